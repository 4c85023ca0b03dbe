//! Identify remote slave: 46, 47, 48, 49, 4A, 4B and the answer 4F (CiA 305).

use canopen_node::lss::Address;

use super::{Feature, SILENCE, configured, unconfigured, with};
use crate::{Bench, Case, Group, Step, ms};

pub const GROUP: Group = Group {
    name: "LSS identify",
    prepare: |bench| {
        bench.needs_feature(Feature::Identify)?;
        configured(bench)
    },
    cases: CASES,
};

const CASES: &[Case] = &[
    Case::new(
        "Its own LSS address as both bounds is answered 4F, in waiting and configuration",
        own,
    ),
    Case::new("A device without a node-ID answers too", |bench| {
        unconfigured(bench)?;
        own(bench)
    }),
    Case::new("Bounds from 0 to FFFF FFFFh hold every device", |bench| {
        expect(bench, |_| (0, u32::MAX))
    }),
    Case::new("A range that ends or begins with the own number holds it", |bench| {
        expect(bench, |own| (0, own))?;
        expect(bench, |own| (own, u32::MAX))
    }),
    Case::new(
        "A range that ends before or begins behind the own number is not answered",
        |bench| {
            expect(bench, |own| (0, own.saturating_sub(1)))?;
            expect(bench, |own| (own.saturating_add(1), u32::MAX))
        },
    ),
    Case::new("A low bound above the high one is not answered", |bench| {
        expect(bench, |own| (own.saturating_add(1), own.saturating_sub(1)))?;
        expect(bench, |_| (u32::MAX, 0))
    }),
    Case::new("The bounds are compared as numbers without a sign", |bench| {
        expect(bench, |_| (0, 0x7FFF_FFFF))?;
        expect(bench, |_| (0x8000_0000, u32::MAX))
    }),
    Case::new("Another vendor-ID or product code is not answered", other_products),
    Case::new("Five of the six requests are not answered", five),
];

/// The bounds of an identify: low and high.
pub struct Question {
    pub address: Address,
    pub revisions: (u32, u32),
    pub serials: (u32, u32),
}

impl Question {
    /// The question for one device.
    pub fn new(address: Address) -> Self {
        let Address { revision_number, serial_number, .. } = address;
        let (revisions, serials) =
            ((revision_number, revision_number), (serial_number, serial_number));
        Self { address, revisions, serials }
    }

    pub fn requests(&self) -> [[u8; 5]; 6] {
        [
            with(0x46, self.address.vendor_id),
            with(0x47, self.address.product_code),
            with(0x48, self.revisions.0),
            with(0x49, self.revisions.1),
            with(0x4A, self.serials.0),
            with(0x4B, self.serials.1),
        ]
    }

    /// Asks it; returns whether somebody answers.
    pub fn ask(&self, bench: &mut Bench) -> Step<bool> {
        let span = bench.quiet();
        bench.pass(ms(0))?;
        for request in self.requests() {
            bench.request(&request)?;
        }
        match bench.lss_answer(span)? {
            None => Ok(false),
            Some([0x4F, 0, 0, 0, 0, 0, 0, 0]) => Ok(true),
            Some(_) => bench.fail("an identify is answered 4F and zeros"),
        }
    }

    /// Asks it, and fails unless it is answered as it must be.
    pub fn expect(&self, bench: &mut Bench, is_answered: bool) -> Step {
        let was_answered = self.ask(bench)?;
        let Self { revisions, serials, .. } = self;
        let words = if is_answered { "answered" } else { "not answered" };
        bench.check(
            was_answered == is_answered,
            format!("revisions {revisions:08X?} and serial numbers {serials:08X?} are {words}"),
        )
    }
}

fn own(bench: &mut Bench) -> Step {
    let question = Question::new(bench.address()?);
    question.expect(bench, true)?;
    bench.enter()?;
    question.expect(bench, true)
}

/// Asks with such bounds of the revision number, then of the serial number. `bounds` gets the own number.
fn expect(bench: &mut Bench, bounds: impl Fn(u32) -> (u32, u32)) -> Step {
    let address = bench.address()?;
    let holds = |own| (bounds(own).0..=bounds(own).1).contains(&own);
    let revisions = bounds(address.revision_number);
    let question = Question { revisions, ..Question::new(address) };
    question.expect(bench, holds(address.revision_number))?;
    let serials = bounds(address.serial_number);
    let question = Question { serials, ..Question::new(address) };
    question.expect(bench, holds(address.serial_number))
}

fn other_products(bench: &mut Bench) -> Step {
    let address = bench.address()?;
    for bit in [0, 31] {
        let vendor_id = address.vendor_id ^ 1 << bit;
        let product_code = address.product_code ^ 1 << bit;
        Question::new(Address { vendor_id, ..address }).expect(bench, false)?;
        Question::new(Address { product_code, ..address }).expect(bench, false)?;
    }
    Ok(())
}

fn five(bench: &mut Bench) -> Step {
    let requests = Question::new(bench.address()?).requests();
    for left_out in 0..6 {
        for (_, request) in requests.iter().enumerate().filter(|(at, _)| *at != left_out) {
            bench.lss(request, SILENCE)?;
        }
        bench.leave()?;
    }
    Ok(())
}
