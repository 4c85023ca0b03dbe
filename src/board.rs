//! The board after a reset: watchdog, clocks, pins and identity.

use lss_slave::{NodeId, Settings, lss::Address};
use stm32f4xx_hal::{
    gpio::{ErasedPin, Input},
    pac::{DBGMCU, IWDG, Peripherals, RCC},
    rcc::{Config, Rcc, RccExt},
    time::Hertz,
    watchdog::IndependentWatchdog,
};

use crate::{
    can_pins::CanPins,
    clock::Alarm,
    controller::{self, Can},
    crystal,
    flash::SettingsFlash,
    led::Led,
    pins::{Pins, Ports},
    product::{chip::UNIQUE_ID, device},
    supply::Supply,
};

/// Sectors 1 and 2 of the flash, which `memory.x` keeps free of code.
pub const SETTINGS: *mut u32 = 0x0800_4000 as *mut u32;

/// The watchdog timeout in ms at 32 kHz; its oscillator runs at 17 to 47 kHz. The longest pause of a healthy board is
/// the erase of a 16 KB sector: 800 ms by bytes, 500 ms by words. A new board erases two; should the watchdog end that,
/// the next start goes on.
const WATCHDOG_MS: u32 = 2_000;

/// The number of register reads that take at least 100 ms at the initial 16 MHz, at five cycles each.
const READS_IN_100_MS: u32 = 320_000;

#[cfg(feature = "io")]
pub use crate::io_board::IoBoard;
/// The I/O of the example `io`.
#[cfg(not(feature = "io"))]
pub type IoBoard = ();

/// The parts of the board that the tasks need.
pub struct Board {
    pub rcc: Rcc,
    pub alarm: Alarm,
    pub can: Can,
    pub can_pins: CanPins,
    pub indicators: (Led, Led),
    /// The settings of a device that has stored none.
    pub defaults: Settings,
    pub settings_flash: SettingsFlash,
    pub watchdog: Watchdog,
    pub io: IoBoard,
}

impl Board {
    /// Sets the board up. The watchdog starts first, so that a hang in the set-up ends in a reset.
    pub fn new(chip: Peripherals) -> Self {
        log_reset_cause(&chip.RCC);
        let watchdog = Watchdog::start(chip.IWDG, chip.DBGMCU);
        let supply = Supply::wait(chip.PWR);
        crystal::start(&chip.RCC);
        let mut clocks = Config::hse(Hertz::from_raw(device::CRYSTAL_HZ))
            .sysclk(Hertz::from_raw(device::SYSCLK_HZ))
            .pclk1(Hertz::from_raw(device::APB1_HZ));
        if device::CRYSTAL_IS_EXTERNAL_CLOCK {
            clocks = clocks.bypass_hse_oscillator();
        }
        // Waits for the PLL, 0.3 ms at most while the crystal runs; if the crystal stops, an interrupt ends the wait
        // too.
        let mut rcc = chip.RCC.freeze(clocks);
        crystal::check(&rcc);
        let alarm = Alarm::new(chip.TIM2, &mut rcc);
        // Before the pins are assigned, so that they do not glitch.
        controller::enable(&mut rcc);
        let ports = Ports {
            a: chip.GPIOA,
            b: chip.GPIOB,
            c: chip.GPIOC,
            d: chip.GPIOD,
            e: chip.GPIOE,
            f: chip.GPIOF,
            g: chip.GPIOG,
            h: chip.GPIOH,
            #[cfg(not(any(
                feature = "stm32f412",
                feature = "stm32f413",
                feature = "stm32f423",
                feature = "stm32f446"
            )))]
            i: chip.GPIOI,
        };
        let pins = Pins::new(ports, &mut rcc);
        let settings_flash = SettingsFlash::new(chip.FLASH, supply);
        Self {
            #[cfg(feature = "io")]
            io: IoBoard::new(pins.io, chip.ADC1, chip.TIM5, &mut rcc),
            #[cfg(not(feature = "io"))]
            io: (),
            rcc,
            alarm,
            #[cfg(not(any(feature = "can2", feature = "can3")))]
            can: chip.CAN1,
            #[cfg(feature = "can2")]
            can: chip.CAN2,
            #[cfg(feature = "can3")]
            can: chip.CAN3,
            can_pins: pins.can,
            indicators: pins.indicators,
            defaults: defaults(&pins.node_id_switches),
            settings_flash,
            watchdog,
        }
    }
}

/// The defaults of the product, with the node-ID of the switches if they give one.
fn defaults(switches: &[ErasedPin<Input>]) -> Settings {
    if switches.is_empty() {
        return device::DEFAULTS;
    }
    // Longer than a pull-up needs for the wires to the switches.
    cortex_m::asm::delay(device::SYSCLK_HZ / 10_000);
    let value = switches.iter().rev().fold(0, |bits, switch| bits << 1 | u8::from(switch.is_low()));
    device::DEFAULTS.with_node_id(NodeId::new(value).or(device::DEFAULTS.node_id))
}

/// Waits at least 100 ms for `it_is_there`, with the core at 16 MHz; returns false on a timeout.
pub fn comes_in_100_ms(it_is_there: impl Fn() -> bool) -> bool {
    (0..READS_IN_100_MS).any(|_| it_is_there())
}

/// The serial number, derived from the chip's unique id.
pub fn serial_number() -> u32 {
    const ID: *const [u8; 12] = UNIQUE_ID as *const _;
    // SAFETY: read-only memory of every STM32F4.
    Address::serial_number_of(&unsafe { ID.read() })
}

fn log_reset_cause(rcc: &RCC) {
    let cause = rcc.csr().read();
    if cause.wdgrstf().bit_is_set() {
        defmt::warn!("reset by the watchdog: a task did not run in time");
    } else if crystal::has_failed() {
        defmt::error!("reset because the crystal stopped");
    } else if cause.sftrstf().bit_is_set() {
        defmt::info!("reset by the firmware");
    } else {
        defmt::info!("power-on, or reset by the pin");
    }
    rcc.csr().modify(|_, w| w.rmvf().set_bit());
}

/// The watchdog, and what a debugger needs of a board that runs.
pub struct Watchdog {
    watchdog: IndependentWatchdog,
    debug: DBGMCU,
}

impl Watchdog {
    /// Starts it; it stops while a debugger halts the core.
    fn start(watchdog: IWDG, debug: DBGMCU) -> Self {
        let mut watchdog = IndependentWatchdog::new(watchdog);
        watchdog.start(fugit::MillisDurationU32::from_ticks(WATCHDOG_MS));
        watchdog.stop_on_debug(&debug, true);
        let mut it = Self { watchdog, debug };
        it.feed();
        it
    }

    /// Feeds it. Also keeps RTT and the debug port on while the core sleeps, which a debugger switches off as it leaves.
    pub fn feed(&mut self) {
        self.watchdog.feed();
        self.debug.cr().modify(|_, w| w.dbg_sleep().set_bit());
    }
}
