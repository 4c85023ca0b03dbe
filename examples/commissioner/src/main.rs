//! An LSS master on a board, and nothing else: its parts, and the loop that never ends.

#![no_std]
#![no_main]

mod commissioner;
mod network;
mod table;

use canopen_stm32f4::{
    Board, Crystal, Led, board,
    can::{CanPins, Controller},
};
use defmt_rtt as _;
use lss_master::Master;
use panic_probe as _;
use stm32f4xx_hal::{gpio::GpioExt, pac::Peripherals};

use crate::{
    commissioner::{Commissioner, TIMING},
    network::{Network, Seen},
    table::Table,
};

#[cortex_m_rt::entry]
fn main() -> ! {
    let chip = Peripherals::take().expect("nobody else takes them");
    let core = cortex_m::Peripherals::take().expect("nobody else takes them");
    let peripherals = board::Peripherals {
        clocks: chip.RCC,
        debug: chip.DBGMCU,
        flash: chip.FLASH,
        power: chip.PWR,
        timer: chip.TIM2,
        watchdog: chip.IWDG,
    };
    let mut board = Board::new(peripherals, &core, Crystal::new(8_000_000, false));
    let rcc = &mut board.rcc;
    let (a, b, d) = (chip.GPIOA.split(rcc), chip.GPIOB.split(rcc), chip.GPIOD.split(rcc));
    let can = Controller::new(chip.CAN1, CanPins::new(b.pb9, b.pb8, rcc), rcc);
    let (button, led) = (a.pa0.into_pull_down_input(), Led::active_high(d.pd13));
    // It may erase the flash, so the bus comes later.
    let table = Table::open(board.flash);
    let (alarm, watchdog, seen) = (board.alarm, board.watchdog, Seen::default());
    let mut network = Network { can, alarm, watchdog, button, led, seen };
    network.start();
    let master = Master::new(TIMING);
    Commissioner { network, table, master, has_conflict: false }.commission()
}
