//! The CAN driver of embassy-stm32 under remote control, beside a LED that blinks and a log.

#![no_std]
#![no_main]

use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_stm32::{
    bind_interrupts,
    can::{
        Can, ExtendedId, Fifo, Frame as CanFrame, Id, Mailbox, Rx0InterruptHandler,
        Rx1InterruptHandler, SceInterruptHandler, StandardId, TxInterruptHandler,
        enums::TryReadError,
        filter::{ListEntry16, ListEntry32, Mask16, Mask32, MasterFilters},
        frame::Header,
    },
    gpio::{Level, Output, Speed},
    interrupt::typelevel,
    peripherals::CAN1,
};
use embassy_time::{Duration, Ticker, Timer};
use foreign::{Driver, Frame, command::*, count_interrupt, data, words};
use panic_probe as _;

bind_interrupts!(struct Interrupts {
    CAN1_TX => TxInterruptHandler<CAN1>, Count<0>;
    CAN1_RX0 => Rx0InterruptHandler<CAN1>, Count<1>;
    CAN1_RX1 => Rx1InterruptHandler<CAN1>, Count<2>;
    CAN1_SCE => SceInterruptHandler<CAN1>, Count<3>;
});

struct Count<const LINE: usize>;

macro_rules! count {
    ($($interrupt:ident $line:literal),*) => {$(
        impl typelevel::Handler<typelevel::$interrupt> for Count<$line> {
            // SAFETY: may be called at any time.
            unsafe fn on_interrupt() {
                count_interrupt($line);
            }
        }
    )*};
}
count!(CAN1_TX 0, CAN1_RX0 1, CAN1_RX1 2, CAN1_SCE 3);

foreign::identifiers_and_filters!(MasterFilters<'_>);

struct Embassy<'d>(Can<'d>);

fn to_driver(frame: Frame) -> CanFrame {
    let header = Header::new(id(frame[0]), frame[1] as u8, frame[0] & REMOTE != 0);
    CanFrame::new(header, &data(frame)).unwrap()
}

fn from_driver(frame: &CanFrame) -> Frame {
    let header = frame.header();
    let mut data = [0; 8];
    data.copy_from_slice(frame.raw_data());
    words(word(*header.id(), header.rtr()), header.len(), data)
}

impl Driver for Embassy<'_> {
    fn configure(&mut self, bit_rate: u32, modes: u32) {
        self.0
            .modify_config()
            .set_bitrate(bit_rate)
            .set_loopback(modes & LOOPBACK != 0)
            .set_silent(modes & SILENT != 0)
            // embassy-stm32 0.6.0 writes this to NART, which means the opposite (RM0090, 32.9.2).
            .set_automatic_retransmit(modes & ONE_SHOT != 0);
    }

    async fn enable(&mut self) {
        self.0.enable().await;
    }

    fn set_filter(&mut self, bank: u8, fifo: u32, kind: u32, words: [u32; 4]) {
        set_filter(&mut self.0.modify_filters(), bank, fifo, kind, words);
    }

    fn clear_filters(&mut self) {
        self.0.modify_filters().clear();
    }

    fn transmit(&mut self, frame: Frame) -> Option<(usize, Option<Frame>)> {
        let status = self.0.try_write(&to_driver(frame)).ok()?;
        Some((status.mailbox() as usize, status.dequeued_frame().map(from_driver)))
    }

    fn receive(&mut self) -> Result<Option<Frame>, u32> {
        match self.0.try_read() {
            Ok(envelope) => Ok(Some(from_driver(&envelope.frame))),
            Err(TryReadError::Empty) => Ok(None),
            Err(TryReadError::BusError(_)) => Err(BUS_ERROR),
        }
    }

    fn abort(&mut self, mailbox: u32) -> bool {
        let mailboxes = [Mailbox::Mailbox0, Mailbox::Mailbox1, Mailbox::Mailbox2];
        self.0.abort(mailboxes[mailbox as usize])
    }

    fn is_idle(&mut self) -> bool {
        self.0.is_transmitter_idle()
    }

    async fn sleep(&mut self) {
        self.0.sleep().await;
    }

    fn wake_up(&mut self) {
        self.0.wakeup();
    }

    fn wake_up_automatically(&mut self, enabled: bool) {
        self.0.set_automatic_wakeup(enabled);
    }
}

#[embassy_executor::task]
async fn blink(mut led: Output<'static>) {
    let mut ticker = Ticker::every(Duration::from_millis(1));
    loop {
        ticker.next().await;
        led.toggle();
    }
}

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    let p = embassy_stm32::init(foreign::embassy_clocks());
    spawner.spawn(blink(Output::new(p.PC13, Level::Low, Speed::Low)).unwrap());
    let mut driver = Embassy(Can::new(p.CAN1, p.PA11, p.PA12, Interrupts));
    defmt::info!("embassy-stm32 is ready");
    foreign::serve(&mut driver, async || Timer::after_micros(20).await).await
}
