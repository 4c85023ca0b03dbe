//! The connection of CAN1 to its transceiver through GPIO.

use emulator::{
    Time,
    can::{Adapter, Bus, Clock, Frame, Id, Level},
    chip::{Access, Chip, Part, Width},
};

const RCC_APB1RSTR: u32 = 0x4002_3820;
const RCC_AHB1ENR: u32 = 0x4002_3830;
const RCC_APB1ENR: u32 = 0x4002_3840;
const GPIOB: u32 = 0x4002_0400;
const CAN: u32 = 0x4000_6400;
/// PB9 (TX) and PB8 (RX) as alternate functions, and PB9 as output or input.
const BOTH: u32 = 0b1010 << 16;
const TX_IS_OUTPUT: u32 = 0b0110 << 16;
const TX_IS_INPUT: u32 = 0b0010 << 16;
/// 500 kbit/s on 16 MHz.
const BTR: u32 = 0x001C_0001;

struct PinRig {
    bus: Bus,
    chip: Chip,
    adapter: Adapter,
}

impl PinRig {
    /// A running chip with these pin modes, and an adapter.
    fn new(moder: u32, btr: u32) -> Self {
        Self::of(Part::Stm32f405, 9, moder, btr)
    }

    /// The same with another part and alternate function.
    fn of(part: Part, function: u32, moder: u32, btr: u32) -> Self {
        let chip = Chip::new(part, Clock { hz: 8_000_000, ppm: 0 }, [0; 12]);
        let mut rig = Self { bus: Bus::new(), chip, adapter: Adapter::new(500_000) };
        rig.write(RCC_AHB1ENR, 1 << 1);
        rig.write(RCC_APB1ENR, 1 << 25);
        rig.write(GPIOB + 0x24, function << 4 | function);
        rig.write(GPIOB, moder);
        rig.start(btr);
        rig
    }

    fn start(&mut self, btr: u32) {
        self.write(CAN, 1);
        self.write(CAN + 0x1C, btr);
        self.write(CAN, 0);
        self.run(Time::from_ms(1));
    }

    fn write(&mut self, address: u32, value: u32) {
        let now = self.bus.now();
        let access = Access { address, width: Width::Word, now, pc: 0x0800_0000 };
        self.chip.write(access, value).expect("no bus error");
    }

    fn run(&mut self, span: Time) {
        let until = self.bus.now() + span;
        let stations: &mut [&mut dyn emulator::can::Station] =
            &mut [self.chip.can_mut(1), &mut self.adapter];
        while self.bus.advance(until, stations, &mut |_, _, _| {}) < until {}
    }

    /// Whether the adapter receives an acknowledge.
    fn is_heard(&mut self) -> bool {
        self.adapter.open();
        self.adapter.send(Frame::data(Id::Standard(0x123), &[1]));
        self.run(Time::from_ms(1));
        self.adapter.unsent() == 0
    }
}

#[test]
fn pb8_and_pb9_carry_can1_by_function_8_on_parts_of_100_mhz_else_by_9() {
    for part in Part::ALL {
        let is_slow = part.clock_limits().0 == 100_000_000;
        for function in [8, 9] {
            let mut rig = PinRig::of(part, function, BOTH, BTR);
            assert_eq!(rig.is_heard(), is_slow == (function == 8), "{part:?}, AF{function}");
        }
    }
}

#[test]
fn a_chip_acknowledges_only_by_a_pin_in_its_alternate_function() {
    let mut rig = PinRig::new(BOTH, BTR);
    assert!(rig.is_heard());
    for moder in [TX_IS_OUTPUT, TX_IS_INPUT] {
        rig.write(GPIOB, moder);
        assert!(!rig.is_heard());
        rig.write(GPIOB, BOTH);
        rig.run(Time::from_ms(30));
        assert!(rig.is_heard());
    }
}

#[test]
fn no_chip_joins_the_bus_without_a_receive_pin() {
    let mut rig = PinRig::new(0b1000 << 16, BTR);
    assert!(!rig.is_heard());
    rig.write(GPIOB, BOTH);
    rig.adapter.close();
    rig.run(Time::from_ms(1));
    assert!(rig.is_heard());
}

#[test]
fn a_chip_that_only_listens_needs_no_pin_to_transmit() {
    let mut rig = PinRig::new(TX_IS_OUTPUT, 1 << 31 | BTR);
    rig.is_heard();
    assert_eq!(rig.chip.findings(), []);
    let rig = PinRig::new(TX_IS_OUTPUT, BTR);
    assert_eq!(rig.chip.findings().len(), 1);
}

#[test]
fn a_locked_transmit_pin_reaches_the_bus_only_in_its_alternate_function() {
    use emulator::can::bxcan::{Readings, TransmitLock};
    let mut rig = PinRig::new(TX_IS_OUTPUT, BTR);
    let transmit_lock = Some(TransmitLock { every: 1, frame: 1 });
    rig.chip.can_mut(1).set_readings(Readings { transmit_lock, ..Readings::default() });
    rig.write(RCC_APB1RSTR, 1 << 25);
    rig.write(RCC_APB1RSTR, 0);
    rig.start(1 << 31 | BTR);
    rig.is_heard();
    rig.adapter.close();
    rig.run(Time::from_ms(1));
    assert_eq!(rig.bus.level(), Level::Recessive);
    rig.write(GPIOB, BOTH);
    rig.run(Time::from_us(1));
    assert_eq!(rig.bus.level(), Level::Dominant);
    rig.write(GPIOB, TX_IS_INPUT);
    rig.run(Time::from_us(1));
    assert_eq!(rig.bus.level(), Level::Recessive);
}
