//! The mapping of a PDO (CiA 301, 7.5.2.36): the values of the application in its bytes.

use super::cob_id::PdoCobId;
use crate::{
    Application,
    object_dictionary::{Access, DataType, Entry, Object, PdoPart},
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
    mapped: [Mapped; MAX_MAPPED],
}

/// A value in a PDO.
#[derive(Clone, Copy, Debug)]
struct Mapped {
    /// Index, sub-index and length in bits, as in the dictionary; 0 for none.
    code: u32,
    /// The field of the application; `None` leaves the bytes out.
    field: Option<u8>,
}

impl Mapped {
    const NONE: Self = Self { code: 0, field: None };

    /// The value at this address, if it can be mapped in this direction.
    const fn new(
        objects: &[Entry],
        direction: Direction,
        index: u16,
        sub_index: u8,
    ) -> Option<Self> {
        let (size, field) = match (direction, dummy(index, sub_index)) {
            (Direction::Receive, Some(data_type)) => (data_type.size(), None),
            _ => {
                let mut at = 0;
                while at < objects.len()
                    && (objects[at].index != index || objects[at].sub_index != sub_index)
                {
                    at += 1;
                }
                if at >= objects.len() || !objects[at].options.is_mappable() {
                    return None;
                }
                let Entry { data_type, access, object: Object::Application(field), .. } =
                    objects[at]
                else {
                    return None;
                };
                let is_possible = match direction {
                    Direction::Transmit => !matches!(access, Access::WriteOnly),
                    Direction::Receive => matches!(access, Access::ReadWrite | Access::WriteOnly),
                };
                if !is_possible {
                    return None;
                }
                (data_type.size(), Some(field))
            }
        };
        let bits = size as u32 * 8;
        let code = (index as u32) << 16 | (sub_index as u32) << 8 | bits;
        Some(Self { code, field })
    }

    /// The value with this code, if it exists and can be mapped in this direction.
    fn with_code(objects: &[Entry], direction: Direction, code: u32) -> Option<Self> {
        let mapped = Self::new(objects, direction, (code >> 16) as u16, (code >> 8) as u8);
        mapped.filter(|mapped| mapped.code == code)
    }

    /// The length in bytes.
    const fn len(self) -> usize {
        (self.code & 0xFF) as usize / 8
    }
}

/// The data type whose bytes a dummy entry leaves out (CiA 301, 7.4.7).
const fn dummy(index: u16, sub_index: u8) -> Option<DataType> {
    Some(match (index, sub_index) {
        (1, 0) => DataType::Boolean,
        (2, 0) => DataType::Integer8,
        (3, 0) => DataType::Integer16,
        (4, 0) => DataType::Integer32,
        (5, 0) => DataType::Unsigned8,
        (6, 0) => DataType::Unsigned16,
        (7, 0) => DataType::Unsigned32,
        _ => return None,
    })
}

impl Mapping {
    pub const EMPTY: Self = Self { number: 0, mapped: [Mapped::NONE; MAX_MAPPED] };

    /// The mapping of a declaration; panics, at compile time, with what is wrong.
    pub const fn declared(
        objects: &[Entry],
        direction: Direction,
        addresses: &[(u16, u8)],
    ) -> Self {
        assert!(addresses.len() <= MAX_MAPPED, "a PDO has more than 8 values");
        let mut mapping = Self::EMPTY;
        let mut len = 0;
        let mut at = 0;
        while at < addresses.len() {
            let (index, sub_index) = addresses[at];
            let Some(mapped) = Mapped::new(objects, direction, index, sub_index) else {
                panic!(
                    "a PDO has an object that does not exist or cannot be mapped in its direction"
                );
            };
            mapping.mapped[at] = mapped;
            len += mapped.len();
            at += 1;
        }
        assert!(len <= 8, "the values of a PDO have more than 8 bytes");
        mapping.number = addresses.len() as u8;
        mapping
    }

    /// The mapping that was stored, if all its values exist and can be mapped in this direction.
    pub fn from_stored(codes: &[[u8; 4]], direction: Direction, objects: &[Entry]) -> Option<Self> {
        let mut mapping = Self { number: codes.len() as u8, ..Self::EMPTY };
        for (at, code) in codes.iter().enumerate() {
            let place = mapping.mapped.get_mut(at)?;
            *place = Mapped::with_code(objects, direction, u32::from_le_bytes(*code))?;
        }
        (mapping.len() <= 8).then_some(mapping)
    }

    /// The mapping as it is stored: the entries of the values that the PDO carries.
    pub fn stored(&self) -> impl Iterator<Item = u32> + Clone {
        self.mapped().map(|mapped| mapped.code)
    }

    fn mapped(&self) -> impl Iterator<Item = &Mapped> + Clone {
        self.mapped.iter().take(self.number.into())
    }

    /// The length of the PDO in bytes.
    pub fn len(&self) -> usize {
        self.mapped().fold(0, |len, mapped| len.saturating_add(mapped.len()))
    }

    pub const fn is_empty(&self) -> bool {
        self.number == 0
    }

    /// The bytes of the values, padded with 0.
    pub fn read<A: Application>(&self, application: &A) -> [u8; 8] {
        let mut data = [0; 8];
        let mut rest = data.as_mut_slice();
        for mapped in self.mapped() {
            let Some((bytes, others)) = rest.split_at_mut_checked(mapped.len()) else { break };
            if let Some(field) = mapped.field {
                application.read(field, 0, bytes);
            }
            rest = others;
        }
        data
    }

    /// Gives the values in `data` to the application; a value that it refuses is ignored.
    pub fn write<A: Application>(&self, data: &[u8], application: &mut A) {
        let mut rest = data;
        for mapped in self.mapped() {
            let Some((bytes, others)) = rest.split_at_checked(mapped.len()) else { break };
            if let Some(field) = mapped.field
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
        let at = usize::from(sub_index).checked_sub(1);
        let mapped = at.and_then(|at| self.mapped.get(at));
        mapped.map_or(self.number.into(), |mapped| mapped.code)
    }

    /// Sets a sub-index, by the procedure of CiA 301: the PDO is not valid; sub-index 0 is 0 while entries change; then
    /// it is set to their number.
    ///
    /// # Errors
    /// [`Abort::DeviceState`] out of turn; [`Abort::NotMappable`] for an object that does not exist or cannot be mapped
    /// so; [`Abort::TooManyMapped`] if the length exceeds 8 bytes; [`Abort::InvalidValue`] for a number above 8.
    pub fn set(
        &mut self,
        direction: Direction,
        cob_id: PdoCobId,
        part: PdoPart,
        value: u32,
        objects: &[Entry],
    ) -> Result<(), Abort> {
        if cob_id.is_valid {
            return Err(Abort::DeviceState);
        }
        let at = usize::from(part.sub_index()).checked_sub(1);
        if let Some(place) = at.and_then(|at| self.mapped.get_mut(at)) {
            if self.number != 0 {
                return Err(Abort::DeviceState);
            }
            *place = Mapped::with_code(objects, direction, value).ok_or(Abort::NotMappable)?;
            return Ok(());
        }
        let wanted = Self { number: value as u8, ..*self };
        if value as usize > MAX_MAPPED {
            return Err(Abort::InvalidValue);
        }
        if wanted.mapped().any(|mapped| mapped.code == 0) {
            return Err(Abort::NotMappable);
        }
        if wanted.len() > 8 {
            return Err(Abort::TooManyMapped);
        }
        *self = wanted;
        Ok(())
    }
}
