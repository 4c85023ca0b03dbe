//! Arbitrary input: foreign frames, random frames, random order; no panic, and no action without a cause.

use canopen_node::{Action, Frame, Instant, lss::Request};
use embedded_can::{ExtendedId, Id, StandardId};
use testkit::{
    frames::bytes,
    node_rig::{NodeRig, defaults},
    random::Random,
};

/// A frame as a CAN driver may pass it on, well-formed or not.
struct Received {
    id: Id,
    is_remote: bool,
    data: Vec<u8>,
}

impl embedded_can::Frame for Received {
    fn new(id: impl Into<Id>, data: &[u8]) -> Option<Self> {
        Some(Self { id: id.into(), is_remote: false, data: data.to_vec() })
    }

    fn new_remote(id: impl Into<Id>, dlc: usize) -> Option<Self> {
        Some(Self { id: id.into(), is_remote: true, data: vec![0; dlc] })
    }

    fn is_extended(&self) -> bool {
        matches!(self.id, Id::Extended(_))
    }

    fn is_remote_frame(&self) -> bool {
        self.is_remote
    }

    fn id(&self) -> Id {
        self.id
    }

    fn dlc(&self) -> usize {
        self.data.len()
    }

    fn data(&self) -> &[u8] {
        &self.data
    }
}

fn received(id: impl Into<Id>, is_remote: bool, data: &[u8]) -> Option<Frame> {
    Frame::received(&Received { id: id.into(), is_remote, data: data.to_vec() })
}

#[test]
fn a_data_frame_with_an_11_bit_id_arrives_as_it_is() {
    let data = bytes("01 02 03 04 05 06 07 08 09");
    for id in 0..=0x7FF {
        let standard = StandardId::new(id).unwrap();
        for len in 0..=8 {
            let frame = received(standard, false, &data[..len]).unwrap();
            assert_eq!((frame.cob_id(), frame.data()), (id, &data[..len]));
        }
        assert_eq!(received(standard, false, &data), None, "nine bytes");
    }
}

#[test]
fn a_frame_with_a_29_bit_id_is_rejected_even_with_an_11_bit_number() {
    let request = bytes("4C 00 00 00 00 00 00 00");
    for id in [0x7E5, 0x000, 0x7E5 << 18, 0x1FFF_FFFF] {
        assert_eq!(received(ExtendedId::new(id).unwrap(), false, &request), None, "{id:08X}");
        assert_eq!(received(ExtendedId::new(id).unwrap(), true, &[]), None, "{id:08X}");
    }
}

#[test]
fn a_remote_frame_is_rejected() {
    for id in [0x7E5, 0x000, 0x740] {
        let id = StandardId::new(id).unwrap();
        assert_eq!(received(id, true, &[]), None);
        assert_eq!(received(id, true, &[0x4C, 0, 0, 0, 0, 0, 0, 0]), None);
    }
}

#[test]
fn every_frame_of_an_lss_master_has_one_meaning_and_is_written_as_read() {
    let mut random = Random::from_environment();
    for command in 0..=0xFF {
        for _ in 0..200 {
            let mut data: [u8; 8] = random.bytes();
            data[0] = command;
            if random.one_in(2) {
                data[1] %= 3;
            }
            if let Some(request) = Request::from_bytes(&data) {
                let written = request.to_bytes();
                assert_eq!(written[0], command);
                assert_eq!(Request::from_bytes(&written), Some(request), "{data:02X?}");
            }
        }
    }
}

/// A random frame with more than a random share of meaningful ones.
fn any_frame(random: &mut Random) -> Frame {
    const COMMANDS: [u8; 25] = [
        0x04, 0x04, 0x04, 0x11, 0x13, 0x15, 0x17, 0x40, 0x41, 0x42, 0x43, 0x44, 0x46, 0x47, 0x48,
        0x49, 0x4A, 0x4B, 0x4C, 0x4F, 0x50, 0x51, 0x51, 0x5A, 0x5E,
    ];
    let cob_id = match random.within(0..8) {
        0 => 0x000,
        1 => random.within(0..0x800) as u16,
        _ => 0x7E5,
    };
    let mut data: [u8; 8] = random.bytes();
    if random.one_in(2) {
        data = data.map(|byte| byte & 0x83);
    }
    if cob_id == 0x000 && random.one_in(2) {
        data[0] = random.pick(&[1, 2, 0x80, 0x81, 0x82]);
        data[1] &= 1;
    } else if !random.one_in(8) {
        data[0] = random.pick(&COMMANDS);
    }
    // Short delays, otherwise most frames would fall into silent periods.
    if cob_id == 0x7E5 && data[0] == 0x15 {
        data[1] %= 4;
        data[2] = if random.one_in(50) { data[2] } else { 0 };
    }
    let len = match (cob_id, random.one_in(8)) {
        (_, true) => random.within(0..9) as usize,
        (0x000, _) => 2,
        _ => 8,
    };
    Frame::new(cob_id, &data[..len]).unwrap()
}

/// Calls outside of the contract: any order, no time order, unrequested outcomes of stores.
#[test]
fn no_order_of_calls_makes_the_node_panic_or_answer_without_end() {
    let mut random = Random::from_environment();
    for _ in 0..200 {
        let mut node = NodeRig::with_defaults(defaults(random.pick(&[0x40, 0xFF]))).node;
        for _ in 0..300 {
            let now = Instant::from_micros(random.u32());
            match random.within(0..4) {
                0 => node.handle_stored(Ok(())),
                1 => {
                    let calls = std::iter::from_fn(|| node.poll(now)).take(1_000);
                    assert!(calls.count() < 1_000, "poll comes to an end");
                }
                _ => {
                    let action = node.handle_frame(&any_frame(&mut random), now);
                    assert!(!matches!(action, Some(Action::Store(_))), "only after the answers");
                }
            }
        }
    }
}
