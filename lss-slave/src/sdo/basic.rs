//! The server of a node without an application: expedited transfers, and segmented upload of the names.

use super::{Abort, Objects, Service, Value, Written, abort, confirm, message};
use crate::{Instant, object_dictionary::Access};

/// An SDO server. It holds one request and at most one segmented upload, which the next initiate ends.
#[derive(Clone, Debug)]
pub struct Basic {
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

impl Service for Basic {
    const NEW: Self = Self { request: None, upload: None };

    fn reset(&mut self) {
        self.request = None;
        self.upload = None;
    }

    fn handle(&mut self, request: [u8; 8]) {
        self.request = Some(request);
    }

    fn poll<O: Objects>(&mut self, objects: &mut O, _: Instant) -> Option<[u8; 8]> {
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
}

impl Basic {
    fn begin_upload(
        &mut self,
        index: u16,
        sub_index: u8,
        objects: &impl Objects,
    ) -> Result<[u8; 8], Abort> {
        let entry = objects.find(index, sub_index)?;
        match objects.read(entry.object)? {
            Value::Number(number) => {
                let unused = 4_u8.wrapping_sub(entry.own_size());
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
        Ok(super::segment(command, segment))
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
    if entry.access != Access::ReadWrite {
        return Err(Abort::ReadOnly);
    }
    let number = u32::from_le_bytes(data);
    let len = u32::from(entry.own_size());
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
