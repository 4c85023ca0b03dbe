//! The parameters of PDOs as a master sees them by SDO (CiA 301, 7.5.2.35 to 7.5.2.38), and a machine with PDOs for
//! these and other tests.

use std::cell::RefCell;

use canopen_node::{
    Application, Count, Frame,
    application::{Dictionary, Event},
    object_dictionary::{Description, Entry},
    objects,
    pdo::{Rpdo, Tpdo},
    sdo::Abort,
};
use testkit::{
    frames::{Frames, SILENCE, bytes},
    node_rig::NodeRig,
    sdo::Client,
};

pub const INVALID_VALUE: u32 = 0x0609_0030;
pub const DEVICE_STATE: u32 = 0x0800_0022;
const UNSUPPORTED_ACCESS: u32 = 0x0601_0000;
pub const NOT_MAPPABLE: u32 = 0x0604_0041;
pub const TOO_MANY_MAPPED: u32 = 0x0604_0042;
pub const INCOMPATIBLE: u32 = 0x0604_0043;
const NO_OBJECT: u32 = 0x0602_0000;
const NO_SUB_INDEX: u32 = 0x0609_0011;

objects! {
    /// A machine with inputs and outputs.
    pub struct Machine, values MachineValue;

    0x2100 {
        0 "Private" private: u8 = 0, rw;
    }
    0x6000 "Inputs" {
        1 "Buttons" buttons: u8 = 0, ro, mappable;
        2 "Level" level: u16 = 0, ro, mappable;
        3 "Position" position: i64 = 0, rwr;
    }
    0x6200 "Outputs" {
        1 "Lamps" lamps: u8 = 0, rw, mappable;
        2 "Speed" speed: u16 = 0, rww in 0..=1000;
        3 "Command" command: u32 = 0, wo, mappable;
    }
}

thread_local! {
    static EVENTS: RefCell<Vec<Event>> = const { RefCell::new(Vec::new()) };
}

/// The events of the machine since the last call.
pub fn take_events() -> Vec<Event> {
    EVENTS.take()
}

impl Application for Machine {
    const TPDOS: &'static [Tpdo] = &[
        Tpdo::new(&[(0x6000, 1), (0x6000, 2)]),
        Tpdo::new(&[(0x6000, 3)]).with_transmission_type(1),
        Tpdo::UNUSED,
    ];
    const RPDOS: &'static [Rpdo] = &[
        Rpdo::new(&[(0x6200, 1), (0x6200, 2)]),
        Rpdo::new(&[(0x0006, 0), (0x6200, 3)]).with_transmission_type(0),
    ];
    const PRODUCERS: usize = 2;

    fn accept(&mut self, value: &MachineValue) -> Result<(), Abort> {
        match value {
            MachineValue::Lamps(0xEE) => Err(Abort::InvalidValue),
            _ => Ok(()),
        }
    }

    fn handle(&mut self, event: Event) {
        EVENTS.with_borrow_mut(|events| events.push(event));
    }
}

/// The machine in a node with other numbers of PDOs and heartbeat producers.
#[derive(Clone, Default)]
pub struct With<const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>(pub Machine);

impl<const T: usize, const R: usize, const P: usize> With<T, R, P> {
    pub fn new() -> Self {
        Self::default()
    }
}

impl<const T: usize, const R: usize, const P: usize> Dictionary for With<T, R, P> {
    type Value = MachineValue;
    type SdoBuffer = <Machine as Dictionary>::SdoBuffer;
    type Numbers = Count<T, R, P>;
    const OBJECTS: &'static [Entry] = Machine::OBJECTS;
    const STORED_LEN: usize = Machine::STORED_LEN;

    fn descriptions() -> impl Iterator<Item = Description> {
        Machine::descriptions()
    }

    fn len(&self, field: u8) -> usize {
        self.0.len(field)
    }

    fn read(&self, field: u8, offset: usize, to: &mut [u8]) -> usize {
        self.0.read(field, offset, to)
    }

    fn parse(field: u8, bytes: &[u8]) -> Result<MachineValue, Abort> {
        Machine::parse(field, bytes)
    }

    fn set(&mut self, value: MachineValue) {
        self.0.set(value);
    }
}

impl<const T: usize, const R: usize, const P: usize> Application for With<T, R, P> {
    const TPDOS: &'static [Tpdo] = Machine::TPDOS.split_at(2).0;
    const RPDOS: &'static [Rpdo] = Machine::RPDOS;
}

pub type Board = NodeRig<Machine>;

/// A board with node-ID 40h and a machine: TPDO 1 has the COB-ID 1C0h, RPDO 1 the COB-ID 240h.
pub fn board() -> Board {
    let board = NodeRig::running(Machine::new());
    take_events();
    board
}

/// The same, in NMT operational.
pub fn operational() -> Board {
    let mut board = board();
    board.nmt("01 40");
    take_events();
    board
}

/// Sends the node a frame, `240: 01 02`; returns the frames that it sends at once.
pub fn receive(board: &mut Board, text: &str) -> Frames {
    let (cob_id, data) = text.split_once(':').expect("a COB-ID");
    let cob_id = u16::from_str_radix(cob_id, 16).expect("a COB-ID");
    board.receive(&Frame::new(cob_id, &bytes(data)).expect("a frame"))
}

/// Changes the machine; returns the frames that the node sends at once.
pub fn change(board: &mut Board, change: impl FnOnce(&mut Machine)) -> Frames {
    change(board.node.application_mut());
    board.pass_us(0)
}

/// Writes a number of this size in bytes.
pub fn write(
    board: &mut impl Client,
    index: u16,
    sub: u8,
    value: u32,
    size: usize,
) -> Result<(), u32> {
    board.download(index, sub, &value.to_le_bytes()[..size])
}

/// Sets a number of this size in bytes.
pub fn set(board: &mut impl Client, index: u16, sub: u8, value: u32, size: usize) {
    assert_eq!(write(board, index, sub, value, size), Ok(()), "{index:04X} sub {sub}: {value:X}");
}

/// Lets the PDO exist with this mapping, by the procedure of CiA 301.
pub fn map(board: &mut impl Client, parameter: u16, cob_id: u32, entries: &[u32]) {
    let mapping = parameter + 0x200;
    set(board, parameter, 1, 0x8000_0000 | cob_id, 4);
    set(board, mapping, 0, 0, 1);
    for (sub, entry) in (1..).zip(entries) {
        set(board, mapping, sub, *entry, 4);
    }
    set(board, mapping, 0, entries.len() as u32, 1);
    set(board, parameter, 1, cob_id, 4);
}

#[test]
fn a_new_device_has_the_pdos_that_its_product_declares() {
    let mut board = board();
    assert_eq!(board.number(0x1800, 0), 6);
    assert_eq!(board.number(0x1800, 1), 0x4000_01C0, "no remote frames");
    assert_eq!(board.number(0x1800, 2), 255);
    assert_eq!([3, 5, 6].map(|sub_index| board.number(0x1800, sub_index)), [0; 3]);
    assert_eq!(board.upload(0x1800, 4), Err(NO_SUB_INDEX));
    assert_eq!([0, 1, 2].map(|sub| board.number(0x1A00, sub)), [2, 0x6000_0108, 0x6000_0210]);
    assert_eq!(board.upload(0x1A00, 9), Err(NO_SUB_INDEX));
    assert_eq!((board.number(0x1801, 1), board.number(0x1801, 2)), (0x4000_02C0, 1));
    assert_eq!([0, 1, 2, 5].map(|sub| board.number(0x1400, sub)), [5, 0x240, 255, 0]);
    assert_eq!([3, 4].map(|sub| board.upload(0x1400, sub)), [Err(NO_SUB_INDEX), Err(NO_SUB_INDEX)]);
    assert_eq!([0, 1, 2].map(|sub| board.number(0x1601, sub)), [2, 0x0006_0010, 0x6200_0320]);
}

objects! {
    /// An input, with the highest numbers that can be declared.
    struct Input, values InputValue;

    0x6000 {
        0 "Input" input: u8 = 0, ro, mappable;
    }
}

impl Application for Input {
    const TPDOS: &'static [Tpdo] = &[Tpdo::new(&[(0x6000, 0); 8])
        .with_transmission_type(240)
        .with_inhibit_time(0xFFFF)
        .with_event_timer(0xFFFF)
        .with_sync_start_value(240); 4];
    const PRODUCERS: usize = 16;
}

#[test]
fn a_product_with_tpdos_alone_declares_the_highest_numbers() {
    let mut board = NodeRig::running(Input::new());
    let tpdo = [1, 2, 3, 5, 6].map(|sub| board.number(0x1803, sub));
    assert_eq!(tpdo, [0x4000_04C0, 240, 0xFFFF, 0xFFFF, 240]);
    assert_eq!([0, 1, 8].map(|sub| board.number(0x1A03, sub)), [8, 0x6000_0008, 0x6000_0008]);
    assert_eq!([0, 16].map(|sub| board.number(0x1016, sub)), [16, 0]);
    assert_eq!((board.number(0x1005, 0), board.number(0x1019, 0)), (0x80, 0));
}

#[test]
fn a_pdo_without_a_declaration_is_invalid_and_empty() {
    let mut board = board();
    assert_eq!(board.number(0x1802, 1), 0xC000_03C0);
    assert_eq!(board.number(0x1A02, 0), 0);
    assert_eq!(board.upload(0x1803, 1), Err(NO_OBJECT), "the node has three");
    assert_eq!(board.upload(0x1A03, 1), Err(NO_OBJECT));
    assert_eq!(board.upload(0x1402, 1), Err(NO_OBJECT), "the node has two");
    assert_eq!(board.upload(0x1602, 0), Err(NO_OBJECT));
    assert_eq!(board.upload(0x15FF, 0), Err(NO_OBJECT));
    assert_eq!(board.upload(0x17FF, 0), Err(NO_OBJECT));
}

#[test]
fn a_node_without_pdos_has_none_of_their_objects() {
    let mut board = NodeRig::with_node_id(0x40);
    for index in [0x1005, 0x1006, 0x1007, 0x1016, 0x1019, 0x1400, 0x1600, 0x1800, 0x1A00] {
        assert_eq!(board.upload(index, 0), Err(NO_OBJECT), "{index:04X}");
    }
}

#[test]
fn cob_ids_follow_the_node_id_that_lss_gives() {
    let mut board = operational();
    board.nmt("80 40");
    board.configure("11 05");
    board.nmt("82 40");
    board.lss("04 00");
    assert_eq!((board.number(0x1800, 1), board.number(0x1401, 1)), (0x4000_0185, 0x305));
    assert_eq!(board.nmt("01 05"), ["185: 00 00 00"]);
    assert_eq!(receive(&mut board, "205: 07 E8 03"), SILENCE);
    assert_eq!((board.node.application().lamps, board.node.application().speed), (7, 1000));
}

#[test]
fn a_valid_pdo_keeps_its_cob_id() {
    let mut board = board();
    for (parameter, old) in [(0x1800, 0x1C0), (0x1400, 0x240)] {
        assert_eq!(write(&mut board, parameter, 1, 0x333, 4), Err(DEVICE_STATE));
        set(&mut board, parameter, 1, old, 4);
        set(&mut board, parameter, 1, 0x8000_0333, 4);
        assert_eq!(board.number(parameter, 1) & 0xBFFF_FFFF, 0x8000_0333);
        set(&mut board, parameter, 1, 0x4000_0333, 4);
        assert_eq!(board.number(parameter, 1) & 0xBFFF_FFFF, 0x333);
        assert_eq!(write(&mut board, parameter, 1, old, 4), Err(DEVICE_STATE));
    }
}

#[test]
fn restricted_can_ids_and_29_bit_identifiers_are_refused() {
    let mut board = board();
    for parameter in [0x1800, 0x1400] {
        set(&mut board, parameter, 1, 0x8000_0000, 4);
        let ids = [0x000, 0x07F, 0x101, 0x180, 0x581, 0x5FF, 0x601, 0x67F, 0x6E0, 0x6FF, 0x701];
        for id in ids.into_iter().chain([0x77F, 0x780, 0x7FF, 0x2000_0333, 0x800]) {
            assert_eq!(write(&mut board, parameter, 1, id, 4), Err(INVALID_VALUE), "{id:X}");
        }
        for id in [0x100, 0x181, 0x57F, 0x680, 0x6DF] {
            set(&mut board, parameter, 1, id, 4);
            set(&mut board, parameter, 1, 0x8000_0000, 4);
        }
    }
}

#[test]
fn transmission_types_without_a_meaning_here_are_refused() {
    let mut board = board();
    for parameter in [0x1800, 0x1401] {
        for transmission_type in [241, 251, 252, 253] {
            let outcome = write(&mut board, parameter, 2, transmission_type, 1);
            assert_eq!(outcome, Err(INVALID_VALUE), "{transmission_type}");
        }
        for transmission_type in [0, 1, 240, 254, 255] {
            set(&mut board, parameter, 2, transmission_type, 1);
            assert_eq!(board.number(parameter, 2), transmission_type);
        }
    }
}

#[test]
fn inhibit_time_and_sync_start_value_of_a_valid_tpdo_stay() {
    let mut board = board();
    assert_eq!(write(&mut board, 0x1800, 3, 100, 2), Err(DEVICE_STATE));
    assert_eq!(write(&mut board, 0x1800, 6, 3, 1), Err(DEVICE_STATE));
    set(&mut board, 0x1800, 1, 0x8000_01C0, 4);
    set(&mut board, 0x1800, 3, 100, 2);
    set(&mut board, 0x1800, 6, 240, 1);
    assert_eq!(write(&mut board, 0x1800, 6, 241, 1), Err(INVALID_VALUE));
    assert_eq!((board.number(0x1800, 3), board.number(0x1800, 6)), (100, 240));
}

#[test]
fn a_mapping_changes_by_the_procedure_of_cia_301_only() {
    let mut board = board();
    for (parameter, entry) in [(0x1800, 0x6000_0210), (0x1400, 0x6200_0210)] {
        let mapping = parameter + 0x200;
        assert_eq!(write(&mut board, mapping, 0, 0, 1), Err(UNSUPPORTED_ACCESS), "it is valid");
        set(&mut board, parameter, 1, 0x8000_0333, 4);
        assert_eq!(write(&mut board, mapping, 1, entry, 4), Err(UNSUPPORTED_ACCESS), "sub 0 is 2");
        set(&mut board, mapping, 0, 0, 1);
        set(&mut board, mapping, 1, entry, 4);
        set(&mut board, mapping, 0, 1, 1);
        assert_eq!((board.number(mapping, 0), board.number(mapping, 1)), (1, entry));
    }
}

#[test]
fn an_object_that_cannot_be_mapped_is_refused() {
    let mut board = board();
    let mapping = |board: &mut Board, parameter: u16, entry| {
        set(board, parameter, 1, 0x8000_0333, 4);
        set(board, parameter + 0x200, 0, 0, 1);
        write(board, parameter + 0x200, 8, entry, 4)
    };
    let both =
        [0, 0x2100_0008, 0x1001_0008, 0x6000_0008, 0x6000_0408, 0x7000_0108, 0x6200_0108 + 1];
    let to_send = [0x0005_0008, 0x6200_0210, 0x6200_0320, 0x6000_0208, 0x6000_0110];
    let to_receive = [
        0x6000_0108,
        0x6000_0340,
        0x0001_0001,
        0x0001_0008,
        0x0005_0010,
        0x0005_0108,
        0x0008_0008,
        0x6200_0208,
    ];
    for entry in both.into_iter().chain(to_send) {
        assert_eq!(mapping(&mut board, 0x1800, entry), Err(NOT_MAPPABLE), "TPDO {entry:08X}");
    }
    for entry in both.into_iter().chain(to_receive) {
        assert_eq!(mapping(&mut board, 0x1400, entry), Err(NOT_MAPPABLE), "RPDO {entry:08X}");
    }
    for entry in [0x6000_0108, 0x6000_0340, 0x6200_0108] {
        assert_eq!(mapping(&mut board, 0x1800, entry), Ok(()), "TPDO {entry:08X}");
    }
    for entry in [0x6200_0108, 0x6200_0210, 0x6200_0320, 0x0002_0008, 0x0007_0020] {
        assert_eq!(mapping(&mut board, 0x1400, entry), Ok(()), "RPDO {entry:08X}");
    }
}

#[test]
fn a_mapping_has_up_to_8_objects_with_8_bytes() {
    let mut board = board();
    set(&mut board, 0x1800, 1, 0x8000_01C0, 4);
    set(&mut board, 0x1A00, 0, 0, 1);
    set(&mut board, 0x1A00, 1, 0x6000_0340, 4);
    set(&mut board, 0x1A00, 2, 0x6000_0108, 4);
    assert_eq!(write(&mut board, 0x1A00, 0, 2, 1), Err(TOO_MANY_MAPPED));
    assert_eq!(write(&mut board, 0x1A00, 0, 3, 1), Err(NOT_MAPPABLE), "sub 3 is empty");
    assert_eq!(write(&mut board, 0x1A00, 0, 9, 1), Err(TOO_MANY_MAPPED));
    assert_eq!(board.number(0x1A00, 0), 0);
    set(&mut board, 0x1A00, 0, 1, 1);
    let eight = [0x6000_0108; 8];
    map(&mut board, 0x1800, 0x1C0, &eight);
    board.node.application_mut().buttons = 5;
    assert_eq!(board.nmt("01 40"), ["1C0: 05 05 05 05 05 05 05 05"]);
}
