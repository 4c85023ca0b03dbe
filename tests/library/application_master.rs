//! An application that is the LSS master of its network: it hears all frames, sends its own, switches the bit rate of its
//! node and stores its values.

use canopen_node::{
    Action, Application, BitRate, BitRateSetting, Frame, Instant, application::Event,
    lss::StoreError, objects,
};
use testkit::{
    flash::BoardFlash,
    frames::{SILENCE, stranger},
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
};

objects! {
    /// A master.
    struct Commander, values CommanderValue;

    private heard: Vec<Frame> = Vec::new();
    private stored: Vec<Result<(), StoreError>> = Vec::new();

    0x2100 {
        0 "Table" table: u8 = 0, rw, stored;
    }
}

impl Application for Commander {
    const IS_MASTER: bool = true;

    fn hear(&mut self, frame: &Frame, _: Instant) {
        self.heard.push(*frame);
    }

    fn handle(&mut self, event: Event) {
        if let Event::Stored(outcome) = event {
            self.stored.push(outcome);
        }
    }
}

fn board() -> NodeRig<Commander> {
    let device = device(ADDRESS).with_defaults(defaults(0x40));
    let mut board = NodeRig::with_application(device, BoardFlash::blank(0), 0, Commander::new());
    board.let_stores_take_time();
    board.timeline();
    board
}

fn now<A: Application + Clone>(board: &NodeRig<A>) -> Instant {
    Instant::from_micros(board.now() as u32)
}

/// Asks for a store.
fn store(board: &mut NodeRig<Commander>) {
    assert!(board.node.store_values());
    board.pass_us(0);
}

#[test]
fn a_master_hears_the_frames_of_others() {
    let mut board = board();
    board.receive(&stranger());
    assert_eq!(board.node.application().heard, [stranger()]);
    assert!(board.node.receives().contains(0x7FF));
}

#[test]
fn a_master_sends_its_frames_unless_the_node_is_silent() {
    let mut board = board();
    let send = |board: &mut NodeRig<Commander>| board.node.send(stranger(), now(board));
    assert_eq!(send(&mut board), Some(Action::Transmit(stranger())));
    board.pass_us(0);
    assert!(board.node.switch_bit_rate(BitRate::Kbit125, 10, now(&board)));
    board.pass_ms(5);
    assert_eq!(send(&mut board), None);
}

#[test]
fn a_master_switches_its_node_with_both_delays_and_stores_the_rate() {
    let mut board = board();
    assert!(board.node.switch_bit_rate(BitRate::Kbit125, 10, now(&board)));
    assert!(!board.node.switch_bit_rate(BitRate::Kbit250, 10, now(&board)), "one at a time");
    board.pass_us(0);
    board.pass_ms(30);
    assert_eq!(board.timeline(), ["0 ms stop", "10 ms 125 kbit/s", "20 ms resume"]);
    assert!(board.stored().is_none());
    store(&mut board);
    board.finish_store();
    let stored = board.stored().expect("it has stored");
    assert_eq!(stored.bit_rate, BitRateSetting::Fixed(BitRate::Kbit125));
    assert_eq!(stored.node_id, defaults(0x40).node_id);
}

#[test]
fn the_store_of_a_master_ends_with_an_event_also_after_a_reset() {
    let mut board = board();
    assert_eq!(board.download(0x2100, 0, &[7]), Ok(()));
    store(&mut board);
    board.nmt("82 40");
    assert_eq!(board.finish_store(), SILENCE);
    assert_eq!(board.node.application().stored, [Ok(())]);
    board.power_cycle();
    assert_eq!(board.number(0x2100, 0), 7);

    store(&mut board);
    board.end_store(Err(StoreError::MediumAccess));
    assert_eq!(board.node.application().stored, [Err(StoreError::MediumAccess)]);
}

#[test]
fn a_store_of_a_master_waits_for_that_of_a_client() {
    let mut board = board();
    board.configure("17");
    assert!(board.is_storing());
    store(&mut board);
    assert!(!board.node.store_values(), "one waits");
    board.nmt("82 40");
    assert_eq!(board.finish_store(), ["17 00"]);
    assert!(board.is_storing(), "that of the master");
    board.finish_store();
    assert_eq!(board.node.application().stored, [Ok(())]);
}

#[test]
fn an_application_that_is_no_master_commands_nothing() {
    let mut board = NodeRig::with_node_id(0x40);
    assert_eq!(board.node.send(stranger(), now(&board)), None);
    assert!(!board.node.switch_bit_rate(BitRate::Kbit125, 10, now(&board)));
    assert!(!board.node.store_values());
}
