//! Random SDO and NMT frames, meaningful or not: no panic, at most one answer, and LSS is served after each of them.

use canopen_node::{Frame, nmt::State, object_dictionary::TABLE};
use testkit::{
    frames::{Frames, SILENCE},
    node_rig::NodeRig,
    random::Random,
    sdo::Client,
};

const FRAMES: usize = 100_000;

/// A random SDO request, often a known command for an existing object.
fn request(random: &mut Random) -> Frame {
    const COMMANDS: [u8; 14] =
        [0x40, 0x60, 0x70, 0x22, 0x23, 0x2B, 0x2F, 0x21, 0x20, 0x80, 0x00, 0x10, 0xA0, 0xC6];
    let mut bytes: [u8; 8] = random.bytes();
    if !random.one_in(4) {
        bytes[0] = random.pick(&COMMANDS);
    }
    if !random.one_in(4) {
        let entry = random.pick(TABLE);
        bytes[1..3].copy_from_slice(&entry.index.to_le_bytes());
        bytes[3] = entry.sub_index;
    }
    if random.one_in(4) {
        bytes[4..].copy_from_slice(random.pick(&[b"save", b"load"]));
    }
    let len = if random.one_in(10) { random.within(0..9) as usize } else { 8 };
    Frame::new(0x640, &bytes[..len]).unwrap()
}

/// An NMT frame, often a command that the node obeys.
fn command(random: &mut Random) -> Frame {
    let mut bytes: [u8; 8] = random.bytes();
    if !random.one_in(4) {
        bytes[0] = random.pick(&[1, 2, 0x80, 0x81, 0x82]);
        bytes[1] = random.pick(&[0, 0x40, 0x41]);
    }
    let len = if random.one_in(10) { random.within(0..9) as usize } else { 2 };
    Frame::new(0x000, &bytes[..len]).unwrap()
}

/// The LSS master's session: it finds the node by its address.
fn assert_identifies(board: &mut NodeRig) {
    assert_eq!(board.lss("46 44 33 22 11"), SILENCE);
    assert_eq!(board.lss("47 88 77 66 55"), SILENCE);
    assert_eq!(board.lss("48"), SILENCE);
    assert_eq!(board.lss("49 FF FF FF FF"), SILENCE);
    assert_eq!(board.lss("4A"), SILENCE);
    assert_eq!(board.lss("4B FF FF FF FF"), ["4F"]);
}

/// Checks that the answer has a valid form and belongs to the request.
fn assert_is_answer(answer: &Frame, request: &[u8; 8]) {
    assert_eq!(answer.cob_id(), 0x5C0);
    let answer: &[u8; 8] = answer.data().try_into().expect("eight bytes");
    match (request[0] >> 5, answer[0]) {
        (_, 0x80) => {
            let code = u32::from_le_bytes(answer[4..].try_into().unwrap());
            assert!([0x05, 0x06, 0x08].contains(&(code >> 24)), "abort code {code:08X}");
        }
        (1, 0x60) | (2 | 5, 0x41 | 0x43 | 0x4B | 0x4F) | (5, 0xC6) | (6, 0xA4) => {
            assert_eq!(answer[1..4], request[1..4]);
        }
        (3, segment) => assert_eq!(segment & 0xF0, request[0] & 0x10),
        _ => panic!("{answer:02X?} does not answer {request:02X?}"),
    }
}

fn assert_answers(answers: &Frames, request: &Frame) {
    match (request.data().first_chunk::<8>(), &answers.0[..]) {
        (None, []) => {}
        (Some(request), []) => assert_eq!(request[0] >> 5, 4, "only an abort has no answer"),
        (Some(request), [answer]) => assert_is_answer(answer, request),
        _ => panic!("{answers:?} to {request:?}"),
    }
}

#[test]
fn each_random_sdo_request_gets_one_valid_answer_and_never_blocks_lss() {
    let mut random = Random::from_environment();
    let mut board = NodeRig::with_node_id(0x40);
    for n in 0..FRAMES {
        let request = request(&mut random);
        let answers = board.receive(&request);
        assert_answers(&answers, &request);
        assert_eq!(board.sdo("80"), SILENCE);
        // A written heartbeat time must not fill the answers with heartbeats.
        board.download(0x1017, 0, &[0, 0]).unwrap();
        assert_eq!(board.node.nmt_state(), State::PreOperational);
        if n % 10 == 0 {
            assert_identifies(&mut board);
        }
        if n % 5_000 == 0 {
            // The log is full after some hundred stores; the next power-on makes room.
            board.power_cycle();
            board.timeline();
        }
    }
    assert_eq!(board.upload(0x1008, 0).unwrap(), b"Test board");
}

#[test]
fn random_nmt_and_sdo_frames_in_any_order_never_block_lss() {
    let mut random = Random::from_environment();
    let mut board = NodeRig::with_heartbeat(0x40, 100);
    for n in 0..FRAMES {
        let sent = if random.one_in(2) {
            board.receive(&command(&mut random))
        } else {
            board.receive(&request(&mut random))
        };
        // Only the segments of a block upload come together.
        let mut numbered = sent.0.iter().zip(1_u8..);
        let are_segments = numbered
            .all(|(frame, number)| frame.cob_id() == 0x5C0 && frame.data()[0] & 0x7F == number);
        assert!(sent.0.len() <= 1 || are_segments, "{sent:?}");
        assert_ne!(board.node.nmt_state(), State::Initialisation);
        if n % 10 == 0 {
            board.pass_us(random.within(0..50_000));
            assert_identifies(&mut board);
        }
        if n % 5_000 == 0 {
            board.timeline();
        }
    }
    assert_eq!(board.nmt("82 00"), ["740: 00"]);
    assert_eq!(board.number(0x1018, 4), 0xDEAD_BEEF);
}

#[test]
fn random_frames_do_not_disturb_an_lss_configuration_on_its_way() {
    let mut random = Random::from_environment();
    for _ in 0..500 {
        let mut board = NodeRig::unconfigured();
        let requests = ["04 01", "11 40", "13 00 02", "17", "5E"];
        let answers = [None, Some("11 00"), Some("13 00"), Some("17 00"), Some("5E FF")];
        for (request_of_lss, answer) in requests.into_iter().zip(answers) {
            for _ in 0..40 {
                // Without a node-ID there is no SDO, and NMT commands are limited to resets, which would disturb.
                assert_eq!(board.receive(&request(&mut random)), SILENCE);
                let command = command(&mut random);
                if !matches!(command.data(), [0x81 | 0x82, 0]) {
                    assert_eq!(board.receive(&command), SILENCE);
                }
            }
            assert_eq!(board.lss(request_of_lss), answer.as_slice());
        }
        assert_eq!(board.lss("04 00"), ["740: 00"]);
    }
}
