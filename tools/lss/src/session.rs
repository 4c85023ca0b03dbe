//! A run of a command on a bus, which leaves all boards in LSS waiting state.

use std::{
    fs::{self, File},
    io::Write,
    time::Duration,
};

use can_bus::{
    bus::{Bus, Masters, Pace},
    person::{PATIENCE, Person},
    stop::Stop,
};
use canopen_node::{BitRate, lss::Request};
use lss_master::Procedure;

use crate::{
    arguments::{Arguments, Command},
    commands,
    failure::Failure,
    network::board,
    picture::{self, Caption},
    progress::Progress,
    recorder::Record,
};

/// The bit rate of new boards.
pub const DEFAULT_RATE: BitRate = BitRate::Kbit125;

/// The answer time from which on a slave is slow.
const SLOW: Duration = Duration::from_millis(50);

/// The time between two looks at what the person writes.
pub const GLANCE: Duration = Duration::from_millis(50);

/// The width and the height of the terminal in characters.
pub type Screen = fn() -> (u16, u16);

/// The bus, and where the results go.
pub struct Session<'a> {
    pub bus: Bus,
    pub out: &'a mut dyn Write,
    pub progress: Progress,
    pub person: Person,
    /// The terminal that the results go to; `None` if they go elsewhere.
    pub screen: Option<Screen>,
    /// All boards are in LSS waiting state, and no request follows.
    pub all_wait: bool,
    /// The answer time of a slow slave that the person was told of.
    pub slow_answer: Option<Duration>,
    /// The serial numbers that the person was told to be there twice.
    pub twice: Vec<u32>,
    /// What the adapter did, for a picture.
    pub record: Option<Record>,
}

impl<'a> Session<'a> {
    pub fn new(bus: Bus, out: &'a mut dyn Write, shows_progress: bool) -> Self {
        let progress = Progress::new(shows_progress);
        let person = Person::absent();
        Self {
            bus,
            out,
            progress,
            person,
            screen: None,
            all_wait: false,
            slow_answer: None,
            twice: Vec::new(),
            record: None,
        }
    }

    /// Carries out the command, leaves the bus, and draws what happened.
    pub fn run(&mut self, arguments: &Arguments) -> Result<(), Failure> {
        let Some(path) = &arguments.svg else { return self.work(arguments) };
        let cannot = |error| Stop::Bench(format!("cannot write {}: {error}", path.display()));
        // Before the work: a file that is there keeps its content.
        File::options().append(true).create(true).open(path).map_err(cannot)?;
        let outcome = self.work(arguments);
        if let Some(Record { entries, time_of_day }) = &self.record {
            let adapter = self.bus.description();
            let caption = Caption {
                title: arguments.command.title(),
                line: format!("{adapter}, from {}", picture::date_and_time(*time_of_day)),
                failure: outcome.as_ref().err().map(ToString::to_string),
            };
            let svg = picture::draw(&entries.borrow(), &caption);
            fs::write(path, svg).map_err(cannot)?;
        }
        outcome
    }

    fn work(&mut self, arguments: &Arguments) -> Result<(), Failure> {
        // A running network has an NMT master and SDO clients.
        self.bus.mind(Masters::Lss);
        self.bus.set_pace(Pace::Quick);
        let outcome = self.carry(arguments);
        self.progress.clear();
        let is_over = match arguments.command {
            // It changes no state.
            Command::Find { .. } => true,
            // The user asks for each state that a raw request leads to.
            Command::Raw { .. } => outcome.is_ok(),
            _ => self.all_wait,
        };
        if !is_over {
            self.end();
        }
        self.bus.leave();
        self.out.flush()?;
        match (self.bus.short_answer, &arguments.command) {
            // It prints each answer.
            (_, Command::Raw { .. }) | (None, _) => outcome,
            (Some(answer), _) => short_answer(outcome, answer.data().len()),
        }
    }

    fn carry(&mut self, arguments: &Arguments) -> Result<(), Failure> {
        let rate = arguments.bit_rate.or(self.bus.fixed_rate()).unwrap_or(DEFAULT_RATE);
        if let Command::Find { ask } = arguments.command {
            return commands::find(self, rate, ask);
        }
        if let Command::Apply(arguments_of_it) = &arguments.command {
            return commands::apply(self, arguments.bit_rate, arguments_of_it);
        }
        self.bus.open(rate)?;
        match arguments.command {
            // These let boards store, send what the user asks for, or do it themselves.
            Command::Store(_) | Command::Raw { .. } | Command::Assign(_) => {}
            _ => board::end_earlier_run(self)?,
        }
        match &arguments.command {
            Command::Find { .. } | Command::Apply(_) | Command::Completion { .. } => Ok(()),
            Command::List { watch: true, .. } => commands::watch(self),
            Command::List { json, .. } => commands::list(self, *json),
            Command::Assign(assign) => commands::assign(self, assign),
            Command::SetRate { rate, delay } => commands::set_rate(self, *rate, *delay),
            Command::Inquire(target) => commands::inquire(self, *target),
            Command::Blink { which } => commands::blink(self, *which),
            Command::Identify(ranges) => commands::identify(self, ranges),
            Command::SetId { id, target, store, reset } => {
                commands::set_id(self, *id, *target, *store, *reset)
            }
            Command::Store(target) => commands::store(self, *target),
            Command::Raw { bytes } => commands::raw(self, bytes),
        }
    }

    /// Asks the person on the standard error, with all boards in LSS waiting state; `None` if nobody answers.
    pub fn ask(&mut self, question: &str) -> Result<Option<String>, Failure> {
        if !self.person.is_there() {
            return Ok(None);
        }
        self.bus.request(Request::SwitchToWaiting)?;
        self.progress.clear();
        eprintln!("{question}");
        let Self { bus, person, .. } = self;
        let until = bus.time() + PATIENCE;
        person.answer(|| -> Result<bool, Failure> {
            bus.pass(GLANCE)?;
            Ok(bus.time() < until)
        })
    }

    /// Lets a Ctrl-C wait until the work is done.
    pub fn uninterrupted<T>(
        &mut self,
        work: impl FnOnce(&mut Self) -> Result<T, Failure>,
    ) -> Result<T, Failure> {
        self.bus.check_interrupt()?;
        self.bus.hold_interrupt(true);
        let outcome = work(self);
        self.bus.hold_interrupt(false);
        outcome
    }

    /// Brings all boards to LSS waiting state, also after Ctrl-C, as far as the adapter still works.
    pub fn end(&mut self) {
        self.bus.insist();
        let _ = self.bus.request(Request::SwitchToWaiting).and_then(|()| self.bus.flush());
    }

    /// Carries out a procedure of the LSS master.
    pub fn carry_out<P: Procedure>(&mut self, procedure: P) -> Result<P::Output, Failure> {
        let outcome = self.bus.carry_out(procedure)?;
        if let Some(number) = self.bus.serial_number_twice()
            && !self.twice.contains(&number)
        {
            self.twice.push(number);
            self.progress.note(&format!(
                "serial number {number:08X}: a second answer to one question. Two boards have this LSS address, or one \
                 answers twice"
            ));
        }
        let slowest = self.bus.slowest_answer().unwrap_or_default();
        if slowest > SLOW.max(2 * self.slow_answer.unwrap_or_default()) {
            self.slow_answer = Some(slowest);
            let ms = slowest.as_millis();
            self.progress.note(&format!(
                "a slave takes {ms} ms to answer: each question waits as long for it"
            ));
        }
        Ok(outcome?)
    }
}

/// What became of a command while the answers of a device were passed over.
fn short_answer(outcome: Result<(), Failure>, len: usize) -> Result<(), Failure> {
    let words = format!(
        "a device answers LSS requests with {len} bytes, and not with 8 (CiA 305): it was passed over. Its firmware must be \
         mended, or `lss raw` configures it, alone on the bus"
    );
    Err(match outcome {
        Ok(()) => Failure::Refused(words),
        Err(stop @ Failure::Stop(_)) => stop,
        Err(failure) => Failure::Refused(format!("{failure}\n{words}")),
    })
}
