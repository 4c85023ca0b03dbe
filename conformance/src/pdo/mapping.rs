//! PDO 21..33: the mapping of PDOs (CiA 301, 7.5.2.36 and 7.5.2.38).

use super::{Direction, Pdo, pdos, valid};
use crate::abort::*;
use crate::{
    Bench, Step,
    bench::name,
    eds::{Access, Entry},
};

const BOTH: [Direction; 2] = [Direction::Receive, Direction::Transmit];

/// Against the procedure.
const OUT_OF_ORDER: [u32; 3] = [UNSUPPORTED_ACCESS, CANNOT_BE_MAPPED, GENERAL];
/// Too many or too long entries: the tool names both sets, in the head of the case and at the step.
const TOO_MUCH: [u32; 4] = [UNSUPPORTED_ACCESS, NO_OBJECT, CANNOT_BE_MAPPED, PDO_LENGTH];
const NOT_MAPPABLE: [u32; 2] = [NO_OBJECT, CANNOT_BE_MAPPED];

impl Pdo {
    /// Makes the PDO invalid and its mapping empty; returns its COB-ID before.
    fn open_mapping(self, bench: &mut Bench) -> Step<u32> {
        let cob_id = self.close(bench)?;
        bench.write((self.mapping, 0), &[0])?;
        Ok(cob_id)
    }

    /// The mapping of the PDO: its entries that count.
    fn entries(self, bench: &mut Bench) -> Step<Vec<u32>> {
        let count = bench.number((self.mapping, 0))? as u8;
        (1..=count).map(|entry| Ok(bench.number((self.mapping, entry))? as u32)).collect()
    }

    /// Writes entries, which must be taken, but not their number.
    fn write_entries(self, bench: &mut Bench, entries: &[u32]) -> Step {
        for (sub_index, entry) in (1..).zip(entries) {
            bench.write((self.mapping, sub_index), &entry.to_le_bytes())?;
        }
        Ok(())
    }

    /// The number of entries that the data sheet has room for.
    fn room(self, bench: &Bench) -> u8 {
        bench.eds.object(self.mapping).map(|entry| entry.address.1).max().unwrap_or(0)
    }

    /// Whether the data sheet lets the mapping be changed.
    fn is_dynamic(self, bench: &Bench) -> bool {
        bench.eds.get((self.mapping, 0)).is_some_and(Entry::can_be_written)
    }
}

/// The PDOs whose mapping can be changed; the case is skipped if there are none.
fn dynamic(bench: &Bench, pdos: Vec<Pdo>) -> Step<Vec<Pdo>> {
    let dynamic: Vec<Pdo> = pdos.into_iter().filter(|pdo| pdo.is_dynamic(bench)).collect();
    if dynamic.is_empty() {
        bench.skip("the EDS has no mapping that can be written")
    } else {
        Ok(dynamic)
    }
}

/// The bits of a dummy, if `entry` is one (CiA 301, 7.4.7.3).
fn dummy_bits(entry: u32) -> Option<u32> {
    let bits = match entry >> 16 {
        1 | 2 | 5 => 8,
        3 | 6 => 16,
        4 | 7 => 32,
        _ => return None,
    };
    Some(bits)
}

pub fn default_mapping(bench: &mut Bench) -> Step {
    for pdo in pdos(bench, &BOTH)? {
        let entries = pdo.entries(bench)?;
        for entry in &entries {
            let address = ((entry >> 16) as u16, (entry >> 8) as u8);
            let is_dummy = dummy_bits(*entry).is_some() && pdo.direction == Direction::Receive;
            let is_there = bench.eds.get(address).is_some_and(|value| {
                let (receives, transmits) = value.pdo_directions();
                let can_be = if pdo.direction == Direction::Receive { receives } else { transmits };
                can_be && value.mapping() == *entry
            });
            bench.check(
                is_there || is_dummy,
                format!("{entry:08X}h is a value that can be mapped"),
            )?;
        }
        let bits: u32 = entries.iter().map(|entry| entry & 0xFF).sum();
        bench.check(bits <= 64, "at most 64 bits")?;
    }
    Ok(())
}

/// The PDOs whose mapping can be changed and is not empty, with their entries; the case is skipped if there are none.
fn mapped(bench: &mut Bench) -> Step<Vec<(Pdo, Vec<u32>)>> {
    let all = pdos(bench, &BOTH)?;
    let mut mapped = Vec::new();
    for pdo in dynamic(bench, all)? {
        let entries = pdo.entries(bench)?;
        if !entries.is_empty() {
            mapped.push((pdo, entries));
        }
    }
    if mapped.is_empty() { bench.skip("no PDO is mapped by default") } else { Ok(mapped) }
}

pub fn procedure(bench: &mut Bench) -> Step {
    for (pdo, mut entries) in mapped(bench)? {
        entries.reverse();
        let cob_id = pdo.open_mapping(bench)?;
        pdo.write_entries(bench, &entries)?;
        bench.write((pdo.mapping, 0), &[entries.len() as u8])?;
        pdo.set_cob_id(bench, cob_id)?;
        let new = pdo.entries(bench)?;
        bench.check(new == entries, format!("{entries:08X?}"))?;
    }
    Ok(())
}

pub fn without_procedure(bench: &mut Bench) -> Step {
    for (pdo, entries) in mapped(bench)? {
        pdo.close(bench)?;
        bench.refuses((pdo.mapping, 1), &entries[0].to_le_bytes(), &OUT_OF_ORDER)?;
    }
    Ok(())
}

pub fn valid_pdo(bench: &mut Bench) -> Step {
    let valid = valid(bench, &BOTH)?.into_iter().map(|(pdo, _)| pdo).collect();
    for pdo in dynamic(bench, valid)? {
        let entries = pdo.entries(bench)?;
        bench.refuses((pdo.mapping, 0), &[0], &OUT_OF_ORDER)?;
        bench.refuses((pdo.mapping, 1), &entries[0].to_le_bytes(), &OUT_OF_ORDER)?;
    }
    Ok(())
}

/// Values of the data sheet, as they are mapped.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// That a PDO can write.
    Output,
    /// That a PDO can read.
    Input,
    /// That cannot be mapped.
    Fixed,
}

/// Whether a value is of this kind: strictly, if it must not be of the other one too.
fn is_of_kind(value: &Entry, kind: Kind, is_strict: bool) -> bool {
    let (receives, transmits) = value.pdo_directions();
    let is_both = value.access == Access::ReadWrite;
    match kind {
        Kind::Output => receives && !(is_strict && is_both),
        Kind::Input => transmits && !(is_strict && is_both),
        Kind::Fixed => !value.is_mappable && value.size().is_some(),
    }
}

/// The number that maps a value which can go with this PDO, of those with the fewest or the most bits.
fn mappable(bench: &Bench, pdo: Pdo, is_longest: bool) -> Step<u32> {
    let kind = if pdo.direction == Direction::Receive { Kind::Output } else { Kind::Input };
    let all =
        bench.eds.entries().filter(|value| is_of_kind(value, kind, false)).map(Entry::mapping);
    let bits = |entry: &u32| entry & 0xFF;
    let found = if is_longest { all.max_by_key(bits) } else { all.min_by_key(bits) };
    match found {
        Some(entry) => Ok(entry),
        None => bench.skip("the EDS has no value that can be mapped"),
    }
}

pub fn too_many(bench: &mut Bench) -> Step {
    let all = pdos(bench, &BOTH)?;
    for pdo in dynamic(bench, all)? {
        let room = pdo.room(bench);
        let entry = mappable(bench, pdo, false)?;
        pdo.open_mapping(bench)?;
        pdo.write_entries(bench, &vec![entry; (64 / (entry & 0xFF)).min(room.into()) as usize])?;
        bench.refuses((pdo.mapping, 0), &[room + 1], &TOO_MUCH)?;
    }
    Ok(())
}

pub fn too_long(bench: &mut Bench) -> Step {
    let mut tried = false;
    let all = pdos(bench, &BOTH)?;
    for pdo in dynamic(bench, all)? {
        let entry = mappable(bench, pdo, true)?;
        let count = 64 / (entry & 0xFF) + 1;
        if count > pdo.room(bench).into() {
            continue;
        }
        tried = true;
        pdo.open_mapping(bench)?;
        pdo.write_entries(bench, &vec![entry; count as usize])?;
        bench.refuses((pdo.mapping, 0), &[count as u8], &TOO_MUCH)?;
    }
    if tried { Ok(()) } else { bench.skip("the values that can be mapped never exceed 64 bits") }
}

/// Maps a value of this kind as the only one of each PDO: taken if it suits the direction, refused otherwise.
pub fn map(bench: &mut Bench, kind: Kind, direction: Direction) -> Step {
    let is_taken = matches!(
        (kind, direction),
        (Kind::Output, Direction::Receive) | (Kind::Input, Direction::Transmit)
    );
    let all = pdos(bench, &[direction])?;
    let dynamic = dynamic(bench, all)?;
    let found = bench.eds.entries().find(|value| is_of_kind(value, kind, !is_taken));
    let Some(entry) = found.map(Entry::mapping) else {
        let what = if kind == Kind::Output { "rww or wo" } else { "ro or rwr" };
        return bench.skip(format!("the EDS has no {what} value that can be mapped"));
    };
    let address = ((entry >> 16) as u16, (entry >> 8) as u8);
    bench.note(format!("{} is mapped", name(address)));
    for pdo in dynamic {
        pdo.open_mapping(bench)?;
        if is_taken {
            pdo.write_entries(bench, &[entry])?;
            bench.write((pdo.mapping, 0), &[1])?;
        } else {
            bench.refuses((pdo.mapping, 1), &entry.to_le_bytes(), &NOT_MAPPABLE)?;
        }
    }
    Ok(())
}

pub fn dummy(bench: &mut Bench) -> Step {
    let all = pdos(bench, &[Direction::Receive])?;
    let dynamic = dynamic(bench, all)?;
    let is_used = |index: &u32| {
        bench.eds.number("DummyUsage", &format!("Dummy{index:04X}")).is_some_and(|used| used == 1)
    };
    let used: Vec<u32> = (1..=7).filter(is_used).collect();
    if used.is_empty() {
        return bench.skip("[DummyUsage] of the EDS has none");
    }
    for pdo in dynamic {
        for index in &used {
            let entry = index << 16 | dummy_bits(index << 16).unwrap_or(0);
            pdo.open_mapping(bench)?;
            pdo.write_entries(bench, &[entry])?;
            bench.write((pdo.mapping, 0), &[1])?;
        }
    }
    Ok(())
}
