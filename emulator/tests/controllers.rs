//! CAN1, CAN2 and CAN3 of a chip, each with an adapter on a bus of its own, and the pins that connect them.

use emulator::{
    Time,
    can::{
        Adapter, Bus, Clock, Frame, Id, Level, Station,
        bxcan::{CanVariant, TransmitLock},
    },
    chip::{Access, Chip, Part, Pin, Width},
};

const RCC_APB1RSTR: u32 = 0x4002_3820;
const RCC_AHB1ENR: u32 = 0x4002_3830;
const RCC_APB1ENR: u32 = 0x4002_3840;
const GPIOA: u32 = 0x4002_0000;
const GPIOB: u32 = 0x4002_0400;

/// CAN1, and the distance from each controller to the next.
const CAN: u32 = 0x4000_6400;
const CAN_DISTANCE: u32 = 0x400;
const MCR: u32 = 0x000;
const RF0R: u32 = 0x00C;
const IER: u32 = 0x014;
const BTR: u32 = 0x01C;
const TI0R: u32 = 0x180;
const FMR: u32 = 0x200;
const FM1R: u32 = 0x204;
const FS1R: u32 = 0x20C;
const FA1R: u32 = 0x21C;
const F0R1: u32 = 0x240;

const FINIT: u32 = 1;
/// 500 kbit/s on 16 MHz.
const HALF_MEGABIT: u32 = 0x001C_0001;
/// The distance in CAN2SB.
const CAN2SB: u32 = 8;

struct Rig {
    chip: Chip,
    buses: Vec<(Bus, Adapter)>,
}

impl Rig {
    /// A chip whose controllers have their clocks but no pins.
    fn new(part: Part) -> Self {
        let chip = Chip::new(part, Clock { hz: 8_000_000, ppm: 0 }, [0; 12]);
        let buses = (0..part.cans()).map(|_| (Bus::new(), Adapter::new(500_000))).collect();
        let mut rig = Self { chip, buses };
        rig.write(RCC_AHB1ENR, 0x1FF);
        rig.write(RCC_APB1ENR, ((1 << part.cans()) - 1) << 25);
        rig
    }

    /// A chip whose controllers take part in their buses, with their first pins.
    fn running(part: Part) -> Self {
        let mut rig = Self::new(part);
        for can in 0..part.cans() {
            part.can_pins(can)[0].into_iter().for_each(|(pin, function)| rig.assign(pin, function));
            rig.start(can, HALF_MEGABIT);
        }
        rig
    }

    /// A chip whose PB8 and PB9 have this alternate function and are in these modes, and whose CAN1 has started.
    fn with_pins(part: Part, function: u32, moder: u32, btr: u32) -> Self {
        let mut rig = Self::new(part);
        rig.write(GPIOB + 0x24, function << 4 | function);
        rig.write(GPIOB, moder);
        rig.start(0, btr);
        rig
    }

    fn now(&self) -> Time {
        self.buses[0].0.now()
    }

    fn access(&self, address: u32) -> Access {
        Access { address, width: Width::Word, now: self.now(), pc: 0x0800_0000 }
    }

    fn write(&mut self, address: u32, value: u32) {
        let access = self.access(address);
        self.chip.write(access, value).expect("no bus error");
    }

    fn read(&mut self, address: u32) -> u32 {
        let access = self.access(address);
        self.chip.read(access).expect("no bus error")
    }

    /// Selects the alternate function of a pin; `None` makes it an input.
    fn set_function(&mut self, Pin(port, number): Pin, function: Option<u32>) {
        let port = GPIOA + 0x400 * (port as u32 - 'A' as u32);
        let number = u32::from(number);
        let (register, shift) = (port + 0x20 + number / 8 * 4, number % 8 * 4);
        let old = self.read(register) & !(0xF << shift);
        self.write(register, old | function.unwrap_or(0) << shift);
        let old = self.read(port) & !(3 << (2 * number));
        self.write(port, old | if function.is_some() { 2 << (2 * number) } else { 0 });
    }

    fn assign(&mut self, pin: Pin, function: u32) {
        self.set_function(pin, Some(function));
    }

    fn start(&mut self, can: usize, btr: u32) {
        self.write(register(can, MCR), 1);
        self.write(register(can, BTR), btr);
        self.write(register(can, MCR), 0);
        self.run_us(1_000);
    }

    /// Resets controllers by their bits in RCC.
    fn reset(&mut self, bits: u32) {
        self.write(RCC_APB1RSTR, bits);
        self.write(RCC_APB1RSTR, 0);
    }

    fn run_us(&mut self, us: u64) {
        let until = self.now() + Time::from_us(us);
        for ((bus, adapter), can) in self.buses.iter_mut().zip(self.chip.cans_mut()) {
            let stations: &mut [&mut dyn Station] = &mut [&mut *can, adapter];
            while bus.advance(until, stations, &mut |_, _, _| {}) < until {}
            can.update_irq();
        }
    }

    /// Whether a controller acknowledges a frame on its bus.
    fn acknowledges(&mut self, can: usize) -> bool {
        self.send(can, 0x123);
        let is_sent = self.buses[can].1.unsent() == 0;
        self.buses[can].1.open();
        is_sent
    }

    fn send(&mut self, can: usize, id: u16) {
        self.buses[can].1.send(Frame::data(Id::Standard(id), &[]));
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
            self.send(can, *id);
            let is_received = self.read(register(can, RF0R)) & 3 == 1;
            self.write(register(can, RF0R), 1 << 5);
            is_received
        };
        ids.iter().copied().filter(passes).collect()
    }

    fn problems(&self) -> Vec<String> {
        self.chip.findings().iter().map(|finding| finding.problem.to_string()).collect()
    }
}

fn register(can: usize, offset: u32) -> u32 {
    CAN + CAN_DISTANCE * can as u32 + offset
}

/// Interrupts: a transmission completed, FIFO 0 has a message, FIFO 1 has one, error or wake-up (RM0430, 10.2).
const INTERRUPTS: [[u32; 4]; 3] = [[19, 20, 21, 22], [63, 64, 65, 66], [74, 75, 76, 77]];

#[test]
fn each_controller_has_its_own_clock_and_interrupts() {
    for part in Part::ALL {
        let mut rig = Rig::running(part);
        rig.set_filters(0, 14, &[(0, 0x100), (14, 0x100)]);
        if part.cans() == 3 {
            rig.set_filters(2, 14, &[(0, 0x100)]);
        }
        // CAN1 last: its reset takes the filters of CAN2.
        for can in (0..part.cans()).rev() {
            // Transmission, FIFO 0 and errors interrupt.
            rig.write(register(can, IER), 1 << 15 | 1 << 11 | 0b11);
            assert_eq!(rig.chip.irqs(), 0, "{part:?}");
            rig.write(register(can, TI0R), 0x200 << 21 | 1);
            rig.run_us(1_000);
            assert_eq!(rig.chip.irqs(), 1 << INTERRUPTS[can][0], "{part:?} CAN{}", can + 1);
            rig.send(can, 0x100);
            let both = 1 << INTERRUPTS[can][0] | 1 << INTERRUPTS[can][1];
            assert_eq!(rig.chip.irqs(), both, "{part:?} CAN{}", can + 1);
            rig.reset(1 << (25 + can));
            assert_eq!(rig.chip.irqs(), 0, "{part:?} CAN{}", can + 1);
        }
        assert_eq!(rig.problems(), [""; 0]);
        rig.write(RCC_APB1ENR, 0);
        for can in 0..part.cans() {
            rig.read(register(can, MCR));
        }
        assert_eq!(rig.problems().len(), part.cans());
    }
}

#[test]
fn only_the_f413_and_the_f423_have_can3() {
    for part in Part::ALL {
        let mut rig = Rig::new(part);
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
                let mut rig = Rig::new(part);
                for &(pin, function) in [receive, transmit] {
                    rig.assign(pin, function);
                }
                rig.start(can, HALF_MEGABIT);
                assert!(rig.acknowledges(can), "{part:?} CAN{} {receive:?} {transmit:?}", can + 1);
                for pin in [receive, transmit] {
                    rig.set_function(pin.0, None);
                    assert!(!rig.acknowledges(can), "{part:?} CAN{} without {pin:?}", can + 1);
                    rig.assign(pin.0, pin.1);
                    rig.run_us(1_000);
                }
            }
            let mut rig = Rig::new(part);
            for &(pin, function) in all.iter().filter(|pin| !pins.as_flattened().contains(pin)) {
                rig.assign(pin, function);
            }
            rig.start(can, HALF_MEGABIT);
            assert!(!rig.acknowledges(can), "{part:?} CAN{} through others' pins", can + 1);
        }
    }
}

const IDS: [u16; 3] = [0x100, 0x200, 0x300];

#[test]
fn can2sb_divides_the_banks_between_can1_and_can2() {
    let mut rig = Rig::running(Part::Stm32f405);
    let banks = [(0, 0x100), (13, 0x200), (27, 0x300)];
    for (can2sb, of_can1) in [(0, 0), (1, 1), (13, 1), (14, 2), (27, 2), (28, 3), (63, 3)] {
        rig.set_filters(0, can2sb, &banks);
        assert_eq!(rig.passed(0, &IDS), IDS[..of_can1], "CAN2SB {can2sb}");
        assert_eq!(rig.passed(1, &IDS), IDS[of_can1..], "CAN2SB {can2sb}");
    }
    assert_eq!(rig.problems(), [""; 0]);
}

#[test]
fn can2_receives_nothing_while_can1_sets_its_filters_up() {
    let mut rig = Rig::running(Part::Stm32f413);
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
    let mut rig = Rig::running(Part::Stm32f405);
    for offset in [FMR, FM1R, FS1R, FA1R, F0R1, F0R1 + 8 * 27] {
        let before = rig.problems().len();
        rig.write(register(1, offset), 0);
        assert_eq!(rig.read(register(1, offset)), 0);
        assert_eq!(rig.problems().len(), before + 2, "{offset:#x}");
    }
}

#[test]
fn can3_has_14_banks_of_its_own_whatever_can2sb_says() {
    let mut rig = Rig::running(Part::Stm32f423);
    rig.set_filters(0, 14, &[(0, 0x200), (14, 0x200)]);
    rig.set_filters(2, 3, &[(0, 0x100), (13, 0x300)]);
    assert_eq!(rig.passed(0, &IDS), [0x200]);
    assert_eq!(rig.passed(1, &IDS), [0x200]);
    assert_eq!(rig.passed(2, &IDS), [0x100, 0x300]);
    assert_eq!(rig.problems(), [""; 0]);
    rig.write(register(2, F0R1 + 8 * 14), 0);
    rig.write(register(2, FA1R), 1 << 14);
    assert_eq!(rig.problems().len(), 2, "there is no bank 14");
}

#[test]
fn a_reset_of_can1_takes_the_filters_of_can2_and_its_own_does_not() {
    let mut rig = Rig::running(Part::Stm32f405);
    rig.set_filters(0, 14, &[(14, 0x100)]);
    rig.reset(1 << 26);
    rig.start(1, HALF_MEGABIT);
    assert_eq!(rig.passed(1, &IDS), [0x100]);
    rig.reset(1 << 25);
    assert_eq!(rig.passed(1, &IDS), IDS[..0]);
}

#[test]
fn can2_that_starts_without_the_clock_of_can1_is_found() {
    let mut rig = Rig::running(Part::Stm32f405);
    rig.write(RCC_APB1ENR, 1 << 26);
    rig.start(1, HALF_MEGABIT);
    assert_eq!(
        rig.problems(),
        ["CAN2 leaves initialisation while CAN1, which has its memory, has no clock"]
    );
}

/// PB9 (TX) and PB8 (RX) as alternate functions, and PB9 as output or input.
const BOTH: u32 = 0b1010 << 16;
const TX_IS_OUTPUT: u32 = 0b0110 << 16;
const TX_IS_INPUT: u32 = 0b0010 << 16;
const SILENT: u32 = 1 << 31;

#[test]
fn pb8_and_pb9_carry_can1_by_function_8_on_parts_of_100_mhz_else_by_9() {
    for part in Part::ALL {
        let is_slow = part.clock_limits().0 == 100_000_000;
        for function in [8, 9] {
            let mut rig = Rig::with_pins(part, function, BOTH, HALF_MEGABIT);
            assert_eq!(rig.acknowledges(0), is_slow == (function == 8), "{part:?}, AF{function}");
        }
    }
}

#[test]
fn a_chip_acknowledges_only_by_a_pin_in_its_alternate_function() {
    let mut rig = Rig::with_pins(Part::Stm32f405, 9, BOTH, HALF_MEGABIT);
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
    let mut rig = Rig::with_pins(Part::Stm32f405, 9, 0b1000 << 16, HALF_MEGABIT);
    assert!(!rig.acknowledges(0));
    rig.write(GPIOB, BOTH);
    rig.run_us(1_000);
    assert!(rig.acknowledges(0));
}

#[test]
fn a_chip_that_only_listens_needs_no_pin_to_transmit() {
    const NO_PINS: &str =
        "a CAN controller leaves initialisation with no pins in its alternate function";
    for (silence, problems) in [(SILENT, vec![]), (0, vec![NO_PINS])] {
        let mut rig = Rig::with_pins(Part::Stm32f405, 9, TX_IS_OUTPUT, silence | HALF_MEGABIT);
        rig.acknowledges(0);
        assert_eq!(rig.problems(), problems);
    }
}

#[test]
fn a_locked_transmit_pin_reaches_the_bus_only_in_its_alternate_function() {
    let mut rig = Rig::with_pins(Part::Stm32f405, 9, TX_IS_OUTPUT, HALF_MEGABIT);
    let transmit_lock = Some(TransmitLock { every: 1, frame: 1 });
    rig.chip.can_mut(1).set_variant(CanVariant { transmit_lock, ..CanVariant::default() });
    rig.reset(1 << 25);
    rig.start(0, SILENT | HALF_MEGABIT);
    rig.send(0, 0x123);
    rig.buses[0].1.close();
    for (moder, level) in
        [(TX_IS_OUTPUT, Level::Recessive), (BOTH, Level::Dominant), (TX_IS_INPUT, Level::Recessive)]
    {
        rig.write(GPIOB, moder);
        rig.run_us(1_000);
        assert_eq!(rig.buses[0].0.level(), level, "{moder:#x}");
    }
}
