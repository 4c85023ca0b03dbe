//! The console of `cargo emulate`: commands for the power, the bus and the pins of any board, and for the example `io`.

use std::{io, sync::mpsc::SyncSender, thread};

use anyhow::{Context, bail, ensure};
use emulator::{board::Board, can::Short, chip::Pin, network::Network};
use testkit::io_board;

use super::client::Input;

const GENERAL: &str = "power off|on [BOARD]             cut or restore the supply\n\
     supply MILLIVOLTS [BOARD]        change the voltage of the supply\n\
     short on|off                     let CANH and CANL touch, or separate them\n\
     pin PIN [BOARD]                  show the level of a pin, such as PD13\n\
     pin PIN high|low|open [BOARD]    connect a pin to a level, or to nothing\n\
     analogue PIN MILLIVOLTS [BOARD]  set the voltage at a pin: PA0..PA7, PB0, PB1, PC0..PC5\n\
     temperature CELSIUS [BOARD]      set the temperature of the chip";
const OF_IO: &str = "\nbutton down|up [BOARD]           press or release the button";

/// Passes the lines of the standard input on, in the background.
pub fn read(inputs: SyncSender<Input>) {
    thread::spawn(move || {
        for line in io::stdin().lines().map_while(Result::ok) {
            if inputs.send(Input::Console(line)).is_err() {
                return;
            }
        }
    });
}

/// The console, which knows the names of the example `io` if that runs.
#[derive(Default)]
pub struct Console {
    has_io: bool,
    /// The LEDs of the example on each board, as last shown.
    leds: Vec<[bool; 2]>,
}

impl Console {
    /// A console for boards with the example `io`, or with any other program.
    pub fn new(has_io: bool) -> Self {
        Self { has_io, leds: Vec::new() }
    }

    /// The commands, for a person.
    pub fn help(&self) -> String {
        GENERAL.to_owned() + if self.has_io { OF_IO } else { "" }
    }

    /// Carries out a command; returns what it shows.
    ///
    /// # Errors
    /// It is none, with a list of those that are.
    pub fn execute(&self, line: &str, network: &mut Network) -> anyhow::Result<Option<String>> {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words[..] {
            [] => {}
            ["power", "off", ref board @ ..] => network.power_off(self.number(network, board)?),
            ["power", "on", ref board @ ..] => network.power_on(self.number(network, board)?),
            ["supply", mv, ref board @ ..] => {
                let mv = number(mv, 0, 3_600, "MILLIVOLTS")?;
                self.board(network, board)?.set_supply(mv);
            }
            ["short", state @ ("on" | "off")] => {
                network.set_short((state == "on").then_some(Short::Recessive));
            }
            ["pin", name, level @ ("high" | "low" | "open"), ref board @ ..] => {
                let board = self.board(network, board)?;
                let pin = pin(name, board)?;
                board.chip().gpio_mut().set_input(pin, (level != "open").then(|| level == "high"));
            }
            ["pin", name, ref board @ ..] => {
                let board = self.board(network, board)?;
                let pin = pin(name, board)?;
                let level = board.chip().gpio().level(pin);
                return Ok(Some(format!("{name} is {}", if level { "high" } else { "low" })));
            }
            ["analogue", name, mv, ref board @ ..] => {
                let board = self.board(network, board)?;
                let channel = channel(pin(name, board)?)
                    .with_context(|| format!("{name} has no channel of ADC1"))?;
                let mv = number(mv, 0, 3_600, "MILLIVOLTS")?;
                board.chip().adc_mut().analogue.channels_mv[channel] = mv;
            }
            ["temperature", celsius, ref board @ ..] => {
                let celsius = number(celsius, -40, 125, "CELSIUS")?;
                self.board(network, board)?.chip().adc_mut().analogue.temperature = celsius;
            }
            ["button", position @ ("down" | "up"), ref board @ ..] if self.has_io => {
                io_board::press(self.board(network, board)?, position == "down");
            }
            _ => bail!("the commands are:\n{}", self.help()),
        }
        Ok(None)
    }

    /// The number of the board that a command names.
    fn number(&self, network: &Network, words: &[&str]) -> anyhow::Result<usize> {
        let last = network.boards().len().saturating_sub(1);
        match words {
            [] => Ok(0),
            [word] => {
                let number = word.parse().context("BOARD is a number, 0 for the first")?;
                ensure!(number <= last, "there is no board {number}: the last one is {last}");
                Ok(number)
            }
            _ => bail!("the commands are:\n{}", self.help()),
        }
    }

    fn board<'a>(&self, network: &'a mut Network, words: &[&str]) -> anyhow::Result<&'a mut Board> {
        let number = self.number(network, words)?;
        Ok(network.board_mut(number))
    }

    /// The lines for the LEDs of the example `io` that have changed.
    pub fn changed_leds(&mut self, boards: &[Board]) -> Vec<String> {
        let mut lines = Vec::new();
        self.leds.resize(if self.has_io { boards.len() } else { 0 }, [false; 2]);
        for (number, (shown, board)) in self.leds.iter_mut().zip(boards).enumerate() {
            let lit = io_board::leds(board);
            if *shown != lit {
                let [first, second] = lit.map(|is_lit| if is_lit { "on" } else { "off" });
                lines.push(format!("board {number}: LED 1 {first}, LED 2 {second}"));
                *shown = lit;
            }
        }
        lines
    }
}

/// The number that `word` gives, within these limits.
fn number<T: TryFrom<i32>>(word: &str, least: i32, most: i32, name: &str) -> anyhow::Result<T> {
    let number = word.parse().ok().filter(|number| (least..=most).contains(number));
    number
        .and_then(|number| T::try_from(number).ok())
        .with_context(|| format!("{name} is a whole number from {least} to {most}"))
}

/// The pin with a name such as `PD13`.
fn pin(name: &str, board: &Board) -> anyhow::Result<Pin> {
    let ports = board.chip().part().gpio_ports();
    let parse = || {
        let mut letters = name.strip_prefix('P')?.chars();
        let port = letters.next().filter(|port| ('A'..).take(ports).any(|known| known == *port))?;
        let number = letters.as_str().parse().ok().filter(|number| *number < 16)?;
        Some(Pin(port, number))
    };
    parse().with_context(|| format!("{name} is no pin: a name such as PA0 or PD13"))
}

/// The channel of ADC1 at a pin (data sheet).
fn channel(pin: Pin) -> Option<usize> {
    match pin {
        Pin('A', number @ 0..=7) => Some(number.into()),
        Pin('B', number @ 0..=1) => Some(8 + usize::from(number)),
        Pin('C', number @ 0..=5) => Some(10 + usize::from(number)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use testkit::{boards, image};

    use super::*;

    fn network() -> Network {
        let mut network = Network::new();
        network.add_board(boards::board(image::PART, image::image(), 0));
        network
    }

    #[test]
    fn commands_reach_the_board() {
        let (mut network, console) = (network(), Console::new(true));
        let mut execute = |line: &str| {
            let shown = console.execute(line, &mut network).expect(line);
            let board = network.board(0);
            (shown.unwrap_or_default(), board.is_powered(), board.chip().adc_mut().analogue)
        };
        for (line, level) in [
            ("button down", "high"),
            (" button  up 0 ", "low"),
            ("pin PA0 high 0", "high"),
            ("pin PA0 low", "low"),
            ("pin PA0 open", "low"),
        ] {
            execute(line);
            assert_eq!(execute("pin PA0").0, format!("PA0 is {level}"), "{line}");
        }
        assert_eq!(execute("temperature -10").2.temperature, -10);
        for (pin, channel) in [("PA0", 0), ("PA7", 7), ("PB1", 9), ("PC5", 15)] {
            let analogue = execute(&format!("analogue {pin} {}", 1_000 + channel)).2;
            assert_eq!(analogue.channels_mv[channel], 1_000 + channel as u32);
        }
        for (line, is_powered) in
            [("power off", false), ("power on 0", true), ("supply 0", false), ("supply 3300", true)]
        {
            assert_eq!(execute(line).1, is_powered, "{line}");
        }
        execute("");
    }

    #[test]
    fn what_is_no_command_is_refused_with_help() {
        let mut network = network();
        for (line, why) in [
            ("help", "the commands are"),
            ("button", "the commands are"),
            ("button pressed", "the commands are"),
            ("button down 0 0", "the commands are"),
            ("button down 1", "there is no board 1"),
            ("power off 1", "there is no board 1"),
            ("power", "the commands are"),
            ("short", "the commands are"),
            ("button down first", "BOARD is a number"),
            ("temperature hot", "CELSIUS"),
            ("temperature 200", "CELSIUS"),
            ("supply 5000", "MILLIVOLTS"),
            ("pin A0", "A0 is no pin"),
            ("pin PZ0 high", "PZ0 is no pin"),
            ("pin PA16", "PA16 is no pin"),
            ("pin PA0 up", "BOARD is a number"),
            ("analogue PD0 100", "PD0 has no channel"),
        ] {
            let error = Console::new(true).execute(line, &mut network).expect_err(line);
            assert!(error.to_string().contains(why), "{line}: {error}");
        }
    }

    #[test]
    fn the_names_of_the_example_are_unknown_beside_another_program() {
        let (mut network, console) = (network(), Console::new(false));
        let error = console.execute("button down", &mut network).expect_err("there is no button");
        assert!(!error.to_string().contains("button"), "{error}");
    }
}
