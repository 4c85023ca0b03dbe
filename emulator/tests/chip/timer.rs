//! The registers of the timers as seen by a program, without a CPU.

use emulator::{
    Time,
    can::Clock,
    chip::{Access, Chip, Part, Problem, Width},
};

use super::{FLASH_ACR, RCC_APB1ENR, RCC_CFGR, RCC_CR, RCC_PLLCFGR, problems, read, write};

const RCC_APB1RSTR: u32 = 0x4002_3820;
const TIM2: u32 = 0x4000_0000;
const TIM5: u32 = 0x4000_0C00;
const CR1: u32 = 0x00;
const DIER: u32 = 0x0C;
const SR: u32 = 0x10;
const EGR: u32 = 0x14;
const CNT: u32 = 0x24;
const PSC: u32 = 0x28;
const ARR: u32 = 0x2C;
const CCR1: u32 = 0x34;
const CCR4: u32 = 0x40;

const TIM2_IRQ: u32 = 28;
const TIM5_IRQ: u32 = 50;

/// A chip at 16 MHz with `timer` counting microseconds from time zero on.
fn counting(timer: u32) -> Chip {
    let mut chip = Chip::new(Part::Stm32f405, Clock { hz: 8_000_000, ppm: 0 }, [0; 12]);
    write(&mut chip, RCC_APB1ENR, 1 << 3 | 1 << 0, Time::ZERO);
    for (register, value) in [(PSC, 15), (EGR, 1), (SR, 0), (CR1, 1)] {
        write(&mut chip, timer + register, value, Time::ZERO);
    }
    chip
}

#[test]
fn a_timer_counts_its_clock_divided_by_the_prescaler() {
    for timer in [TIM2, TIM5] {
        let mut chip = counting(timer);
        for us in [0, 1, 2, 999, 123_456_789] {
            let now = Time::from_us(us);
            assert_eq!(u64::from(read(&mut chip, timer + CNT, now)), us);
            let almost = now + Time::from_ns(999);
            assert_eq!(u64::from(read(&mut chip, timer + CNT, almost)), us);
        }
        assert_eq!(problems(&chip), []);
    }
}

#[test]
fn a_timer_counts_twice_as_fast_as_a_slow_apb1_with_the_crystals_error() {
    let mut chip = Chip::new(Part::Stm32f405, Clock { hz: 8_000_000, ppm: 100 }, [0; 12]);
    let ready = Time::from_ms(10);
    for (register, value) in
        [(FLASH_ACR, 5), (RCC_PLLCFGR, 1 << 22 | 160 << 6 | 4), (RCC_CR, 0x0101_0083)]
    {
        write(&mut chip, register, value, Time::ZERO);
    }
    write(&mut chip, RCC_CFGR, 4 << 13 | 5 << 10 | 2, ready);
    assert_eq!(chip.clocks().timclk1, Clock { hz: 80_000_000, ppm: 100 });
    write(&mut chip, RCC_APB1ENR, 1, ready);
    for (register, value) in [(PSC, 79), (EGR, 1), (CR1, 1)] {
        write(&mut chip, TIM2 + register, value, ready);
    }
    assert_eq!(read(&mut chip, TIM2 + CNT, ready + Time::from_s(1)), 1_000_100);
    assert_eq!(problems(&chip), []);
}

#[test]
fn a_timer_wraps_at_32_bits_or_at_its_auto_reload_value() {
    let mut chip = counting(TIM2);
    write(&mut chip, TIM2 + CNT, 0xFFFF_FFFE, Time::ZERO);
    let counts = [0, 1, 2, 3].map(|us| read(&mut chip, TIM2 + CNT, Time::from_us(us)));
    assert_eq!(counts, [0xFFFF_FFFE, 0xFFFF_FFFF, 0, 1]);
    assert_eq!(read(&mut chip, TIM2 + SR, Time::from_us(3)) & 1, 1);

    let mut chip = counting(TIM5);
    write(&mut chip, TIM5 + ARR, 9, Time::ZERO);
    assert_eq!(read(&mut chip, TIM5 + SR, Time::from_us(9)) & 1, 0);
    assert_eq!(read(&mut chip, TIM5 + SR, Time::from_us(10)) & 1, 1);
    assert_eq!(read(&mut chip, TIM5 + CNT, Time::from_us(25)), 5);
}

#[test]
fn a_compare_interrupts_at_its_count_until_the_flag_is_cleared() {
    for (timer, irq) in [(TIM2, TIM2_IRQ), (TIM5, TIM5_IRQ)] {
        let mut chip = counting(timer);
        write(&mut chip, timer + CCR1, 1_000, Time::ZERO);
        assert_eq!(chip.next_event(), Time::MAX, "it does not interrupt");
        write(&mut chip, timer + DIER, 1 << 1, Time::ZERO);
        let at = Time::from_ms(1);
        assert_eq!(chip.next_event(), at);
        chip.advance(Time::from_us(999));
        assert_eq!(chip.irqs(), 0);
        chip.advance(at);
        assert_eq!(chip.irqs(), 1 << irq);
        assert_eq!(read(&mut chip, timer + SR, at), 1 << 1);
        write(&mut chip, timer + SR, !(1 << 1), at);
        assert_eq!(chip.irqs(), 0);
        assert_eq!(problems(&chip), []);
    }
}

#[test]
fn each_channel_has_its_own_compare_and_the_earliest_comes_first() {
    let mut chip = counting(TIM2);
    for channel in 0..4 {
        write(&mut chip, TIM2 + CCR1 + 4 * channel, 400 - 100 * channel, Time::ZERO);
    }
    write(&mut chip, TIM2 + SR, 0, Time::ZERO);
    write(&mut chip, TIM2 + DIER, 0b11110, Time::ZERO);
    assert_eq!(chip.next_event(), Time::from_us(100));
    for (us, flags) in [(100, 0b10000), (200, 0b11000), (300, 0b11100), (400, 0b11110)] {
        assert_eq!(read(&mut chip, TIM2 + SR, Time::from_us(us)), flags);
    }
}

#[test]
fn a_compare_with_the_present_count_or_an_earlier_one_is_late_by_a_turn() {
    let mut chip = counting(TIM2);
    write(&mut chip, TIM2 + DIER, 1 << 1, Time::ZERO);
    for value in [50, 49] {
        write(&mut chip, TIM2 + CCR1, value, Time::from_us(50));
        assert!(chip.next_event() > Time::from_s(4_294), "at {value}");
    }
    write(&mut chip, TIM2 + CCR1, 51, Time::from_us(50));
    assert_eq!(chip.next_event(), Time::from_us(51));
}

#[test]
fn a_stopped_timer_keeps_its_count_and_an_update_clears_it() {
    let mut chip = counting(TIM2);
    write(&mut chip, TIM2 + CR1, 0, Time::from_us(70));
    assert_eq!(read(&mut chip, TIM2 + CNT, Time::from_us(90)), 70);
    write(&mut chip, TIM2 + CR1, 1, Time::from_us(100));
    assert_eq!(read(&mut chip, TIM2 + CNT, Time::from_us(105)), 75);
    write(&mut chip, TIM2 + EGR, 1, Time::from_us(110));
    assert_eq!(read(&mut chip, TIM2 + CNT, Time::from_us(111)), 1);
    assert_eq!(read(&mut chip, TIM2 + SR, Time::from_us(111)) & 1, 1);
    write(&mut chip, RCC_APB1RSTR, 1, Time::from_us(120));
    write(&mut chip, RCC_APB1RSTR, 0, Time::from_us(120));
    let registers = [CR1, CNT, PSC, ARR, CCR4];
    let values = registers.map(|register| read(&mut chip, TIM2 + register, Time::from_us(130)));
    assert_eq!(values, [0, 0, 0, u32::MAX, 0]);
}

#[test]
fn a_timer_of_16_bits_ignores_the_upper_half_of_the_bus() {
    const TIM12: u32 = 0x4000_1800;
    let mut chip = Chip::new(Part::Stm32f405, Clock { hz: 8_000_000, ppm: 0 }, [0; 12]);
    write(&mut chip, RCC_APB1ENR, 1 << 6, Time::ZERO);
    // The bridge repeats a half-word in the upper half.
    let half = |register| Access {
        address: TIM12 + register,
        width: Width::Half,
        now: Time::ZERO,
        pc: 0x0800_1234,
    };
    for (register, value) in [(PSC, 15), (ARR, 0xFFFF), (EGR, 1), (SR, 0xFFFE), (CCR1, 0x8000)] {
        chip.write(half(register), value).expect("no bus error");
    }
    write(&mut chip, TIM12 + DIER, 1 << 1 | 1 << 0, Time::ZERO);
    write(&mut chip, TIM12 + CR1, 1, Time::ZERO);
    for (us, irqs, flag) in [(0x8000, 1 << 43, 1 << 1), (0x1_0000, 1 << 43, 1 << 0)] {
        let at = Time::from_us(us);
        assert_eq!(chip.next_event(), at);
        chip.advance(at);
        assert_eq!(chip.irqs(), irqs);
        assert_eq!(read(&mut chip, TIM12 + CNT, at), us as u32 & 0xFFFF);
        write(&mut chip, TIM12 + SR, !flag, at);
        assert_eq!(chip.irqs(), 0);
    }
    assert_eq!(problems(&chip), []);
    assert_eq!(read(&mut chip, TIM12 + CCR4, Time::from_us(70_000)), 0);
    assert_eq!(problems(&chip), [Problem::Unmodelled], "it has two channels");
}

#[test]
fn every_timer_interrupts_on_its_own_line() {
    const RCC_APB2ENR: u32 = 0x4002_3844;
    for (timer, irq) in [
        (0x4001_0000, 25),
        (0x4000_0000, 28),
        (0x4000_0400, 29),
        (0x4000_0800, 30),
        (0x4000_0C00, 50),
        (0x4000_1000, 54),
        (0x4000_1400, 55),
        (0x4001_0400, 44),
        (0x4001_4000, 24),
        (0x4001_4400, 25),
        (0x4001_4800, 26),
        (0x4000_1800, 43),
        (0x4000_1C00, 44),
        (0x4000_2000, 45),
    ] {
        let mut chip = Chip::new(Part::Stm32f405, Clock { hz: 8_000_000, ppm: 0 }, [0; 12]);
        write(&mut chip, RCC_APB1ENR, 0x1FF, Time::ZERO);
        write(&mut chip, RCC_APB2ENR, 7 << 16 | 3, Time::ZERO);
        for (register, value) in [(ARR, 15), (DIER, 1), (CR1, 1)] {
            write(&mut chip, timer + register, value, Time::ZERO);
        }
        assert_eq!(chip.next_event(), Time::from_us(1), "{timer:#x}");
        chip.advance(Time::from_us(1));
        assert_eq!(chip.irqs(), 1 << irq, "{timer:#x}");
        assert_eq!(problems(&chip), []);
    }
}

#[test]
fn in_one_pulse_mode_a_timer_stops_at_its_overflow() {
    let mut chip = counting(TIM2);
    write(&mut chip, TIM2 + ARR, 99, Time::ZERO);
    write(&mut chip, TIM2 + CR1, 1 << 3 | 1, Time::ZERO);
    let after = Time::from_us(250);
    let [cr1, count, flags] =
        [CR1, CNT, SR].map(|register| read(&mut chip, TIM2 + register, after));
    assert_eq!((cr1, count, flags & 1), (1 << 3, 0, 1));
    assert_eq!(problems(&chip), []);
}

#[test]
fn uses_of_a_timer_that_are_not_modelled_are_found() {
    const CCMR1: u32 = 0x18;
    const DMAR: u32 = 0x4C;
    for (register, value) in
        [(CR1, 1 << 4), (0x04, 1), (0x08, 1), (DIER, 1 << 8), (CCMR1, 0x68), (0x20, 1), (DMAR, 0)]
    {
        let mut chip = counting(TIM2);
        write(&mut chip, TIM2 + register, value, Time::ZERO);
        assert_eq!(problems(&chip), [Problem::Unmodelled], "{register:#x}");
    }
    for (register, value) in [(PSC, 7), (ARR, 20)] {
        let mut chip = counting(TIM2);
        write(&mut chip, TIM2 + register, value, Time::from_us(50));
        assert!(matches!(problems(&chip)[..], [Problem::Misuse(_)]), "{register:#x}");
    }
    let mut chip = Chip::new(Part::Stm32f405, Clock { hz: 8_000_000, ppm: 0 }, [0; 12]);
    write(&mut chip, TIM2 + CR1, 1, Time::ZERO);
    assert_eq!(problems(&chip), [Problem::ClockOff]);
}
