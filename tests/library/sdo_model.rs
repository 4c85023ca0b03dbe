//! A second description of the SDO server, written from CiA 301, which must agree with it about random messages.

use std::collections::BTreeMap;

use testkit::{
    frames::{Frames, SILENCE},
    node_rig::NodeRig,
    random::{Random, every},
    sdo_messages::{Address, crc, initiate, segment},
};

use crate::sdo_machine::{CONSTANT, Machine, board};

/// The longest string of the machine.
const LONGEST: usize = 40;
const TIMEOUT: u32 = 0x0504_0000;
const COMMAND: u32 = 0x0504_0001;
const TOO_LONG: u32 = 0x0607_0012;
const TOO_SHORT: u32 = 0x0607_0013;

type Message = [u8; 8];

/// The heartbeat time.
const HEARTBEAT: Address = (0x1017, 0);

/// A transfer of an object.
#[derive(Clone, Debug)]
struct Transfer {
    at: Address,
    state: State,
}

/// The state of a transfer, with all of its data.
#[derive(Clone, Debug)]
enum State {
    Upload { rest: Vec<u8>, toggle: u8 },
    Download { size: Option<usize>, data: Vec<u8>, toggle: u8 },
    BlockUpload(BlockUpload),
    BlockDownload(BlockDownload),
}

#[derive(Clone, Debug)]
struct BlockUpload {
    data: Vec<u8>,
    has_crc: bool,
    /// The number of bytes that the client has confirmed.
    confirmed: usize,
    phase: Phase,
    block: usize,
    /// The number of segments of the block.
    sent: usize,
}

#[derive(Clone, Debug)]
struct BlockDownload {
    size: Option<usize>,
    has_crc: bool,
    segments: Vec<[u8; 7]>,
    /// The number of the last segment in sequence, and that of the last segment.
    last: u8,
    seen: u8,
    is_ending: bool,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Phase {
    Initiated,
    Sent,
    Ending,
}

struct Model {
    /// Domain 2300h sub-index 2 reads sub-index 1.
    values: BTreeMap<Address, Vec<u8>>,
    transfer: Option<Transfer>,
    /// The number of the last segment of a block that was cut off.
    cut_off: bool,
    /// The time since the last message of the client in milliseconds.
    idle: u64,
    is_stopped: bool,
}

fn abort(at: Address, code: u32) -> Vec<Message> {
    vec![initiate(0x80, at, code)]
}

impl Model {
    fn new() -> Self {
        let values = [
            ((0x1008, 0), b"Test board".to_vec()),
            (HEARTBEAT, vec![0, 0]),
            ((0x1200, 0), vec![2]),
            ((0x1200, 1), vec![0x40, 6, 0, 0]),
            ((0x1200, 2), vec![0xC0, 5, 0, 0]),
            ((0x2100, 0), vec![5]),
            ((0x2100, 1), vec![8]),
            ((0x2100, 2), vec![16, 0]),
            ((0x2100, 3), vec![32, 0, 0, 0]),
            ((0x2100, 4), 0x1122_3344_5566_7788_u64.to_le_bytes().to_vec()),
            ((0x2100, 5), vec![]),
            ((0x2200, 0), vec![3]),
            ((0x2200, 1), CONSTANT.into()),
            ((0x2200, 2), vec![]),
            ((0x2200, 3), vec![]),
            ((0x2300, 0), vec![2]),
            ((0x2300, 1), vec![]),
            ((0x2300, 2), vec![]),
        ];
        let values = values.into();
        Self { values, transfer: None, cut_off: false, idle: 0, is_stopped: false }
    }

    fn check_exists(&self, at: Address) -> Result<(), u32> {
        match self.values.contains_key(&at) {
            true => Ok(()),
            false if self.values.keys().any(|(index, _)| *index == at.0) => Err(0x0609_0011),
            false => Err(0x0602_0000),
        }
    }

    fn read(&self, at: Address) -> Result<Vec<u8>, u32> {
        self.check_exists(at)?;
        match (at, &self.values[&if at == (0x2300, 2) { (0x2300, 1) } else { at }]) {
            ((0x2100, 5), _) => Err(0x0601_0001),
            ((0x2300, 1 | 2), memory) if memory.is_empty() => Err(0x0800_0024),
            (_, value) => Ok(value.clone()),
        }
    }

    /// The size of a number, or `None`.
    fn size(at: Address) -> Option<usize> {
        match at {
            (0x2100, 1) => Some(1),
            (0x1017, _) | (0x2100, 2) => Some(2),
            (0x2100, 4) => Some(8),
            (0x2100, 5) => Some(4),
            _ => None,
        }
    }

    fn check_writable(&self, at: Address, size: Option<usize>) -> Result<(), u32> {
        self.check_exists(at)?;
        if !matches!(at, (0x1017, _) | (0x2100, 1 | 2 | 4 | 5) | (0x2200, 2 | 3) | (0x2300, 1)) {
            return Err(0x0601_0002);
        }
        let Some(len) = size else { return Ok(()) };
        match Self::size(at) {
            Some(size) if len > size => Err(TOO_LONG),
            Some(size) if len < size => Err(TOO_SHORT),
            None if at.0 != 0x2300 && len > LONGEST => Err(TOO_LONG),
            _ => Ok(()),
        }
    }

    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), u32> {
        match Self::size(at) {
            Some(size) if data.len() > size => return Err(TOO_LONG),
            Some(size) if data.len() < size => return Err(TOO_SHORT),
            _ => {}
        }
        match at {
            (0x2100, 1) if data[0] < 5 => return Err(0x0609_0032),
            (0x2100, 1) if data[0] > 250 => return Err(0x0609_0031),
            (0x2100, 2) if data == [0xAD, 0xDE] => return Err(0x0800_0022),
            (0x2200, 2) if data.len() > 20 => return Err(TOO_LONG),
            _ => _ = self.values.insert(at, data.to_vec()),
        }
        Ok(())
    }

    /// Whether so much data can be on its way to an object.
    fn check_room(at: Address, size: Option<usize>, len: usize) -> Result<(), u32> {
        match size {
            Some(size) if len > size => Err(TOO_LONG),
            _ if at.0 != 0x2300 && len > LONGEST => Err(TOO_LONG),
            _ => Ok(()),
        }
    }

    fn check_complete(size: Option<usize>, len: usize) -> Result<(), u32> {
        if size.is_some_and(|size| len < size) { Err(TOO_SHORT) } else { Ok(()) }
    }

    /// Ends the transfer without an answer.
    fn cut_off(&mut self) {
        if let Some(Transfer { state: State::BlockDownload(block), .. }) = self.transfer.take()
            && !block.is_ending
        {
            self.cut_off = self.idle < 100;
        }
    }

    /// Whether a message is part of a block that was cut off.
    fn is_of_block(&mut self, command: u8) -> bool {
        let is_of_block = self.cut_off;
        self.cut_off &= command < 127;
        is_of_block
    }

    /// The answers of the server, and its new state.
    fn handle(&mut self, message: Message) -> Vec<Message> {
        if self.is_of_block(message[0]) || self.is_stopped {
            return vec![];
        }
        self.idle = 0;
        let command = message[0];
        let at = (u16::from_le_bytes([message[1], message[2]]), message[3]);
        let transfer = self.transfer.take();
        let of_transfer = transfer.as_ref().map_or((0, 0), |transfer| transfer.at);
        if let Some(Transfer { state: State::BlockDownload(block), .. }) = &transfer
            && !block.is_ending
        {
            if command == 0x80 {
                return vec![];
            }
            return self.receive_block(of_transfer, block.clone(), message).unwrap_or_else(
                |code| {
                    self.cut_off = command < 127;
                    abort(of_transfer, code)
                },
            );
        }
        let (answers, at) = match command >> 5 {
            1 => (self.begin_download(at, message), at),
            2 => (self.begin_upload(at), at),
            4 => return vec![],
            5 if command & 3 == 0 => (self.begin_block_upload(at, message), at),
            6 if command & 1 == 0 => (self.begin_block_download(at, message), at),
            7 => (Err(COMMAND), at),
            _ => (self.go_on(transfer, message), of_transfer),
        };
        answers.unwrap_or_else(|code| abort(at, code))
    }

    fn begin(&mut self, at: Address, state: State) {
        self.transfer = Some(Transfer { at, state });
    }

    fn begin_upload(&mut self, at: Address) -> Result<Vec<Message>, u32> {
        let data = self.read(at)?;
        if let 1..=4 = data.len() {
            let mut number = [0; 4];
            number[..data.len()].copy_from_slice(&data);
            let command = 0x43 | (4 - data.len() as u8) << 2;
            return Ok(vec![initiate(command, at, u32::from_le_bytes(number))]);
        }
        let answer = initiate(0x41, at, data.len() as u32);
        self.begin(at, State::Upload { rest: data, toggle: 0 });
        Ok(vec![answer])
    }

    fn begin_download(&mut self, at: Address, message: Message) -> Result<Vec<Message>, u32> {
        let number = u32::from_le_bytes(message[4..].try_into().unwrap()) as usize;
        let unused = usize::from(message[0] >> 2 & 3);
        let answer = vec![initiate(0x60, at, 0)];
        match message[0] & 3 {
            0 => {
                self.check_writable(at, None)?;
                self.begin(at, State::Download { size: None, data: vec![], toggle: 0 });
            }
            1 => {
                self.check_writable(at, Some(number))?;
                self.begin(at, State::Download { size: Some(number), data: vec![], toggle: 0 });
            }
            expedited => {
                let of_object = Self::size(at).filter(|&size| size <= 4).unwrap_or(4);
                let len = if expedited == 3 { 4 - unused } else { of_object };
                self.check_writable(at, Some(len))?;
                self.write(at, &message[4..4 + len])?;
            }
        }
        Ok(answer)
    }

    fn begin_block_upload(&mut self, at: Address, message: Message) -> Result<Vec<Message>, u32> {
        let data = self.read(at)?;
        let (block, threshold) = (usize::from(message[4]), usize::from(message[5]));
        if !(1..=127).contains(&block) {
            return Err(0x0504_0002);
        }
        if threshold > 0 && data.len() <= threshold {
            return self.begin_upload(at);
        }
        let answer = initiate(0xC6, at, data.len() as u32);
        let (has_crc, phase) = (message[0] & 4 != 0, Phase::Initiated);
        let upload = BlockUpload { data, has_crc, confirmed: 0, phase, block, sent: 0 };
        self.begin(at, State::BlockUpload(upload));
        Ok(vec![answer])
    }

    fn begin_block_download(&mut self, at: Address, message: Message) -> Result<Vec<Message>, u32> {
        let number = u32::from_le_bytes(message[4..].try_into().unwrap()) as usize;
        let size = (message[0] & 2 != 0).then_some(number);
        self.check_writable(at, size)?;
        let has_crc = message[0] & 4 != 0;
        let (segments, is_ending) = (vec![], false);
        let download = BlockDownload { size, has_crc, segments, last: 0, seen: 0, is_ending };
        self.begin(at, State::BlockDownload(download));
        Ok(vec![initiate(0xA4, at, 127)])
    }

    fn go_on(&mut self, transfer: Option<Transfer>, message: Message) -> Result<Vec<Message>, u32> {
        let command = message[0];
        let Some(Transfer { at, state }) = transfer else { return Err(COMMAND) };
        match state {
            State::Upload { mut rest, toggle } if command >> 5 == 3 => {
                if command & 0x10 != toggle {
                    return Err(0x0503_0000);
                }
                let part: Vec<u8> = rest.drain(..rest.len().min(7)).collect();
                let is_last = rest.is_empty();
                let head = toggle | (7 - part.len() as u8) << 1 | u8::from(is_last);
                if !is_last {
                    self.begin(at, State::Upload { rest, toggle: toggle ^ 0x10 });
                }
                Ok(vec![segment(head, &part)])
            }
            State::Download { size, mut data, toggle } if command >> 5 == 0 => {
                if command & 0x10 != toggle {
                    return Err(0x0503_0000);
                }
                let mut unused = usize::from(command >> 1 & 7);
                if let (1, 0, Some(size)) = (command & 1, unused, size) {
                    unused = 7 - (size - data.len()).min(7);
                }
                data.extend(&message[1..8 - unused]);
                Self::check_room(at, size, data.len())?;
                if command & 1 == 1 {
                    Self::check_complete(size, data.len())?;
                    self.write(at, &data)?;
                } else {
                    self.begin(at, State::Download { size, data, toggle: toggle ^ 0x10 });
                }
                Ok(vec![segment(0x20 | toggle, &[])])
            }
            State::BlockUpload(upload) if command >> 5 == 5 => self.send_block(at, upload, message),
            State::BlockDownload(block) if command >> 5 == 6 => {
                let mut data = block.segments.concat();
                data.truncate(data.len() - usize::from(command >> 2 & 7).min(7));
                Self::check_room(at, block.size, data.len())?;
                if block.has_crc && crc(&data).to_le_bytes() != message[1..3] {
                    return Err(0x0504_0004);
                }
                Self::check_complete(block.size, data.len())?;
                self.write(at, &data)?;
                Ok(vec![segment(0xA1, &[])])
            }
            _ => Err(COMMAND),
        }
    }

    fn send_block(
        &mut self,
        at: Address,
        mut upload: BlockUpload,
        message: Message,
    ) -> Result<Vec<Message>, u32> {
        match (message[0] & 3, upload.phase) {
            (3, Phase::Initiated) => {}
            (2, Phase::Sent) => {
                let number = usize::from(message[1]);
                let (confirmed, sent) = (upload.confirmed, upload.sent);
                if number > sent {
                    return Err(0x0504_0003);
                }
                if number == sent && confirmed + 7 * sent >= upload.data.len() {
                    let unused = (sent * 7 + confirmed - upload.data.len()) as u8;
                    let crc = if upload.has_crc { crc(&upload.data) } else { 0 };
                    upload.phase = Phase::Ending;
                    self.begin(at, State::BlockUpload(upload));
                    return Ok(vec![segment(0xC1 | unused << 2, &crc.to_le_bytes())]);
                }
                upload.block = message[2].into();
                if !(1..=127).contains(&upload.block) {
                    return Err(0x0504_0002);
                }
                upload.confirmed += 7 * number;
            }
            (1, Phase::Ending) => return Ok(vec![]),
            _ => return Err(COMMAND),
        }
        let unconfirmed = &upload.data[upload.confirmed..];
        let rest = unconfirmed.len().div_ceil(7).max(1);
        let message = |number: usize| {
            let part = unconfirmed.chunks(7).nth(number - 1).unwrap_or_default();
            segment(number as u8 | if number == rest { 0x80 } else { 0 }, part)
        };
        let answers: Vec<_> = (1..=rest.min(upload.block)).map(message).collect();
        (upload.phase, upload.sent) = (Phase::Sent, answers.len());
        self.begin(at, State::BlockUpload(upload));
        Ok(answers)
    }

    fn receive_block(
        &mut self,
        at: Address,
        mut block: BlockDownload,
        message: Message,
    ) -> Result<Vec<Message>, u32> {
        let number = message[0] & 0x7F;
        let is_last = message[0] & 0x80 != 0;
        if number == 0 {
            return Err(0x0504_0003);
        }
        let in_sequence = number == block.last + 1;
        if in_sequence {
            // All bytes of the segments before count.
            Self::check_room(at, block.size, block.segments.len() * 7)?;
            block.segments.push(message[1..].try_into().unwrap());
            block.last = number;
        }
        block.seen = number;
        let mut answers = vec![];
        if is_last || number == 127 {
            answers.push(segment(0xA2, &[block.last, 127]));
            (block.last, block.seen) = (0, 0);
        }
        block.is_ending = is_last && in_sequence;
        self.begin(at, State::BlockDownload(block));
        Ok(answers)
    }

    /// The messages of the server when its client is silent for so long.
    fn be_silent(&mut self, ms: u64) -> Vec<Message> {
        self.idle += ms;
        self.cut_off &= ms < 100;
        if self.idle < 1_000 {
            return vec![];
        }
        let Some(at) = self.transfer.as_ref().map(|transfer| transfer.at) else { return vec![] };
        self.cut_off();
        abort(at, TIMEOUT)
    }

    /// A message that fits the state more often than not.
    fn next_message(&self, random: &mut Random) -> Message {
        let mut message: Message = random.bytes();
        if random.one_in(30) {
            // The model knows few of the objects below 8000h.
            message[2] |= 0x80;
            return message;
        }
        if self.cut_off && !random.one_in(8) {
            // A segment that would set an object if it were executed.
            message[1..5].copy_from_slice(&[0x00, 0x21, 0x01, random.within(0..255) as u8]);
            message[0] = random.byte() & 0x7F | if random.one_in(30) { 0x80 } else { 0 };
            return message;
        }
        let at = random.pick(&self.values.keys().copied().collect::<Vec<_>>());
        message[1..3].copy_from_slice(&at.0.to_le_bytes());
        message[3] = if random.one_in(30) { random.byte() } else { at.1 };
        let Some(Transfer { at: of_transfer, state }) =
            self.transfer.as_ref().filter(|_| !random.one_in(60))
        else {
            let len = if random.one_in(2) {
                Self::size(at).unwrap_or(9) as u64
            } else {
                random.within(0..50)
            };
            message[4..].copy_from_slice(&(len as u32).to_le_bytes());
            message[0] = random.pick(&[
                0x40, 0x40, 0x20, 0x21, 0x23, 0x22, 0x2B, 0x2F, 0xC0, 0xC2, 0xC4, 0xC6, 0xA0, 0xA4,
            ]);
            if message[0] >> 5 == 5 {
                message[4] = random.pick(&[0, 1, 2, 5, 127, 128]);
                message[5] = random.pick(&[0, 0, 0, 4, 200]);
            }
            return message;
        };
        match state {
            State::Upload { toggle, .. } => message[0] = 0x60 | toggle,
            State::Download { toggle, size, data, .. } => {
                let rest = size
                    .map_or(random.within(0..30) as usize, |size| size.saturating_sub(data.len()));
                let len = rest.min(7);
                let is_last = if random.one_in(10) { random.one_in(2) } else { rest <= 7 };
                let says_unused = !is_last || !random.one_in(4);
                let unused = if says_unused { 7 - len as u8 } else { 0 };
                message[0] = toggle | unused << 1 | u8::from(is_last);
                message[1..].copy_from_slice(&random.bytes::<7>());
            }
            State::BlockUpload(BlockUpload { phase, sent, .. }) => match phase {
                Phase::Initiated => message[0] = 0xA3,
                Phase::Ending => message[0] = 0xA1,
                Phase::Sent => {
                    let number = if random.one_in(4) {
                        random.within(0..*sent as u64 + 2)
                    } else {
                        *sent as u64
                    };
                    let any = random.byte();
                    let block_size = random.pick(&[1, 1, 3, 3, 50, 50, 127, 127, any]);
                    message[..3].copy_from_slice(&[0xA2, number as u8, block_size]);
                }
            },
            State::BlockDownload(BlockDownload { is_ending: false, seen, .. }) => {
                message = random.bytes();
                let number = match random.within(0..200) {
                    0 => return initiate(0x80, *of_transfer, 0),
                    1..3 => random.byte(),
                    // One is lost.
                    3..6 => seen + 2,
                    _ => seen + 1,
                };
                let segments = if *of_transfer == (0x2300, 1) { 100 } else { 5 };
                message[0] = number & 0x7F | if random.one_in(segments) { 0x80 } else { 0 };
            }
            State::BlockDownload(BlockDownload { size, segments, .. }) => {
                let len = segments.len() * 7;
                let unused =
                    size.filter(|&size| len >= size && len - size < 8).map_or(3, |size| len - size);
                let data = segments.concat();
                let [c0, c1] = crc(&data[..len - unused]).to_le_bytes();
                message[..3].copy_from_slice(&[0xC1 | (unused as u8) << 2, c0, c1]);
            }
        }
        message
    }
}

fn messages(frames: &Frames) -> Vec<Message> {
    // The heartbeat time is one of the objects.
    let of_server = frames.0.iter().filter(|frame| frame.cob_id() == 0x5C0);
    of_server.map(|frame| frame.data().try_into().expect("eight bytes")).collect()
}

fn send(board: &mut NodeRig<Machine>, message: Message) -> Vec<Message> {
    messages(&board.receive(&canopen_node::Frame::new(0x640, &message).unwrap()))
}

#[test]
fn the_server_and_its_second_description_agree_about_random_messages() {
    let mut random = Random::from_environment();
    let (mut board, mut model) = (board(), Model::new());
    let mut transfers = [0; 5];
    let count = 200_000 / every(4);
    for n in 0..count {
        let message = model.next_message(&mut random);
        let before = model.transfer.clone();
        assert_eq!(
            send(&mut board, message),
            model.handle(message),
            "{n}: {message:02X?} in {before:02X?}"
        );
        if random.one_in(50) {
            let is_long = random.one_in(10) && model.values[&HEARTBEAT] == [0, 0];
            let ms = match is_long {
                true => 60_000 * random.pick(&[36, 71, 72]),
                false => random.pick(&[200, 760, 990, 1_000, 5_000]),
            };
            assert_eq!(
                messages(&board.pass_ms(ms)),
                model.be_silent(ms),
                "{n}: {ms} ms of silence after {before:02X?}"
            );
        }
        if random.one_in(200) {
            board.nmt("82 40");
            model.cut_off();
            model.values.insert(HEARTBEAT, vec![0, 0]);
            model.is_stopped = false;
        }
        if random.one_in(if model.is_stopped { 5 } else { 200 }) {
            model.is_stopped ^= true;
            board.nmt(if model.is_stopped { "02 40" } else { "80 40" });
            model.cut_off();
        }
        if random.one_in(200) {
            board.configure("13 00 00, 15 01 00");
            board.pass_ms(2);
            board.lss("04 00");
            model.cut_off();
        }
        if random.one_in(10) {
            // Whatever an SDO client does, an LSS master finds the node.
            let identify = ["46 44 33 22 11", "47 88 77 66 55", "48", "49 FF FF FF FF", "4A"];
            identify.iter().for_each(|step| assert_eq!(board.lss(step), SILENCE, "{n}"));
            assert_eq!(board.lss("4B FF FF FF FF"), ["4F"], "{n}");
        }
        if model.values[&HEARTBEAT] != [0, 0] && model.transfer.is_none() && !model.is_stopped {
            // Heartbeats every few milliseconds would take long.
            let message = initiate(0x2B, HEARTBEAT, 0);
            assert_eq!(send(&mut board, message), model.handle(message), "{n}");
        }
        transfers[match model.transfer.as_ref().map(|transfer| &transfer.state) {
            None => 0,
            Some(State::Upload { .. }) => 1,
            Some(State::Download { .. }) => 2,
            Some(State::BlockUpload(_)) => 3,
            Some(State::BlockDownload(_)) => 4,
        }] += 1;
        board.take_actions();
    }
    let machine = board.node.application();
    assert_eq!(machine.memory, model.values[&(0x2300, 1)]);
    assert_eq!(machine.values.octets.as_bytes(), model.values[&(0x2200, 3)]);
    assert_eq!(machine.values.u64.to_le_bytes(), model.values[&(0x2100, 4)][..]);
    assert!(
        machine.ended > 100 && machine.aborted > 100,
        "{} and {}",
        machine.ended,
        machine.aborted
    );
    assert!(transfers.iter().all(|&times| times > count / 50), "{transfers:?}");
}
