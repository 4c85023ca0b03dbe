//! The times of the tasks of a node in service, from which the response times follow.

use std::collections::{BTreeMap, BTreeSet};

use super::{
    instruction::{Flow, Mask},
    measure::Work,
    path::{Search, Waits},
    program::{Program, is_named},
    stated::{Stated, Unit},
};

/// Cycles of an exception entry, and of a return with its jump (ARM DDI 0439, 3.9).
pub const ENTRY: u64 = 12;
pub const RETURN: u64 = 15;
/// The loop over the received frames, and the loop over the node's actions.
pub const FRAMES: &str = "while let Some(received)";
pub const ACTIONS: &str = "while let Some(action)";

/// The most actions of the node in a critical section of the task that stores: the answer to the store, the next store
/// and a heartbeat.
pub const STORE_ACTIONS: u64 = 3;
/// The most actions in an activation that receives no frame: a heartbeat.
pub const OWN_ACTIONS: u64 = 1;

/// The upper bounds in cycles, with one set of waits.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Costs {
    /// The first frame of an activation of the task that receives, to its end, with an answer of LSS.
    pub frame: u64,
    /// Each further frame.
    pub more_frames: u64,
    /// The same without an answer of LSS: for SDO, NMT or none.
    pub silent_frame: u64,
    /// An action of the node: an SDO answer, a heartbeat, the next store.
    pub action: u64,
    /// The tasks without an action.
    pub transmitted: u64,
    pub status: u64,
    pub due: u64,
    /// From the interrupt to the release of the first frame in the FIFO.
    pub release: u64,
    /// From the interrupt to the transmit request of an LSS answer.
    pub answer: u64,
    /// The longest critical section of the task that stores, without an action.
    pub section: u64,
    /// The longest time for which it disables the interrupts for a log line.
    pub log: u64,
    /// A change of the bit rate.
    pub start: u64,
    /// A frame of the node in every state, such as with a full queue.
    pub transmit: u64,
}

/// A search in service.
pub fn search<'a>(program: &'a Program, stated: &'a Stated, waits: Waits) -> Search<'a> {
    let mut search = Search::new(program, stated, waits);
    search.is_service = true;
    let never = || stated.iter().filter(|bound| bound.unit == Unit::Never);
    search.excluded = program
        .names
        .iter()
        .filter(|(address, name)| {
            let file = program.frames.get(address).and_then(|frames| frames.last());
            never().any(|bound| {
                bound.function.as_ref().is_some_and(|function| is_named(name, function))
                    && file.is_some_and(|frame| frame.file == bound.file)
            })
        })
        .map(|(address, _)| *address)
        .collect();
    search.rounds_of = BTreeMap::from([(FRAMES, 0), (ACTIONS, 0)]);
    search
}

impl Costs {
    pub fn new(program: &Program, stated: &Stated, waits: Waits) -> anyhow::Result<Self> {
        let of = |name: &str| program.function(name);
        let entry = ENTRY + waits.other_line * 2;
        let task = |search: &mut Search, name: &str| -> anyhow::Result<u64> {
            Ok(entry + search.function(of(name)?)? + RETURN)
        };
        let search = || search(program, stated, waits);
        let with = |text, rounds| {
            let mut search = search();
            search.rounds_of.insert(text, rounds);
            search
        };
        let (receive, act) = (of("CAN1_RX0")?, of("Runner::act")?);
        let poll = of("Runner::act_until_nothing_is_due")?;
        let frame = task(&mut search(), "CAN1_RX0")?;
        let mut silent = search();
        silent.closed.insert((receive, act));
        let mut answer = search();
        answer.closed.insert((receive, poll));
        let chain = [receive, act, of("Controller::transmit")?, of("can::put_in_mailbox")?];
        let mut sum = entry;
        for pair in chain.windows(2) {
            sum += answer.until(pair[0], &calls(program, pair[0], pair[1])?)?;
            // The jump to it.
            sum += 3 + waits.other_line + waits.next_line;
        }
        sum += answer.function(chain[3])?;
        let release = releases(program, receive)?;
        let mut any = Search::new(program, stated, waits);
        Ok(Self {
            frame,
            more_frames: task(&mut with(FRAMES, 1), "CAN1_RX0")? - frame,
            silent_frame: task(&mut silent, "CAN1_RX0")?,
            action: with(ACTIONS, 1).function(poll)? - search().function(poll)?,
            transmitted: task(&mut search(), "CAN1_TX")?,
            status: task(&mut search(), "CAN1_SCE")?,
            due: task(&mut search(), "TIM2")?,
            release: entry + search().until(receive, &release)? + waits.peripheral,
            answer: sum,
            section: section(&mut search(), of("USART1")?)?,
            log: log(&mut search(), of("USART1")?)?,
            start: any.function(of("Controller::start")?)?,
            transmit: any.function(of("Controller::transmit")?)?,
        })
    }

    /// A further frame of an activation, without an answer of LSS.
    pub const fn more_silent_frames(&self) -> u64 {
        self.more_frames - (self.frame - self.silent_frame)
    }

    /// The bound for an activation with this work.
    pub fn of(&self, program: &Program, work: Work) -> Option<u64> {
        let own = match program.name(work.task) {
            "CAN1_RX0" if work.frames > 0 => self.frame + (work.frames - 1) * self.more_frames,
            "CAN1_RX0" => self.frame,
            "CAN1_TX" => self.transmitted,
            "CAN1_SCE" => self.status,
            "TIM2" => self.due,
            _ => return None,
        };
        Some(own + work.actions * self.action)
    }
}

/// The calls of one function by another.
fn calls(program: &Program, caller: u32, callee: u32) -> anyhow::Result<BTreeSet<u32>> {
    let graph = program.graph(caller)?;
    let is_call = |at: &u32| program.callee(&program.instructions[at], caller) == Some(callee);
    Ok(graph.into_keys().filter(is_call).collect())
}

/// The instructions that release a frame of the FIFO: the first of those that wait for it.
fn releases(program: &Program, receive: u32) -> anyhow::Result<BTreeSet<u32>> {
    let is_wait = |at: &u32| {
        program.frames[at]
            .iter()
            .any(|frame| is_named(&frame.function, "Controller::await_release"))
    };
    Ok(program.graph(receive)?.into_keys().filter(is_wait).collect())
}

/// The longest path from a rise of BASEPRI to its end, with the two instructions.
fn section(search: &mut Search, task: u32) -> anyhow::Result<u64> {
    let graph = search.graph(task)?;
    let of = |mask: Mask| -> BTreeSet<u32> {
        let has = |at: &&u32| search.program.masks.get(at) == Some(&mask);
        graph.keys().filter(has).copied().collect()
    };
    let (begins, ends) = (of(Mask::Raise), of(Mask::Restore));
    let mut longest = 0;
    for begin in begins {
        longest = longest.max(search.between(task, &graph, begin, &ends)? + 2 * RETURN);
    }
    Ok(longest)
}

/// The longest path from the function that begins a log line to the end of the one that ends it.
fn log(search: &mut Search, task: u32) -> anyhow::Result<u64> {
    let program = search.program;
    let ends = program.function("_defmt_release")?;
    let begins: BTreeSet<u32> = ["defmt::export::acquire_and_header", "_defmt_acquire"]
        .map(|name| program.function(name))
        .into_iter()
        .collect::<Result<_, _>>()?;
    let mut longest = 0;
    for function in program.reachable(task)? {
        if search.excluded.contains(&function) {
            continue;
        }
        let graph = search.graph(function)?;
        let of = |wanted: &dyn Fn(u32) -> bool| -> BTreeSet<u32> {
            let is_wanted =
                |at: &&u32| program.callee(&program.instructions[at], function).is_some_and(wanted);
            graph.keys().filter(is_wanted).copied().collect()
        };
        let last = of(&|callee| callee == ends);
        for begin in of(&|callee| begins.contains(&callee)) {
            let is_call = |at: u32| matches!(program.instructions[&at].flow, Flow::Call(_));
            if !last.is_empty() && is_call(begin) {
                let released = search.function(ends)?;
                // A function without an own end has its caller's.
                if let Ok(cycles) = search.between(function, &graph, begin, &last) {
                    longest = longest.max(cycles + released + RETURN);
                }
            }
        }
    }
    Ok(longest)
}
