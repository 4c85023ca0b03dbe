//! Boards that run small programs, assembled instruction by instruction.

#[expect(dead_code, reason = "one register is for another program")]
mod programs;

use emulator::{
    Time,
    board::{Board, Settings, Stop},
    can::Clock,
    chip::{ChipVariant, Part, Pin, Problem, ResetCause},
};
use programs::{Program, R0, R1, R2, RCC_AHB1ENR, RCC_APB1ENR, RCC_CFGR, RCC_CR};

const FLASH_ACR: u32 = 0x4002_3C00;
const RCC_CSR: u32 = 0x4002_3874;
const GPIOD: u32 = 0x4002_0C00;
const IWDG_KR: u32 = 0x4000_3000;
const FLASH_KEYR: u32 = 0x4002_3C04;
const FLASH_CR: u32 = 0x4002_3C10;
const SYST_CSR: u32 = 0xE000_E010;
const SYST_RVR: u32 = 0xE000_E014;
const COUNTER: u32 = 0x2000_0100;

const NVIC_ISER: u32 = 0xE000_E100;
const TIM2: u32 = 0x4000_0000;
const TIM2_CCR1: u32 = TIM2 + 0x34;
const TIM2_IRQ: u32 = 28;

const SYSTICK: usize = 15;
const NMI: usize = 2;
const HARD_FAULT: usize = 3;

/// The time from power-on to the start of the board's program.
const START: Time = Time::from_us(1_500);

fn board(program: Program) -> Board {
    Board::new(Part::Stm32f405, &program.image(), Settings::default())
}

fn word(board: &Board, address: u32) -> u32 {
    let mut bytes = [0; 4];
    assert!(board.read_memory(address, &mut bytes), "{address:#x} is no memory");
    u32::from_le_bytes(bytes)
}

fn board_with(program: Program, chip_variant: ChipVariant) -> Board {
    let settings = Settings { chip_variant, ..Settings::default() };
    Board::new(Part::Stm32f405, &program.image(), settings)
}

/// Runs through resets up to `until`.
fn run(board: &mut Board, until: Time) {
    while board.run_until(until) != Stop::Deadline {}
}

/// Counts SysTick interrupts of `reload` + 1 cycles at `COUNTER`, and sleeps in between.
fn ticker(reload: u32) -> Program {
    let mut program = Program::new();
    program.store(COUNTER, 0).store(SYST_RVR, reload).store(SYST_CSR, 7);
    program.sleep_forever();
    program.handler(SYSTICK).load(R1, COUNTER).add(R1, 1).store_register(COUNTER, R1).back();
    program
}

#[test]
fn a_run_in_small_pieces_is_the_same_as_a_run_in_one() {
    let end = Time::from_ms(30);
    for program in [|| ticker(997), alarms] {
        let (mut whole, mut pieces) = (board(program()), board(program()));
        run(&mut whole, end);
        let mut step = 1;
        while pieces.now() < end {
            step = step * 5 % 1_000_003;
            let next = pieces.now() + Time::from_ns(step);
            run(&mut pieces, end.min(next));
        }
        assert_eq!((pieces.now(), pieces.cycles()), (whole.now(), whole.cycles()));
        assert_eq!(word(&pieces, COUNTER), word(&whole, COUNTER));
    }
}

/// Counts the wake-ups by TIM2's compare at `COUNTER`, each 1 ms after the one before.
fn alarms() -> Program {
    const CEN: u32 = 1;
    const CC1: u32 = 1 << 1;
    let mut program = Program::new();
    program.store(COUNTER, 0).store(RCC_APB1ENR, 1);
    for (register, value) in [(0x28, 15), (0x14, 1), (0x34, 1_000), (0x0C, CC1), (0x00, CEN)] {
        program.store(TIM2 + register, value);
    }
    program.store(NVIC_ISER, 1 << TIM2_IRQ).sleep_forever();
    program.handler(16 + TIM2_IRQ as usize).store(TIM2 + 0x10, 0);
    program.load(R1, COUNTER).add(R1, 1).store_register(COUNTER, R1);
    program.load(R1, TIM2_CCR1).add(R1, 250).add(R1, 250).add(R1, 250).add(R1, 250);
    program.store_register(TIM2_CCR1, R1).back();
    program
}

#[test]
fn systick_and_a_timer_wake_a_sleeping_cpu_exactly_as_often_as_they_interrupt() {
    for (program, late) in [(ticker(15_999), 5), (alarms(), 100)] {
        let mut board = board(program);
        run(&mut board, START + Time::from_s(10) + Time::from_us(late));
        assert_eq!(word(&board, COUNTER), 10_000);
        let (all, busy) = board.cycles();
        assert!(all >= 160_000_000 && busy < all / 100, "{busy} of {all} cycles");
        assert_eq!(board.findings(), []);
    }
}

#[test]
fn the_core_follows_the_clock_of_rcc_with_the_crystals_error() {
    let mut program = Program::new();
    program.store(RCC_CR, 0x0001_0083).wait_for_ones(RCC_CR, 1 << 17).store(RCC_CFGR, 1);
    program.stop();
    let settings = Settings { crystal: Clock { hz: 8_000_000, ppm: -100 }, ..Settings::default() };
    let mut board = Board::new(Part::Stm32f405, &program.image(), settings);
    run(&mut board, Time::from_ms(10));
    let (before, _) = board.cycles();
    let start = board.now();
    run(&mut board, start + Time::from_s(1));
    let (after, _) = board.cycles();
    assert!((after - before).abs_diff(7_999_200) <= 3, "{}", after - before);
}

#[test]
fn a_power_cycle_scrambles_ram_and_keeps_flash() {
    let mut program = Program::new();
    program.load(R2, COUNTER).store_register(COUNTER + 4, R2).store(COUNTER, 0).stop();
    let mut board = board(program);
    run(&mut board, Time::from_ms(2));
    board.set_flash(0x4000, b"kept");
    board.power_off();
    assert_eq!(board.wake_time(), Time::MAX);
    run(&mut board, Time::from_ms(5));
    assert_eq!((board.now(), board.is_powered()), (Time::from_ms(5), false));
    board.power_on();
    run(&mut board, Time::from_ms(10));
    assert_ne!(word(&board, COUNTER + 4), 0);
    assert_eq!(board.flash()[0x4000..0x4004], *b"kept");
    assert_eq!(board.resets().len(), 2);
}

/// Erases sector 1 and then writes 1 to `COUNTER`.
fn eraser() -> Program {
    let mut program = Program::new();
    program.store(COUNTER, 0).store(FLASH_KEYR, 0x4567_0123).store(FLASH_KEYR, 0xCDEF_89AB);
    program.store(FLASH_CR, 0x0001_020A).store(COUNTER, 1).stop();
    program
}

#[test]
fn an_erase_stalls_the_program_that_runs_from_flash() {
    let mut board = board(eraser());
    board.set_flash(0x4000, &[0; 0x4000]);
    run(&mut board, Time::from_ms(250));
    assert_eq!(word(&board, COUNTER), 0);
    assert!(board.wake_time() > board.now());
    run(&mut board, Time::from_ms(252));
    assert_eq!(word(&board, COUNTER), 1);
    assert!(board.flash()[0x4000..0x8000].iter().all(|&byte| byte == 0xFF));
}

#[test]
fn an_erase_does_not_stall_a_program_that_runs_from_ram() {
    let mut board = board(eraser().in_ram());
    run(&mut board, Time::from_ms(3));
    assert_eq!(word(&board, COUNTER), 1);
}

#[test]
fn an_erase_stalls_a_load_from_flash_by_a_program_in_ram() {
    // On the STM32F427, sector 16 lies in the other bank than what is loaded.
    for (part, sector, is_stalled) in
        [(Part::Stm32f405, 1, true), (Part::Stm32f427, 1, true), (Part::Stm32f427, 16, false)]
    {
        for address in [0x0800_C000, 0x0000_C000] {
            let mut program = Program::new();
            program.store(COUNTER, 0).store(FLASH_KEYR, 0x4567_0123).store(FLASH_KEYR, 0xCDEF_89AB);
            program.store(FLASH_CR, 0x0001_0202 | sector << 3).load(R1, address);
            program.store_register(COUNTER, R1).stop();
            let mut board = Board::new(part, &program.in_ram().image(), Settings::default());
            board.set_flash(0xC000, &[1, 0, 0, 0]);
            run(&mut board, Time::from_ms(250));
            let case = format!("{part:?}, sector {sector}, {address:#x}");
            assert_eq!(word(&board, COUNTER), u32::from(!is_stalled), "{case}");
            run(&mut board, Time::from_ms(252));
            assert_eq!(word(&board, COUNTER), 1, "{case}");
        }
    }
}

#[test]
fn an_erase_stalls_an_interrupt_only_if_its_vector_is_in_the_flash() {
    const VTOR: u32 = 0xE000_ED08;
    const VECTORS: u32 = 0x2000_0800;
    let program = |vectors: Option<u32>| {
        let mut program = Program::new();
        program.store(COUNTER, 0).store(FLASH_KEYR, 0x4567_0123).store(FLASH_KEYR, 0xCDEF_89AB);
        if let Some(handler) = vectors {
            program.store(VECTORS + 4 * SYSTICK as u32, handler).store(VTOR, VECTORS);
        }
        program.store(FLASH_CR, 0x0001_020A).store(SYST_RVR, 15_999).store(SYST_CSR, 7).stop();
        let handler = program.here() - 0x0800_0200 + 0x2000_1001;
        program.handler(SYSTICK).load(R1, COUNTER).add(R1, 1).store_register(COUNTER, R1).back();
        (program.in_ram(), handler)
    };
    let counted = |program| {
        let mut board = board(program);
        run(&mut board, Time::from_ms(250));
        word(&board, COUNTER)
    };
    assert_eq!(counted(program(None).0), 0);
    let handler = program(Some(0)).1;
    assert!((240..250).contains(&counted(program(Some(handler)).0)));
}

#[test]
fn nothing_at_an_address_and_a_breakpoint_without_debugger_are_hard_faults() {
    // The second address is right below the RAM, where the stack of a program overflows to.
    for address in [Some(0x6000_0000), Some(0x1FFF_FFFC), None] {
        let mut program = Program::new();
        program.store(COUNTER, 0);
        match address {
            Some(address) => program.store(address, 1).stop(),
            None => program.breakpoint(),
        };
        program.handler(HARD_FAULT).store(COUNTER, 2).stop();
        let mut board = board(program);
        run(&mut board, Time::from_ms(2));
        assert_eq!(word(&board, COUNTER), 2);
    }
}

#[test]
fn without_a_fault_below_the_ram_stores_there_are_lost() {
    let mut program = Program::new();
    program.store(COUNTER, 0).store(0x1FFF_FFFC, 1).load(R1, 0x1FFF_FFFC).add(R1, 7);
    program.store_register(COUNTER, R1).stop();
    program.handler(HARD_FAULT).store(COUNTER, 2).stop();
    let variant = ChipVariant { no_fault_below_ram: true, ..ChipVariant::default() };
    let mut board = board_with(program, variant);
    run(&mut board, Time::from_ms(2));
    assert_eq!(word(&board, COUNTER), 7);
}

/// The cycles from the start to a pin that is set after 300 additions, with this content of FLASH_ACR.
fn cycles_of_300_additions(acr: u32, variant: ChipVariant) -> u64 {
    let mut program = Program::new();
    program.store(RCC_AHB1ENR, 1 << 3).store(FLASH_ACR, acr).store(GPIOD, 1 << 24);
    for _ in 0..300 {
        program.add(R1, 1);
    }
    program.store(GPIOD + 0x18, 1 << 12).stop();
    let mut board = board_with(program, variant);
    run(&mut board, Time::from_ms(3));
    (board.output(Pin('D', 12)).since - START).as_ns() * 16 / 1_000
}

#[test]
fn a_slow_core_takes_two_and_three_times_as_long_and_systick_does_not() {
    let [once, twice, thrice] = [1, 2, 3].map(|slowdown| {
        let variant = ChipVariant { slowdown, ..ChipVariant::default() };
        let mut sleeper = board_with(ticker(15_999), variant);
        run(&mut sleeper, START + Time::from_s(1) + Time::from_us(50));
        assert_eq!(word(&sleeper, COUNTER), 1_000);
        cycles_of_300_additions(0, variant)
    });
    assert!(twice.abs_diff(2 * once) < once / 20, "{once}, {twice}");
    assert!(thrice.abs_diff(3 * once) < once / 20, "{once}, {thrice}");
}

#[test]
fn flash_waits_cost_what_prefetch_and_cache_do_not_hide() {
    const LINES: u64 = 300 / 8;
    let waiting = ChipVariant { flash_waits: true, ..ChipVariant::default() };
    let never = cycles_of_300_additions(5, ChipVariant::default());
    assert_eq!(cycles_of_300_additions(0, waiting), never);
    let always = cycles_of_300_additions(5, waiting);
    assert!((5 * LINES..5 * (LINES + 8)).contains(&(always - never)), "{never}, {always}");
    let prefetched = cycles_of_300_additions(1 << 8 | 5, waiting);
    assert!(prefetched - never < 30, "{never}, {prefetched}");
}

/// Counts interrupts of TIM3 each millisecond at `COUNTER`; the watchdog is on. DBGMCU freezes this at a halt.
fn counting(freezes: u32) -> Board {
    const DBGMCU_APB1_FZ: u32 = 0xE004_2008;
    const TIM3: u32 = 0x4000_0400;
    const TIM3_IRQ: usize = 29;
    let mut program = Program::new();
    program.store(COUNTER, 0).store(DBGMCU_APB1_FZ, freezes).store(IWDG_KR, 0xCCCC);
    program.store(RCC_APB1ENR, 1 << 1).store(TIM3 + 0x2C, 15_999).store(TIM3 + 0x0C, 1);
    program.store(NVIC_ISER, 1 << TIM3_IRQ).store(TIM3, 1).sleep_forever();
    program.handler(16 + TIM3_IRQ).store(TIM3 + 0x10, 0).store(IWDG_KR, 0xAAAA);
    program.load(R1, COUNTER).add(R1, 1).store_register(COUNTER, R1).back();
    board(program)
}

#[test]
fn a_halted_core_does_nothing_and_the_watchdog_resets_unless_it_is_frozen() {
    for (freezes, resets) in [(0, 2), (1 << 12, 1), (1 << 12 | 1 << 1, 1)] {
        let mut board = counting(freezes);
        run(&mut board, Time::from_us(101_950));
        assert_eq!(word(&board, COUNTER), 100);
        board.halt();
        run(&mut board, Time::from_us(2_101_950));
        assert_eq!((word(&board, COUNTER), board.resets().len()), (100, resets), "{freezes:#x}");
        board.resume();
        run(&mut board, Time::from_us(2_101_960));
        let is_timer_frozen = freezes >> 1 & 1 == 1;
        if resets == 1 {
            // What came in the meantime is a single interrupt.
            assert_eq!(word(&board, COUNTER), if is_timer_frozen { 100 } else { 101 });
            run(&mut board, Time::from_us(2_111_960));
            assert_eq!(word(&board, COUNTER), if is_timer_frozen { 110 } else { 111 });
            board.halt();
            run(&mut board, Time::from_s(60));
            board.resume();
            run(&mut board, Time::from_s(61));
        }
        assert_eq!((board.resets().len(), board.findings()), (resets, vec![]));
    }
}

/// RM0440 3.3.4.
#[test]
fn a_read_of_a_double_error_is_an_nmi_that_its_handler_ends_by_eccd() {
    const WORD: u32 = 0x0800_4000;
    const FLASH_ECCR: u32 = 0x4002_2018;
    let mut program = Program::new();
    program.store(COUNTER, 0).load(R0, WORD + 8).load(R0, WORD + 4).load(R0, WORD).stop();
    program.handler(NMI).load(R1, COUNTER).add(R1, 1).store_register(COUNTER, R1);
    program.store(FLASH_ECCR, 1 << 31).back();
    let mut board = Board::new(Part::Stm32g431, &program.image(), Settings::default());
    board.chip().flash_mut().damage(WORD - 0x0800_0000);
    board.reset(ResetCause::Pin);
    run(&mut board, Time::from_ms(3));
    assert_eq!((word(&board, COUNTER), board.findings()), (2, vec![]));
}

#[test]
fn a_brown_out_holds_the_chip_in_reset_and_keeps_ram() {
    let mut program = Program::new();
    program.load(R1, COUNTER).add(R1, 1).store_register(COUNTER, R1);
    program.load(R0, RCC_CSR).store_register(COUNTER + 4, R0).stop();
    let mut board = board(program);
    run(&mut board, Time::from_ms(5));
    let first = word(&board, COUNTER);
    assert_eq!(word(&board, COUNTER + 4) >> 24, 0x0E);

    board.set_supply(1_700);
    run(&mut board, Time::from_ms(10));
    assert_eq!(board.resets().len(), 1, "the factory's level is lower");
    board.set_supply(3_300);
    board.chip().flash_mut().set_brown_out_level(3);
    board.set_supply(2_840);
    assert!(board.is_powered());
    board.set_supply(2_800);
    assert!(!board.is_powered());
    run(&mut board, Time::from_ms(20));
    board.set_supply(2_900);
    assert!(!board.is_powered(), "hysteresis");
    board.set_supply(2_950);
    run(&mut board, Time::from_ms(30));
    assert_eq!(board.resets()[1..], [(Time::from_ms(20), ResetCause::BrownOut)]);
    assert_eq!(word(&board, COUNTER), first.wrapping_add(1));
    assert_eq!(word(&board, COUNTER + 4) >> 24 & 0x0E, 0x0E, "flags add up");
}

#[test]
fn a_board_that_is_switched_on_at_a_low_supply_waits_for_more() {
    let mut program = Program::new();
    program.store(COUNTER, 1).stop();
    let mut board = board(program);
    board.chip().flash_mut().set_brown_out_level(3);
    board.power_off();
    board.set_supply(2_850);
    board.power_on();
    run(&mut board, Time::from_ms(10));
    assert!(!board.is_powered(), "hysteresis");
    board.set_supply(3_000);
    run(&mut board, Time::from_ms(20));
    assert!(board.is_powered());
    assert_eq!(word(&board, COUNTER), 1);
}

/// Waits for the crystal, runs on it, and sleeps; the non-maskable interrupt writes 4 to `COUNTER`.
fn on_crystal(security: u32) -> Program {
    let mut program = Program::new();
    program.store(COUNTER, 0).store(IWDG_KR, 0xCCCC);
    program.store(RCC_CR, 0x0001_0083 | security).wait_for_ones(RCC_CR, 1 << 17).store(RCC_CFGR, 1);
    program.sleep_forever();
    program.handler(NMI).store(0x4002_380C, 1 << 23).store(COUNTER, 4).back();
    program
}

#[test]
fn without_clock_security_only_the_watchdog_ends_the_silence() {
    let mut board = board(on_crystal(0));
    run(&mut board, Time::from_ms(10));
    board.stop_crystal();
    run(&mut board, Time::from_ms(500));
    assert_eq!((board.wake_time() > Time::from_ms(500), board.resets().len()), (true, 1));
    assert_eq!(board.run_until(Time::from_s(1)), Stop::Reset(ResetCause::Watchdog));
    board.start_crystal();
    run(&mut board, Time::from_ms(600));
    assert_eq!(board.chip().clocks().hclk.hz, 8_000_000);
}

#[test]
fn a_fault_in_the_fault_handler_locks_up_until_the_watchdog_resets() {
    let mut program = Program::new();
    program.store(IWDG_KR, 0xCCCC).breakpoint();
    program.handler(HARD_FAULT).undefined();
    let mut board = board(program);
    run(&mut board, Time::from_ms(100));
    assert!(board.lockup().is_some());
    assert_eq!(board.run_until(Time::from_s(1)), Stop::Reset(ResetCause::Watchdog));
    assert_eq!(board.lockup(), None);
}

#[test]
fn systick_on_the_external_clock_is_found() {
    let mut program = Program::new();
    program.store(SYST_RVR, 99).store(SYST_CSR, 1).sleep_forever();
    let mut board = board(program);
    run(&mut board, Time::from_ms(2));
    assert_eq!(board.findings().len(), 1);
}

const VTOR: u32 = 0xE000_ED08;
const MEMRMP: u32 = 0x4001_3800;

#[test]
fn a_boot_loader_leaves_clock_systick_usb_and_its_own_vector_table() {
    let mut program = Program::new();
    for (at, register) in
        [VTOR, MEMRMP, RCC_CFGR, SYST_CSR, NVIC_ISER + 8, 0].into_iter().enumerate()
    {
        program.load(R1, register).store_register(COUNTER + 4 * at as u32, R1);
    }
    program.sleep_forever();
    let mut board =
        board_with(program, ChipVariant { boot_loader: true, ..ChipVariant::default() });
    run(&mut board, Time::from_ms(5));
    let words = [0, 4, 8, 12, 16, 20].map(|offset| word(&board, COUNTER + offset));
    assert_eq!(words, [0, 1, 0x100A, 7, 1 << 3, 0x1FFF_0401]);
    assert_eq!(board.chip().clocks().pclk1.hz, 30_000_000);
    assert_eq!((board.lockup(), board.findings()), (None, vec![]), "its handlers return");
    board.reset(ResetCause::Pin);
    run(&mut board, Time::from_ms(10));
    assert_eq!(word(&board, COUNTER + 4), 1, "again");
}

#[test]
fn the_memory_at_address_0_is_that_of_memrmp() {
    let mut program = Program::new();
    program.store(0x4002_3844, 1 << 14).store(COUNTER, 7);
    program.load(R1, 4).store_register(COUNTER + 4, R1);
    program.store(MEMRMP, 3).load(R1, COUNTER - 0x2000_0000).store_register(COUNTER + 8, R1);
    program.store(MEMRMP, 0).load(R1, 4).store_register(COUNTER + 12, R1).stop();
    let mut start = [0; 4];
    let mut board = board(program);
    run(&mut board, Time::from_ms(3));
    assert!(board.read_memory(0x0800_0004, &mut start));
    let start = u32::from_le_bytes(start);
    let words = [4, 8, 12].map(|offset| word(&board, COUNTER + offset));
    assert_eq!(words, [start, 7, start]);
    assert_eq!(board.findings(), []);
}

#[test]
fn a_tolerant_board_does_not_tolerate_what_can_rcc_and_gpio_lack() {
    const DAC: u32 = 0x4000_7400;
    for (address, is_tolerated) in
        [(DAC, true), (0x4002_38FC, false), (GPIOD + 0x30, false), (0x4000_67FC, false)]
    {
        let mut program = Program::new();
        program.store(RCC_AHB1ENR, 1 << 3).store(RCC_APB1ENR, 1 << 25).store(address, 1).stop();
        let settings = Settings { tolerates_unmodelled: true, ..Settings::default() };
        let mut tolerant = Board::new(Part::Stm32f405, &program.image(), settings);
        let mut strict = board(program);
        for board in [&mut tolerant, &mut strict] {
            run(board, Time::from_ms(2));
            let problems: Vec<_> = board.findings().iter().map(|found| found.problem).collect();
            assert_eq!(problems, [Problem::Unmodelled], "{address:08x}");
        }
        assert_eq!(tolerant.misuse().is_none(), is_tolerated, "{address:08x}");
        assert!(strict.misuse().is_some(), "{address:08x}");
    }
}
