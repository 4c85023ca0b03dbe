//! The measured sessions of an LSS master, each with a program that has just started.

use std::{ops::RangeInclusive, path::Path};

use anyhow::{Context, ensure};
use canopen_node::{BitRate, Frame, Instant, lss::Request};
use lss_master::{Bus, Fastscan, Identify, InquireAddress, Master, Procedure, Select, Timing};

use super::machine::{Cost, Machine, Reception};

/// The LSS address of every slave (`IDENTITY` in `proof/bench/src/lib.rs`); half of its bits are ones.
const IDENTITY: [u32; 4] = [0x5AA5_3CC3, 0x0FF0_A55A, 0x3333_CCCC, 0x6996_9669];
/// A frame of another node: its first transmit PDO.
const FOREIGN_COB_ID: u16 = 0x18A;

/// Gives one or two costs; none: not supported.
type Measurement = fn(&mut Machine) -> anyhow::Result<Vec<Cost>>;

/// The measurements, each with the head of its column.
pub const MEASUREMENTS: [([&str; 2], Measurement); 7] = [
    (["inquire", "/answer"], inquire),
    (["select", "x4"], select),
    (["node-ID", ""], configure),
    (["fastscan", "hit/miss"], |machine| Ok(fastscan(machine)?.1)),
    (["scan", "x133"], |machine| Ok(vec![fastscan(machine)?.0])),
    (["identify", "x6"], identify),
    (["foreign", "frame"], ignore),
];

/// The costs of a slave's services.
pub struct Costs {
    /// Those of each measurement.
    pub costs: Vec<Vec<Cost>>,
    /// The largest stack use in bytes.
    pub stack: u32,
}

impl Costs {
    /// Runs the program through all measurements.
    ///
    /// # Errors
    /// The master's procedure fails, so that its cost is meaningless.
    pub fn measure(elf: &Path) -> anyhow::Result<Self> {
        let mut costs = Self { costs: Vec::new(), stack: 0 };
        for (_, measurement) in MEASUREMENTS {
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
    let (_, costs) = carry_out(machine, Request::ConfigureNodeId(5))?;
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
    let frame = Frame::new(FOREIGN_COB_ID, &[0x11; 8]).expect("a legal frame");
    let reception = machine.receive(&frame)?;
    ensure!(reception.answer.is_none(), "a foreign frame is answered");
    Ok(vec![reception.cost])
}

/// What a program makes of the requests of a procedure, by their command specifiers.
type Receptions = Vec<(u8, Reception)>;

fn sum(costs: &Receptions, commands: RangeInclusive<u8>) -> Cost {
    let of_commands = costs.iter().filter(|(command, _)| commands.contains(command));
    of_commands.fold(Cost::default(), |sum, (_, Reception { cost, .. })| Cost {
        instructions: sum.instructions + cost.instructions,
        cycles: sum.cycles + cost.cycles,
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
