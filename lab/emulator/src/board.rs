//! A board: a microcontroller with firmware in its flash, a crystal, a supply switch and a debug probe.

mod log;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

pub use log::Logged;

use crate::{
    Time,
    can::{Clock, bxcan},
    chip::{Chip, ChipVariant, FLASH_BASE, Finding, Output, Part, Pin, Pwm, Request, ResetCause},
    engine::{Engine, Halt, Lockup, rsemu::Rsemu},
    image::Image,
};
use log::Log;

/// The time for which an internal reset pulls NRST low (RM0090 7.1.1).
const RESET_HOLD: Time = Time::from_us(20);
/// The longest time that a program runs before its surroundings are looked at again.
const STEP: Time = Time::from_us(50);
/// The time between two looks of the probe into the log. As a real one, it knows nothing of resets.
pub const LOG_POLL: Time = Time::from_ms(10);

/// The properties in which boards with the same part differ.
#[derive(Clone, Copy, Debug)]
pub struct Settings {
    /// The crystal at the HSE pins.
    pub crystal: Clock,
    /// The supply in mV at first: at most 3,600; 2,930 on an STM32F407 Discovery, behind its diode.
    pub supply_mv: u32,
    /// The chip's 96-bit unique id, as it lies in memory.
    pub unique_id: [u8; 12],
    /// The chip's deviations from the nominal chip.
    pub chip_variant: ChipVariant,
    /// The CAN controller whose transceiver is on the network's first bus: 1 for CAN1.
    pub controller: usize,
    /// The transceivers end a dominant level after this time (0.3 to 1.2 ms are sold), so that the least bit rate is 11
    /// bits in it. `None`: they have no such time-out.
    pub dominant_time_out: Option<Time>,
    /// The behaviour of the CAN controllers where the manual is ambiguous.
    pub can_variant: bxcan::CanVariant,
    /// Whether an access to a peripheral that is not modelled is no [misuse](Board::misuse). Registers of CAN, RCC,
    /// flash, power and GPIO that are not modelled always are.
    pub tolerates_unmodelled: bool,
}

impl Default for Settings {
    /// An exact 8 MHz crystal, 3.3 V, a unique id of zeros, a nominal chip, CAN1, the nominal CAN controllers, and
    /// no tolerance.
    fn default() -> Self {
        Self {
            crystal: Clock { hz: 8_000_000, ppm: 0 },
            supply_mv: 3_300,
            unique_id: [0; 12],
            chip_variant: ChipVariant::default(),
            controller: 1,
            dominant_time_out: None,
            can_variant: bxcan::CanVariant::default(),
            tolerates_unmodelled: false,
        }
    }
}

/// The reason why [`Board::run_until`] returned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stop {
    Deadline,
    /// The program wrote a CAN register: the bus should catch up before the program continues.
    CanWritten,
    /// The chip was reset; the program has not started again yet.
    Reset(ResetCause),
    PowerCut,
}

/// A microcontroller with its surroundings.
pub struct Board {
    chip: Arc<Mutex<Chip>>,
    engine: Box<dyn Engine>,
    log: Log,
    /// The number of intervals before the probe's latest look.
    looked: u64,
    image: Image,
    controller: usize,
    tolerates_unmodelled: bool,
    powered: bool,
    /// The supply is on, but too low for the chip to leave its reset.
    browned_out: bool,
    dark: Time,
    power_ups: u64,
    resets: Vec<(Time, ResetCause)>,
}

impl Board {
    /// A board with `image` in its flash, switched on at time zero.
    ///
    /// # Panics
    /// A segment of the image lies outside of the part's flash, or the part has no such controller.
    pub fn new(part: Part, image: &Image, settings: Settings) -> Self {
        let Settings { crystal, supply_mv, unique_id, chip_variant, .. } = settings;
        let Settings { controller, can_variant, tolerates_unmodelled, .. } = settings;
        let mut chip = Chip::with_variant(part, crystal, unique_id, chip_variant);
        chip.set_supply(supply_mv);
        for can in chip.cans_mut() {
            can.set_variant(can_variant);
            can.controller().set_dominant_time_out(settings.dominant_time_out);
        }
        assert!((1..=part.cans()).contains(&controller), "{} has no CAN{controller}", part.name());
        for (address, bytes) in image.segments() {
            let offset = address.wrapping_sub(FLASH_BASE);
            let fits = u64::from(offset) + bytes.len() as u64 <= part.flash_size().into();
            assert!(fits, "segment at {address:#010x} is not in the flash of {}", part.name());
            chip.flash_mut().load(offset, bytes);
        }
        let chip = Arc::new(Mutex::new(chip));
        let engine = Box::new(Rsemu::new(Arc::clone(&chip)));
        let mut board = Self {
            chip,
            engine,
            log: Log::new(image),
            looked: 0,
            image: image.clone(),
            controller,
            tolerates_unmodelled,
            powered: false,
            browned_out: false,
            dark: Time::ZERO,
            power_ups: 0,
            resets: Vec::new(),
        };
        board.power_on();
        board
    }

    /// The microcontroller's peripherals. The board cannot run while the guard is held.
    pub fn chip(&self) -> MutexGuard<'_, Chip> {
        // A report on a test that has failed may still read it.
        self.chip.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The CAN controller whose transceiver is on the network's first bus: 1 for CAN1.
    pub fn controller(&self) -> usize {
        self.controller
    }

    pub fn now(&self) -> Time {
        if self.powered { self.engine.now() } else { self.dark }
    }

    pub fn is_powered(&self) -> bool {
        self.powered
    }

    /// The time of the program's next action unless an interrupt comes first; [`Time::MAX`] without power.
    pub fn wake_time(&self) -> Time {
        if !self.powered {
            return Time::MAX;
        }
        self.engine.wake_time().min(self.next_event())
    }

    /// The time at which the chip acts by itself.
    fn next_event(&self) -> Time {
        self.chip().next_event()
    }

    /// Runs the program until `until`, overshooting by less than an instruction, or to an earlier stop.
    /// [`now`](Self::now) is the time reached.
    pub fn run_until(&mut self, until: Time) -> Stop {
        while self.now() < until {
            if !self.powered {
                self.dark = until;
                break;
            }
            let event = self.next_event();
            let awake = self.engine.wake_time().max(self.now());
            self.look();
            let step = Time::from_ps(awake.as_ps().saturating_add(STEP.as_ps()));
            let halt = self.engine.run(until.min(event).min(step));
            let now = self.engine.now();
            if halt == Halt::ResetRequested {
                self.reset(ResetCause::Software);
                return Stop::Reset(ResetCause::Software);
            }
            if now >= event {
                let request = self.chip().advance(now);
                match request {
                    Some(Request::Reset(cause)) => {
                        self.reset(cause);
                        return Stop::Reset(cause);
                    }
                    Some(Request::PowerCut) => {
                        self.power_off();
                        return Stop::PowerCut;
                    }
                    None => {}
                }
            }
            if halt == Halt::CanWritten {
                return Stop::CanWritten;
            }
        }
        Stop::Deadline
    }

    /// Advances to `until`, earlier than [`wake_time`](Self::wake_time), if the CPU sleeps; returns whether it does.
    pub(crate) fn sleep(&mut self, until: Time) -> bool {
        let sleeps = self.powered && self.engine.sleep(until);
        if sleeps {
            self.look();
        }
        sleeps
    }

    /// Lets the probe fetch the log, if a look was due since the last one. While the core slept there was nothing new.
    fn look(&mut self) {
        let looks = self.engine.now().as_ps() / LOG_POLL.as_ps();
        if looks != self.looked {
            self.looked = looks;
            self.log.poll(self.engine.as_mut());
        }
    }

    /// Resets the microcontroller now; RAM keeps its content.
    pub fn reset(&mut self, cause: ResetCause) {
        if !self.powered {
            return;
        }
        self.look();
        self.start(cause, self.engine.now());
    }

    fn start(&mut self, cause: ResetCause, now: Time) {
        self.log.restart(self.engine.as_mut());
        self.chip().reset(cause, now);
        let variant = self.chip().variant();
        let hold = match cause {
            ResetCause::PowerOn | ResetCause::BrownOut => variant.start_up.reset(),
            _ => RESET_HOLD,
        };
        if variant.boot_loader {
            self.engine.start_from_loader(now, hold);
        } else {
            self.engine.reset(now, hold);
        }
        self.resets.push((now, cause));
    }

    /// Switches the supply off now. An unfinished flash operation leaves undefined bits.
    pub fn power_off(&mut self) {
        self.browned_out = false;
        if !self.powered {
            return;
        }
        self.look();
        self.dark = self.engine.now();
        self.powered = false;
        self.chip().reset(ResetCause::PowerOn, self.dark);
    }

    /// Switches the supply on now. RAM has random content, flash keeps its content. A supply below the brown-out level
    /// leaves the chip in reset.
    pub fn power_on(&mut self) {
        if self.powered || self.browned_out {
            return;
        }
        self.power_ups += 1;
        if self.power_ups == 1 || !self.chip().variant().ram_remembers {
            self.engine.scramble_ram(self.power_ups);
        }
        let is_supplied = !self.chip().supply_is_too_low(true);
        (self.powered, self.browned_out) = (is_supplied, !is_supplied);
        if is_supplied {
            self.start(ResetCause::PowerOn, self.dark);
        }
    }

    /// Sets the supply in mV, at most 3,600. Below the brown-out level of the option bytes the chip is
    /// held in reset, as if the power was off, but RAM keeps its content.
    pub fn set_supply(&mut self, mv: u32) {
        self.chip().set_supply(mv);
        if self.powered && self.chip().supply_is_too_low(false) {
            self.power_off();
            self.browned_out = true;
        } else if self.browned_out && !self.chip().supply_is_too_low(true) {
            self.browned_out = false;
            self.powered = true;
            self.start(ResetCause::BrownOut, self.dark);
        } else if self.powered {
            let now = self.now();
            self.chip().check_supply(now);
        }
    }

    /// Halts the core as a debugger does. Timers, watchdog and CAN go on, but for what DBGMCU freezes.
    pub fn halt(&mut self) {
        self.engine.set_halted(true);
        let now = self.now();
        self.chip().halt(now);
    }

    /// Lets a core go on that was [halted](Self::halt).
    pub fn resume(&mut self) {
        self.engine.set_halted(false);
        let now = self.now();
        self.chip().resume(now);
    }

    pub fn stop_crystal(&mut self) {
        let now = self.now();
        self.chip().stop_crystal(now);
    }

    /// Lets the crystal oscillate again, once the program has switched it on.
    pub fn start_crystal(&mut self) {
        let now = self.now();
        self.chip().start_crystal(now);
    }

    /// The output state of a pin.
    ///
    /// # Panics
    /// The part has no such pin.
    pub fn output(&self, pin: Pin) -> Output {
        self.chip().gpio().output(pin)
    }

    /// The waveform of a timer at a pin, if there is one.
    pub fn pwm(&self, pin: Pin) -> Option<Pwm> {
        let now = self.now();
        self.chip().pwm(pin, now)
    }

    pub fn flash(&self) -> Vec<u8> {
        self.chip().flash().bytes().to_vec()
    }

    /// Replaces the flash from byte `offset` on, program included.
    pub fn set_flash(&mut self, offset: u32, bytes: &[u8]) {
        self.chip().flash_mut().load(offset, bytes);
        self.engine.sync_flash();
    }

    /// All accesses that a real chip would not tolerate, or that the emulator does not model.
    pub fn findings(&self) -> Vec<Finding> {
        self.chip().findings().to_vec()
    }

    /// The first of them that this board does not tolerate.
    pub fn misuse(&self) -> Option<Finding> {
        let chip = self.chip();
        let is_misuse =
            |finding: &&Finding| !(self.tolerates_unmodelled && chip.is_tolerable(finding));
        chip.findings().iter().find(is_misuse).cloned()
    }

    /// The program that was in the flash at first.
    pub fn image(&self) -> &Image {
        &self.image
    }

    /// What the program has logged, across all resets.
    pub fn logged(&self) -> &[Logged] {
        self.log.logged()
    }

    /// Every reset so far, the first power-on included.
    pub fn resets(&self) -> &[(Time, ResetCause)] {
        &self.resets
    }

    /// Core clock cycles so far, and the share of them in which the core was not asleep.
    pub fn cycles(&self) -> (u64, u64) {
        (self.engine.cycles(), self.engine.busy_cycles())
    }

    /// The number of times so far that the core has waited for a bank of the flash that was busy.
    pub fn flash_stalls(&self) -> u64 {
        self.engine.stalls()
    }

    /// The fault registers, if the core is locked up.
    pub fn lockup(&self) -> Option<Lockup> {
        self.engine.lockup()
    }

    pub fn pc(&self) -> u32 {
        self.engine.pc()
    }

    pub fn sp(&self) -> u32 {
        self.engine.sp()
    }

    /// Copies out of RAM or flash; outside of them, returns false and copies nothing.
    pub fn read_memory(&self, address: u32, bytes: &mut [u8]) -> bool {
        self.engine.read_memory(address, bytes)
    }

    /// Copies into RAM, as a debugger does; outside of it, returns false and copies nothing.
    pub fn write_memory(&mut self, address: u32, bytes: &[u8]) -> bool {
        self.engine.write_memory(address, bytes)
    }
}
