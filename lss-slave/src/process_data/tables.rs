//! The rows of process data in the object dictionary, as many as the node has.

use super::{MAX_PDOS, MAX_PRODUCERS, ProcessData, mapping::MAX_MAPPED};
use crate::{
    Application, NodeId,
    object_dictionary::{
        Access::{self, Const, ReadWrite},
        DataType::{self, Unsigned8, Unsigned16, Unsigned32},
        DefaultValue, Description, Entry, Number, Object, Options, PdoPart,
    },
};

pub(super) const SYNC_COB_ID: u16 = 0x1005;
pub(super) const CONSUMER_HEARTBEAT_TIME: u16 = 0x1016;
pub(super) const SYNC_COUNTER_OVERFLOW: u16 = 0x1019;
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

impl<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>
    ProcessData<TPDOS, RPDOS, PRODUCERS>
{
    const RPDO_PARAMETERS: [[Entry; 3]; RPDOS] = rows!(RPDOS, rpdo_parameter);
    const RPDO_MAPPINGS: [MappingRows; RPDOS] = rows!(RPDOS, rpdo_mapping);
    const TPDO_PARAMETERS: [[Entry; 6]; TPDOS] = rows!(TPDOS, tpdo_parameter);
    const TPDO_MAPPINGS: [MappingRows; TPDOS] = rows!(TPDOS, tpdo_mapping);
    const PRODUCER_ROWS: [Entry; MAX_PRODUCERS + 1] = {
        let highest = Object::HighestSubIndex(PRODUCERS as u8);
        let mut rows =
            [row(CONSUMER_HEARTBEAT_TIME, 0, Unsigned8, Const, highest); MAX_PRODUCERS + 1];
        let mut at = 1;
        while at <= MAX_PRODUCERS {
            let object = Object::ConsumerHeartbeatTime(at as u8);
            rows[at] = row(CONSUMER_HEARTBEAT_TIME, at as u8, Unsigned32, ReadWrite, object);
            at += 1;
        }
        rows
    };
    const SYNC_ROWS: [Entry; 2] = [
        row(SYNC_COB_ID, 0, Unsigned32, ReadWrite, Object::SyncCobId),
        row(SYNC_COUNTER_OVERFLOW, 0, Unsigned8, ReadWrite, Object::SyncCounterOverflow),
    ];

    /// The rows in ascending order, in tables that begin with a sub-index 0.
    const TABLES: [&'static [Entry]; 7] = [
        if Self::HAS_PDOS { Self::SYNC_ROWS.split_at(1).0 } else { &[] },
        if PRODUCERS > 0 { Self::PRODUCER_ROWS.split_at(PRODUCERS + 1).0 } else { &[] },
        if Self::HAS_PDOS { Self::SYNC_ROWS.split_at(1).1 } else { &[] },
        Self::RPDO_PARAMETERS.as_flattened(),
        Self::RPDO_MAPPINGS.as_flattened(),
        Self::TPDO_PARAMETERS.as_flattened(),
        Self::TPDO_MAPPINGS.as_flattened(),
    ];

    /// The table that has the object with this index.
    pub fn table(index: u16) -> Option<&'static [Entry]> {
        if !Self::IS_USED {
            return None;
        }
        let has_it = |table: &&[Entry]| {
            table.first().is_some_and(|first| first.index <= index)
                && table.last().is_some_and(|last| index <= last.index)
        };
        Self::TABLES.into_iter().find(has_it)
    }

    /// The rows in ascending order, with their descriptions. The defaults are those that the application declares.
    pub fn entries<A: Application>() -> impl Iterator<Item = (Entry, Description)> {
        let new = Self::new::<A>();
        let default = move |entry: &Entry| {
            let at = |node| new.read(entry.object, NodeId::new(node)).unwrap_or_default();
            match (at(1), at(2)) {
                (one, other) if one != other => DefaultValue::NodeIdPlus(one.wrapping_sub(1)),
                (same, _) => DefaultValue::Number(same),
            }
        };
        let describe = move |entry: &Entry| Description {
            object: object_name(entry),
            name: name(entry),
            default: match entry.object {
                Object::HighestSubIndex(_) => DefaultValue::Varies,
                _ => default(entry),
            },
            limits: limits(entry),
        };
        Self::TABLES.into_iter().flatten().map(move |entry| (*entry, describe(entry)))
    }
}

const fn row(
    index: u16,
    sub_index: u8,
    data_type: DataType,
    access: Access,
    object: Object,
) -> Entry {
    Entry { index, sub_index, data_type, access, options: Options::NONE, object }
}

const fn rpdo_parameter(at: usize) -> [Entry; 3] {
    let index = RPDO_PARAMETER + at as u16;
    [
        row(index, 0, Unsigned8, Const, Object::HighestSubIndex(2)),
        row(index, 1, Unsigned32, ReadWrite, Object::RpdoParameter(PdoPart::new(at, 1))),
        row(index, 2, Unsigned8, ReadWrite, Object::RpdoParameter(PdoPart::new(at, 2))),
    ]
}

const fn tpdo_parameter(at: usize) -> [Entry; 6] {
    let index = TPDO_PARAMETER + at as u16;
    [
        row(index, 0, Unsigned8, Const, Object::HighestSubIndex(6)),
        row(index, 1, Unsigned32, ReadWrite, Object::TpdoParameter(PdoPart::new(at, 1))),
        row(index, 2, Unsigned8, ReadWrite, Object::TpdoParameter(PdoPart::new(at, 2))),
        row(index, 3, Unsigned16, ReadWrite, Object::TpdoParameter(PdoPart::new(at, 3))),
        row(index, 5, Unsigned16, ReadWrite, Object::TpdoParameter(PdoPart::new(at, 5))),
        row(index, 6, Unsigned8, ReadWrite, Object::TpdoParameter(PdoPart::new(at, 6))),
    ]
}

const fn rpdo_mapping(at: usize) -> MappingRows {
    let index = RPDO_MAPPING + at as u16;
    let number = Object::RpdoMapping(PdoPart::new(at, 0));
    let mut rows = [row(index, 0, Unsigned8, ReadWrite, number); MAX_MAPPED + 1];
    let mut sub_index = 1;
    while sub_index <= MAX_MAPPED as u8 {
        let object = Object::RpdoMapping(PdoPart::new(at, sub_index));
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
        row.object = Object::TpdoMapping(PdoPart::new(at, sub_index));
        sub_index += 1;
    }
    rows
}

/// The name of an object with further sub-indices, at its sub-index 0.
const fn object_name(entry: &Entry) -> Option<&'static str> {
    const RPDOS: [&str; MAX_PDOS] = [
        "RPDO communication parameter 1",
        "RPDO communication parameter 2",
        "RPDO communication parameter 3",
        "RPDO communication parameter 4",
    ];
    const TPDOS: [&str; MAX_PDOS] = [
        "TPDO communication parameter 1",
        "TPDO communication parameter 2",
        "TPDO communication parameter 3",
        "TPDO communication parameter 4",
    ];
    const RPDO_MAPPINGS: [&str; MAX_PDOS] = [
        "RPDO mapping parameter 1",
        "RPDO mapping parameter 2",
        "RPDO mapping parameter 3",
        "RPDO mapping parameter 4",
    ];
    const TPDO_MAPPINGS: [&str; MAX_PDOS] = [
        "TPDO mapping parameter 1",
        "TPDO mapping parameter 2",
        "TPDO mapping parameter 3",
        "TPDO mapping parameter 4",
    ];
    let at = entry.index as usize % MAX_PDOS;
    match (entry.index, entry.sub_index) {
        (CONSUMER_HEARTBEAT_TIME, 0) => Some("Consumer heartbeat time"),
        (RPDO_PARAMETER..RPDO_MAPPING, 0) => Some(RPDOS[at]),
        (RPDO_MAPPING..TPDO_PARAMETER, 0) => Some(RPDO_MAPPINGS[at]),
        (TPDO_PARAMETER..TPDO_MAPPING, 0) => Some(TPDOS[at]),
        (TPDO_MAPPING.., 0) => Some(TPDO_MAPPINGS[at]),
        _ => None,
    }
}

/// The name of a value.
const fn name(entry: &Entry) -> &'static str {
    match (entry.index, entry.sub_index) {
        (SYNC_COB_ID, _) => "COB-ID SYNC",
        (SYNC_COUNTER_OVERFLOW, _) => "Synchronous counter overflow value",
        (RPDO_MAPPING..TPDO_PARAMETER, 0) | (TPDO_MAPPING.., 0) => "Number of mapped objects",
        (_, 0) => "Highest sub-index supported",
        (CONSUMER_HEARTBEAT_TIME, _) => "Consumer heartbeat time",
        (RPDO_PARAMETER..RPDO_MAPPING, 1) => "COB-ID used by RPDO",
        (TPDO_PARAMETER..TPDO_MAPPING, 1) => "COB-ID used by TPDO",
        (RPDO_PARAMETER..RPDO_MAPPING, _) | (TPDO_PARAMETER..TPDO_MAPPING, 2) => {
            "Transmission type"
        }
        (TPDO_PARAMETER..TPDO_MAPPING, 3) => "Inhibit time",
        (TPDO_PARAMETER..TPDO_MAPPING, 5) => "Event timer",
        (TPDO_PARAMETER..TPDO_MAPPING, _) => "SYNC start value",
        _ => "Application object",
    }
}

const fn limits(entry: &Entry) -> Option<(Number, Number)> {
    let highest = match entry.object {
        Object::SyncCounterOverflow => 240,
        Object::TpdoParameter(part) if part.sub_index() == 6 => 240,
        Object::RpdoMapping(part) | Object::TpdoMapping(part) if part.sub_index() == 0 => {
            MAX_MAPPED as i128
        }
        _ => return None,
    };
    Some((Number::Integer(0), Number::Integer(highest)))
}
