//! The rows of PDOs in the object dictionary, as many as the node has.

use super::mapping::MAX_MAPPED;
use crate::{
    object_dictionary::{
        Access::{Const, ReadWrite},
        DataType::{Unsigned8, Unsigned16, Unsigned32},
        DefaultValue, Description, Entry, Name, Number, Object, PdoEntry, row,
    },
    sync,
};

pub(super) const RPDO_PARAMETER: u16 = 0x1400;
pub(super) const RPDO_MAPPING: u16 = 0x1600;
pub(super) const TPDO_PARAMETER: u16 = 0x1800;
pub(super) const TPDO_MAPPING: u16 = 0x1A00;

type MappingRows = [Entry; MAX_MAPPED + 1];

/// The rows of each of a number of PDOs, at compile time.
macro_rules! rows {
    ($number:expr, $of:ident) => {{
        let mut all = [$of(0); $number];
        let mut at = 0;
        while at < $number {
            all[at] = $of(at);
            at += 1;
        }
        all
    }};
}

/// The rows of these numbers of PDOs.
pub struct Tables<const TPDOS: usize, const RPDOS: usize>;

impl<const TPDOS: usize, const RPDOS: usize> Tables<TPDOS, RPDOS> {
    const RPDO_PARAMETERS: [[Entry; 4]; RPDOS] = rows!(RPDOS, rpdo_parameter);
    const RPDO_MAPPINGS: [MappingRows; RPDOS] = rows!(RPDOS, rpdo_mapping);
    const TPDO_PARAMETERS: [[Entry; 6]; TPDOS] = rows!(TPDOS, tpdo_parameter);
    const TPDO_MAPPINGS: [MappingRows; TPDOS] = rows!(TPDOS, tpdo_mapping);

    /// The rows in ascending order, in tables that begin with a sub-index 0: 1005h to 1007h, 1019h, and those of RPDOs and TPDOs.
    pub const ALL: [&'static [Entry]; 6] = [
        if TPDOS + RPDOS > 0 { sync::ROWS } else { &[] },
        if TPDOS + RPDOS > 0 { sync::COUNTER_OVERFLOW_ROW } else { &[] },
        Self::RPDO_PARAMETERS.as_flattened(),
        Self::RPDO_MAPPINGS.as_flattened(),
        Self::TPDO_PARAMETERS.as_flattened(),
        Self::TPDO_MAPPINGS.as_flattened(),
    ];
}

/// The description of a row of a PDO.
pub fn describe(entry: &Entry, default: DefaultValue) -> Description {
    Description {
        object: object_name(entry),
        name: name(entry).into(),
        default,
        limits: limits(entry),
    }
}

const fn rpdo_parameter(at: usize) -> [Entry; 4] {
    let index = RPDO_PARAMETER + at as u16;
    [
        row(index, 0, Unsigned8, Const, Object::HighestSubIndex(5)),
        row(index, 1, Unsigned32, ReadWrite, Object::RpdoParameter(PdoEntry::new(at, 1))),
        row(index, 2, Unsigned8, ReadWrite, Object::RpdoParameter(PdoEntry::new(at, 2))),
        row(index, 5, Unsigned16, ReadWrite, Object::RpdoParameter(PdoEntry::new(at, 5))).stored(),
    ]
}

const fn tpdo_parameter(at: usize) -> [Entry; 6] {
    let index = TPDO_PARAMETER + at as u16;
    [
        row(index, 0, Unsigned8, Const, Object::HighestSubIndex(6)),
        row(index, 1, Unsigned32, ReadWrite, Object::TpdoParameter(PdoEntry::new(at, 1))),
        row(index, 2, Unsigned8, ReadWrite, Object::TpdoParameter(PdoEntry::new(at, 2))),
        row(index, 3, Unsigned16, ReadWrite, Object::TpdoParameter(PdoEntry::new(at, 3))),
        row(index, 5, Unsigned16, ReadWrite, Object::TpdoParameter(PdoEntry::new(at, 5))),
        row(index, 6, Unsigned8, ReadWrite, Object::TpdoParameter(PdoEntry::new(at, 6))),
    ]
}

const fn rpdo_mapping(at: usize) -> MappingRows {
    let index = RPDO_MAPPING + at as u16;
    let number = Object::RpdoMapping(PdoEntry::new(at, 0));
    let mut rows = [row(index, 0, Unsigned8, ReadWrite, number); MAX_MAPPED + 1];
    let mut sub_index = 1;
    while sub_index <= MAX_MAPPED as u8 {
        let object = Object::RpdoMapping(PdoEntry::new(at, sub_index));
        rows[sub_index as usize] = row(index, sub_index, Unsigned32, ReadWrite, object);
        sub_index += 1;
    }
    rows
}

const fn tpdo_mapping(at: usize) -> MappingRows {
    let mut rows = rpdo_mapping(at);
    let mut sub_index = 0;
    while sub_index <= MAX_MAPPED as u8 {
        let row = &mut rows[sub_index as usize];
        row.index = TPDO_MAPPING + at as u16;
        row.object = Object::TpdoMapping(PdoEntry::new(at, sub_index));
        sub_index += 1;
    }
    rows
}

/// The name of an object with further sub-indices, at its sub-index 0.
fn object_name(entry: &Entry) -> Option<Name> {
    let (text, first) = match (entry.index, entry.sub_index) {
        (RPDO_PARAMETER..RPDO_MAPPING, 0) => ("RPDO communication parameter", RPDO_PARAMETER),
        (RPDO_MAPPING..TPDO_PARAMETER, 0) => ("RPDO mapping parameter", RPDO_MAPPING),
        (TPDO_PARAMETER..TPDO_MAPPING, 0) => ("TPDO communication parameter", TPDO_PARAMETER),
        (TPDO_MAPPING.., 0) => ("TPDO mapping parameter", TPDO_MAPPING),
        _ => return None,
    };
    Some(Name { text, number: Some((entry.index - first) as u8 + 1) })
}

/// The name of a value.
const fn name(entry: &Entry) -> &'static str {
    match (entry.index, entry.sub_index) {
        (RPDO_MAPPING..TPDO_PARAMETER, 0) | (TPDO_MAPPING.., 0) => "Number of mapped objects",
        (_, 0) => "Highest sub-index supported",
        (RPDO_PARAMETER..RPDO_MAPPING, 1) => "COB-ID used by RPDO",
        (TPDO_PARAMETER..TPDO_MAPPING, 1) => "COB-ID used by TPDO",
        (RPDO_PARAMETER..RPDO_MAPPING | TPDO_PARAMETER..TPDO_MAPPING, 2) => "Transmission type",
        (RPDO_PARAMETER..RPDO_MAPPING | TPDO_PARAMETER..TPDO_MAPPING, 5) => "Event timer",
        (TPDO_PARAMETER..TPDO_MAPPING, 3) => "Inhibit time",
        (TPDO_PARAMETER..TPDO_MAPPING, _) => "SYNC start value",
        _ => "Application object",
    }
}

const fn limits(entry: &Entry) -> Option<(Number, Number)> {
    let highest = match entry.object {
        Object::TpdoParameter(part) if part.sub_index() == 6 => 240,
        Object::RpdoMapping(part) | Object::TpdoMapping(part) if part.sub_index() == 0 => {
            MAX_MAPPED as i128
        }
        _ => return None,
    };
    Some((Number::Integer(0), Number::Integer(highest)))
}
