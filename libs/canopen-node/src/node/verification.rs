//! Verify configuration 1020h (CiA 301, 7.5.2.23): by date and time a master recognises the configuration that it has
//! stored, and need not download it again.

use crate::{
    object_dictionary::DataType,
    settings::parameters::{HEADER, Packer, Parameter},
};

/// Date and time of the configuration, as a master has written them; 0 if it has changed since.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Stamp([u32; 2]);

/// The stamp in use and the stored one.
#[derive(Clone, Debug)]
pub(super) struct Verification {
    current: Stamp,
    persistent: Stamp,
    /// What the store in progress makes persistent; the stored one if that does not change, or if there is no store.
    staged: Stamp,
}

impl Stamp {
    const NONE: Self = Self([0; 2]);
}

impl Verification {
    pub const INDEX: u16 = 0x1020;
    /// The greatest number of bytes that the stored parameters take.
    pub const STORED_LEN: usize = 2 * (HEADER + 4);
    const DATA_TYPE: u8 = DataType::Unsigned32 as u8;

    pub const fn new() -> Self {
        Self { current: Stamp::NONE, persistent: Stamp::NONE, staged: Stamp::NONE }
    }

    /// The value of a sub-index: 1 is the date, 2 the time.
    pub fn read(&self, sub_index: u8) -> u32 {
        let Stamp([date, time]) = self.current;
        if sub_index == 1 { date } else { time }
    }

    /// Sets a sub-index.
    pub fn write(&mut self, sub_index: u8, value: u32) {
        let Stamp([date, time]) = &mut self.current;
        *(if sub_index == 1 { date } else { time }) = value;
    }

    /// Records a change of the configuration.
    pub const fn clear(&mut self) {
        self.current = Stamp::NONE;
    }

    /// Records that a reset has discarded what is not stored. Values of the application stay changed by then, so that only
    /// the stored stamp is still right.
    pub fn reset(&mut self) {
        if self.current != self.persistent {
            self.clear();
        }
    }

    /// Begins a store by this sub-index of 1010h or 1011h. A store of a part leaves changes of the other part unstored, so
    /// that no new stamp is right.
    pub fn stage(&mut self, sub_index: u8) {
        const ALL: u8 = 1;
        let is_right = sub_index == ALL || self.current == self.persistent;
        self.staged = if is_right { self.current } else { Stamp::NONE };
    }

    /// Ends the store in progress.
    pub const fn end_store(&mut self, is_done: bool) {
        if is_done {
            self.persistent = self.staged;
        } else {
            self.staged = self.persistent;
        }
    }

    /// Packs the stamp of the store in progress, unless it is 0.
    pub fn save(&self, to: &mut Packer<'_>) {
        let Stamp([date, time]) = self.staged;
        for (sub_index, number) in [(1, date), (2, time)] {
            if number != 0 {
                let (data_type, value) = (Self::DATA_TYPE, &number.to_le_bytes());
                to.put(&Parameter { index: Self::INDEX, sub_index, data_type, value });
            }
        }
    }

    /// Takes a stored parameter, if it is one of these; returns whether it was taken.
    pub fn restore(&mut self, parameter: &Parameter<'_>) -> bool {
        match (parameter.sub_index, parameter.data_type, parameter.value) {
            (sub_index @ 1..=2, Self::DATA_TYPE, &[b0, b1, b2, b3]) => {
                self.write(sub_index, u32::from_le_bytes([b0, b1, b2, b3]));
                (self.persistent, self.staged) = (self.current, self.current);
                true
            }
            _ => false,
        }
    }
}
