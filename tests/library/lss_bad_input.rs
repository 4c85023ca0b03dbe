//! Arbitrary input: foreign frames, random frames, random order; no panic, and no action without a cause.

use canopen_node::{Action, Frame, Instant, lss::Request};
use embedded_can::{ExtendedId, Id, StandardId};
use testkit::{
    frames::{bytes, of_master},
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
fn a_data_frame_with_an_11_bit_id_arrives_as_it_is_and_no_other() {
    let data = bytes("01 02 03 04 05 06 07 08 09");
    for id in 0..=0x7FF {
        let standard = StandardId::new(id).unwrap();
        for len in 0..=8 {
            let frame = received(standard, false, &data[..len]).unwrap();
            assert_eq!((frame.cob_id(), frame.data()), (id, &data[..len]));
            assert_eq!(received(standard, true, &data[..len]), None, "remote");
            for extended in [id.into(), u32::from(id) << 18, 0x1FFF_FFFF] {
                let extended = ExtendedId::new(extended).unwrap();
                for is_remote in [false, true] {
                    assert_eq!(received(extended, is_remote, &data[..len]), None, "29 bits");
                }
            }
        }
        assert_eq!(received(standard, false, &data), None, "nine bytes");
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

/// A random frame, more often than not one that has a meaning.
fn any_frame(random: &mut Random) -> Frame {
    const MEANINGFUL: &str = "04 00, 04 01, 11 05, 11 FF, 13 00 02, 15 01 00, 15 FF FF, 17, 4C, 5E, \
        40 44 33 22 11, 41 88 77 66 55, 42 03 02 01 00, 43 EF BE AD DE, 51 00 00 00 00 80, \
        000: 01 00, 000: 02 00, 000: 80 00, 000: 81 00, 000: 82 00";
    if random.one_in(4) {
        let len = random.within(0..9) as usize;
        let any = random.within(0..0x800) as u16;
        let cob_id = random.pick(&[0x7E5, 0x000, 0x640, any]);
        return Frame::new(cob_id, &random.bytes::<8>()[..len]).unwrap();
    }
    of_master(random.pick(&MEANINGFUL.split(", ").collect::<Vec<_>>()))
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
                0 => node.handle_stored(Ok(&[])),
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
