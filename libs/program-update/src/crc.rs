//! CRC-32 as in zlib, without a table of a kilobyte.

/// The value with which a CRC begins.
pub const BEGIN: u32 = u32::MAX;

/// The rest of each half-byte.
const TABLE: [u32; 16] = {
    let mut table = [0; 16];
    let mut i = 0;
    while i < 16 {
        let mut rest = i as u32;
        let mut bit = 0;
        while bit < 4 {
            rest = if rest & 1 == 1 { rest >> 1 ^ 0xEDB8_8320 } else { rest >> 1 };
            bit += 1;
        }
        table[i] = rest;
        i += 1;
    }
    table
};

/// The CRC after more bytes. The first `crc` is [`BEGIN`]; the inverse of the last one is the CRC-32.
#[must_use]
pub fn more(crc: u32, bytes: &[u8]) -> u32 {
    bytes.iter().fold(crc, |crc, byte| {
        let crc = crc ^ u32::from(*byte);
        let crc = crc >> 4 ^ TABLE[(crc & 15) as usize];
        crc >> 4 ^ TABLE[(crc & 15) as usize]
    })
}

/// The CRC-32 of bytes, such as the 1009h text of a product.
#[must_use]
pub fn of(bytes: &[u8]) -> u32 {
    !more(BEGIN, bytes)
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_crc_is_that_of_zlib() {
        assert_eq!(super::of(b"123456789"), 0xCBF4_3926);
    }
}
