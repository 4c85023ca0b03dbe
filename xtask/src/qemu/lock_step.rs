//! The same session with both cores side by side: all registers, instruction by instruction.
//!
//! Time and peripherals are those of the emulator. What its core loads from them QEMU's gets too, and each interrupt
//! reaches QEMU's core before the same instruction; see `qemu/src/mirror.rs` for how. So nothing but the cores can differ.

mod difference;
mod pair;

use std::{
    collections::BTreeMap,
    fmt,
    process::Command,
    sync::{Arc, Mutex, MutexGuard},
    time::Instant,
};

use anyhow::Context;
use emulator::{
    can::Adapter,
    engine::{Engine, Step, Watcher},
    image::Image,
    network::Network,
};

use super::{BIT_RATE, INTERVAL, PART, QEMU, START, gdb::Gdb, session};
use crate::{boards, explain::explain};
use pair::Pair;

/// A sign of life after so many instructions.
const PROGRESS: u64 = 25_000;

/// How much to compare, and whether to spoil it.
#[derive(Clone, Copy)]
pub struct Limits {
    /// Ends after so many instructions.
    pub instructions: u64,
    /// Compares once in so many instructions, and wherever the core meets what is outside of it.
    pub stride: usize,
    /// Inverts the lowest bits of QEMU's r0..r12 before this instruction.
    pub corrupt: Option<u64>,
}

/// Runs the session and prints what was compared. Fails at the first difference.
pub fn run(qemu: &mut Command, image: &Image, limits: Limits) -> anyhow::Result<()> {
    let begin = Instant::now();
    let gdb = Gdb::start(qemu).context(format!(
        "cannot run {QEMU} in lock-step. The plugin needs QEMU 7.2 to 10.0 with plugins and its \
         symbols exported, as Debian builds it"
    ))?;
    let follower = Follower::new(Pair::new(gdb, image.clone(), limits));
    let mut network = Network::new();
    let board = network.add_board(boards::board(PART, image, 0));
    network.board_mut(board).watch(Box::new(follower.clone()));
    let adapter = network.add_adapter(Adapter::new(BIT_RATE));
    println!("{:>12} {:>11}", "instructions", "ms");
    println!("{:>12} {:>11} the board starts, with erased settings", 0, network.now());
    network.run_until(START);
    for frame in session() {
        let state = follower.lock();
        if state.has_ended() {
            break;
        }
        let instructions = state.pair.tally().instructions;
        drop(state);
        println!("{instructions:>12} {:>11} > {frame} {}", network.now(), explain(&frame));
        network.send(adapter, frame);
        network.run_for(INTERVAL);
    }
    let mut state = follower.lock();
    if let Some(failure) = state.failure.take() {
        return Err(failure);
    }
    let tally = state.pair.tally();
    let all = if tally.instructions < limits.instructions { "the whole session, " } else { "" };
    println!("Compared: {all}{tally}");
    println!("No difference. {:.0} s", begin.elapsed().as_secs_f64());
    Ok(())
}

/// The emulator's core tells it what it does.
#[derive(Clone)]
struct Follower(Arc<Mutex<State>>);

struct State {
    pair: Pair,
    failure: Option<anyhow::Error>,
    /// When the next sign of life is due.
    progress: u64,
}

impl State {
    fn has_ended(&self) -> bool {
        self.failure.is_some() || self.pair.is_complete()
    }
}

impl Follower {
    fn new(pair: Pair) -> Self {
        Self(Arc::new(Mutex::new(State { pair, failure: None, progress: PROGRESS })))
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().expect("a panic has ended the run")
    }

    fn attempt(&self, what: impl FnOnce(&mut Pair) -> anyhow::Result<()>) {
        let mut state = self.lock();
        if !state.has_ended() {
            state.failure = what(&mut state.pair).err();
        }
    }
}

impl Watcher for Follower {
    fn stepped(&mut self, step: &Step, core: &dyn Engine) {
        self.attempt(|pair| pair.follow(step, core));
        let mut state = self.lock();
        let instructions = state.pair.tally().instructions;
        if instructions >= state.progress {
            state.progress += PROGRESS;
            println!("{instructions:>12} {:>11}", core.now());
        }
    }

    fn flash_changed(&mut self, offset: usize, bytes: &[u8], core: &dyn Engine) {
        self.attempt(|pair| pair.change_flash(offset, bytes, core));
    }

    fn ram_changed(&mut self, address: u32, bytes: &[u8], core: &dyn Engine) {
        self.attempt(|pair| pair.change_ram(address, bytes, core));
    }
}

/// What was compared.
#[derive(Default)]
struct Tally {
    instructions: u64,
    /// Times that all registers were compared.
    comparisons: u64,
    /// By the name of the handler.
    exceptions: BTreeMap<String, u64>,
    tail_chained: u64,
    /// Entered out of a handler.
    nested: u64,
    /// Entered within an IT block.
    in_it_block: u64,
    resets: u64,
    sleeps: u64,
    /// Loads of the ICSR that differed in VECTACTIVE, which rsemu lacks.
    vectactive: u64,
    loads: u64,
    stores: u64,
    checks: u64,
}

impl fmt::Display for Tally {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} instructions", self.instructions)?;
        writeln!(f, "{:>9} times r0..r15 and xPSR", self.comparisons)?;
        let exceptions: u64 = self.exceptions.values().sum();
        write!(f, "{exceptions:>9} exceptions:")?;
        for (handler, count) in &self.exceptions {
            write!(f, " {handler} {count}")?;
        }
        writeln!(f)?;
        writeln!(
            f,
            "{:>9} {} tail-chained, {} out of a handler, {} within an IT block",
            "of these", self.tail_chained, self.nested, self.in_it_block
        )?;
        writeln!(f, "{:>9} resets, the power-on among them", self.resets)?;
        writeln!(f, "{:>9} times asleep", self.sleeps)?;
        writeln!(
            f,
            "{:>9} times without VECTACTIVE in the ICSR, which rsemu lacks",
            self.vectactive
        )?;
        writeln!(f, "{:>9} loads from peripherals: address and width", self.loads)?;
        writeln!(f, "{:>9} stores to them and to flash: value too", self.stores)?;
        write!(f, "{:>9} times all RAM and the floating-point registers", self.checks)
    }
}
