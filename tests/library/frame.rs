//! Frames: construction, content, equality.

use canopen_node::{BitRate, Frame};
use embedded_can::{ExtendedId, Frame as _, Id, StandardId};

#[test]
fn a_frame_has_an_11_bit_identifier_and_up_to_eight_bytes() {
    let data = [1, 2, 3, 4, 5, 6, 7, 8, 9];
    for len in 0..=8 {
        for cob_id in [0, 0x7FF] {
            let frame = Frame::new(cob_id, &data[..len]).expect("a frame");
            assert_eq!((frame.cob_id(), frame.data()), (cob_id, &data[..len]));
        }
        for cob_id in 0x800..=u16::MAX {
            assert_eq!(Frame::new(cob_id, &data[..len]), None, "{cob_id:04X}");
        }
    }
    assert_eq!(Frame::new(0, &data), None);
}

#[test]
fn a_frame_from_a_controller_is_the_same_as_one_from_its_data() {
    let padded = [1, 2, 3, 4, 5, 6, 7, 8];
    for len in 0..=8 {
        let frame = Frame::from_padded(0x123, len, padded).expect("a frame");
        assert_eq!(
            Some(frame),
            Frame::new(0x123, &padded[..len]),
            "what follows the data is nothing"
        );
        assert_eq!(frame.data(), &padded[..len]);
        assert_eq!(frame.padded_data()[..len], padded[..len]);
    }
    assert_eq!(Frame::from_padded(0x123, 9, padded), None);
    assert_eq!(Frame::from_padded(0x800, 8, padded), None);
}

#[test]
fn frames_with_another_identifier_length_or_byte_differ() {
    let frame = Frame::new(0x123, &[1, 0]);
    for other in [Frame::new(0x124, &[1, 0]), Frame::new(0x123, &[1]), Frame::new(0x123, &[1, 1])] {
        assert_ne!(frame, other);
    }
}

#[test]
fn an_embedded_can_frame_is_a_data_frame_with_a_standard_id() {
    fn made<F: embedded_can::Frame>(id: impl Into<Id>, data: &[u8]) -> Option<F> {
        F::new(id, data)
    }
    let id = StandardId::new(0x7E5).expect("an id");
    let frame: Frame = made(id, &[4, 1]).expect("a frame");
    assert_eq!(Some(frame), Frame::new(0x7E5, &[4, 1]));
    assert_eq!((frame.id(), frame.dlc()), (Id::Standard(id), 2));
    assert_eq!(embedded_can::Frame::data(&frame), [4, 1]);
    assert!(frame.is_standard() && frame.is_data_frame());
    assert_eq!(made::<Frame>(id, &[0; 9]), None);
    assert_eq!(made::<Frame>(ExtendedId::new(0x7E5).expect("an id"), &[4, 1]), None);
    assert_eq!(Frame::new_remote(id, 2), None);
}

#[test]
fn the_longest_time_of_a_frame_has_the_most_stuff_bits() {
    for (len, bits) in [(0, 55), (1, 65), (8, 135)] {
        let frame = Frame::new(0x7E5, &[0; 8][..len]).expect("a frame");
        assert_eq!(frame.longest_micros(BitRate::Kbit1000), bits, "{len} bytes");
        assert_eq!(frame.longest_micros(BitRate::Kbit800), (bits * 5).div_ceil(4), "{len} bytes");
    }
}
