//! The measured session: requests of an LSS master, each kind in a program that has just started.

use std::path::Path;

use anyhow::{Context, ensure};
use canopen_node::{
    Frame,
    lss::{
        AddressPart, FastscanStep, IdentifyKey, REQUEST_COB_ID, RESPONSE_COB_ID, Request, Response,
    },
};

use super::machine::{Cost, Machine, Reception};

/// The LSS address of every slave (`IDENTITY` in `bench/src/lib.rs`); half of its bits are ones.
const IDENTITY: [u32; 4] = [0x5AA5_3CC3, 0x0FF0_A55A, 0x3333_CCCC, 0x6996_9669];
/// Requests of a Fastscan without prior knowledge: the start, and 32 bits and a confirmation for each of the four
/// parts.
const FULL_SCAN: u32 = 1 + 4 * (32 + 1);
/// A frame of another node: its first transmit PDO.
const FOREIGN_COB_ID: u16 = 0x18A;

/// The cost of a slave's services.
#[derive(Clone, Debug, Default)]
pub struct Costs {
    pub inquire: Cost,
    /// The part of it up to the request to transmit the answer.
    pub inquire_answered: Cost,
    /// The cost of all four requests.
    pub selective: Cost,
    pub configure_node_id: Cost,
    pub fastscan_match: Cost,
    pub fastscan_no_match: Cost,
    pub full_scan: Cost,
    /// The cost of all six requests; `None`: not supported.
    pub identify: Option<Cost>,
    pub foreign: Cost,
    /// The largest stack use in bytes.
    pub stack: u32,
}

impl Costs {
    /// Runs the program through all measurements.
    ///
    /// # Errors
    /// An answer differs from CiA 305, so that its cost is meaningless.
    pub fn measure(elf: &Path) -> anyhow::Result<Self> {
        let context = || format!("in {}", elf.display());
        let mut costs = Self::default();
        for part in
            [Self::inquire, Self::configure, Self::select, Self::scan, Self::identify, Self::ignore]
        {
            let mut machine = Machine::start(elf).with_context(context)?;
            // The first frame differs from the others: for example, it may prove the bit rate.
            request(&mut machine, Request::SwitchToWaiting).with_context(context)?;
            part(&mut costs, &mut machine).with_context(context)?;
            costs.stack = costs.stack.max(machine.stack_used());
        }
        Ok(costs)
    }

    fn inquire(&mut self, machine: &mut Machine) -> anyhow::Result<()> {
        request(machine, Request::SwitchToConfiguration)?;
        let reception = request(machine, Request::Inquire(AddressPart::VendorId))?;
        expect(&reception, Response::Inquire(AddressPart::VendorId, IDENTITY[0]))?;
        self.inquire = reception.cost;
        self.inquire_answered = reception.answer.map_or(reception.cost, |(_, cost)| cost);
        Ok(())
    }

    fn configure(&mut self, machine: &mut Machine) -> anyhow::Result<()> {
        request(machine, Request::SwitchToConfiguration)?;
        let reception = request(machine, Request::ConfigureNodeId(5))?;
        self.configure_node_id = reception.cost;
        expect(&reception, Response::ConfigureNodeId { accepted: true })
    }

    fn select(&mut self, machine: &mut Machine) -> anyhow::Result<()> {
        let mut last = None;
        for (sub, number) in (0..).zip(IDENTITY) {
            let part = AddressPart::new(sub).expect("there are four");
            let reception = request(machine, Request::Select(part, number))?;
            self.selective += reception.cost;
            last = Some(reception);
        }
        expect(&last.expect("there are four"), Response::Selected)
    }

    fn scan(&mut self, machine: &mut Machine) -> anyhow::Result<()> {
        let mut requests = 0;
        let mut step = |id_number, bit_check, sub, next| {
            let step = FastscanStep { id_number, bit_check, sub, next };
            let reception = request(machine, Request::Fastscan(step))?;
            let is_match = reception.answer.is_some();
            if is_match {
                expect(&reception, Response::Identified)?;
            }
            self.full_scan += reception.cost;
            let of_its_kind =
                if is_match { &mut self.fastscan_match } else { &mut self.fastscan_no_match };
            // The first request starts the scan; the second is the first that compares.
            if requests > 0 && *of_its_kind == Cost::default() {
                *of_its_kind = reception.cost;
            }
            requests += 1;
            anyhow::Ok(is_match)
        };
        ensure!(step(0, 0x80, 0, 0)?, "no answer to the start of Fastscan");
        for (sub, number) in (0..).zip(IDENTITY) {
            let mut found = 0;
            for bit in (0..32).rev() {
                if !step(found, bit, sub, sub)? {
                    found |= 1 << bit;
                }
            }
            ensure!(found == number, "Fastscan finds {found:#010x} instead of {number:#010x}");
            ensure!(step(found, 0, sub, (sub + 1) % 4)?, "part {sub} is not confirmed");
        }
        ensure!(requests == FULL_SCAN, "{requests} requests");
        let reception = request(machine, Request::Inquire(AddressPart::VendorId))?;
        expect(&reception, Response::Inquire(AddressPart::VendorId, IDENTITY[0]))
            .context("after Fastscan")
    }

    fn identify(&mut self, machine: &mut Machine) -> anyhow::Result<()> {
        let [vendor, product, revision, serial] = IDENTITY;
        let mut cost = Cost::default();
        let mut last = None;
        for (key, number) in [
            (IdentifyKey::VendorId, vendor),
            (IdentifyKey::ProductCode, product),
            (IdentifyKey::RevisionNumberLow, revision - 1),
            (IdentifyKey::RevisionNumberHigh, revision + 1),
            (IdentifyKey::SerialNumberLow, serial - 1),
            (IdentifyKey::SerialNumberHigh, serial + 1),
        ] {
            let reception = request(machine, Request::Identify(key, number))?;
            cost += reception.cost;
            last = Some(reception);
        }
        let last = last.expect("there are six");
        if last.answer.is_some() {
            expect(&last, Response::Identified)?;
            self.identify = Some(cost);
        }
        Ok(())
    }

    fn ignore(&mut self, machine: &mut Machine) -> anyhow::Result<()> {
        let frame = Frame::new(FOREIGN_COB_ID, &[0x11; 8]).expect("a legal frame");
        let reception = machine.receive(&frame)?;
        ensure!(reception.answer.is_none(), "a foreign frame is answered");
        self.foreign = reception.cost;
        Ok(())
    }
}

fn request(machine: &mut Machine, request: Request) -> anyhow::Result<Reception> {
    let frame = Frame::new(REQUEST_COB_ID, &request.to_bytes()).expect("a legal frame");
    machine.receive(&frame).with_context(|| format!("at {request:?}"))
}

fn expect(reception: &Reception, response: Response) -> anyhow::Result<()> {
    let frame = Frame::new(RESPONSE_COB_ID, &response.to_bytes());
    let answer = reception.answer.map(|(frame, _)| frame);
    ensure!(answer == frame, "the answer is {answer:02X?} instead of {response:?}");
    Ok(())
}

#[cfg(test)]
mod tests {
    #[test]
    fn half_of_the_bits_that_a_full_scan_asks_for_are_ones() {
        let ones: u32 = super::IDENTITY.iter().map(|number| number.count_ones()).sum();
        assert_eq!(ones, 64);
    }
}
