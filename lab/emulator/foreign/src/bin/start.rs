//! What programs on embassy-stm32 do at their start: clocks, RTC, random numbers, a serial line, cycle counter, CAN.

#![no_std]
#![no_main]

use cortex_m::peripheral::DWT;
use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_stm32::{
    bind_interrupts,
    can::{
        Can, Frame, Rx0InterruptHandler, Rx1InterruptHandler, SceInterruptHandler, StandardId,
        TxInterruptHandler,
    },
    exti::{self, ExtiInput},
    gpio::{Level, Output, Pull, Speed},
    interrupt::typelevel,
    mode::Blocking,
    peripherals::{CAN1, RNG},
    rcc::{LsConfig, PllQDiv},
    rng::{self, Rng},
    rtc::{Rtc, RtcConfig},
    usart::UartTx,
};
use embassy_time::Timer;
use panic_probe as _;

bind_interrupts!(struct Interrupts {
    CAN1_TX => TxInterruptHandler<CAN1>;
    CAN1_RX0 => Rx0InterruptHandler<CAN1>;
    CAN1_RX1 => Rx1InterruptHandler<CAN1>;
    CAN1_SCE => SceInterruptHandler<CAN1>;
    RNG => rng::InterruptHandler<RNG>;
    EXTI0 => exti::InterruptHandler<typelevel::EXTI0>;
});

#[embassy_executor::main]
async fn main(_spawner: Spawner) {
    let mut config = foreign::embassy_clocks();
    config.rcc.ls = LsConfig::default_lsi();
    if let Some(pll) = &mut config.rcc.pll {
        pll.divq = Some(PllQDiv::DIV7);
    }
    let p = embassy_stm32::init(config);
    let mut core = cortex_m::Peripherals::take().unwrap();
    core.DCB.enable_trace();
    core.DWT.enable_cycle_counter();

    let mut line: UartTx<'_, Blocking> =
        UartTx::new_blocking(p.USART2, p.PA2, Default::default()).unwrap();
    line.blocking_write(b"hello\r\n").unwrap();
    let (rtc, _) = Rtc::new(p.RTC, RtcConfig::default());
    let mut random = Rng::new(p.RNG, Interrupts);
    let mut bytes = [0; 8];
    random.async_fill_bytes(&mut bytes).await.unwrap();
    let _button = ExtiInput::new(p.PA0, p.EXTI0, Pull::Down, Interrupts);
    rtc.read_backup_register(0);

    let before = DWT::cycle_count();
    Timer::after_millis(1).await;
    defmt::info!("1 ms is {} cycles", DWT::cycle_count().wrapping_sub(before) / 1_000 * 1_000);

    let mut can = Can::new(p.CAN1, p.PA11, p.PA12, Interrupts);
    can.modify_config().set_bitrate(500_000);
    can.enable().await;
    let mut led = Output::new(p.PC13, Level::Low, Speed::Low);
    let frame = Frame::new_data(StandardId::new(0x123).unwrap(), &bytes).unwrap();
    loop {
        can.write(&frame).await;
        led.toggle();
        Timer::after_millis(1).await;
    }
}
