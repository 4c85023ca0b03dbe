//! The mapping of a PDO (CiA 301, 7.5.2.36): the values of the application in its bytes.

use crate::{
    Application,
    declaration_error::DeclarationError,
    object_dictionary::{self, Access, DataType, Entry, Object, Options},
    sdo::Abort,
};

/// The most values in a PDO: each has at least one byte.
pub(super) const MAX_MAPPED: usize = 8;

/// The direction of a PDO.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Direction {
    Transmit,
    Receive,
}

/// The values that a PDO carries.
#[derive(Clone, Copy, Debug)]
pub(super) struct Mapping {
    /// Sub-index 0; 0 disables the PDO.
    number: u8,
    /// The length of the PDO in bytes.
    len: u8,
    mapped: [Option<&'static Entry>; MAX_MAPPED],
}

/// The objects whose bytes an RPDO leaves out (CiA 301, 7.4.7). Their index is that of their data type. A BOOLEAN would
/// be one bit, but a value has at least one byte.
const DUMMIES: &[Entry] = &[
    dummy(DataType::Integer8),
    dummy(DataType::Integer16),
    dummy(DataType::Integer32),
    dummy(DataType::Unsigned8),
    dummy(DataType::Unsigned16),
    dummy(DataType::Unsigned32),
];

const fn dummy(data_type: DataType) -> Entry {
    Entry {
        index: data_type as u16,
        sub_index: 0,
        data_type,
        access: Access::WriteOnly,
        options: Options::NONE.mappable(),
        object: Object::Dummy,
    }
}

impl Direction {
    /// The name of a PDO.
    pub const fn pdo(self) -> &'static str {
        match self {
            Self::Transmit => "TPDO",
            Self::Receive => "RPDO",
        }
    }
}

/// The reason why an object cannot be mapped.
#[derive(Clone, Copy, Debug)]
enum NotMappable {
    Missing,
    NotDeclared,
    WrongDirection,
}

impl NotMappable {
    const fn reason(self, direction: Direction) -> &'static str {
        match (self, direction) {
            (Self::Missing, _) => " does not exist",
            (Self::NotDeclared, _) => " is not declared as mappable: add this option",
            (Self::WrongDirection, Direction::Transmit) => {
                " is no input: its access is wo or rww, and must be ro, rwr or rw"
            }
            (Self::WrongDirection, Direction::Receive) => {
                " is no output: its access is constant, ro or rwr, and must be wo, rww or rw"
            }
        }
    }
}

/// The object with this address, if it can be mapped in this direction.
const fn find(
    objects: &'static [Entry],
    direction: Direction,
    index: u16,
    sub_index: u8,
) -> Result<&'static Entry, NotMappable> {
    let table = table(objects, index);
    let mut at = 0;
    while at < table.len() {
        let entry = &table[at];
        if entry.index == index && entry.sub_index == sub_index {
            return match reason(entry, direction) {
                Some(reason) => Err(reason),
                None => Ok(entry),
            };
        }
        at += 1;
    }
    Err(NotMappable::Missing)
}

const fn table(objects: &'static [Entry], index: u16) -> &'static [Entry] {
    if index < 0x1000 { DUMMIES } else { objects }
}

/// Why an object cannot be mapped in this direction.
const fn reason(entry: &Entry, direction: Direction) -> Option<NotMappable> {
    let is_possible = match direction {
        Direction::Transmit => !matches!(entry.access, Access::WriteOnly | Access::ReadWriteOutput),
        Direction::Receive => {
            !matches!(entry.access, Access::Const | Access::ReadOnly | Access::ReadWriteInput)
        }
    };
    match (entry.options.is_mappable(), is_possible) {
        (false, _) => Some(NotMappable::NotDeclared),
        (true, false) => Some(NotMappable::WrongDirection),
        (true, true) => None,
    }
}

/// The object with this entry of a mapping, if it can be mapped in this direction.
fn find_code(
    objects: &'static [Entry],
    direction: Direction,
    wanted: u32,
) -> Option<&'static Entry> {
    let (index, sub_index) = ((wanted >> 16) as u16, (wanted >> 8) as u8);
    let entry = object_dictionary::find(table(objects, index), index, sub_index).ok()?;
    (code(entry) == wanted && reason(entry, direction).is_none()).then_some(entry)
}

/// The entry of a mapping for this object: index, sub-index and length in bits.
fn code(entry: &Entry) -> u32 {
    u32::from(entry.index) << 16 | u32::from(entry.sub_index) << 8 | bits(entry.data_type)
}

/// The length of a value in bits.
fn bits(data_type: DataType) -> u32 {
    u32::from(data_type.size()) * 8
}

/// The length of mapped values in bytes.
fn len(mapped: &[Option<&Entry>]) -> u8 {
    let sizes = mapped.iter().filter_map(|entry| Some((*entry)?.data_type.size()));
    sizes.fold(0, u8::saturating_add)
}

impl Mapping {
    pub const EMPTY: Self = Self { number: 0, len: 0, mapped: [None; MAX_MAPPED] };

    /// The mapping of the PDO with this number, from 1, as it is declared; panics, at compile time, with what is wrong.
    pub const fn declared(
        objects: &'static [Entry],
        direction: Direction,
        number: usize,
        addresses: &[(u16, u8)],
    ) -> Self {
        let error = DeclarationError::of_pdo(direction.pdo(), number);
        if addresses.len() > MAX_MAPPED {
            error
                .number(addresses.len())
                .text(" values are mapped, at most 8 are possible")
                .raise();
        }
        let mut mapping = Self::EMPTY;
        let mut len = 0;
        let mut at = 0;
        while at < addresses.len() {
            let (index, sub_index) = addresses[at];
            let entry = match find(objects, direction, index, sub_index) {
                Ok(entry) => entry,
                Err(fault) => error.object(index, sub_index).text(fault.reason(direction)).raise(),
            };
            mapping.mapped[at] = Some(entry);
            len += entry.data_type.size();
            at += 1;
        }
        if len > 8 {
            error
                .text("its values have ")
                .number(len as usize)
                .text(" bytes, at most 8 are possible")
                .raise();
        }
        (mapping.number, mapping.len) = (addresses.len() as u8, len);
        mapping
    }

    /// The mapping that was stored, if all its values exist and can be mapped in this direction.
    pub fn from_stored(
        codes: &[[u8; 4]],
        direction: Direction,
        objects: &'static [Entry],
    ) -> Option<Self> {
        let mut mapping = Self::EMPTY;
        for (at, code) in codes.iter().enumerate() {
            let place = mapping.mapped.get_mut(at)?;
            *place = Some(find_code(objects, direction, u32::from_le_bytes(*code))?);
        }
        (mapping.number, mapping.len) = (codes.len() as u8, len(&mapping.mapped));
        (mapping.len <= 8).then_some(mapping)
    }

    /// The mapping as it is stored: the entries of the values that the PDO carries.
    pub fn stored(&self) -> impl Iterator<Item = u32> {
        self.entries().map(code)
    }

    /// Removes the entries behind sub-index 0.
    pub fn remove_unused(&mut self) {
        self.mapped.iter_mut().skip(self.number.into()).for_each(|entry| *entry = None);
    }

    fn entries(&self) -> impl Iterator<Item = &'static Entry> {
        self.mapped.iter().take(self.number()).filter_map(|entry| *entry)
    }

    /// The number of values that the PDO carries.
    pub fn number(&self) -> usize {
        self.number.into()
    }

    /// The length of the PDO in bytes.
    pub const fn len(&self) -> usize {
        self.len as usize
    }

    pub const fn is_empty(&self) -> bool {
        self.number == 0
    }

    /// The bytes of the values, the first as the lowest.
    pub fn read<A: Application>(&self, application: &mut A) -> u64 {
        // The bytes behind a value are zero, or those of the next one.
        let mut bytes = [0; 16];
        let mut at = 0_usize;
        for Entry { index, sub_index, data_type, object, .. } in self.entries() {
            if let Object::Application(field) = *object {
                application.before_read(*index, *sub_index);
                if let Some(place) = bytes.get_mut(at..).and_then(<[u8]>::first_chunk_mut) {
                    *place = application.bits(field).to_le_bytes();
                }
            }
            at = at.wrapping_add(data_type.size().into());
        }
        bytes.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes))
    }

    /// The bits of the values that are not quiet.
    pub fn heeded(&self) -> u64 {
        let (mut heeded, mut at) = (0, 0_u32);
        for Entry { data_type, options, .. } in self.entries() {
            let bits = bits(*data_type);
            if !options.is_quiet() {
                heeded |= u64::MAX.wrapping_shr(64_u32.wrapping_sub(bits)).wrapping_shl(at);
            }
            at = at.wrapping_add(bits);
        }
        heeded
    }

    /// Gives the values in `data` to the application; a value that it refuses is ignored.
    pub fn write<A: Application>(&self, data: &[u8], application: &mut A) {
        let mut rest = data;
        for Entry { data_type, object, .. } in self.entries() {
            let size = data_type.size().into();
            let Some((bytes, others)) = rest.split_at_checked(size) else { break };
            if let Object::Application(field) = *object
                && let Ok(value) = A::parse(field, bytes)
                && application.accept(&value).is_ok()
            {
                application.set(value);
            }
            rest = others;
        }
    }

    /// The value of a sub-index.
    pub fn value(&self, sub_index: u8) -> u32 {
        match usize::from(sub_index).checked_sub(1) {
            None => self.number.into(),
            Some(at) => self.mapped.get(at).copied().flatten().map_or(0, code),
        }
    }

    /// Sets a sub-index, by the procedure of CiA 301: sub-index 0 is 0 while entries change; then it is set to their
    /// number.
    ///
    /// # Errors
    /// [`Abort::UnsupportedAccess`] out of turn; [`Abort::NotMappable`] for an object that does not exist or cannot be
    /// mapped so; [`Abort::TooManyMapped`] for more than 8 objects or bytes.
    pub fn set(
        &mut self,
        direction: Direction,
        sub_index: u8,
        value: u32,
        objects: &'static [Entry],
    ) -> Result<(), Abort> {
        let at = usize::from(sub_index).checked_sub(1);
        if let Some(place) = at.and_then(|at| self.mapped.get_mut(at)) {
            if self.number != 0 {
                return Err(Abort::UnsupportedAccess);
            }
            *place = Some(find_code(objects, direction, value).ok_or(Abort::NotMappable)?);
            return Ok(());
        }
        let wanted = self.mapped.get(..value as usize).ok_or(Abort::TooManyMapped)?;
        if wanted.iter().any(Option::is_none) {
            return Err(Abort::NotMappable);
        }
        let len = len(wanted);
        if len > 8 {
            return Err(Abort::TooManyMapped);
        }
        (self.number, self.len) = (value as u8, len);
        Ok(())
    }
}
