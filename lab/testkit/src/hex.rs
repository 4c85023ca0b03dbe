//! Intel HEX files, for those who write programs into chips.

/// The data bytes of a line.
const LINE: u32 = 16;

/// The content of the file for parts of the memory, each with its address, in order.
pub fn file(parts: &[(u32, &[u8])]) -> String {
    let mut text = String::new();
    let mut upper = None;
    for (start, bytes) in parts {
        let (mut address, mut rest) = (*start, *bytes);
        while !rest.is_empty() {
            let [high @ .., _, _] = address.to_be_bytes();
            if upper.replace(high) != Some(high) {
                text += &line(0, 4, &high);
            }
            let len = rest.len().min((LINE - address % LINE) as usize);
            let (data, after) = rest.split_at(len);
            text += &line(address as u16, 0, data);
            (rest, address) = (after, address + len as u32);
        }
    }
    text + &line(0, 1, &[])
}

/// A record of this kind.
fn line(offset: u16, kind: u8, data: &[u8]) -> String {
    let [high, low] = offset.to_be_bytes();
    let head = [data.len() as u8, high, low, kind];
    let bytes = head.iter().chain(data);
    let sum = bytes.clone().fold(0_u8, |sum, byte| sum.wrapping_add(*byte));
    let digits: String =
        bytes.chain(&[sum.wrapping_neg()]).map(|byte| format!("{byte:02X}")).collect();
    format!(":{digits}\n")
}

#[cfg(test)]
mod tests {
    #[test]
    fn a_hex_file_has_lines_of_16_bytes_and_the_upper_half_of_addresses() {
        let text = super::file(&[(0x0800_FFFC, &[1, 2, 3, 4, 5])]);
        let expected = [
            ":020000040800F2",
            ":04FFFC0001020304F7",
            ":020000040801F1",
            ":0100000005FA",
            ":00000001FF",
        ];
        assert_eq!(text.lines().collect::<Vec<_>>(), expected);
    }
}
