//! The checks of a declaration at compile time.

use crate::{
    declaration_error::DeclarationError,
    object_dictionary::{Access, Entry, Object, Options},
};

/// Checks the table of a product; panics, at compile time, with what is wrong.
pub const fn check(objects: &[Entry]) {
    if objects.len() > 256 {
        DeclarationError::new("there are more than 256 objects").raise();
    }
    let mut before = None;
    let mut rest = objects;
    while let [entry, others @ ..] = rest {
        if let Some(fault) = fault(entry, before) {
            fail(entry.index, entry.sub_index, fault);
        }
        before = Some(entry);
        rest = others;
    }
}

/// What is wrong with an entry that follows another.
const fn fault(entry: &Entry, before: Option<&Entry>) -> Option<&'static str> {
    if entry.index < 0x2001 || entry.index > 0x9FFF {
        return Some("its index must be 2001h to 9FFFh");
    }
    if entry.index == 0x2FF0 {
        return Some("this index is that of the node-ID and the bit rate: take another");
    }
    if entry.data_type.size() == 0 && entry.options.is_mappable() {
        return Some("only numbers can be mapped into a PDO: leave `mappable` out");
    }
    if entry.options.is_quiet() && !entry.options.is_mappable() {
        return Some("only a mappable object can be quiet: add `mappable`");
    }
    if entry.options.is_stored() {
        if entry.options.is_streamed() {
            return Some(
                "what is read and written in parts is not stored: its application keeps it",
            );
        }
        if matches!(entry.access, Access::Const) {
            return Some("a constant is not stored: leave `stored` out");
        }
    }
    let mut is_part = false;
    if let Some(before) = before {
        if before.index == entry.index && before.sub_index == entry.sub_index {
            return Some("it is declared twice");
        }
        if before.index > entry.index
            || before.index == entry.index && before.sub_index > entry.sub_index
        {
            return Some("objects must be sorted by index and sub-index");
        }
        let is_whole =
            before.sub_index == 0 && !matches!(before.object, Object::HighestSubIndex(_));
        is_part = before.index == entry.index && !is_whole;
    }
    if entry.sub_index != 0 && !is_part {
        return Some(
            "an object with sub-indices needs a name behind its index, and no sub-index 0, which is added",
        );
    }
    None
}

/// Ends the build with what is wrong with an object.
pub const fn fail(index: u16, sub_index: u8, fault: &str) -> ! {
    DeclarationError::of_object(index, sub_index).text(fault).raise()
}

/// Checks that a field has a value for each of its sub-indices: one, or the first and the last.
pub const fn check_count(index: u16, sub_indices: &[u8], count: u8) {
    let (first, last) = match *sub_indices {
        [first] => (first, first),
        [first, last, ..] => (first, last),
        [] => return,
    };
    if last < first || last - first + 1 != count {
        fail(
            index,
            first,
            "an array has a value for each of its sub-indices, such as 1..=4 and [f32; 4]",
        );
    }
}

/// Checks the methods that a field is declared `with`.
pub const fn check_methods(
    index: u16,
    sub_index: u8,
    options: Options,
    access: Access,
    methods: &[&str],
) {
    if !options.is_streamed() {
        fail(index, sub_index, "only a `Domain` or a `LongText` is declared `with` methods");
    }
    if methods.len() == 1 && !matches!(access, Access::Const | Access::ReadOnly) {
        fail(
            index,
            sub_index,
            "a client can write it, so it needs two methods: `with read and write`",
        );
    }
}
