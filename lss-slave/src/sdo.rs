//! The SDO server (CiA 301, 7.2.4): expedited transfers in both directions and segmented upload for the names.

use core::{error, fmt};

use crate::object_dictionary::{Access, Entry, Missing, Object};

/// The base COB-ID of requests, to which the node-ID is added.
pub const REQUEST_COB_ID: u16 = 0x600;
/// The base COB-ID of answers, to which the node-ID is added.
pub const RESPONSE_COB_ID: u16 = 0x580;

/// The reason for an abort, with the code that is sent to the client (CiA 301, table 22).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
#[repr(u32)]
pub enum Abort {
    /// The segment repeats the toggle bit of the one before.
    Toggle = 0x0503_0000,
    /// The command is unknown or not supported, such as block transfer.
    Command = 0x0504_0001,
    /// There is no memory for the data.
    Memory = 0x0504_0005,
    /// A write-only object was read.
    WriteOnly = 0x0601_0001,
    /// A read-only object was written.
    ReadOnly = 0x0601_0002,
    /// The object does not exist.
    NoObject = 0x0602_0000,
    /// The object does not exist or cannot be mapped into this PDO.
    NotMappable = 0x0604_0041,
    /// The mapped objects are longer than a PDO.
    TooManyMapped = 0x0604_0042,
    /// The value does not go with other values.
    Incompatible = 0x0604_0043,
    /// The hardware failed: the settings could not be written.
    Hardware = 0x0606_0000,
    /// The data is longer than the object.
    TooLong = 0x0607_0012,
    /// The data is shorter than the object.
    TooShort = 0x0607_0013,
    /// The object exists, the sub-index does not.
    NoSubIndex = 0x0609_0011,
    /// The value is out of the object's range.
    InvalidValue = 0x0609_0030,
    /// The value is above the object's upper limit.
    TooHigh = 0x0609_0031,
    /// The value is below the object's lower limit.
    TooLow = 0x0609_0032,
    /// The signature is not "save" or "load" as the object requires.
    NotStored = 0x0800_0020,
    /// Another store is under way.
    Busy = 0x0800_0021,
    /// The state of the device does not allow it.
    DeviceState = 0x0800_0022,
    /// The object exists, but has no data now.
    NoData = 0x0800_0024,
}

impl fmt::Display for Abort {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let reason = match self {
            Self::Toggle => "the toggle bit has not changed",
            Self::Command => "unknown command",
            Self::Memory => "no memory for the data",
            Self::WriteOnly => "the object can only be written",
            Self::ReadOnly => "the object can only be read",
            Self::NoObject => "no such object",
            Self::NotMappable => "the object cannot be mapped into the PDO",
            Self::TooManyMapped => "the mapped objects are longer than a PDO",
            Self::Incompatible => "the value does not go with other values",
            Self::Hardware => "the hardware failed",
            Self::TooLong => "too much data",
            Self::TooShort => "too little data",
            Self::NoSubIndex => "no such sub-index",
            Self::InvalidValue => "invalid value",
            Self::TooHigh => "the value is above the upper limit",
            Self::TooLow => "the value is below the lower limit",
            Self::NotStored => "wrong signature",
            Self::Busy => "another store is under way",
            Self::DeviceState => "the state of the device does not allow it",
            Self::NoData => "no data available",
        };
        write!(f, "{reason} ({:08X}h)", *self as u32)
    }
}

impl error::Error for Abort {}

/// The value of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Value {
    Number(u32),
    Text(&'static str),
}

/// The effect of a write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Written {
    Now,
    /// The answer follows later: [`confirm`] or [`abort`].
    Later,
}

/// The object dictionary behind the server.
pub(crate) trait Objects {
    fn find(&self, index: u16, sub_index: u8) -> Result<&'static Entry, Abort>;
    fn read(&self, object: Object) -> Result<Value, Abort>;
    /// Writes the first bytes of `value`, as many as the entry has.
    fn write(&mut self, entry: &Entry, value: u32) -> Result<Written, Abort>;
}

/// An SDO server. It holds one request and at most one segmented upload, which the next initiate ends.
#[derive(Clone, Debug)]
pub(crate) struct Server {
    /// A received request that has not been answered.
    request: Option<[u8; 8]>,
    upload: Option<Upload>,
}

#[derive(Clone, Copy, Debug)]
struct Upload {
    index: u16,
    sub_index: u8,
    rest: &'static [u8],
    toggle: u8,
}

impl Server {
    pub const fn new() -> Self {
        Self { request: None, upload: None }
    }

    /// Discards the request and the current upload without an answer to the client.
    pub const fn reset(&mut self) {
        self.request = None;
        self.upload = None;
    }

    /// Accepts a request, which [`poll`](Self::poll) answers.
    pub const fn handle(&mut self, request: [u8; 8]) {
        self.request = Some(request);
    }

    /// Executes the request and returns the answer, if there is one now.
    pub fn poll(&mut self, objects: &mut impl Objects) -> Option<[u8; 8]> {
        let [command, i0, i1, sub_index, d0, d1, d2, d3] = self.request.take()?;
        let index = u16::from_le_bytes([i0, i1]);
        let data = [d0, d1, d2, d3];
        let upload = self.upload.take();
        let answer = match command >> 5 {
            DOWNLOAD => download(command, index, sub_index, data, objects)
                .map(|written| (written == Written::Now).then(|| confirm(index, sub_index))),
            UPLOAD => self.begin_upload(index, sub_index, objects).map(Some),
            UPLOAD_SEGMENT => {
                let Some(upload) = upload else {
                    return Some(abort(0, 0, Abort::Command));
                };
                match self.continue_upload(upload, command & TOGGLE) {
                    Ok(answer) => Ok(Some(answer)),
                    Err(code) => return Some(abort(upload.index, upload.sub_index, code)),
                }
            }
            ABORT => Ok(None),
            _ => Err(Abort::Command),
        };
        answer.unwrap_or_else(|code| Some(abort(index, sub_index, code)))
    }

    fn begin_upload(
        &mut self,
        index: u16,
        sub_index: u8,
        objects: &impl Objects,
    ) -> Result<[u8; 8], Abort> {
        let entry = objects.find(index, sub_index)?;
        if entry.access == Access::WriteOnly {
            return Err(Abort::WriteOnly);
        }
        match objects.read(entry.object)? {
            Value::Number(number) => {
                let unused = 4_u8.saturating_sub(entry.data_type.size());
                Ok(message(0x43 | unused << 2, index, sub_index, number))
            }
            Value::Text(text) => {
                let rest = text.as_bytes();
                self.upload = Some(Upload { index, sub_index, rest, toggle: 0 });
                Ok(message(0x41, index, sub_index, rest.len() as u32))
            }
        }
    }

    fn continue_upload(&mut self, upload: Upload, toggle: u8) -> Result<[u8; 8], Abort> {
        if toggle != upload.toggle {
            return Err(Abort::Toggle);
        }
        let mut segment = [0; 7];
        let mut rest = upload.rest.iter();
        let mut unused = segment.len() as u8;
        for (to, from) in segment.iter_mut().zip(&mut rest) {
            *to = *from;
            unused -= 1;
        }
        let rest = rest.as_slice();
        let command = toggle | unused << 1 | u8::from(rest.is_empty());
        if !rest.is_empty() {
            self.upload = Some(Upload { rest, toggle: toggle ^ TOGGLE, ..upload });
        }
        let [b0, b1, b2, b3, b4, b5, b6] = segment;
        Ok([command, b0, b1, b2, b3, b4, b5, b6])
    }
}

/// Client command specifiers: the upper three bits of a request's first byte.
const DOWNLOAD: u8 = 1;
const UPLOAD: u8 = 2;
const UPLOAD_SEGMENT: u8 = 3;
const ABORT: u8 = 4;
const TOGGLE: u8 = 0x10;

fn download(
    command: u8,
    index: u16,
    sub_index: u8,
    data: [u8; 4],
    objects: &mut impl Objects,
) -> Result<Written, Abort> {
    const EXPEDITED: u8 = 0x02;
    const SIZE_INDICATED: u8 = 0x01;
    let entry = objects.find(index, sub_index)?;
    if !matches!(entry.access, Access::ReadWrite | Access::WriteOnly) {
        return Err(Abort::ReadOnly);
    }
    let number = u32::from_le_bytes(data);
    let len = u32::from(entry.data_type.size());
    let (expedited, indicated) = (command & EXPEDITED != 0, command & SIZE_INDICATED != 0);
    let sent = match (expedited, indicated) {
        (true, true) => 4 - u32::from(command >> 2 & 3),
        (false, true) => number,
        (_, false) => len,
    };
    if sent > len {
        return Err(Abort::TooLong);
    }
    if sent < len {
        return Err(Abort::TooShort);
    }
    if !expedited {
        return Err(Abort::Command);
    }
    objects.write(entry, number)
}

/// The answer to a completed download.
pub(crate) const fn confirm(index: u16, sub_index: u8) -> [u8; 8] {
    message(0x60, index, sub_index, 0)
}

/// The message that ends a transfer.
pub(crate) const fn abort(index: u16, sub_index: u8, code: Abort) -> [u8; 8] {
    message(0x80, index, sub_index, code as u32)
}

const fn message(command: u8, index: u16, sub_index: u8, number: u32) -> [u8; 8] {
    let [i0, i1] = index.to_le_bytes();
    let [d0, d1, d2, d3] = number.to_le_bytes();
    [command, i0, i1, sub_index, d0, d1, d2, d3]
}

impl From<Missing> for Abort {
    fn from(missing: Missing) -> Self {
        match missing {
            Missing::Object => Self::NoObject,
            Missing::SubIndex => Self::NoSubIndex,
        }
    }
}
