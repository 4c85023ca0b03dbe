//! The object dictionary: the table of all objects that are accessible by SDO (CiA 301, 7.5).

/// An object of the node, or a part of one.
///
/// To add an object, name it here, give it a row in [`TABLE`], and handle its reads (and writes) in `node::objects`.
/// Then add it to the EDS, which a test compares with the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[expect(missing_docs, reason = "the names are those of CiA 301")]
pub enum Object {
    DeviceType,
    ErrorRegister,
    NumberOfErrors,
    /// The error history's entry at this sub-index: 1 is the newest.
    ErrorField(u8),
    DeviceName,
    HardwareVersion,
    SoftwareVersion,
    StoreParameters,
    RestoreDefaultParameters,
    CobIdEmergency,
    ProducerHeartbeatTime,
    /// The effect of a communication error on the NMT state.
    CommunicationErrorBehaviour,
    VendorId,
    ProductCode,
    RevisionNumber,
    SerialNumber,
    /// The number of recoveries from bus-off since the start.
    BusOffs,
    /// The number of times received frames were lost since the start.
    Overruns,
    /// TEC of the controller (ISO 11898-1).
    TransmitErrorCounter,
    /// REC of the controller (ISO 11898-1).
    ReceiveErrorCounter,
    /// The commanded bit rate in kbit/s: stored at power-on, or activated since. 0 during automatic detection.
    HomeBitRate,
    /// The bit rate in use, in kbit/s.
    BitRateInUse,
    /// The number of times since the start that the node has joined the others at another bit rate.
    Rescues,
    /// Sub-index 0 of an object: the number of its further sub-indices.
    HighestSubIndex(u8),
    /// The COB-ID of requests to the SDO server.
    CobIdSdoRequest,
    /// The COB-ID of answers of the SDO server.
    CobIdSdoResponse,
    /// The value of an application with this number.
    Application(u8),
}

/// A CiA 301 data type; the value is its index in the dictionary, as an EDS names it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u8)]
#[expect(missing_docs, reason = "the names are those of CiA 301")]
pub enum DataType {
    Boolean = 0x01,
    Integer8 = 0x02,
    Integer16 = 0x03,
    Integer32 = 0x04,
    Unsigned8 = 0x05,
    Unsigned16 = 0x06,
    Unsigned32 = 0x07,
    Real32 = 0x08,
    VisibleString = 0x09,
    OctetString = 0x0A,
    Domain = 0x0F,
    Real64 = 0x11,
    Integer64 = 0x15,
    Unsigned64 = 0x1B,
}

impl DataType {
    /// The size of a number of this type in bytes; 0 for a string or a domain.
    pub const fn size(self) -> u8 {
        match self {
            Self::Boolean | Self::Integer8 | Self::Unsigned8 => 1,
            Self::Integer16 | Self::Unsigned16 => 2,
            Self::Integer32 | Self::Unsigned32 | Self::Real32 => 4,
            Self::Integer64 | Self::Unsigned64 | Self::Real64 => 8,
            Self::VisibleString | Self::OctetString | Self::Domain => 0,
        }
    }
}

impl Entry {
    /// The size of the number at this row of [`TABLE`], whose numbers are unsigned: [`DataType::size`] in less code.
    pub(crate) const fn own_size(&self) -> u8 {
        1 << ((self.data_type as u8 & 3).wrapping_sub(1) & 3)
    }
}

/// The access that a client has to an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[expect(missing_docs, reason = "the names are those of CiA 306")]
pub enum Access {
    Const,
    ReadOnly,
    ReadWrite,
    WriteOnly,
}

/// The properties of an object beside its access.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Options(u8);

impl Options {
    /// Neither mappable nor stored.
    pub const NONE: Self = Self(0);
    const MAPPABLE: u8 = 1;
    const STORED: u8 = 2;

    /// Adds that the object can be mapped into a PDO.
    #[must_use]
    pub const fn mappable(self) -> Self {
        Self(self.0 | Self::MAPPABLE)
    }

    /// Adds that 1010h stores the value.
    #[must_use]
    pub const fn stored(self) -> Self {
        Self(self.0 | Self::STORED)
    }

    /// Whether the object can be mapped into a PDO.
    pub const fn is_mappable(self) -> bool {
        self.0 & Self::MAPPABLE != 0
    }

    /// Whether 1010h stores the value.
    pub const fn is_stored(self) -> bool {
        self.0 & Self::STORED != 0
    }
}

/// A row of the table.
#[derive(Clone, Copy, Debug)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[expect(missing_docs, reason = "the names say it")]
pub struct Entry {
    pub index: u16,
    pub sub_index: u8,
    pub data_type: DataType,
    pub access: Access,
    pub options: Options,
    pub object: Object,
}

/// All objects, by index and sub-index.
pub const TABLE: &[Entry] = &{
    use Access::*;
    use DataType::*;
    use Object::*;
    [
        row(0x1000, 0, Unsigned32, Const, DeviceType),
        row(0x1001, 0, Unsigned8, ReadOnly, ErrorRegister),
        row(0x1003, 0, Unsigned8, ReadWrite, NumberOfErrors),
        row(0x1003, 1, Unsigned32, ReadOnly, ErrorField(1)),
        row(0x1003, 2, Unsigned32, ReadOnly, ErrorField(2)),
        row(0x1003, 3, Unsigned32, ReadOnly, ErrorField(3)),
        row(0x1003, 4, Unsigned32, ReadOnly, ErrorField(4)),
        row(0x1003, 5, Unsigned32, ReadOnly, ErrorField(5)),
        row(0x1003, 6, Unsigned32, ReadOnly, ErrorField(6)),
        row(0x1003, 7, Unsigned32, ReadOnly, ErrorField(7)),
        row(0x1003, 8, Unsigned32, ReadOnly, ErrorField(8)),
        row(0x1008, 0, VisibleString, Const, DeviceName),
        row(0x1009, 0, VisibleString, Const, HardwareVersion),
        row(0x100A, 0, VisibleString, Const, SoftwareVersion),
        row(0x1010, 0, Unsigned8, Const, HighestSubIndex(1)),
        row(0x1010, 1, Unsigned32, ReadWrite, StoreParameters),
        row(0x1011, 0, Unsigned8, Const, HighestSubIndex(1)),
        row(0x1011, 1, Unsigned32, ReadWrite, RestoreDefaultParameters),
        row(0x1014, 0, Unsigned32, ReadOnly, CobIdEmergency),
        row(0x1017, 0, Unsigned16, ReadWrite, ProducerHeartbeatTime),
        row(0x1018, 0, Unsigned8, Const, HighestSubIndex(4)),
        row(0x1018, 1, Unsigned32, Const, VendorId),
        row(0x1018, 2, Unsigned32, Const, ProductCode),
        row(0x1018, 3, Unsigned32, Const, RevisionNumber),
        row(0x1018, 4, Unsigned32, Const, SerialNumber),
        row(0x1029, 0, Unsigned8, Const, HighestSubIndex(1)),
        row(0x1029, 1, Unsigned8, ReadWrite, CommunicationErrorBehaviour),
        row(0x2000, 0, Unsigned8, Const, HighestSubIndex(7)),
        row(0x2000, 1, Unsigned16, ReadOnly, BusOffs),
        row(0x2000, 2, Unsigned16, ReadOnly, Overruns),
        row(0x2000, 3, Unsigned8, ReadOnly, TransmitErrorCounter),
        row(0x2000, 4, Unsigned8, ReadOnly, ReceiveErrorCounter),
        row(0x2000, 5, Unsigned16, ReadOnly, HomeBitRate),
        row(0x2000, 6, Unsigned16, ReadOnly, BitRateInUse),
        row(0x2000, 7, Unsigned16, ReadOnly, Rescues),
    ]
};

/// The SDO server parameter, which a node with an application has beside [`TABLE`].
pub const SDO_SERVER: &[Entry] = &{
    use Access::*;
    use DataType::*;
    use Object::*;
    [
        row(0x1200, 0, Unsigned8, Const, HighestSubIndex(2)),
        row(0x1200, 1, Unsigned32, ReadOnly, CobIdSdoRequest),
        row(0x1200, 2, Unsigned32, ReadOnly, CobIdSdoResponse),
    ]
};

const fn row(
    index: u16,
    sub_index: u8,
    data_type: DataType,
    access: Access,
    object: Object,
) -> Entry {
    Entry { index, sub_index, data_type, access, options: Options::NONE, object }
}

/// The row of an object in `table`, or the part of its address that does not exist.
pub(crate) fn find(
    table: &'static [Entry],
    index: u16,
    sub_index: u8,
) -> Result<&'static Entry, Missing> {
    let is_at_or_before = |entry: &Entry| (entry.index, entry.sub_index) <= (index, sub_index);
    let last = table.partition_point(is_at_or_before).wrapping_sub(1);
    // Each object has a sub-index 0, so this row belongs to the object if it exists.
    match table.get(last) {
        Some(entry) if entry.index != index => Err(Missing::Object),
        Some(entry) if entry.sub_index != sub_index => Err(Missing::SubIndex),
        Some(entry) => Ok(entry),
        None => Err(Missing::Object),
    }
}

/// The part of a dictionary address that does not exist.
pub(crate) enum Missing {
    Object,
    SubIndex,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_size_of_an_own_number_is_that_of_its_type() {
        for entry in TABLE.iter().filter(|entry| entry.data_type != DataType::VisibleString) {
            assert_eq!(entry.own_size(), entry.data_type.size(), "{:X}h", entry.index);
        }
    }
}
