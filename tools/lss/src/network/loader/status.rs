//! The flash status 1F57h in words, and what to do.

use program_update::header::Field;

/// The status in words.
pub fn words(status: u32) -> String {
    let field = status >> 16;
    match status >> 1 & 0x7F {
        0 => "no error (1F57h)".into(),
        1 => "it has no valid program".into(),
        2 => field_words(field),
        3 if field == Field::Length as u32 => {
            "the program has another length than its header says".into()
        }
        3 if field == Field::Address as u32 => {
            "the program begins with no stack pointer and reset vector for this chip".into()
        }
        3 => "the program is damaged: its checksum is wrong. Make or copy the file again".into(),
        4 => "it was not cleared".into(),
        5 => "its flash cannot be erased or written. If it stays so, exchange the board".into(),
        6 => "the program is too long for it".into(),
        7 => "its flash is write-protected".into(),
        8 => "its supply is too low to write the flash".into(),
        9 => "its program has failed five times in a row".into(),
        other => format!("status {other} of 1F57h, which is not known"),
    }
}

/// Why a header is refused.
fn field_words(field: u32) -> String {
    let words = [
        (Field::Magic, "it does not begin as an update file"),
        (Field::HeaderCrc, "its header is damaged"),
        (Field::Rest, "its header is damaged"),
        (Field::Length, "it has no program of whole words"),
        (Field::Vendor, "it is for another product"),
        (Field::Product, "it is for another product"),
        (Field::Hardware, "it is for another hardware version"),
        (Field::Chip, "it is for another chip"),
        (Field::Controller, "it is for another CAN controller"),
        (Field::Address, "it is for another place in the flash"),
        (Field::Release, "its release is lower than the installed one"),
        (Field::Signature, "it is not signed with the key of this board"),
    ];
    match words.into_iter().find(|(other, _)| *other as u32 == field) {
        Some((_, words)) => words.into(),
        None => format!("the board does not accept byte {field} of its header"),
    }
}
