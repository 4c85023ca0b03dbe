//! The SDO server: takes each request to its service, and ends transfers of silent clients.

use super::{
    Abort, Address, Buffer, Content, Message, Objects,
    block_download::{BLOCK_SIZE, BlockDownload, ends_block},
    block_upload::BlockUpload,
    download::Download,
    upload::TOGGLE,
    upload::Upload,
};
use crate::{
    Deadline, Instant,
    object_dictionary::{Access, Entry},
};

/// A client sends the segments of a block without waiting. Those that arrive after the transfer has ended must not be
/// executed as requests, and CiA 301 gives them nothing that a request cannot have. So until the last one, an abort, or
/// this time without a message nothing is executed, however many segments are lost: the client of a request will repeat
/// it, and file content that is executed does more harm.
const REST_MICROS: u32 = 100_000;
/// The first byte of an abort: only this one tells it from a segment of a block.
const ABORT_COMMAND: u8 = ABORT << 5;

/// An SDO server. It holds one request and at most one transfer, which the next initiate ends.
#[derive(Clone, Debug)]
pub(crate) struct Server<B> {
    /// A received request that has not been answered.
    request: Option<Message>,
    transfer: Option<Transfer>,
    /// Until then segments may follow a block download that has ended within a block.
    rest_until: Option<Deadline>,
    /// The value under way.
    buffer: B,
    /// The time of the last progress of the transfer.
    since: Instant,
    /// Whether the next segment of a block may be sent: none of those before waits.
    is_clear: bool,
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

impl<B: Buffer> Server<B> {
    /// A server without a request.
    pub const NEW: Self = Self {
        request: None,
        transfer: None,
        rest_until: None,
        buffer: B::EMPTY,
        since: Instant::from_micros(0),
        is_clear: false,
    };

    /// Discards the request and the current transfer without an answer to the client.
    pub fn reset(&mut self) {
        self.end_transfer();
        self.request = None;
    }

    /// Accepts a request, which [`poll`](Self::poll) answers if the NMT state and the bit rate allow it (`is_served`).
    pub fn handle(&mut self, request: Message, is_served: bool, now: Instant) {
        if self.rest_until.take_if(|until| !until.is_over(now)).is_some() {
            let command = request.command();
            let is_last = command == ABORT_COMMAND || ends_block(command, BLOCK_SIZE);
            self.rest_until = Deadline::after(now, REST_MICROS).filter(|_| !is_last);
        } else if is_served {
            self.request = Some(request);
        }
    }

    /// Executes the request and returns the answer, if there is one now. Without an answer returns the next message of
    /// the transfer.
    pub fn poll<O: Objects>(&mut self, objects: &mut O, now: Instant) -> Option<Message> {
        self.answer(objects, now).or_else(|| self.proceed(objects, now))
    }

    /// The latest time of the next [`poll`](Self::poll), if there is no request before.
    pub fn poll_at<O: Objects>(&self) -> Option<Instant> {
        self.transfer.is_some().then(|| self.since.plus_micros(O::TIMEOUT_MICROS))
    }

    /// Ends the current transfer without an answer to the client.
    pub fn end_transfer(&mut self) {
        if let Some(Transfer::BlockDownload(transfer)) = self.transfer.take()
            && transfer.is_in_block()
        {
            self.rest_until = Deadline::after(self.since, REST_MICROS);
            // What waits may be a segment.
            if let Some(request) = self.request.take() {
                self.handle(request, true, self.since);
            }
        }
    }

    /// The domain that the current transfer writes.
    pub fn domain(&self) -> Option<&'static Entry> {
        self.transfer.as_ref()?.domain()
    }

    /// Whether there is a transfer of several messages.
    pub const fn has_transfer(&self) -> bool {
        self.transfer.is_some()
    }

    /// Whether the answer to the request that waits lets the client go on with the download of the object with this index,
    /// in blocks of this size.
    pub fn goes_on(&self, index: u16, block_size: u8) -> bool {
        const LAST: u8 = 0x80;
        let Some(request) = self.request else { return false };
        let number = request.command() & !LAST;
        match &self.transfer {
            Some(Transfer::Download(download)) => download.entry.index == index,
            Some(Transfer::BlockDownload(transfer)) => {
                let is_last = number == block_size || request.command() & LAST != 0;
                transfer.download.entry.index == index && is_last
            }
            _ => false,
        }
    }

    /// Whether a block of an upload has further segments.
    pub const fn is_sending_block(&self) -> bool {
        matches!(&self.transfer, Some(Transfer::BlockUpload(upload)) if upload.is_sending())
    }

    /// Records that no frame of the node waits for the bus.
    pub const fn note_sent(&mut self) {
        self.is_clear = true;
    }

    fn answer<O: Objects>(&mut self, objects: &mut O, now: Instant) -> Option<Message> {
        let request = self.request.take()?;
        self.since = now;
        if self.continues(request.command()) {
            return self.continue_transfer(request, objects);
        }
        if self.transfer.is_some() {
            self.cancel_transfer(objects);
        }
        let answer = match request.command() >> 5 {
            ABORT => {
                self.rest_until = None;
                objects.forget_store();
                Ok(None)
            }
            UPLOAD | DOWNLOAD => self.begin(request, objects),
            BLOCK_UPLOAD if O::BLOCK_UPLOAD => self.begin(request, objects),
            BLOCK_DOWNLOAD if O::BLOCK_DOWNLOAD => self.begin(request, objects),
            _ => Err(Abort::Command),
        };
        answer.unwrap_or_else(|code| Some(Message::abort(request.address(), code)))
    }

    /// Begins a transfer; returns the answer, if there is one now.
    fn begin<O: Objects>(
        &mut self,
        request: Message,
        objects: &mut O,
    ) -> Result<Option<Message>, Abort> {
        let address = request.address();
        let entry = objects.find(address.index, address.sub_index)?;
        match (request.command() >> 5, entry.access) {
            (UPLOAD | BLOCK_UPLOAD, Access::WriteOnly) => Err(Abort::WriteOnly),
            (DOWNLOAD | BLOCK_DOWNLOAD, Access::Const | Access::ReadOnly) => Err(Abort::ReadOnly),
            (DOWNLOAD, _) => self.download(request, entry, objects),
            (BLOCK_DOWNLOAD, _) if O::BLOCK_DOWNLOAD => {
                let size = if O::PROGRAM_DOWNLOAD { objects.grant(entry) } else { BLOCK_SIZE };
                self.block_download(request, entry, size, objects).map(Some)
            }
            (service, _) => {
                let value = objects.read(entry)?;
                if let (UPLOAD, Content::Number(number)) = (service, value) {
                    return Ok(Some(expedited(address, entry.data_type.size(), number)));
                }
                let upload = Upload::begin(entry, value, objects, self.buffer.as_mut())?;
                let answer = match service {
                    BLOCK_UPLOAD if O::BLOCK_UPLOAD => self.block_upload(request, upload, objects),
                    _ => self.upload(upload, objects),
                };
                answer.map(Some)
            }
        }
    }

    fn upload<O: Objects>(&mut self, upload: Upload, objects: &O) -> Result<Message, Abort> {
        if let 1..=4 = upload.len() {
            let mut bytes = [0; 4];
            let len = upload.read(objects, self.buffer.as_ref(), &mut bytes)?;
            return Ok(expedited(upload.address, len as u8, u32::from_le_bytes(bytes)));
        }
        self.transfer = Some(Transfer::Upload(upload));
        Ok(Message::new(0x41, upload.address, upload.len()))
    }

    fn download<O: Objects>(
        &mut self,
        request: Message,
        entry: &'static Entry,
        objects: &mut O,
    ) -> Result<Option<Message>, Abort> {
        const EXPEDITED: u8 = 0x02;
        const SIZE_INDICATED: u8 = 0x01;
        let (command, address, number) = (request.command(), request.address(), request.data);
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
        let confirmation = Message::new(0x60, address, 0);
        let data = number.to_le_bytes();
        let bytes = data.get(..announced.unwrap_or(4) as usize).unwrap_or(&data);
        if is_expedited && !entry.options.is_streamed() {
            return objects.write(entry, bytes, confirmation);
        }
        let mut download = Download::begin(entry, announced, objects, self.buffer.as_ref())?;
        if !is_expedited {
            self.transfer = Some(Transfer::Download(download));
            return Ok(Some(confirmation));
        }
        download
            .add(bytes, objects, self.buffer.as_mut())
            .and_then(|()| download.end(confirmation, objects, self.buffer.as_ref()))
            .inspect_err(|_| Transfer::Download(download).cancel(objects))
    }

    fn block_upload<O: Objects>(
        &mut self,
        request: Message,
        upload: Upload,
        objects: &O,
    ) -> Result<Message, Abort> {
        const CRC_SUPPORTED: u8 = 0x04;
        let [block_size, switch_at, ..] = request.data.to_le_bytes();
        let (transfer, answer) =
            BlockUpload::begin(upload, block_size, request.command() & CRC_SUPPORTED != 0)?;
        // Short data goes by the other protocol: the client has asked for that (protocol switch threshold).
        if upload.len() <= switch_at.into() && switch_at > 0 {
            return self.upload(upload, objects);
        }
        self.transfer = Some(Transfer::BlockUpload(transfer));
        Ok(answer)
    }

    fn block_download<O: Objects>(
        &mut self,
        request: Message,
        entry: &'static Entry,
        size: u8,
        objects: &mut O,
    ) -> Result<Message, Abort> {
        const CRC_SUPPORTED: u8 = 0x04;
        const SIZE_INDICATED: u8 = 0x02;
        let command = request.command();
        let announced = (command & SIZE_INDICATED != 0).then_some(request.data);
        let download = Download::begin(entry, announced, objects, self.buffer.as_ref())?;
        let has_crc = command & CRC_SUPPORTED != 0;
        let (transfer, answer) = BlockDownload::begin(download, has_crc, size);
        self.transfer = Some(Transfer::BlockDownload(transfer));
        Ok(answer)
    }

    /// Takes a request to the current transfer; returns the answer, if there is one now.
    fn continue_transfer<O: Objects>(
        &mut self,
        request: Message,
        objects: &mut O,
    ) -> Option<Message> {
        let Some(transfer) = &mut self.transfer else {
            return Some(Message::abort(Address::NONE, Abort::Command));
        };
        match transfer.advance(request, objects, self.buffer.as_mut()) {
            Ok((answer, is_over)) => {
                // The segments before a message of the client have been sent.
                self.is_clear = true;
                if is_over {
                    self.transfer = None;
                }
                answer
            }
            Err(code) => self.fail(code, objects),
        }
    }

    /// Returns the next segment of a block, or the end of a transfer whose client is silent.
    fn proceed<O: Objects>(&mut self, objects: &mut O, now: Instant) -> Option<Message> {
        let deadline = self.poll_at::<O>()?;
        let code = match &mut self.transfer {
            Some(Transfer::BlockUpload(upload))
                if O::BLOCK_UPLOAD && upload.is_sending() && self.is_clear =>
            {
                self.since = now;
                self.is_clear = false;
                match upload.next_segment(objects, self.buffer.as_ref()) {
                    Ok(segment) => return Some(segment),
                    Err(code) => code,
                }
            }
            _ if !deadline.has_come(now) => return None,
            _ => Abort::Timeout,
        };
        self.fail(code, objects)
    }

    /// Ends the transfer for this reason; returns the message to the client.
    fn fail<O: Objects>(&mut self, code: Abort, objects: &mut O) -> Option<Message> {
        let address = self.transfer.as_ref()?.address();
        self.cancel_transfer(objects);
        Some(Message::abort(address, code))
    }

    /// Ends the transfer, if there is one, before its end.
    fn cancel_transfer<O: Objects>(&mut self, objects: &mut O) {
        if let Some(transfer) = &self.transfer {
            transfer.cancel(objects);
            self.end_transfer();
        }
    }

    /// Whether a request belongs to a transfer rather than begins or ends one.
    fn continues(&self, command: u8) -> bool {
        match &self.transfer {
            Some(Transfer::BlockDownload(download)) if download.is_in_block() => {
                command != ABORT_COMMAND
            }
            _ => match command >> 5 {
                DOWNLOAD_SEGMENT | UPLOAD_SEGMENT => true,
                BLOCK_UPLOAD | BLOCK_DOWNLOAD => !begins_transfer(command),
                _ => false,
            },
        }
    }
}

/// Whether a request begins a transfer.
const fn begins_transfer(command: u8) -> bool {
    match command >> 5 {
        DOWNLOAD | UPLOAD => true,
        BLOCK_UPLOAD => command & 3 == 0,
        BLOCK_DOWNLOAD => command & 1 == 0,
        _ => false,
    }
}

impl Transfer {
    /// Handles a request; returns the answer, if there is one now, and whether the transfer is over.
    fn advance<O: Objects>(
        &mut self,
        message: Message,
        objects: &mut O,
        buffer: &mut [u8],
    ) -> Result<(Option<Message>, bool), Abort> {
        let (command, data) = (message.command(), message.payload());
        match (command >> 5, self) {
            (_, Self::BlockDownload(download)) if O::BLOCK_DOWNLOAD && download.is_in_block() => {
                Ok((download.handle_segment(command, data, objects, buffer)?, false))
            }
            (BLOCK_DOWNLOAD, Self::BlockDownload(download)) if O::BLOCK_DOWNLOAD => {
                Ok((download.end(command, data, objects, buffer)?, true))
            }
            (UPLOAD_SEGMENT, Self::Upload(upload)) => {
                let answer = upload.next_segment(command & TOGGLE, objects, buffer)?;
                Ok((Some(answer), upload.is_complete()))
            }
            (DOWNLOAD_SEGMENT, Self::Download(download)) => {
                download.handle_segment(command, &data, objects, buffer)
            }
            (BLOCK_UPLOAD, Self::BlockUpload(upload)) if O::BLOCK_UPLOAD => {
                upload.handle(command, data)
            }
            _ => Err(Abort::Command),
        }
    }

    /// The address of the object.
    const fn address(&self) -> Address {
        match self {
            Self::Upload(upload) => upload.address,
            Self::BlockUpload(transfer) => transfer.upload.address,
            Self::Download(download) => Address::of(download.entry),
            Self::BlockDownload(transfer) => Address::of(transfer.download.entry),
        }
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
                if download.entry.options.is_streamed() =>
            {
                Some(download.entry)
            }
            _ => None,
        }
    }
}

const fn expedited(address: Address, len: u8, number: u32) -> Message {
    let unused = 4_u8.saturating_sub(len);
    Message::new(0x43 | unused << 2, address, number)
}
