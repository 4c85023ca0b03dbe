//! What an application may decide about its values and TPDOs: values computed when they are read, quiet values, and TPDOs
//! that are sent on demand.

use canopen_node::{Application, Frame, application::Domain, objects, pdo::Tpdo, sdo::Abort};
use testkit::{
    frames::{Frames, SILENCE},
    node_rig::NodeRig,
    sdo::Client,
};

objects! {
    /// A meter, whose age counts how often it was read.
    pub struct Meter, values MeterValue;

    0x2100 "Ages" {
        1 "Reads" reads: u8 = 0, rw, mappable, quiet;
        2..=3 "Twice the level" doubled: [u16; 2] = [0; 2], ro, mappable;
        4 "Log" log: Domain = Domain, ro;
    }
    0x6000 {
        0 "Level" level: u16 = 0, ro, mappable;
    }
}

impl Application for Meter {
    const TPDOS: &'static [Tpdo] = &[
        Tpdo::new(&[(0x6000, 0), (0x2100, 1)]).with_inhibit_time(100),
        Tpdo::new(&[(0x2100, 3)]).with_transmission_type(1),
        Tpdo::new(&[(0x2100, 1)]).with_transmission_type(0),
    ];

    fn before_read(&mut self, index: u16, sub_index: u8) {
        match (index, sub_index) {
            (0x2100, 1) => self.reads += 1,
            (0x2100, 3) => self.doubled[1] = 2 * self.level,
            (0x2100, 4) => panic!("a domain has hooks of its own"),
            _ => {}
        }
    }

    fn domain_len(&mut self, _: u16, _: u8) -> Result<u32, Abort> {
        Ok(0)
    }
}

type Board = NodeRig<Meter>;

fn board() -> Board {
    NodeRig::running(Meter::new())
}

/// A board in NMT operational after its first TPDO, whose inhibit time is over.
fn operational() -> Board {
    let mut board = board();
    assert_eq!(board.nmt("01 40"), ["1C0: 00 00 01"]);
    assert_eq!(board.pass_ms(100), SILENCE);
    board
}

fn sync(board: &mut Board) -> Frames {
    board.receive(&Frame::new(0x080, &[]).unwrap())
}

fn send(board: &mut Board, number: u8) -> Frames {
    board.node.send_tpdo(number);
    board.pass_us(0)
}

#[test]
fn a_value_is_computed_when_a_client_reads_it() {
    let mut board = board();
    board.node.application_mut().level = 7;
    assert_eq!(board.sdo("40 00 21 03"), ["5C0: 4B 00 21 03 0E 00 00 00"]);
    assert_eq!(board.sdo("40 00 21 02"), ["5C0: 4B 00 21 02 00 00 00 00"]);
    assert_eq!([1, 2].map(|_| board.upload(0x2100, 1).unwrap()[0]), [1, 2], "once for each upload");
    assert_eq!(board.download(0x2100, 1, &[9]), Ok(()));
    assert_eq!(board.node.application().reads, 9, "a write reads nothing");
    assert_eq!(board.upload(0x2100, 4), Ok(vec![]));
}

#[test]
fn a_value_is_computed_when_a_sync_asks_for_it() {
    let mut board = operational();
    board.node.application_mut().level = 0x0102;
    board.pass_ms(100);
    let frames = sync(&mut board);
    assert!(frames.0.iter().any(|frame| frame.cob_id() == 0x2C0 && frame.data() == [4, 2]));
}

#[test]
fn a_quiet_value_is_carried_but_sends_no_tpdo() {
    let mut board = operational();
    let reads = board.node.application().reads;
    assert_eq!(board.download(0x2100, 1, &[0x50]), Ok(()));
    assert!(board.node.application().reads > reads, "it was looked at");
    assert_eq!(board.pass_ms(1000), SILENCE);
    board.node.application_mut().reads = 0x60;
    board.node.application_mut().level = 1;
    assert_eq!(board.pass_us(0), ["1C0: 01 00 61"]);
}

#[test]
fn a_quiet_value_sends_no_tpdo_of_type_0_either() {
    let mut board = operational();
    let of_type_0 = |frames: Frames| frames.0.iter().any(|frame| frame.cob_id() == 0x3C0);
    assert!(of_type_0(sync(&mut board)), "it is new");
    assert!(!of_type_0(sync(&mut board)));
    assert_eq!(send(&mut board, 3), SILENCE, "it waits for SYNC");
    assert!(of_type_0(sync(&mut board)));
    assert!(!of_type_0(sync(&mut board)), "once");
}

#[test]
fn a_tpdo_is_sent_on_demand_after_its_inhibit_time() {
    let mut board = operational();
    let [first] = &send(&mut board, 1).0[..] else { panic!("it is sent at once") };
    assert_eq!((first.cob_id(), &first.data()[..2]), (0x1C0, &[0, 0][..]));
    assert_eq!(send(&mut board, 1), SILENCE, "the inhibit time runs");
    assert_eq!(board.pass_ms(9), SILENCE);
    assert_eq!(board.pass_ms(1).0.len(), 1);
    assert_eq!(board.pass_ms(1000), SILENCE, "once for each demand");
}

#[test]
fn a_demand_for_a_tpdo_that_is_not_in_use_has_no_effect() {
    let mut board = operational();
    for number in [0, 2, 4, 255] {
        assert_eq!(send(&mut board, number), SILENCE, "{number}");
    }
    board.nmt("80 40");
    assert_eq!(send(&mut board, 1), SILENCE, "pre-operational");
    assert_eq!(board.pass_ms(1000), SILENCE);
}
