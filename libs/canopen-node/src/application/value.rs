//! The types that a value in the dictionary may have.

use core::fmt::Debug;

use lss_slave::bytes::copy;

use super::text::{OctetString, Text};
use crate::{
    object_dictionary::{DataType, Options},
    sdo::Abort,
};

/// A type of value in the dictionary (CiA 301, 7.1.4).
#[diagnostic::on_unimplemented(
    message = "`{Self}` is no type of an object",
    note = "types are `bool`, `i8` to `i64`, `u8` to `u64`, `f32`, `f64`, `&'static str`, and those of `canopen_node::application`, such as `Unsigned24`, `Text<16>` and `Domain`"
)]
pub trait ValueType {
    /// The type of the field that holds the value.
    type Field: Copy + Debug;
    /// The CiA 301 data type.
    const DATA_TYPE: DataType;
    /// The length of the longest value that a client can write, in bytes.
    const CAPACITY: usize;
    /// The options of each object of this type.
    #[doc(hidden)]
    const OPTIONS: Options = Options::NONE;

    /// The length of the value in bytes.
    fn len(field: &Self::Field) -> usize;

    /// Copies the bytes of the value from `offset` to `to`; returns their number.
    fn read(field: &Self::Field, offset: usize, to: &mut [u8]) -> usize;

    /// The bytes of a number, the first as the lowest.
    #[doc(hidden)]
    fn bits(field: &Self::Field) -> u64 {
        let mut bytes = [0; 8];
        Self::read(field, 0, &mut bytes);
        u64::from_le_bytes(bytes)
    }

    /// The value in these bytes.
    ///
    /// # Errors
    /// [`Abort::TooLong`] or [`Abort::TooShort`].
    fn parse(bytes: &[u8]) -> Result<Self::Field, Abort>;
}

macro_rules! numbers {
    ($($number:ty => $data_type:ident,)*) => {$(
        impl ValueType for $number {
            type Field = Self;
            const DATA_TYPE: DataType = DataType::$data_type;
            const CAPACITY: usize = size_of::<Self>();

            fn len(_: &Self) -> usize {
                size_of::<Self>()
            }

            fn read(field: &Self, offset: usize, to: &mut [u8]) -> usize {
                copy(&field.to_le_bytes(), offset, to)
            }

            fn bits(field: &Self) -> u64 {
                let mut bytes = [0; 8];
                if let Some(first) = bytes.first_chunk_mut() {
                    *first = field.to_le_bytes();
                }
                u64::from_le_bytes(bytes)
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

macro_rules! short_numbers {
    ($($number:ident($field:ty) of $bits:literal bits;)*) => {$(
        #[doc = concat!("A number of ", $bits, " bits. Its field is an `", stringify!($field), "`; a client reads the")]
        /// nearest number of this type.
        #[derive(Debug)]
        pub enum $number {}

        impl ValueType for $number {
            type Field = $field;
            const DATA_TYPE: DataType = DataType::$number;
            const CAPACITY: usize = $bits / 8;

            fn len(_: &$field) -> usize {
                Self::CAPACITY
            }

            fn read(field: &$field, offset: usize, to: &mut [u8]) -> usize {
                const UNUSED: u32 = <$field>::BITS - $bits;
                let number = (*field).clamp(<$field>::MIN >> UNUSED, <$field>::MAX >> UNUSED);
                let bytes = number.to_le_bytes();
                copy(bytes.get(..Self::CAPACITY).unwrap_or(&bytes), offset, to)
            }

            fn parse(bytes: &[u8]) -> Result<$field, Abort> {
                const UNUSED: u32 = <$field>::BITS - $bits;
                let bytes = parse_number::<{ $bits / 8 }>(bytes)?;
                let mut number = [0; size_of::<$field>()];
                copy(&bytes, 0, &mut number);
                // The sign is the highest of the bits.
                Ok(<$field>::from_le_bytes(number) << UNUSED >> UNUSED)
            }
        }
    )*};
}

short_numbers! {
    Integer24(i32) of 24 bits;
    Integer40(i64) of 40 bits;
    Integer48(i64) of 48 bits;
    Integer56(i64) of 56 bits;
    Unsigned24(u32) of 24 bits;
    Unsigned40(u64) of 40 bits;
    Unsigned48(u64) of 48 bits;
    Unsigned56(u64) of 56 bits;
}

fn parse_number<const N: usize>(bytes: &[u8]) -> Result<[u8; N], Abort> {
    bytes.try_into().map_err(|_| if bytes.len() > N { Abort::TooLong } else { Abort::TooShort })
}

impl ValueType for bool {
    type Field = Self;
    const DATA_TYPE: DataType = DataType::Boolean;
    const CAPACITY: usize = 1;

    fn len(_: &Self) -> usize {
        1
    }

    fn read(field: &Self, offset: usize, to: &mut [u8]) -> usize {
        copy(&[u8::from(*field)], offset, to)
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
impl ValueType for &'static str {
    type Field = Self;
    const DATA_TYPE: DataType = DataType::VisibleString;
    const CAPACITY: usize = 0;

    fn len(field: &Self) -> usize {
        str::len(field)
    }

    fn read(field: &Self, offset: usize, to: &mut [u8]) -> usize {
        copy(field.as_bytes(), offset, to)
    }

    fn parse(_: &[u8]) -> Result<Self, Abort> {
        Err(Abort::ReadOnly)
    }
}

macro_rules! strings {
    ($($string:ident => $data_type:ident,)*) => {$(
        impl<const N: usize> ValueType for $string<N> {
            type Field = Self;
            const DATA_TYPE: DataType = DataType::$data_type;
            const CAPACITY: usize = N;

            fn len(field: &Self) -> usize {
                field.as_bytes().len()
            }

            fn read(field: &Self, offset: usize, to: &mut [u8]) -> usize {
                copy(field.as_bytes(), offset, to)
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

macro_rules! streamed {
    ($($(#[$doc:meta])* $name:ident => $data_type:ident;)*) => {$(
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        pub struct $name;

        impl ValueType for $name {
            type Field = Self;
            const DATA_TYPE: DataType = DataType::$data_type;
            const CAPACITY: usize = 0;
            const OPTIONS: Options = Options::NONE.streamed();

            fn len(_: &Self) -> usize {
                0
            }

            fn read(_: &Self, _: usize, _: &mut [u8]) -> usize {
                0
            }

            fn parse(_: &[u8]) -> Result<Self, Abort> {
                Ok(Self)
            }
        }
    )*};
}

streamed! {
    /// A DOMAIN: data of any length that the application keeps elsewhere, and reads and writes in parts.
    Domain => Domain;
    /// A VISIBLE_STRING of any length that the application keeps elsewhere, as a [`Domain`].
    LongText => VisibleString;
}
