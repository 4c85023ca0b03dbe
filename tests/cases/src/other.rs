//! Testing other 01..10: stored parameters and restricted COB-IDs (CiA 301, 7.5.2.13, 7.5.2.14, 7.5.2.22 and 7.3.5).

use crate::{
    Address, Bench, Case, Command, Group, Step, abort,
    bench::{hex, name},
};

pub const GROUP: Group =
    Group { name: "Testing other", prepare: |bench| bench.restore(), cases: CASES };

const CASES: &[Case] = &[
    Case::new("1010h sub 1 refuses a wrong signature", |bench| wrong_signature(bench, STORE, 1)),
    Case::new("1010h sub 1 stores parameters", |bench| store(bench, 1)),
    Case::new("1011h sub 1 refuses a wrong signature", |bench| wrong_signature(bench, RESTORE, 1)),
    Case::new("1011h sub 1 restores the defaults", |bench| restore(bench, 1)),
    Case::new("1010h sub 2 refuses a wrong signature", |bench| wrong_signature(bench, STORE, 2)),
    Case::new("1010h sub 2 stores communication parameters", |bench| store(bench, 2)),
    Case::new("1011h sub 2 refuses a wrong signature", |bench| wrong_signature(bench, RESTORE, 2)),
    Case::new("1011h sub 2 restores the defaults of communication parameters", |bench| {
        restore(bench, 2)
    }),
    Case::new("1020h is stored, and cleared by a change of the configuration", configuration),
    Case::new("Restricted COB-IDs are refused", restricted).with_remark(
        "The tool clears the flags of a COB-ID and writes it at once. This case keeps the flags and \
         makes the service invalid first, so that only the number can be refused.",
    ),
];

const STORE: u16 = 0x1010;
const RESTORE: u16 = 0x1011;
/// Bit 31 of the COB-ID of a service: the service does not exist.
const INVALID: u32 = 1 << 31;

/// Communication parameters that are not the defaults, as far as the data sheet lets them be written.
fn changes(bench: &Bench) -> Vec<(Address, Vec<u8>)> {
    let all = [
        ((0x1005, 0), 0x200_u32.to_le_bytes().to_vec()),
        ((0x1006, 0), 5_000_u32.to_le_bytes().to_vec()),
        ((0x1015, 0), 1_000_u16.to_le_bytes().to_vec()),
        ((0x1017, 0), 20_000_u16.to_le_bytes().to_vec()),
    ];
    let is_there = |address| bench.eds.get(address).is_some_and(|entry| entry.can_be_written());
    all.into_iter().filter(|(address, _)| is_there(*address)).collect()
}

fn change(bench: &mut Bench) -> Step {
    for (address, value) in changes(bench) {
        bench.write(address, &value)?;
    }
    Ok(())
}

/// The values of the parameters that [`change`] writes.
fn read_changed(bench: &mut Bench) -> Step<Vec<Vec<u8>>> {
    changes(bench).into_iter().map(|(address, _)| bench.read(address)).collect()
}

/// Skips the case if the data sheet lacks the parameters or the object, or if the device acts on its own instead.
fn needs(bench: &mut Bench, index: u16, sub_index: u8) -> Step {
    bench.needs((index, sub_index))?;
    if changes(bench).is_empty() {
        return bench.skip("the EDS has no parameter that could be changed");
    }
    let abilities = bench.number((index, sub_index))?;
    if abilities & 1 == 0 {
        return bench.skip(format!("{} does nothing on command", name((index, sub_index))));
    }
    if index == STORE && abilities & 2 != 0 {
        return bench.skip(format!("{} also stores without a command", name((index, sub_index))));
    }
    Ok(())
}

fn wrong_signature(bench: &mut Bench, index: u16, sub_index: u8) -> Step {
    needs(bench, index, sub_index)?;
    let before = read_changed(bench)?;
    change(bench)?;
    bench.refuses((index, sub_index), b"wron", &[abort::CANNOT_BE_STORED, abort::GENERAL])?;
    bench.reset(Command::ResetNode)?;
    let after = read_changed(bench)?;
    bench.check(after == before, "the values before, after the reset")
}

fn store(bench: &mut Bench, sub_index: u8) -> Step {
    needs(bench, STORE, sub_index)?;
    change(bench)?;
    bench.write((STORE, sub_index), b"save")?;
    bench.reset(Command::ResetNode)?;
    for (address, value) in changes(bench) {
        let stored = bench.read(address)?;
        bench.check(
            stored == value,
            format!("{} is {} after the reset", name(address), hex(&value)),
        )?;
    }
    Ok(())
}

fn restore(bench: &mut Bench, sub_index: u8) -> Step {
    needs(bench, RESTORE, sub_index)?;
    let before = read_changed(bench)?;
    change(bench)?;
    if bench.eds.get((STORE, sub_index)).is_some() {
        bench.write((STORE, sub_index), b"save")?;
    }
    bench.write((RESTORE, sub_index), b"load")?;
    bench.reset(Command::ResetNode)?;
    let after = read_changed(bench)?;
    bench.check(after == before, "the defaults after the reset")
}

fn configuration(bench: &mut Bench) -> Step {
    const DATE_AND_TIME: [[u8; 4]; 2] = [[0x12, 0x34, 0, 0], [0x01, 0x02, 0x03, 0x04]];
    bench.needs((0x1020, 1))?;
    bench.needs((STORE, 1))?;
    for (sub_index, value) in (1..).zip(DATE_AND_TIME) {
        bench.write((0x1020, sub_index), &value)?;
    }
    bench.write((STORE, 1), b"save")?;
    bench.reset(Command::ResetNode)?;
    for (sub_index, value) in (1..).zip(DATE_AND_TIME) {
        let stored = bench.read((0x1020, sub_index))?;
        bench.check(stored == value, format!("1020h sub {sub_index} is {}", hex(&value)))?;
    }
    change(bench)?;
    for sub_index in [1, 2] {
        let value = bench.number((0x1020, sub_index))?;
        bench.check(value == 0, format!("1020h sub {sub_index} is 0 after a change"))?;
    }
    Ok(())
}

/// The COB-IDs that nothing may be given (CiA 301, table 38).
fn restricted_cob_ids() -> impl Iterator<Item = u32> {
    let ranges = [
        0x000..=0x07F,
        0x101..=0x180,
        0x581..=0x5FF,
        0x601..=0x67F,
        0x6E0..=0x6FF,
        0x701..=0x77F,
        0x780..=0x7FF,
    ];
    ranges.into_iter().flatten()
}

fn restricted(bench: &mut Bench) -> Step {
    let first = |range: std::ops::RangeInclusive<u16>, sub_index: u8| {
        let mut found = bench.eds.entries().filter(|entry| {
            range.contains(&entry.address.0)
                && entry.address.1 == sub_index
                && entry.can_be_written()
        });
        found.next().map(|entry| entry.address)
    };
    let areas = [
        first(0x1005..=0x1005, 0),
        first(0x1012..=0x1012, 0),
        first(0x1014..=0x1014, 0),
        first(0x1201..=0x127F, 1),
        first(0x1280..=0x12FF, 1),
        first(0x1400..=0x15FF, 1),
        first(0x1800..=0x19FF, 1),
    ];
    let addresses: Vec<Address> = areas.into_iter().flatten().collect();
    if addresses.is_empty() {
        return bench.skip("the EDS has no COB-ID that can be written");
    }
    for address in addresses {
        let mut before = bench.number(address)? as u32;
        let has_valid_bit = !matches!(address.0, 0x1005 | 0x1012);
        if has_valid_bit {
            // The COB-ID of a valid service cannot be changed at all.
            before |= INVALID;
            bench.write(address, &before.to_le_bytes())?;
        }
        let flags = before & !0x7FF & if has_valid_bit { !INVALID } else { u32::MAX };
        for cob_id in restricted_cob_ids() {
            let value = flags | cob_id;
            bench.refuses(
                address,
                &value.to_le_bytes(),
                &[abort::INVALID_VALUE, abort::GENERAL],
            )?;
        }
        let after = bench.number(address)? as u32;
        bench.check(after == before, format!("{} is still {before:08X}h", name(address)))?;
    }
    Ok(())
}
