//! The server: takes each request to its service, and ends transfers whose client is silent.

use super::{
    Abort, Address, Objects, Value, Written, block_download::BlockDownload,
    block_upload::BlockUpload, download::Download, message, upload::TOGGLE, upload::Upload,
};
use crate::{
    Instant,
    object_dictionary::{Access, DataType, Entry},
};

/// The number of segments of a block upload that may wait for the bus: the second is there when the first has left,
/// and an LSS answer waits for two frames at most.
const SEGMENTS_PENDING: u8 = 2;

/// An SDO server. It holds one request and at most one transfer, which the next initiate ends.
#[derive(Clone, Debug)]
pub(crate) struct Server<B> {
    /// A received request that has not been answered.
    request: Option<[u8; 8]>,
    transfer: Option<Transfer>,
    /// The value under way; it has room for the longest that can be written.
    buffer: B,
    /// The time of the last progress of the transfer.
    since: Instant,
    /// The number of segments that may be sent until [`note_sent`](Self::note_sent).
    credit: u8,
    /// The answer to a download whose store is under way, unless it is that to an expedited one.
    confirmation: Option<[u8; 8]>,
}

#[derive(Clone, Copy, Debug)]
enum Transfer {
    Upload(Upload),
    Download(Download),
    BlockUpload(BlockUpload),
    BlockDownload(BlockDownload),
}

/// Client command specifiers: the upper three bits of a request's first byte.
const DOWNLOAD_SEGMENT: u8 = 0;
const DOWNLOAD: u8 = 1;
const UPLOAD: u8 = 2;
const UPLOAD_SEGMENT: u8 = 3;
const ABORT: u8 = 4;
const BLOCK_UPLOAD: u8 = 5;
const BLOCK_DOWNLOAD: u8 = 6;

/// A message with index and sub-index.
#[derive(Clone, Copy)]
struct Initiate {
    command: u8,
    address: Address,
    data: [u8; 4],
}

impl Initiate {
    const fn new([command, i0, i1, sub_index, d0, d1, d2, d3]: [u8; 8]) -> Self {
        let address = Address { index: u16::from_le_bytes([i0, i1]), sub_index };
        Self { command, address, data: [d0, d1, d2, d3] }
    }
}

impl<B: AsRef<[u8]> + AsMut<[u8]>> Server<B> {
    pub const fn new(buffer: B) -> Self {
        let since = Instant::from_micros(0);
        Self { request: None, transfer: None, buffer, since, credit: 0, confirmation: None }
    }

    /// Discards the request.
    pub const fn discard_request(&mut self) {
        self.request = None;
    }

    /// Discards the current transfer.
    pub const fn discard_transfer(&mut self) {
        self.transfer = None;
    }

    /// The domain that the current transfer writes.
    pub fn domain(&self) -> Option<&'static Entry> {
        domain_of(self.transfer.as_ref()?)
    }

    /// Accepts a request, which [`poll`](Self::poll) answers.
    pub const fn handle(&mut self, request: [u8; 8]) {
        self.request = Some(request);
    }

    /// Records that no frame of the node waits for the bus.
    pub const fn note_sent(&mut self) {
        self.credit = SEGMENTS_PENDING;
    }

    /// Whether a block of an upload has further segments.
    pub const fn is_sending_block(&self) -> bool {
        matches!(&self.transfer, Some(Transfer::BlockUpload(upload)) if upload.is_sending())
    }

    /// The latest time of the next [`poll`](Self::poll), if there is no request before.
    pub fn poll_at<O: Objects>(&self) -> Option<Instant> {
        let micros = match self.transfer.as_ref()? {
            Transfer::BlockDownload(transfer) if transfer.is_within_block() => {
                confirm_after(O::TIMEOUT_MICROS)
            }
            _ => O::TIMEOUT_MICROS,
        };
        Some(self.since.plus_micros(micros))
    }

    /// The answer to the download whose store has succeeded.
    pub fn confirm<O: Objects>(&self, index: u16, sub_index: u8) -> [u8; 8] {
        let answer = message(0x60, index, sub_index, 0);
        if O::HAS_APPLICATION { self.confirmation.unwrap_or(answer) } else { answer }
    }

    /// Executes the request and returns the answer, if there is one now. Without an answer returns the next message of
    /// the transfer.
    pub fn poll<O: Objects>(&mut self, objects: &mut O, now: Instant) -> Option<[u8; 8]> {
        let answer = self.answer(objects, now);
        if O::HAS_APPLICATION { answer.or_else(|| self.proceed(objects, now)) } else { answer }
    }

    fn answer<O: Objects>(&mut self, objects: &mut O, now: Instant) -> Option<[u8; 8]> {
        let request = self.request.take()?;
        if O::HAS_APPLICATION {
            self.since = now;
            self.confirmation = None;
        }
        if self.continues::<O>(request[0]) {
            return self.continue_transfer(request, objects);
        }
        if O::HAS_APPLICATION
            && let Some(transfer) = &self.transfer
        {
            cancel(transfer, objects);
        }
        self.transfer = None;
        let initiate = Initiate::new(request);
        let answer = match initiate.command >> 5 {
            DOWNLOAD => self.download(initiate, objects),
            UPLOAD => self.upload(initiate, objects),
            ABORT => Ok(None),
            BLOCK_UPLOAD if O::HAS_APPLICATION => self.block_upload(initiate, objects).map(Some),
            BLOCK_DOWNLOAD if O::HAS_APPLICATION => {
                self.block_download(initiate, objects).map(Some)
            }
            _ => Err(Abort::Command),
        };
        answer.unwrap_or_else(|code| Some(abort(initiate.address, code)))
    }

    fn upload<O: Objects>(
        &mut self,
        Initiate { address, .. }: Initiate,
        objects: &O,
    ) -> Result<Option<[u8; 8]>, Abort> {
        let entry = find_readable(address, objects)?;
        if O::HAS_APPLICATION {
            let upload = Upload::begin(entry, objects, self.buffer.as_mut())?;
            return self.begin_upload(upload, objects).map(Some);
        }
        Ok(Some(match objects.read(entry.object)? {
            Value::Number(number) => expedited(address, entry.own_size(), number),
            Value::Text(text) => {
                let upload = Upload::of_text(entry, text);
                self.transfer = Some(Transfer::Upload(upload));
                address.message(0x41, upload.len::<O>())
            }
        }))
    }

    fn begin_upload<O: Objects>(&mut self, upload: Upload, objects: &O) -> Result<[u8; 8], Abort> {
        if let 1..=4 = upload.len::<O>() {
            let mut bytes = [0; 4];
            let len = upload.read(objects, self.buffer.as_ref(), &mut bytes)?;
            return Ok(expedited(upload.address, len as u8, u32::from_le_bytes(bytes)));
        }
        self.transfer = Some(Transfer::Upload(upload));
        Ok(upload.address.message(0x41, upload.len::<O>()))
    }

    fn download<O: Objects>(
        &mut self,
        Initiate { command, address, data }: Initiate,
        objects: &mut O,
    ) -> Result<Option<[u8; 8]>, Abort> {
        const EXPEDITED: u8 = 0x02;
        const SIZE_INDICATED: u8 = 0x01;
        let entry = find_writable(address, objects)?;
        let number = u32::from_le_bytes(data);
        let (is_expedited, indicated) = (command & EXPEDITED != 0, command & SIZE_INDICATED != 0);
        let announced = match (is_expedited, indicated) {
            (true, true) => Some(4 - u32::from(command >> 2 & 3)),
            (false, true) => Some(number),
            (_, false) => None,
        };
        let confirmation = address.message(0x60, 0);
        if O::HAS_APPLICATION {
            // Without its length an expedited string or domain is all four bytes.
            let size = entry.data_type.size();
            let of_object = if let 1..=4 = size { size.into() } else { 4 };
            let announced = announced.or(is_expedited.then_some(of_object));
            let mut download = Download::begin(entry, announced, self.buffer.as_ref())?;
            if !is_expedited {
                self.transfer = Some(Transfer::Download(download));
                return Ok(Some(confirmation));
            }
            let bytes = data.get(..announced.unwrap_or(4) as usize).unwrap_or(&data);
            let buffer = self.buffer.as_mut();
            let written = download.add(bytes, objects, buffer);
            return match written.and_then(|()| download.end(objects, buffer)) {
                Ok(written) => Ok(self.conclude(confirmation, written)),
                Err(code) => {
                    cancel(&Transfer::Download(download), objects);
                    Err(code)
                }
            };
        }
        let size = entry.own_size().into();
        let sent = announced.unwrap_or(size);
        if sent > size {
            return Err(Abort::TooLong);
        }
        if sent < size {
            return Err(Abort::TooShort);
        }
        if !is_expedited {
            return Err(Abort::Command);
        }
        let written = objects.write(entry, number)?;
        Ok((written == Written::Now).then_some(confirmation))
    }

    fn block_upload<O: Objects>(
        &mut self,
        Initiate { address, data: [block_size, switch_at, ..], .. }: Initiate,
        objects: &O,
    ) -> Result<[u8; 8], Abort> {
        let entry = find_readable(address, objects)?;
        let upload = Upload::begin(entry, objects, self.buffer.as_mut())?;
        let (transfer, answer) = BlockUpload::begin::<O>(upload, block_size)?;
        // Short data goes by the other protocol: the client has asked for that (protocol switch threshold).
        if upload.len::<O>() <= switch_at.into() && switch_at > 0 {
            return self.begin_upload(upload, objects);
        }
        self.transfer = Some(Transfer::BlockUpload(transfer));
        Ok(answer)
    }

    fn block_download<O: Objects>(
        &mut self,
        Initiate { command, address, data }: Initiate,
        objects: &O,
    ) -> Result<[u8; 8], Abort> {
        const CRC_SUPPORTED: u8 = 0x04;
        const SIZE_INDICATED: u8 = 0x02;
        let entry = find_writable(address, objects)?;
        let announced = (command & SIZE_INDICATED != 0).then_some(u32::from_le_bytes(data));
        let download = Download::begin(entry, announced, self.buffer.as_ref())?;
        let (transfer, answer) = BlockDownload::begin(download, command & CRC_SUPPORTED != 0);
        self.transfer = Some(Transfer::BlockDownload(transfer));
        Ok(answer)
    }

    /// Takes a request to the current transfer; returns the answer, if there is one now.
    fn continue_transfer<O: Objects>(
        &mut self,
        request: [u8; 8],
        objects: &mut O,
    ) -> Option<[u8; 8]> {
        let Some(transfer) = &mut self.transfer else {
            return Some(abort(Address::NONE, Abort::Command));
        };
        match transfer.advance(request, objects, self.buffer.as_mut()) {
            Ok(Advance::Goes(answer)) => {
                // The segments before a message of the client have been sent.
                if O::HAS_APPLICATION {
                    self.credit = SEGMENTS_PENDING;
                }
                answer
            }
            Ok(Advance::Ends(answer)) => {
                self.transfer = None;
                answer
            }
            Ok(Advance::IsWritten(answer, written)) => {
                self.transfer = None;
                self.conclude(answer, written)
            }
            Err(code) => {
                let message = transfer.fail(code, objects);
                self.transfer = None;
                Some(message)
            }
        }
    }

    /// The answer to a download that is complete, unless it follows later.
    fn conclude(&mut self, answer: [u8; 8], written: Written) -> Option<[u8; 8]> {
        match written {
            Written::Now => Some(answer),
            Written::Later => {
                self.confirmation = Some(answer);
                None
            }
        }
    }

    /// Returns the next segment of a block, the confirmation of a block whose end was lost, or the end of a transfer
    /// whose client is silent.
    fn proceed<O: Objects>(&mut self, objects: &mut O, now: Instant) -> Option<[u8; 8]> {
        let deadline = self.poll_at::<O>()?;
        let transfer = self.transfer.as_mut()?;
        let code = match transfer {
            Transfer::BlockUpload(upload) if upload.is_sending() && self.credit > 0 => {
                self.since = now;
                self.credit = self.credit.saturating_sub(1);
                match upload.next_segment(objects, self.buffer.as_ref()) {
                    Ok(segment) => return Some(segment),
                    Err(code) => code,
                }
            }
            _ if !deadline.has_come(now) => return None,
            Transfer::BlockDownload(download) if download.is_within_block() => {
                return Some(download.confirm_block());
            }
            _ => Abort::Timeout,
        };
        let message = transfer.fail(code, objects);
        self.transfer = None;
        Some(message)
    }

    /// Whether a request belongs to a transfer rather than begins or ends one.
    fn continues<O: Objects>(&self, command: u8) -> bool {
        /// Only this first byte tells an abort from a segment of a block.
        const ABORT_COMMAND: u8 = ABORT << 5;
        if !O::HAS_APPLICATION {
            return command >> 5 == UPLOAD_SEGMENT;
        }
        match (command >> 5, &self.transfer) {
            (_, Some(Transfer::BlockDownload(download))) if download.is_receiving() => {
                command != ABORT_COMMAND
            }
            (DOWNLOAD_SEGMENT | UPLOAD_SEGMENT, _) => true,
            (BLOCK_UPLOAD, _) => command & 3 != 0,
            (BLOCK_DOWNLOAD, _) => command & 1 != 0,
            _ => false,
        }
    }
}

/// What a request has done to its transfer, with the answer, if it has one.
enum Advance {
    Goes(Option<[u8; 8]>),
    Ends(Option<[u8; 8]>),
    /// It is complete, and its object is written.
    IsWritten([u8; 8], Written),
}

impl Transfer {
    fn advance<O: Objects>(
        &mut self,
        [command, data @ ..]: [u8; 8],
        objects: &mut O,
        buffer: &mut [u8],
    ) -> Result<Advance, Abort> {
        use Advance::*;
        match (command >> 5, self) {
            (UPLOAD_SEGMENT, Self::Upload(upload)) => {
                let answer = Some(upload.next_segment(command & TOGGLE, objects, buffer)?);
                Ok(if upload.is_complete::<O>() { Ends(answer) } else { Goes(answer) })
            }
            _ if !O::HAS_APPLICATION => Err(Abort::Command),
            (DOWNLOAD_SEGMENT, Self::Download(download)) => {
                let (answer, written) = download.handle_segment(command, &data, objects, buffer)?;
                Ok(match written {
                    Some(written) => IsWritten(answer, written),
                    None => Goes(Some(answer)),
                })
            }
            (BLOCK_UPLOAD, Self::BlockUpload(upload)) => {
                let (answer, is_over) = upload.handle::<O>(command, data)?;
                Ok(if is_over { Ends(answer) } else { Goes(answer) })
            }
            (_, Self::BlockDownload(download)) if download.is_receiving() => {
                Ok(Goes(download.handle_segment(command, data, objects, buffer)?))
            }
            (BLOCK_DOWNLOAD, Self::BlockDownload(download)) => {
                let (answer, written) = download.end(command, data, objects, buffer)?;
                Ok(IsWritten(answer, written))
            }
            _ => Err(Abort::Command),
        }
    }

    /// The message that ends the transfer for this reason.
    fn fail<O: Objects>(&self, code: Abort, objects: &mut O) -> [u8; 8] {
        let address = match self {
            Self::Upload(upload) => upload.address,
            _ if !O::HAS_APPLICATION => Address::NONE,
            Self::BlockUpload(transfer) => transfer.upload.address,
            Self::Download(download) => Address::of(download.entry),
            Self::BlockDownload(transfer) => Address::of(transfer.download.entry),
        };
        if O::HAS_APPLICATION {
            cancel(self, objects);
        }
        abort(address, code)
    }
}

fn find_readable<O: Objects>(address: Address, objects: &O) -> Result<&'static Entry, Abort> {
    let entry = objects.find(address.index, address.sub_index)?;
    match entry.access {
        Access::WriteOnly if O::HAS_APPLICATION => Err(Abort::WriteOnly),
        _ => Ok(entry),
    }
}

fn find_writable<O: Objects>(address: Address, objects: &O) -> Result<&'static Entry, Abort> {
    let entry = objects.find(address.index, address.sub_index)?;
    match entry.access {
        Access::ReadWrite => Ok(entry),
        Access::WriteOnly if O::HAS_APPLICATION => Ok(entry),
        _ => Err(Abort::ReadOnly),
    }
}

/// Ends a transfer before its end: the application must discard the part of a domain that it has.
fn cancel<O: Objects>(transfer: &Transfer, objects: &mut O) {
    if let Some(domain) = domain_of(transfer) {
        objects.abort_domain(domain);
    }
}

/// The domain that the transfer writes.
fn domain_of(transfer: &Transfer) -> Option<&'static Entry> {
    match transfer {
        Transfer::Download(download) | Transfer::BlockDownload(BlockDownload { download, .. })
            if download.entry.data_type == DataType::Domain =>
        {
            Some(download.entry)
        }
        _ => None,
    }
}

const fn expedited(address: Address, len: u8, number: u32) -> [u8; 8] {
    let unused = 4_u8.saturating_sub(len);
    address.message(0x43 | unused << 2, number)
}

/// The time after which a block is confirmed as far as it has come: its last segment may be lost. It is late in the
/// time-out, since a slow client does not expect it.
const fn confirm_after(timeout_micros: u32) -> u32 {
    timeout_micros / 4 * 3
}

const fn abort(address: Address, code: Abort) -> [u8; 8] {
    super::abort(address.index, address.sub_index, code)
}
