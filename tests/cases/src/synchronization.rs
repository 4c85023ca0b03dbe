//! Synchronization 01..10: consumer and producer of SYNC (CiA 301, 7.2.5).

use crate::{
    Bench, Case, Command, Group, Step, abort, ms,
    pdo::{self, Direction},
};

pub const GROUP: Group =
    Group { name: "Synchronization", prepare: |bench| bench.restore(), cases: CASES };

const CASES: &[Case] = &[
    Case::new("1005h is 80h", default_cob_id),
    Case::new("The device produces SYNC with its period", producer),
    Case::new("A TPDO of type 10 is sent with every tenth SYNC", every_tenth),
    Case::new("The device consumes SYNC, and takes the period 0", consumer),
    Case::new("The counter overflow value 1 is refused", wrong_overflow),
    Case::new("SYNC has no counter with the overflow value 0", no_counter),
    Case::new("SYNC counts up to the overflow value 5", counter),
    Case::new("1010h keeps the SYNC producer and its counter", kept_counter),
    Case::new("The overflow value cannot be changed while a period is set", overflow_with_period),
    Case::new("1010h keeps the overflow value", kept_overflow),
];

pub const COB_ID: u32 = 0x80;
/// Bit 30 of 1005h: the device produces SYNC.
const PRODUCES: u32 = 1 << 30;
/// 1006h, in microseconds.
const PERIOD_US: u32 = 100_000;
const WRONG_OVERFLOW: &[u32] =
    &[abort::INVALID_VALUE, abort::TOO_HIGH, abort::TOO_LOW, abort::GENERAL];

fn default_cob_id(bench: &mut Bench) -> Step {
    bench.needs((0x1005, 0))?;
    let cob_id = bench.number((0x1005, 0))?;
    bench.check(cob_id & 0x1FFF_FFFF == u64::from(COB_ID), "the COB-ID 80h")
}

fn set_cob_id(bench: &mut Bench, flags: u32) -> Step {
    bench.write((0x1005, 0), &(COB_ID | flags).to_le_bytes())
}

fn set_period(bench: &mut Bench, us: u32) -> Step {
    bench.write((0x1006, 0), &us.to_le_bytes())
}

/// Sets the period 0, if there is one: then the counter overflow value can be changed.
pub fn end_period(bench: &mut Bench) -> Step {
    if bench.eds.get((0x1006, 0)).is_some() { set_period(bench, 0) } else { Ok(()) }
}

/// Makes the device a producer; the case is skipped if it cannot be one.
pub fn produce(bench: &mut Bench) -> Step {
    bench.needs((0x1005, 0))?;
    bench.needs((0x1006, 0))?;
    set_period(bench, PERIOD_US)?;
    match bench.download((0x1005, 0), &(COB_ID | PRODUCES).to_le_bytes())? {
        Ok(()) => Ok(()),
        Err(_) => {
            set_period(bench, 0)?;
            bench.skip("the device only consumes SYNC: it refuses bit 30 of 1005h")
        }
    }
}

/// Makes the device a producer with this overflow value; the case is skipped if it cannot be one.
fn produce_counted(bench: &mut Bench, overflow: u8) -> Step {
    bench.needs((0x1019, 0))?;
    end_period(bench)?;
    bench.write((0x1019, 0), &[overflow])?;
    produce(bench)
}

fn producer(bench: &mut Bench) -> Step {
    produce(bench)?;
    let count = bench.collect(ms(10_000), COB_ID as u16)?.len();
    bench.check((98..=102).contains(&count), "100 SYNCs in 10 s")?;
    set_cob_id(bench, 0)
}

fn every_tenth(bench: &mut Bench) -> Step {
    for (pdo, cob_id) in pdo::valid(bench, &[Direction::Transmit])? {
        pdo.set_transmission(bench, 10, 0)?;
        bench.nmt(Command::Start)?;
        bench.pass(ms(100))?;
        let mut count = 0;
        for _ in 0..100 {
            bench.sync(&[])?;
            count += bench.collect(ms(100), cob_id as u16 & 0x7FF)?.len();
        }
        bench.check(count == 10, "10 TPDOs for 100 SYNCs")?;
        bench.nmt(Command::EnterPreOperational)?;
    }
    Ok(())
}

fn consumer(bench: &mut Bench) -> Step {
    bench.needs((0x1005, 0))?;
    set_cob_id(bench, 0)?;
    end_period(bench)
}

fn wrong_overflow(bench: &mut Bench) -> Step {
    bench.needs((0x1019, 0))?;
    end_period(bench)?;
    bench.refuses((0x1019, 0), &[1], WRONG_OVERFLOW)?;
    Ok(())
}

/// The bytes of the next SYNCs.
fn counters(bench: &mut Bench, count: usize) -> Step<Vec<Vec<u8>>> {
    let span = ms(u64::from(PERIOD_US / 1000) * (count as u64 + 2));
    let all = bench.collect(span, COB_ID as u16)?;
    bench.check(all.len() >= count, format!("{count} SYNCs within {span:?}"))?;
    Ok(all.iter().take(count).map(|(_, frame)| frame.data().to_vec()).collect())
}

fn no_counter(bench: &mut Bench) -> Step {
    produce_counted(bench, 0)?;
    let counters = counters(bench, 3)?;
    bench.check(counters.iter().all(Vec::is_empty), "a SYNC without data")
}

fn counter(bench: &mut Bench) -> Step {
    produce_counted(bench, 5)?;
    let counters = counters(bench, 10)?;
    let expected: Vec<Vec<u8>> = (1..=5).cycle().take(10).map(|counter| vec![counter]).collect();
    bench.check(counters == expected, "1, 2, 3, 4, 5, 1, and so on")
}

fn kept_counter(bench: &mut Bench) -> Step {
    bench.needs((0x1010, 1))?;
    produce_counted(bench, 5)?;
    bench.write((0x1010, 1), b"save")?;
    bench.reset(Command::ResetNode)?;
    let counters = counters(bench, 3)?;
    bench.check(counters == [[1], [2], [3]], "1, 2, 3 after the reset")
}

fn overflow_with_period(bench: &mut Bench) -> Step {
    bench.needs((0x1006, 0))?;
    bench.needs((0x1019, 0))?;
    set_period(bench, 1_000)?;
    bench.refuses((0x1019, 0), &[5], &[abort::NOT_NOW, abort::GENERAL])?;
    set_period(bench, 0)
}

fn kept_overflow(bench: &mut Bench) -> Step {
    bench.needs((0x1019, 0))?;
    bench.needs((0x1010, 1))?;
    end_period(bench)?;
    bench.write((0x1019, 0), &[5])?;
    bench.write((0x1010, 1), b"save")?;
    bench.reset(Command::ResetNode)?;
    let overflow = bench.number((0x1019, 0))?;
    bench.check(overflow == 5, "1019h is 5 after the reset")
}
