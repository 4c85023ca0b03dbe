//! The crate `bxcan` on CAN1 and CAN2: frames 100h to 1FFh pass from CAN1 to CAN2, and 200h to 2FFh the other way.

#![no_std]
#![no_main]

use core::cell::RefCell;

use bxcan::{Can, Fifo, Instance, Interrupts, StandardId, filter::Mask32};
use cortex_m::interrupt::Mutex;
use defmt_rtt as _;
use panic_probe as _;
use stm32f4xx_hal::{
    can::Can as HalCan,
    interrupt,
    pac::{CAN1, CAN2, Interrupt, NVIC, Peripherals},
    prelude::*,
    rcc::Config,
};

/// The first filter bank of CAN2.
const FIRST_OF_CAN2: u8 = 3;

type Sides = (Can<HalCan<CAN1>>, Can<HalCan<CAN2>>);

static SIDES: Mutex<RefCell<Option<Sides>>> = Mutex::new(RefCell::new(None));

/// Passes the frames in FIFO 0 on; one that the other side does not take is lost.
fn pass(from: &mut Can<impl Instance>, to: &mut Can<impl Instance>) {
    while let Ok(frame) = from.receive() {
        let _ = to.transmit(&frame);
    }
}

fn with_sides(act: impl FnOnce(&mut Sides)) {
    cortex_m::interrupt::free(|cs| SIDES.borrow(cs).borrow_mut().as_mut().map(act));
}

#[interrupt]
fn CAN1_RX0() {
    with_sides(|(can1, can2)| pass(can1, can2));
}

#[interrupt]
fn CAN2_RX0() {
    with_sides(|(can1, can2)| pass(can2, can1));
}

/// 14 quanta a bit on APB1 of 42 MHz, sample point at 85.7 %.
fn bit_timing(bit_rate: u32) -> u32 {
    0x001A_0000 | (3_000_000 / bit_rate - 1)
}

fn group(first: u16) -> Mask32 {
    let (first, mask) = (StandardId::new(first).unwrap(), StandardId::new(0x700).unwrap());
    Mask32::frames_with_std_id(first, mask)
}

#[cortex_m_rt::entry]
fn main() -> ! {
    let p = Peripherals::take().unwrap();
    let clocks = Config::hse(8.MHz()).sysclk(168.MHz()).pclk1(42.MHz()).pclk2(84.MHz());
    let mut rcc = p.RCC.freeze(clocks);
    let port_b = p.GPIOB.split(&mut rcc);

    let can1 = p.CAN1.can((port_b.pb9, port_b.pb8), &mut rcc);
    let can2 = p.CAN2.can((port_b.pb6, port_b.pb5), &mut rcc);
    let mut can1 = Can::builder(can1).set_bit_timing(bit_timing(500_000)).leave_disabled();
    let mut can2 = Can::builder(can2).set_bit_timing(bit_timing(250_000)).leave_disabled();

    let mut filters = can1.modify_filters();
    filters.set_split(FIRST_OF_CAN2).enable_bank(0, Fifo::Fifo0, group(0x100));
    filters.slave_filters().enable_bank(FIRST_OF_CAN2, Fifo::Fifo0, group(0x200));
    drop(filters);

    can1.enable_interrupts(Interrupts::FIFO0_MESSAGE_PENDING);
    can2.enable_interrupts(Interrupts::FIFO0_MESSAGE_PENDING);
    while can1.enable_non_blocking().is_err() {}
    while can2.enable_non_blocking().is_err() {}
    cortex_m::interrupt::free(|cs| SIDES.borrow(cs).replace(Some((can1, can2))));
    // SAFETY: the handlers take a critical section for what they share.
    unsafe {
        NVIC::unmask(Interrupt::CAN1_RX0);
        NVIC::unmask(Interrupt::CAN2_RX0);
    }
    defmt::info!("the gateway is ready");
    loop {
        cortex_m::asm::wfi();
    }
}
