//! The stack of the release image: its depth, and that an overflow reaches no variable.
//!
//! `cargo test --test image stack -- --nocapture` prints the depths.

use emulator::chip::{FLASH_BASE, RAM_BASE};
use testkit::stack;

use crate::rig::*;

/// The limit for the use of the stack: a quarter of it.
const MOST: usize = 4 * 1024;

fn symbol(name: &str) -> u32 {
    image().symbol(name).unwrap_or_else(|| panic!("no {name} in the image"))
}

#[test]
fn all_variables_lie_above_the_stack_and_nothing_lies_below_it() {
    let stack = stack::stack(image());
    assert_eq!(stack.start, RAM_BASE);
    assert!(stack.len() >= 4 * MOST, "{} bytes", stack.len());
    for section in ["__sdata", "__sbss", "__suninit"] {
        assert!(symbol(section) >= stack.end, "{section} begins at {:#x}", symbol(section));
    }
    let (_, vectors) =
        image().segments().find(|&(at, _)| at == FLASH_BASE).expect("a vector table");
    assert_eq!(vectors[..4], stack.end.to_le_bytes(), "the stack pointer out of a reset");
}

/// `push {lr}` and a call of it.
const CALL_FOR_EVER: [u8; 6] = [0x00, 0xB5, 0xFF, 0xF7, 0xFD, 0xFF];

#[test]
fn a_stack_overflow_is_logged_with_its_place_and_reaches_no_variable() {
    // By priority, the highest first; and a chip on which nothing faults below the RAM.
    for (handler, most_ms, no_fault_below_ram) in
        [("TIM2", 60, false), ("CAN1_RX0", 600, false), ("RCC", 600, false), ("TIM2", 60, true)]
    {
        let mut rig = node_40_on(ChipVariant { no_fault_below_ram, ..ChipVariant::default() });
        // The control block of the log above the stack, and the guard at its end.
        let memory = |rig: &ImageRig| {
            let (mut above, mut guard) = ([0; 16], [0; 1024]);
            assert!(rig.network.board(0).read_memory(symbol("_SEGGER_RTT"), &mut above));
            assert!(rig.network.board(0).read_memory(RAM_BASE, &mut guard));
            (above, guard)
        };
        let (before, from) = (memory(&rig), rig.network.now());
        let reset_at = reset_by(&mut rig, code(handler), &CALL_FOR_EVER, ResetCause::Software);
        assert!(reset_at < from + Time::from_ms(most_ms), "{handler}: {}", reset_at - from);
        assert!(memory(&rig) == before, "{handler}");
        rig.boot(0, reset_at);
        let behind_call = FLASH_BASE + code(handler) + CALL_FOR_EVER.len() as u32;
        let frames = rig.collect(Time::from_ms(20)).0;
        assert_eq!(frames[1].data()[..4], [0x00, 0x61, 1, 3], "{handler}");
        assert_eq!(frames[1].data()[4..], behind_call.to_le_bytes(), "{handler}");
        let line = format!("reset by a stack overflow below the call before {behind_call:#x}");
        assert!(rig.has_logged(&line), "{handler}");
    }
}

/// Prints the depth of the stack since the last call.
fn note(rig: &mut ImageRig, what: &str) {
    let depth = stack::deepest(rig.network.board(0), image());
    println!("{depth:5} of {} bytes: {what}", stack::stack(image()).len());
    assert!((100..=MOST).contains(&depth), "{what}: {depth} bytes");
    stack::paint(rig.network.board_mut(0), image());
}

/// Frames without a pause on a disturbed bus: every interrupt comes while others are served, and a slow flash is
/// written at the lowest priority.
fn storm(rig: &mut ImageRig, random: &mut Random) {
    let other = rig.network.add_adapter(Adapter::new(1_000_000));
    let disturber = rig.add_disturber();
    rig.network.board(0).chip().flash_mut().set_timing(Timing::Worst);
    for round in 0..150 {
        let requests = ["04 01", "11 40", "11 04", "17", "5E", "51", "47", "4C"];
        for _ in 0..40 {
            let request = random.pick(&requests);
            rig.queue(&testkit::frames::request(request));
            rig.queue(&sdo::request(0x40, "40 08 10 00"));
            let urgent = random.pick(&[0x001, 0x080, 0x640, 0x7E4]);
            rig.network.send(other, Frame::data(Id::Standard(urgent), &random.bytes::<8>()));
        }
        if round % 10 == 9 {
            rig.network.adapter_mut(disturber).open();
            rig.network.send(disturber, Frame::data(Id::Standard(0), &[0xA5; 8]));
            rig.network.run_for(Time::from_us(random.within(100..3_000)));
            rig.network.adapter_mut(disturber).close();
        }
        rig.network.run_for(Time::from_us(random.within(5_000..15_000)));
        rig.nmt(random.pick(&["01 00", "80 00", "82 00", "02 00"]));
    }
    rig.collect(Time::from_ms(500));
}

#[test]
fn the_stack_is_never_used_by_more_than_a_quarter() {
    let mut random = Random::from_environment();
    let rate = BitRate::Kbit1000;
    // The last one is in the other sector: the boot erases the first.
    let stores: Vec<_> = (0..398).map(|n| settings(n as u8 % 100 + 1, rate)).collect();
    let last = settings(0x40, rate).with_heartbeat_ms(5);
    let mut board = board_with_flash(&flash_with(&[&stores[..], &[last]].concat()));
    stack::paint(&mut board, image());
    let mut rig = ImageRig::new(rate, [board]);
    note(&mut rig, "a boot that erases");

    rig.lss("04 01, 5A, 5B, 5C, 5D, 5E, 11 41, 11 80, 13 00 02, 13 00 05");
    rig.lss("46, 47, 48, 49, 4A, 4B, 4C, 51");
    note(&mut rig, "LSS");
    let requests = [
        "40 08 10 00",
        "60 00",
        "70 00",
        "40 18 10 04",
        "2B 17 10 00 E8 03",
        "23 10 10 01 73 61 76 65",
    ];
    for request in requests {
        rig.transmit(on_the_wire(&sdo::request(0x40, request)));
        rig.collect(Time::from_ms(5));
    }
    note(&mut rig, "SDO");
    rig.lss("17");
    note(&mut rig, "a store");
    rig.lss("13 00 00, 15 05 00");
    rig.collect(Time::from_ms(15));
    note(&mut rig, "a switch of the bit rate");
    rig.lss("11 40, 17");
    rig.network.allow_reset(0, ResetCause::Software);
    rig.nmt("81 00");
    rig.collect(Time::from_ms(20));
    note(&mut rig, "a reset of the node");
    storm(&mut rig, &mut random);
    note(&mut rig, "storms of every interrupt");
    rig.lss("04 01");
    let answers = rig.lss("5A").0;
    assert!(answers.iter().any(|frame| frame.cob_id() == 0x7E4), "{answers:?}");
}
