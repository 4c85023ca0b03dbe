//! The messages of a client that transfers a value by SDO and does not wait for the answers.

/// Index and sub-index.
pub type Address = (u16, u8);

/// A message with an address.
pub fn initiate(command: u8, (index, sub_index): Address, number: u32) -> [u8; 8] {
    let ([i0, i1], [n0, n1, n2, n3]) = (index.to_le_bytes(), number.to_le_bytes());
    [command, i0, i1, sub_index, n0, n1, n2, n3]
}

/// An expedited download of one to four bytes.
pub fn expedited(address: Address, data: &[u8]) -> [u8; 8] {
    let mut message = initiate(0x23 | (4 - data.len() as u8) << 2, address, 0);
    message[4..][..data.len()].copy_from_slice(data);
    message
}

/// A download in segments, at least one.
pub fn download(address: Address, data: &[u8]) -> Vec<[u8; 8]> {
    let empty = data.is_empty().then_some(&[][..]);
    let parts: Vec<&[u8]> = data.chunks(7).chain(empty).collect();
    let segments = parts.iter().enumerate().map(|(number, part)| {
        let toggle = (number as u8 & 1) << 4;
        let is_last = number + 1 == parts.len();
        segment(toggle | (7 - part.len() as u8) << 1 | u8::from(is_last), part)
    });
    [initiate(0x21, address, data.len() as u32)].into_iter().chain(segments).collect()
}

/// An upload of this number of segments.
pub fn upload(address: Address, segments: u8) -> Vec<[u8; 8]> {
    let requests = (0..segments).map(|number| segment(0x60 | (number & 1) << 4, &[]));
    [initiate(0x40, address, 0)].into_iter().chain(requests).collect()
}

/// A block download of a value that fits one block.
pub fn block_download(address: Address, data: &[u8]) -> Vec<[u8; 8]> {
    let last = data.chunks(7).count();
    let segments = data
        .chunks(7)
        .zip(1..)
        .map(|(part, number)| segment(number as u8 | if number == last { 0x80 } else { 0 }, part));
    let unused = (last * 7 - data.len()) as u8;
    let end = segment(0xC1 | unused << 2, &crc(data).to_le_bytes());
    let begin = initiate(0xC6, address, data.len() as u32);
    [begin].into_iter().chain(segments).chain([end]).collect()
}

/// A block upload of this number of blocks, all but the last complete.
pub fn block_upload(
    address: Address,
    block_size: u8,
    blocks: u8,
    in_last_block: u8,
) -> Vec<[u8; 8]> {
    let mut messages = vec![initiate(0xA4, address, block_size.into()), segment(0xA3, &[])];
    let confirmations = (1..blocks).map(|_| segment(0xA2, &[block_size, block_size]));
    messages.extend(confirmations);
    messages.extend([segment(0xA2, &[in_last_block, block_size]), segment(0xA1, &[])]);
    messages
}

/// A message without an address.
pub fn segment(command: u8, data: &[u8]) -> [u8; 8] {
    let mut message = [command, 0, 0, 0, 0, 0, 0, 0];
    message[1..][..data.len()].copy_from_slice(data);
    message
}

/// The CRC of block transfer, bit by bit (CiA 301, 7.2.4.3.16).
pub fn crc(data: &[u8]) -> u16 {
    let mut crc = 0;
    for byte in data {
        crc ^= u16::from(*byte) << 8;
        for _ in 0..8 {
            crc = crc << 1 ^ if crc >> 15 == 1 { 0x1021 } else { 0 };
        }
    }
    crc
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_crc_of_the_digits_is_the_usual_check_value() {
        assert_eq!(super::crc(b"123456789"), 0x31C3);
    }
}
