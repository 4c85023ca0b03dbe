//! The share of time in which the core sleeps: it is woken only by frames on the bus and by due actions.

use crate::rig::*;

/// The share of time asleep while `act` lasts, in thousandths of a percent.
fn share_asleep(rig: &mut ImageRig, what: &str, act: impl FnOnce(&mut ImageRig)) -> u64 {
    let (cycles_before, busy_before) = rig.network.board(0).cycles();
    act(rig);
    let (cycles, busy) = rig.network.board(0).cycles();
    let share = 100_000 - (busy - busy_before) * 100_000 / (cycles - cycles_before);
    println!("{what:40} asleep for {:3}.{:03} % of the time", share / 1000, share % 1000);
    share
}

/// Node 40 with a heartbeat each second, after its boot-up.
fn node_40(bit_rate: BitRate) -> ImageRig {
    let mut rig = rig_with(settings(0x40, bit_rate).with_heartbeat_ms(1000));
    rig.collect(Time::from_ms(200));
    rig
}

fn run_for_10_s(rig: &mut ImageRig) {
    rig.network.run_for(Time::from_s(10));
}

#[test]
fn an_idle_board_is_asleep_for_more_than_99_5_percent_of_the_time() {
    let idle =
        share_asleep(&mut node_40(BitRate::Kbit125), "idle, a heartbeat a second", run_for_10_s);
    assert!(idle > 99_950, "{idle}");
    let blank = share_asleep(&mut blank_rig(), "blank, LSS waiting", run_for_10_s);
    assert!(blank > 99_950, "{blank}");
}

#[test]
fn a_bus_full_of_foreign_frames_wakes_the_core_no_more_often() {
    for bit_rate in [BitRate::Kbit1000, BitRate::Kbit10] {
        let mut rig = node_40(bit_rate);
        let other = rig.network.add_adapter(Adapter::new(bit_per_s(bit_rate)));
        let what = format!("a full bus of foreign frames, {} kbit/s", bit_rate.kbit_per_s());
        let share = share_asleep(&mut rig, &what, |rig| {
            let until = rig.network.now() + Time::from_s(3);
            while rig.network.now() < until {
                while rig.network.adapter_mut(other).unsent() < 20 {
                    rig.network.send(other, Frame::data(Id::Standard(0x123), &[0x5A; 8]));
                }
                rig.network.run_for(Time::from_ms(1));
            }
        });
        assert!(share > 99_950, "{share}");
    }
}
