//! Tests that take the drivers through their unsafe code, over a chip in plain memory. What a real one makes of it is
//! tested with the release image.

extern crate std;

pub mod peripheral;
pub mod start;

use core::sync::atomic::Ordering::Relaxed;
use std::panic::catch_unwind;

use canopen_node::{
    BitRate, Frame, Instant, NodeId, Receives,
    indicator::BusState,
    runner::{BusError, Controller as _, Mode, Received, Sample},
    settings::{Found, Log},
};
use embedded_storage::nor_flash::{NorFlash, ReadNorFlash};
use firmware::{
    application::{Application, Node},
    device::{self, DEVICE},
};
use stm32f4xx_hal::{
    gpio::Pin,
    memory,
    pac::{CAN1, FLASH, FLASH_STATUS, GPIOA, PWR, RCC, TIM2, set},
    rcc::Rcc,
};

use crate::{
    can::{CanPins, Controller},
    clock::{self, Alarm},
    crystal::{self, Crystal},
    flash::{FlashError, SettingsFlash},
    supply::Supply,
};

/// CAN_TSR: three empty mailboxes.
const ALL_EMPTY: u32 = 0b111 << 26;

fn settings_flash() -> SettingsFlash {
    // As after a reset.
    set(FLASH.cr(), 1 << 31);
    SettingsFlash::new(FLASH, Supply::wait(PWR))
}

#[test]
fn words_are_written_where_they_are_read() {
    let _chip = memory::take();
    let mut flash = settings_flash();
    let end = flash.capacity() as u32;
    for offset in [0, 4, 16 * 1024 - 8, 16 * 1024, end - 8] {
        flash.write(offset, &[1, 2, 3, 4, 5, 6, 7, 8]).unwrap();
    }
    let mut bytes = [0; 12];
    flash.read(0, &mut bytes).unwrap();
    assert_eq!(bytes, [1, 2, 3, 4, 1, 2, 3, 4, 5, 6, 7, 8]);
    flash.read(end - 12, &mut bytes).unwrap();
    assert_eq!(bytes, [0xFF, 0xFF, 0xFF, 0xFF, 1, 2, 3, 4, 5, 6, 7, 8]);
    assert!(FLASH.cr().read().lock().bit_is_set());
}

#[test]
fn words_beyond_the_sectors_are_refused() {
    let _chip = memory::take();
    let mut flash = settings_flash();
    let end = flash.capacity() as u32;
    assert!(matches!(flash.read(end, &mut [0; 4]), Err(FlashError::Range(_))));
    assert!(matches!(flash.write(end - 4, &[0; 8]), Err(FlashError::Range(_))));
    assert!(matches!(flash.erase(0, end + 16 * 1024), Err(FlashError::Range(_))));
    assert!(matches!(flash.read(2, &mut [0; 4]), Err(FlashError::Range(_))));
}

#[test]
fn only_the_erased_sector_is_blank() {
    let _chip = memory::take();
    let mut flash = settings_flash();
    flash.write(0, &[0; 4]).unwrap();
    flash.write(16 * 1024, &[0; 4]).unwrap();
    flash.erase(16 * 1024, 32 * 1024).unwrap();
    let mut word = [1; 4];
    flash.read(0, &mut word).unwrap();
    assert_eq!(word, [0; 4]);
    flash.read(16 * 1024, &mut word).unwrap();
    assert_eq!(word, [0xFF; 4]);
}

#[test]
fn errors_of_the_flash_are_reported() {
    const PROGRAMMING_PARALLELISM: u32 = 1 << 6;
    let _chip = memory::take();
    let mut flash = settings_flash();
    FLASH_STATUS.store(PROGRAMMING_PARALLELISM, Relaxed);
    assert!(matches!(flash.write(0, &[0; 4]), Err(FlashError::Status)));
    assert!(matches!(flash.erase(0, 16 * 1024), Err(FlashError::Status)));
}

#[test]
fn bytes_are_written_at_a_low_supply() {
    const LOW: u32 = 1 << 2;
    let _chip = memory::take();
    let mut flash = settings_flash();
    set(PWR.csr(), LOW);
    let end = flash.capacity() as u32;
    flash.write(end - 8, &[1, 2, 3, 4, 5, 6, 7, 8]).unwrap();
    let mut bytes = [0; 8];
    flash.read(end - 8, &mut bytes).unwrap();
    assert_eq!(bytes, [1, 2, 3, 4, 5, 6, 7, 8]);
}

#[test]
fn settings_outlast_other_data_in_the_flash_and_restarts() {
    let _chip = memory::take();
    let settings = |node_id| device::DEFAULTS.with_node_id(NodeId::new(node_id));
    settings_flash().write(0, &[0; 64]).unwrap();
    let (mut log, found) = Log::<_, 0>::open(settings_flash());
    assert_eq!((found, log.settings()), (Found::OtherData, None));
    for node_id in [5, 6, 7] {
        log.store(settings(node_id)).unwrap();
        let (restarted, found) = Log::<_, 0>::open(settings_flash());
        assert_eq!((found, restarted.settings()), (Found::Complete, Some(settings(node_id))));
        log = restarted;
    }
}

/// The frames of a node, and those of others before its bit rate is proven.
fn receives(all: bool) -> Receives {
    let node = Node::with_application(DEVICE.with_serial_number(1), None, Application::new());
    Receives { all, ..node.receives() }
}

/// A controller that is in initialisation mode, as its driver waits for it, with empty mailboxes.
fn controller() -> Controller<CAN1> {
    const INITIALISATION: u32 = 1 << 0;
    set(CAN1.msr(), INITIALISATION);
    set(CAN1.tsr(), ALL_EMPTY);
    let pins = CanPins::new(Pin::<'B', 9>::new(), Pin::<'B', 8>::new(), &mut Rcc);
    Controller::new(CAN1, pins, &mut Rcc)
}

fn frame(cob_id: u16) -> Frame {
    Frame::new(cob_id, &[1, 2, 3, 4, 5]).unwrap()
}

/// A frame in the receive FIFO.
fn deliver(cob_id: u16, length_code: u32) {
    set(CAN1.rfr(0), 1);
    set(CAN1.rx(0).rir(), u32::from(cob_id) << 21);
    set(CAN1.rx(0).rdtr(), length_code);
    set(CAN1.rx(0).rdlr(), 0x0403_0201);
    set(CAN1.rx(0).rdhr(), 5);
}

#[test]
fn each_filter_bank_gets_the_identifiers_of_its_list() {
    let _chip = memory::take();
    let mut can = controller();
    let first_bank = || CAN1.fb(0).fr1().read().bits() & 0xFFFF;
    can.set_receives(&receives(false));
    assert_eq!((CAN1.fm1r().read().bits(), CAN1.fa1r().read().bits()), (1, 1), "a list");
    assert_eq!(first_bank(), u32::from(canopen_node::lss::REQUEST_COB_ID) << 5);
    assert!(can.start(Mode::TakePart, BitRate::Kbit125, &receives(true)));
    assert_eq!((CAN1.fm1r().read().bits(), CAN1.fa1r().read().bits()), (0, 1), "a mask");
    assert_eq!(first_bank(), 0);
}

#[test]
fn the_transmit_pin_belongs_to_the_controller_unless_it_listens() {
    let _chip = memory::take();
    let mode = || {
        // SAFETY: the registers of port B, the next after those of port A.
        let port = unsafe { &*GPIOA::ptr().byte_add(0x400) };
        port.moder().read().bits() >> 18
    };
    let mut can = controller();
    assert_eq!(mode(), 0b01);
    for _ in 0..2 {
        // It is at rest while the controller is reset: `plain_chip::rcc`.
        assert!(can.start(Mode::TakePart, BitRate::Kbit125, &receives(true)));
        assert_eq!(mode(), 0b10);
    }
    assert!(can.start(Mode::Listen, BitRate::Kbit250, &receives(true)));
    assert_eq!(mode(), 0b01);
}

#[test]
fn a_received_frame_has_its_identifier_and_data() {
    let _chip = memory::take();
    let mut can = controller();
    assert!(can.receive().is_none());
    deliver(0x123, 5);
    assert!(matches!(can.receive(), Some(Received::Frame(received)) if received == frame(0x123)));
    deliver(0x123, 9);
    assert!(matches!(can.receive(), Some(Received::Other)));
}

#[test]
fn frames_go_to_a_mailbox_or_wait_for_one() {
    let _chip = memory::take();
    let mailbox = |at| (CAN1.tx(at).tir().read().stid().bits(), CAN1.tx(at).tdlr().read().bits());
    let mut can = controller();
    assert!(can.send(&frame(0x181)));
    assert_eq!(mailbox(0), (0x181, 0x0403_0201));
    assert!(can.is_idle());
    set(CAN1.tsr(), 0);
    assert!(!can.send(&frame(0x182)));
    assert_eq!(mailbox(0).0, 0x181);
    assert!(!can.is_idle());
    // The second one is for any frame but another 181h.
    set(CAN1.tsr(), 0b110 << 26);
    assert!(!can.send(&frame(0x181)));
    assert_eq!([mailbox(1).0, mailbox(2).0], [0, 0]);
    assert!(can.send(&frame(0x183)));
    assert_eq!([mailbox(1).0, mailbox(2).0], [0x183, 0]);
    // The last one is for a frame ahead of both.
    set(CAN1.tsr(), 0b100 << 26);
    for behind in [0x181, 0x182, 0x183, 0x184] {
        assert!(!can.send(&frame(behind)), "{behind:#x}");
    }
    assert_eq!(mailbox(2).0, 0);
    assert!(can.send(&frame(0x180)));
    assert_eq!(mailbox(2).0, 0x180);
}

#[test]
fn only_flags_that_were_seen_are_cleared_and_mailboxes_aborted() {
    const ONE_SENT: u32 = 0b11 << 8;
    let _chip = memory::take();
    let mut can = controller();
    set(CAN1.tsr(), ALL_EMPTY | ONE_SENT);
    assert!(can.take_sent());
    assert_eq!(CAN1.tsr().read().bits(), 1 << 8);
    assert!(!can.take_sent());
    set(CAN1.tx(1).tir(), 0x7E4 << 21);
    can.drop_frames(|cob_id| cob_id != 0x7E4);
    assert_eq!(CAN1.tsr().read().bits(), 1 << 7 | 1 << 23);
    can.drop_frames(|_| true);
    assert_eq!(CAN1.tsr().read().bits(), 1 << 7 | 1 << 15 | 1 << 23);
}

#[test]
fn errors_of_the_bus_are_reported_and_counted() {
    const FORM: u32 = 2 << 4;
    const BUS_OFF: u32 = 1 << 2;
    let _chip = memory::take();
    let mut can = controller();
    assert!(can.start(Mode::TakePart, BitRate::Kbit125, &receives(true)));
    set(CAN1.esr(), 130 << 24 | 7 << 16 | FORM | BUS_OFF);
    assert_eq!(can.error_counters(), (7, 130));
    assert_eq!(can.bus_state(), BusState::BusOff);
    assert_eq!(can.take_error(), Some(BusError::Form));
    assert!(CAN1.ier().read().lecie().bit_is_clear());
    // The register holds 7 now, as software sets it.
    assert_eq!(can.take_error(), None);
}

#[test]
fn a_sample_shows_the_level_of_the_bus_and_whether_the_controller_sends() {
    const RX: u32 = 1 << 11;
    const TXM: u32 = 1 << 8;
    let _chip = memory::take();
    let mut can = controller();
    for (register, is_recessive, is_transmitting) in
        [(0, false, false), (RX, true, false), (RX | TXM, true, true), (TXM, false, true)]
    {
        set(CAN1.msr(), register);
        assert_eq!(can.sample(), Some(Sample { is_recessive, is_transmitting }));
    }
    can.report_errors();
    assert!(CAN1.ier().read().lecie().bit_is_set());
}

#[test]
fn the_alarm_comes_at_the_count_of_the_timer() {
    let _chip = memory::take();
    let mut alarm = Alarm::new(TIM2, &mut Rcc);
    set(TIM2.cnt(), 1_234);
    assert_eq!(clock::now().as_micros(), 1_234);
    alarm.set(Instant::from_micros(5_000));
    assert_eq!(TIM2.ccr1().read().bits(), 5_000);
}

#[test]
fn a_crystal_that_did_not_fail_leaves_no_note() {
    let _chip = memory::take();
    assert!(!crystal::has_failed());
}

/// RCC_PLLCFGR for 160 MHz from a crystal of 8 MHz.
const PLL: u32 = 1 << 22 | 160 << 6 | 4;

/// Checks a system clock from this source with these settings of the PLL.
fn check_clock(source: u32, pll: u32) {
    let _chip = memory::take();
    set(RCC.cfgr(), source << 2);
    set(RCC.pllcfgr(), pll);
    crystal::check(Crystal::new(device::CRYSTAL_HZ, false), &RCC);
}

#[test]
fn the_clock_that_the_pll_makes_from_the_crystal_is_accepted() {
    check_clock(0b10, PLL);
    check_clock(0b10, 1 << 22 | 1 << 16 | 320 << 6 | 4);
}

#[test]
fn any_other_clock_ends_in_a_reset() {
    const HSI: u32 = 0b00;
    const HSE: u32 = 0b01;
    const ON_PLL: u32 = 0b10;
    let others =
        [(HSI, PLL), (HSE, PLL), (ON_PLL, PLL & !(1 << 22)), (ON_PLL, PLL + 1), (ON_PLL, 0)];
    for (source, pll) in others {
        assert!(catch_unwind(|| check_clock(source, pll)).is_err(), "{source} {pll:08X}");
    }
}
