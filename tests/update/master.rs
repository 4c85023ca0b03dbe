//! A master for a board that may fall silent at any time: a request that is not answered is no failure of the test.

use canopen_node::Frame;
use emulator::Time;

use super::rig::{NODE, Rig};

/// The time within which the old or the new program must answer after the power has returned.
const REVIVAL: Time = Time::from_s(10);

/// There was no answer.
#[derive(Debug)]
pub struct Silence;

impl Rig {
    /// The answer to a request of the SDO client.
    pub fn ask(&mut self, request: [u8; 8]) -> Result<[u8; 8], Silence> {
        self.0.queue(&Frame::new(0x600 + u16::from(NODE), &request).expect("eight bytes"));
        self.answer()
    }

    fn answer(&mut self) -> Result<[u8; 8], Silence> {
        let is_answer = |frame: &Frame| frame.cob_id() == 0x580 + u16::from(NODE);
        let (_, frame) = self.0.wait_for(self.1, is_answer).ok_or(Silence)?;
        Ok(*frame.eight_bytes().expect("eight bytes"))
    }

    /// Writes program control; true if that is confirmed.
    pub fn try_control(&mut self, value: u8) -> Result<bool, Silence> {
        Ok(self.ask([0x2F, 0x51, 0x1F, 1, value, 0, 0, 0])?[0] == 0x60)
    }

    /// Reads a number.
    pub fn try_number(&mut self, index: u16, sub_index: u8) -> Result<u32, Silence> {
        let [low, high] = index.to_le_bytes();
        let [.., a, b, c, d] = self.ask([0x40, low, high, sub_index, 0, 0, 0, 0])?;
        Ok(u32::from_le_bytes([a, b, c, d]))
    }

    /// Waits until the loader is no longer busy; returns the status.
    pub fn try_finish(&mut self) -> Result<u32, Silence> {
        loop {
            let status = self.try_number(0x1F57, 1)?;
            if status & 1 == 0 {
                return Ok(status);
            }
            self.0.network.run_for(Time::from_ms(100));
        }
    }

    /// Downloads a file in blocks; true if that is confirmed.
    pub fn try_download(&mut self, file: &[u8]) -> Result<bool, Silence> {
        let [a, b, c, d] = (file.len() as u32).to_le_bytes();
        let begun = self.ask([0xC2, 0x50, 0x1F, 1, a, b, c, d])?;
        if begun[0] & 0xE0 != 0xA0 {
            return Ok(false);
        }
        let mut size = begun[4];
        let mut segments = file.chunks(7).peekable();
        while segments.peek().is_some() {
            for number in 1..=size {
                let Some(segment) = segments.next() else { break };
                let last = if segments.peek().is_none() { 0x80 } else { 0 };
                let mut message = [number | last, 0, 0, 0, 0, 0, 0, 0];
                message[1..=segment.len()].copy_from_slice(segment);
                let frame = Frame::new(0x600 + u16::from(NODE), &message).expect("eight bytes");
                self.0.queue(&frame);
            }
            let answer = self.answer()?;
            if answer[0] != 0xA2 {
                return Ok(false);
            }
            size = answer[2];
        }
        let unused = (7 - file.len() % 7) as u8 % 7;
        Ok(self.ask([0xC1 | unused << 2, 0, 0, 0, 0, 0, 0, 0])?[0] == 0xA1)
    }

    /// The number of operations of the flash so far.
    pub fn operations(&self) -> u64 {
        self.0.network.board(0).chip().flash().operations()
    }

    /// Waits until a program, not the loader, answers.
    pub fn revive(&mut self) {
        let until = self.0.network.now() + REVIVAL;
        loop {
            // A request of before is forgotten.
            self.0.network.adapter_mut(self.0.master).close();
            self.0.network.adapter_mut(self.0.master).open();
            if matches!(self.try_number(0x1F51, 1), Ok(1)) {
                return;
            }
            assert!(self.0.network.now() < until, "no program answers");
            self.0.network.run_for(Time::from_ms(50));
        }
    }
}
