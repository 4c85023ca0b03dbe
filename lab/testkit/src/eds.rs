//! The electronic data sheet of a product (CiA 306), and a page of its objects for people, from the product's tables.

#[cfg(feature = "sheets")]
pub mod ours;
mod page;

use std::{collections::BTreeMap, fmt::Write as _};

use canopen_node::{
    BitRate, Device,
    application::Dictionary,
    object_dictionary::{Access, DataType, DefaultValue, Description, Entry, Object},
};

/// The date of every data sheet, mm-dd-yyyy: the same tables always give the same file.
const DATE: &str = "11-21-2026";
const MANDATORY: [u16; 3] = [0x1000, 0x1001, 0x1018];

/// A product, as its data sheet names it.
#[derive(Clone, Copy, Debug)]
pub struct Product<'a> {
    /// The name of the data sheet, such as `lss-slave.eds`.
    pub file_name: &'a str,
    pub vendor_name: &'a str,
    pub description: &'a str,
    pub device: Device,
}

/// A product and all values in its object dictionary.
#[derive(Debug)]
pub struct DataSheet<'a> {
    product: Product<'a>,
    /// By index and sub-index.
    values: Vec<Value>,
}

#[derive(Debug)]
struct Value {
    entry: Entry,
    description: Description,
    /// The value of a new device, in the notation of CiA 306.
    default: Option<String>,
}

impl<'a> DataSheet<'a> {
    /// The data sheet of a product whose dictionary has these entries, such as [`entries`] of its application.
    ///
    /// [`entries`]: canopen_node::Node::entries
    pub fn new(
        product: Product<'a>,
        entries: impl IntoIterator<Item = (Entry, Description)>,
        new_application: &impl Dictionary,
    ) -> Self {
        let value = |(entry, description): (Entry, Description)| {
            let default = default(&entry, &description, new_application);
            Value { entry, description, default }
        };
        let mut values: Vec<_> = entries.into_iter().map(value).collect();
        values.sort_by_key(|value| (value.entry.index, value.entry.sub_index));
        Self { product, values }
    }

    /// The text of the EDS.
    ///
    /// # Panics
    /// If a line cannot be in an EDS: it is not ASCII or longer than 255 characters.
    pub fn eds(&self) -> String {
        let mut eds = self.head();
        let is_mandatory = |index: &u16| MANDATORY.contains(index);
        let is_manufacturer = |index: &u16| (0x2000..0x6000).contains(index);
        let is_optional = |index: &u16| !is_mandatory(index) && !is_manufacturer(index);
        self.list(&mut eds, "MandatoryObjects", is_mandatory);
        self.list(&mut eds, "OptionalObjects", is_optional);
        self.list(&mut eds, "ManufacturerObjects", is_manufacturer);
        for values in self.objects() {
            write_object(&mut eds, values);
        }
        for line in eds.lines() {
            assert!(line.is_ascii() && line.len() <= 255, "not possible in an EDS: {line}");
        }
        eds
    }

    /// The values of each object.
    fn objects(&self) -> impl Iterator<Item = &[Value]> {
        self.values.chunk_by(|a, b| a.entry.index == b.entry.index)
    }

    /// The indices of all objects.
    fn indices(&self) -> impl Iterator<Item = u16> {
        self.objects().map(|values| values[0].entry.index)
    }

    /// The sections before the lists of objects.
    fn head(&self) -> String {
        let Product { file_name, vendor_name, description, device } = self.product;
        let mut rates = BitRate::ALL.map(|rate| {
            format!("BaudRate_{}={}", rate.kbit_per_s(), u8::from(device.bit_rates.contains(rate)))
        });
        rates.reverse();
        let rates = rates.join("\n");
        let receive_pdos = self.indices().filter(|i| (0x1400..0x1600).contains(i)).count();
        let transmit_pdos = self.indices().filter(|i| (0x1800..0x1A00).contains(i)).count();
        let has_settings =
            self.values.iter().any(|value| value.entry.object == Object::PendingNodeId);
        let also_by_sdo = if has_settings { ", or by SDO in 2FF0h" } else { " only" };
        let granularity = if receive_pdos + transmit_pdos > 0 { 8 } else { 0 };
        // A dummy of 1 bit, a BOOLEAN, is not possible.
        let dummy = |data_type| u8::from(receive_pdos > 0 && data_type != DataType::Boolean as u8);
        let dummies =
            (1..=7).map(|n| format!("Dummy{n:04}={}", dummy(n))).collect::<Vec<_>>().join("\n");
        format!(
            "\
[FileInfo]
FileName={file_name}
FileVersion=1
FileRevision=0
EDSVersion=4.0
Description={description}
CreationTime=12:00PM
CreationDate={DATE}
CreatedBy=lss-slave
ModificationTime=12:00PM
ModificationDate={DATE}
ModifiedBy=lss-slave

[DeviceInfo]
VendorName={vendor_name}
VendorNumber=0x{:08X}
ProductName={}
ProductNumber=0x{:08X}
RevisionNumber=0x{:08X}
OrderCode=
{rates}
SimpleBootUpMaster=0
SimpleBootUpSlave=1
Granularity={granularity}
DynamicChannelsSupported=0
GroupMessaging=0
NrOfRXPDO={receive_pdos}
NrOfTXPDO={transmit_pdos}
LSS_Supported=1
CompactPDO=0

[DummyUsage]
{dummies}

[Comments]
Lines=3
Line1=Made from the tables of the firmware: change those instead.
Line2=The serial number 1018h sub 4 differs in every device.
Line3=Node-ID and bit rate are configured by LSS{also_by_sdo}.
",
            device.address.vendor_id,
            device.name,
            device.address.product_code,
            device.address.revision_number,
        )
    }

    /// Writes the list of the objects whose index satisfies `is_listed`.
    fn list(&self, eds: &mut String, name: &str, is_listed: impl Fn(&u16) -> bool) {
        let indices: Vec<_> = self.indices().filter(is_listed).collect();
        line(eds, format_args!("\n[{name}]\nSupportedObjects={}", indices.len()));
        for (n, index) in (1..).zip(indices) {
            line(eds, format_args!("{n}=0x{index:04X}"));
        }
    }
}

fn line(to: &mut String, content: impl std::fmt::Display) {
    writeln!(to, "{content}").expect("a string takes any text");
}

fn write_object(eds: &mut String, values: &[Value]) {
    let index = values[0].entry.index;
    let Some(name) = values[0].description.object else {
        return write_value(eds, &format!("{index:04X}"), &values[0]);
    };
    let object_type = if is_record(values) { RECORD } else { ARRAY };
    line(eds, format_args!("\n[{index:04X}]\nSubNumber={}", values.len()));
    line(eds, format_args!("ParameterName={name}\nObjectType={object_type:#X}"));
    for value in values {
        write_value(eds, &format!("{index:04X}sub{:X}", value.entry.sub_index), value);
    }
}

const DOMAIN: u8 = 0x2;
const VAR: u8 = 0x7;
const ARRAY: u8 = 0x8;
const RECORD: u8 = 0x9;

/// Whether the object is a record: CiA 301 says so, or its values differ in type.
fn is_record(values: &[Value]) -> bool {
    let is_by_standard =
        matches!(values[0].entry.index, 0x1018 | 0x1200..=0x12FF | 0x1400..=0x1BFF);
    let types = values[1..].iter().map(|value| value.entry.data_type as u8);
    is_by_standard || types.clone().min() != types.max()
}

fn write_value(eds: &mut String, section: &str, value: &Value) {
    let Value { entry, description, default } = value;
    let is_domain = entry.data_type == DataType::Domain;
    let object_type = if is_domain { DOMAIN } else { VAR };
    line(eds, format_args!("\n[{section}]\nParameterName={}", description.name));
    line(eds, format_args!("ObjectType={object_type:#X}"));
    line(eds, format_args!("DataType=0x{:04X}", entry.data_type as u8));
    line(eds, format_args!("AccessType={}", access(entry)));
    if let Some((low, high)) = description.limits
        && !is_real(entry)
    {
        line(eds, format_args!("LowLimit={low}\nHighLimit={high}"));
    }
    if let Some(default) = default
        && (!is_real(entry) || default == "0")
    {
        line(eds, format_args!("DefaultValue={default}"));
    }
    if !is_domain {
        line(eds, format_args!("PDOMapping={}", u8::from(entry.options.is_mappable())));
    }
    if acts(entry) {
        // "Refuse write on download": a tool that configures a device leaves the object out.
        line(eds, "ObjFlags=1");
    }
}

/// Whether the value is a REAL. Some tools read its limits and its default as a decimal number, others as the bits of the
/// number, which agree on 0 only; so a data sheet has no others.
fn is_real(entry: &Entry) -> bool {
    matches!(entry.data_type, DataType::Real32 | DataType::Real64)
}

/// Whether a write triggers an action.
fn acts(entry: &Entry) -> bool {
    use Object::{NumberOfErrors, RestoreDefaultParameters, StoreParameters};
    matches!(entry.object, NumberOfErrors | RestoreDefaultParameters | StoreParameters)
}

fn access(entry: &Entry) -> &'static str {
    match entry.access {
        Access::Const => "const",
        Access::ReadOnly => "ro",
        Access::ReadWrite => "rw",
        Access::ReadWriteInput => "rwr",
        Access::ReadWriteOutput => "rww",
        Access::WriteOnly => "wo",
    }
}

/// The value of a new device, if there is one that can be read.
fn default(
    entry: &Entry,
    description: &Description,
    new_application: &impl Dictionary,
) -> Option<String> {
    if let Object::HighestSubIndex(highest) = entry.object {
        return Some(highest.to_string());
    }
    match description.default {
        DefaultValue::Varies => None,
        // Identities, COB-IDs and mappings are easier to read in hexadecimal.
        DefaultValue::Number(number) if entry.data_type == DataType::Unsigned32 => {
            Some(format!("0x{number:08X}"))
        }
        DefaultValue::Number(number) => Some(number.to_string()),
        DefaultValue::NodeIdPlus(number) => Some(format!("$NODEID+0x{number:X}")),
        DefaultValue::Text(text) => Some(text.to_owned()),
        DefaultValue::OfApplication => default_of_application(entry, new_application),
    }
}

fn default_of_application(entry: &Entry, application: &impl Dictionary) -> Option<String> {
    let Object::Application(field) = entry.object else { return None };
    // What a master cannot write is live, such as an input; what it cannot read has no default either.
    if matches!(entry.access, Access::ReadOnly | Access::WriteOnly) {
        return None;
    }
    let mut bytes = vec![0; application.len(field)];
    application.read(field, 0, &mut bytes);
    let number = |negative: bool| {
        let mut number = [if negative { 0xFF } else { 0 }; 8];
        number[..bytes.len()].copy_from_slice(&bytes);
        number
    };
    let is_negative = bytes.last().is_some_and(|top| top & 0x80 != 0);
    use DataType::*;
    Some(match entry.data_type {
        Boolean | Unsigned8 | Unsigned16 | Unsigned24 | Unsigned32 | Unsigned40 | Unsigned48
        | Unsigned56 | Unsigned64 => u64::from_le_bytes(number(false)).to_string(),
        Integer8 | Integer16 | Integer24 | Integer32 | Integer40 | Integer48 | Integer56
        | Integer64 => i64::from_le_bytes(number(is_negative)).to_string(),
        Real32 => f32::from_bits(u64::from_le_bytes(number(false)) as u32).to_string(),
        Real64 => f64::from_bits(u64::from_le_bytes(number(false))).to_string(),
        VisibleString => String::from_utf8_lossy(&bytes).into_owned(),
        OctetString => bytes.iter().map(|byte| format!("{byte:02X}")).collect(),
        Domain => return None,
    })
}

/// The sections of an EDS with their keys and values, by name.
pub type Sections = BTreeMap<String, BTreeMap<String, String>>;

/// Parses an EDS.
///
/// # Panics
/// If a line is neither a section nor a key with its value, or if one occurs twice.
pub fn parse(eds: &str) -> Sections {
    let mut sections = Sections::new();
    let mut name = String::new();
    for line in eds.lines().filter(|line| !line.is_empty()) {
        if let Some(section) = line.strip_prefix('[').and_then(|line| line.strip_suffix(']')) {
            assert!(!sections.contains_key(section), "[{section}] twice");
            section.clone_into(&mut name);
            sections.insert(name.clone(), BTreeMap::new());
        } else {
            let (key, value) = line.split_once('=').expect("key=value");
            let section = sections.get_mut(&name).expect("a section");
            let before = section.insert(key.to_owned(), value.to_owned());
            assert_eq!(before, None, "{key} twice in [{name}]");
        }
    }
    sections
}
