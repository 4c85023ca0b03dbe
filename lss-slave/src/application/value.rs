//! The types that a value in the dictionary may have.

use super::text::{OctetString, Text};
use crate::{object_dictionary::DataType, sdo::Abort};

/// A type of value in the dictionary (CiA 301, 7.1.4).
#[expect(clippy::len_without_is_empty, reason = "it is the length in bytes")]
pub trait Value: Sized {
    /// The CiA 301 data type.
    const DATA_TYPE: DataType;
    /// The length of the longest value that a client can write, in bytes.
    const CAPACITY: usize;

    /// The length of the value in bytes.
    fn len(&self) -> usize;

    /// Copies the bytes of the value from `offset` to `to`; returns their number.
    fn read(&self, offset: usize, to: &mut [u8]) -> usize;

    /// The value in these bytes.
    ///
    /// # Errors
    /// [`Abort::TooLong`] or [`Abort::TooShort`].
    fn parse(bytes: &[u8]) -> Result<Self, Abort>;
}

/// Copies `from`, from `offset` on, to `to` as far as both reach; returns the number of bytes.
pub(crate) fn copy(from: &[u8], offset: usize, to: &mut [u8]) -> usize {
    let from = from.get(offset..).unwrap_or_default();
    to.iter_mut().zip(from).map(|(to, from)| *to = *from).count()
}

macro_rules! numbers {
    ($($number:ty => $data_type:ident,)*) => {$(
        impl Value for $number {
            const DATA_TYPE: DataType = DataType::$data_type;
            const CAPACITY: usize = size_of::<Self>();

            fn len(&self) -> usize {
                size_of::<Self>()
            }

            fn read(&self, offset: usize, to: &mut [u8]) -> usize {
                copy(&self.to_le_bytes(), offset, to)
            }

            fn parse(bytes: &[u8]) -> Result<Self, Abort> {
                parse_number(bytes).map(Self::from_le_bytes)
            }
        }
    )*};
}

numbers! {
    i8 => Integer8,
    i16 => Integer16,
    i32 => Integer32,
    i64 => Integer64,
    u8 => Unsigned8,
    u16 => Unsigned16,
    u32 => Unsigned32,
    u64 => Unsigned64,
    f32 => Real32,
    f64 => Real64,
}

fn parse_number<const N: usize>(bytes: &[u8]) -> Result<[u8; N], Abort> {
    bytes.try_into().map_err(|_| if bytes.len() > N { Abort::TooLong } else { Abort::TooShort })
}

impl Value for bool {
    const DATA_TYPE: DataType = DataType::Boolean;
    const CAPACITY: usize = 1;

    fn len(&self) -> usize {
        1
    }

    fn read(&self, offset: usize, to: &mut [u8]) -> usize {
        copy(&[u8::from(*self)], offset, to)
    }

    fn parse(bytes: &[u8]) -> Result<Self, Abort> {
        match parse_number(bytes)? {
            [0] => Ok(false),
            [1] => Ok(true),
            _ => Err(Abort::InvalidValue),
        }
    }
}

/// A constant text, which a client cannot write.
impl Value for &'static str {
    const DATA_TYPE: DataType = DataType::VisibleString;
    const CAPACITY: usize = 0;

    fn len(&self) -> usize {
        str::len(self)
    }

    fn read(&self, offset: usize, to: &mut [u8]) -> usize {
        copy(self.as_bytes(), offset, to)
    }

    fn parse(_: &[u8]) -> Result<Self, Abort> {
        Err(Abort::ReadOnly)
    }
}

macro_rules! strings {
    ($($string:ident => $data_type:ident,)*) => {$(
        impl<const N: usize> Value for $string<N> {
            const DATA_TYPE: DataType = DataType::$data_type;
            const CAPACITY: usize = N;

            fn len(&self) -> usize {
                self.as_bytes().len()
            }

            fn read(&self, offset: usize, to: &mut [u8]) -> usize {
                copy(self.as_bytes(), offset, to)
            }

            fn parse(bytes: &[u8]) -> Result<Self, Abort> {
                Self::from_bytes(bytes).ok_or(Abort::TooLong)
            }
        }
    )*};
}

strings! {
    Text => VisibleString,
    OctetString => OctetString,
}

/// A DOMAIN: data of any length that the application keeps elsewhere, and reads and writes in parts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Domain;

impl Value for Domain {
    const DATA_TYPE: DataType = DataType::Domain;
    const CAPACITY: usize = 0;

    fn len(&self) -> usize {
        0
    }

    fn read(&self, _: usize, _: &mut [u8]) -> usize {
        0
    }

    fn parse(_: &[u8]) -> Result<Self, Abort> {
        Ok(Self)
    }
}
