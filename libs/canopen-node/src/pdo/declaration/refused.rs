//! PDOs that do not compile. The product has an input `0x6000:1`, an output `0x6000:2` and a value that is not mappable.

/// A mapping whose values do not exist:
/// ```compile_fail,E0080
/// # use canopen_node::{Application, Node, pdo::Tpdo};
/// # canopen_node::objects! { struct Machine, values MachineValue; 0x6000 "Values" { 1 "Input" input: u64 = 0, ro, mappable;
/// #     2 "Output" output: u8 = 0, wo, mappable; 3 "Private" private: u8 = 0, rw; } }
/// # impl Application for Machine {
/// const TPDOS: &'static [Tpdo] = &[Tpdo::new(&[(0x6000, 4)])];
/// # }
/// # const _: usize = Node::<Machine>::STORED_LEN;
/// ```
///
/// A value that is not mappable, or only in the other direction:
/// ```compile_fail,E0080
/// # use canopen_node::{Application, Node, pdo::Tpdo};
/// # canopen_node::objects! { struct Machine, values MachineValue; 0x6000 "Values" { 1 "Input" input: u64 = 0, ro, mappable;
/// #     2 "Output" output: u8 = 0, wo, mappable; 3 "Private" private: u8 = 0, rw; } }
/// # impl Application for Machine {
/// const TPDOS: &'static [Tpdo] = &[Tpdo::new(&[(0x6000, 3)])];
/// # }
/// # const _: usize = Node::<Machine>::STORED_LEN;
/// ```
/// ```compile_fail,E0080
/// # use canopen_node::{Application, Node, pdo::Tpdo};
/// # canopen_node::objects! { struct Machine, values MachineValue; 0x6000 "Values" { 1 "Input" input: u64 = 0, ro, mappable;
/// #     2 "Output" output: u8 = 0, wo, mappable; 3 "Private" private: u8 = 0, rw; } }
/// # impl Application for Machine {
/// const TPDOS: &'static [Tpdo] = &[Tpdo::new(&[(0x6000, 2)])];
/// # }
/// # const _: usize = Node::<Machine>::STORED_LEN;
/// ```
///
/// More than eight bytes:
/// ```compile_fail,E0080
/// # use canopen_node::{Application, Node, pdo::Tpdo};
/// # canopen_node::objects! { struct Machine, values MachineValue; 0x6000 "Values" { 1 "Input" input: u64 = 0, ro, mappable;
/// #     2 "Output" output: u8 = 0, wo, mappable; 3 "Private" private: u8 = 0, rw; } }
/// # impl Application for Machine {
/// const TPDOS: &'static [Tpdo] = &[Tpdo::new(&[(0x6000, 1), (0x6000, 1)])];
/// # }
/// # const _: usize = Node::<Machine>::STORED_LEN;
/// ```
///
/// More than 16 TPDOs:
/// ```compile_fail,E0080
/// # use canopen_node::{Application, Node, pdo::Tpdo};
/// # canopen_node::objects! { struct Machine, values MachineValue; 0x6000 "Values" { 1 "Input" input: u64 = 0, ro, mappable;
/// #     2 "Output" output: u8 = 0, wo, mappable; 3 "Private" private: u8 = 0, rw; } }
/// # impl Application for Machine {
/// const TPDOS: &'static [Tpdo] = &[Tpdo::UNUSED; 17];
/// # }
/// # const _: usize = Node::<Machine>::STORED_LEN;
/// ```
///
/// A transmission type with remote frames:
/// ```compile_fail,E0080
/// # use canopen_node::{Application, Node, pdo::Tpdo};
/// # canopen_node::objects! { struct Machine, values MachineValue; 0x6000 "Values" { 1 "Input" input: u64 = 0, ro, mappable;
/// #     2 "Output" output: u8 = 0, wo, mappable; 3 "Private" private: u8 = 0, rw; } }
/// # impl Application for Machine {
/// const TPDOS: &'static [Tpdo] = &[Tpdo::new(&[(0x6000, 1)]).with_transmission_type(253)];
/// # }
/// # const _: usize = Node::<Machine>::STORED_LEN;
/// ```
///
/// Without these faults:
/// ```
/// # use canopen_node::{Application, Node, pdo::Tpdo};
/// # canopen_node::objects! { struct Machine, values MachineValue; 0x6000 "Values" { 1 "Input" input: u64 = 0, ro, mappable;
/// #     2 "Output" output: u8 = 0, wo, mappable; 3 "Private" private: u8 = 0, rw; } }
/// # impl Application for Machine {
/// const TPDOS: &'static [Tpdo] = &[Tpdo::new(&[(0x6000, 1)]).with_transmission_type(254)];
/// # }
/// # const _: usize = Node::<Machine>::STORED_LEN;
/// ```
///
/// An RPDO of a value that only the device writes:
/// ```compile_fail,E0080
/// # use canopen_node::{Application, Node, pdo::Rpdo};
/// # canopen_node::objects! { struct Machine, values MachineValue; 0x6000 "Values" { 1 "Input" input: u64 = 0, ro, mappable;
/// #     2 "Output" output: u8 = 0, wo, mappable; 3 "Private" private: u8 = 0, rw; } }
/// # impl Application for Machine {
/// const RPDOS: &'static [Rpdo] = &[Rpdo::new(&[(0x6000, 1)])];
/// # }
/// # const _: usize = Node::<Machine>::STORED_LEN;
/// ```
/// ```
/// # use canopen_node::{Application, Node, pdo::Rpdo};
/// # canopen_node::objects! { struct Machine, values MachineValue; 0x6000 "Values" { 1 "Input" input: u64 = 0, ro, mappable;
/// #     2 "Output" output: u8 = 0, wo, mappable; 3 "Private" private: u8 = 0, rw; } }
/// # impl Application for Machine {
/// const RPDOS: &'static [Rpdo] = &[Rpdo::new(&[(0x6000, 2)])];
/// # }
/// # const _: usize = Node::<Machine>::STORED_LEN;
/// ```
struct Refused;
