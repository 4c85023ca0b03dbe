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
pub static COUNTS: [AtomicU32; 4] = [const { AtomicU32::new(0) }; 4];

/// Counts an interrupt.
pub fn count_interrupt(line: usize) {
    COUNTS[line].fetch_add(1, SeqCst);
}

/// A frame as it lies in the words: identifier with [`EXTENDED`] and [`REMOTE`], DLC, data.
pub type Frame = [u32; 4];

pub fn words(id: u32, dlc: u8, data: [u8; 8]) -> Frame {
    let data = u64::from_le_bytes(data);
    [id, dlc.into(), data as u32, (data >> 32) as u32]
}

/// The eight bytes of its data.
pub fn data([_, _, low, high]: Frame) -> [u8; 8] {
    (u64::from(low) | u64::from(high) << 32).to_le_bytes()
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
        let command = REMOTE_CONTROL.control.load(SeqCst);
        let words = core::array::from_fn(|i| REMOTE_CONTROL.data[i].load(SeqCst));
        if let Some(answer) = execute(driver, command, words).await {
            for (word, value) in REMOTE_CONTROL.data.iter().zip(answer) {
                word.store(value, SeqCst);
            }
            REMOTE_CONTROL.control.store(READY, SeqCst);
        } else {
            pause().await;
        }
    }
}

async fn execute(
    driver: &mut impl Driver,
    command: u32,
    words: [u32; WORDS],
) -> Option<[u32; WORDS]> {
    let [a, b, c, d, e, f, g] = words;
    let mut answer = [0; WORDS];
    match command {
        CONFIGURE => driver.configure(a, b),
        ENABLE => driver.enable().await,
        FILTER => driver.set_filter(a as u8, b, c, [d, e, f, g]),
        CLEAR_FILTERS => driver.clear_filters(),
        TRANSMIT => {
            if let Some((mailbox, replaced)) = driver.transmit([a, b, c, d]) {
                answer[0] = if replaced.is_some() { REPLACED } else { QUEUED };
                answer[1] = mailbox as u32;
                answer[2..6].copy_from_slice(&replaced.unwrap_or_default());
            }
        }
        RECEIVE => match driver.receive() {
            Ok(None) => answer[0] = EMPTY,
            Err(error) => answer[0] = error,
            Ok(Some(frame)) => {
                answer[0] = FRAME;
                answer[1..5].copy_from_slice(&frame);
            }
        },
        ABORT => answer[0] = driver.abort(a).into(),
        IS_IDLE => answer[0] = driver.is_idle().into(),
        SLEEP => driver.sleep().await,
        WAKE_UP => driver.wake_up(),
        WAKE_UP_AUTOMATICALLY => driver.wake_up_automatically(a != 0),
        INTERRUPTS => {
            for (word, count) in answer.iter_mut().zip(&COUNTS) {
                *word = count.load(SeqCst);
            }
        }
        _ => return None,
    }
    Some(answer)
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
