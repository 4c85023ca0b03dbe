//! The console of `cargo emulate`: switches the power, shorts the bus, presses the button, sets the temperature, and shows the LEDs.

use std::{io, thread};

use anyhow::{Context, bail};
use emulator::{board::Board, can::Short, network::Network};
use testkit::io_board;

use super::client::Input;

/// The commands, for a person.
pub const HELP: &str = "power off|on [BOARD]          cut or restore the supply\n\
     short on|off                  let CANH and CANL touch, or separate them\n\
     button down|up [BOARD]        press or release the button\n\
     temperature CELSIUS [BOARD]   set the temperature of the chip";

/// Passes the lines of the standard input on, in the background.
pub fn read(inputs: std::sync::mpsc::SyncSender<Input>) {
    thread::spawn(move || {
        for line in io::stdin().lines().map_while(Result::ok) {
            if inputs.send(Input::Console(line)).is_err() {
                return;
            }
        }
    });
}

/// Carries out a command.
///
/// # Errors
/// It is none, with a list of those that are.
pub fn execute(line: &str, network: &mut Network) -> anyhow::Result<()> {
    let words: Vec<&str> = line.split_whitespace().collect();
    match words[..] {
        [] => Ok(()),
        ["power", "off", ref number @ ..] => {
            network.power_off(board(network, number)?);
            Ok(())
        }
        ["power", "on", ref number @ ..] => {
            network.power_on(board(network, number)?);
            Ok(())
        }
        ["short", state @ ("on" | "off")] => {
            network.set_short((state == "on").then_some(Short::Recessive));
            Ok(())
        }
        ["button", position @ ("down" | "up"), ref number @ ..] => {
            let number = board(network, number)?;
            io_board::press(network.board_mut(number), position == "down");
            Ok(())
        }
        ["temperature", celsius, ref number @ ..] => {
            let celsius = celsius.parse().ok().filter(|celsius| (-40..=125).contains(celsius));
            let celsius = celsius.context("CELSIUS is a whole number from -40 to 125")?;
            let number = board(network, number)?;
            io_board::set_temperature(network.board_mut(number), celsius);
            Ok(())
        }
        _ => bail!("the commands are:\n{HELP}"),
    }
}

/// The number of the board that a command names.
fn board(network: &Network, number: &[&str]) -> anyhow::Result<usize> {
    let number: usize = match number {
        [] => 0,
        [number] => number.parse().context("BOARD is a number, 0 for the first")?,
        _ => bail!("the commands are:\n{HELP}"),
    };
    let count = network.boards().len();
    if number >= count {
        bail!("there is no board {number}: the last one is {}", count.saturating_sub(1));
    }
    Ok(number)
}

/// The LEDs of the boards, as last shown.
#[derive(Default)]
pub struct Leds(Vec<[bool; 2]>);

impl Leds {
    /// Prints the LEDs that have changed.
    pub fn show(&mut self, boards: &[Board]) {
        self.0.resize(boards.len(), [false; 2]);
        for (number, shown) in self.0.iter_mut().enumerate() {
            let lit = io_board::leds(&boards[number]);
            if *shown != lit {
                let [first, second] = lit.map(|is_lit| if is_lit { "on" } else { "off" });
                println!("board {number}: LED 1 {first}, LED 2 {second}");
                *shown = lit;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use emulator::chip::{Part, Pin};
    use testkit::{boards, image};

    use super::*;

    fn network() -> Network {
        let mut network = Network::new();
        network.add_board(boards::board(Part::Stm32f405, image::image(), 0));
        network
    }

    #[test]
    fn commands_reach_the_board() {
        let mut network = network();
        for (line, level) in [("button down", true), (" button  up 0 ", false)] {
            execute(line, &mut network).expect("a command");
            assert_eq!(network.board(0).chip().gpio().level(Pin('A', 0)), level, "{line}");
        }
        execute("temperature -10", &mut network).expect("a command");
        assert_eq!(network.board(0).chip().adc_mut().analogue.temperature, -10);
        for (line, is_powered) in [("power off", false), ("power on 0", true)] {
            execute(line, &mut network).expect("a command");
            assert_eq!(network.board(0).is_powered(), is_powered, "{line}");
        }
        execute("", &mut network).expect("an empty line does nothing");
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
        ] {
            let error = execute(line, &mut network).expect_err(line);
            assert!(error.to_string().contains(why), "{line}: {error}");
        }
    }
}
