//! `lss`: commissions a CANopen network through a CAN adapter.

use std::{
    io::{self, IsTerminal, Write},
    process::ExitCode,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

use clap::{CommandFactory, error::ErrorKind};

use can_bus::{adapter, person::Person, stop::Stop};
use lss::{Arguments, Command, Failure, Screen, Session, Shows};

fn main() -> ExitCode {
    let arguments = Arguments::read(std::env::args_os()).unwrap_or_else(|error| error.exit());
    let is_interrupted = Arc::new(AtomicBool::new(false));
    match run(&arguments, is_interrupted) {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            // As clap has it.
            let style = clap::builder::Styles::styled();
            let error = style.get_error();
            anstream::eprintln!("{error}error:{error:#} {failure}");
            failure.exit_code().into()
        }
    }
}

/// Whether the terminal only prints.
fn is_dumb() -> bool {
    std::env::var_os("TERM").is_some_and(|term| term == "dumb")
}

/// The size of the terminal, or that of an old one if it does not tell.
fn screen() -> (u16, u16) {
    match terminal_size::terminal_size() {
        Some((terminal_size::Width(width), terminal_size::Height(height))) => (width, height),
        None => (80, 24),
    }
}

fn run(arguments: &Arguments, is_interrupted: Arc<AtomicBool>) -> Result<(), Failure> {
    if let Command::Completion { shell } = arguments.command {
        clap_complete::generate(shell, &mut Arguments::command(), "lss", &mut io::stdout());
        return Ok(());
    }
    if matches!(arguments.command, Command::Adapters) {
        return lss::adapters(&mut io::stdout());
    }
    let found = if arguments.adapter.is_none() { adapter::list() } else { Vec::new() };
    let place = match (&arguments.adapter, &found[..]) {
        (Some(place), _) | (None, [(place, _)]) => place,
        (None, found) => {
            let missing = ErrorKind::MissingRequiredArgument;
            let words =
                "which CAN adapter? --adapter slcan:/dev/ttyACM0, or the variable LSS_ADAPTER";
            let found: Vec<String> =
                found.iter().map(|(place, words)| format!("\n  {place}  {words}")).collect();
            Arguments::command().error(missing, words.to_owned() + &found.concat()).exit()
        }
    };
    let flag = Arc::clone(&is_interrupted);
    let is_watching = matches!(arguments.command, Command::List { watch: true, .. });
    let handled = ctrlc::set_handler(move || {
        let is_first = !flag.swap(true, Ordering::Relaxed);
        if is_first && !is_watching {
            // The terminal may be gone.
            let _ = writeln!(
                io::stderr(),
                "interrupted: the boards leave LSS configuration state first"
            );
        }
    });
    handled.map_err(|error| Stop::Bench(format!("cannot wait for Ctrl-C: {error}")))?;
    if place.is_up() {
        let words = format!(
            "{place} is up. {place}@125 uses it as it is, at 125 kbit/s; or take it down first, and `lss` sets its bit rate"
        );
        return Err(Stop::NoAdapter(words).into());
    }
    let adapter = place.connect()?;
    let is_screen = io::stdout().is_terminal() && !arguments.explain && !is_dumb();
    let shows = match io::stderr().is_terminal() && !is_dumb() {
        _ if arguments.explain => Shows::Nothing,
        true => Shows::Line,
        false => Shows::Lines,
    };
    let out = Box::new(io::stdout());
    let mut session = Session::new(adapter, arguments, is_interrupted, out, shows)?;
    session.screen = is_screen.then_some(screen as Screen);
    if io::stdin().is_terminal() {
        session.person = Person::at_standard_input();
    }
    session.run(arguments)
}
