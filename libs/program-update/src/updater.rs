//! The loader's objects: clear, download and restore, one small step of the flash at a time.

use crate::{Abort, Flash, Header, Object, Verify, header::Expected, start::Why};

/// What the loader has to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Answer the end of the download of 1F50h.
    Answer(Result<(), Abort>),
    /// Put what is in force into the mailbox, and reset.
    Reset,
}

/// The state of the loader. Times are counts of microseconds that may wrap.
///
/// `WORDS` is the room for data that the flash has not taken yet, in words of four bytes.
pub struct Updater<F, V, const WORDS: usize = 4096> {
    flash: F,
    verify: V,
    expected: Expected,
}

impl<F: Flash, V: Verify, const WORDS: usize> Updater<F, V, WORDS> {
    /// The loader after its start, for the reason that [`decide`](crate::start::decide) gave. It reads both programs once,
    /// and waits for that. A restore begins with the first [`poll`](Self::poll).
    pub fn new(flash: F, verify: V, expected: Expected, why: Why, now: u32) -> Self {
        let _ = (why, now);
        Self { flash, verify, expected }
    }

    /// Does the next step, if the flash is ready for it, and says what the loader has to do. Call it as often as
    /// possible while [`is_busy`](Self::is_busy), and at least every 10 ms otherwise. A step reads some 100 words at
    /// most, or starts one operation of the flash; it never waits for the flash.
    pub fn poll(&mut self, now: u32) -> Option<Action> {
        let _ = now;
        None
    }

    /// Whether the flash is being written or erased, or is about to be: then leave it alone, and refuse LSS store
    /// configuration and 1010h.
    pub fn is_busy(&self) -> bool {
        false
    }

    /// Whether neither RUN nor BACKUP holds a program that can be started: emergency 6200h.
    pub fn is_without_program(&self) -> bool {
        false
    }

    /// The header of the program in RUN, else of that in BACKUP: for 1018h sub-index 3 and 100Ah.
    pub fn header(&self) -> Option<&Header> {
        None
    }

    /// The value of an object.
    pub fn read(&self, object: Object) -> u32 {
        let _ = object;
        0
    }

    /// An SDO request has come, of whatever kind: the loader goes on for 60 s.
    pub fn requested(&mut self, now: u32) {
        let _ = now;
    }

    /// The answer to a write of 1F51h sub-index 1, to be sent at once. After start and reset [`poll`](Self::poll) asks
    /// for [`Action::Reset`], 100 ms after [`answered`](Self::answered).
    ///
    /// # Errors
    /// [`Abort::DeviceState`]: start without a valid program, or confirm; [`Abort::InvalidValue`].
    pub fn write_control(&mut self, value: u8, now: u32) -> Result<(), Abort> {
        let _ = (value, now);
        Err(Abort::DeviceState)
    }

    /// Another node has acknowledged the last SDO answer.
    pub fn answered(&mut self, now: u32) {
        let _ = now;
    }

    /// The bytes that [`write`](Self::write) takes now. Ask for no more: make the next block this long, or answer the
    /// next segment when there is room.
    pub fn room(&self) -> usize {
        0
    }

    /// The next bytes of a download to 1F50h, any number of them; a new download begins with `offset` 0.
    ///
    /// # Errors
    /// [`Abort::DeviceState`]: not cleared. [`Abort::NotStored`]: the header does not fit, nothing was written.
    /// [`Abort::Hardware`]: the flash failed, or there are more bytes than the header says. [`Abort::Memory`]: more than
    /// [`room`](Self::room). In each case 1F57h says why, and the download has ended.
    pub fn write(&mut self, offset: u32, bytes: &[u8], now: u32) -> Result<(), Abort> {
        let _ = (offset, bytes, now);
        Err(Abort::DeviceState)
    }

    /// The end of a download of `len` bytes. The answer follows as [`Action::Answer`].
    ///
    /// # Errors
    /// As [`write`](Self::write); [`Abort::Hardware`] also for a wrong length.
    pub fn end(&mut self, len: u32, now: u32) -> Result<(), Abort> {
        let _ = (len, now);
        Err(Abort::DeviceState)
    }

    /// The client or the SDO server has ended the download, also while its answer is due. After the first word of the
    /// program, another download needs another clear.
    pub fn abort(&mut self) {}

    /// The flash, for the settings; not while [`is_busy`](Self::is_busy).
    pub fn flash(&mut self) -> &mut F {
        &mut self.flash
    }
}
