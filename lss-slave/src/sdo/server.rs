//! The server of a node with an application: takes each request to its service, and ends transfers of silent clients.

use super::{
    Abort, Address, Objects, Service, Written, block_download::BlockDownload,
    block_upload::BlockUpload, confirm, download::Download, upload::TOGGLE, upload::Upload,
};
use crate::{
    Instant,
    object_dictionary::{Access, DataType, Entry},
};

/// The number of segments of a block upload that may wait for the bus: the second is there when the first has left,
/// and an LSS answer waits for two frames at most.
const SEGMENTS_PENDING: u8 = 2;

/// An SDO server with every service, for values of up to `N` bytes that a client can write.
#[derive(Clone, Debug)]
pub struct Server<const N: usize> {
    /// A received request that has not been answered.
    request: Option<[u8; 8]>,
    transfer: Option<Transfer>,
    /// The value under way; it has room for the longest that can be written.
    buffer: [u8; N],
    /// The time of the last progress of the transfer.
    since: Instant,
    /// The number of segments that may be sent until [`note_sent`](Self::note_sent).
    credit: u8,
    /// The answer to a download whose store is under way.
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

impl<const N: usize> Service for Server<N> {
    const NEW: Self = Self {
        request: None,
        transfer: None,
        buffer: [0; N],
        since: Instant::from_micros(0),
        credit: 0,
        confirmation: None,
    };

    fn reset(&mut self) {
        self.request = None;
        self.transfer = None;
    }

    fn handle(&mut self, request: [u8; 8]) {
        self.request = Some(request);
    }

    fn poll<O: Objects>(&mut self, objects: &mut O, now: Instant) -> Option<[u8; 8]> {
        self.answer(objects, now).or_else(|| self.proceed(objects, now))
    }

    fn poll_at<O: Objects>(&self) -> Option<Instant> {
        let micros = match self.transfer.as_ref()? {
            Transfer::BlockDownload(transfer) if transfer.is_within_block() => {
                confirm_after(O::TIMEOUT_MICROS)
            }
            _ => O::TIMEOUT_MICROS,
        };
        Some(self.since.plus_micros(micros))
    }

    fn end_transfer(&mut self) {
        self.transfer = None;
    }

    fn domain(&self) -> Option<&'static Entry> {
        self.transfer.as_ref()?.domain()
    }

    fn is_sending_block(&self) -> bool {
        matches!(&self.transfer, Some(Transfer::BlockUpload(upload)) if upload.is_sending())
    }

    fn note_sent(&mut self) {
        self.credit = SEGMENTS_PENDING;
    }

    fn confirm(&self, index: u16, sub_index: u8) -> [u8; 8] {
        self.confirmation.unwrap_or(confirm(index, sub_index))
    }
}

impl<const N: usize> Server<N> {
    fn answer<O: Objects>(&mut self, objects: &mut O, now: Instant) -> Option<[u8; 8]> {
        let request = self.request.take()?;
        self.since = now;
        self.confirmation = None;
        if self.continues(request[0]) {
            return self.continue_transfer(request, objects);
        }
        if let Some(transfer) = self.transfer.take() {
            transfer.cancel(objects);
        }
        let initiate = Initiate::new(request);
        let answer = match initiate.command >> 5 {
            DOWNLOAD => self.download(initiate, objects),
            UPLOAD => self.upload(initiate, objects).map(Some),
            ABORT => Ok(None),
            BLOCK_UPLOAD => self.block_upload(initiate, objects).map(Some),
            BLOCK_DOWNLOAD => self.block_download(initiate, objects).map(Some),
            _ => Err(Abort::Command),
        };
        answer.unwrap_or_else(|code| Some(abort(initiate.address, code)))
    }

    fn upload<O: Objects>(
        &mut self,
        Initiate { address, .. }: Initiate,
        objects: &O,
    ) -> Result<[u8; 8], Abort> {
        let entry = find_readable(address, objects)?;
        let upload = Upload::begin(entry, objects, &mut self.buffer)?;
        self.begin_upload(upload, objects)
    }

    fn begin_upload<O: Objects>(&mut self, upload: Upload, objects: &O) -> Result<[u8; 8], Abort> {
        if let 1..=4 = upload.len() {
            let mut bytes = [0; 4];
            let len = upload.read(objects, &self.buffer, &mut bytes)?;
            return Ok(expedited(upload.address, len as u8, u32::from_le_bytes(bytes)));
        }
        self.transfer = Some(Transfer::Upload(upload));
        Ok(upload.address.message(0x41, upload.len()))
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
        // Without its length an expedited string or domain is all four bytes.
        let size = entry.data_type.size();
        let of_object = if let 1..=4 = size { size.into() } else { 4 };
        let announced = announced.or(is_expedited.then_some(of_object));
        let mut download = Download::begin(entry, announced, &self.buffer)?;
        let confirmation = address.message(0x60, 0);
        if !is_expedited {
            self.transfer = Some(Transfer::Download(download));
            return Ok(Some(confirmation));
        }
        let bytes = data.get(..announced.unwrap_or(4) as usize).unwrap_or(&data);
        let written = download
            .add(bytes, objects, &mut self.buffer)
            .and_then(|()| download.end(objects, &self.buffer));
        match written {
            Ok(written) => Ok(self.conclude(confirmation, written)),
            Err(code) => {
                Transfer::Download(download).cancel(objects);
                Err(code)
            }
        }
    }

    fn block_upload<O: Objects>(
        &mut self,
        Initiate { address, data: [block_size, switch_at, ..], .. }: Initiate,
        objects: &O,
    ) -> Result<[u8; 8], Abort> {
        let entry = find_readable(address, objects)?;
        let upload = Upload::begin(entry, objects, &mut self.buffer)?;
        let (transfer, answer) = BlockUpload::begin(upload, block_size)?;
        // Short data goes by the other protocol: the client has asked for that (protocol switch threshold).
        if upload.len() <= switch_at.into() && switch_at > 0 {
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
        let download = Download::begin(entry, announced, &self.buffer)?;
        let (transfer, answer) = BlockDownload::begin(download, command & CRC_SUPPORTED != 0);
        self.transfer = Some(Transfer::BlockDownload(transfer));
        Ok(answer)
    }

    /// Takes a request to the current transfer; returns the answer, if there is one now.
    #[inline(never)] // Apart it takes 190 bytes less.
    fn continue_transfer<O: Objects>(
        &mut self,
        request: [u8; 8],
        objects: &mut O,
    ) -> Option<[u8; 8]> {
        let Some(transfer) = &mut self.transfer else {
            return Some(abort(Address::NONE, Abort::Command));
        };
        match transfer.advance(request, objects, &mut self.buffer) {
            Ok(Advance::Goes(answer)) => {
                // The segments before a message of the client have been sent.
                self.credit = SEGMENTS_PENDING;
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
                match upload.next_segment(objects, &self.buffer) {
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
    fn continues(&self, command: u8) -> bool {
        /// Only this first byte tells an abort from a segment of a block.
        const ABORT_COMMAND: u8 = ABORT << 5;
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
                Ok(if upload.is_complete() { Ends(answer) } else { Goes(answer) })
            }
            (DOWNLOAD_SEGMENT, Self::Download(download)) => {
                let (answer, written) = download.handle_segment(command, &data, objects, buffer)?;
                Ok(match written {
                    Some(written) => IsWritten(answer, written),
                    None => Goes(Some(answer)),
                })
            }
            (BLOCK_UPLOAD, Self::BlockUpload(upload)) => {
                let (answer, is_over) = upload.handle(command, data)?;
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
            Self::BlockUpload(transfer) => transfer.upload.address,
            Self::Download(download) => Address::of(download.entry),
            Self::BlockDownload(transfer) => Address::of(transfer.download.entry),
        };
        self.cancel(objects);
        abort(address, code)
    }

    /// Ends the transfer before its end: the application must discard the part of a domain that it has.
    fn cancel<O: Objects>(&self, objects: &mut O) {
        if let Some(domain) = self.domain() {
            objects.abort_domain(domain);
        }
    }

    /// The domain that the transfer writes.
    fn domain(&self) -> Option<&'static Entry> {
        match self {
            Self::Download(download) | Self::BlockDownload(BlockDownload { download, .. })
                if download.entry.data_type == DataType::Domain =>
            {
                Some(download.entry)
            }
            _ => None,
        }
    }
}

fn find_readable<O: Objects>(address: Address, objects: &O) -> Result<&'static Entry, Abort> {
    let entry = objects.find(address.index, address.sub_index)?;
    match entry.access {
        Access::WriteOnly => Err(Abort::WriteOnly),
        _ => Ok(entry),
    }
}

fn find_writable<O: Objects>(address: Address, objects: &O) -> Result<&'static Entry, Abort> {
    let entry = objects.find(address.index, address.sub_index)?;
    match entry.access {
        Access::ReadWrite | Access::WriteOnly => Ok(entry),
        _ => Err(Abort::ReadOnly),
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
