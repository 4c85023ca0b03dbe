//! Verify configuration 1020h (CiA 301, 7.5.2.23): by date and time a master recognises the configuration that it has
//! stored, and need not download it again.

/// Date and time of the configuration, as a master has written them; 0 if it has changed since.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Stamp([u32; 2]);

/// The stamp in use and the stored one.
#[derive(Clone, Debug)]
pub(super) struct Verification {
    pub current: Stamp,
    pub persistent: Stamp,
}

impl Stamp {
    pub const NONE: Self = Self([0; 2]);

    /// Sets a sub-index: 1 is the date, 2 the time.
    pub fn write(&mut self, sub_index: u8, value: u32) {
        let Self([date, time]) = self;
        *(if sub_index == 1 { date } else { time }) = value;
    }
}

impl Verification {
    pub const INDEX: u16 = 0x1020;

    pub const fn new() -> Self {
        Self { current: Stamp::NONE, persistent: Stamp::NONE }
    }

    /// The value of a sub-index: 1 is the date, 2 the time.
    pub fn read(&self, sub_index: u8) -> u32 {
        let Stamp([date, time]) = self.current;
        if sub_index == 1 { date } else { time }
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

    /// Whether a store by this sub-index of 1010h makes the stamp persistent. A store of a part leaves changes of the other
    /// part unstored, so that no new stamp is right.
    pub fn is_right_after(&self, sub_index: u8) -> bool {
        const ALL: u8 = 1;
        sub_index == ALL || self.current == self.persistent
    }
}
