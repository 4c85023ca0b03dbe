//! `cargo emulate`: boards in real time, and their CAN bus as SLCAN adapters over TCP.

pub mod client;
mod console;
mod memory;
mod pace;
mod programs;

use std::{
    collections::BTreeMap,
    net::{SocketAddr, TcpListener},
    path::PathBuf,
    sync::mpsc,
    time::{Duration, Instant},
};

use anyhow::{Context, ensure};
use canopen_node::{BitRate, NodeId, Settings};
use emulator::{
    Time,
    board::{self, Board},
    can::Clock,
    chip::Part,
    network::{Network, Recording},
};
use testkit::{image::PART, image_rig::DEFAULT_BIT_RATE, settings::Stored, wire::bit_per_s};

use testkit::boards::{self, FIRST_START};

use canopen_stm32f4::chip;

use crate::{
    controller,
    example::{self, Example},
};
use client::{Client, ClientId, Input};
use console::Console;
use memory::Memory;
use pace::Pace;
use programs::Programs;

/// The longest time until the programs get a received frame.
const TICK: Duration = Duration::from_millis(1);
/// The longest real time without a look at the clients' lines, while a busy program slows the emulation down.
const TURN: Duration = Duration::from_millis(20);
/// The step of virtual time within a turn.
const SLICE: Time = Time::from_us(500);
const DEFAULT_HEARTBEAT_MS: u16 = 1000;

/// Offer the CAN bus of emulated boards to any CAN program, as SLCAN adapters over TCP
///
/// Each TCP connection is one SLCAN (LAWICEL) adapter on the bus, with its own bit rate. With python-can:
///
///   can.Bus(interface="slcan", channel="socket://127.0.0.1:29536", bitrate=125000)
///
/// The boards run the release firmware in real time until Ctrl-C. An adapter that is opened at a different bit rate
/// from theirs disturbs the bus, as on a desk; an adapter that is closed drops its waiting frames.
///
/// With --elf any program for an STM32F4 or an STM32G431 runs beside them. Its defmt or RTT log is
/// printed, and at the end every access that the emulated board does not model or a chip does not tolerate.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Number of boards with our firmware: 1..=127; 0 beside --elf
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(0..=127))]
    boards: u8,
    /// Another program for the chip, an ELF file or `*.hex`, on a board of its own; the option can be repeated
    #[arg(long, value_name = "FILE")]
    elf: Vec<PathBuf>,
    /// Address on which to wait for CAN programs
    #[arg(long, default_value = "127.0.0.1:29536", value_name = "ADDRESS:PORT")]
    listen: SocketAddr,
    /// Keep each board's flash in the folder DIR, as board-N.bin: the next run is a power cycle
    #[arg(long, value_name = "DIR")]
    flash: Option<PathBuf>,
    /// Node-ID of a board without stored settings: 1..=127, counting up from board to board; or none
    #[arg(long, value_name = "ID|none", value_parser = node_id)]
    node_id: Option<FirstNodeId>,
    /// Bit rate in kbit/s of a board without stored settings; 125 if only --node-id is given
    #[arg(long, value_name = "KBIT", value_parser = bit_rate)]
    bit_rate: Option<BitRate>,
    /// Run an example of a product on its board, in place of the plain firmware; implies --console
    #[arg(long)]
    example: Option<Example>,
    /// Take commands from the standard input: switch the power, short the bus, set pins, voltages and the temperature
    #[arg(long)]
    console: bool,
    /// The chip on the boards; stm32g431 only on those of --elf
    #[arg(long, default_value = testkit::image::PART.name(), value_parser = Part::any)]
    chip: Part,
    /// The CAN controller on the bus, on the boards of --elf: can1, can2, or on some chips can3
    #[arg(long, default_value = "can1", value_parser = chip::controller, requires = "elf")]
    controller: u8,
    /// The crystal on the boards of --elf, in MHz
    #[arg(long, default_value_t = 8, value_name = "MHZ", value_parser = clap::value_parser!(u8).range(4..=26), requires = "elf")]
    crystal: u8,
    /// Give the boards transceivers with this dominant time-out
    #[arg(long, value_name = "MICROSECONDS", value_parser = clap::value_parser!(u16).range(1..))]
    time_out: Option<u16>,
}

/// The node-ID of the first board; `None`: the boards are stored as unconfigured.
type FirstNodeId = Option<NodeId>;

fn node_id(text: &str) -> Result<FirstNodeId, String> {
    match text {
        "none" => Ok(None),
        _ => match text.parse().ok().and_then(NodeId::new) {
            None => Err("1 to 127, or none".into()),
            id => Ok(id),
        },
    }
}

fn bit_rate(text: &str) -> Result<BitRate, String> {
    BitRate::ALL.into_iter().find(|rate| rate.kbit_per_s().to_string() == text).ok_or_else(|| {
        let rates = BitRate::ALL.map(|rate| rate.kbit_per_s().to_string());
        format!("one of {}", rates.join(", "))
    })
}

impl Arguments {
    /// The settings stored in a board before its first start; `None`: it is blank.
    fn preset(&self, number: usize) -> anyhow::Result<Option<Stored>> {
        if self.node_id.is_none() && self.bit_rate.is_none() {
            return Ok(None);
        }
        let settings = Settings::new(self.bit_rate.unwrap_or(DEFAULT_BIT_RATE).into());
        let stored = |settings| Stored { settings, heartbeat_ms: DEFAULT_HEARTBEAT_MS };
        let Some(first) = self.node_id.flatten() else { return Ok(Some(stored(settings))) };
        let id = NodeId::new(first.get().saturating_add(number as u8)).with_context(|| {
            format!("--node-id {}: no node-ID is left for board {number}", first.get())
        })?;
        Ok(Some(stored(settings.with_node_id(Some(id)))))
    }
}

/// Runs the boards until Ctrl-C.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    // It may build the firmware for minutes: a program that connects meanwhile would get no answer.
    let Prepared { mut network, memory, programs } = prepare(arguments)?;
    let listener = TcpListener::bind(arguments.listen).with_context(|| {
        format!("cannot listen at {} (choose another address with --listen)", arguments.listen)
    })?;
    let address = listener.local_addr()?;
    let (sender, inputs) = mpsc::sync_channel(client::WAITING);
    let (stop, console_sender) = (sender.clone(), sender.clone());
    ctrlc::set_handler(move || _ = stop.send(Input::Stop)).context("cannot wait for Ctrl-C")?;
    client::accept(listener, sender);
    println!("ready: SLCAN on {address}; {}", describe(programs.ours(&network), &programs));
    let console = Console::new(matches!(arguments.example, Some(Example::Io)));
    if arguments.console || arguments.example.is_some() {
        println!("commands (BOARD is 0 unless given):\n{}", console.help());
        console::read(console_sender);
    }
    let bit_rate = arguments.bit_rate.unwrap_or(DEFAULT_BIT_RATE);
    let mut surroundings = Surroundings { memory, programs, console };
    serve(&mut network, &inputs, &mut surroundings, bit_rate)?;
    print!("{}", surroundings.programs.report(&network));
    ensure!(
        surroundings.programs.are_tolerable(&network),
        "a chip does not tolerate what the report has"
    );
    Ok(())
}

/// The boards on their bus, ours after their first start.
struct Prepared {
    network: Network,
    memory: Memory,
    programs: Programs,
}

fn prepare(arguments: &Arguments) -> anyhow::Result<Prepared> {
    let chip = arguments.chip;
    let is_ours = Part::F4.contains(&chip);
    ensure!(
        is_ours || !arguments.elf.is_empty(),
        "--chip {} needs --elf: our firmware does not run on it",
        chip.name()
    );
    let chip_of_ours = if is_ours { chip } else { PART };
    let controller = arguments.controller;
    controller::check(chip, controller)?;
    ensure!(arguments.boards > 0 || !arguments.elf.is_empty(), "--boards 0 needs --elf");
    ensure!(
        arguments.boards > 0 || arguments.example.is_none(),
        "--example runs on boards with our firmware only, and there are none"
    );
    ensure!(
        arguments.boards > 0 || arguments.node_id.is_none(),
        "--node-id is stored in boards with our firmware only: set that of an --elf board over LSS"
    );
    let presets = (0..usize::from(arguments.boards))
        .map(|number| arguments.preset(number))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let mut memory = Memory::open(arguments.flash.as_deref())?;
    let mut network = Network::new();
    network.record(Recording::Off);
    let dominant_time_out = arguments.time_out.map(|us| Time::from_us(us.into()));
    let image = (arguments.boards > 0)
        .then(|| example::image(chip_of_ours, arguments.example))
        .transpose()?;
    for (number, (preset, image)) in presets.into_iter().zip(image.iter().cycle()).enumerate() {
        let unique_id = boards::unique_id(number);
        let of_example = example::board(arguments.example);
        let settings = board::Settings { unique_id, dominant_time_out, ..of_example };
        let mut board = Board::new(chip_of_ours, image, settings);
        memory.restore(&mut board, image, number, preset)?;
        network.add_board(board);
    }
    network.run_for(FIRST_START);
    memory.save(&network)?;
    let crystal = Clock { hz: u32::from(arguments.crystal) * 1_000_000, ppm: 0 };
    let controller = controller.into();
    let settings = board::Settings { crystal, controller, dominant_time_out, ..Default::default() };
    let programs = Programs::load(&arguments.elf, chip, settings, &mut memory, &mut network)?;
    Ok(Prepared { network, memory, programs })
}

fn describe(ours: &[Board], programs: &Programs) -> String {
    let board = |number: usize| {
        let stored = match boards::stored_settings(&ours[number].flash()) {
            None => "blank".to_owned(),
            Some(Settings { node_id, bit_rate, .. }) => {
                let node_id = node_id.map_or("none".to_owned(), |id| id.get().to_string());
                format!("node-ID {node_id}, {bit_rate}")
            }
        };
        format!("board {number}: serial number {:08X}, {stored}", boards::serial_number(number))
    };
    (0..ours.len()).map(board).chain(programs.names()).collect::<Vec<_>>().join("; ")
}

/// What is around the bus beside the clients.
#[derive(Default)]
pub struct Surroundings {
    memory: Memory,
    programs: Programs,
    console: Console,
}

/// Runs the network in real time, each client with an adapter set to `bit_rate`, until [`Input::Stop`].
pub fn serve(
    network: &mut Network,
    inputs: &mpsc::Receiver<Input>,
    surroundings: &mut Surroundings,
    bit_rate: BitRate,
) -> anyhow::Result<()> {
    let Surroundings { memory, programs, console } = surroundings;
    let bit_rate = bit_per_s(bit_rate);
    let mut clients: BTreeMap<ClientId, Client> = BTreeMap::new();
    let mut unused = Vec::new();
    let mut pace = Pace::new(network.now());
    loop {
        let first = inputs.recv_timeout(TICK);
        let (due, turn) = (pace.due(network.now()), Instant::now());
        while network.now() < due && turn.elapsed() < TURN {
            network.run_until(due.min(network.now() + SLICE));
        }
        for client in clients.values_mut() {
            client.deliver(network);
        }
        for line in console.changed_leds(network.boards()) {
            println!("{line}");
        }
        programs.print(network);
        memory.save(network)?;
        // Take all waiting inputs: on a busy computer each run takes long.
        for input in first.into_iter().chain(inputs.try_iter().take(client::WAITING)) {
            match input {
                Input::Connected(id, stream) => {
                    let adapter = unused.pop().unwrap_or_else(|| client::new_adapter(network));
                    clients.insert(id, Client::new(stream, adapter, bit_rate, network));
                }
                Input::Line(id, line) => {
                    if let Some(client) = clients.get_mut(&id) {
                        client.execute(&line, network);
                    }
                }
                Input::Gone(id) => {
                    if let Some(client) = clients.remove(&id) {
                        unused.push(client.leave(network));
                    }
                }
                Input::Console(line) => match console.execute(&line, network) {
                    Ok(shown) => shown.iter().for_each(|line| println!("{line}")),
                    Err(error) => eprintln!("{error}"),
                },
                Input::Stop => return memory.save(network),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{
        io::{Read, Write},
        iter,
        net::TcpStream,
        thread,
    };

    use clap::Parser;
    use emulator::can::Adapter;
    use testkit::{
        frames::{of_master, of_node},
        wire::on_the_wire,
    };

    use super::*;

    #[derive(Parser)]
    struct CommandLine {
        #[command(flatten)]
        arguments: Arguments,
    }

    fn prepared(words: &str) -> anyhow::Result<Prepared> {
        let words = ["emulate"].into_iter().chain(words.split_whitespace());
        prepare(&CommandLine::try_parse_from(words)?.arguments)
    }

    #[test]
    fn the_board_of_each_example_answers_a_master() {
        for example in ["", "--example io"] {
            let mut network = prepared(&format!("{example} --node-id 5")).expect(example).network;
            let master = network.add_adapter(Adapter::new(bit_per_s(DEFAULT_BIT_RATE)));
            for request in ["04 01", "5E"] {
                network.send(master, on_the_wire(&of_master(request)));
            }
            let received = || network.run_until_received(master, Time::from_ms(50));
            let frames: Vec<_> = iter::from_fn(received).map(|(_, frame)| frame).collect();
            assert!(frames.contains(&on_the_wire(&of_node("5E 05"))), "`{example}`: {frames:?}");
        }
    }

    #[test]
    fn an_option_without_effect_is_refused() {
        let refusal = |words: &str| match prepared(words) {
            Ok(_) => panic!("`{words}` is not refused"),
            Err(error) => error.to_string(),
        };
        for words in ["--controller can2", "--example io --crystal 12"] {
            assert!(refusal(words).contains("--elf <FILE>"), "{words}");
        }
        assert!(refusal("--chip stm32g431").contains("needs --elf"));
        assert!(refusal("--boards 0 --elf a.elf --example io").contains("there are none"));
        assert!(refusal("--boards 0 --elf a.elf --node-id 5").contains("our firmware only"));
    }

    #[test]
    fn the_address_is_taken_when_the_boards_are_ready() {
        let taken = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = taken.local_addr().expect("it is bound").to_string();
        let words = ["emulate", "--boards", "0", "--elf", "missing.elf", "--listen", &address];
        let command = CommandLine::try_parse_from(words).expect("valid");
        let error = run(&command.arguments).expect_err("there is no such file").to_string();
        assert!(error.contains("missing.elf"), "{error}");
    }

    /// A bus without boards that runs until the end of the tests.
    fn served_bus() -> SocketAddr {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = listener.local_addr().expect("it is bound");
        thread::spawn(move || {
            let (sender, inputs) = mpsc::sync_channel(client::WAITING);
            client::accept(listener, sender);
            let mut nothing = Surroundings::default();
            serve(&mut Network::new(), &inputs, &mut nothing, BitRate::Kbit500)
        });
        address
    }

    struct Program(TcpStream);

    impl Program {
        fn connect(address: SocketAddr) -> Self {
            let stream = TcpStream::connect(address).expect("it listens");
            stream.set_read_timeout(Some(Duration::from_secs(20))).expect("not zero");
            Self(stream)
        }

        fn send(&mut self, lines: &str) {
            self.0.write_all(lines.as_bytes()).expect("it is connected");
        }

        fn expect(&mut self, answer: &str) {
            let mut received = vec![0; answer.len()];
            self.0.read_exact(&mut received).expect("as many bytes as expected");
            assert_eq!(String::from_utf8_lossy(&received), answer);
        }
    }

    #[test]
    fn programs_exchange_frames() {
        let address = served_bus();
        let (mut one, mut other) = (Program::connect(address), Program::connect(address));
        let mut listener = Program::connect(address);
        one.send("\rO\r");
        one.expect("\r\r");
        other.send("S6\rO\r");
        other.expect("\r\r");
        listener.send("S6\rL\r");
        listener.expect("\r\r");
        thread::sleep(Duration::from_millis(20));

        one.send("t7E52AABB\rR123456783\r");
        one.expect("z\rZ\r");
        other.expect("t7E52AABB\rR123456783\r");
        listener.expect("t7E52AABB\rR123456783\r");
        listener.send("t1230\rF\r");
        listener.expect("\x07F00\r");
        other.send("T000000010\r");
        other.expect("Z\r");
        one.expect("T000000010\r");
        listener.expect("T000000010\r");
    }

    #[test]
    fn a_program_at_another_bit_rate_disturbs_the_bus_until_it_goes() {
        let address = served_bus();
        let (mut one, mut other) = (Program::connect(address), Program::connect(address));
        for program in [&mut one, &mut other] {
            program.send("S6\rO\r");
            program.expect("\r\r");
        }
        let mut disturber = Program::connect(address);
        disturber.send("S4\rO\rt0000\r");
        disturber.expect("\r\rz\r");
        thread::sleep(Duration::from_millis(100));
        one.send("t1230\rF\r");
        one.expect("z\rFA4\r");
        drop(disturber);
        other.expect("t1230\r");
    }

    #[test]
    fn a_command_that_is_not_possible_now_is_refused() {
        let mut program = Program::connect(served_bus());
        program.send("t1230\rX\rO\rO\rL\rS4\rC\rC\rt1230\rS4\r");
        program.expect("\x07\x07\r\x07\x07\x07\r\r\x07\r");
        program.send("V\rN\rZ1\rM00000000\r\nmFFFFFFFF\r");
        program.expect("V1013\rNEMUL\r\r\r\r");
    }

    #[test]
    fn a_line_that_is_no_command_is_refused() {
        let mut program = Program::connect(served_bus());
        program.send("S0\rS8\rO\r");
        program.expect("\r\r\r");
        let lines = "X\rS\rS9\rS44\rs031C\rO1\rZ\rZ2\rM0\rmGGGGGGGG\rt\rt7E\rt7E5\rt8000\rt7E59\rt7E51\r\
                     t7E5100FF\rt7E51G0\rt7E51+1\rr7E5100\rT7E50\rT200000000\rt\u{c4}\rR1FFFFFFF\r\0\r";
        program.send(lines);
        program.0.write_all(b"t\xFF\r").expect("it is connected");
        program.expect(&"\x07".repeat(lines.matches('\r').count() + 1));
    }

    #[test]
    fn a_line_that_is_too_long_is_refused_as_a_whole() {
        let mut program = Program::connect(served_bus());
        program.send("S6\rO\r");
        program.expect("\r\r");
        let long = "A".repeat(64);
        program.send(&format!("{long}t1230\r{long}\r{}\rV\r", "A".repeat(10_000)));
        program.expect("\x07\x07\x07V1013\r");
    }

    #[test]
    fn a_program_that_floods_the_emulation_does_not_block_others() {
        let address = served_bus();
        let mut flood = Program::connect(address);
        thread::spawn(move || while flood.0.write_all(&[b'\r'; 4096]).is_ok() {});
        thread::sleep(Duration::from_millis(300));
        let mut program = Program::connect(address);
        for _ in 0..10 {
            program.send("V\r");
            program.expect("V1013\r");
        }
    }

    #[test]
    fn a_node_id_is_1_to_127_or_none() {
        assert_eq!(node_id("none"), Ok(None));
        assert_eq!(node_id("1"), Ok(NodeId::new(1)));
        assert_eq!(node_id("127"), Ok(NodeId::new(127)));
        for text in ["", "0", "128", "255", "-1", "x"] {
            assert!(node_id(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_bit_rate_is_one_of_cia_301() {
        assert_eq!(bit_rate("125"), Ok(BitRate::Kbit125));
        assert_eq!(bit_rate("1000"), Ok(BitRate::Kbit1000));
        assert!(bit_rate("100").is_err());
    }
}
