//! PDO 21..33: the mapping of PDOs (CiA 301, 7.5.2.36 and 7.5.2.38).

use super::{Direction, Pdo, pdos, valid};
use crate::abort::*;
use crate::{
    Bench, Step,
    bench::name,
    eds::{Access, Entry},
};

const BOTH: [Direction; 2] = [Direction::Receive, Direction::Transmit];
/// The most entries of a mapping.
const MOST_ENTRIES: u8 = 64;

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
    pub fn entries(self, bench: &mut Bench) -> Step<Vec<u32>> {
        let count = bench.number((self.mapping, 0))?;
        bench.check(count <= MOST_ENTRIES.into(), format!("at most {MOST_ENTRIES} entries"))?;
        (1..=count as u8).map(|entry| Ok(bench.number((self.mapping, entry))? as u32)).collect()
    }

    /// The number of bytes that the mapping has.
    pub fn len(self, bench: &mut Bench) -> Step<usize> {
        Ok(self.entries(bench)?.iter().map(bits).sum::<u32>().div_ceil(8) as usize)
    }

    /// Writes entries, which must be taken, but not their number.
    fn write_entries(self, bench: &mut Bench, entries: &[u32]) -> Step {
        for (sub_index, entry) in (1..).zip(entries) {
            bench.write((self.mapping, sub_index), &entry.to_le_bytes())?;
        }
        Ok(())
    }

    /// Writes the same entry at the first places, and then a number of entries. One of these writes must be refused: an
    /// entry only if it passes 64 bits.
    fn refuses_entries(self, bench: &mut Bench, entry: u32, places: u8, number: u8) -> Step {
        let data = entry.to_le_bytes();
        for place in 1..=places {
            let address = (self.mapping, place);
            if u32::from(place) * (entry & 0xFF) <= 64 {
                bench.write(address, &data)?;
            } else if let Err(code) = bench.download(address, &data)? {
                let is_right = TOO_MUCH.contains(&code);
                return bench.check(is_right, format!("{} refuses it as too much", name(address)));
            }
        }
        bench.refuses((self.mapping, 0), &[number], &TOO_MUCH)?;
        Ok(())
    }

    /// The number of entries that the data sheet has room for.
    fn room(self, bench: &Bench) -> u8 {
        let places = bench.eds.object(self.mapping).map(|entry| entry.address.1);
        places.filter(|place| *place <= MOST_ENTRIES).max().unwrap_or(0)
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

pub fn default_mapping(bench: &mut Bench) -> Step {
    for pdo in pdos(bench, &BOTH)? {
        let entries = pdo.entries(bench)?;
        let numbers = std::iter::once(entries.len() as u32).chain(entries.iter().copied());
        for (sub_index, number) in (0..=MOST_ENTRIES).zip(numbers) {
            let address = (pdo.mapping, sub_index);
            let default = bench.eds.get(address).and_then(|entry| entry.number_default(bench.node));
            if let Some(default) = default {
                let is_default = default == number.into();
                bench.check(is_default, format!("{} is {default:X}h", name(address)))?;
            }
        }
        for entry in &entries {
            bench.check(
                bench.eds.can_be_mapped(*entry, pdo.direction == Direction::Receive),
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
        if let Some(entry) = entries.first() {
            bench.refuses((pdo.mapping, 1), &entry.to_le_bytes(), &OUT_OF_ORDER)?;
        }
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

/// The numbers that map a value which can go with this PDO.
fn mappable(bench: &Bench, pdo: Pdo) -> impl Iterator<Item = u32> {
    let kind = if pdo.direction == Direction::Receive { Kind::Output } else { Kind::Input };
    bench.eds.entries().filter(move |value| is_of_kind(value, kind, false)).map(Entry::mapping)
}

fn bits(entry: &u32) -> u32 {
    entry & 0xFF
}

pub fn too_many(bench: &mut Bench) -> Step {
    let mut tried = false;
    let all = pdos(bench, &BOTH)?;
    for pdo in dynamic(bench, all)? {
        let Some(entry) = mappable(bench, pdo).min_by_key(bits) else { continue };
        tried = true;
        let room = pdo.room(bench);
        pdo.open_mapping(bench)?;
        pdo.refuses_entries(bench, entry, room, room + 1)?;
    }
    if tried { Ok(()) } else { bench.skip("the EDS has no value that can be mapped") }
}

pub fn too_long(bench: &mut Bench) -> Step {
    let mut tried = false;
    let all = pdos(bench, &BOTH)?;
    for pdo in dynamic(bench, all)? {
        let dummies = bench.eds.dummies().filter(|_| pdo.direction == Direction::Receive);
        // The last of the longest is found: a value rather than a dummy.
        let Some(entry) = dummies.chain(mappable(bench, pdo)).max_by_key(bits) else { continue };
        let count = (64 / bits(&entry) + 1) as u8;
        if count > pdo.room(bench) {
            continue;
        }
        tried = true;
        pdo.open_mapping(bench)?;
        pdo.refuses_entries(bench, entry, count, count)?;
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
    let used: Vec<u32> = bench.eds.dummies().collect();
    if used.is_empty() {
        return bench.skip("[DummyUsage] of the EDS has none");
    }
    for pdo in dynamic {
        for entry in &used {
            pdo.open_mapping(bench)?;
            pdo.write_entries(bench, &[*entry])?;
            bench.write((pdo.mapping, 0), &[1])?;
        }
    }
    Ok(())
}
