//! The FDCAN driver of embassy-stm32 on an STM32G4 under remote control, beside a LED that blinks and a log.

#![no_std]
#![no_main]

use core::task::Poll;

use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_futures::poll_once;
use embassy_stm32::{
    Config, Peri, bind_interrupts,
    can::{
        Can, CanConfigurator, Frame as CanFrame, IT0InterruptHandler, IT1InterruptHandler,
        OperatingMode, Properties,
        config::{GlobalFilter, NonMatchingFilter::Reject},
        filter::{Action, ExtendedFilter, FilterType, StandardFilter},
        frame::Header,
    },
    gpio::{Level, Output, Speed},
    interrupt::typelevel,
    peripherals::{FDCAN1, PA11, PA12},
    rcc::{Hse, HseMode, Pll, PllMul, PllPreDiv, PllQDiv, PllRDiv, PllSource, Sysclk, mux},
    time::Hertz,
};
use embassy_time::{Duration, Ticker, Timer};
use embedded_can::{ExtendedId, Id, StandardId};
use foreign::{Driver, Frame, command::*, count_interrupt, data, words};
use panic_probe as _;

bind_interrupts!(struct Interrupts {
    FDCAN1_IT0 => IT0InterruptHandler<FDCAN1>, Count<0>;
    FDCAN1_IT1 => IT1InterruptHandler<FDCAN1>, Count<1>;
});

struct Count<const LINE: usize>;

impl typelevel::Handler<typelevel::FDCAN1_IT0> for Count<0> {
    // SAFETY: may be called at any time.
    unsafe fn on_interrupt() {
        count_interrupt(0);
    }
}

impl typelevel::Handler<typelevel::FDCAN1_IT1> for Count<1> {
    // SAFETY: may be called at any time.
    unsafe fn on_interrupt() {
        count_interrupt(1);
    }
}

fn standard(word: u32) -> StandardId {
    StandardId::new(word as u16 & 0x7FF).unwrap()
}

fn extended(word: u32) -> ExtendedId {
    ExtendedId::new(word & 0x1FFF_FFFF).unwrap()
}

fn to_driver(frame: Frame) -> CanFrame {
    let id: Id = if frame[0] & EXTENDED != 0 {
        extended(frame[0]).into()
    } else {
        standard(frame[0]).into()
    };
    let length = frame[1] as u8;
    let header = Header::new(id, length, frame[0] & REMOTE != 0);
    CanFrame::new(header, &data(frame)[..length.into()]).unwrap()
}

fn from_driver(frame: &CanFrame) -> Frame {
    let header = frame.header();
    let word = match header.id() {
        Id::Standard(id) => u32::from(id.as_raw()),
        Id::Extended(id) => id.as_raw() | EXTENDED,
    };
    let remote = if header.rtr() { REMOTE } else { 0 };
    let mut data = [0; 8];
    data[..frame.data().len()].copy_from_slice(frame.data());
    words(word | remote, header.len(), data)
}

struct Fdcan {
    can: Peri<'static, FDCAN1>,
    receive: Peri<'static, PA11>,
    transmit: Peri<'static, PA12>,
    configured: Option<(CanConfigurator<'static>, OperatingMode)>,
    running: Option<Can<'static>>,
}

impl Fdcan {
    fn properties(&self) -> &Properties {
        match (&self.configured, &self.running) {
            (Some((configurator, _)), _) => configurator.properties(),
            (_, Some(can)) => can.properties(),
            _ => panic!("not configured"),
        }
    }
}

impl Driver for Fdcan {
    /// The driver changes its rate only by being made anew.
    fn configure(&mut self, bit_rate: u32, modes: u32) {
        self.running = None;
        self.configured = None;
        // SAFETY: the driver that had them is dropped.
        let (can, receive, transmit) = unsafe {
            (
                self.can.clone_unchecked(),
                self.receive.clone_unchecked(),
                self.transmit.clone_unchecked(),
            )
        };
        let mut configurator = CanConfigurator::new(can, receive, transmit, Interrupts);
        configurator.set_bitrate(bit_rate);
        let global = GlobalFilter::default()
            .set_handle_standard_frames(Reject)
            .set_handle_extended_frames(Reject);
        let config = configurator.config().set_global_filter(global);
        configurator.set_config(config.set_automatic_retransmit(modes & ONE_SHOT == 0));
        let mode = match modes & (LOOPBACK | SILENT) {
            LOOPBACK => OperatingMode::ExternalLoopbackMode,
            SILENT => OperatingMode::BusMonitoringMode,
            0 => OperatingMode::NormalOperationMode,
            _ => OperatingMode::InternalLoopbackMode,
        };
        self.configured = Some((configurator, mode));
    }

    async fn enable(&mut self) {
        if let Some((configurator, mode)) = self.configured.take() {
            self.running = Some(configurator.start(mode));
        }
    }

    /// The bank stands for four filters of each list.
    fn set_filter(&mut self, bank: u8, fifo: u32, kind: u32, words: [u32; 4]) {
        let action = if fifo == 0 { Action::StoreInFifo0 } else { Action::StoreInFifo1 };
        let [a, b, c, d] = words;
        let first = 4 * bank;
        let set = |place: u8, id: u32, mask: u32| {
            let slot = first + place;
            if id & EXTENDED != 0 || mask == 0 {
                let filter = FilterType::BitMask { filter: id & 0x1FFF_FFFF, mask };
                self.properties()
                    .set_extended_filter(slot.into(), ExtendedFilter { filter, action });
            }
            if id & EXTENDED == 0 || mask == 0 {
                let filter = FilterType::BitMask { filter: id as u16, mask: mask as u16 };
                self.properties()
                    .set_standard_filter(slot.into(), StandardFilter { filter, action });
            }
        };
        let list = |words: &[u32]| {
            (0..).zip(words).for_each(|(place, &id)| set(place, id, 0x1FFF_FFFF));
        };
        match kind {
            LIST_16 => list(&words),
            LIST_32 => list(&[a, b]),
            MASK_16 => {
                set(0, a, b);
                set(1, c, d);
            }
            _ => set(0, a, b),
        }
    }

    fn clear_filters(&mut self) {
        let properties = self.properties();
        properties.set_standard_filters(&[StandardFilter::disable(); 28]);
        properties.set_extended_filters(&[ExtendedFilter::disable(); 8]);
    }

    /// The driver does not tell which buffer it took.
    fn transmit(&mut self, frame: Frame) -> Option<(usize, Option<Frame>)> {
        let can = self.running.as_mut()?;
        match poll_once(can.write(&to_driver(frame))) {
            Poll::Ready(replaced) => Some((0, replaced.as_ref().map(from_driver))),
            Poll::Pending => None,
        }
    }

    fn receive(&mut self) -> Result<Option<Frame>, u32> {
        let Some(can) = &mut self.running else { return Ok(None) };
        match poll_once(can.read()) {
            Poll::Ready(Ok(envelope)) => Ok(Some(from_driver(&envelope.frame))),
            Poll::Ready(Err(_)) => Err(BUS_ERROR),
            Poll::Pending => Ok(None),
        }
    }

    /// The driver offers none.
    fn abort(&mut self, _: u32) -> bool {
        false
    }

    /// Nothing shows it: `flush` of embassy-stm32 0.6.0 looks at other buffers than it is told.
    fn is_idle(&mut self) -> bool {
        false
    }

    async fn sleep(&mut self) {}

    fn wake_up(&mut self) {}

    fn wake_up_automatically(&mut self, _: bool) {}
}

#[embassy_executor::task]
async fn blink(mut led: Output<'static>) {
    let mut ticker = Ticker::every(Duration::from_millis(1));
    loop {
        ticker.next().await;
        led.toggle();
    }
}

/// 80 MHz from a crystal of 8 MHz, for FDCAN too.
fn clocks() -> Config {
    let mut config = Config::default();
    config.rcc.hse = Some(Hse { freq: Hertz(8_000_000), mode: HseMode::Oscillator });
    config.rcc.hsi48 = None;
    config.rcc.pll = Some(Pll {
        source: PllSource::HSE,
        prediv: PllPreDiv::DIV2,
        mul: PllMul::MUL80,
        divp: None,
        divq: Some(PllQDiv::DIV4),
        divr: Some(PllRDiv::DIV4),
    });
    config.rcc.sys = Sysclk::PLL1_R;
    config.rcc.mux.fdcansel = mux::Fdcansel::PLL1_Q;
    config
}

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    let p = embassy_stm32::init(clocks());
    spawner.spawn(blink(Output::new(p.PC13, Level::Low, Speed::Low)).unwrap());
    let mut driver =
        Fdcan { can: p.FDCAN1, receive: p.PA11, transmit: p.PA12, configured: None, running: None };
    defmt::info!("embassy-stm32 is ready");
    foreign::serve(&mut driver, async || Timer::after_micros(20).await).await
}
