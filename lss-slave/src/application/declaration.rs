//! The macro that declares the objects of a product, and the checks of a declaration at compile time.

use crate::object_dictionary::{DataType, Entry, Object};

/// Checks the table of a product; panics, at compile time, with what is wrong.
#[doc(hidden)]
pub const fn check(objects: &[Entry]) {
    let mut at = 0;
    while at < objects.len() {
        let entry = &objects[at];
        assert!(
            0x2001 <= entry.index && entry.index <= 0x9FFF,
            "the index of an object must be 2001h to 9FFFh"
        );
        assert!(
            entry.data_type.size() > 0 || !entry.options.is_mappable(),
            "only numbers can be mapped into a PDO"
        );
        assert!(
            !matches!(entry.data_type, DataType::Domain) || !entry.options.is_stored(),
            "a DOMAIN is not stored: its application keeps it"
        );
        if at > 0 {
            let before = &objects[at - 1];
            assert!(
                before.index < entry.index
                    || before.index == entry.index && before.sub_index < entry.sub_index,
                "the objects must be sorted by index and sub-index, and none may occur twice"
            );
            assert!(
                before.index == entry.index || entry.sub_index == 0,
                "an object needs a sub-index 0: a name gives it one"
            );
        }
        at += 1;
    }
}

/// Checks a default; panics, at compile time, if it is out of its limits.
#[doc(hidden)]
pub const fn check_limits(default: i64, low: i64, high: i64) {
    assert!(low <= default && default <= high, "a default is out of its limits");
}

/// Fills in the highest sub-index of each object that has one.
#[doc(hidden)]
pub const fn complete<const N: usize>(mut objects: [Entry; N]) -> [Entry; N] {
    let mut highest = 0;
    let mut at = N;
    while at > 0 {
        at -= 1;
        let entry = &mut objects[at];
        if entry.sub_index > highest {
            highest = entry.sub_index;
        } else if let Object::HighestSubIndex(number) = &mut entry.object {
            *number = highest;
        }
        if entry.sub_index == 0 {
            highest = 0;
        }
    }
    objects
}

/// The largest of these capacities, and at least that for the longest number, in bytes.
#[doc(hidden)]
pub const fn longest(capacities: &[usize]) -> usize {
    let mut longest = 8;
    let mut at = 0;
    while at < capacities.len() {
        if capacities[at] > longest {
            longest = capacities[at];
        }
        at += 1;
    }
    longest
}

/// Declares the objects of a product: a struct whose fields are the values, and its
/// [`Dictionary`](crate::application::Dictionary).
///
/// A variable has one value with sub-index 0. An object with a name has values with sub-indices from 1; sub-index 0,
/// the highest sub-index, is added. A value is declared by its sub-index, its name in the EDS, its field, its type and
/// default, its access (`constant`, `ro`, `rw`, `wo`), optional limits of a number, and options: `mappable` into a PDO,
/// `stored` by 1010h.
///
/// A declaration does not compile if an object occurs twice or out of order, if its index is not one of 2001h to 9FFFh,
/// or if a default is out of its limits.
#[macro_export]
macro_rules! objects {
    (
        $(#[$attribute:meta])*
        $visibility:vis struct $name:ident, values $value:ident;
        $($index:literal $($object:literal)? {
            $(
                $sub_index:literal $text:literal $field:ident: $type:ty = $default:expr, $access:ident
                $(, $low:literal ..= $high:literal)? $(, $option:ident)* ;
            )+
        })*
    ) => {
        $(#[$attribute])*
        #[derive(Clone, Copy, Debug)]
        $visibility struct $name {
            $($(
                #[doc = $text]
                pub $field: $type,
            )+)*
        }

        /// A value for one of the objects.
        #[allow(non_camel_case_types, reason = "the variants have the names of the fields")]
        #[derive(Clone, Copy, Debug)]
        $visibility enum $value {
            $($(
                #[doc = $text]
                $field($type),
            )+)*
        }

        impl $name {
            /// The objects with their defaults.
            pub const fn new() -> Self {
                Self { $($($field: $default,)+)* }
            }
        }

        impl Default for $name {
            fn default() -> Self {
                Self::new()
            }
        }

        const _: () = {
            use $crate::{
                application::{self, Description, Dictionary, Value},
                object_dictionary::{Access, Entry, Object, Options},
                sdo::{Abort, Server},
            };

            #[allow(non_camel_case_types)]
            #[repr(u8)]
            enum Field { $($($field,)+)* }

            const LONGEST: usize = application::longest(&[$($(<$type as Value>::CAPACITY,)+)*]);

            impl Dictionary for $name {
                type Value = $value;
                type SdoServer = Server<LONGEST>;

                const OBJECTS: &'static [Entry] = &application::complete([$(
                    $($crate::objects!(@highest $index $object),)?
                    $(Entry {
                        index: $index,
                        sub_index: $sub_index,
                        data_type: <$type as Value>::DATA_TYPE,
                        access: $crate::objects!(@access $access),
                        options: Options::NONE$(.$option())*,
                        object: Object::Application(Field::$field as u8),
                    },)+
                )*]);

                const DESCRIPTIONS: &'static [Description] = &[$(
                    $(Description { name: $object, limits: None },)?
                    $(Description {
                        name: $text,
                        limits: $crate::objects!(@limits $($low, $high)?),
                    },)+
                )*];

                fn len(&self, field: u8) -> usize {
                    match field {
                        $($(_ if field == Field::$field as u8 => Value::len(&self.$field),)+)*
                        _ => 0,
                    }
                }

                fn read(&self, field: u8, offset: usize, to: &mut [u8]) -> usize {
                    match field {
                        $($(_ if field == Field::$field as u8 => Value::read(&self.$field, offset, to),)+)*
                        _ => 0,
                    }
                }

                fn parse(field: u8, bytes: &[u8]) -> Result<$value, Abort> {
                    match field {
                        $($(_ if field == Field::$field as u8 => {
                            let value: $type = Value::parse(bytes)?;
                            $(
                                if value < $low {
                                    return Err(Abort::TooLow);
                                }
                                if value > $high {
                                    return Err(Abort::TooHigh);
                                }
                            )?
                            Ok($value::$field(value))
                        })+)*
                        _ => Err(Abort::NoObject),
                    }
                }

                fn set(&mut self, value: $value) {
                    match value {
                        $($($value::$field(value) => self.$field = value,)+)*
                    }
                }
            }

            application::check(<$name as Dictionary>::OBJECTS);
            $($($(application::check_limits($default as i64, $low as i64, $high as i64);)?)+)*
        };
    };
    (@highest $index:literal $object:literal) => {
        Entry {
            index: $index,
            sub_index: 0,
            data_type: $crate::object_dictionary::DataType::Unsigned8,
            access: Access::Const,
            options: Options::NONE,
            object: Object::HighestSubIndex(0),
        }
    };
    (@access constant) => { Access::Const };
    (@access ro) => { Access::ReadOnly };
    (@access rw) => { Access::ReadWrite };
    (@access wo) => { Access::WriteOnly };
    (@limits) => { None };
    (@limits $low:literal, $high:literal) => { Some(($low as i64, $high as i64)) };
}
