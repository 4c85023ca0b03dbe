//! The CRC of block transfer (CiA 301, 7.2.4.3.16).

/// A CRC-16-CCITT in progress: polynomial x^16 + x^12 + x^5 + 1, initial value 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Crc(u16);

impl Crc {
    pub fn add(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            // Eight steps of the division at once; a table of 512 bytes would be twice as fast.
            let x = self.0 >> 8 ^ u16::from(byte);
            let x = x ^ x >> 4;
            self.0 = self.0 << 8 ^ x << 12 ^ x << 5 ^ x;
        }
    }

    pub const fn value(self) -> u16 {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_crc_of_the_example_in_cia_301_is_31c3() {
        let mut crc = Crc::default();
        crc.add(b"12345");
        crc.add(b"6789");
        assert_eq!(crc.value(), 0x31C3);
    }
}
