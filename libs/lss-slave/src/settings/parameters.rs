//! Parameters: the values that object 1010h stores, packed one after another.
//!
//! Each is packed like this, little endian:
//!
//! | bytes | content |
//! |---|---|
//! | 0..1 | index |
//! | 2 | sub-index |
//! | 3 | data type, as CiA 301 numbers them: `06` is UNSIGNED16 |
//! | 4..5 | length of the value in bytes |
//! | from 6 | the value as in an SDO transfer |

use super::{log::place, record::PART_LEN};
use crate::bytes::copy;

/// The bytes that a parameter takes beside its value: index, sub-index, data type and length.
#[doc(hidden)]
pub const HEADER: usize = 6;

/// The most bytes of parameters for which a bank of the settings log of `bank_len` bytes has room, in flash with a
/// program unit of `write_size` bytes. They take half of it with their record, so that others can be stored without an
/// erase.
pub const fn capacity(bank_len: usize, write_size: usize) -> usize {
    let places = bank_len / place::len(write_size) as usize;
    (places.saturating_sub(place::RESERVE as usize) / 2).saturating_sub(1) * PART_LEN
}

/// The value of an object, to be stored or as it was stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Parameter<'a> {
    /// The index of the object.
    pub index: u16,
    /// The sub-index of the object.
    pub sub_index: u8,
    /// The CiA 301 data type at the time of the store.
    pub data_type: u8,
    /// The value as in an SDO transfer.
    pub value: &'a [u8],
}

impl<'a> Parameter<'a> {
    /// Takes the first parameter from packed ones.
    fn take_from(packed: &mut &'a [u8]) -> Option<Self> {
        let (header, rest) = packed.split_first_chunk()?;
        let (value, rest) = rest.split_at_checked(value_len(*header).into())?;
        *packed = rest;
        let [i0, i1, sub_index, data_type, ..] = *header;
        Some(Self { index: u16::from_le_bytes([i0, i1]), sub_index, data_type, value })
    }

    /// The first of the packed parameters.
    pub(super) fn first_of(mut packed: &'a [u8]) -> Option<Self> {
        Self::take_from(&mut packed)
    }
}

/// The length of the value behind a header.
pub(super) const fn value_len(header: [u8; HEADER]) -> u16 {
    let [.., l0, l1] = header;
    u16::from_le_bytes([l0, l1])
}

/// The parameters that are packed in these bytes.
pub fn unpack(mut packed: &[u8]) -> impl Iterator<Item = Parameter<'_>> {
    core::iter::from_fn(move || Parameter::take_from(&mut packed))
}

/// Packs parameters into a buffer.
pub struct Packer<'a> {
    to: &'a mut [u8],
    len: usize,
}

impl<'a> Packer<'a> {
    /// An empty pack in this buffer.
    pub const fn new(to: &'a mut [u8]) -> Self {
        Self { to, len: 0 }
    }

    /// Appends a parameter.
    pub fn put(&mut self, parameter: &Parameter<'_>) {
        let Parameter { index, sub_index, data_type, value } = *parameter;
        let place = self.reserve(index, sub_index, data_type, value.len());
        copy(value, 0, place);
    }

    /// Appends a parameter and returns the place of its value, which the caller fills in. One that does not fit is left
    /// out, and its place is empty.
    pub fn reserve(&mut self, index: u16, sub_index: u8, data_type: u8, len: usize) -> &mut [u8] {
        let rest = self.to.get_mut(self.len..).unwrap_or_default();
        if let Some((header, rest)) = rest.split_first_chunk_mut::<HEADER>()
            && let Some(value) = rest.get_mut(..len)
            && let Ok(value_len) = u16::try_from(len)
        {
            let ([i0, i1], [l0, l1]) = (index.to_le_bytes(), value_len.to_le_bytes());
            *header = [i0, i1, sub_index, data_type, l0, l1];
            self.len = self.len.saturating_add(HEADER).saturating_add(len);
            return value;
        }
        &mut []
    }

    /// The number of bytes of the packed parameters.
    pub const fn len(&self) -> usize {
        self.len
    }

    /// Whether nothing is packed.
    pub const fn is_empty(&self) -> bool {
        self.len == 0
    }
}
