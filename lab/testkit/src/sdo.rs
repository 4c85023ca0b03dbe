//! An SDO client (CiA 301, 7.2.4) for the tests, of a node in the process and of the release image. It is written
//! independently of the server, and checks each byte of the answers.

use canopen_node::{Application, Frame};

use super::{
    frames::{Frames, bytes},
    node_rig::NodeRig,
    sdo_messages::{crc, download, expedited, initiate},
};

/// An SDO request to the node `node_id`: `text` is its bytes, padded with 0 to eight.
pub fn request(node_id: u8, text: &str) -> Frame {
    let mut bytes = bytes(text);
    bytes.resize(8, 0);
    Frame::new(0x600 + u16::from(node_id), &bytes).expect("a frame")
}

impl<A: Application + Clone> NodeRig<A> {
    /// Sends an SDO request to the node, whose node-ID must be 40h; returns the frames that it sends at once.
    pub fn sdo(&mut self, text: &str) -> Frames {
        self.receive(&request(0x40, text))
    }
}

impl<A: Application + Clone> Client for NodeRig<A> {
    fn say(&mut self, messages: &[[u8; 8]], is_last: impl Fn(&[u8; 8]) -> bool) -> Vec<[u8; 8]> {
        let node_id = self.node.node_id().expect("a node-ID").get();
        let mut answers = Vec::new();
        for message in messages {
            let sent = self.receive(&of_client(node_id, message));
            answers
                .extend(sent.0.iter().map(|frame| of_server(node_id, frame).expect("an answer")));
        }
        let ends = answers.iter().position(is_last);
        assert_eq!(ends.map(|at| at + 1), Some(answers.len()), "{answers:02X?}");
        answers
    }

    fn confirm(&mut self, message: [u8; 8]) {
        let node_id = self.node.node_id().expect("a node-ID").get();
        let answers = self.receive(&of_client(node_id, &message));
        assert!(answers.0.is_empty(), "{answers:?} to a confirmation");
    }
}

/// A message of the client to a node.
pub(crate) fn of_client(node_id: u8, message: &[u8; 8]) -> Frame {
    Frame::new(0x600 + u16::from(node_id), message).expect("a frame")
}

/// The message in a frame of the server of a node.
pub(crate) fn of_server(node_id: u8, frame: &Frame) -> Option<[u8; 8]> {
    let is_it = frame.cob_id() == 0x580 + u16::from(node_id);
    is_it.then(|| frame.data().try_into().expect("eight bytes"))
}

/// A client of the SDO server of one node. The errors of its transfers are abort codes.
pub trait Client {
    /// Sends messages; returns the answers, to the first one for which `is_last` is true.
    ///
    /// # Panics
    /// If this answer does not come.
    fn say(&mut self, messages: &[[u8; 8]], is_last: impl Fn(&[u8; 8]) -> bool) -> Vec<[u8; 8]>;

    /// Sends a message that is not answered.
    fn confirm(&mut self, message: [u8; 8]);

    /// Reads an object.
    fn upload(&mut self, index: u16, sub_index: u8) -> Result<Vec<u8>, u32> {
        let answer = self.transfer([0x40, 0, 0, 0, 0, 0, 0, 0], index, sub_index)?;
        let size = u32::from_le_bytes([answer[4], answer[5], answer[6], answer[7]]);
        match answer[0] {
            0x43 | 0x47 | 0x4B | 0x4F => {
                let (data, unused) = answer[4..].split_at(4 - usize::from(answer[0] >> 2 & 3));
                assert!(unused.iter().all(|&byte| byte == 0), "unused bytes are 0");
                Ok(data.to_vec())
            }
            0x41 => {
                let data = self.upload_segments();
                assert_eq!(data.len(), size as usize, "the size that was announced");
                Ok(data)
            }
            command => panic!("{command:02X} does not answer an upload"),
        }
    }

    /// Reads a number of up to four bytes.
    fn number(&mut self, index: u16, sub_index: u8) -> u32 {
        let mut bytes = self.upload(index, sub_index).expect("the object can be read");
        assert!(bytes.len() <= 4, "a number");
        bytes.resize(4, 0);
        u32::from_le_bytes(bytes.try_into().unwrap())
    }

    /// Writes an object and indicates its size: up to four bytes expedited, more in segments.
    fn download(&mut self, index: u16, sub_index: u8, data: &[u8]) -> Result<(), u32> {
        if !(1..=4).contains(&data.len()) {
            return self.download_segments(index, sub_index, data, Some(data.len() as u32));
        }
        let answer = self.transfer(expedited((index, sub_index), data), index, sub_index)?;
        assert_eq!((answer[0], &answer[4..]), (0x60, &[0; 4][..]));
        Ok(())
    }

    /// Writes an object in segments, and announces this size.
    fn download_segments(
        &mut self,
        index: u16,
        sub_index: u8,
        data: &[u8],
        size: Option<u32>,
    ) -> Result<(), u32> {
        let address = (index, sub_index);
        let command = if size.is_some() { 0x21 } else { 0x20 };
        let initiate = initiate(command, address, size.unwrap_or(0));
        let answer = self.transfer(initiate, index, sub_index)?;
        assert_eq!((answer[0], &answer[4..]), (0x60, &[0; 4][..]));
        let segments = download(address, data).into_iter().skip(1);
        for (toggle, segment) in [0x00, 0x10].into_iter().cycle().zip(segments) {
            let answer = self.exchange(segment);
            if answer[0] == 0x80 {
                return Err(abort_code(&answer, index, sub_index));
            }
            assert_eq!(answer, [0x20 | toggle, 0, 0, 0, 0, 0, 0, 0]);
        }
        Ok(())
    }

    /// Reads an object by block transfer with blocks of this size and a check of the CRC.
    fn block_upload(&mut self, index: u16, sub_index: u8, block_size: u8) -> Result<Vec<u8>, u32> {
        let request = [0xA4, 0, 0, 0, block_size, 0, 0, 0];
        let answer = self.transfer(request, index, sub_index)?;
        assert_eq!(answer[0], 0xC6, "the server checks by CRC and indicates the size");
        let size = u32::from_le_bytes([answer[4], answer[5], answer[6], answer[7]]) as usize;
        let mut data = Vec::new();
        let mut message = [0xA3, 0, 0, 0, 0, 0, 0, 0];
        let mut is_end = false;
        while !is_end {
            let is_last = |segment: &[u8; 8]| segment[0] & 0x80 != 0 || segment[0] == block_size;
            let segments = self.say(&[message], is_last);
            for (number, segment) in (1..).zip(&segments) {
                assert_eq!(segment[0] & 0x7F, number, "the sequence number");
                is_end = segment[0] & 0x80 != 0;
                data.extend(&segment[1..]);
            }
            message = [0xA2, segments.len() as u8, block_size, 0, 0, 0, 0, 0];
        }
        let [command, c0, c1, rest @ ..] = self.exchange(message);
        assert_eq!((command & 0xE3, rest), (0xC1, [0; 5]));
        let unused = usize::from(command >> 2 & 7);
        assert!(data[data.len() - unused..].iter().all(|&byte| byte == 0), "unused bytes are 0");
        data.truncate(data.len() - unused);
        assert_eq!(data.len(), size, "the size that was indicated");
        assert_eq!(u16::from_le_bytes([c0, c1]), crc(&data), "the CRC");
        self.confirm([0xA1, 0, 0, 0, 0, 0, 0, 0]);
        Ok(data)
    }

    /// Writes an object by block transfer with a CRC, and indicates its size.
    fn block_download(&mut self, index: u16, sub_index: u8, data: &[u8]) -> Result<(), u32> {
        let [s0, s1, s2, s3] = (data.len() as u32).to_le_bytes();
        let answer = self.transfer([0xC6, 0, 0, 0, s0, s1, s2, s3], index, sub_index)?;
        assert_eq!(answer[0], 0xA4, "the server checks by CRC");
        let mut block_size = answer[4];
        let mut rest = data;
        let (mut unused, mut is_end) = (0, false);
        while !is_end {
            assert!((1..=127).contains(&block_size), "block size {block_size}");
            let mut block = Vec::new();
            while !is_end && block.len() < usize::from(block_size) {
                let (segment, others) = rest.split_at(rest.len().min(7));
                (rest, unused, is_end) = (others, 7 - segment.len() as u8, others.is_empty());
                let mut message = [0; 8];
                message[0] = (block.len() as u8 + 1) | if is_end { 0x80 } else { 0 };
                message[1..][..segment.len()].copy_from_slice(segment);
                block.push(message);
            }
            let [answer] = self.say(&block, |_| true)[..] else { panic!("one answer") };
            if answer[0] == 0x80 {
                return Err(abort_code(&answer, index, sub_index));
            }
            assert_eq!(answer[..2], [0xA2, block.len() as u8], "all segments are confirmed");
            assert_eq!(answer[3..], [0; 5]);
            block_size = answer[2];
        }
        let [c0, c1] = crc(data).to_le_bytes();
        let answer = self.exchange([0xC1 | unused << 2, c0, c1, 0, 0, 0, 0, 0]);
        match answer[0] {
            0x80 => Err(abort_code(&answer, index, sub_index)),
            _ => {
                assert_eq!(answer, [0xA1, 0, 0, 0, 0, 0, 0, 0]);
                Ok(())
            }
        }
    }

    /// Stores the parameters of this sub-index of 1010h; 1: all.
    fn save(&mut self, sub_index: u8) -> Result<(), u32> {
        self.download(0x1010, sub_index, b"save")
    }

    /// Restores the default parameters of this sub-index of 1011h; 1: all.
    fn load(&mut self, sub_index: u8) -> Result<(), u32> {
        self.download(0x1011, sub_index, b"load")
    }

    /// The data of an upload in segments that has begun.
    fn upload_segments(&mut self) -> Vec<u8> {
        let mut data = Vec::new();
        for toggle in [0x00, 0x10].into_iter().cycle() {
            let answer = self.exchange([0x60 | toggle, 0, 0, 0, 0, 0, 0, 0]);
            assert_eq!(answer[0] & 0xF0, toggle, "a segment with the toggle bit of its request");
            let (segment, unused) = answer[1..].split_at(7 - usize::from(answer[0] >> 1 & 7));
            assert!(unused.iter().all(|&byte| byte == 0), "unused bytes are 0");
            data.extend(segment);
            if answer[0] & 1 == 1 {
                return data;
            }
            assert!(unused.is_empty(), "only the last segment is shorter");
        }
        unreachable!()
    }

    /// The answer to a request; checks that it names the same object.
    fn transfer(
        &mut self,
        mut request: [u8; 8],
        index: u16,
        sub_index: u8,
    ) -> Result<[u8; 8], u32> {
        let [i0, i1] = index.to_le_bytes();
        request[1..4].copy_from_slice(&[i0, i1, sub_index]);
        let answer = self.exchange(request);
        assert_eq!(answer[1..4], request[1..4], "the object that was asked for");
        match answer {
            [0x80, _, _, _, code @ ..] => Err(u32::from_le_bytes(code)),
            _ => Ok(answer),
        }
    }

    /// The answer to a request.
    fn exchange(&mut self, request: [u8; 8]) -> [u8; 8] {
        let answers = self.say(&[request], |_| true);
        let [answer] = answers[..] else { panic!("one answer, not {answers:02X?}") };
        answer
    }
}

/// The code of an abort, which must name this object.
fn abort_code(answer: &[u8; 8], index: u16, sub_index: u8) -> u32 {
    let [i0, i1] = index.to_le_bytes();
    let [0x80, a0, a1, a2, code @ ..] = *answer else { panic!("an abort, not {answer:02X?}") };
    assert_eq!([a0, a1, a2], [i0, i1, sub_index], "the object of the transfer");
    u32::from_le_bytes(code)
}
