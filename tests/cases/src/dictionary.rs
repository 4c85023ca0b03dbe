//! OD 01..09: every value of the data sheet, by SDO (CiA 301, 7.4; CiA 306).

use testkit::sdo_messages::initiate;

use crate::{
    Bench, Case, Group, Step, abort,
    bench::{hex, name},
    eds::{Entry, Kind},
};

pub const GROUP: Group = Group { name: "OD", prepare: |bench| bench.restore(), cases: CASES };

const CASES: &[Case] = &[
    Case::new("Each value is read and written as its access type says", |bench| {
        access(bench, 0x1000, |_| true)
    }),
    Case::new("Each value is its default", |bench| defaults(bench, 0x1000)),
    Case::new("Each read-only value refuses a write", read_only),
    Case::new("Each write-only value refuses a read", write_only),
    Case::new("Sub-index FFh is the structure of its object", structure),
    Case::new("Each value keeps its limits", limits),
    Case::new(
        "Each value of manufacturer and profile is read and written as its access type says",
        |bench| access(bench, 0x2000, |entry| entry.kind() != Kind::Domain),
    )
    .with_remark(DOMAIN),
    Case::new("Each value of manufacturer and profile is its default", |bench| {
        defaults(bench, 0x2000)
    })
    .with_remark("The tool compares values with access ro and rw; this case also constant ones."),
    Case::new("Each value of manufacturer and profile takes what it holds", |bench| {
        access(bench, 0x2000, |entry| takes_its_value(entry) && entry.kind() != Kind::Domain)
    })
    .with_remark(DOMAIN),
];

const DOMAIN: &str = "A DOMAIN can be long: OD 01 transfers it, and this case leaves it out.";

/// The values from this index on that satisfy `is_it`.
fn values(bench: &Bench, from: u16, is_it: impl Fn(&Entry) -> bool) -> Vec<Entry> {
    bench.eds.entries().filter(|entry| entry.address.0 >= from && is_it(entry)).cloned().collect()
}

/// Whether an error field may be empty: a read is then aborted.
fn may_be_empty(entry: &Entry) -> bool {
    entry.address.0 == 0x1003 && entry.address.1 > 0
}

/// Whether a value takes what it holds at any time: PDOs must be invalid first, and some writes act.
fn takes_its_value(entry: &Entry) -> bool {
    let is_pdo = (0x1400..0x1C00).contains(&entry.address.0);
    entry.can_be_written() && !is_pdo && !entry.acts_on_write()
}

/// Reads the values from this index on that satisfy `is_it`, and writes them back.
fn access(bench: &mut Bench, from: u16, is_it: fn(&Entry) -> bool) -> Step {
    let is_it = |entry: &Entry| entry.can_be_read() && !may_be_empty(entry) && is_it(entry);
    let all = values(bench, from, is_it);
    if all.is_empty() {
        return bench.skip(format!("the EDS has no such value from {from:04X}h on"));
    }
    for entry in all {
        let data = bench.read(entry.address)?;
        if let Some(size) = entry.size() {
            bench.check(data.len() == size, format!("{} has {size} bytes", name(entry.address)))?;
        }
        if takes_its_value(&entry) {
            bench.write(entry.address, &data)?;
        }
    }
    Ok(())
}

fn defaults(bench: &mut Bench, from: u16) -> Step {
    let node = bench.node;
    let all = values(bench, from, |entry| entry.can_be_read() && entry.default(node).is_some());
    if all.is_empty() {
        return bench.skip(format!("the EDS has no default from {from:04X}h on"));
    }
    for entry in all {
        let data = bench.read(entry.address)?;
        let default = entry.default(node).unwrap_or_default();
        bench.check(data == default, format!("{} is {}", name(entry.address), hex(&default)))?;
    }
    Ok(())
}

fn read_only(bench: &mut Bench) -> Step {
    for entry in
        values(bench, 0x1000, |entry| !entry.can_be_written() && entry.kind() != Kind::Domain)
    {
        let empty = || vec![0; entry.size().unwrap_or(1)];
        let data = if may_be_empty(&entry) { empty() } else { bench.read(entry.address)? };
        bench.refuses(entry.address, &data, abort::READ_ONLY)?;
    }
    Ok(())
}

fn write_only(bench: &mut Bench) -> Step {
    let all = values(bench, 0x1000, |entry| !entry.can_be_read());
    if all.is_empty() {
        return bench.skip("the EDS has no write-only value");
    }
    for entry in all {
        bench.expect_abort(initiate(0x40, entry.address, 0), abort::WRITE_ONLY)?;
    }
    Ok(())
}

fn structure(bench: &mut Bench) -> Step {
    let mut tried = false;
    for index in bench.eds.indices() {
        let Ok(data) = bench.upload((index, 0xFF))? else { continue };
        tried = true;
        let last = bench.eds.object(index).last().map(|entry| (entry.data_type, entry.object_type));
        let (data_type, object_type) = last.unwrap_or_default();
        let expected = (data_type << 8 | object_type).to_le_bytes();
        bench.check(data == expected, format!("{index:04X}h sub FFh is {}", hex(&expected)))?;
    }
    if tried { Ok(()) } else { bench.skip("no object has a sub-index FFh, which is optional") }
}

fn limits(bench: &mut Bench) -> Step {
    let node = bench.node;
    let all = values(bench, 0x1000, |entry| {
        takes_its_value(entry) && (entry.low(node).is_some() || entry.high(node).is_some())
    });
    if all.is_empty() {
        return bench.skip("the EDS has no limits");
    }
    for entry in all {
        let Some((least, most)) = entry.range() else { continue };
        let before = if entry.can_be_read() { Some(bench.read(entry.address)?) } else { None };
        for (limit, beyond, codes) in [
            (entry.low(node).filter(|low| *low > least), -1, abort::BELOW_LIMIT),
            (entry.high(node).filter(|high| *high < most), 1, abort::ABOVE_LIMIT),
        ] {
            let Some(limit) = limit else { continue };
            bench.refuses(entry.address, &entry.of_number(limit + beyond), codes)?;
            bench.write(entry.address, &entry.of_number(limit))?;
        }
        if let Some(before) = before {
            bench.write(entry.address, &before)?;
        }
    }
    Ok(())
}
