//! The areas of the dictionary that 1010h stores and 1011h restores, and the stored values of the application.

use super::verification::Verification;
use crate::{
    application::Dictionary,
    object_dictionary::{self, Entry, Object},
    sdo::{Abort, Message},
    settings::parameters::{self, Packer, Parameter},
};

/// An SDO download whose client waits for the answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Owed {
    pub index: u16,
    pub sub_index: u8,
    /// The answer when it is done.
    pub confirmation: Message,
}

impl Owed {
    /// The answer: it is done, or has failed.
    pub fn answer(self, outcome: Result<(), Abort>) -> Message {
        let Self { index, sub_index, confirmation } = self;
        match outcome {
            Ok(()) => confirmation,
            Err(code) => Message::refusal(index, sub_index, code),
        }
    }
}

/// An area of the dictionary that is stored and restored apart from the other (CiA 301, objects 1010h and 1011h).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Area {
    /// The objects 1000h to 1FFFh, but for 1020h.
    Communication,
    /// The objects 2000h to 9FFFh.
    Application,
    /// The object 1020h, which is about both.
    Verification,
}

/// The effect of a store on the stored values of an area.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Change {
    Keep,
    /// Replaces them by the current values.
    Renew,
    /// Removes them, so that the defaults apply from the next start on.
    Remove,
}

impl Area {
    pub const ALL: [Self; 3] = [Self::Communication, Self::Application, Self::Verification];
    const RESTORE: u16 = 0x1011;

    /// The area of the object with this index.
    pub const fn of(index: u16) -> Self {
        match index {
            Verification::INDEX => Self::Verification,
            0..0x2000 => Self::Communication,
            _ => Self::Application,
        }
    }

    /// Whether a write to this sub-index of 1010h or 1011h concerns the area.
    pub const fn is_concerned(self, sub_index: u8) -> bool {
        match sub_index {
            2 => !matches!(self, Self::Application),
            3 => !matches!(self, Self::Communication),
            _ => true,
        }
    }

    /// The effect on the area of a store for this client, or for LSS if there is none.
    pub fn change(self, client: Option<Owed>) -> Change {
        match client {
            Some(download) if self.is_concerned(download.sub_index) => {
                if download.index == Self::RESTORE { Change::Remove } else { Change::Renew }
            }
            _ => Change::Keep,
        }
    }

    /// Packs the parameters of this area that are among the `persistent` ones.
    pub fn keep(self, persistent: &[u8], to: &mut Packer<'_>) {
        parameters::unpack(persistent)
            .filter(|parameter| Self::of(parameter.index) == self)
            .for_each(|parameter| to.put(&parameter));
    }
}

/// Packs the current values of the application that are stored.
pub(super) fn save<A: Dictionary>(application: &A, to: &mut Packer<'_>) {
    let stored = A::OBJECTS.iter().filter(|entry| entry.options.is_stored());
    for Entry { index, sub_index, data_type, object, .. } in stored {
        if let Object::Application(field) = *object {
            let place = to.reserve(*index, *sub_index, *data_type as u8, application.len(field));
            application.read(field, 0, place);
        }
    }
}

/// Takes a stored value, if the application has it with this data type and the value is legal; returns whether it has.
pub(super) fn restore<A: Dictionary>(application: &mut A, parameter: &Parameter<'_>) -> bool {
    let Parameter { index, sub_index, data_type, value } = *parameter;
    let Ok(entry) = object_dictionary::find(A::OBJECTS, index, sub_index) else {
        return false;
    };
    let Object::Application(field) = entry.object else {
        return false;
    };
    let is_stored = entry.options.is_stored() && entry.data_type as u8 == data_type;
    match A::parse(field, value) {
        Ok(value) if is_stored => {
            application.set(value);
            true
        }
        _ => false,
    }
}
