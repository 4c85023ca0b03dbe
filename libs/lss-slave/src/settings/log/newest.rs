//! The newest record, and the parameters to which it refers.

use super::{
    Error,
    place::{self, Layout},
};
use crate::{
    bytes::copy,
    settings::record::{self, PART_LEN, Record, Reference},
};

/// The newest valid record.
#[derive(Clone, Copy)]
pub struct Newest {
    pub record: Record,
    pub at: u32,
    /// The first address of its bank.
    pub bank: u32,
}

impl Newest {
    /// The part of the parameters with this number.
    pub fn part<F: Layout>(&self, flash: &mut F, number: u16) -> Result<[u8; PART_LEN], Error> {
        let first = self.record.parameters.map_or(u16::MAX, |reference| reference.first);
        let place = u32::from(first).saturating_add(number.into());
        let at = place.saturating_mul(F::PLACE).saturating_add(self.bank);
        // All parts lie before their record.
        if at >= self.at {
            return Err(Error::NotAsWritten);
        }
        Ok(record::part_from_bytes(&place::content(flash, at)?))
    }

    /// Whether the parameters are complete and undamaged.
    pub fn is_intact<F: Layout>(&self, flash: &mut F) -> bool {
        let Some(Reference { len, crc, .. }) = self.record.parameters else {
            return true;
        };
        let mut found = u32::MAX;
        for (number, len) in parts(len) {
            let Ok(part) = self.part(flash, number) else {
                return false;
            };
            found = record::crc32_of_more(found, part.get(..len).unwrap_or_default());
        }
        !found == crc
    }
}

/// The numbers of the parts of parameters of `len` bytes, and the length of each.
pub fn parts(len: u16) -> impl Iterator<Item = (u16, usize)> {
    let starts = (0..usize::from(len)).step_by(PART_LEN);
    (0..).zip(starts.map(move |start| usize::from(len).saturating_sub(start).min(PART_LEN)))
}

/// The part of packed parameters with this number; unused bytes are FF.
pub fn part_of(packed: &[u8], number: u16) -> [u8; PART_LEN] {
    let mut part = [0xFF; PART_LEN];
    copy(packed, usize::from(number).saturating_mul(PART_LEN), &mut part);
    part
}

/// The parameters of a record in the flash, read from the start to the end.
pub struct Blob<'a, F> {
    pub flash: &'a mut F,
    pub newest: Newest,
    /// The number of bytes before the next one to read.
    at: usize,
    /// The part that was read last, and its number.
    last: Option<(u16, [u8; PART_LEN])>,
}

impl<'a, F: Layout> Blob<'a, F> {
    pub fn new(flash: &'a mut F, newest: Newest) -> Self {
        Self { flash, newest, at: 0, last: None }
    }

    /// The number of bytes that have not been read.
    pub fn rest(&self) -> usize {
        let len = self.newest.record.parameters.map_or(0, |parameters| parameters.len);
        usize::from(len).saturating_sub(self.at)
    }

    pub fn skip(&mut self, bytes: usize) {
        self.at = self.at.saturating_add(bytes);
    }

    pub fn read(&mut self, mut to: &mut [u8]) -> Result<(), Error> {
        while !to.is_empty() {
            let number = (self.at / PART_LEN) as u16;
            let part = match self.last {
                Some((last, part)) if last == number => part,
                _ => self.newest.part(self.flash, number)?,
            };
            self.last = Some((number, part));
            let read = copy(&part, self.at % PART_LEN, to);
            self.skip(read);
            to = to.get_mut(read..).unwrap_or_default();
        }
        Ok(())
    }
}
