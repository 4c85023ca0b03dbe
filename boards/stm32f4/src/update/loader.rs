//! The loader: a node with the objects of program download, whose code lies in RAM.

use core::mem::{self, MaybeUninit};

use canopen_node::{
    Application, BitRate, Count, Device, Instant, Node,
    application::{Dictionary, Event},
    lss::StoreError,
    nmt,
    sdo::{self, Answer},
    settings::Log,
};
use cortex_m::{asm, peripheral::NVIC};
#[cfg(not(feature = "signed"))]
use program_update::Unsigned as Checked;
#[cfg(feature = "signed")]
use program_update::signature::{self, Digest, PublicKey, Sha256};
use program_update::{Action, Command, Expected, Updater, crc, header, start::Why};
#[cfg(feature = "signed")]
use program_update::{Area, Flash, Signed as Checked, header::HEADER_LEN};
use rtic_core::Mutex;
use stm32f4xx_hal::{pac::FLASH, rcc::RccExt};

pub use super::boot::{Stay, start_or_stay};
use super::{
    areas::Areas,
    objects::{code, object},
};
use crate::{
    board::{Board, Peripherals},
    can::{CanPins, Controller, Peripheral},
    chip::{CHIP, RUN},
    clock,
    crystal::Crystal,
    mailbox, reset,
    watchdog::{Task, Watchdog},
};

/// The words that wait for the flash.
const RING: usize = 1024;

/// The most segments of a block.
const LONGEST_BLOCK: u8 = 127;

/// The segments of a block at this bit rate, while the flash keeps up. None takes more than 85 ms: some clients wait only
/// 100 ms from its begin for the answer.
fn block_size(bit_rate: BitRate) -> u8 {
    (u32::from(bit_rate.kbit_per_s()) * 5 / 8).min(LONGEST_BLOCK.into()) as u8
}

/// The time for which an answer is held back while the flash is behind, and the indicators' step of 50 ms at most: some
/// clients wait for 100 ms.
const HOLD_MICROS: u32 = 30_000;

type State = Updater<Areas, Checked, RING>;

/// The place of the loader's state.
pub type Place = MaybeUninit<State>;

/// The node with its controller.
pub type Runner<C> = crate::runner::Runner<C, Loader>;

fn now() -> u32 {
    clock::now().as_micros()
}

/// The application of the loader.
pub struct Loader {
    updater: &'static mut State,
    /// The program has left its answer to the loader.
    owes_answer: bool,
    /// An SDO answer has been given that nobody may have acknowledged.
    is_answering: bool,
    /// The segments of a block while the flash keeps up.
    block_size: u8,
    /// The segments that the client may send before the next answer.
    granted: u8,
    /// Since when an answer is held back, since the flash is behind.
    held_since: Option<Instant>,
}

impl Dictionary for Loader {
    type Value = ();
    type SdoBuffer = [u8; 8];
    type Numbers = Count<0, 0, 0>;
}

impl Application for Loader {
    const PROGRAM_DOWNLOAD: bool = true;
    const MAY_OPERATE: bool = false;

    fn program(&mut self) -> Option<&mut dyn canopen_node::Program> {
        Some(self)
    }

    fn handle(&mut self, event: Event) {
        if let Event::BitRate(bit_rate) = event {
            self.block_size = block_size(bit_rate);
        }
    }
}

impl canopen_node::Program for Loader {
    fn read(&mut self, index: u16, sub_index: u8) -> u32 {
        self.updater.read(object(index, sub_index))
    }

    fn control(&mut self, value: u8, _: nmt::State) -> Result<Answer, sdo::Abort> {
        self.updater.write_control(value).map_err(code)?;
        Ok(Answer::Now)
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), sdo::Abort> {
        self.updater.write(offset, bytes).map_err(code)
    }

    fn end(&mut self, len: u32) -> Result<Answer, sdo::Abort> {
        self.granted = 1;
        self.updater.end(len).map_err(code)?;
        Ok(Answer::Later)
    }

    fn grant(&mut self) -> u8 {
        self.granted = if self.is_behind() { 1 } else { self.block_size };
        self.granted
    }

    fn granted(&mut self) -> u8 {
        self.granted
    }

    fn holds(&mut self, now: Instant) -> bool {
        let since = *self.held_since.get_or_insert(now);
        // The segments of a longer block have taken the time.
        let may_hold = self.granted == 1 && !since.plus_micros(HOLD_MICROS).has_come(now);
        let holds = may_hold && self.is_behind();
        if !holds {
            self.held_since = None;
        }
        holds
    }

    fn abort(&mut self) {
        self.granted = 1;
        self.updater.abort();
    }

    fn requested(&mut self) {
        self.updater.requested(now());
        asm::sev();
    }

    fn answering(&mut self) {
        self.is_answering = true;
    }
}

impl Loader {
    /// Whether little room is left for what waits for the flash.
    fn is_behind(&self) -> bool {
        self.updater.room() < RING * 4 / 2
    }
}

/// Whose programs the loader takes.
#[cfg(feature = "signed")]
pub struct Author {
    key: PublicKey,
    allows_downgrade: bool,
}

#[cfg(feature = "signed")]
impl Author {
    /// The owner of a key. `allows_downgrade`: also programs with a lower release than the installed one. A release does
    /// not build with a key of zeros, which is that of the template.
    pub const fn new(key: PublicKey, allows_downgrade: bool) -> Self {
        let (mut is_key, mut i) = (cfg!(debug_assertions), 0);
        while i < key.len() {
            is_key |= key[i] != 0;
            i += 1;
        }
        assert!(is_key, "src/key.rs has no key: `cargo update-file --key PEM` writes it");
        Self { key, allows_downgrade }
    }
}

/// What the idle task does.
pub struct Work {
    has_reported: bool,
    #[cfg(feature = "signed")]
    key: &'static PublicKey,
}

impl Board {
    /// As [`new`](Self::new), for the loader that stays. The program has compared the crystal.
    pub fn of_loader(
        chip: Peripherals,
        core: &cortex_m::Peripherals,
        crystal: Crystal,
        stay: &Stay,
    ) -> Self {
        Self::with_clocks(chip, core, crystal, stay.reset, RccExt::constrain)
    }

    /// Starts the node of the loader with what was in force, or the stored settings, or the defaults.
    pub fn start_loader<C: Peripheral>(
        mut self,
        mut device: Device,
        place: &'static mut Place,
        stay: Stay,
        can: C,
        pins: CanPins<C>,
        #[cfg(feature = "signed")] author: &'static Author,
    ) -> (Runner<C>, Work, Watchdog) {
        let Stay { why, .. } = stay;
        // SAFETY: nothing else uses the flash. The loader runs in RAM, and reads what the flash has, not what a cache has.
        let flash = unsafe { FLASH::steal() };
        flash.acr().modify(|_, w| w.icen().clear_bit().dcen().clear_bit());
        enable_flash_interrupt();
        #[cfg(feature = "signed")]
        let allows_downgrade = author.allows_downgrade;
        #[cfg(not(feature = "signed"))]
        let allows_downgrade = true;
        let expected = Expected {
            vendor_id: device.address.vendor_id,
            product_code: device.address.product_code,
            hardware: crc::of(device.hardware_version.as_bytes()),
            chip: header::text(CHIP.feature),
            controller: C::NUMBER,
            address: RUN.address,
            capacity: RUN.kb * 1024 - header::HEADER_LEN as u32,
            ram: 0x2000_0000..0x2000_0000 + CHIP.ram_kb * 1024,
            allows_downgrade,
        };
        let updater = place.write(Updater::new(Areas::new(now), Checked, expected, why, now()));
        if let Some(header) = updater.header() {
            device.address.revision_number = header.revision_number;
        }
        let settings = match mailbox::take_in_force() {
            Some(in_force) => {
                device.heartbeat_ms = in_force.heartbeat_ms;
                Some(in_force.settings)
            }
            None => Log::<_, 0>::peek(self.flash),
        };
        let owes_answer = why == Why::Stop;
        let loader = Loader {
            updater,
            owes_answer,
            is_answering: false,
            block_size: LONGEST_BLOCK,
            granted: 1,
            held_since: None,
        };
        let mut node = Node::with_application(device, settings, loader);
        if owes_answer {
            node.owe_control();
        }
        let bit_rate = node.bit_rate();
        node.application_mut().handle(Event::BitRate(bit_rate));
        let can = Controller::new(can, pins, &mut self.rcc);
        self.watchdog.feed();
        self.watchdog.call::<C>();
        let work = Work {
            has_reported: false,
            #[cfg(feature = "signed")]
            key: &author.key,
        };
        (Runner::new(node, can, self.alarm), work, self.watchdog)
    }
}

impl Work {
    /// Does the next step, then sleeps until there may be another: what makes one due signals an event. Between two locks
    /// the interrupts of the bus come.
    pub fn step<C: Peripheral>(&mut self, runner: &mut impl Mutex<T = Runner<C>>) {
        Task::STORE.answer();
        Task::IDLE.answer();
        let next = runner.lock(Self::next);
        if next.is_holding {
            runner.lock(|runner| runner.with(Node::resume));
        }
        if next.owes_answer {
            runner.lock(|runner| runner.answer(Ok(())));
        }
        if next.is_without_program != self.has_reported {
            self.has_reported = next.is_without_program;
            runner.lock(|runner| {
                runner.with(|node| match next.is_without_program {
                    true => _ = node.report(USER_SOFTWARE, 0, [0; 5]),
                    false => node.end_report(USER_SOFTWARE),
                });
            });
        }
        #[cfg(feature = "signed")]
        let action = next.action.and_then(|action| self.check(runner, action));
        #[cfg(not(feature = "signed"))]
        let action = next.action;
        if let Some(action) = action {
            runner.lock(|runner| carry_out(runner, action));
        }
        if !next.is_busy || Areas::is_busy() {
            asm::wfe();
        }
    }

    /// Checks a signature or a hash, if that is the action, while the bus goes on; returns what is left to do.
    #[cfg(feature = "signed")]
    fn check<C: Peripheral>(
        &mut self,
        runner: &mut impl Mutex<T = Runner<C>>,
        action: Action,
    ) -> Option<Action> {
        /// The bytes of the header that are copied under one lock.
        const PART: usize = 64;
        match action {
            Action::Verify => {
                let mut header = [0; HEADER_LEN];
                for (to, number) in header.chunks_exact_mut(PART).zip(0..) {
                    runner.lock(|runner| {
                        let bytes = runner.node().application().updater.header_bytes();
                        to.copy_from_slice(&bytes[number * PART..][..PART]);
                    });
                }
                let is_signed = signature::is_signed(&header, self.key);
                runner
                    .lock(|runner| runner.application(|loader| loader.updater.verified(is_signed)))
            }
            Action::Hash { words } => {
                let mut hash = Sha256::new();
                let mut areas = Areas::new(now);
                for word in 0..words {
                    let word = areas.read(Area::Run, HEADER_LEN as u32 + 4 * word);
                    hash.update(word.to_le_bytes());
                    Task::STORE.answer();
                    Task::IDLE.answer();
                }
                let hash = hash.finalize().into();
                runner.lock(|runner| runner.application(|loader| loader.updater.hashed(&hash)))
            }
            other => Some(other),
        }
    }

    /// Begins the next step; returns what follows.
    fn next<C: Peripheral>(runner: &mut Runner<C>) -> Next {
        runner.refuse_store(StoreError::MediumAccess);
        let (is_idle, state) = (runner.is_idle(), runner.node().nmt_state());
        runner.application(|loader| {
            if loader.is_answering && is_idle {
                loader.is_answering = false;
                loader.updater.answered(now());
            }
            let action = loader.updater.poll(now());
            Next {
                action,
                is_busy: action.is_some() || loader.updater.is_busy(),
                is_holding: loader.held_since.is_some(),
                is_without_program: loader.updater.is_without_program(),
                owes_answer: state == nmt::State::PreOperational
                    && mem::take(&mut loader.owes_answer),
            }
        })
    }
}

/// What follows a step.
struct Next {
    action: Option<Action>,
    /// The flash, or the work before it, goes on.
    is_busy: bool,
    is_holding: bool,
    is_without_program: bool,
    owes_answer: bool,
}

fn carry_out<C: Peripheral>(runner: &mut Runner<C>, action: Action) {
    match action {
        Action::Answer(outcome) => runner.answer(outcome.map_err(code)),
        Action::Reset => {
            mailbox::hand_over(runner.node(), Command::Start);
            reset::end_by_command();
        }
        Action::Verify | Action::Hash { .. } => {}
    }
}

/// Handles the interrupt of the flash: the end of an operation.
extern "C" fn handle_flash() {
    Areas::go_on();
    asm::sev();
}

/// Enables the interrupt of the flash, which the list of the chip's interrupts lacks for some chips. The vector table
/// is in RAM.
fn enable_flash_interrupt() {
    /// Its number (RM0090, table 62).
    const FLASH: usize = 4;
    // SAFETY: loader.x defines the table. The handler touches nothing but the flag of the interrupt.
    unsafe {
        (&raw mut __vector_table)
            .cast::<usize>()
            .add(16 + FLASH)
            .write_volatile(handle_flash as *const () as usize);
        (*NVIC::PTR).iser[0].write(1 << FLASH);
    }
}

// SAFETY: only its address is used.
unsafe extern "C" {
    /// The vector table of the loader.
    static mut __vector_table: u32;
}

/// The emergency error code without a program: software of the user.
const USER_SOFTWARE: u16 = 0x6200;
