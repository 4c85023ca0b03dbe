//! The macro that declares the objects of a product, and what it makes at compile time.

use crate::object_dictionary::{Access, DataType, Entry, Object, row};

/// The row of a field of the declaration, and the number of its values.
pub type Row = (Entry, u8);

/// The number of values in these rows.
pub const fn count(mut rows: &[Row]) -> usize {
    let mut number = 0;
    while let [(_, count), others @ ..] = rows {
        number += *count as usize;
        rows = others;
    }
    number
}

/// The number of the first value of each field, of these numbers of values.
pub const fn firsts<const N: usize>(counts: [u8; N]) -> [u8; N] {
    let mut firsts = [0; N];
    let mut at = 1;
    while at < N {
        firsts[at] = counts[at - 1].wrapping_add(firsts[at - 1]);
        at += 1;
    }
    firsts
}

/// The table of these rows: an entry for each value, numbered, and the highest sub-index of each object that has one.
pub const fn table<const N: usize>(mut rows: &[Row]) -> [Entry; N] {
    let none = row(0, 0, DataType::Unsigned8, Access::Const, Object::HighestSubIndex(0));
    let mut table = [none; N];
    let (mut at, mut whole, mut number) = (0, 0, 0_u8);
    while let [(first, count), others @ ..] = rows {
        let mut position = 0;
        while position < *count {
            let mut entry = *first;
            entry.sub_index += position;
            if let Object::Application(place) = &mut entry.object {
                *place = number;
                number = number.wrapping_add(1);
            } else {
                whole = at;
            }
            table[at] = entry;
            if let Object::HighestSubIndex(highest) = &mut table[whole].object
                && table[whole].index == entry.index
            {
                *highest = entry.sub_index;
            }
            position += 1;
            at += 1;
        }
        rows = others;
    }
    table
}

/// The largest of these capacities, and at least that for the longest number, in bytes.
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
/// default, its access (`constant`, `ro`, `rw`, `rwr`, `rww`, `wo`), optional limits of a number, and options: `mappable`
/// into a PDO, `quiet` if a change of a mapped value alone shall not send an event-driven TPDO, `stored` by 1010h. The
/// limits are a range of numbers or constants.
///
/// The access decides which PDOs can carry a mappable value. `rwr` is that of a process input and `rww` that of a process
/// output (CiA 306): a client reads and writes both, and they are mappable without the option.
///
/// | access | TPDO | RPDO |
/// |---|---|---|
/// | `ro, mappable`, `constant, mappable`, `rwr` | yes | no |
/// | `rww`, `wo, mappable` | no | yes |
/// | `rw, mappable` | yes | yes |
///
/// An array has a value for each of its sub-indices, with the same access, limits and options. In the EDS their names
/// are numbered from 1. A value has the name of its field as types are written, with the place in the array:
///
/// ```
/// use canopen_node::{Application, objects, sdo::Abort};
///
/// const HIGHEST_GAIN: f32 = 2.0;
///
/// objects! {
///     /// The objects of a scale with four cells.
///     pub struct Scale, values ScaleValue;
///
///     0x2100 "Gains" {
///         1..=4 "Gain" gains: [f32; 4] = [1.0; 4], rw in 0.5..=HIGHEST_GAIN, stored;
///     }
/// }
///
/// impl Application for Scale {
///     fn accept(&mut self, value: &ScaleValue) -> Result<(), Abort> {
///         match *value {
///             ScaleValue::Gains((0, gain)) if gain != 1.0 => Err(Abort::InvalidValue), // Cell 1 is the reference.
///             _ => Ok(()),
///         }
///     }
/// }
///
/// assert_eq!(Scale::new().gains[3], 1.0);
/// ```
///
/// State that is no object stands before the objects, with its start value: `private lost: u8 = 0;`. A [`Domain`] or a
/// [`LongText`] names the methods that read and write it, or only the first: `rw with read_log and write_log`. They are
/// `fn(&self) -> &[u8]`, and `fn(&mut self, offset: usize, bytes: &[u8]) -> Result<(), Abort>`, which begins anew at
/// offset 0.
///
/// | type | of CiA 301 |
/// |---|---|
/// | `bool` | BOOLEAN |
/// | `i8`, `i16`, `i32`, `i64`, `u8`, `u16`, `u32`, `u64` | INTEGER8 to INTEGER64, UNSIGNED8 to UNSIGNED64 |
/// | [`Integer24`] to [`Integer56`], [`Unsigned24`] to [`Unsigned56`] | the same; fields of 32 or 64 bits hold them |
/// | `f32`, `f64` | REAL32, REAL64 |
/// | `&'static str`, [`Text`] | VISIBLE_STRING |
/// | [`OctetString`] | OCTET_STRING |
/// | [`LongText`] | VISIBLE_STRING of any length |
/// | [`Domain`] | DOMAIN |
///
/// [`Integer24`]: crate::application::Integer24
/// [`Integer56`]: crate::application::Integer56
/// [`Unsigned24`]: crate::application::Unsigned24
/// [`Unsigned56`]: crate::application::Unsigned56
/// [`Text`]: crate::application::Text
/// [`OctetString`]: crate::application::OctetString
/// [`LongText`]: crate::application::LongText
/// [`Domain`]: crate::application::Domain
///
/// # What does not compile
/// The build ends with the object and the fault: an index outside of 2001h to 9FFFh, objects that are not sorted or
/// declared twice, sub-indices without a name, a default or a limit out of range, an array with another number of
/// sub-indices, a mapped text, a stored domain, and a number `with` methods.
#[macro_export]
macro_rules! objects {
    (
        $(#[$attribute:meta])*
        $visibility:vis struct $name:ident, values $value:ident;
        $($(#[$state_attribute:meta])* private $state:ident: $state_type:ty = $start:expr;)*
        $($index:literal $($object:literal)? {
            $(
                $sub_index:literal $(..= $last:literal)? $text:literal
                $field:ident: $type:ty = $default:expr, $access:ident
                $(with $read:ident $(and $write:ident)?)? $(in $limits:expr)? $(, $option:ident)* ;
            )+
        })*
    ) => {
        $(#[$attribute])*
        #[derive(Clone, Debug)]
        $visibility struct $name {
            $($(#[$state_attribute])* $state: $state_type,)*
            $($(
                #[doc = $text]
                pub $field: <$type as $crate::application::FieldType>::Field,
            )+)*
        }

        $crate::private::pastey::paste! {
            /// A value for one of the objects.
            #[derive(Clone, Copy, Debug)]
            $visibility enum $value {
                $($(
                    #[doc = $text]
                    [<$field:camel>](<$type as $crate::application::FieldType>::Written),
                )+)*
            }
        }

        impl $name {
            /// The objects with their defaults.
            pub const fn new() -> Self {
                Self { $($state: $start,)* $($($field: $default,)+)* }
            }
        }

        impl Default for $name {
            fn default() -> Self {
                Self::new()
            }
        }

        const _: () = {
            use $crate::{application, object_dictionary, private, sdo, settings::parameters};

            #[allow(non_camel_case_types)]
            enum Field { $($($field,)+)* }

            const FIRSTS: [u8; <[Field]>::len(&[$($(Field::$field,)+)*])] =
                private::firsts([$($(<$type as application::FieldType>::COUNT,)+)*]);

            /// The place of a value in its field, if it is in the field.
            fn position<T: application::FieldType>(field: Field, value: u8) -> Option<u8> {
                let position = value.wrapping_sub(FIRSTS[field as usize]);
                (position < T::COUNT).then_some(position)
            }

            const ROWS: &[private::Row] = &[$(
                $($crate::objects!(@highest $index $object),)?
                $((
                    object_dictionary::Entry {
                        index: $index,
                        sub_index: $sub_index,
                        data_type: <private::ValueOf<$type> as application::ValueType>::DATA_TYPE,
                        access: $crate::objects!(@access $index $sub_index $access),
                        options: $crate::objects!(@options $access)
                            $(.and($crate::objects!(@option $index $sub_index $option)))*
                            .and(<private::ValueOf<$type> as application::ValueType>::OPTIONS),
                        object: object_dictionary::Object::Application(0),
                    },
                    <$type as application::FieldType>::COUNT,
                ),)+
            )*];

            #[allow(unused_variables, reason = "there may be no object yet")]
            impl application::Dictionary for $name {
                type Value = $value;
                type SdoBuffer = [u8; private::longest(&[
                    $($(<private::ValueOf<$type> as application::ValueType>::CAPACITY,)+)*
                ])];
                type Numbers = $crate::Count<
                    { <$name as $crate::Application>::TPDOS.len() },
                    { <$name as $crate::Application>::RPDOS.len() },
                    { <$name as $crate::Application>::PRODUCERS },
                >;

                const OBJECTS: &'static [object_dictionary::Entry] =
                    &private::table::<{ private::count(ROWS) }>(ROWS);

                fn descriptions() -> impl Iterator<Item = object_dictionary::Description> {
                    [$(
                        $((1, object_dictionary::Description {
                            object: Some($object.into()),
                            name: "Highest sub-index supported".into(),
                            default: object_dictionary::DefaultValue::Varies,
                            limits: None,
                        }),)?
                        $((<$type as application::FieldType>::COUNT, object_dictionary::Description {
                            object: None,
                            name: $text.into(),
                            default: object_dictionary::DefaultValue::OfApplication,
                            limits: $crate::objects!(@limits $type $(, $limits)?),
                        }),)+
                    )*]
                    .into_iter()
                    // With its type, since there may be no object yet.
                    .flat_map(|(count, description): (u8, object_dictionary::Description)| description.of_each(count))
                }

                const STORED_LEN: usize = {
                    const fn len<T: application::FieldType>(options: object_dictionary::Options) -> usize {
                        let len = parameters::HEADER + <T::Value as application::ValueType>::CAPACITY;
                        if options.is_stored() { len * T::COUNT as usize } else { 0 }
                    }
                    0 $($( + len::<$type>(
                        object_dictionary::Options::NONE
                            $(.and($crate::objects!(@option $index $sub_index $option)))*
                    ))+)*
                };

                fn len(&self, field: u8) -> usize {
                    $($(if let Some(at) = position::<$type>(Field::$field, field) {
                        return private::len::<$type>(&self.$field, at);
                    })+)*
                    0
                }

                fn read(&self, field: u8, offset: usize, to: &mut [u8]) -> usize {
                    $($(if let Some(at) = position::<$type>(Field::$field, field) {
                        return private::read::<$type>(&self.$field, at, offset, to);
                    })+)*
                    0
                }

                fn bits(&self, field: u8) -> u64 {
                    $($(if const {
                        $crate::objects!(@options $access)
                            $(.and($crate::objects!(@option $index $sub_index $option)))*
                            .is_mappable()
                    } {
                        if let Some(at) = position::<$type>(Field::$field, field) {
                            return private::bits::<$type>(&self.$field, at);
                        }
                    })+)*
                    0
                }

                fn parse(field: u8, bytes: &[u8]) -> Result<$value, sdo::Abort> {
                    $($(if let Some(at) = position::<$type>(Field::$field, field) {
                        let value = <private::ValueOf<$type> as application::ValueType>::parse(bytes)?;
                        $(private::check_limits(&value, &($limits))?;)?
                        let written = <$type as application::FieldType>::written(at, value);
                        return Ok($crate::private::pastey::paste!($value::[<$field:camel>])(written));
                    })+)*
                    Err(sdo::Abort::NoObject)
                }

                fn domain(&self, index: u16, sub_index: u8) -> Option<&[u8]> {
                    match (index, sub_index) {
                        $($($(($index, $sub_index) => Some(self.$read()),)?)+)*
                        _ => None,
                    }
                }

                fn write_part(
                    &mut self,
                    index: u16,
                    sub_index: u8,
                    offset: u32,
                    bytes: &[u8],
                ) -> Result<(), sdo::Abort> {
                    match (index, sub_index) {
                        $($($($(($index, $sub_index) => self.$write(offset as usize, bytes),)?)?)+)*
                        _ => Err(sdo::Abort::Hardware),
                    }
                }

                fn set(&mut self, value: $value) {
                    match value {
                        $($($crate::private::pastey::paste!($value::[<$field:camel>](value)) => {
                            <$type as application::FieldType>::set(&mut self.$field, value);
                        })+)*
                    }
                }
            }

            private::check(<$name as application::Dictionary>::OBJECTS);
            <<$name as application::Dictionary>::Numbers>::check::<$name>();
            $($(
                private::check_count(
                    $index,
                    &[$sub_index $(, $last)?],
                    <$type as application::FieldType>::COUNT,
                );
                $(private::check_methods(
                    $index,
                    $sub_index,
                    <private::ValueOf<$type> as application::ValueType>::OPTIONS,
                    $crate::objects!(@access $index $sub_index $access),
                    &[stringify!($read) $(, stringify!($write))?],
                );)?
                #[allow(unused_variables, reason = "there may be no limits")]
                let defaults: &[private::Plain<$type>] =
                    &$crate::objects!(@defaults $default $(, $last)?);
                $(
                    let limits: core::ops::RangeInclusive<private::Plain<$type>> = $limits;
                    let (low, high) = (*limits.start(), *limits.end());
                    let mut at = 0;
                    while at < defaults.len() {
                        if !(low <= defaults[at] && defaults[at] <= high) {
                            private::fail($index, $sub_index + at as u8, "its default is out of its limits");
                        }
                        at += 1;
                    }
                    if !<private::ValueOf<$type> as application::ValueType>::DATA_TYPE.reaches(low as i128, high as i128) {
                        private::fail($index, $sub_index, "a limit is out of the range of its type");
                    }
                )?
            )+)*
        };
    };
    (@defaults $value:expr) => { [$value] };
    (@defaults $array:expr, $last:literal) => { $array };
    (@highest $index:literal $object:literal) => {
        (
            object_dictionary::Entry {
                index: $index,
                sub_index: 0,
                data_type: object_dictionary::DataType::Unsigned8,
                access: object_dictionary::Access::Const,
                options: object_dictionary::Options::NONE,
                object: object_dictionary::Object::HighestSubIndex(0),
            },
            1,
        )
    };
    (@access $index:literal $sub_index:literal constant) => { object_dictionary::Access::Const };
    (@access $index:literal $sub_index:literal ro) => { object_dictionary::Access::ReadOnly };
    (@access $index:literal $sub_index:literal rw) => { object_dictionary::Access::ReadWrite };
    (@access $index:literal $sub_index:literal rwr) => { object_dictionary::Access::ReadWriteInput };
    (@access $index:literal $sub_index:literal rww) => { object_dictionary::Access::ReadWriteOutput };
    (@access $index:literal $sub_index:literal wo) => { object_dictionary::Access::WriteOnly };
    (@access $index:literal $sub_index:literal $other:ident) => {
        compile_error!(concat!(
            "object ", stringify!($index), " sub-index ", $sub_index, ": `", stringify!($other),
            "` is no access; there are constant, ro, rw, rwr, rww and wo",
        ))
    };
    (@option $index:literal $sub_index:literal mappable) => { object_dictionary::Options::NONE.mappable() };
    (@option $index:literal $sub_index:literal quiet) => { object_dictionary::Options::NONE.quiet() };
    (@option $index:literal $sub_index:literal stored) => { object_dictionary::Options::NONE.stored() };
    (@option $index:literal $sub_index:literal $other:ident) => {
        compile_error!(concat!(
            "object ", stringify!($index), " sub-index ", $sub_index, ": `", stringify!($other),
            "` is no option; there are mappable, quiet and stored",
        ))
    };
    (@options rwr) => { object_dictionary::Options::NONE.mappable() };
    (@options rww) => { object_dictionary::Options::NONE.mappable() };
    (@options $access:ident) => { object_dictionary::Options::NONE };
    (@limits $type:ty) => { None };
    (@limits $type:ty, $limits:expr) => {{
        let limits: core::ops::RangeInclusive<private::Plain<$type>> = $limits;
        Some(((*limits.start()).into(), (*limits.end()).into()))
    }};
}
