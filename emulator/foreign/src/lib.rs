//! Programs on CAN drivers of others, remotely controlled by a test through words in RAM, as by a debugger.

#![no_std]

pub mod command;

use core::sync::atomic::{AtomicU32, Ordering::SeqCst};

use command::*;

/// The words that the test finds by the name of their symbol.
// SAFETY: no other symbol has this name.
#[unsafe(no_mangle)]
static REMOTE_CONTROL: Words =
    Words { control: AtomicU32::new(0), data: [const { AtomicU32::new(0) }; WORDS] };

#[repr(C)]
struct Words {
    control: AtomicU32,
    data: [AtomicU32; WORDS],
}

/// The numbers of interrupts: transmit, FIFO 0, FIFO 1, status change and error.
pub static INTERRUPTS: [AtomicU32; 4] = [const { AtomicU32::new(0) }; 4];

/// Counts an interrupt.
pub fn count_interrupt(line: usize) {
    INTERRUPTS[line].fetch_add(1, SeqCst);
}

/// A frame as it lies in the words.
#[derive(Clone, Copy)]
pub struct Frame {
    /// The identifier, with [`EXTENDED`] and [`REMOTE`].
    pub id: u32,
    pub dlc: u8,
    pub data: [u8; 8],
}

impl Frame {
    fn from_words([id, dlc, low, high]: [u32; 4]) -> Self {
        let data = u64::from(low) | u64::from(high) << 32;
        Self { id, dlc: dlc as u8, data: data.to_le_bytes() }
    }

    fn into_words(self) -> [u32; 4] {
        let data = u64::from_le_bytes(self.data);
        [self.id, self.dlc.into(), data as u32, (data >> 32) as u32]
    }

    pub fn is_remote(&self) -> bool {
        self.id & REMOTE != 0
    }

    /// The data that the frame carries.
    pub fn payload(&self) -> &[u8] {
        let length = if self.is_remote() { 0 } else { usize::from(self.dlc.min(8)) };
        &self.data[..length]
    }
}

/// A CAN driver under remote control.
#[allow(async_fn_in_trait)]
pub trait Driver {
    fn configure(&mut self, bit_rate: u32, modes: u32);
    async fn enable(&mut self);
    fn set_filter(&mut self, bank: u8, fifo: u32, kind: u32, words: [u32; 4]);
    fn clear_filters(&mut self);
    /// The number of the mailbox, and the frame that had to make room.
    fn transmit(&mut self, frame: Frame) -> Option<(usize, Option<Frame>)>;
    /// A frame if there is one; the error is [`OVERRUN`] or [`BUS_ERROR`].
    fn receive(&mut self) -> Result<Option<Frame>, u32>;
    fn abort(&mut self, mailbox: u32) -> bool;
    fn is_idle(&mut self) -> bool;
    async fn sleep(&mut self);
    fn wake_up(&mut self);
    fn wake_up_automatically(&mut self, enabled: bool);
}

/// Carries out commands for ever; `pause` passes some time between two looks at the control word.
pub async fn serve(driver: &mut impl Driver, pause: impl AsyncFn()) -> ! {
    REMOTE_CONTROL.control.store(READY, SeqCst);
    loop {
        let number = REMOTE_CONTROL.control.load(SeqCst);
        if let Some(command) = Command::ALL.into_iter().find(|command| *command as u32 == number) {
            let words = core::array::from_fn(|i| REMOTE_CONTROL.data[i].load(SeqCst));
            let answer = execute(driver, command, words).await;
            for (word, value) in REMOTE_CONTROL.data.iter().zip(answer) {
                word.store(value, SeqCst);
            }
            REMOTE_CONTROL.control.store(READY, SeqCst);
        } else {
            pause().await;
        }
    }
}

async fn execute(driver: &mut impl Driver, command: Command, words: [u32; WORDS]) -> [u32; WORDS] {
    let [a, b, c, d, e, f, g] = words;
    let mut answer = [0; WORDS];
    match command {
        Command::Configure => driver.configure(a, b),
        Command::Enable => driver.enable().await,
        Command::Filter => driver.set_filter(a as u8, b, c, [d, e, f, g]),
        Command::ClearFilters => driver.clear_filters(),
        Command::Transmit => {
            if let Some((mailbox, replaced)) = driver.transmit(Frame::from_words([a, b, c, d])) {
                answer[0] = QUEUED;
                answer[1] = mailbox as u32;
                if let Some(frame) = replaced {
                    answer[0] = REPLACED;
                    answer[2..6].copy_from_slice(&frame.into_words());
                }
            }
        }
        Command::Receive => match driver.receive() {
            Ok(None) => answer[0] = EMPTY,
            Err(error) => answer[0] = error,
            Ok(Some(frame)) => {
                answer[0] = FRAME;
                answer[1..5].copy_from_slice(&frame.into_words());
            }
        },
        Command::Abort => answer[0] = driver.abort(a).into(),
        Command::IsIdle => answer[0] = driver.is_idle().into(),
        Command::Sleep => driver.sleep().await,
        Command::WakeUp => driver.wake_up(),
        Command::WakeUpAutomatically => driver.wake_up_automatically(a != 0),
        Command::Interrupts => {
            for (word, count) in answer.iter_mut().zip(&INTERRUPTS) {
                *word = count.load(SeqCst);
            }
        }
    }
    answer
}

/// Defines conversions between identifier words and the identifiers of a driver, and `set_filter`, with the driver's
/// types in scope. The filters of embassy began as those of `bxcan`.
#[macro_export]
macro_rules! identifiers_and_filters {
    ($filters:ty) => {
        fn standard(word: u32) -> StandardId {
            StandardId::new(word as u16 & 0x7FF).unwrap()
        }

        fn extended(word: u32) -> ExtendedId {
            ExtendedId::new(word & 0x1FFF_FFFF).unwrap()
        }

        fn id(word: u32) -> Id {
            if word & EXTENDED != 0 { extended(word).into() } else { standard(word).into() }
        }

        fn word(id: Id, is_remote: bool) -> u32 {
            let word = match id {
                Id::Standard(id) => u32::from(id.as_raw()),
                Id::Extended(id) => id.as_raw() | EXTENDED,
            };
            if is_remote { word | REMOTE } else { word }
        }

        fn set_filter(filters: &mut $filters, bank: u8, fifo: u32, kind: u32, words: [u32; 4]) {
            let [a, b, c, d] = words;
            let half = |word: u32| match word & REMOTE {
                0 => ListEntry16::data_frames_with_id(standard(word)),
                _ => ListEntry16::remote_frames_with_id(standard(word)),
            };
            let whole = |word: u32| match word & REMOTE {
                0 => ListEntry32::data_frames_with_id(id(word)),
                _ => ListEntry32::remote_frames_with_id(id(word)),
            };
            let fifo = if fifo == 0 { Fifo::Fifo0 } else { Fifo::Fifo1 };
            let masked = |id, mask| Mask16::frames_with_std_id(standard(id), standard(mask));
            match kind {
                LIST_16 => filters.enable_bank(bank, fifo, [half(a), half(b), half(c), half(d)]),
                LIST_32 => filters.enable_bank(bank, fifo, [whole(a), whole(b)]),
                MASK_16 => filters.enable_bank(bank, fifo, [masked(a, b), masked(c, d)]),
                _ if b == 0 => filters.enable_bank(bank, fifo, Mask32::accept_all()),
                _ if a & EXTENDED != 0 => {
                    let filter = Mask32::frames_with_ext_id(extended(a), extended(b));
                    filters.enable_bank(bank, fifo, filter)
                }
                _ => {
                    let filter = Mask32::frames_with_std_id(standard(a), standard(b));
                    filters.enable_bank(bank, fifo, filter)
                }
            };
        }
    };
}

/// 168 MHz from a crystal of 8 MHz.
#[cfg(feature = "embassy")]
pub fn embassy_clocks() -> embassy_stm32::Config {
    use embassy_stm32::{
        rcc::{
            AHBPrescaler, APBPrescaler, Hse, HseMode, Pll, PllMul, PllPDiv, PllPreDiv, PllSource,
            Sysclk,
        },
        time::Hertz,
    };

    let mut config = embassy_stm32::Config::default();
    config.rcc.hse = Some(Hse { freq: Hertz(8_000_000), mode: HseMode::Oscillator });
    config.rcc.pll_src = PllSource::HSE;
    config.rcc.pll = Some(Pll {
        prediv: PllPreDiv::DIV4,
        mul: PllMul::MUL168,
        divp: Some(PllPDiv::DIV2),
        divq: None,
        divr: None,
    });
    config.rcc.sys = Sysclk::PLL1_P;
    config.rcc.ahb_pre = AHBPrescaler::DIV1;
    config.rcc.apb1_pre = APBPrescaler::DIV4;
    config.rcc.apb2_pre = APBPrescaler::DIV2;
    config
}
