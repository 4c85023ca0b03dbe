//! The macro that declares the objects of a product, and the checks of a declaration at compile time.

use crate::object_dictionary::{Access, DataType, Entry, Object};

/// Checks the table of a product; panics, at compile time, with what is wrong.
#[doc(hidden)]
pub const fn check(objects: &[Entry]) {
    assert!(objects.len() <= 256, "there are more than 256 objects");
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
        assert!(
            !matches!(entry.access, Access::Const) || !entry.options.is_stored(),
            "a constant is not stored"
        );
        let mut is_part = false;
        if at > 0 {
            let before = &objects[at - 1];
            assert!(
                before.index < entry.index
                    || before.index == entry.index && before.sub_index < entry.sub_index,
                "the objects must be sorted by index and sub-index, and none may occur twice"
            );
            let is_whole =
                before.sub_index == 0 && !matches!(before.object, Object::HighestSubIndex(_));
            is_part = before.index == entry.index && !is_whole;
        }
        assert!(entry.sub_index == 0 || is_part, "an object with sub-indices needs a name");
        at += 1;
    }
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
/// | type | of CiA 301 |
/// |---|---|
/// | `bool` | BOOLEAN |
/// | `i8`, `i16`, `i32`, `i64`, `u8`, `u16`, `u32`, `u64` | INTEGER8 to INTEGER64, UNSIGNED8 to UNSIGNED64 |
/// | [`Integer24`] to [`Integer56`], [`Unsigned24`] to [`Unsigned56`] | the same; fields of 32 or 64 bits hold them |
/// | `f32`, `f64` | REAL32, REAL64 |
/// | `&'static str`, [`Text`] | VISIBLE_STRING |
/// | [`OctetString`] | OCTET_STRING |
/// | [`Domain`] | DOMAIN |
///
/// [`Integer24`]: crate::application::Integer24
/// [`Integer56`]: crate::application::Integer56
/// [`Unsigned24`]: crate::application::Unsigned24
/// [`Unsigned56`]: crate::application::Unsigned56
/// [`Text`]: crate::application::Text
/// [`OctetString`]: crate::application::OctetString
/// [`Domain`]: crate::application::Domain
///
/// # What does not compile
/// Each of these declarations is wrong in one place; its twin differs from it in that place only.
///
/// An object that occurs twice:
/// ```compile_fail,E0080
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Speed" speed: u16 = 0, rw; }
/// 0x2100 { 0 "Level" level: u16 = 0, rw; }
/// # }
/// ```
/// ```
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Speed" speed: u16 = 0, rw; }
/// 0x2101 { 0 "Level" level: u16 = 0, rw; }
/// # }
/// ```
///
/// A sub-index that occurs twice:
/// ```compile_fail,E0080
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 "Motor" { 1 "Speed" speed: u16 = 0, rw; 1 "Level" level: u16 = 0, rw; }
/// # }
/// ```
/// ```
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 "Motor" { 1 "Speed" speed: u16 = 0, rw; 2 "Level" level: u16 = 0, rw; }
/// # }
/// ```
///
/// Objects that are not sorted:
/// ```compile_fail,E0080
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2101 { 0 "Speed" speed: u16 = 0, rw; }
/// 0x2100 { 0 "Level" level: u16 = 0, rw; }
/// # }
/// ```
/// ```
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2101 { 0 "Speed" speed: u16 = 0, rw; }
/// 0x2102 { 0 "Level" level: u16 = 0, rw; }
/// # }
/// ```
///
/// An index of the node (2000h and below) or of nobody (above 9FFFh):
/// ```compile_fail,E0080
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2000 { 0 "Speed" speed: u16 = 0, rw; }
/// # }
/// ```
/// ```
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2001 { 0 "Speed" speed: u16 = 0, rw; }
/// # }
/// ```
///
/// A sub-index beside 0 of an object without a name:
/// ```compile_fail,E0080
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 { 1 "Speed" speed: u16 = 0, rw; }
/// # }
/// ```
/// ```
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 "Motor" { 1 "Speed" speed: u16 = 0, rw; }
/// # }
/// ```
///
/// A value with sub-index 0 and another beside it:
/// ```compile_fail,E0080
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Speed" speed: u16 = 0, rw; 1 "Level" level: u16 = 0, rw; }
/// # }
/// ```
/// ```
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 "Motor" { 1 "Speed" speed: u16 = 0, rw; 2 "Level" level: u16 = 0, rw; }
/// # }
/// ```
///
/// A default out of its limits:
/// ```compile_fail,E0080
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Speed" speed: u16 = 101, rw, 0..=100; }
/// # }
/// ```
/// ```
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Speed" speed: u16 = 100, rw, 0..=100; }
/// # }
/// ```
///
/// A limit out of the range of the type:
/// ```compile_fail,E0080
/// # use lss_slave::application::Unsigned24;
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Speed" speed: Unsigned24 = 0, rw, 0..=16_777_216; }
/// # }
/// ```
/// ```
/// # use lss_slave::application::Unsigned24;
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Speed" speed: Unsigned24 = 0, rw, 0..=16_777_215; }
/// # }
/// ```
///
/// A text that is mapped into a PDO:
/// ```compile_fail,E0080
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Label" label: &'static str = "", ro, mappable; }
/// # }
/// ```
/// ```
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Label" label: &'static str = "", ro; }
/// # }
/// ```
///
/// A stored domain:
/// ```compile_fail,E0080
/// # use lss_slave::application::Domain;
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Log" log: Domain = Domain, ro, stored; }
/// # }
/// ```
/// ```
/// # use lss_slave::application::Domain;
/// # lss_slave::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Log" log: Domain = Domain, ro; }
/// # }
/// ```
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
                pub $field: <$type as $crate::application::Value>::Field,
            )+)*
        }

        /// A value for one of the objects.
        #[allow(non_camel_case_types, reason = "the variants have the names of the fields")]
        #[derive(Clone, Copy, Debug)]
        $visibility enum $value {
            $($(
                #[doc = $text]
                $field(<$type as $crate::application::Value>::Field),
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
            use $crate::{application, emergency, object_dictionary, sdo, settings::parameters};

            #[allow(non_camel_case_types)]
            enum Field { $($($field,)+)* }

            const LONGEST: usize =
                application::longest(&[$($(<$type as application::Value>::CAPACITY,)+)*]);

            #[allow(unused_variables, reason = "there may be no object yet")]
            impl application::Dictionary for $name {
                type Value = $value;
                type SdoBuffer = [u8; LONGEST];
                type Errors = $crate::objects!(@errors $($index)*);

                const OBJECTS: &'static [object_dictionary::Entry] = &application::complete([$(
                    $($crate::objects!(@highest $index $object),)?
                    $(object_dictionary::Entry {
                        index: $index,
                        sub_index: $sub_index,
                        data_type: <$type as application::Value>::DATA_TYPE,
                        access: $crate::objects!(@access $access),
                        options: object_dictionary::Options::NONE$(.$option())*,
                        object: object_dictionary::Object::Application(Field::$field as u8),
                    },)+
                )*]);

                fn descriptions() -> impl Iterator<Item = object_dictionary::Description> {
                    [$(
                        $(object_dictionary::Description {
                            object: Some($object),
                            name: "Highest sub-index supported",
                            default: object_dictionary::DefaultValue::Varies,
                            limits: None,
                        },)?
                        $(object_dictionary::Description {
                            object: None,
                            name: $text,
                            default: object_dictionary::DefaultValue::OfApplication,
                            limits: $crate::objects!(@limits $type $(, $low, $high)?),
                        },)+
                    )*]
                    .into_iter()
                }

                const STORED_LEN: usize = {
                    const fn len<T: application::Value>(options: object_dictionary::Options) -> usize {
                        if options.is_stored() { parameters::HEADER + T::CAPACITY } else { 0 }
                    }
                    0 $($( + len::<$type>(object_dictionary::Options::NONE$(.$option())*))+)*
                };

                fn len(&self, field: u8) -> usize {
                    match field {
                        $($(_ if field == Field::$field as u8 => <$type as application::Value>::len(&self.$field),)+)*
                        _ => 0,
                    }
                }

                fn read(&self, field: u8, offset: usize, to: &mut [u8]) -> usize {
                    match field {
                        $($(_ if field == Field::$field as u8 => <$type as application::Value>::read(&self.$field, offset, to),)+)*
                        _ => 0,
                    }
                }

                fn parse(field: u8, bytes: &[u8]) -> Result<$value, sdo::Abort> {
                    match field {
                        $($(_ if field == Field::$field as u8 => {
                            let value = <$type as application::Value>::parse(bytes)?;
                            $(
                                // A real number that is none is not between the limits.
                                if !($low..=$high).contains(&value) {
                                    return Err(if value < $low { sdo::Abort::TooLow } else { sdo::Abort::TooHigh });
                                }
                            )?
                            Ok($value::$field(value))
                        })+)*
                        _ => Err(sdo::Abort::NoObject),
                    }
                }

                fn set(&mut self, value: $value) {
                    match value {
                        $($($value::$field(value) => self.$field = value,)+)*
                    }
                }
            }

            application::check(<$name as application::Dictionary>::OBJECTS);
            $($($(
                let (default, low, high): $crate::objects!(@three $type) = ($default, $low, $high);
                assert!(low <= default && default <= high, "a default is out of its limits");
                assert!(
                    <$type as application::Value>::DATA_TYPE.reaches($low as i128, $high as i128),
                    "a limit is out of the range of its type"
                );
            )?)+)*
        };
    };
    (@three $type:ty) => {
        (
            <$type as application::Value>::Field,
            <$type as application::Value>::Field,
            <$type as application::Value>::Field,
        )
    };
    (@errors) => { [emergency::Report; 0] };
    (@errors $($index:literal)+) => { [emergency::Report; 8] };
    (@highest $index:literal $object:literal) => {
        object_dictionary::Entry {
            index: $index,
            sub_index: 0,
            data_type: object_dictionary::DataType::Unsigned8,
            access: object_dictionary::Access::Const,
            options: object_dictionary::Options::NONE,
            object: object_dictionary::Object::HighestSubIndex(0),
        }
    };
    (@access constant) => { object_dictionary::Access::Const };
    (@access ro) => { object_dictionary::Access::ReadOnly };
    (@access rw) => { object_dictionary::Access::ReadWrite };
    (@access wo) => { object_dictionary::Access::WriteOnly };
    (@limits $type:ty) => { None };
    (@limits $type:ty, $low:literal, $high:literal) => {
        Some((
            <<$type as application::Value>::Field>::into($low),
            <<$type as application::Value>::Field>::into($high),
        ))
    };
}
