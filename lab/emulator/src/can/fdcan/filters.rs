//! Acceptance filtering (RM0440 44.3.3).

use super::{Fdcan, registers::*};
use crate::can::{Frame, Id};

/// The fate of a received frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Accepted {
    /// The FIFO that gets it, if any does.
    pub fifo: Option<usize>,
    /// The number of the filter that matched, if one did.
    pub filter: Option<u32>,
    pub has_priority: bool,
}

const REJECTED: Accepted = Accepted { fifo: None, filter: None, has_priority: false };

impl Fdcan {
    pub(super) fn accept(&self, frame: &Frame) -> Accepted {
        let rxgfc = self.reg(RXGFC);
        let is_standard = matches!(frame.id, Id::Standard(_));
        let reject_remote = if is_standard { RXGFC_RRFS } else { RXGFC_RRFE };
        if frame.remote && rxgfc & reject_remote != 0 {
            return REJECTED;
        }
        let matching = match frame.id {
            Id::Standard(id) => self.standard_match(id.into()),
            Id::Extended(id) => self.extended_match(id),
        };
        if let Some((filter, configuration)) = matching {
            let fifo = match configuration {
                1 | 5 => Some(0),
                2 | 6 => Some(1),
                _ => None,
            };
            let has_priority = matches!(configuration, 4..=6);
            return Accepted { fifo, filter: Some(filter), has_priority };
        }
        let shift = if is_standard { RXGFC_ANFS } else { RXGFC_ANFE };
        let fifo = Some((rxgfc >> shift & 3) as usize).filter(|&fifo| fifo < 2);
        Accepted { fifo, ..REJECTED }
    }

    /// The first standard filter that matches, and its configuration (SFEC).
    fn standard_match(&self, id: u32) -> Option<(u32, u32)> {
        let count = (self.reg(RXGFC) >> 16 & 0x1F).min(28);
        (0..count).find_map(|number| {
            let element = self.memory.standard_filter(number as usize);
            let (first, second) = (element >> 16 & 0x7FF, element & 0x7FF);
            let configuration = element >> 27 & 7;
            let matches = match element >> 30 {
                0 => (first..=second).contains(&id),
                1 => id == first || id == second,
                2 => id & second == first & second,
                _ => false,
            };
            (matches && configuration != 0).then_some((number, configuration))
        })
    }

    /// The first extended filter that matches, and its configuration (EFEC).
    fn extended_match(&self, id: u32) -> Option<(u32, u32)> {
        let count = (self.reg(RXGFC) >> 24 & 0xF).min(8);
        let masked = id & self.reg(XIDAM);
        (0..count).find_map(|number| {
            let element = self.memory.extended_filter(number as usize);
            let [first, second] = element.map(|word| word & 0x1FFF_FFFF);
            let configuration = element[0] >> 29;
            let matches = match element[1] >> 30 {
                0 => (first..=second).contains(&masked),
                1 => masked == first || masked == second,
                2 => masked & second == first & second,
                _ => (first..=second).contains(&id),
            };
            (matches && configuration != 0).then_some((number, configuration))
        })
    }
}
