//! Conversion between a frame and its bits: field layout, CRC and stuffing from start of frame to the CRC sequence.

use super::{Frame, Id};

/// The level of the wire, or of one station's output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Level {
    /// Logic 0, driven; wins over recessive.
    Dominant,
    /// Logic 1, released.
    #[default]
    Recessive,
}

impl Level {
    fn from_bit(bit: bool) -> Self {
        if bit { Self::Recessive } else { Self::Dominant }
    }

    fn bit(self) -> bool {
        self == Self::Recessive
    }
}

/// Bits from the CRC delimiter to the last bit of EOF: delimiter, acknowledge slot and delimiter, EOF.
const TAIL: u32 = 10;
const CRC_BITS: u8 = 15;
/// Position of the IDE bit, counted from SOF without stuff bits.
const IDE: u8 = 13;
/// Bits before the data field in the base and the extended format.
const BASE_HEADER: u8 = 19;
const EXTENDED_HEADER: u8 = 39;

impl Frame {
    /// Bits on the wire from SOF to the last bit of EOF, including stuff bits; intermission adds three.
    pub fn wire_bits(&self) -> u32 {
        u32::from(BitStream::new(self).length) + TAIL
    }
}

/// CRC-15 of ISO 11898-1, generator 0x4599, initial value zero. Over a frame and its CRC sequence it is zero.
#[derive(Clone, Copy, Debug, Default)]
struct Crc(u16);

impl Crc {
    fn push(&mut self, bit: bool) {
        let feedback = bit != (self.0 >> 14 & 1 == 1);
        self.0 = self.0 << 1 & 0x7FFF;
        if feedback {
            self.0 ^= 0x4599;
        }
    }
}

/// The run of equal bits that determines the position of stuff bits.
#[derive(Clone, Copy, Debug, Default)]
struct Run {
    level: Level,
    length: u8,
}

impl Run {
    fn push(&mut self, level: Level) {
        self.length = if level == self.level { self.length + 1 } else { 1 };
        self.level = level;
    }

    /// Whether the next bit is a stuff bit.
    fn full(self) -> bool {
        self.length == 5
    }
}

/// The stuffed bits of a frame from SOF to the CRC sequence; everything after them is recessive.
#[derive(Debug)]
pub(super) struct BitStream {
    bits: [u64; 3],
    length: u8,
    run: Run,
    crc: Crc,
}

impl BitStream {
    pub fn new(frame: &Frame) -> Self {
        let mut stream = Self { bits: [0; 3], length: 0, run: Run::default(), crc: Crc::default() };
        stream.field(0, 1);
        match frame.id {
            Id::Standard(id) => {
                stream.field(u64::from(id), 11);
                stream.field(u64::from(frame.remote) << 2, 3);
            }
            Id::Extended(id) => {
                stream.field(u64::from(id >> 18), 11);
                stream.field(0b11, 2);
                stream.field(u64::from(id & 0x3_FFFF), 18);
                stream.field(u64::from(frame.remote) << 2, 3);
            }
        }
        stream.field(u64::from(frame.dlc), 4);
        for &byte in frame.payload() {
            stream.field(u64::from(byte), 8);
        }
        stream.field(u64::from(stream.crc.0), CRC_BITS);
        stream
    }

    /// The bit at `index`, counted from SOF with stuff bits.
    pub fn level(&self, index: u8) -> Level {
        let word = self.bits.get(usize::from(index / 64));
        Level::from_bit(index >= self.length || word.is_some_and(|w| w >> (index % 64) & 1 == 1))
    }

    fn field(&mut self, value: u64, width: u8) {
        for shift in (0..width).rev() {
            let bit = value >> shift & 1 == 1;
            self.crc.push(bit);
            self.append(Level::from_bit(bit));
            if self.run.full() {
                self.append(Level::from_bit(!bit));
            }
        }
    }

    fn append(&mut self, level: Level) {
        self.run.push(level);
        self.bits[usize::from(self.length / 64)] |= u64::from(level.bit()) << (self.length % 64);
        self.length += 1;
    }
}

/// The meaning of a bit to a [`Decoder`].
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Progress {
    Within,
    /// A sixth equal bit where a stuff bit was due.
    StuffError,
    /// This was the last bit of the CRC sequence, or the stuff bit after it.
    CrcSequenceEnd,
}

/// Decodes the bits of a frame from SOF to the CRC sequence.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Decoder {
    bits: u128,
    position: u8,
    run: Run,
    crc: Crc,
    /// Position after the CRC sequence; zero until the DLC is known.
    end: u8,
}

impl Decoder {
    /// Position of the next bit, counted from SOF without stuff bits.
    pub fn position(&self) -> u8 {
        self.position
    }

    pub fn stuff_bit_due(&self) -> bool {
        self.run.full()
    }

    pub fn push(&mut self, level: Level) -> Progress {
        if self.run.full() {
            if level == self.run.level {
                return Progress::StuffError;
            }
            self.run.push(level);
        } else {
            self.run.push(level);
            self.crc.push(level.bit());
            self.bits = self.bits << 1 | u128::from(level.bit());
            self.position += 1;
            if self.end == 0 && self.position == self.header() {
                self.end = self.position + 8 * self.data_bytes() + CRC_BITS;
            }
        }
        if self.position == self.end && !self.run.full() {
            Progress::CrcSequenceEnd
        } else {
            Progress::Within
        }
    }

    /// Whether the CRC sequence, once complete, agrees with the frame.
    pub fn crc_matches(&self) -> bool {
        self.crc.0 == 0
    }

    /// The frame, once the CRC sequence is complete.
    pub fn frame(&self) -> Frame {
        let base = self.field(1, 11) as u16;
        let id = if self.extended() {
            Id::Extended(u32::from(base) << 18 | self.field(14, 18) as u32)
        } else {
            Id::Standard(base)
        };
        let mut data = [0; 8];
        for (index, byte) in data.iter_mut().take(usize::from(self.data_bytes())).enumerate() {
            *byte = self.field(self.header() + 8 * index as u8, 8) as u8;
        }
        Frame { id, remote: self.remote(), dlc: self.dlc(), data }
    }

    fn field(&self, from: u8, width: u8) -> u64 {
        (self.bits >> (self.position - from - width)) as u64 & ((1 << width) - 1)
    }

    fn extended(&self) -> bool {
        self.position > IDE && self.field(IDE, 1) == 1
    }

    /// Bits before the data field: those of the base format until the IDE bit is known.
    fn header(&self) -> u8 {
        if self.extended() { EXTENDED_HEADER } else { BASE_HEADER }
    }

    fn remote(&self) -> bool {
        self.field(if self.extended() { 32 } else { 12 }, 1) == 1
    }

    fn dlc(&self) -> u8 {
        self.field(self.header() - 4, 4) as u8
    }

    fn data_bytes(&self) -> u8 {
        if self.remote() { 0 } else { self.dlc().min(8) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// xorshift64*: random enough for a test, and the same on every computer.
    fn random(state: &mut u64) -> u64 {
        *state ^= *state >> 12;
        *state ^= *state << 25;
        *state ^= *state >> 27;
        state.wrapping_mul(0x2545_F491_4F6C_DD1D)
    }

    fn crc(bits: &str) -> u16 {
        let mut crc = Crc::default();
        bits.bytes().filter(|b| *b != b' ').for_each(|b| crc.push(b == b'1'));
        crc.0
    }

    #[test]
    fn the_crc_has_the_catalogued_check_value() {
        // CRC-15/CAN in the catalogue of parametrised CRC algorithms: "123456789" gives 059e.
        let bits: String = b"123456789".iter().map(|byte| format!("{byte:08b}")).collect();
        assert_eq!(crc(&bits), 0x059E);
    }

    #[test]
    fn frames_have_the_length_that_long_division_gives() {
        let standard = |id, payload: &[u8]| Frame::data(Id::Standard(id), payload);
        for (frame, bits) in [
            (standard(0x7E5, &[4, 1, 0, 0, 0, 0, 0, 0]), 120),
            (standard(0x7E4, &[0x44, 0, 0, 0, 0, 0, 0, 0]), 121),
            (standard(0x705, &[0x7F]), 55),
            (standard(0x555, &[0x55; 8]), 109),
            // 34 dominant bits, as the CRC of zeros is zero, and a stuff bit after each five.
            (standard(0, &[]), 34 + 6 + 10),
            (Frame::remote(Id::Standard(0x123), 4), 44),
            (Frame::data(Id::Extended(0x7E5), &[]), 70),
            (Frame::data(Id::Extended(0x1FFF_FFFF), &[0xFF; 8]), 146),
        ] {
            assert_eq!(frame.wire_bits(), bits, "{frame}");
        }
    }

    #[test]
    fn a_decoder_returns_any_frame_and_none_is_longer_than_the_worst_case() {
        let seed = 0xD1B5_4A32_D192_ED03;
        println!("seed {seed:#x}");
        let mut state = seed;
        for _ in 0..40_000 {
            let frame = any_frame(&mut state);
            let stream = BitStream::new(&frame);
            let mut decoder = Decoder::default();
            let progress: Vec<Progress> =
                (0..stream.length).map(|index| decoder.push(stream.level(index))).collect();
            let end = progress.iter().position(|progress| *progress != Progress::Within);
            assert_eq!(end, Some(progress.len() - 1), "{frame}");
            assert_eq!(progress.last(), Some(&Progress::CrcSequenceEnd), "{frame}");
            assert!(decoder.crc_matches());
            assert_eq!(decoder.frame(), frame);

            // g + 8n + 13 + (g + 8n - 1) / 4 less the intermission of three, g = 34 and 54.
            let g = if matches!(frame.id, Id::Standard(_)) { 34 } else { 54 };
            let bits = g + 8 * frame.payload().len() as u32;
            let lengths = bits + 10..=bits + 10 + (bits - 1) / 4;
            assert!(lengths.contains(&frame.wire_bits()), "{frame}");
        }
    }

    #[test]
    fn a_single_wrong_bit_never_passes() {
        let frame = Frame::data(Id::Standard(0x7E4), &[0x44, 0, 0, 0, 0, 0, 0, 0]);
        let stream = BitStream::new(&frame);
        for wrong in 1..stream.length {
            let mut decoder = Decoder::default();
            let end = (0..stream.length).find_map(|index| {
                let level = Level::from_bit(stream.level(index).bit() != (index == wrong));
                Some(decoder.push(level)).filter(|progress| *progress != Progress::Within)
            });
            let passed = end == Some(Progress::CrcSequenceEnd) && decoder.crc_matches();
            assert!(!passed, "bit {wrong}");
        }
    }

    fn any_frame(state: &mut u64) -> Frame {
        let bits = random(state);
        let id = match bits & 1 {
            0 => Id::Standard((bits >> 8 & 0x7FF) as u16),
            _ => Id::Extended((bits >> 8 & 0x1FFF_FFFF) as u32),
        };
        let dlc = (bits >> 40 & 15) as u8;
        if bits >> 44 & 7 == 0 {
            return Frame::remote(id, dlc);
        }
        // Sparse and dense bytes, for many stuff bits.
        let data = random(state) & random(state);
        let data = if bits >> 48 & 1 == 0 { data } else { !data }.to_le_bytes();
        Frame::data(id, &data[..usize::from(dlc.min(8))]).with_dlc(dlc)
    }
}
