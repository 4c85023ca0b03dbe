//! The object dictionary: the table of the node's own objects that are accessible by SDO (CiA 301, 7.5).

mod description;

pub use description::{DefaultValue, Description, Name, Number};

use crate::Device;

/// An object of the node, or a part of one.
///
/// To add an object, name it here, declare it in the table, and handle its reads (and writes) in `node::objects`. The
/// objects of a product are declared by [`objects!`](crate::objects) instead.
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
    InhibitTimeEmergency,
    ProducerHeartbeatTime,
    /// The effect of a communication error on the NMT state.
    CommunicationErrorBehaviour,
    /// Date (1) or time (2) of the configuration.
    VerifyConfiguration(u8),
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
    /// Why the device was reset before the start; 0 if the firmware has not failed.
    RestartCause,
    /// Where it has failed.
    RestartAddress,
    /// Sub-index 0 of an object: the number of its further sub-indices.
    HighestSubIndex(u8),
    /// The COB-ID of requests to the SDO server.
    CobIdSdoRequest,
    /// The COB-ID of answers of the SDO server.
    CobIdSdoResponse,
    /// The value of an application with this number.
    Application(u8),
    /// A value that an RPDO leaves out.
    Dummy,
    /// The node-ID that the next reset communication activates.
    PendingNodeId,
    /// The bit rate in kbit/s that is to be stored. 0 is automatic detection.
    PendingBitRate,
    SyncCobId,
    CommunicationCyclePeriod,
    SynchronousWindowLength,
    SyncCounterOverflow,
    /// The entry of the heartbeat consumer at this sub-index.
    ConsumerHeartbeatTime(u8),
    RpdoParameter(PdoEntry),
    RpdoMapping(PdoEntry),
    TpdoParameter(PdoEntry),
    TpdoMapping(PdoEntry),
}

/// A sub-index of the parameters or the mapping of a PDO.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct PdoEntry(u8);

impl PdoEntry {
    pub(crate) const fn new(at: usize, sub_index: u8) -> Self {
        Self((at as u8) << 4 | sub_index & 0xF)
    }

    /// The number of the PDO, from 0.
    pub(crate) const fn at(self) -> usize {
        (self.0 >> 4) as usize
    }

    /// The sub-index.
    pub const fn sub_index(self) -> u8 {
        self.0 & 0xF
    }
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
    Integer24 = 0x10,
    Real64 = 0x11,
    Integer40 = 0x12,
    Integer48 = 0x13,
    Integer56 = 0x14,
    Integer64 = 0x15,
    Unsigned24 = 0x16,
    Unsigned40 = 0x18,
    Unsigned48 = 0x19,
    Unsigned56 = 0x1A,
    Unsigned64 = 0x1B,
}

impl DataType {
    /// The size of a number of this type in bytes; 0 for a string or a domain.
    pub const fn size(self) -> u8 {
        /// By the number of the type.
        const SIZES: [u8; 32] = {
            let mut sizes = [0; 32];
            let numbers: [&[DataType]; 8] = [
                &[DataType::Boolean, DataType::Integer8, DataType::Unsigned8],
                &[DataType::Integer16, DataType::Unsigned16],
                &[DataType::Integer24, DataType::Unsigned24],
                &[DataType::Integer32, DataType::Unsigned32, DataType::Real32],
                &[DataType::Integer40, DataType::Unsigned40],
                &[DataType::Integer48, DataType::Unsigned48],
                &[DataType::Integer56, DataType::Unsigned56],
                &[DataType::Integer64, DataType::Unsigned64, DataType::Real64],
            ];
            let mut of_size = 0;
            while of_size < numbers.len() {
                let mut at = 0;
                while at < numbers[of_size].len() {
                    sizes[numbers[of_size][at] as usize] = of_size as u8 + 1;
                    at += 1;
                }
                of_size += 1;
            }
            sizes
        };
        SIZES[self as usize & 31]
    }

    /// Whether integers of this type reach from `low` to `high`; true for any other type.
    #[doc(hidden)]
    pub const fn reaches(self, low: i128, high: i128) -> bool {
        let numbers = 1_i128 << (8 * self.size() as u32);
        let lowest = match self {
            Self::Integer8 | Self::Integer16 | Self::Integer24 | Self::Integer32 => -numbers / 2,
            Self::Integer40 | Self::Integer48 | Self::Integer56 | Self::Integer64 => -numbers / 2,
            Self::Unsigned8 | Self::Unsigned16 | Self::Unsigned24 | Self::Unsigned32 => 0,
            Self::Unsigned40 | Self::Unsigned48 | Self::Unsigned56 | Self::Unsigned64 => 0,
            _ => return true,
        };
        lowest <= low && high < lowest + numbers
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
    /// `rwr`: a process input, which a TPDO can carry and no RPDO.
    ReadWriteInput,
    /// `rww`: a process output, which an RPDO can carry and no TPDO.
    ReadWriteOutput,
    WriteOnly,
}

/// The properties of an object beside its access.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Options(u8);

impl Options {
    /// None of them.
    pub const NONE: Self = Self(0);
    const MAPPABLE: u8 = 1;
    const STORED: u8 = 2;
    const QUIET: u8 = 4;
    const STREAMED: u8 = 8;

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

    /// Adds that a change of the object alone sends no TPDO.
    #[must_use]
    pub const fn quiet(self) -> Self {
        Self(self.0 | Self::QUIET)
    }

    /// Adds that the application reads and writes the object in parts.
    #[must_use]
    pub(crate) const fn streamed(self) -> Self {
        Self(self.0 | Self::STREAMED)
    }

    /// Adds others.
    #[doc(hidden)]
    #[must_use]
    pub const fn and(self, others: Self) -> Self {
        Self(self.0 | others.0)
    }

    /// Whether the object can be mapped into a PDO.
    pub const fn is_mappable(self) -> bool {
        self.0 & Self::MAPPABLE != 0
    }

    /// Whether 1010h stores the value.
    pub const fn is_stored(self) -> bool {
        self.0 & Self::STORED != 0
    }

    /// Whether the application reads and writes the object in parts.
    pub const fn is_streamed(self) -> bool {
        self.0 & Self::STREAMED != 0
    }

    /// Whether a change of the object alone sends no TPDO.
    pub const fn is_quiet(self) -> bool {
        self.0 & Self::QUIET != 0
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

/// A row without options.
pub(crate) const fn row(
    index: u16,
    sub_index: u8,
    data_type: DataType,
    access: Access,
    object: Object,
) -> Entry {
    Entry { index, sub_index, data_type, access, options: Options::NONE, object }
}

impl Entry {
    /// The same row, with a value that 1010h stores.
    pub(crate) const fn stored(self) -> Self {
        Self { options: self.options.stored(), ..self }
    }
}

/// Declares the table of the node's objects, and a function that describes them. A row has a sub-index, a name, for
/// sub-index 0 the name `of` an object with further sub-indices, a data type, an access, `stored` if 1010h stores the
/// value, the [`Object`], and optionally its default and its limits.
macro_rules! table {
    ($device:ident: $($index:literal {
        $(
            $sub_index:literal $name:literal $(of $object_name:literal)?
            : $data_type:ident, $access:ident $($option:ident)?, $object:ident $(($part:literal))?
            $(= $default:ident($value:expr))? $(, $low:literal ..= $high:literal)?;
        )+
    })*) => {
        /// The node's own objects, by index and sub-index.
        pub(crate) const TABLE: &[Entry] = &[$($(
            Entry {
                index: $index,
                sub_index: $sub_index,
                data_type: DataType::$data_type,
                access: Access::$access,
                options: Options::NONE$(.$option())?,
                object: Object::$object $(($part))?,
            },
        )+)*];

        /// The descriptions of the rows of [`TABLE`], in the same order. The image does not contain them.
        pub(crate) fn descriptions($device: &Device) -> impl Iterator<Item = Description> + use<> {
            [$($(
                Description {
                    object: table!(@option $(Name::from($object_name))?),
                    name: $name.into(),
                    default: table!(@default $($default($value))?),
                    limits: table!(@option $((Number::Integer($low), Number::Integer($high)))?),
                },
            )+)*]
            .into_iter()
        }
    };
    (@option) => { None };
    (@option $value:expr) => { Some($value) };
    (@default) => { DefaultValue::Varies };
    (@default $default:ident($value:expr)) => { DefaultValue::$default($value) };
}

table! {
    device:

    0x1000 {
        0 "Device type": Unsigned32, Const, DeviceType;
    }
    0x1001 {
        0 "Error register": Unsigned8, ReadOnly, ErrorRegister = Number(0);
    }
    0x1003 {
        0 "Number of errors" of "Pre-defined error field": Unsigned8, ReadWrite, NumberOfErrors = Number(0);
        1 "Standard error field 1": Unsigned32, ReadOnly, ErrorField(1);
        2 "Standard error field 2": Unsigned32, ReadOnly, ErrorField(2);
        3 "Standard error field 3": Unsigned32, ReadOnly, ErrorField(3);
        4 "Standard error field 4": Unsigned32, ReadOnly, ErrorField(4);
        5 "Standard error field 5": Unsigned32, ReadOnly, ErrorField(5);
        6 "Standard error field 6": Unsigned32, ReadOnly, ErrorField(6);
        7 "Standard error field 7": Unsigned32, ReadOnly, ErrorField(7);
        8 "Standard error field 8": Unsigned32, ReadOnly, ErrorField(8);
    }
    0x1008 {
        0 "Manufacturer device name": VisibleString, Const, DeviceName = Text(device.name);
    }
    0x1009 {
        0 "Manufacturer hardware version": VisibleString, Const, HardwareVersion = Text(device.hardware_version);
    }
    0x100A {
        0 "Manufacturer software version": VisibleString, Const, SoftwareVersion = Text(device.software_version);
    }
    0x1010 {
        0 "Highest sub-index supported" of "Store parameters": Unsigned8, Const, HighestSubIndex(3);
        1 "Save all parameters": Unsigned32, ReadWrite, StoreParameters = Number(1);
        2 "Save communication parameters": Unsigned32, ReadWrite, StoreParameters = Number(1);
        3 "Save application parameters": Unsigned32, ReadWrite, StoreParameters = Number(1);
    }
    0x1011 {
        0 "Highest sub-index supported" of "Restore default parameters": Unsigned8, Const, HighestSubIndex(3);
        1 "Restore all default parameters": Unsigned32, ReadWrite, RestoreDefaultParameters = Number(1);
        2 "Restore communication default parameters": Unsigned32, ReadWrite, RestoreDefaultParameters = Number(1);
        3 "Restore application default parameters": Unsigned32, ReadWrite, RestoreDefaultParameters = Number(1);
    }
    0x1014 {
        0 "COB-ID EMCY": Unsigned32, ReadWrite stored, CobIdEmergency = NodeIdPlus(0x80);
    }
    0x1015 {
        0 "Inhibit time EMCY": Unsigned16, ReadWrite stored, InhibitTimeEmergency = Number(0);
    }
    0x1017 {
        0 "Producer heartbeat time": Unsigned16, ReadWrite stored, ProducerHeartbeatTime
            = Number(device.heartbeat_ms.into());
    }
    0x1018 {
        0 "Highest sub-index supported" of "Identity object": Unsigned8, Const, HighestSubIndex(4);
        1 "Vendor-ID": Unsigned32, Const, VendorId = Number(device.address.vendor_id);
        2 "Product code": Unsigned32, Const, ProductCode = Number(device.address.product_code);
        3 "Revision number": Unsigned32, Const, RevisionNumber = Number(device.address.revision_number);
        4 "Serial number": Unsigned32, Const, SerialNumber;
    }
    0x1020 {
        0 "Highest sub-index supported" of "Verify configuration": Unsigned8, Const, HighestSubIndex(2);
        1 "Configuration date": Unsigned32, ReadWrite stored, VerifyConfiguration(1) = Number(0);
        2 "Configuration time": Unsigned32, ReadWrite stored, VerifyConfiguration(2) = Number(0);
    }
    0x1029 {
        0 "Highest sub-index supported" of "Error behaviour": Unsigned8, Const, HighestSubIndex(1);
        1 "Communication error": Unsigned8, ReadWrite stored, CommunicationErrorBehaviour = Number(0), 0..=2;
    }
    0x1200 {
        0 "Highest sub-index supported" of "SDO server parameter": Unsigned8, Const, HighestSubIndex(2);
        1 "COB-ID client to server": Unsigned32, ReadOnly, CobIdSdoRequest = NodeIdPlus(0x600);
        2 "COB-ID server to client": Unsigned32, ReadOnly, CobIdSdoResponse = NodeIdPlus(0x580);
    }
    0x2000 {
        0 "Highest sub-index supported" of "CAN controller": Unsigned8, Const, HighestSubIndex(9);
        1 "Recoveries from bus-off": Unsigned16, ReadOnly, BusOffs;
        2 "Receive overruns": Unsigned16, ReadOnly, Overruns;
        3 "Transmit error counter": Unsigned8, ReadOnly, TransmitErrorCounter;
        4 "Receive error counter": Unsigned8, ReadOnly, ReceiveErrorCounter;
        5 "Home bit rate": Unsigned16, ReadOnly, HomeBitRate;
        6 "Bit rate in use": Unsigned16, ReadOnly, BitRateInUse;
        7 "Rescues": Unsigned16, ReadOnly, Rescues;
        8 "Cause of the reset before the start": Unsigned8, ReadOnly, RestartCause;
        9 "Address of the reset before the start": Unsigned32, ReadOnly, RestartAddress;
    }
}

/// The row of an object in `table`, or the part of its address that does not exist.
#[inline]
pub(crate) fn find(
    table: &'static [Entry],
    index: u16,
    sub_index: u8,
) -> Result<&'static Entry, Missing> {
    let place = |index: u16, sub_index: u8| u32::from(index) << 8 | u32::from(sub_index);
    let place_of = |entry: &Entry| place(entry.index, entry.sub_index);
    let row = match table.binary_search_by_key(&place(index, sub_index), place_of) {
        Ok(row) => table.get(row),
        // Each object has a sub-index 0, so the row before belongs to the object if it exists.
        Err(row) => match table.get(row.wrapping_sub(1)) {
            Some(before) if before.index == index => return Err(Missing::SubIndex),
            _ => None,
        },
    };
    row.ok_or(Missing::Object)
}

/// The part of a dictionary address that does not exist.
pub(crate) enum Missing {
    Object,
    SubIndex,
}
