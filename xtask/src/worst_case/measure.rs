//! What the image does on emulated boards: the times to compare the bounds with, and whether each step is one that the
//! analysis allows.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, HashSet},
    sync::{Arc, Mutex},
};

use emulator::{
    Time,
    board::{self, Board},
    can::{Adapter, Frame, Id},
    chip::{FLASH_BASE, Readings, Timing},
    engine::{Engine, Step, Watcher},
};
use lss_slave::BitRate;
use testkit::{
    frames,
    image::{image, part},
    image_rig::{ImageRig, SETTINGS_OFFSET, flash_with, on_the_wire, settings},
    random::Random,
    sdo, stack,
};

use super::{
    costs::ENTRY,
    instruction::{Flow, Mask, Memory},
    path::{Loop, is_copy},
    program::Program,
};

/// The bits of xPSR with the number of the exception.
const EXCEPTION: u32 = 0x1FF;

/// CAN_TI0R to CAN_TI2R of CAN1, whose bit 0 requests the transmission.
const TRANSMIT_REQUESTS: [u32; 3] = [0x4000_6580, 0x4000_6590, 0x4000_65A0];

/// What one kind of activation has taken at most.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Longest {
    pub cycles: u64,
    pub stack: u32,
}

/// What a task has had to do in an activation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Work {
    /// The function in the vector table.
    pub task: u32,
    /// The frames that it has taken from the FIFO.
    pub frames: u64,
    /// The actions of the node that were due.
    pub actions: u64,
}

/// The results of the sessions.
#[derive(Clone, Debug, Default)]
pub struct Measured {
    /// The longest activations, by their work.
    pub tasks: BTreeMap<Work, Longest>,
    /// The longest time from the interrupt to the transmit request of an LSS answer that need not wait.
    pub answer: u64,
    /// The longest critical sections of the task that stores, by the address of their first instruction and the actions
    /// of the node in them.
    pub sections: BTreeMap<(u32, u64), u64>,
    /// How often a loop has gone back at most, by its header.
    pub back: BTreeMap<u32, u64>,
    /// Loads that were executed, and those that read the flash.
    pub loads: HashSet<u32>,
    pub constant_loads: HashSet<u32>,
    /// Loads and stores that were executed, and those that reached a peripheral.
    pub accesses: HashSet<u32>,
    pub peripheral: HashSet<u32>,
    /// Steps that the graph of the image does not have.
    pub foreign: BTreeSet<(u32, u32)>,
    /// The most cycles of an instruction, those of a jump included.
    pub cycles: HashMap<u32, u64>,
    /// The calls that were made.
    pub calls: BTreeSet<u32>,
    /// The longest copy of each call that copies.
    pub copied: BTreeMap<u32, u64>,
    /// The deepest stack.
    pub stack: u32,
}

/// The functions and loops whose passes say what an activation has had to do.
#[derive(Clone, Copy)]
pub struct Marks {
    /// The header of the loop over the received frames.
    pub frames: u32,
    /// `Runner::act`, but for the calls with the answer to a frame.
    pub act: u32,
    /// The function with the loop over the actions.
    pub poll: u32,
    /// The function that takes frames out of the queue.
    pub fill: u32,
}

struct Section {
    at: u32,
    begin: u64,
    /// The actions of the activation before it.
    actions: u64,
}

struct Activation {
    exception: u32,
    task: u32,
    begin: u64,
    /// The cycles of activations that have interrupted this one.
    interrupted: u64,
    sp: u32,
    lowest: u32,
    frames: u64,
    actions: u64,
    /// The loops under way: how often each has gone back.
    loops: HashMap<usize, u64>,
    section: Option<Section>,
    /// Whether the node has done more than to answer.
    has_done_more: bool,
}

struct Observer {
    program: Arc<Program>,
    loops: Arc<Vec<Loop>>,
    /// The loops of the function that an instruction is in, by halfword.
    loops_at: Vec<Vec<usize>>,
    marks: Marks,
    measured: Arc<Mutex<Measured>>,
    active: Vec<Activation>,
    cycles: u64,
}

impl Observer {
    fn entry(&mut self, step: &Step, core: &dyn Engine, after: u32) {
        let task = self.program.vectors.get(after as usize).copied().unwrap_or(0);
        let sp = step.before.r[13];
        self.active.push(Activation {
            exception: after,
            task,
            // The core may have slept until now.
            begin: core.cycles() - ENTRY,
            interrupted: 0,
            sp,
            lowest: core.sp().min(sp),
            frames: 0,
            actions: 0,
            loops: HashMap::new(),
            section: None,
            has_done_more: false,
        });
    }

    fn end(&mut self, cycles: u64) {
        let Some(ended) = self.active.pop() else { return };
        let whole = cycles - ended.begin;
        let own = whole - ended.interrupted;
        let mut measured = self.measured.lock().expect("no panic before");
        let work = Work { task: ended.task, frames: ended.frames, actions: ended.actions };
        let longest = measured.tasks.entry(work).or_default();
        longest.cycles = longest.cycles.max(own);
        longest.stack = longest.stack.max(ended.sp - ended.lowest);
        drop(measured);
        if let Some(outer) = self.active.last_mut() {
            outer.interrupted += whole;
            if let Some(section) = &mut outer.section {
                section.begin += whole;
            }
        }
    }

    fn instruction(&mut self, step: &Step, core: &dyn Engine, cycles: u64) {
        let pc = step.before.r[15];
        let next = core.pc();
        let Some(instruction) = self.program.instructions.get(&pc) else { return };
        let used = cycles - self.cycles;
        let mut measured = self.measured.lock().expect("no panic before");
        let most = measured.cycles.entry(pc).or_insert(0);
        *most = used.max(*most);
        let end = instruction.end();
        let may_follow = match &instruction.flow {
            Flow::Next => next == end,
            Flow::Jump(target) => next == *target || instruction.is_conditional && next == end,
            Flow::Branch(target) => next == *target || next == end,
            Flow::Call(target) => next == *target || instruction.is_conditional && next == end,
            Flow::Table(targets) => targets.contains(&next),
            Flow::Return | Flow::Fault | Flow::Unknown(_) => true,
        };
        if !may_follow && next != pc {
            measured.foreign.insert((pc, next));
        }
        if matches!(instruction.memory, Memory::Other { .. }) {
            measured.accesses.insert(pc);
        }
        if let Memory::Other { is_load: true, .. } = instruction.memory {
            let (base, offset) = instruction.base;
            let register = |number: u32| step.before.r[number as usize & 0xF];
            let in_flash = |address: u32| (FLASH_BASE..FLASH_BASE + 0x10_0000).contains(&address);
            measured.loads.insert(pc);
            if in_flash(register(base)) || offset.is_some_and(|offset| in_flash(register(offset))) {
                measured.constant_loads.insert(pc);
            }
        }
        if step.transfers.iter().any(|transfer| transfer.access.address >= 0x4000_0000) {
            measured.peripheral.insert(pc);
        }
        let callee = match instruction.flow {
            Flow::Call(callee) if next == callee => Some(callee),
            _ => None,
        };
        measured.calls.extend(callee.map(|_| pc));
        if let Some(callee) = callee.filter(|callee| is_copy(self.program.name(*callee))) {
            let register = if self.program.name(callee).contains("memclr") { 1 } else { 2 };
            let length = measured.copied.entry(pc).or_insert(0);
            *length = (*length).max(u64::from(step.before.r[register]));
        }
        let has_requested = step.transfers.iter().any(|transfer| {
            let register = transfer.access.address;
            transfer.is_store && TRANSMIT_REQUESTS.contains(&register) && transfer.value & 1 == 1
        });
        if has_requested
            && let Some(active) = self.active.last()
            && active.frames == 1
            && !active.has_done_more
        {
            measured.answer = measured.answer.max(cycles - active.begin);
        }
        drop(measured);
        self.marks(pc, next, core, cycles);
    }

    fn marks(&mut self, pc: u32, next: u32, core: &dyn Engine, cycles: u64) {
        let Some(active) = self.active.last_mut() else { return };
        active.lowest = active.lowest.min(core.sp());
        active.has_done_more |= pc == self.marks.fill || pc == self.marks.poll;
        if pc == self.marks.frames {
            active.frames += 1;
        }
        let called = self.program.instructions.get(&pc).map(|instruction| &instruction.flow);
        if called == Some(&Flow::Call(self.marks.act)) && next == self.marks.act {
            active.actions += u64::from(self.program.owner(pc) == self.marks.poll);
        }
        let index = (pc.wrapping_sub(FLASH_BASE) / 2) as usize;
        let mut measured = self.measured.lock().expect("no panic before");
        for &number in self.loops_at.get(index).into_iter().flatten() {
            let found = &self.loops[number];
            if pc == found.header {
                let back = active.loops.entry(number).and_modify(|back| *back += 1).or_insert(0);
                let most = measured.back.entry(found.header).or_insert(0);
                *most = (*most).max(*back);
            } else if !found.nodes.contains(&pc) {
                active.loops.remove(&number);
            }
        }
        match self.program.masks.get(&pc) {
            Some(Mask::Raise | Mask::Disable) if active.section.is_none() => {
                active.section = Some(Section { at: pc, begin: cycles, actions: active.actions });
            }
            Some(Mask::Restore | Mask::Enable) => {
                if let Some(section) = active.section.take()
                    && self.program.name(active.task) == "USART1"
                {
                    let actions = active.actions - section.actions;
                    let longest = measured.sections.entry((section.at, actions)).or_insert(0);
                    *longest = (*longest).max(cycles - section.begin);
                }
            }
            _ => {}
        }
    }
}

impl Watcher for Observer {
    fn stepped(&mut self, step: &Step, core: &dyn Engine) {
        let cycles = core.cycles();
        if step.from_reset {
            self.active.clear();
            self.cycles = cycles;
            return;
        }
        let before = step.before.xpsr & EXCEPTION;
        let after = core.registers().xpsr & EXCEPTION;
        let is_return = self
            .program
            .instructions
            .get(&step.before.r[15])
            .is_some_and(|instruction| instruction.flow == Flow::Return);
        if before == after {
            self.instruction(step, core, cycles);
        } else if is_return && self.active.iter().rev().nth(1).map_or(0, |a| a.exception) == after {
            self.end(cycles);
        } else {
            // The next one may follow without a return between them.
            let is_known = self.active.last().is_some_and(|active| active.exception == before);
            if is_return && is_known {
                self.end(self.cycles);
            }
            self.entry(step, core, after);
        }
        self.cycles = cycles;
    }

    fn flash_changed(&mut self, _: usize, _: &[u8], _: &dyn Engine) {}

    fn ram_changed(&mut self, _: u32, _: &[u8], _: &dyn Engine) {}
}

/// A node in service on a board, with or without waits for the flash.
fn rig(observer: Observer, flash_waits: bool) -> ImageRig {
    let chip_readings = Readings { flash_waits, ..Readings::default() };
    let board = board::Settings { chip_readings, ..Default::default() };
    let mut board = Board::new(part(), image(), board);
    let stored = settings(0x40, BitRate::Kbit1000).with_heartbeat_ms(7);
    board.set_flash(SETTINGS_OFFSET, &flash_with(&[stored]));
    stack::paint(&mut board, image());
    let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
    rig.collect(Time::from_ms(20));
    // The rate is proven from here on.
    rig.lss("04 01");
    rig.network.board_mut(0).watch(Box::new(observer));
    rig
}

/// What happens around the board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Session {
    Service,
    /// With the waits of the flash.
    ServiceWithWaits,
    /// Errors, other bit rates, a lost master and resets.
    Disturbed,
}

/// Runs a session and returns what the board did.
pub fn run(
    program: &Arc<Program>,
    loops: Vec<Loop>,
    functions: &BTreeMap<u32, BTreeSet<u32>>,
    marks: Marks,
    session: Session,
) -> Measured {
    let last = program.instructions.keys().next_back().copied().unwrap_or(FLASH_BASE);
    let mut loops_at = vec![Vec::new(); ((last - FLASH_BASE) / 2 + 2) as usize];
    for (number, found) in loops.iter().enumerate() {
        for at in &functions[&found.function] {
            loops_at[((at - FLASH_BASE) / 2) as usize].push(number);
        }
    }
    let measured = Arc::new(Mutex::new(Measured::default()));
    let observer = Observer {
        program: Arc::clone(program),
        loops: Arc::new(loops),
        loops_at,
        marks,
        measured: Arc::clone(&measured),
        active: Vec::new(),
        cycles: 0,
    };
    let mut rig = rig(observer, session == Session::ServiceWithWaits);
    if session == Session::Disturbed {
        disturbed(&mut rig);
    } else {
        services(&mut rig);
        full_bus(&mut rig);
        stores(&mut rig);
    }
    let depth = stack::deepest(rig.network.board(0), image());
    drop(rig);
    let mut measured = measured.lock().expect("no panic before").clone();
    measured.stack = depth as u32;
    measured
}

/// Every service, one request after the other.
fn services(rig: &mut ImageRig) {
    for request in ["5A", "5B", "5C", "5D", "5E", "13 00 02", "13 00 05", "13 00 00", "11 00"] {
        rig.lss(request);
    }
    for node_id in ["11 41", "11 40"] {
        rig.lss(node_id);
        rig.lss("17");
    }
    rig.network.board(0).chip().flash_mut().set_timing(Timing::Worst);
    for text in ["04 00", "40", "46", "4C", "51", "04 01", "04 00"] {
        rig.lss(text);
    }
    let objects =
        ["00 10 00", "18 10 01", "08 10 00", "17 10 00", "01 10 00", "03 10 00", "99 99 00"];
    for object in objects {
        rig.transmit(on_the_wire(&sdo::request(0x40, &format!("40 {object}"))));
        rig.collect(Time::from_ms(1));
        rig.transmit(on_the_wire(&sdo::request(0x40, "60")));
        rig.collect(Time::from_ms(1));
    }
    for text in ["2B 17 10 00 08 00", "2B 17 10 00 07 00", "23 10 10 01 73 61 76 65"] {
        rig.transmit(on_the_wire(&sdo::request(0x40, text)));
        rig.collect(Time::from_ms(3));
    }
    for command in ["01 40", "02 40", "80 40", "82 40", "01 00", "80 00", "82 00"] {
        rig.nmt(command);
    }
    rig.collect(Time::from_ms(300));
}

/// Requests of all kinds without a gap, with frames for others between them.
fn full_bus(rig: &mut ImageRig) {
    let mut random = Random::from_seed(7);
    let other = rig.network.add_adapter(Adapter::new(1_000_000));
    for _ in 0..5 {
        for _ in 0..20 {
            let request = random.pick(&["04 01", "5A", "5B", "5E", "11 40", "17", "04 00"]);
            rig.queue(&frames::request(request));
            let object = random.pick(&["40 18 10 01", "40 00 10 00", "2B 17 10 00 07 00"]);
            rig.queue(&sdo::request(0x40, object));
            let cob_id = random.pick(&[0x000, 0x640, 0x7E5]);
            rig.network.send(rig.master, Frame::data(Id::Standard(cob_id), &[]));
            rig.network.send(other, Frame::data(Id::Standard(0x001), &[0; 8]));
        }
        rig.collect(Time::from_ms(20));
        rig.nmt(random.pick(&["01 00", "80 00", "82 00"]));
    }
    rig.collect(Time::from_ms(300));
}

/// Stores that follow each other at every phase of the fastest heartbeat, and stops of a node that stores for an SDO
/// client.
fn stores(rig: &mut ImageRig) {
    let flash = |rig: &ImageRig, timing| rig.network.board(0).chip().flash_mut().set_timing(timing);
    let sdo = |rig: &mut ImageRig, text| {
        rig.queue(&sdo::request(0x40, text));
    };
    rig.nmt("80 00");
    rig.lss("04 01");
    sdo(rig, "2B 17 10 00 01 00");
    flash(rig, Timing::Typical);
    for round in 0..175 {
        for request in [&format!("11 {:02X}", 0x40 + round % 2), "17", "17"] {
            rig.queue(&frames::request(request));
        }
        rig.collect(Time::from_us(2_006));
    }
    flash(rig, Timing::Worst);
    for _ in 0..20 {
        sdo(rig, "23 10 10 01 73 61 76 65");
        rig.collect(Time::from_us(300));
        rig.nmt("02 40");
        rig.collect(Time::from_us(2_007));
        rig.nmt("80 40");
    }
    rig.lss("04 00");
    rig.collect(Time::from_ms(60));
}

/// A full transmit queue: the answers to many stores, while the bus is full of more urgent frames.
fn full_queue(rig: &mut ImageRig) {
    rig.network.board(0).chip().flash_mut().set_timing(Timing::Worst);
    rig.lss("04 01");
    for node_id in 1..=60 {
        for request in [&format!("11 {node_id:02X}"), "17"] {
            rig.queue(&frames::request(request));
        }
    }
    rig.collect(Time::from_ms(22));
    let other = rig.network.add_adapter(Adapter::new(1_000_000));
    for _ in 0..700 {
        rig.network.send(other, Frame::data(Id::Standard(0x001), &[0; 8]));
    }
    rig.collect(Time::from_ms(150));
    expect_log(rig, "CAN: the transmit queue is full");
    for request in ["11 40", "17", "04 00"] {
        rig.lss(request);
    }
    rig.network.adapter_mut(other).close();
}

/// Stores that fail: a low supply, and a word that the flash does not take.
fn failed_stores(rig: &mut ImageRig) {
    rig.lss("04 01");
    rig.lss("11 41");
    rig.network.board_mut(0).set_supply(2_600);
    rig.lss("17");
    rig.network.board_mut(0).set_supply(3_300);
    rig.network.board(0).chip().flash_mut().fail_programs(1);
    rig.lss("17");
    expect_log(rig, "flash: not written, the supply is below");
    expect_log(rig, "the settings were not stored, the old ones stay: the flash reads back");
    for request in ["11 40", "17", "04 00"] {
        rig.lss(request);
    }
}

/// # Panics
/// If the board has not come to this: the session has lost its sense.
fn expect_log(rig: &ImageRig, text: &str) {
    assert!(rig.has_logged(text), "no line of the log begins with `{text}`");
}

/// What is not service: a full queue, failed stores, errors on the bus, changes of the bit rate, a node alone, resets.
fn disturbed(rig: &mut ImageRig) {
    full_queue(rig);
    failed_stores(rig);
    let disturber = rig.add_disturber();
    rig.disturb(disturber, Id::Standard(0x2AA), Time::from_us(700), Time::from_ms(60));
    rig.collect(Time::from_ms(50));
    for (index, rate) in [("02", BitRate::Kbit500), ("00", BitRate::Kbit1000)] {
        rig.lss("04 01");
        rig.lss(&format!("13 00 {index}"));
        rig.lss("11 41");
        rig.lss("17");
        rig.lss("15 02 00");
        rig.set_master_bit_rate(rate);
        rig.collect(Time::from_ms(20));
        rig.nmt("01 00");
    }
    // Without a delay, and nobody acknowledges what follows.
    rig.lss("04 01");
    rig.lss("15 00 00");
    rig.network.adapter_mut(rig.master).close();
    rig.collect(Time::from_ms(400));
    rig.network.adapter_mut(rig.master).open();
    rig.collect(Time::from_ms(100));
    for request in ["04 00", "04 01", "11 FF", "04 00"] {
        rig.lss(request);
    }
    rig.nmt("82 00");
    for request in ["4C", "51 00 00 00 00 80", "04 01", "11 42", "04 00"] {
        rig.lss(request);
    }
    rig.collect(Time::from_ms(50));
}
