//! An application with a value of every kind and domains, for the tests of the SDO services.

use canopen_node::{
    Application, Count,
    application::{Dictionary, Domain, OctetString, Text},
    object_dictionary::{Description, Entry},
    objects,
    sdo::Abort,
};
use testkit::node_rig::NodeRig;

pub const CONSTANT: &str =
    "A constant text that is longer than every value that a client can write to this machine";

objects! {
    /// The values.
    pub struct Values, values MachineValue;

    0x2100 "Numbers" {
        1 "8 bits" u8: u8 = 8, rw in 5..=250;
        2 "16 bits" u16: u16 = 16, rw;
        3 "32 bits" u32: u32 = 32, ro;
        4 "64 bits" u64: u64 = 0x1122_3344_5566_7788, rw;
        5 "Command" command: u32 = 0, wo;
    }
    0x2200 "Strings" {
        1 "Constant" constant: &'static str = CONSTANT, constant;
        2 "Text" text: Text<20> = Text::EMPTY, rw;
        3 "Octets" octets: OctetString<40> = OctetString::EMPTY, rw;
    }
    0x2300 "Domains" {
        1 "Memory" memory: Domain = Domain, rw;
        2 "Log" log: Domain = Domain, ro;
    }
}

/// The values, and a memory that domain 2300h sub-index 1 writes and both domains read.
#[derive(Clone)]
pub struct Machine {
    pub values: Values,
    pub memory: Vec<u8>,
    /// What a client writes, until the end of the transfer.
    pub draft: Option<Vec<u8>>,
    /// The calls of `end_domain` and `abort_domain`.
    pub ended: u32,
    pub aborted: u32,
    /// The reason to refuse the next part or the end of a domain.
    pub refuse_part: Option<Abort>,
    pub refuse_end: Option<Abort>,
}

impl Application for Values {}

impl Dictionary for Machine {
    type Value = MachineValue;
    type SdoBuffer = <Values as Dictionary>::SdoBuffer;
    type Numbers = Count<0, 0, 0>;
    const OBJECTS: &'static [Entry] = Values::OBJECTS;
    const STORED_LEN: usize = Values::STORED_LEN;

    fn descriptions() -> impl Iterator<Item = Description> {
        Values::descriptions()
    }

    fn len(&self, field: u8) -> usize {
        self.values.len(field)
    }

    fn read(&self, field: u8, offset: usize, to: &mut [u8]) -> usize {
        self.values.read(field, offset, to)
    }

    fn parse(field: u8, bytes: &[u8]) -> Result<MachineValue, Abort> {
        Values::parse(field, bytes)
    }

    fn set(&mut self, value: MachineValue) {
        self.values.set(value);
    }
}

impl Application for Machine {
    fn accept(&mut self, value: &MachineValue) -> Result<(), Abort> {
        match value {
            MachineValue::U16(0xDEAD) | MachineValue::U64(0xDEAD) => Err(Abort::DeviceState),
            _ => Ok(()),
        }
    }

    fn domain_len(&mut self, _: u16, _: u8) -> Result<u32, Abort> {
        if self.memory.is_empty() { Err(Abort::NoData) } else { Ok(self.memory.len() as u32) }
    }

    fn read_domain(&self, _: u16, _: u8, offset: u32, to: &mut [u8]) -> usize {
        let from = self.memory.get(offset as usize..).unwrap_or_default();
        let len = from.len().min(to.len());
        to[..len].copy_from_slice(&from[..len]);
        len
    }

    fn write_domain(&mut self, at: u16, sub: u8, offset: u32, bytes: &[u8]) -> Result<(), Abort> {
        assert_eq!((at, sub), (0x2300, 1));
        if let Some(refusal) = self.refuse_part {
            return Err(refusal);
        }
        let draft = self.draft.get_or_insert_default();
        assert_eq!(offset as usize, draft.len(), "the parts follow each other");
        draft.extend(bytes);
        Ok(())
    }

    fn end_domain(&mut self, at: u16, sub: u8, len: u32) -> Result<(), Abort> {
        assert_eq!((at, sub), (0x2300, 1));
        if let Some(refusal) = self.refuse_end {
            return Err(refusal);
        }
        self.memory = self.draft.take().unwrap_or_default();
        assert_eq!(len as usize, self.memory.len());
        self.ended += 1;
        Ok(())
    }

    fn abort_domain(&mut self, at: u16, sub: u8) {
        assert_eq!((at, sub), (0x2300, 1));
        self.draft = None;
        self.aborted += 1;
    }
}

/// A board with node-ID 40h and the machine.
pub fn board() -> NodeRig<Machine> {
    let machine = Machine {
        values: Values::new(),
        memory: Vec::new(),
        draft: None,
        ended: 0,
        aborted: 0,
        refuse_part: None,
        refuse_end: None,
    };
    NodeRig::running(machine)
}

/// The same with `len` bytes in its memory.
pub fn board_with_memory(len: usize) -> NodeRig<Machine> {
    let mut board = board();
    board.node.application_mut().memory = bytes(len);
    board.pass_us(0);
    board
}

/// Bytes that differ from those before.
pub fn bytes(len: usize) -> Vec<u8> {
    (0..len).map(|at| (at * 7 + at / 251 + 1) as u8).collect()
}
