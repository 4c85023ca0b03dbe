//! What people and tools need of the objects and the image does not: names, defaults and limits.

use core::fmt;

/// The description of a value, beside its [`Entry`](super::Entry).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Description {
    /// The name of the object, at sub-index 0 of one that has further sub-indices.
    pub object: Option<Name>,
    /// The name of the value.
    pub name: Name,
    /// The value of a new device. A highest sub-index is in the [`Entry`](super::Entry) itself.
    pub default: DefaultValue,
    /// The lowest and the highest legal number, if there are limits.
    pub limits: Option<(Number, Number)>,
}

impl Description {
    /// The descriptions of `count` values of this one's name.
    #[doc(hidden)]
    pub fn of_each(self, count: u8) -> impl Iterator<Item = Self> {
        let number = move |number| (count > 1).then_some(number);
        let name = move |at| Name { number: number(at), ..self.name };
        (1..=count).map(move |at| Self { name: name(at), ..self })
    }
}

/// The name of an object or a value, with a number if others have the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "the names say it")]
pub struct Name {
    pub text: &'static str,
    pub number: Option<u8>,
}

impl From<&'static str> for Name {
    fn from(text: &'static str) -> Self {
        Self { text, number: None }
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.text)?;
        self.number.map_or(Ok(()), |number| write!(f, " {number}"))
    }
}

/// The value of a new device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DefaultValue {
    /// None: the value differs from device to device or changes with time.
    Varies,
    /// A number.
    Number(u32),
    /// The node-ID and this number.
    NodeIdPlus(u32),
    /// A text.
    Text(&'static str),
    /// The value in a new application; see [`Dictionary::read`](crate::application::Dictionary::read).
    OfApplication,
}

/// A number of one of the data types.
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(missing_docs, reason = "the names say it")]
pub enum Number {
    Integer(i128),
    Real32(f32),
    Real64(f64),
}

impl fmt::Display for Number {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Integer(number) => number.fmt(f),
            Self::Real32(number) => number.fmt(f),
            Self::Real64(number) => number.fmt(f),
        }
    }
}

macro_rules! from {
    ($($variant:ident: $($number:ty)*;)*) => {$($(
        impl From<$number> for Number {
            fn from(number: $number) -> Self {
                Self::$variant(number.into())
            }
        }
    )*)*};
}

from! {
    Integer: i8 i16 i32 i64 u8 u16 u32 u64;
    Real32: f32;
    Real64: f64;
}
