//! Declarations that do not compile. Each is wrong in one place; its twin differs from it in that place only.

/// An object that occurs twice:
/// ```compile_fail,E0080
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Speed" speed: u16 = 0, rw; }
/// 0x2100 { 0 "Level" level: u16 = 0, rw; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
/// ```
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Speed" speed: u16 = 0, rw; }
/// 0x2101 { 0 "Level" level: u16 = 0, rw; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
///
/// A sub-index that occurs twice:
/// ```compile_fail,E0080
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 "Motor" { 1 "Speed" speed: u16 = 0, rw; 1 "Level" level: u16 = 0, rw; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
/// ```
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 "Motor" { 1 "Speed" speed: u16 = 0, rw; 2 "Level" level: u16 = 0, rw; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
///
/// Objects that are not sorted:
/// ```compile_fail,E0080
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2101 { 0 "Speed" speed: u16 = 0, rw; }
/// 0x2100 { 0 "Level" level: u16 = 0, rw; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
/// ```
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2101 { 0 "Speed" speed: u16 = 0, rw; }
/// 0x2102 { 0 "Level" level: u16 = 0, rw; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
///
/// An index of the node (2000h and below) or of nobody (above 9FFFh):
/// ```compile_fail,E0080
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2000 { 0 "Speed" speed: u16 = 0, rw; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
/// ```
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2001 { 0 "Speed" speed: u16 = 0, rw; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
///
/// A sub-index beside 0 of an object without a name:
/// ```compile_fail,E0080
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 { 1 "Speed" speed: u16 = 0, rw; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
/// ```
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 "Motor" { 1 "Speed" speed: u16 = 0, rw; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
///
/// A value with sub-index 0 and another beside it:
/// ```compile_fail,E0080
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Speed" speed: u16 = 0, rw; 1 "Level" level: u16 = 0, rw; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
/// ```
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 "Motor" { 1 "Speed" speed: u16 = 0, rw; 2 "Level" level: u16 = 0, rw; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
///
/// A default out of its limits:
/// ```compile_fail,E0080
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Speed" speed: u16 = 101, rw in 0..=100; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
/// ```
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Speed" speed: u16 = 100, rw in 0..=100; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
///
/// An array with another number of sub-indices:
/// ```compile_fail,E0080
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 "Speeds" { 1..=3 "Speed" speeds: [u16; 2] = [0; 2], rw; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
/// ```
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 "Speeds" { 1..=2 "Speed" speeds: [u16; 2] = [0; 2], rw; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
///
/// A default of an array out of its limits:
/// ```compile_fail,E0080
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 "Speeds" { 1..=2 "Speed" speeds: [u16; 2] = [0, 101], rw in 0..=100; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
/// ```
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 "Speeds" { 1..=2 "Speed" speeds: [u16; 2] = [0, 100], rw in 0..=100; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
///
/// A limit out of the range of the type:
/// ```compile_fail,E0080
/// # use canopen_node::application::Unsigned24;
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Speed" speed: Unsigned24 = 0, rw in 0..=16_777_216; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
/// ```
/// # use canopen_node::application::Unsigned24;
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Speed" speed: Unsigned24 = 0, rw in 0..=16_777_215; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
///
/// A text that is mapped into a PDO:
/// ```compile_fail,E0080
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Label" label: &'static str = "", ro, mappable; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
/// ```
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Label" label: &'static str = "", ro; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
///
/// A stored domain:
/// ```compile_fail,E0080
/// # use canopen_node::application::Domain;
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Log" log: Domain = Domain, ro, stored; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
/// ```
/// # use canopen_node::application::Domain;
/// # canopen_node::objects! { struct Objects, values Value;
/// 0x2100 { 0 "Log" log: Domain = Domain, ro; }
/// # }
/// # impl canopen_node::Application for Objects {}
/// ```
struct Refused;
