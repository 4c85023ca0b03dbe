//! The measured sessions of an LSS master, of an SDO client and of a PDO's producer, each with a program that has just
//! started.

use std::{ops::RangeInclusive, path::Path};

use anyhow::{Context, bail, ensure};
use canopen_node::{BitRate, Frame, Instant, lss::Request, nmt, sdo};
use lss_master::{Bus, Fastscan, Identify, InquireAddress, Master, Procedure, Select, Timing};

use super::machine::{Cost, Machine, Reception};

/// The LSS address of every slave (`IDENTITY` in `tests/peers/src/lib.rs`); half of its bits are ones.
const IDENTITY: [u32; 4] = [0x5AA5_3CC3, 0x0FF0_A55A, 0x3333_CCCC, 0x6996_9669];
/// A frame of another node: its first transmit PDO.
const FOREIGN_COB_ID: u16 = 0x18A;

/// The node-ID that the master assigns.
const NODE_ID: u8 = 5;

/// Gives one or two costs; none: not supported.
type Measurement = fn(&mut Machine) -> anyhow::Result<Vec<Cost>>;
/// A measurement with the head of its column.
pub type Column = ([&'static str; 2], Measurement);

/// The measurements of LSS.
pub const LSS: [Column; 7] = [
    (["inquire", "/answer"], inquire),
    (["select", "x4"], select),
    (["node-ID", ""], configure),
    (["fastscan", "hit/miss"], |machine| Ok(fastscan(machine)?.1)),
    (["scan", "x133"], |machine| Ok(vec![fastscan(machine)?.0])),
    (["identify", "x6"], identify),
    (["foreign", "frame"], ignore),
];

/// The measurements of a node with a node-ID.
pub const NODE: [Column; 5] = [
    (["SDO", "upload"], |machine| request_sdo(machine, [0x40, 0x18, 0x10, 1, 0, 0, 0, 0], 0x43)),
    (["SDO", "download"], |machine| {
        request_sdo(machine, [0x2B, 0x17, 0x10, 0, 0xE8, 3, 0, 0], 0x60)
    }),
    (["SDO", "abort"], |machine| request_sdo(machine, [0x40, 0, 0x50, 0, 0, 0, 0, 0], 0x80)),
    (["22 bytes", "by SDO"], upload_segments),
    (["RPDO", ""], receive_pdo),
];

/// The costs of a slave's services.
pub struct Costs {
    /// Those of each measurement.
    pub costs: Vec<Vec<Cost>>,
    /// The largest stack use in bytes.
    pub stack: u32,
}

impl Costs {
    /// Runs the program through these measurements.
    ///
    /// # Errors
    /// A procedure fails, so that its cost is meaningless.
    pub fn measure(elf: &Path, columns: &[Column]) -> anyhow::Result<Self> {
        let mut costs = Self { costs: Vec::new(), stack: 0 };
        for (_, measurement) in columns {
            let mut machine = Machine::start(elf)?;
            // The first frame differs from the others: for example, it may prove the bit rate.
            let begun = carry_out(&mut machine, Request::SwitchToWaiting);
            let measured = begun.and_then(|_| measurement(&mut machine));
            costs.costs.push(measured.with_context(|| format!("in {}", elf.display()))?);
            costs.stack = costs.stack.max(machine.stack_used());
        }
        Ok(costs)
    }
}

/// The whole cost, and the part of it up to the request to transmit the answer.
fn inquire(machine: &mut Machine) -> anyhow::Result<Vec<Cost>> {
    carry_out(machine, Request::SwitchToConfiguration)?;
    let (address, costs) = carry_out(machine, InquireAddress::new())?;
    ensure!(address == IDENTITY.into(), "the LSS address is {address:X?}");
    let Reception { cost, answer } = costs[0].1;
    Ok(vec![cost, answer.map_or(cost, |(_, cost)| cost)])
}

fn configure(machine: &mut Machine) -> anyhow::Result<Vec<Cost>> {
    carry_out(machine, Request::SwitchToConfiguration)?;
    let (_, costs) = carry_out(machine, Request::ConfigureNodeId(NODE_ID))?;
    Ok(vec![costs[0].1.cost])
}

/// The cost of all four requests.
fn select(machine: &mut Machine) -> anyhow::Result<Vec<Cost>> {
    let (_, costs) = carry_out(machine, Select(IDENTITY.into()))?;
    Ok(vec![sum(&costs, 0x40..=0x43)])
}

/// The cost of a whole scan, and those of the first request with an answer and the first without.
fn fastscan(machine: &mut Machine) -> anyhow::Result<(Cost, Vec<Cost>)> {
    let (found, mut costs) = carry_out(machine, Fastscan::new())?;
    ensure!(found == Some(IDENTITY.into()), "Fastscan finds {found:X?}");
    costs.retain(|(command, _)| *command == 0x51);
    ensure!(costs.len() == 133, "{} requests", costs.len());
    // The first request starts the scan; the second is the first that compares.
    let first = |is_match: bool| {
        let mut compared = costs.iter().skip(1).map(|(_, reception)| reception);
        compared.find(|reception| reception.answer.is_some() == is_match)
    };
    let found = [true, false].into_iter().filter_map(first).map(|reception| reception.cost);
    Ok((sum(&costs, 0x51..=0x51), found.collect()))
}

/// The cost of all six requests.
fn identify(machine: &mut Machine) -> anyhow::Result<Vec<Cost>> {
    let [vendor_id, product_code, revision, serial] = IDENTITY;
    let identify = Identify {
        vendor_id,
        product_code,
        revision_numbers: revision - 1..=revision + 1,
        serial_numbers: serial - 1..=serial + 1,
    };
    let (is_answered, costs) = carry_out(machine, identify)?;
    Ok(if is_answered { vec![sum(&costs, 0x46..=0x4B)] } else { Vec::new() })
}

fn ignore(machine: &mut Machine) -> anyhow::Result<Vec<Cost>> {
    let reception = machine.receive(&frame(FOREIGN_COB_ID, &[0x11; 8]))?;
    ensure!(reception.answer.is_none(), "a foreign frame is answered");
    Ok(vec![reception.cost])
}

/// Assigns the node-ID and starts the node, which is then NMT operational.
fn start(machine: &mut Machine) -> anyhow::Result<()> {
    carry_out(machine, Request::SwitchToConfiguration)?;
    carry_out(machine, Request::ConfigureNodeId(NODE_ID))?;
    carry_out(machine, Request::SwitchToWaiting)?;
    // One of the slaves applies the node-ID at this reset.
    for command in [0x82, 0x80, 0x01] {
        machine.receive(&frame(nmt::COMMAND_COB_ID, &[command, NODE_ID]))?;
    }
    Ok(())
}

/// The cost of an SDO request, whose answer begins with `expected`.
fn request_sdo(machine: &mut Machine, request: [u8; 8], expected: u8) -> anyhow::Result<Vec<Cost>> {
    start(machine)?;
    Ok(vec![ask_sdo(machine, request, expected)?])
}

fn ask_sdo(machine: &mut Machine, request: [u8; 8], expected: u8) -> anyhow::Result<Cost> {
    let reception = machine.receive(&frame(sdo::REQUEST_COB_ID + u16::from(NODE_ID), &request))?;
    let Some((answer, _)) = reception.answer else {
        bail!("no answer to {request:02X?}");
    };
    // The bits for the number of unused bytes may stay 0.
    ensure!(
        answer.data()[0] & !0x0E == expected & !0x0E,
        "{request:02X?} is answered by {answer:?}"
    );
    Ok(reception.cost)
}

/// The cost of the four requests that upload the device name.
fn upload_segments(machine: &mut Machine) -> anyhow::Result<Vec<Cost>> {
    start(machine)?;
    let mut sum = ask_sdo(machine, [0x40, 8, 0x10, 0, 0, 0, 0, 0], 0x41)?;
    for (command, answer) in [(0x60, 0), (0x70, 0x10), (0x60, 0), (0x70, 0x1D)] {
        sum += ask_sdo(machine, [command, 0, 0, 0, 0, 0, 0, 0], answer)?;
    }
    Ok(vec![sum])
}

/// The cost of an RPDO of four bytes; none if the node's answer to an upload does not have them.
fn receive_pdo(machine: &mut Machine) -> anyhow::Result<Vec<Cost>> {
    const DATA: [u8; 4] = [1, 2, 3, 4];
    start(machine)?;
    let reception = machine.receive(&frame(0x200 + u16::from(NODE_ID), &DATA))?;
    let request = frame(sdo::REQUEST_COB_ID + u16::from(NODE_ID), &[0x40, 0, 0x21, 0, 0, 0, 0, 0]);
    let answer = machine.receive(&request)?.answer;
    let has_arrived = answer.is_some_and(|(answer, _)| answer.data()[4..] == DATA);
    Ok(if has_arrived { vec![reception.cost] } else { Vec::new() })
}

fn frame(cob_id: u16, data: &[u8]) -> Frame {
    Frame::new(cob_id, data).expect("a legal frame")
}

/// What a program makes of the requests of a procedure, by their command specifiers.
type Receptions = Vec<(u8, Reception)>;

fn sum(costs: &Receptions, commands: RangeInclusive<u8>) -> Cost {
    let of_commands = costs.iter().filter(|(command, _)| commands.contains(command));
    of_commands.fold(Cost::default(), |mut sum, (_, Reception { cost, .. })| {
        sum += *cost;
        sum
    })
}

/// Carries out a procedure of the master, to whom no time passes but for an answer that does not come.
fn carry_out<P: Procedure>(
    machine: &mut Machine,
    procedure: P,
) -> anyhow::Result<(P::Output, Receptions)> {
    let now = Instant::from_micros(0);
    let mut slave = Slave { machine, now, receptions: Vec::new(), answer: None };
    let output = lss_master::run(&mut slave, &mut Master::new(Timing::default()), procedure)??;
    Ok((output, slave.receptions))
}

/// The bus of a program.
struct Slave<'a> {
    machine: &'a mut Machine,
    now: Instant,
    receptions: Receptions,
    answer: Option<Frame>,
}

impl Bus for Slave<'_> {
    type Error = anyhow::Error;

    fn now(&self) -> Instant {
        self.now
    }

    fn send(&mut self, request: &Frame) -> anyhow::Result<()> {
        let reception = self.machine.receive(request)?;
        self.answer = reception.answer.map(|(frame, _)| frame);
        self.receptions.push((request.data()[0], reception));
        Ok(())
    }

    fn receive(
        &mut self,
        until: Instant,
        mut take: impl FnMut(&Frame, Instant),
    ) -> anyhow::Result<()> {
        match self.answer.take() {
            Some(frame) => take(&frame, self.now),
            None => self.now = until,
        }
        Ok(())
    }

    fn set_bit_rate(&mut self, _: BitRate) -> anyhow::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn half_of_the_bits_that_a_full_scan_asks_for_are_ones() {
        let ones: u32 = super::IDENTITY.iter().map(|number| number.count_ones()).sum();
        assert_eq!(ones, 64);
    }
}
