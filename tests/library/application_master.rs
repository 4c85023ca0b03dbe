//! An application that is the LSS master of its network: it hears all frames, sends its own, switches the bit rate of its
//! node and stores its values; and the inbox that such an application may have.

use canopen_node::{
    Action, Application, BitRate, BitRateSetting, BusEvent, Frame, Instant, NodeId, Settings,
    application::Event, lss::StoreError, master::Inbox, objects,
};
use testkit::{
    flash::BoardFlash,
    frames::{Frames, SILENCE, of_master, stranger},
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
};

objects! {
    /// A master.
    pub struct Commander, values CommanderValue;

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

impl Commander {
    /// The outcomes of its stores.
    pub fn stored(&self) -> &[Result<(), StoreError>] {
        &self.stored
    }
}

fn board() -> NodeRig<Commander> {
    let device = device(ADDRESS).with_defaults(defaults(0x40));
    let mut board = NodeRig::with_application(device, BoardFlash::blank(0), 0, Commander::new());
    board.let_stores_take_time();
    board.timeline();
    board
}

/// A board at an unproven bit rate of 1 Mbit/s that sends nothing by itself.
fn unproven() -> NodeRig<Commander> {
    let device = device(ADDRESS).with_rescue(true);
    let device = device.with_defaults(Settings::new(BitRate::Kbit1000.into()));
    let mut board = NodeRig::with_application(device, BoardFlash::blank(0), 0, Commander::new());
    board.is_acknowledged = false;
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
fn a_master_pauses_when_nobody_acknowledges_its_frames() {
    let mut board = unproven();
    let send = |board: &mut NodeRig<Commander>| board.node.send(stranger(), now(board));
    assert_eq!(send(&mut board), Some(Action::Transmit(stranger())));
    board.pass_ms(99);
    assert_eq!(send(&mut board), Some(Action::Transmit(stranger())));
    board.pass_ms(2);
    assert_eq!(send(&mut board), None);
}

#[test]
fn a_master_that_searches_takes_part_at_the_bit_rate_that_it_is_told() {
    // After so many milliseconds it listens at this rate, the second time at home.
    for (rate, ms) in [(BitRate::Kbit800, 0), (BitRate::Kbit1000, 1_110)] {
        let mut board = unproven();
        board.see(BusEvent::Error);
        board.pass_ms(ms);
        assert_eq!((board.bit_rate(), board.node.is_listening()), (rate, true));
        board.timeline();
        assert!(board.node.switch_bit_rate(rate, 0, now(&board)));
        board.pass_us(0);
        assert!(!board.node.is_listening(), "{rate}");
        let takes_part = format!("0 ms {rate}");
        assert!(board.timeline().contains(&takes_part), "{rate}");
        assert!(board.node.send(stranger(), now(&board)).is_some());
    }
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

/// Asks for a store of all values, as a client.
fn ask_for_a_store(board: &mut NodeRig<Commander>) -> Frames {
    board.receive(&of_master("640: 23 10 10 01 73 61 76 65"))
}

#[test]
fn the_store_of_a_client_is_answered_on_a_master_but_not_after_a_reset() {
    let mut board = board();
    assert_eq!(ask_for_a_store(&mut board), SILENCE);
    assert_eq!(board.finish_store(), ["5C0: 60 10 10 01 00 00 00 00"]);

    ask_for_a_store(&mut board);
    board.nmt("82 40");
    assert_eq!(board.finish_store(), SILENCE);
    assert_eq!(board.node.application().stored, [], "it is not the master's");
}

#[test]
fn the_store_of_a_client_that_waits_on_a_master_is_forgotten_by_a_reset() {
    let mut board = board();
    board.configure("17");
    ask_for_a_store(&mut board);
    board.nmt("82 40");
    assert_eq!(board.finish_store(), ["17 00"]);
    assert!(!board.is_storing());
}

#[test]
fn an_application_that_is_no_master_commands_nothing() {
    let mut board = NodeRig::with_node_id(0x40);
    assert_eq!(board.node.send(stranger(), now(&board)), None);
    assert!(!board.node.switch_bit_rate(BitRate::Kbit125, 10, now(&board)));
    assert!(!board.node.store_values());
}

#[test]
fn the_inbox_of_a_master_has_answers_stores_nodes_and_rivals() {
    let mut inbox = Inbox::EMPTY;
    let node = |id| NodeId::new(id).expect("a node-ID");
    let hear = |inbox: &mut Inbox, cob_id| {
        let frame = Frame::new(cob_id, &[0x44]).expect("a frame");
        inbox.hear(&frame, Instant::from_micros(7));
        frame
    };
    let answer = hear(&mut inbox, 0x7E4);
    assert!(inbox.has_answer() && !inbox.has_rival());
    assert_eq!(inbox.take_answer(), Some((answer, Instant::from_micros(7))));
    assert!(!inbox.has_answer() && inbox.take_answer().is_none());

    // Emergency, TPDO 1, SDO answer and heartbeat are signs of a node; SYNC and what is for it are none.
    for base in [0x080, 0x180, 0x580, 0x700] {
        hear(&mut inbox, base + 5);
        assert!(inbox.has_heard(node(5)) && !inbox.has_heard(node(4)), "{base:03X}");
        inbox.forget();
        assert!(!inbox.has_heard(node(5)));
    }
    for cob_id in [0x000, 0x080, 0x205, 0x605, 0x7E5] {
        hear(&mut inbox, cob_id);
    }
    assert!((1..=127).all(|id| !inbox.has_heard(node(id))));
    assert!(inbox.has_rival());
    inbox.forget();
    assert!(!inbox.has_rival());

    inbox.handle(Event::Sync);
    assert_eq!(inbox.take_stored(), None);
    inbox.handle(Event::Stored(Err(StoreError::MediumAccess)));
    assert_eq!(inbox.take_stored(), Some(Err(StoreError::MediumAccess)));
    assert_eq!(inbox.take_stored(), None);
}
