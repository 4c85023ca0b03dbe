//! CAN1, CAN2 and CAN3 of a chip, each with an adapter on a bus of its own, and the pins that connect them.

use emulator::{
    Time,
    can::{
        Level,
        bxcan::{CanVariant, TransmitLock},
    },
    chip::{Part, Problem},
};

use crate::rig::{
    BTR, F0R1, FA1R, FM1R, FMR, FS1R, GPIOB, MCR, MEGABIT, RCC_APB1ENR, RF0R, Rig, SILENT, standard,
};

const FINIT: u32 = 1;
/// The distance in CAN2SB.
const CAN2SB: u32 = 8;

/// A chip whose controllers take part in their buses, with their first pins.
fn running(part: Part) -> Rig {
    let mut rig = Rig::asleep(part);
    (0..part.cans()).for_each(|can| rig.start(can, MEGABIT));
    rig
}

/// A chip whose PB8 and PB9 have this alternate function and are in these modes, and whose CAN1 has started.
fn with_pins(part: Part, function: u32, moder: u32, btr: u32) -> Rig {
    let mut rig = Rig::clocked(part);
    rig.write_all(&[(GPIOB + 0x24, function << 4 | function), (GPIOB, moder)]);
    rig.start(0, btr);
    rig
}

impl Rig {
    fn start(&mut self, can: usize, btr: u32) {
        for (offset, value) in [(MCR, 1), (BTR, btr), (MCR, 0)] {
            self.write(register(can, offset), value);
        }
        self.run_us(1_000);
    }

    /// Whether a controller acknowledges a frame on its bus.
    fn acknowledges(&mut self, can: usize) -> bool {
        self.send_to(can, 0x123);
        let is_sent = self.buses[can].1.unsent() == 0;
        self.buses[can].1.open();
        is_sent
    }

    fn send_to(&mut self, can: usize, id: u16) {
        self.buses[can].1.send(standard(id, &[]));
        self.run_us(1_000);
    }

    /// Activates only these banks of the filter registers of a controller, each for one standard identifier.
    fn set_filters(&mut self, can: usize, can2sb: u32, banks: &[(u32, u32)]) {
        let active = banks.iter().fold(0, |bits, (bank, _)| bits | 1 << bank);
        self.write(register(can, FMR), can2sb << CAN2SB | FINIT);
        self.write(register(can, FM1R), active);
        self.write(register(can, FS1R), active);
        self.write(register(can, FA1R), active);
        for (bank, id) in banks {
            for word in 0..2 {
                self.write(register(can, F0R1 + 8 * bank + 4 * word), id << 21);
            }
        }
        self.write(register(can, FMR), can2sb << CAN2SB);
    }

    /// The frames of these identifiers that pass the filters of a controller.
    fn passed(&mut self, can: usize, ids: &[u16]) -> Vec<u16> {
        let passes = |id: &u16| {
            self.send_to(can, *id);
            let is_received = self.read(register(can, RF0R)) & 3 == 1;
            self.write(register(can, RF0R), 1 << 5);
            is_received
        };
        ids.iter().copied().filter(passes).collect()
    }
}

/// The register of a controller that corresponds to one of CAN1.
fn register(can: usize, of_can1: u32) -> u32 {
    of_can1 + 0x400 * can as u32
}

#[test]
fn only_the_f413_and_the_f423_have_can3() {
    for part in Part::F4 {
        let mut rig = Rig::clocked(part);
        rig.write(RCC_APB1ENR, 7 << 25);
        assert_eq!(rig.read(register(2, MCR)) != 0, part.manual() == "RM0430", "{part:?}");
        assert_eq!(rig.problems().is_empty(), part.manual() == "RM0430", "{part:?}");
    }
}

#[test]
fn a_controller_takes_part_through_each_of_its_pins_and_no_other() {
    for part in [Part::Stm32f405, Part::Stm32f412, Part::Stm32f413, Part::Stm32f446] {
        let all = (0..part.cans()).flat_map(|can| part.can_pins(can));
        let all: Vec<_> = all.flatten().copied().collect();
        for can in 0..part.cans() {
            let pins = part.can_pins(can);
            for [receive, transmit] in pins
                .iter()
                .map(|[rx, _]| [rx, &pins[0][1]])
                .chain(pins.iter().map(|[_, tx]| [&pins[0][0], tx]))
            {
                let mut rig = Rig::clocked(part);
                for &(pin, function) in [receive, transmit] {
                    rig.assign(pin, function);
                }
                rig.start(can, MEGABIT);
                assert!(rig.acknowledges(can), "{part:?} CAN{} {receive:?} {transmit:?}", can + 1);
                for pin in [receive, transmit] {
                    rig.set_function(pin.0, None);
                    assert!(!rig.acknowledges(can), "{part:?} CAN{} without {pin:?}", can + 1);
                    rig.assign(pin.0, pin.1);
                    rig.run_us(1_000);
                }
            }
            let mut rig = Rig::clocked(part);
            for &(pin, function) in all.iter().filter(|pin| !pins.as_flattened().contains(pin)) {
                rig.assign(pin, function);
            }
            rig.start(can, MEGABIT);
            assert!(!rig.acknowledges(can), "{part:?} CAN{} through others' pins", can + 1);
        }
    }
}

const IDS: [u16; 3] = [0x100, 0x200, 0x300];

#[test]
fn can2sb_divides_the_banks_between_can1_and_can2() {
    let mut rig = running(Part::Stm32f405);
    let banks = [(0, 0x100), (13, 0x200), (27, 0x300)];
    for (can2sb, of_can1) in [(0, 0), (1, 1), (13, 1), (14, 2), (27, 2), (28, 3), (63, 3)] {
        rig.set_filters(0, can2sb, &banks);
        assert_eq!(rig.passed(0, &IDS), IDS[..of_can1], "CAN2SB {can2sb}");
        assert_eq!(rig.passed(1, &IDS), IDS[of_can1..], "CAN2SB {can2sb}");
    }
    assert_eq!(rig.problems(), []);
}

#[test]
fn can2_receives_nothing_while_can1_sets_its_filters_up() {
    let mut rig = running(Part::Stm32f413);
    rig.set_filters(0, 0, &[(5, 0x100)]);
    rig.set_filters(2, 14, &[(5, 0x100)]);
    rig.write(register(0, FMR), FINIT);
    assert_eq!(rig.passed(1, &IDS), IDS[..0]);
    assert_eq!(rig.passed(2, &IDS), [0x100], "CAN3 stands alone");
    rig.write(register(0, FMR), 0);
    assert_eq!(rig.passed(1, &IDS), [0x100]);
}

#[test]
fn can2_has_no_filter_registers() {
    let mut rig = running(Part::Stm32f405);
    for offset in [FMR, FM1R, FS1R, FA1R, F0R1, F0R1 + 8 * 27] {
        let before = rig.problems().len();
        rig.write(register(1, offset), 0);
        assert_eq!(rig.read(register(1, offset)), 0);
        assert_eq!(rig.problems().len(), before + 2, "{offset:#x}");
    }
}

#[test]
fn can3_has_14_banks_of_its_own_whatever_can2sb_says() {
    let mut rig = running(Part::Stm32f423);
    rig.set_filters(0, 14, &[(0, 0x200), (14, 0x200)]);
    rig.set_filters(2, 3, &[(0, 0x100), (13, 0x300)]);
    assert_eq!(rig.passed(0, &IDS), [0x200]);
    assert_eq!(rig.passed(1, &IDS), [0x200]);
    assert_eq!(rig.passed(2, &IDS), [0x100, 0x300]);
    assert_eq!(rig.problems(), []);
    rig.write_all(&[(register(2, F0R1 + 8 * 14), 0), (register(2, FA1R), 1 << 14)]);
    assert_eq!(rig.problems().len(), 2, "there is no bank 14");
}

#[test]
fn a_reset_of_can1_takes_the_filters_of_can2_and_its_own_does_not() {
    let mut rig = running(Part::Stm32f405);
    rig.set_filters(0, 14, &[(14, 0x100)]);
    rig.reset_by_rcc(1 << 26);
    rig.start(1, MEGABIT);
    assert_eq!(rig.passed(1, &IDS), [0x100]);
    rig.reset_by_rcc(1 << 25);
    assert_eq!(rig.passed(1, &IDS), IDS[..0]);
}

#[test]
fn can2_that_starts_without_the_clock_of_can1_is_found() {
    let mut rig = running(Part::Stm32f405);
    rig.write(RCC_APB1ENR, 1 << 26);
    rig.start(1, MEGABIT);
    assert_eq!(
        rig.problems(),
        [Problem::Misuse(
            "CAN2 leaves initialisation while CAN1, which has its memory, has no clock"
        )]
    );
}

/// PB9 (TX) and PB8 (RX) as alternate functions, and PB9 as output or input.
const BOTH: u32 = 0b1010 << 16;
const TX_IS_OUTPUT: u32 = 0b0110 << 16;
const TX_IS_INPUT: u32 = 0b0010 << 16;

#[test]
fn pb8_and_pb9_carry_can1_by_function_8_on_parts_of_100_mhz_else_by_9() {
    for part in Part::F4 {
        let is_slow = part.clock_limits().0 == 100_000_000;
        for function in [8, 9] {
            let mut rig = with_pins(part, function, BOTH, MEGABIT);
            assert_eq!(rig.acknowledges(0), is_slow == (function == 8), "{part:?}, AF{function}");
        }
    }
}

#[test]
fn a_chip_acknowledges_only_by_a_pin_in_its_alternate_function() {
    let mut rig = with_pins(Part::Stm32f405, 9, BOTH, MEGABIT);
    assert!(rig.acknowledges(0));
    for moder in [TX_IS_OUTPUT, TX_IS_INPUT] {
        rig.write(GPIOB, moder);
        assert!(!rig.acknowledges(0));
        rig.write(GPIOB, BOTH);
        rig.run_us(30_000);
        assert!(rig.acknowledges(0));
    }
}

#[test]
fn no_chip_joins_the_bus_without_a_receive_pin() {
    let mut rig = with_pins(Part::Stm32f405, 9, 0b1000 << 16, MEGABIT);
    assert!(!rig.acknowledges(0));
    rig.write(GPIOB, BOTH);
    rig.run_us(1_000);
    assert!(rig.acknowledges(0));
}

#[test]
fn a_chip_that_only_listens_needs_no_pin_to_transmit() {
    const NO_PINS: Problem = Problem::Misuse(
        "a CAN controller leaves initialisation with no pins in its alternate function",
    );
    for (silence, problems) in [(SILENT, vec![]), (0, vec![NO_PINS])] {
        let mut rig = with_pins(Part::Stm32f405, 9, TX_IS_OUTPUT, silence | MEGABIT);
        rig.acknowledges(0);
        assert_eq!(rig.problems(), problems);
    }
}

#[test]
fn a_locked_transmit_pin_reaches_the_bus_only_in_its_alternate_function() {
    let mut rig = with_pins(Part::Stm32f405, 9, TX_IS_OUTPUT, MEGABIT);
    let transmit_lock = Some(TransmitLock { every: 1, frame: 1 });
    rig.can_mut(1).set_variant(CanVariant { transmit_lock, ..CanVariant::default() });
    rig.reset_by_rcc(1 << 25);
    rig.start(0, SILENT | MEGABIT);
    rig.send_to(0, 0x123);
    rig.buses[0].1.close();
    for (moder, level) in
        [(TX_IS_OUTPUT, Level::Recessive), (BOTH, Level::Dominant), (TX_IS_INPUT, Level::Recessive)]
    {
        rig.write(GPIOB, moder);
        rig.run_us(1_000);
        assert_eq!(rig.buses[0].0.level(), level, "{moder:#x}");
    }
}

#[test]
fn a_transmit_pin_that_is_a_low_output_holds_the_wire_dominant_until_the_time_out() {
    const ODR: u32 = GPIOB + 0x14;
    let mut rig = with_pins(Part::Stm32f405, 9, BOTH, MEGABIT);
    rig.cans_mut()[0].controller().set_dominant_time_out(Some(Time::from_us(300)));
    assert!(rig.acknowledges(0));
    let mut is_dominant = |moder, odr, us| {
        rig.write_all(&[(ODR, odr), (GPIOB, moder)]);
        rig.run_us(us);
        rig.buses[0].0.level() == Level::Dominant
    };
    assert!(!is_dominant(TX_IS_OUTPUT, 1 << 9, 10));
    assert!(is_dominant(TX_IS_OUTPUT, 0, 10));
    assert!(is_dominant(TX_IS_OUTPUT, 0, 280));
    assert!(!is_dominant(TX_IS_OUTPUT, 0, 20));
    assert!(!is_dominant(TX_IS_INPUT, 0, 10), "an input");
    assert!(is_dominant(TX_IS_OUTPUT, 0, 10), "again");
}
