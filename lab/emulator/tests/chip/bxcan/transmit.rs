//! Transmit mailboxes: status, priority, abort, one-shot.

use emulator::can::{Note, bxcan::CanVariant};

use crate::rig::{ESR, INRQ, MCR, MSR, NART, Rig, TI0R, TSR, TXFP, standard};

#[test]
fn mailboxes_go_by_identifier_then_by_number_or_with_txfp_by_order_of_request() {
    // The mode, the identifiers of the mailboxes in the order of request, the upper byte of TSR, the order on the bus.
    for (mcr, requests, tsr, order) in [
        // Mailbox 2 has the lowest priority.
        (0, [(0, 0x300), (1, 0x100), (2, 0x300)], 0b1000_0010, [1, 0, 2]),
        // Mailbox 0 was last.
        (TXFP, [(1, 0x300), (2, 0x100), (0, 0x200)], 0b0010_0000, [1, 2, 0]),
    ] {
        let mut rig = Rig::running(mcr);
        rig.write(MCR, mcr | INRQ);
        for (mailbox, id) in requests {
            rig.mailbox(mailbox, standard(id, &[mailbox as u8]));
        }
        assert_eq!(rig.read(TSR) >> 24, tsr);
        rig.write(MCR, mcr);
        rig.run_us(500);
        let sent: Vec<u8> = rig.received().iter().map(|frame| frame.data[0]).collect();
        assert_eq!(sent, order);
    }
}

/// The modelled reading of RM0090, 32.7.1: an idle bus makes a mailbox "transmit" at once (confidence 0.85). The other
/// one: the mailbox is chosen at SOF.
#[test]
fn a_higher_priority_overtakes_waiting_mailboxes_and_the_chosen_one_only_with_a_late_choice() {
    for (late_choice, order) in [(false, [0, 2, 1]), (true, [1, 2, 0])] {
        let mut rig = Rig::of_variant(CanVariant { late_choice, ..CanVariant::default() }, 0);
        // Two requests on an idle bus, a third while the first of them is sent.
        rig.mailbox(0, standard(0x300, &[0]));
        rig.mailbox(1, standard(0x200, &[1]));
        rig.run_us(10);
        rig.mailbox(2, standard(0x100, &[2]));
        rig.run_us(500);
        let sent: Vec<u8> = rig.received().iter().map(|frame| frame.data[0]).collect();
        assert_eq!(sent, order);
    }
}

#[test]
fn an_abort_comes_too_late_for_a_request_on_an_idle_bus() {
    let sent = |variant| {
        let mut rig = Rig::of_variant(variant, 0);
        rig.mailbox(0, standard(0x123, &[1]));
        rig.write(TSR, 1 << 7);
        let pending = rig.read(TSR) & 0xFF;
        rig.run_us(100);
        (pending, rig.read(TSR) & 0xF, rig.received().len())
    };
    assert_eq!(sent(CanVariant::default()), (1 << 7, 0b0011, 1));
    let late_choice = CanVariant { late_choice: true, ..CanVariant::default() };
    assert_eq!(sent(late_choice), (1, 0b0001, 0));
}

/// Another station's SOF takes the turn of the chosen mailbox. Then it can be aborted, and a more urgent one takes its
/// place.
#[test]
fn a_choice_ends_when_another_station_starts_first() {
    let mut rig = Rig::running(0);
    rig.send(standard(0x7F, &[7]));
    rig.step_until("a frame", |rig| rig.read(MSR) >> 9 & 1 == 1);
    rig.mailbox(0, standard(0x300, &[0]));
    rig.mailbox(1, standard(0x200, &[1]));
    rig.mailbox(2, standard(0x100, &[2]));
    rig.write(TSR, 1 << 15);
    rig.run_us(500);
    let order: Vec<u8> = rig.received().iter().map(|frame| frame.data[0]).collect();
    assert_eq!(order, [2, 0]);
}

#[test]
fn a_mailbox_that_waits_is_protected_and_aborted_at_once() {
    let mut rig = Rig::running(0);
    rig.send(standard(0, &[0; 8]));
    rig.run_us(10);
    rig.mailbox(0, standard(0x123, &[1]));
    rig.can_mut(1).take_notes();
    rig.write(TI0R + 8, 0xFF);
    assert_eq!(rig.read(TI0R + 8), 1);
    rig.write(TSR, 1 << 7);
    assert_eq!(rig.read(TSR), 0x1C00_0001, "RQCP without TXOK");
    let now = rig.now;
    assert_eq!(
        rig.can_mut(1).take_notes(),
        [(now, Note::Aborted { mailbox: 0, frame: standard(0x123, &[1]) })]
    );
    rig.run_us(500);
    assert_eq!(rig.received(), []);
}

#[test]
fn an_abort_under_way_ends_the_repetition_of_a_failing_frame() {
    let mut rig = Rig::running(0);
    rig.adapter().close();
    rig.mailbox(0, standard(0x123, &[1]));
    rig.run_us(250);
    assert_eq!(rig.read(TSR) & 0xF, 1 << 3, "TERR without RQCP: it is repeated");
    rig.step_until("a transmission", |rig| rig.read(MSR) >> 8 & 1 == 1);
    rig.write(TSR, 1 << 7);
    assert_eq!(rig.read(TSR) >> 26 & 1, 0);
    rig.run_us(100);
    assert_eq!(rig.read(TSR), 0x1C00_0009, "RQCP and TERR");
    let tec = rig.read(ESR) >> 16 & 0xFF;
    rig.run_us(1000);
    assert_eq!(rig.read(ESR) >> 16 & 0xFF, tec);
}

#[test]
fn one_shot_gives_up_after_an_error_or_lost_arbitration() {
    let mut rig = Rig::running(NART);
    rig.write(MCR, NART | INRQ);
    rig.mailbox(0, standard(0x123, &[1]));
    // Both join now, and so start together after eleven bits.
    rig.adapter().open();
    rig.send(standard(0x100, &[]));
    rig.write(MCR, NART);
    rig.run_us(300);
    assert_eq!(rig.read(TSR), 0x1C00_0005, "RQCP and ALST");
    assert_eq!(rig.received(), []);

    rig.adapter().close();
    rig.mailbox(0, standard(0x123, &[1]));
    rig.run_us(1000);
    assert_eq!(rig.read(TSR), 0x1C00_0009, "RQCP and TERR");
    assert_eq!(rig.read(ESR), 0x0008_0030, "one acknowledgement error");
}
