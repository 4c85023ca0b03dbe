//! The crate `bxcan` on stm32f4xx-hal under remote control, beside a LED that blinks and a log.

#![no_std]
#![no_main]

use core::cell::RefCell;

use bxcan::{
    Can, Data, ExtendedId, Fifo, Frame as CanFrame, Id, Interrupts, Mailbox, StandardId,
    filter::{ListEntry16, ListEntry32, Mask16, Mask32, MasterFilters},
};
use cortex_m::{interrupt::Mutex, peripheral::syst::SystClkSource};
use defmt_rtt as _;
use foreign::{Driver, Frame, command::*, count_interrupt, data, words};
use panic_probe as _;
use stm32f4xx_hal::{
    can::Can as HalCan,
    gpio::{Output, Pin},
    interrupt,
    pac::{CAN1, Interrupt, NVIC, Peripherals, TIM3},
    prelude::*,
    rcc::Config,
    timer::{CounterUs, Event},
};

type Hal = HalCan<CAN1>;

foreign::identifiers_and_filters!(MasterFilters<'_, Hal>);

/// The interrupts of the controller; their handlers mask them, and [`Driver::receive`] takes the masks off.
const LINES: [Interrupt; 4] =
    [Interrupt::CAN1_TX, Interrupt::CAN1_RX0, Interrupt::CAN1_RX1, Interrupt::CAN1_SCE];

fn on_interrupt(line: usize) {
    NVIC::mask(LINES[line]);
    count_interrupt(line);
}

#[interrupt]
fn CAN1_TX() {
    on_interrupt(0);
}

#[interrupt]
fn CAN1_RX0() {
    on_interrupt(1);
}

#[interrupt]
fn CAN1_RX1() {
    on_interrupt(2);
}

#[interrupt]
fn CAN1_SCE() {
    on_interrupt(3);
}

struct Bxcan(Can<Hal>);

impl Bxcan {
    fn listen(&mut self) {
        self.0.clear_tx_interrupt();
        self.0.clear_sleep_interrupt();
        self.0.clear_wakeup_interrupt();
        for line in LINES {
            NVIC::unpend(line);
            // SAFETY: nothing relies on the masks: the handlers only count.
            unsafe { NVIC::unmask(line) };
        }
    }
}

fn to_driver(frame: Frame) -> CanFrame {
    let (id, dlc) = (id(frame[0]), frame[1] as u8);
    if frame[0] & REMOTE != 0 {
        return CanFrame::new_remote(id, dlc);
    }
    CanFrame::new_data(id, Data::new(&data(frame)[..dlc.into()]).unwrap())
}

fn from_driver(frame: &CanFrame) -> Frame {
    let mut data = [0; 8];
    if let Some(payload) = frame.data() {
        data[..payload.len()].copy_from_slice(payload);
    }
    words(word(frame.id(), frame.is_remote_frame()), frame.dlc(), data)
}

impl Driver for Bxcan {
    fn configure(&mut self, bit_rate: u32, modes: u32) {
        // 14 quanta a bit on APB1 of 42 MHz, sample point at 85.7 %.
        let prescaler = 3_000_000 / bit_rate;
        self.0
            .modify_config()
            .set_bit_timing(0x001A_0000 | (prescaler - 1))
            .set_loopback(modes & LOOPBACK != 0)
            .set_silent(modes & SILENT != 0)
            .set_automatic_retransmit(modes & ONE_SHOT == 0)
            .leave_disabled();
        self.0.enable_interrupts(
            Interrupts::TRANSMIT_MAILBOX_EMPTY
                | Interrupts::FIFO0_MESSAGE_PENDING
                | Interrupts::FIFO1_MESSAGE_PENDING
                | Interrupts::WAKEUP
                | Interrupts::SLEEP,
        );
        self.listen();
    }

    async fn enable(&mut self) {
        while self.0.enable_non_blocking().is_err() {}
    }

    fn set_filter(&mut self, bank: u8, fifo: u32, kind: u32, words: [u32; 4]) {
        set_filter(&mut self.0.modify_filters(), bank, fifo, kind, words);
    }

    fn clear_filters(&mut self) {
        self.0.modify_filters().clear();
    }

    fn transmit(&mut self, frame: Frame) -> Option<(usize, Option<Frame>)> {
        let status = self.0.transmit(&to_driver(frame)).ok()?;
        Some((status.mailbox() as usize, status.dequeued_frame().map(from_driver)))
    }

    fn receive(&mut self) -> Result<Option<Frame>, u32> {
        let received = match self.0.receive() {
            Ok(frame) => Ok(Some(from_driver(&frame))),
            Err(nb::Error::WouldBlock) => Ok(None),
            Err(nb::Error::Other(_)) => Err(OVERRUN),
        };
        self.listen();
        received
    }

    fn abort(&mut self, mailbox: u32) -> bool {
        let mailboxes = [Mailbox::Mailbox0, Mailbox::Mailbox1, Mailbox::Mailbox2];
        self.0.abort(mailboxes[mailbox as usize])
    }

    fn is_idle(&mut self) -> bool {
        self.0.is_transmitter_idle()
    }

    async fn sleep(&mut self) {
        self.0.sleep();
    }

    fn wake_up(&mut self) {
        self.0.wakeup();
    }

    fn wake_up_automatically(&mut self, enabled: bool) {
        self.0.set_automatic_wakeup(enabled);
    }
}

type Blinker = (CounterUs<TIM3>, Pin<'D', 12, Output>);

static BLINKER: Mutex<RefCell<Option<Blinker>>> = Mutex::new(RefCell::new(None));

#[interrupt]
fn TIM3() {
    cortex_m::interrupt::free(|cs| {
        if let Some((timer, led)) = BLINKER.borrow(cs).borrow_mut().as_mut() {
            timer.clear_all_flags();
            led.toggle();
        }
    });
}

/// Ends the sleep of the main loop.
#[cortex_m_rt::exception]
fn SysTick() {}

#[cortex_m_rt::entry]
fn main() -> ! {
    let p = Peripherals::take().unwrap();
    let clocks = Config::hse(8.MHz()).sysclk(168.MHz()).pclk1(42.MHz()).pclk2(84.MHz());
    let mut rcc = p.RCC.freeze(clocks);
    let (port_b, port_d) = (p.GPIOB.split(&mut rcc), p.GPIOD.split(&mut rcc));

    let mut timer = p.TIM3.counter_us(&mut rcc);
    timer.start(1.millis()).unwrap();
    timer.listen(Event::Update);
    let led = port_d.pd12.into_push_pull_output();
    cortex_m::interrupt::free(|cs| BLINKER.borrow(cs).replace(Some((timer, led))));
    // SAFETY: its handler takes a critical section for what it shares.
    unsafe { NVIC::unmask(Interrupt::TIM3) };

    let mut ticks = cortex_m::Peripherals::take().unwrap().SYST;
    ticks.set_clock_source(SystClkSource::Core);
    ticks.set_reload(20 * 168 - 1);
    ticks.clear_current();
    ticks.enable_interrupt();
    ticks.enable_counter();

    let can = p.CAN1.can((port_b.pb9, port_b.pb8), &mut rcc);
    let mut driver = Bxcan(Can::builder(can).leave_disabled());
    defmt::info!("bxcan is ready");
    embassy_futures::block_on(foreign::serve(&mut driver, async || cortex_m::asm::wfi()))
}
