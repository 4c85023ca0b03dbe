//! The stack of the release image: its depth, an upper bound of it, and that an overflow reaches no variable.
//!
//! `cargo test --test image stack -- --nocapture` prints the depths and the bound.

use emulator::{
    chip::{FLASH_BASE, RAM_BASE},
    image::Image,
};
use testkit::{image::build_elf, stack, stack_bound::Bound};

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

/// The bound of the stack, and the image.
fn bound(package: &str, part: Part) -> (Bound, Image) {
    let elf = build_elf(package, part).unwrap_or_else(|error| panic!("{error}"));
    let bound = Bound::of(&elf).unwrap_or_else(|error| panic!("{error}"));
    (bound, Image::from_elf(&elf).expect("an image"))
}

#[test]
fn the_stack_suffices_for_every_path_through_the_program() {
    for (package, part) in [("firmware", Part::Stm32f405), ("example-io", Part::Stm32f407)] {
        let (bound, image) = bound(package, part);
        println!("{package}\n{bound}");
        for handler in ["Reset", "HardFault", "NonMaskableInt", "TIM2", "CAN1_RX0", "USART1"] {
            let is_there = bound.levels.iter().any(|(name, _)| name == handler);
            assert!(is_there, "{handler}:\n{bound}");
        }
        let size = stack::stack(&image).len();
        assert!(bound.bytes() as usize <= size, "{} of {size} bytes", bound.bytes());
    }
}

/// `push {r0-r7}` and a jump back to it.
const PUSH_FOR_EVER: [u8; 4] = [0xFF, 0xB4, 0xFD, 0xE7];

#[test]
fn a_stack_overflow_is_logged_reaches_no_variable_and_ends_in_a_reset() {
    // By priority, the highest first; and a chip on which nothing faults below the RAM.
    for (handler, most_ms, no_fault_below_ram) in
        [("TIM2", 60, false), ("CAN1_RX0", 600, false), ("USART1", 600, false), ("TIM2", 60, true)]
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
        let reset_at = reset_by(&mut rig, code(handler), &PUSH_FOR_EVER, ResetCause::Software);
        assert!(reset_at < from + Time::from_ms(most_ms), "{handler}: {}", reset_at - from);
        assert!(memory(&rig) == before, "{handler}");
        rig.boot(0, reset_at);
        assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"], "{handler}");
        assert!(rig.has_logged("stack overflow, resetting"), "{handler}");
    }
}

/// Prints the depth of the stack since the last call.
fn note(rig: &mut ImageRig, bound: usize, what: &str) {
    let depth = stack::deepest(rig.network.board(0), image());
    println!("{depth:5} of {} bytes: {what}", stack::stack(image()).len());
    assert!((100..=MOST).contains(&depth), "{what}: {depth} bytes");
    assert!(depth <= bound, "{what}: {depth} bytes, more than the bound of {bound}");
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
    let (bound, _) = bound("firmware", Part::Stm32f405);
    let bound = bound.bytes() as usize;
    let mut random = Random::from_environment();
    let rate = BitRate::Kbit1000;
    // Nearly full: the boot moves to the other sector.
    let stores: Vec<_> = (0..385).map(|n| settings(n as u8 % 100 + 1, rate)).collect();
    let last = settings(0x40, rate).with_heartbeat_ms(5);
    let mut board = board_with_flash(&flash_with(&[&stores[..], &[last]].concat()));
    stack::paint(&mut board, image());
    let mut rig = ImageRig::new(rate, [board]);
    note(&mut rig, bound, "a boot that erases");

    rig.lss("04 01, 5A, 5B, 5C, 5D, 5E, 11 41, 11 80, 13 00 02, 13 00 05");
    rig.lss("46, 47, 48, 49, 4A, 4B, 4C, 51");
    note(&mut rig, bound, "LSS");
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
    note(&mut rig, bound, "SDO");
    rig.lss("17");
    note(&mut rig, bound, "a store");
    rig.lss("13 00 00, 15 05 00");
    rig.collect(Time::from_ms(15));
    note(&mut rig, bound, "a switch of the bit rate");
    rig.lss("11 40, 17");
    rig.network.allow_reset(0, ResetCause::Software);
    rig.nmt("81 00");
    rig.collect(Time::from_ms(20));
    note(&mut rig, bound, "a reset of the node");
    storm(&mut rig, &mut random);
    note(&mut rig, bound, "storms of every interrupt");
    rig.lss("04 01");
    let answers = rig.lss("5A").0;
    assert!(answers.iter().any(|frame| frame.cob_id() == 0x7E4), "{answers:?}");
}
