//! What the TWAI controller of the ESP32-C3 means in the node's terms: bit rates, frames and errors. It runs on the
//! computer too, for its tests.

#![no_std]
#![forbid(unsafe_code)]

use canopen_node::{
    BitRate, BitRates, Frame,
    bit_rate::BitTiming,
    runner::{BusError, Received},
};

/// The clock of the bit timing: the prescaler divides the APB clock of 80 MHz by even numbers only (ESP32-C3 Technical
/// Reference Manual, TWAI_BUS_TIMING_0_REG).
pub const CLOCK_HZ: u32 = 80_000_000 / 2;

/// The bit rates that LSS may select: all, and each is exact.
pub const BIT_RATES: BitRates = BitRates::possible(CLOCK_HZ).with_automatic();

const TIMINGS: [Option<BitTiming>; 10] = BitTiming::table(CLOCK_HZ);

/// The bit timing of `rate`, with a prescaler that divides the APB clock.
pub fn timing(rate: BitRate) -> Option<BitTiming> {
    let timing = TIMINGS.get(usize::from(rate.index())).copied().flatten()?;
    Some(BitTiming { prescaler: 2 * timing.prescaler, ..timing })
}

/// A frame of the driver. Length codes 9 to 15 are legal on the wire.
pub fn received(frame: &impl embedded_can::Frame) -> Received {
    Some(frame).filter(|frame| frame.dlc() <= 8).and_then(Frame::received).into()
}

/// The error with this code of TWAI_ERR_CODE_CAP_REG.
///
/// Of a bit error the code does not tell the level. A recessive bit that becomes dominant is one in the data length
/// code, the data and the checksum only: before, it is a lost arbitration, and later only dominant bits are checked.
pub const fn error(code: u8) -> BusError {
    const RECEIVING: u8 = 1 << 5;
    const LENGTH_CODE: u8 = 0b01011;
    const DATA: u8 = 0b01010;
    const CHECKSUM: u8 = 0b01000;
    const ACKNOWLEDGE: u8 = 0b11001;
    match (code >> 6, code & 0x1F) {
        (0b00, LENGTH_CODE | DATA | CHECKSUM) => BusError::BitRecessive,
        (0b00, _) => BusError::BitDominant,
        (0b01, _) => BusError::Form,
        (0b10, _) => BusError::Stuff,
        (_, ACKNOWLEDGE) if code & RECEIVING == 0 => BusError::Acknowledge,
        _ => BusError::Crc,
    }
}

#[cfg(test)]
mod tests {
    use canopen_node::BusEvent;
    use embedded_can::{ExtendedId, Id, StandardId};

    use super::*;

    /// A frame as the driver of esp-hal returns it: eight bytes of data for length codes above 8.
    struct DriverFrame {
        id: Id,
        is_remote: bool,
        length_code: usize,
    }

    const DATA: [u8; 8] = [1, 2, 3, 4, 5, 6, 7, 8];

    impl embedded_can::Frame for DriverFrame {
        fn new(_: impl Into<Id>, _: &[u8]) -> Option<Self> {
            None
        }

        fn new_remote(_: impl Into<Id>, _: usize) -> Option<Self> {
            None
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
            self.length_code
        }

        fn data(&self) -> &[u8] {
            &DATA[..if self.is_remote { 0 } else { self.length_code.min(8) }]
        }
    }

    fn lss_request(length_code: usize) -> DriverFrame {
        let id = StandardId::new(0x7E5).unwrap().into();
        DriverFrame { id, is_remote: false, length_code }
    }

    #[test]
    fn a_data_frame_keeps_its_identifier_and_data() {
        for len in 0..=8 {
            let frame = Frame::new(0x7E5, &DATA[..len]).unwrap();
            assert_eq!(received(&lss_request(len)), Received::Frame(frame));
        }
    }

    #[test]
    fn a_length_code_above_8_is_no_frame_of_the_node() {
        for length_code in 9..=15 {
            assert_eq!(received(&lss_request(length_code)), Received::Other);
        }
    }

    #[test]
    fn remote_frames_and_29_bit_identifiers_are_no_frames_of_the_node() {
        assert_eq!(received(&DriverFrame { is_remote: true, ..lss_request(8) }), Received::Other);
        let id = ExtendedId::new(0x7E5).unwrap().into();
        assert_eq!(received(&DriverFrame { id, ..lss_request(8) }), Received::Other);
    }

    #[test]
    fn each_bit_rate_is_exact_with_an_even_prescaler() {
        for rate in BitRate::ALL {
            assert!(BIT_RATES.contains(rate), "{rate}");
            let timing = timing(rate).unwrap();
            assert_eq!(timing.prescaler % 2, 0, "{rate}");
            let hz = 1000 * u32::from(rate.kbit_per_s());
            assert_eq!(u32::from(timing.prescaler) * timing.quanta() * hz, 80_000_000, "{rate}");
        }
    }

    #[test]
    fn each_bit_rate_has_segments_that_the_registers_can_hold() {
        for timing in BitRate::ALL.map(|rate| timing(rate).unwrap()) {
            assert!((2..=16_384).contains(&timing.prescaler), "{timing:?}");
            assert!((1..=16).contains(&timing.segment1), "{timing:?}");
            assert!((1..=8).contains(&timing.segment2), "{timing:?}");
            assert!((1..=4).contains(&timing.sync_jump_width), "{timing:?}");
        }
    }

    #[test]
    fn errors_of_a_wrong_bit_rate_count_as_such() {
        for code in [
            0b1010_1010, // Stuff error, received data.
            0b1111_1000, // Checksum, at its delimiter.
            0b0000_1010, // Bit error in sent data.
        ] {
            assert_eq!(error(code).event(), Some(BusEvent::Error), "{code:08b}");
        }
        assert_eq!(error(0b0111_1010).event(), Some(BusEvent::FormError), "end of frame");
    }

    #[test]
    fn a_missing_acknowledge_and_a_broken_wire_say_nothing_of_the_bit_rate() {
        assert_eq!(error(0b1101_1001), BusError::Acknowledge);
        for code in [
            0b0000_0011, // Bit error in the start of frame.
            0b0000_0010, // In the first bits of the identifier.
            0b0011_1001, // In the own acknowledge.
            0b0001_0001, // In the own error flag.
        ] {
            assert_eq!(error(code), BusError::BitDominant, "{code:08b}");
        }
    }
}
