//! A program of `tests/peers/` on the emulated chip: takes frames in its mailbox and counts the cost of each.

use std::{
    path::Path,
    sync::{Arc, Mutex},
};

use anyhow::{bail, ensure};
use canopen_node::Frame;
use emulator::{
    Time,
    can::Clock,
    chip::{Chip, FLASH_BASE, RAM_BASE},
    engine::{Engine, rsemu::Rsemu},
    image::Image,
};
use testkit::image::PART;

/// The pattern with which the harness fills the free stack.
const UNTOUCHED: [u8; 4] = 0xC5C5_C5C5_u32.to_le_bytes();
/// More instructions than any measured operation takes.
const PATIENCE: u64 = 1_000_000;

/// The bytes of a mailbox (`Mailbox` in `tests/peers/src/lib.rs`): identifier and request, length from 4 on, data from 8 on.
type Mailbox = [u8; 16];

/// The number of executed instructions.
pub type Cost = u64;

/// The result of a received frame.
#[derive(Clone, Copy, Debug)]
pub struct Reception {
    /// The cost from the first instruction of `receive` to its return.
    pub cost: Cost,
    /// The first transmitted frame, and the cost until its transmission was requested.
    pub answer: Option<(Frame, Cost)>,
}

/// A program that waits for frames.
pub struct Machine {
    engine: Rsemu,
    image: Image,
    /// The transmit mailbox.
    transmitted: u32,
}

impl Machine {
    /// Loads the program and runs its preparation.
    pub fn start(elf: &Path) -> anyhow::Result<Self> {
        let image = Image::load(elf)?;
        let crystal = Clock { hz: 8_000_000, ppm: 0 };
        let mut chip = Chip::new(PART, crystal, [0; 12]);
        for (address, bytes) in image.segments().filter(|(address, _)| *address < RAM_BASE) {
            chip.flash_mut().load(address - FLASH_BASE, bytes);
        }
        let mut engine = Rsemu::new(Arc::new(Mutex::new(chip)));
        for (address, bytes) in image.segments().filter(|(address, _)| *address >= RAM_BASE) {
            ensure!(engine.write_memory(address, bytes), "a segment does not fit into RAM");
        }
        engine.reset(Time::ZERO, Time::ZERO);
        let transmitted = address(&image, "TRANSMITTED");
        let mut machine = Self { engine, image, transmitted };
        machine.run_to("idle", |_, _| {})?;
        Ok(machine)
    }

    /// Passes a frame to the program.
    pub fn receive(&mut self, frame: &Frame) -> anyhow::Result<Reception> {
        let mut mailbox: Mailbox = [0; 16];
        mailbox[..4].copy_from_slice(&(u32::from(frame.cob_id()) << 21).to_le_bytes());
        mailbox[4] = frame.data().len() as u8;
        mailbox[8..][..frame.data().len()].copy_from_slice(frame.data());
        self.write(address(&self.image, "RECEIVED"), &mailbox);
        self.write(self.transmitted, &[0; 4]);
        self.write(address(&self.image, "WAITING"), &[1, 0, 0, 0]);

        self.run_to("receive", |_, _| {})?;
        let mut answer = None;
        let cost = self.run_to("returned", |machine, cost| {
            answer = answer.or_else(|| machine.transmitted().map(|frame| (frame, cost)));
        })?;
        self.run_to("idle", |_, _| {})?;
        Ok(Reception { cost, answer })
    }

    /// The largest stack use of `receive` and its callees in bytes.
    pub fn stack_used(&self) -> u32 {
        let [stack_bottom, stack_top] =
            ["stack_bottom", "stack_top"].map(|name| address(&self.image, name));
        let mut stack = vec![0; (stack_top - stack_bottom) as usize];
        assert!(self.engine.read_memory(stack_bottom, &mut stack), "the stack is in RAM");
        let untouched = stack.chunks(4).take_while(|word| *word == UNTOUCHED).count();
        (stack.len() - 4 * untouched) as u32
    }

    /// Executes instructions until the next one is at a symbol, and passes each step to `watch`.
    fn run_to(&mut self, symbol: &str, mut watch: impl FnMut(&Self, Cost)) -> anyhow::Result<Cost> {
        const STEP: Time = Time::from_ps(1);
        let address = address(&self.image, symbol);
        let mut cost = 0;
        while self.engine.pc() != address {
            self.engine.run(self.engine.now() + STEP);
            cost += 1;
            if cost > PATIENCE || self.engine.lockup().is_some() {
                bail!("the program hangs at {:#010x}", self.engine.pc());
            }
            watch(self, cost);
        }
        Ok(cost)
    }

    fn transmitted(&self) -> Option<Frame> {
        const REQUESTED: u32 = 1;
        let mut mailbox: Mailbox = [0; 16];
        assert!(self.engine.read_memory(self.transmitted, &mut mailbox), "a mailbox is in RAM");
        let [i0, i1, i2, i3, length, ..] = mailbox;
        let identifier = u32::from_le_bytes([i0, i1, i2, i3]);
        if identifier & REQUESTED == 0 {
            return None;
        }
        Frame::new((identifier >> 21) as u16, mailbox[8..].get(..length.into())?)
    }

    fn write(&mut self, address: u32, bytes: &[u8]) {
        let written = self.engine.write_memory(address, bytes);
        assert!(written, "the words of the harness are in RAM");
    }
}

/// The address of a symbol of the harness.
fn address(image: &Image, name: &str) -> u32 {
    image.symbol(name).unwrap_or_else(|| panic!("no {name} in the harness")) & !1
}
