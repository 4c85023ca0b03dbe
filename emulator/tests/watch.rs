//! The reports that a watcher gets of a program.

#[expect(dead_code, reason = "what other tests need of the assembler")]
mod programs;

use std::sync::{Arc, Mutex};

use emulator::{
    Time,
    board::{Board, Settings, Stop},
    chip::Part,
    engine::{Engine, Registers, Step, Watcher},
};
use programs::{Program, R0, R1};

const RCC_AHB1ENR: u32 = 0x4002_3830;
const SYST_CSR: u32 = 0xE000_E010;
const SYST_RVR: u32 = 0xE000_E014;
const AIRCR: u32 = 0xE000_ED0C;
const SYSTICK: usize = 15;
const EXCEPTION: u32 = 0x1FF;

/// Each step, and the registers after it.
#[derive(Clone, Default)]
struct Diary(Arc<Mutex<Vec<(Step, Registers)>>>);

impl Watcher for Diary {
    fn stepped(&mut self, step: &Step, core: &dyn Engine) {
        self.0.lock().expect("no panic").push((step.clone(), core.registers()));
    }

    fn flash_changed(&mut self, _: usize, _: &[u8], _: &dyn Engine) {}

    fn ram_changed(&mut self, _: u32, _: &[u8], _: &dyn Engine) {}
}

/// The steps reported to a watcher in the first 2 ms, of which the board runs for half a millisecond.
fn watch(program: &Program) -> Vec<(Step, Registers)> {
    let diary = Diary::default();
    let mut board = Board::new(Part::Stm32f405, &program.image(), Settings::default());
    board.watch(Box::new(diary.clone()));
    while board.run_until(Time::from_ms(2)) != Stop::Deadline {}
    assert_eq!(board.findings(), []);
    std::mem::take(&mut diary.0.lock().expect("no panic"))
}

#[test]
fn each_step_begins_where_the_one_before_it_ended() {
    let mut program = Program::new();
    program.store(SYST_RVR, 500).store(SYST_CSR, 7).sleep_forever();
    program.handler(SYSTICK).add(R1, 1).back();
    let diary = watch(&program);
    assert!(diary[0].0.from_reset);
    assert!(diary.windows(2).all(|pair| !pair[1].0.from_reset && pair[0].1 == pair[1].0.before));
    // In 500 us at 16 MHz, every 501 cycles.
    let entries = diary.iter().filter(|(step, after)| {
        step.systick_pending && step.before.xpsr & EXCEPTION == 0 && after.xpsr & EXCEPTION == 15
    });
    assert_eq!(entries.count(), 15);
}

#[test]
fn loads_and_stores_of_peripherals_are_reported_with_their_instruction() {
    let mut program = Program::new();
    program.store(RCC_AHB1ENR, 1 << 3).load(R0, RCC_AHB1ENR).stop();
    let diary = watch(&program);
    let transfers: Vec<_> = diary
        .iter()
        .flat_map(|(step, _)| step.transfers.iter().map(|transfer| (step.before.r[15], *transfer)))
        .map(|(pc, transfer)| {
            assert_eq!(pc, transfer.access.pc);
            (transfer.access.address, transfer.is_store, transfer.value)
        })
        .collect();
    assert_eq!(transfers, [(RCC_AHB1ENR, true, 1 << 3), (RCC_AHB1ENR, false, 1 << 3)]);
}

#[test]
fn the_instruction_that_asks_for_a_reset_is_the_last_before_it() {
    let mut program = Program::new();
    program.store(AIRCR, 0x05FA_0004).stop();
    let diary = watch(&program);
    let asked = diary.iter().position(|(step, _)| step.requests_reset).expect("it asks");
    assert!(diary[asked + 1].0.from_reset);
}
