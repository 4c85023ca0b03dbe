//! The blocks of a download at each bit rate: how many segments the loader asks for, and when it answers.

use canopen_node::{BitRate, Frame};
use emulator::{Time, can::Id, chip::Timing};
use testkit::image_rig::{ImageRig, settings};

use super::rig::{NODE, Rig, board_of, file};

/// A board at this bit rate with the slowest flash, which clears.
fn clearing(rate: BitRate) -> Rig {
    let board = board_of(&file("0.1.0"), settings(NODE, rate));
    board.chip().flash_mut().set_timing(Timing::Worst);
    let mut rig = Rig(ImageRig::new(rate, [board]), Time::from_s(2));
    rig.0.network.permit_misuse();
    rig.0.collect(Time::from_ms(100));
    assert!(rig.try_control(0).unwrap());
    assert!(rig.try_control(3).unwrap());
    rig
}

#[test]
fn a_block_takes_at_most_85_ms_at_each_bit_rate_and_is_no_shorter_than_needed() {
    for rate in BitRate::ALL {
        let mut rig = clearing(rate);
        let begun = rig.ask([0xC2, 0x50, 0x1F, 1, 0, 0, 1, 0]).unwrap();
        assert_eq!(begun[0], 0xA4);
        let size = begun[4];
        let from = rig.0.network.now();
        for number in 1..=size {
            // Each byte has stuff bits.
            let segment = [number, 0, 0, 0, 0, 0, 0, 0];
            rig.0.queue(&Frame::new(0x600 + u16::from(NODE), &segment).expect("eight bytes"));
        }
        rig.0.send_all();
        let segments = rig.0.sent(from).filter(|sent| sent.frame.id == Id::Standard(0x605));
        let end = segments.map(|sent| sent.end).max().expect("segments");
        let time = end - from;
        println!("{} kbit/s: {size} segments, {} us", rate.kbit_per_s(), time.as_ps() / 1_000_000);
        assert!(time <= Time::from_ms(85), "{} kbit/s", rate.kbit_per_s());
        assert!(size == 127 || time > Time::from_ms(60), "{} kbit/s", rate.kbit_per_s());
    }
}

/// A client of Lely waits for 100 ms from the begin of a block.
#[test]
fn each_block_has_its_answer_within_100_ms_while_the_slowest_flash_is_behind() {
    for rate in [BitRate::Kbit125, BitRate::Kbit500] {
        let mut rig = clearing(rate);
        rig.1 = Time::from_ms(100);
        // It is behind at first, and keeps up behind the clear. The end is refused: it is only a part.
        assert!(!rig.try_download(&file("0.2.0")[..12_000]).unwrap());
    }
}
