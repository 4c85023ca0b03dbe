//! The objects of program download (CiA 302-3): 1F50h, 1F51h, 1F56h and 1F57h, and the state 2001h of an update, in a
//! product or loader that turns them on.

use super::{Action, Node, Owed, Task, Tasks};
use crate::{
    Application, Instant, Settings, nmt,
    object_dictionary::{
        Access::{Const, ReadOnly, ReadWrite, WriteOnly},
        DataType::{Domain, Unsigned8, Unsigned32},
        DefaultValue, Description, Entry, Object, Options, row,
    },
    sdo::{Abort, Answer, BLOCK_SIZE, Message},
};

/// The data of the program.
pub(super) const DATA: u16 = 0x1F50;
/// Program control.
pub(super) const CONTROL: u16 = 0x1F51;
/// The state of the update.
pub(super) const STATE: u16 = 0x2001;

pub(super) const ROWS: &[Entry] = &[
    row(DATA, 0, Unsigned8, Const, Object::HighestSubIndex(1)),
    Entry {
        options: Options::NONE.streamed(),
        ..row(DATA, 1, Domain, WriteOnly, Object::Application(0))
    },
    row(CONTROL, 0, Unsigned8, Const, Object::HighestSubIndex(1)),
    row(CONTROL, 1, Unsigned8, ReadWrite, Object::Application(0)),
    row(0x1F56, 0, Unsigned8, Const, Object::HighestSubIndex(1)),
    row(0x1F56, 1, Unsigned32, ReadOnly, Object::Application(0)),
    row(0x1F57, 0, Unsigned8, Const, Object::HighestSubIndex(1)),
    row(0x1F57, 1, Unsigned32, ReadOnly, Object::Application(0)),
    row(STATE, 0, Unsigned8, Const, Object::HighestSubIndex(2)),
    row(STATE, 1, Unsigned8, ReadOnly, Object::Application(0)),
    row(STATE, 2, Unsigned8, ReadOnly, Object::Application(0)),
];

/// Whether the object with this index is one of them.
pub(super) const fn contains(index: u16) -> bool {
    matches!(index, DATA..=0x1F57 | STATE)
}

/// The rows with their descriptions.
pub(super) fn entries() -> impl Iterator<Item = (Entry, Description)> {
    let describe = |entry: &Entry| {
        let (object, name) = match (entry.index, entry.sub_index) {
            (DATA, 0) => (Some("Program data"), "Highest sub-index supported"),
            (CONTROL, 0) => (Some("Program control"), "Highest sub-index supported"),
            (0x1F56, 0) => (Some("Program software identification"), "Highest sub-index supported"),
            (0x1F57, 0) => (Some("Flash status indication"), "Highest sub-index supported"),
            (_, 0) => (Some("Update"), "Highest sub-index supported"),
            (STATE, 1) => (None, "State"),
            (STATE, _) => (None, "Starts on trial"),
            _ => (None, "Program 1"),
        };
        let object = object.map(Into::into);
        Description { object, name: name.into(), default: DefaultValue::Varies, limits: None }
    };
    ROWS.iter().map(move |entry| (*entry, describe(entry)))
}

/// What the objects of program download do: a program that can be replaced, or its loader.
pub trait Program {
    /// The value of an object: 1F51h, 1F56h, 1F57h or 2001h.
    fn read(&mut self, index: u16, sub_index: u8) -> u32;

    /// Carries out program control 1F51h. [`Node::answer`] gives an answer that follows later.
    ///
    /// # Errors
    /// The abort code for the client.
    fn control(&mut self, value: u8, state: nmt::State) -> Result<Answer, Abort>;

    /// Takes the next part of a program, 1F50h. The first part has offset 0.
    ///
    /// # Errors
    /// The abort code for the client.
    fn write(&mut self, _offset: u32, _bytes: &[u8]) -> Result<(), Abort> {
        Err(Abort::DeviceState)
    }

    /// Completes a program of `len` bytes. [`Node::answer`] gives an answer that follows later.
    ///
    /// # Errors
    /// The abort code for the client.
    fn end(&mut self, _len: u32) -> Result<Answer, Abort> {
        Err(Abort::DeviceState)
    }

    /// The number of segments of the next block, 1 to 127.
    fn grant(&mut self) -> u8 {
        BLOCK_SIZE
    }

    /// What the last [`grant`](Self::grant) was.
    fn granted(&mut self) -> u8 {
        BLOCK_SIZE
    }

    /// Whether the answer to a part of the program waits for now. [`Node::resume`] must follow.
    fn holds(&mut self, _now: Instant) -> bool {
        false
    }

    /// Discards a program that was not completed.
    fn abort(&mut self) {}

    /// An SDO request has come, whatever it concerns.
    fn requested(&mut self) {}

    /// An SDO answer is being sent, whatever it concerns.
    fn answering(&mut self) {}
}

impl<A: Application> Node<A> {
    /// Continues with a node-ID, a bit rate and a heartbeat time in milliseconds that were in force before a restart, in
    /// place of the stored ones, which stay stored. To be called after [`restore`](Self::restore), before all others.
    #[must_use]
    pub fn with_in_force(mut self, settings: Settings, heartbeat_ms: u16) -> Self {
        self.nmt.configure(heartbeat_ms, self.nmt.error_behaviour());
        self.slave = self.product.device.slave(settings);
        self
    }

    /// Has a loader owe the answer to a write of 1F51h sub-index 1, which a program has left to it.
    pub const fn owe_control(&mut self) {
        let confirmation = Message::confirmation(CONTROL, 1);
        self.product.owed = Some(Owed { index: CONTROL, sub_index: 1, confirmation });
    }

    /// Whether the answer to the request that waits has to wait on, since the program has no room for what would follow.
    pub(super) fn holds_answer(&mut self, now: Instant) -> bool {
        let Some(program) = self.product.application.program() else { return false };
        self.sdo.goes_on(DATA, program.granted()) && program.holds(now)
    }

    /// Looks again whether an answer that [waits](Program::holds) can be given. [`poll`](Self::poll) must follow.
    pub fn resume(&mut self) {
        self.agenda.add(Tasks::of(&[Task::Sdo]));
    }

    /// Informs the program that an SDO answer is being sent.
    pub(super) fn note_answer(&mut self) {
        if A::PROGRAM_DOWNLOAD
            && let Some(program) = self.product.application.program()
        {
            program.answering();
        }
    }

    /// The producer heartbeat time 1017h in force, in milliseconds.
    pub const fn heartbeat_ms(&self) -> u16 {
        self.nmt.heartbeat_ms()
    }

    /// Gives the answer that [`Program`] has put off: the download is done, or has failed. The answer is lost if the NMT
    /// state has changed to one without SDO since.
    #[must_use = "an action that is not carried out is lost"]
    pub fn answer(&mut self, outcome: Result<(), Abort>) -> Option<Action> {
        let owed = self.product.owed.take()?;
        if !self.serves_sdo() {
            return None;
        }
        self.note_answer();
        self.sdo_frame(owed.answer(outcome)).map(Action::sdo)
    }
}
