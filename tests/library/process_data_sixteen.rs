//! Sixteen TPDOs and sixteen RPDOs: those from the fifth on have no COB-ID before a master gives them one.

use canopen_node::Frame;
use testkit::{
    eds::parse,
    frames::{SILENCE, bytes},
    node_rig::NodeRig,
    sdo::Client,
};

use crate::{
    eds::sheet_of,
    process_data::{DEVICE_STATE, INVALID_VALUE, With, map},
};

type Sixteen = With<16, 16, 2>;
type Board = NodeRig<Sixteen>;

fn board() -> Board {
    NodeRig::running(Sixteen::new())
}

/// A board whose TPDOs 5 to 16 have the COB-IDs 405h to 410h and the buttons, and RPDOs 5 to 16 the COB-IDs 505h to 510h
/// and the lamps.
fn with_sixteen() -> Board {
    let mut board = board();
    for number in 5..=16 {
        map(&mut board, 0x1800 + number - 1, 0x400 + u32::from(number), &[0x6000_0108]);
        map(&mut board, 0x1400 + number - 1, 0x500 + u32::from(number), &[0x6200_0108]);
    }
    board
}

fn receive(board: &mut Board, cob_id: u16, data: &str) -> Vec<u16> {
    let frames = board.receive(&Frame::new(cob_id, &bytes(data)).unwrap());
    frames.0.iter().map(Frame::cob_id).collect()
}

#[test]
fn a_new_device_has_no_cob_id_for_a_pdo_above_four() {
    let mut board = board();
    assert_eq!(
        [3, 4, 15].map(|at| board.number(0x1800 + at, 1)),
        [0xC000_04C0, 0xC000_0000, 0xC000_0000]
    );
    assert_eq!(
        [3, 4, 15].map(|at| board.number(0x1400 + at, 1)),
        [0x8000_0540, 0x8000_0000, 0x8000_0000]
    );
    for parameter in [0x180F_u16, 0x140F] {
        let valid = board.download(parameter, 1, &[0, 0, 0, 0]);
        assert_eq!(valid, Err(INVALID_VALUE), "0 is the COB-ID of NMT");
    }
    assert_eq!(board.nmt("01 40"), ["1C0: 00 00 00"]);
    assert!(receive(&mut board, 0x040, "01").is_empty(), "the node-ID is no COB-ID");
}

#[test]
fn each_of_sixteen_tpdos_is_sent() {
    let mut board = with_sixteen();
    let sent = board.nmt("01 40").0;
    let expected = [0x1C0].into_iter().chain(0x405..=0x410);
    assert!(sent.iter().map(Frame::cob_id).eq(expected), "{sent:?}");
    board.node.application_mut().0.buttons = 3;
    assert_eq!(board.pass_us(0).0.len(), 13);
    for number in 5..=16 {
        assert_eq!(board.download(0x1800 + number - 1, 2, &[1]), Ok(()));
    }
    let expected: Vec<_> = [0x2C0].into_iter().chain(0x405..=0x410).collect();
    assert_eq!(receive(&mut board, 0x080, ""), expected);
    assert_eq!(board.pass_ms(1000), SILENCE);
}

#[test]
fn each_of_sixteen_rpdos_takes_effect() {
    let mut board = with_sixteen();
    board.nmt("01 40");
    for number in 5..=16 {
        receive(&mut board, 0x500 + number, &format!("{number:02X}"));
        assert_eq!(u16::from(board.node.application().0.lamps), number);
        assert!(board.node.receives().contains(0x500 + number));
    }
    receive(&mut board, 0x511, "77");
    assert_eq!(board.node.application().0.lamps, 16);
}

#[test]
fn sixteen_pdos_are_stored() {
    let mut board = with_sixteen();
    assert_eq!(board.save(1), Ok(()));
    board.power_cycle();
    for number in 5..=16 {
        let at = number - 1;
        assert_eq!(board.number(0x1800 + at, 1), 0x400 + u32::from(number));
        assert_eq!(board.number(0x1A00 + at, 1), 0x6000_0108);
        assert_eq!(board.number(0x1400 + at, 1), 0x500 + u32::from(number));
    }
    assert_eq!(board.download(0x180F, 3, &[1, 0]), Err(DEVICE_STATE), "it is valid");
}

#[test]
fn the_data_sheet_has_sixteen_pdos() {
    let sections = parse(&sheet_of(&Sixteen::new()));
    let info = &sections["DeviceInfo"];
    let numbers = ["NrOfRXPDO", "NrOfTXPDO", "Granularity"].map(|key| &*info[key]);
    assert_eq!(numbers, ["16", "16", "8"]);
    assert_eq!(
        (&*sections["180F"]["ObjectType"], &*sections["1A0F"]["ObjectType"]),
        ("0x9", "0x9")
    );
    assert_eq!(sections["180F"]["ParameterName"], "TPDO communication parameter 16");
    assert_eq!(sections["180Fsub1"]["DefaultValue"], "0xC0000000");
    assert_eq!(sections["1803sub1"]["DefaultValue"], "$NODEID+0xC0000480");
}
