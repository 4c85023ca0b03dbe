//! Stored parameters: the parts of the dictionary that 1010h and 1011h concern, the effect of a store on each, and the
//! values of the application.

use super::storing::Download;
use crate::{
    application::Dictionary,
    object_dictionary::{self, Entry, Object},
    settings::parameters::{self, Packer, Parameter, Parameters},
};

/// A part of the dictionary that is stored and restored apart from the other (CiA 301, objects 1010h and 1011h).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    /// The objects 1000h to 1FFFh.
    Communication,
    /// The objects 2000h to 9FFFh.
    Application,
}

/// The effect of a store on the stored values of a part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Change {
    Keep,
    /// Replaces them by the current values.
    Renew,
    /// Removes them, so that the defaults apply from the next start on.
    Remove,
}

impl Part {
    pub const ALL: [Self; 2] = [Self::Communication, Self::Application];
    const RESTORE: u16 = 0x1011;

    /// The part of the object with this index.
    pub const fn of(index: u16) -> Self {
        if index < 0x2000 { Self::Communication } else { Self::Application }
    }

    /// Whether a write to this sub-index of 1010h or 1011h concerns the part.
    pub const fn is_concerned(self, sub_index: u8) -> bool {
        match sub_index {
            2 => matches!(self, Self::Communication),
            3 => matches!(self, Self::Application),
            _ => true,
        }
    }

    /// The effect on the part of a store for this client, or for LSS if there is none.
    pub fn change(self, client: Option<Download>) -> Change {
        match client {
            Some(Download { index, sub_index, .. }) if self.is_concerned(sub_index) => {
                if index == Self::RESTORE { Change::Remove } else { Change::Renew }
            }
            _ => Change::Keep,
        }
    }

    /// Packs the parameters of this part that are among the `persistent` ones.
    pub fn keep(self, persistent: &[u8], to: &mut Packer<'_>) {
        parameters::unpack(persistent)
            .filter(|parameter| Self::of(parameter.index) == self)
            .for_each(|parameter| to.put(&parameter));
    }
}

impl<A: Dictionary> Parameters for A {
    const LEN: usize = A::STORED_LEN;

    fn save(&self, to: &mut Packer<'_>) {
        let stored = A::OBJECTS.iter().filter(|entry| entry.options.is_stored());
        for Entry { index, sub_index, data_type, object, .. } in stored {
            if let Object::Application(field) = *object {
                let place = to.reserve(*index, *sub_index, *data_type as u8, self.len(field));
                self.read(field, 0, place);
            }
        }
    }

    fn restore(&mut self, parameter: &Parameter<'_>) -> bool {
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
                self.set(value);
                true
            }
            _ => false,
        }
    }
}
