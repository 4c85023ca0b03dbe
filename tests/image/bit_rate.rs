//! A release image at the wrong bit rate, or set to detect it: it finds the rate of the bus with little disturbance.

use canopen_node::{BitRate, BitRateSetting, Settings};
use emulator::{
    Time,
    can::{Adapter, Frame, Id},
    network::{AdapterId, Source, What},
};
use testkit::frames::{self, SILENCE};

use crate::rig::{ImageRig, bit_per_s, board_with, rig_with, settings};

/// Two other nodes that exchange a frame every 10 ms for a duration.
pub fn talk(rig: &mut ImageRig, others: [AdapterId; 2], span: Time) {
    let until = rig.network.now() + span;
    while rig.network.now() < until {
        for (adapter, cob_id) in others.into_iter().zip([0x181, 0x182]) {
            rig.network.send(adapter, Frame::data(Id::Standard(cob_id), &[0x5A; 8]));
        }
        rig.network.run_for(Time::from_ms(40));
    }
}

pub fn others(rig: &mut ImageRig, bit_rate: BitRate) -> [AdapterId; 2] {
    [(); 2].map(|()| rig.network.add_adapter(Adapter::new(bit_per_s(bit_rate))))
}

fn automatic() -> Settings {
    settings(0x40, BitRate::Kbit1000).with_bit_rate(BitRateSetting::Automatic)
}

/// Makes the master repeat a frame, as CAN controllers do, until another node acknowledges it.
pub fn wait_until_acknowledged(rig: &mut ImageRig) {
    let from = rig.network.now();
    rig.queue(&frames::request("04 00"));
    while rig.network.adapter_mut(rig.master).unsent() > 0 {
        assert!(rig.network.now() < from + Time::from_s(10), "no acknowledge");
        rig.network.run_for(Time::from_ms(1));
    }
    println!("{} ms at {} ms a bit", rig.network.now() - from, rig.bit_time());
    rig.collect(Time::from_ms(200));
}

/// Whether node 40 answers the master, once it is in configuration state.
pub fn answers(rig: &mut ImageRig) -> bool {
    rig.lss("04 01");
    let answers = rig.lss("5E");
    answers.0.iter().any(|frame| frames::text(frame).starts_with("7E4: 5E 40"))
}

#[test]
fn a_board_detects_each_bit_rate_without_an_error_frame() {
    for bit_rate in BitRate::ALL {
        let mut rig = ImageRig::new(bit_rate, [board_with(0, automatic())]);
        let others = others(&mut rig, bit_rate);
        talk(&mut rig, others, Time::from_s(3));
        assert!(answers(&mut rig), "{bit_rate:?}");
        let is_by_board = |event: &&emulator::network::Event| {
            event.source == Source::Board(0) && matches!(event.what, What::Error { .. })
        };
        let errors: Vec<_> = rig.network.trace().iter().filter(is_by_board).collect();
        assert!(errors.is_empty(), "{bit_rate:?}: {errors:#?}");
    }
}

#[test]
fn a_board_that_detects_the_bit_rate_finds_that_of_a_master_that_is_alone() {
    for bit_rate in BitRate::ALL {
        let mut rig = ImageRig::new(bit_rate, [board_with(0, automatic())]);
        wait_until_acknowledged(&mut rig);
        assert!(answers(&mut rig), "{bit_rate:?}");
    }
}

#[test]
fn automatic_detection_can_be_configured_stored_and_taken_back() {
    let mut rig = rig_with(settings(0x40, BitRate::Kbit1000));
    rig.collect(Time::from_ms(20));
    rig.lss("04 01");
    assert_eq!(rig.lss("13 00 09"), ["13 00"]);
    assert_eq!(rig.lss("17"), ["17 00"]);
    rig.network.power_off(0);
    rig.set_master_bit_rate(BitRate::Kbit250);
    let others = others(&mut rig, BitRate::Kbit250);
    rig.power_on(0);
    assert_eq!(rig.collect(Time::from_s(2)), SILENCE, "the bus is silent");
    talk(&mut rig, others, Time::from_s(3));
    rig.collect(Time::from_ms(100));
    assert!(answers(&mut rig));
    assert_eq!(rig.lss("13 00 02"), ["13 00"]);
    assert_eq!(rig.lss("17"), ["17 00"]);
    for other in others {
        rig.network.adapter_mut(other).close();
    }
    rig.set_master_bit_rate(BitRate::Kbit500);
    rig.power_cycle(0);
    assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"]);
}
