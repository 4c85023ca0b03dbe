//! The types that a declared field may have: a value, or an array of values.

use core::{fmt::Debug, ops::RangeInclusive};

use super::ValueType;
use crate::sdo::Abort;

/// The type of a declared field: a value, or an array of values with consecutive sub-indices.
#[diagnostic::on_unimplemented(
    message = "`{Self}` is no type of an object",
    note = "types are `bool`, `i8` to `i64`, `u8` to `u64`, `f32`, `f64`, `&'static str`, and those of `canopen_node::application`, such as `Unsigned24`, `Text<16>` and `Domain`"
)]
pub trait FieldType {
    /// The type of each value.
    type Value: ValueType;
    /// The type of the field in the struct.
    type Field: Copy + Debug;
    /// A value that a client writes; with its place, from 0, if the field is an array.
    type Written: Copy + Debug;
    /// The number of values.
    const COUNT: u8;

    /// The value at a place.
    fn get(field: &Self::Field, at: u8) -> Option<&<Self::Value as ValueType>::Field>;

    /// The value that a client writes at a place.
    fn written(at: u8, value: <Self::Value as ValueType>::Field) -> Self::Written;

    /// Replaces a value.
    fn set(field: &mut Self::Field, written: Self::Written);
}

/// The type of each value of a field.
pub type ValueOf<T> = <T as FieldType>::Value;

/// A value of a field, as the struct has it.
pub type Plain<T> = <ValueOf<T> as ValueType>::Field;

impl<T: ValueType> FieldType for T {
    type Value = T;
    type Field = T::Field;
    type Written = T::Field;
    const COUNT: u8 = 1;

    fn get(field: &T::Field, _: u8) -> Option<&T::Field> {
        Some(field)
    }

    fn written(_: u8, value: T::Field) -> T::Field {
        value
    }

    fn set(field: &mut T::Field, written: T::Field) {
        *field = written;
    }
}

impl<T: ValueType, const N: usize> FieldType for [T; N] {
    type Value = T;
    type Field = [T::Field; N];
    type Written = (usize, T::Field);
    const COUNT: u8 = {
        assert!(N <= 254, "an array has at most 254 values");
        N as u8
    };

    fn get(field: &[T::Field; N], at: u8) -> Option<&T::Field> {
        field.get(usize::from(at))
    }

    fn written(at: u8, value: T::Field) -> (usize, T::Field) {
        (at.into(), value)
    }

    fn set(field: &mut [T::Field; N], (at, value): (usize, T::Field)) {
        if let Some(place) = field.get_mut(at) {
            *place = value;
        }
    }
}

/// The length of a value of a field in bytes.
pub fn len<T: FieldType>(field: &T::Field, at: u8) -> usize {
    T::get(field, at).map_or(0, T::Value::len)
}

/// Copies the bytes of a value of a field from `offset` to `to`; returns their number.
pub fn read<T: FieldType>(field: &T::Field, at: u8, offset: usize, to: &mut [u8]) -> usize {
    T::get(field, at).map_or(0, |value| T::Value::read(value, offset, to))
}

/// The bytes of a number in a field, the first as the lowest.
pub fn bits<T: FieldType>(field: &T::Field, at: u8) -> u64 {
    T::get(field, at).map_or(0, T::Value::bits)
}

/// Compares a value with its limits.
///
/// # Errors
/// [`Abort::TooLow`] or [`Abort::TooHigh`]. NaN is not between the limits.
pub fn check_limits<T: PartialOrd>(value: &T, limits: &RangeInclusive<T>) -> Result<(), Abort> {
    match limits.contains(value) {
        true => Ok(()),
        false if value < limits.start() => Err(Abort::TooLow),
        false => Err(Abort::TooHigh),
    }
}
