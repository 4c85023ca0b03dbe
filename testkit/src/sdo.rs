//! An SDO client (CiA 301, 7.2.4) for the tests, written independently of the server. It checks each byte of the
//! answers.

use lss_slave::{Application, Frame};

use super::{
    frames::{Frames, bytes},
    node_rig::NodeRig,
};

/// An SDO request to the node `node_id`: `text` is its bytes, padded with 0 to eight.
pub fn request(node_id: u8, text: &str) -> Frame {
    let mut bytes = bytes(text);
    bytes.resize(8, 0);
    Frame::new(0x600 + u16::from(node_id), &bytes).expect("a frame")
}

impl<A: Application + Clone, const TPDOS: usize, const RPDOS: usize, const PRODUCERS: usize>
    NodeRig<A, TPDOS, RPDOS, PRODUCERS>
{
    /// Sends an SDO request to the node, whose node-ID must be 40h; returns the frames that it sends at once.
    pub fn sdo(&mut self, text: &str) -> Frames {
        self.receive(&request(0x40, text))
    }

    /// Reads an object.
    ///
    /// # Errors
    /// The abort code.
    pub fn upload(&mut self, index: u16, sub_index: u8) -> Result<Vec<u8>, u32> {
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
    pub fn number(&mut self, index: u16, sub_index: u8) -> u32 {
        let mut bytes = self.upload(index, sub_index).expect("the object can be read");
        assert!(bytes.len() <= 4, "a number");
        bytes.resize(4, 0);
        u32::from_le_bytes(bytes.try_into().unwrap())
    }

    /// Writes an object and indicates its size.
    ///
    /// # Errors
    /// The abort code.
    pub fn download(&mut self, index: u16, sub_index: u8, data: &[u8]) -> Result<(), u32> {
        let mut request = [0; 8];
        request[0] = 0x23 | (4 - data.len() as u8) << 2;
        request[4..][..data.len()].copy_from_slice(data);
        let answer = self.transfer(request, index, sub_index)?;
        assert_eq!((answer[0], &answer[4..]), (0x60, &[0; 4][..]));
        Ok(())
    }

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

    fn exchange(&mut self, request: [u8; 8]) -> [u8; 8] {
        let node_id = u16::from(self.node.node_id().expect("a node-ID").get());
        let request = Frame::new(0x600 + node_id, &request).expect("a frame");
        let answers = self.receive(&request);
        let [answer] = answers.0[..] else { panic!("one answer, not {answers:?}") };
        assert_eq!(answer.cob_id(), 0x580 + node_id);
        answer.data().try_into().expect("eight bytes")
    }
}
