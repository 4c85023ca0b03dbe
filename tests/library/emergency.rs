//! Emergency messages (CiA 301, 7.2.7): the frames and times for each fault, and the error register 1001h.

use canopen_node::{BitRate, BitRateSetting, BusEvent, Service, emergency::Fault};
use testkit::{
    flash::Operation,
    frames::{Frames, SILENCE},
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
};

use crate::process_data::set;

const BUS_OFF_RECOVERED: &str = "0C0: 40 81 11 00 00 00 00 00";
const OVERRUN: &str = "0C0: 10 81 11 00 00 00 00 00";
const SETTINGS_LOST: &str = "0C0: 10 63 01 00 00 00 00 00";
const ERROR_PASSIVE: &str = "0C0: 20 81 11 00 00 00 00 00";
const NO_ERROR: &str = "0C0: 00 00 00 00 00 00 00 00";

/// Reports a fault to the node; returns the frames that it sends at once.
fn report(board: &mut NodeRig, fault: Fault) -> Frames {
    board.node.handle_fault(fault);
    board.pass_us(0)
}

#[test]
fn a_fault_that_is_over_is_8140_or_8110_and_then_no_error() {
    for (fault, message) in
        [(BusEvent::BusOffRecovered, BUS_OFF_RECOVERED), (BusEvent::Overrun, OVERRUN)]
    {
        let mut board = NodeRig::with_node_id(0x40);
        assert_eq!(board.see(fault), [message, NO_ERROR]);
        assert_eq!(board.number(0x1001, 0), 0);
        assert_eq!(board.pass_ms(10_000), SILENCE, "once");
        assert_eq!(board.see(fault), [message, NO_ERROR], "each time");
    }
}

#[test]
fn lost_settings_are_6310_and_an_error_until_something_is_stored() {
    let mut board = NodeRig::with_node_id(0x40);
    assert_eq!(report(&mut board, Fault::SettingsLost), [SETTINGS_LOST]);
    assert_eq!(board.sdo("40 01 10 00"), ["5C0: 4F 01 10 00 01 00 00 00"]);
    assert_eq!(board.pass_ms(10_000), SILENCE);
    board.lss("04 01");
    assert_eq!(board.lss("17"), ["17 00", NO_ERROR]);
    assert_eq!(board.sdo("40 01 10 00"), ["5C0: 4F 01 10 00 00 00 00 00"]);
    assert_eq!(board.lss("17"), ["17 00"], "no error is reported once");
}

#[test]
fn a_store_by_sdo_ends_lost_settings_unless_it_fails() {
    let mut board = NodeRig::with_node_id(0x40);
    report(&mut board, Fault::SettingsLost);
    board.flash.fail(Operation::Write);
    assert_eq!(board.sdo("23 10 10 01 73 61 76 65"), ["5C0: 80 10 10 01 00 00 06 06"]);
    assert_eq!(board.number(0x1001, 0), 1);
    board.flash.repair();
    board.power_cycle();
    report(&mut board, Fault::SettingsLost);
    let answers = board.sdo("23 10 10 01 73 61 76 65");
    assert_eq!(answers, ["5C0: 60 10 10 01 00 00 00 00", NO_ERROR]);
    assert_eq!(board.number(0x1001, 0), 0);
}

#[test]
fn while_settings_are_lost_the_end_of_another_fault_sends_no_0000() {
    let mut board = NodeRig::with_node_id(0x40);
    report(&mut board, Fault::SettingsLost);
    assert_eq!(board.see(BusEvent::Overrun), [OVERRUN]);
    assert_eq!(board.number(0x1001, 0), 1);
    assert_eq!(board.see(BusEvent::BusOffRecovered), [BUS_OFF_RECOVERED]);
    board.lss("04 01");
    assert_eq!(board.lss("17"), ["17 00", NO_ERROR]);
}

#[test]
fn without_an_acknowledge_one_emergency_waits_for_the_bus_however_many_faults() {
    let mut board = NodeRig::with_node_id(0x40);
    board.is_acknowledged = false;
    assert_eq!(board.see(BusEvent::BusOffRecovered), [BUS_OFF_RECOVERED]);
    for _ in 0..20 {
        assert_eq!(board.see(BusEvent::BusOffRecovered), SILENCE);
        assert_eq!(report(&mut board, Fault::ErrorPassive), SILENCE);
    }
    board.is_acknowledged = true;
    for other in [Service::Lss, Service::BootUp, Service::Sdo, Service::Heartbeat, Service::Tpdo] {
        assert_eq!(board.acknowledge(other), SILENCE, "{other:?} is another frame's");
    }
    assert_eq!(board.acknowledge(Service::Emergency), [ERROR_PASSIVE, BUS_OFF_RECOVERED]);
}

#[test]
fn settings_lost_and_stored_without_a_node_id_are_reported_and_ended() {
    let mut board = NodeRig::unconfigured();
    report(&mut board, Fault::SettingsLost);
    board.configure("11 40");
    assert_eq!(board.lss("17"), ["17 00"]);
    assert_eq!(board.lss("04 00"), ["740: 00", SETTINGS_LOST, NO_ERROR]);
}

#[test]
fn an_emergency_waits_for_the_end_of_a_switch_delay() {
    let mut board = NodeRig::with_heartbeat(0x40, 1_000);
    board.configure("13 00 02, 15 0A 00");
    assert_eq!(board.see(BusEvent::BusOffRecovered), SILENCE);
    assert_eq!(board.pass_us(19_999), SILENCE);
    assert_eq!(board.pass_us(1), [BUS_OFF_RECOVERED, NO_ERROR, "740: 7F"]);
}

#[test]
fn a_message_that_a_switch_has_dropped_is_sent_again_at_any_rate() {
    for rate in ["13 00 00", "13 00 02"] {
        let mut board = NodeRig::with_node_id(0x40);
        board.configure(rate);
        board.is_acknowledged = false;
        assert_eq!(report(&mut board, Fault::SettingsLost), [SETTINGS_LOST]);
        board.report(BusEvent::Overrun);
        assert_eq!(board.lss("15 0A 00"), SILENCE);
        board.is_acknowledged = true;
        assert_eq!(board.pass_ms(20), [SETTINGS_LOST, "0C0: 10 81 11 00 00 00 00 00"], "{rate}");
        assert_eq!(board.number(0x1003, 0), 2);
    }
}

#[test]
fn a_message_that_left_within_a_switch_is_not_sent_again() {
    let mut board = NodeRig::with_node_id(0x40);
    board.configure("13 00 00");
    board.is_acknowledged = false;
    assert_eq!(report(&mut board, Fault::SettingsLost), [SETTINGS_LOST]);
    board.lss("15 0A 00");
    assert_eq!(board.acknowledge(Service::Emergency), SILENCE, "it was on the bus");
    board.is_acknowledged = true;
    assert_eq!(board.pass_ms(20), SILENCE);
}

#[test]
fn a_heartbeat_that_a_switch_has_dropped_is_sent_at_once_at_any_rate() {
    for rate in ["13 00 00", "13 00 02"] {
        let mut board = NodeRig::with_heartbeat(0x40, 100);
        board.configure(rate);
        board.is_acknowledged = false;
        assert_eq!(board.pass_ms(100), ["740: 7F"]);
        assert_eq!(board.lss("15 00 00"), ["740: 7F"], "{rate}");
    }
}

#[test]
fn a_message_that_reset_communication_has_dropped_follows_the_boot_up() {
    let mut board = NodeRig::with_node_id(0x40);
    board.is_acknowledged = false;
    assert_eq!(report(&mut board, Fault::SettingsLost), [SETTINGS_LOST]);
    assert_eq!(board.nmt("82 40"), ["740: 00"]);
    board.is_acknowledged = true;
    for other in [Service::Lss, Service::Sdo, Service::Emergency, Service::Heartbeat, Service::Tpdo]
    {
        assert_eq!(board.acknowledge(other), SILENCE, "{other:?} is not the boot-up");
    }
    assert_eq!(board.acknowledge(Service::BootUp), [SETTINGS_LOST]);
    assert_eq!(board.number(0x1003, 0), 1);
}

#[test]
fn an_emergency_is_sent_before_a_heartbeat_due_at_the_same_time() {
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    board.report(BusEvent::Overrun);
    assert_eq!(board.be_late_ms(100), [OVERRUN, NO_ERROR, "740: 7F"]);
}

/// Sets the controller's error counters; returns the frames that the node sends at once.
fn count(board: &mut NodeRig, transmit: u8, receive: u8) -> Frames {
    board.report(BusEvent::ErrorCounters { transmit, receive });
    board.pass_us(0)
}

#[test]
fn error_passive_is_8120_and_its_end_is_no_error() {
    for transmit in [128, 255] {
        let mut board = NodeRig::with_node_id(0x40);
        assert_eq!(count(&mut board, 127, 127), SILENCE, "error active");
        assert_eq!(count(&mut board, transmit, 0), [ERROR_PASSIVE]);
        assert_eq!(board.number(0x1001, 0), 0x11);
        assert_eq!(count(&mut board, transmit, 127), SILENCE, "once");
        assert_eq!(count(&mut board, 127, 96), SILENCE, "the warning level");
        assert_eq!(count(&mut board, 127, 95), [NO_ERROR]);
        assert_eq!(board.number(0x1001, 0), 0);
        assert_eq!(count(&mut board, 0, 0), SILENCE, "no error is reported once");
    }
}

#[test]
fn a_receiver_of_alternate_errors_and_frames_reports_error_passive_once() {
    let mut board = NodeRig::with_node_id(0x40);
    assert_eq!(count(&mut board, 0, 135), SILENCE);
    assert_eq!(count(&mut board, 0, 127), [ERROR_PASSIVE]);
    for _ in 0..1_000 {
        assert_eq!(count(&mut board, 0, 128), SILENCE);
        assert_eq!(count(&mut board, 0, 119), SILENCE);
    }
    assert_eq!(board.number(0x1003, 0), 1);
    assert_eq!(count(&mut board, 0, 95), [NO_ERROR]);
}

#[test]
fn emergencies_wait_while_the_bus_carries_only_errors() {
    let mut board = NodeRig::with_heartbeat(0x40, 1_000);
    for receive in [128, 135, 255] {
        assert_eq!(count(&mut board, 0, receive), SILENCE);
        assert_eq!(board.see(BusEvent::Overrun), SILENCE);
        assert_eq!(board.pass_ms(1_000), ["740: 7F"]);
    }
    assert_eq!(count(&mut board, 0, 119), [ERROR_PASSIVE, "0C0: 10 81 11 00 00 00 00 00"]);
    assert_eq!(count(&mut board, 0, 95), [NO_ERROR]);
}

#[test]
fn error_passive_that_lasts_goes_with_the_messages_of_other_faults() {
    let mut board = NodeRig::with_node_id(0x40);
    count(&mut board, 128, 0);
    assert_eq!(board.see(BusEvent::Overrun), ["0C0: 10 81 11 00 00 00 00 00"]);
    assert_eq!(report(&mut board, Fault::SettingsLost), ["0C0: 10 63 11 00 00 00 00 00"]);
    assert_eq!(count(&mut board, 0, 0), SILENCE, "the settings are still lost");
    assert_eq!(board.number(0x1001, 0), 0x01);
}

#[test]
fn a_node_that_only_listens_is_not_error_passive() {
    let automatic = defaults(0x40).with_bit_rate(BitRateSetting::Automatic);
    let mut board = NodeRig::of(device(ADDRESS).with_defaults(automatic));
    assert!(board.node.is_listening());
    assert_eq!(count(&mut board, 0, 200), SILENCE);
    board.see(BusEvent::Received);
    assert_eq!(board.pass_us(0), SILENCE);
    assert_eq!(board.number(0x1003, 0), 0);
}

#[test]
fn the_end_of_a_rescue_while_another_error_lasts_leaves_no_bytes_behind() {
    let mut board = NodeRig::with_node_id(0x40);
    report(&mut board, Fault::SettingsLost);
    report(
        &mut board,
        Fault::AwayFromHomeRate { in_use: BitRate::Kbit500, home: BitRate::Kbit125 },
    );
    assert_eq!(board.configure("15 00 00"), SILENCE);
    assert_eq!(board.number(0x1001, 0), 1, "the settings are still lost");
    assert_eq!(board.lss("17"), ["17 00", NO_ERROR]);
}

#[test]
fn the_error_history_has_the_messages_that_have_left_in_their_order() {
    let mut board = NodeRig::with_node_id(0x40);
    set(&mut board, 0x1015, 0, 100, 2);
    board.report(BusEvent::Overrun);
    count(&mut board, 128, 0);
    board.report(BusEvent::Overrun);
    let history = |board: &mut NodeRig| {
        (1..=board.number(0x1003, 0) as u8).map(|at| board.number(0x1003, at)).collect::<Vec<_>>()
    };
    assert_eq!(history(&mut board), [0x8120]);
    board.pass_ms(10);
    assert_eq!(history(&mut board), [0x8110, 0x8120]);
    board.is_acknowledged = false;
    board.pass_ms(10);
    assert_eq!(board.see(BusEvent::Overrun).0.len(), 1);
    assert_eq!(history(&mut board), [0x8110, 0x8120], "it waits for the bus");
    board.acknowledge(Service::Emergency);
    assert_eq!(history(&mut board), [0x8110, 0x8110, 0x8120]);
}

#[test]
fn reset_communication_keeps_the_error_history_and_adds_nothing_to_it() {
    let mut board = NodeRig::with_node_id(0x40);
    report(&mut board, Fault::SettingsLost);
    count(&mut board, 128, 0);
    assert_eq!(board.nmt("82 00"), ["740: 00"]);
    let errors = [1, 2].map(|sub_index| board.number(0x1003, sub_index));
    assert_eq!((board.number(0x1003, 0), errors), (2, [0x8120, 0x6310]));
    assert_eq!(board.number(0x1001, 0), 0x11, "the errors last");
    board.nmt("81 00");
    assert_eq!(board.number(0x1003, 0), 0, "reset node clears it");
}

#[test]
fn a_boot_up_that_is_sent_again_does_not_enter_its_errors_again() {
    let mut board = NodeRig::unconfigured();
    report(&mut board, Fault::SettingsLost);
    board.configure("11 40");
    assert_eq!(board.lss("04 00"), ["740: 00", SETTINGS_LOST]);
    for _ in 0..3 {
        assert_eq!(board.nmt("82 00"), ["740: 00"]);
    }
    assert_eq!(board.number(0x1003, 0), 1);
}
