//! The objects of program download (CiA 302-3): 1F50h, 1F51h, 1F56h and 1F57h, and the state 2001h of an update, in a
//! product or loader that turns them on.

use super::{Action, Node};
use crate::{
    Application,
    object_dictionary::{
        Access::{Const, ReadOnly, ReadWrite, WriteOnly},
        DataType::{Domain, Unsigned8, Unsigned32},
        DefaultValue, Description, Entry, Object, Options, row,
    },
    sdo::{Abort, Message},
};

/// The data of the program.
const DATA: u16 = 0x1F50;
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

/// The answer to an SDO download that has not been given yet.
#[derive(Clone, Copy, Debug)]
#[must_use]
pub struct Confirmation {
    pub(crate) index: u16,
    pub(crate) sub_index: u8,
    pub(crate) message: Message,
}

impl<A: Application> Node<A> {
    /// Answers an SDO download that the application has taken: it is done, or has failed. The answer is lost if the NMT
    /// state has changed to one without SDO since.
    #[must_use = "an action that is not carried out is lost"]
    pub fn answer(
        &mut self,
        confirmation: Confirmation,
        outcome: Result<(), Abort>,
    ) -> Option<Action> {
        if !self.serves_sdo() {
            return None;
        }
        let Confirmation { index, sub_index, message } = confirmation;
        self.transmit_by_sdo(match outcome {
            Ok(()) => message,
            Err(code) => Message::refusal(index, sub_index, code),
        })
    }
}
