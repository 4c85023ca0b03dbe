//! `cargo xtask worst-case`: upper bounds of times and of the stack, from the object code of the release image.

mod costs;
mod instruction;
mod measure;
mod page;
mod path;
mod program;
mod response;
mod stack;
mod stated;

use std::{
    collections::{BTreeMap, BTreeSet},
    env, fs,
    sync::Arc,
    thread,
};

use anyhow::{Context, bail, ensure};
use emulator::chip::Part;

use crate::workspace;
use costs::{Costs, FRAMES, OWN_ACTIONS, RETURN, STORE_ACTIONS};
use instruction::{Flow, Mask, REFILL};
use measure::{Marks, Measured, Session, Work};
use path::{Loop, Search, Waits, is_copy};
use program::Program;
use stack::Depths;
use stated::Stated;

const PAGE: &str = "docs/worst-case.md";
/// The tasks, by the names of their interrupts, with their priorities: `src/main.rs`.
const TASKS: [(&str, u8); 5] =
    [("CAN1_TX", 3), ("CAN1_RX0", 3), ("CAN1_SCE", 3), ("TIM2", 3), ("USART1", 1)];
/// The exceptions above all tasks, after which the chip is reset.
const FAULTS: [&str; 2] = ["NonMaskableInt", "HardFault"];
/// The registers that an exception stacks, and a word for its alignment. The image has no floating-point instruction.
const EXCEPTION_FRAME: u32 = 32 + 4;
/// A step that takes longer contains a stall while the flash programs a word, 16 us at least.
const STALL: u64 = 1_000;

/// Compute upper bounds of the times and the stack of the release image
///
/// Follows the object code for the STM32F405: the longest path with the bounds that the sources state beside their loops
/// (`// Bound: 8 rounds: reason.`), with and without the waits of the flash. Runs the image on an emulated board and
/// compares: a step that the analysis does not know, a loop with more rounds or an activation that takes longer makes it
/// fail. Writes the tables of docs/worst-case.md.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Compare the tables with the image instead of writing them; numbers may differ by a twentieth
    #[arg(long)]
    check: bool,
    /// Print the longest path through a function in service, and nothing else
    #[arg(long, value_name = "FUNCTION", conflicts_with = "check")]
    path: Option<String>,
}

/// All results, for the page.
struct Analysis {
    program: Program,
    loops: Vec<Loop>,
    /// How often each loop has gone back, by its header.
    back: BTreeMap<u32, u64>,
    /// Without waits, with those of the flash, and with those of the buses too.
    costs: [Costs; 3],
    /// What was measured without waits and with those of the flash.
    measured: [Measured; 2],
    /// The longest activations of the two.
    activations: BTreeMap<Work, [u64; 2]>,
    /// The levels of preemption: name, bytes, and what was measured.
    levels: Vec<(String, u32, Option<u32>)>,
    /// The deepest stack that was measured.
    stack: u32,
    stack_size: u32,
}

/// Prints the bounds beside the measured times, and writes or checks the page.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    testkit::image::build(Part::Stm32f405)?;
    let own = env::current_exe()?;
    let target = own.ancestors().nth(2).context("this program is not in a target directory")?;
    let elf = fs::read(target.join("thumbv7em-none-eabihf/release/lss-slave"))?;
    let program = Program::parse(&elf, workspace())?;
    let stated = Stated::load()?;
    if let Some(name) = &arguments.path {
        let mut search = costs::search(&program, &stated, Waits::NONE);
        let function = program.function(name)?;
        search.explain(function)?.iter().for_each(|line| println!("{line}"));
        return Ok(());
    }
    let analysis = analyse(program, &stated)?;
    let blocks = page::blocks(&analysis);
    if !arguments.check {
        blocks.iter().for_each(|(name, block)| println!("{name}\n\n{block}"));
    }
    let path = workspace().join(PAGE);
    let found = fs::read_to_string(&path).context(PAGE)?;
    let filled = page::fill(&found, &blocks).with_context(|| format!("{PAGE} lacks a marker"))?;
    if !arguments.check {
        fs::write(path, filled)?;
    } else if !page::is_close(&found, &filled) {
        bail!("the tables of {PAGE} are not those of the image: run `cargo xtask worst-case`");
    }
    Ok(())
}

fn analyse(program: Program, stated: &Stated) -> anyhow::Result<Analysis> {
    check_vectors(&program)?;
    let loops = loops(&program, stated)?;
    let mut depths = Depths::new(&program);
    let of = |name: &str| program.function(name);
    let tasks = TASKS
        .map(|(name, priority)| Ok((name, priority, depths.function(of(name)?)?)))
        .into_iter()
        .collect::<anyhow::Result<Vec<_>>>()?;
    let background = depths.function(of("Reset")?)?;
    let faults = FAULTS.map(|name| depths.function(of(name)?));
    let faults = faults.into_iter().collect::<anyhow::Result<Vec<u32>>>()?;

    let frames = loops.iter().find(|found| found.text.contains(FRAMES));
    let marks = Marks {
        frames: frames.context("the loop over the received frames is not found")?.header,
        act: of("Runner::act")?,
        poll: of("Runner::act_until_nothing_is_due")?,
        fill: of("Controller::fill_mailboxes")?,
    };
    let bodies: BTreeMap<u32, BTreeSet<u32>> = loops
        .iter()
        .map(|found| Ok((found.function, program.graph(found.function)?.into_keys().collect())))
        .collect::<anyhow::Result<_>>()?;
    let shared = Arc::new(program);
    let run = |session| measure::run(&shared, loops.clone(), &bodies, marks, session);
    let [without, with, disturbed] = thread::scope(|scope| {
        [Session::Service, Session::ServiceWithWaits, Session::Disturbed]
            .map(|session| scope.spawn(move || run(session)))
            .map(|run| run.join().expect("a session does not panic"))
    });
    let mut program = Arc::into_inner(shared).context("a board still holds the program")?;
    take_accesses(&mut program, &[&without, &with, &disturbed]);

    let mut costs = Vec::new();
    for waits in [Waits::NONE, Waits::FLASH, Waits::CHIP] {
        costs.push(Costs::new(&program, stated, waits)?);
    }
    let costs: [Costs; 3] = costs.try_into().ok().context("three")?;
    for (measured, costs, waits) in
        [(&without, &costs[0], Waits::NONE), (&with, &costs[1], Waits::FLASH)]
    {
        check_steps(&program, stated, &loops, measured, waits)?;
        check_service(&program, stated, measured, costs, waits)?;
    }
    check_steps(&program, stated, &loops, &disturbed, Waits::NONE)?;

    let mut activations: BTreeMap<Work, [u64; 2]> = BTreeMap::new();
    let mut back = BTreeMap::new();
    let mut deepest: BTreeMap<u32, u32> = BTreeMap::new();
    let measured = [without, with];
    for (number, measured) in measured.iter().enumerate() {
        for (work, longest) in &measured.tasks {
            activations.entry(*work).or_default()[number] = longest.cycles;
        }
    }
    for measured in measured.iter().chain([&disturbed]) {
        for (work, longest) in &measured.tasks {
            let stack = deepest.entry(work.task).or_default();
            *stack = longest.stack.max(*stack);
        }
        for (header, rounds) in &measured.back {
            let most = back.entry(*header).or_insert(0);
            *most = (*most).max(*rounds);
        }
    }
    let mut levels = vec![("start and idle".to_owned(), background, None)];
    for priority in [1, 3] {
        let of_level = || tasks.iter().filter(|(_, of, _)| *of == priority);
        let deepest_of = |name: &str| {
            let function = program.function(name).ok()?;
            deepest.get(&function).copied()
        };
        for (name, _, depth) in of_level() {
            let measured = deepest_of(name).unwrap_or(0);
            ensure!(
                measured <= depth + EXCEPTION_FRAME,
                "{name} has used {measured} bytes of stack, more than its bound of {depth} and a frame"
            );
        }
        let depth = of_level().map(|(_, _, depth)| *depth).max().unwrap_or(0);
        let measured = of_level().filter_map(|(name, ..)| deepest_of(name)).max();
        levels.push((format!("tasks of priority {priority}"), depth + EXCEPTION_FRAME, measured));
    }
    let deepest_fault = faults.into_iter().max().unwrap_or(0);
    levels.push(("fault or NMI".to_owned(), deepest_fault + EXCEPTION_FRAME, None));
    let range = testkit::stack::stack(testkit::image::image());
    let stacks = measured.iter().chain([&disturbed]).map(|measured| measured.stack);
    let stack = stacks.max().unwrap_or(0);
    let bound: u32 = levels.iter().map(|(_, bytes, _)| bytes).sum();
    ensure!(stack <= bound, "the stack was {stack} bytes deep, more than its bound of {bound}");
    ensure!(bound <= range.len() as u32, "the stack may overflow: {bound} bytes");
    let stack_size = range.len() as u32;
    Ok(Analysis { program, loops, back, costs, measured, activations, levels, stack, stack_size })
}

/// The analysis knows all interrupt handlers.
fn check_vectors(program: &Program) -> anyhow::Result<()> {
    const FIRST_INTERRUPT: usize = 16;
    let default = program.function("DefaultHandler_").or_else(|_| program.function("ADC"))?;
    for &function in program.vectors.iter().skip(FIRST_INTERRUPT) {
        let name = program.name(function);
        let is_known =
            function == 0 || function == default || TASKS.iter().any(|(task, _)| *task == name);
        ensure!(is_known, "the interrupt handler {name} is none of the tasks that are analysed");
    }
    Ok(())
}

/// The loops of all tasks, with their bounds.
///
/// # Errors
/// A loop or a copy without a bound: all of them are named.
fn loops(program: &Program, stated: &Stated) -> anyhow::Result<Vec<Loop>> {
    let mut search = Search::new(program, stated, Waits::NONE);
    for (name, _) in TASKS {
        search.function(program.function(name)?)?;
    }
    let missing: Vec<String> = search.missing.iter().cloned().collect();
    ensure!(missing.is_empty(), "without a bound:\n{}", missing.join("\n"));
    Ok(search.loops.into_values().collect())
}

/// Takes over which loads and stores reach the flash or a peripheral.
fn take_accesses(program: &mut Program, measured: &[&Measured]) {
    for measured in measured {
        program.constant_loads.extend(&measured.constant_loads);
        program.ram_loads.extend(&measured.loads);
        program.ram_accesses.extend(&measured.accesses);
        program.peripheral_accesses.extend(&measured.peripheral);
    }
    program.ram_loads.retain(|at| !program.constant_loads.contains(at));
    program.ram_accesses.retain(|at| !program.peripheral_accesses.contains(at));
}

/// Compares what the board did with what the analysis allows in every state.
fn check_steps(
    program: &Program,
    stated: &Stated,
    loops: &[Loop],
    measured: &Measured,
    waits: Waits,
) -> anyhow::Result<()> {
    if let Some((from, to)) = measured.foreign.first() {
        bail!("the board went from {from:#x}, {}, to {to:#x}: no such path", program.place(*from));
    }
    check_rounds(loops.iter(), measured)?;
    let mut search = Search::new(program, stated, waits);
    for (at, length) in &measured.copied {
        let Flow::Call(callee) = program.instructions[at].flow else { continue };
        let bound = search.length(callee, *at);
        ensure!(*length <= bound, "a copy of {length} bytes, not {bound}: {}", program.place(*at));
    }
    for (at, used) in measured.cycles.iter().filter(|(_, used)| **used < STALL) {
        let instruction = &program.instructions[at];
        let jump = if instruction.flow == Flow::Next { 0 } else { REFILL };
        let back = if instruction.flow == Flow::Return { RETURN } else { 0 };
        let fetch = waits.other_line + waits.next_line;
        let bound = search.own(program.owner(*at), instruction)? + jump + back + fetch;
        ensure!(
            *used <= bound,
            "the instruction at {at:#x} took {used} cycles, not {bound}: {}",
            program.place(*at)
        );
    }
    Ok(())
}

fn check_rounds<'a>(
    loops: impl Iterator<Item = &'a Loop>,
    measured: &Measured,
) -> anyhow::Result<()> {
    for found in loops.filter(|found| !is_copy(&found.place)) {
        let back = measured.back.get(&found.header).copied().unwrap_or(0);
        ensure!(
            back <= found.back,
            "a loop has gone back {back} times, more than its bound of {}: {}",
            found.back,
            found.place
        );
    }
    Ok(())
}

/// Compares what the board did with what the analysis allows in service.
fn check_service(
    program: &Program,
    stated: &Stated,
    measured: &Measured,
    costs: &Costs,
    waits: Waits,
) -> anyhow::Result<()> {
    let mut service = costs::search(program, stated, waits);
    service.rounds_of.clear();
    for (name, _) in TASKS {
        service.function(program.function(name)?)?;
    }
    check_rounds(service.loops.values(), measured)?;
    let is_excluded = |at: &&u32| service.is_excluded(program.owner(**at), **at);
    if let Some(at) = measured.calls.iter().find(is_excluded) {
        bail!("a call that is said to be none of service was made: {}", program.place(*at));
    }
    for (work, longest) in &measured.tasks {
        let Some(bound) = costs.of(program, *work) else { continue };
        ensure!(
            longest.cycles <= bound,
            "{} took {} cycles, more than its bound of {bound}",
            program.name(work.task),
            longest.cycles
        );
        let is_of_frames = program.name(work.task) == "CAN1_RX0";
        ensure!(
            is_of_frames || work.actions <= OWN_ACTIONS,
            "{} has made {} actions, more than its bound of {OWN_ACTIONS}",
            program.name(work.task),
            work.actions
        );
    }
    ensure!(
        (1..=costs.answer).contains(&measured.answer),
        "an answer took {} cycles, more than its bound of {}",
        measured.answer,
        costs.answer
    );
    ensure!(
        measured.sections.keys().any(|(_, actions)| *actions == STORE_ACTIONS),
        "no critical section had {STORE_ACTIONS} actions: the session no longer meets the phase of the heartbeat"
    );
    for ((at, actions), cycles) in &measured.sections {
        let (bound, most) = match program.masks.get(at) {
            Some(Mask::Disable) => (costs.log, 0),
            _ => (costs.section + actions * costs.action, STORE_ACTIONS),
        };
        ensure!(*cycles <= bound, "a critical section took {cycles} cycles, not {bound}");
        ensure!(*actions <= most, "a critical section had {actions} actions, not {most}");
    }
    Ok(())
}
