//! The share of time in which the core sleeps: it is woken only by frames on the bus and by due actions.

use canopen_node::BitRate;
use emulator::{
    Time,
    can::{Adapter, Frame, Id},
};
use testkit::{frames, sdo::Client};

use crate::rig::{ImageRig, bit_per_s, blank_rig, example_board, on_the_wire, rig_with, settings};

/// The limit for a SYNC with its four TPDOs, in core cycles.
const ROUND_CYCLES: u64 = 5_000;

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

#[test]
fn a_bus_full_of_requests_leaves_the_core_asleep_for_most_of_the_time() {
    let mut rig = node_40(BitRate::Kbit1000);
    rig.lss("04 01");
    let share = share_asleep(&mut rig, "a full bus, all to be answered", |rig| {
        let request = on_the_wire(&frames::request("11 80"));
        (0..2000).for_each(|_| rig.network.send(rig.master, request));
        while rig.network.adapter_mut(rig.master).unsent() > 0 {
            rig.network.run_for(Time::from_ms(1));
        }
    });
    assert!(share > 90_000, "{share}");
}

#[test]
fn a_sync_and_its_four_tpdos_cost_few_cycles() {
    const ROUNDS: u64 = 200;
    let mut rig = ImageRig::new(BitRate::Kbit1000, [example_board(settings(1, BitRate::Kbit1000))]);
    rig.collect(Time::from_ms(50));
    let mut client = rig.sdo_client(1);
    // TPDOs 3 and 4 carry the LEDs and the temperature, 1 and 2 the button and the temperature.
    for (at, cob_id) in [(2, 0x381_u32), (3, 0x481)] {
        let mapped = [0x6200_0108_u32, 0x6401_0110];
        let mut write = |index: u16, sub_index, data: &[u8]| {
            client.download(index + at, sub_index, data).expect("it is written");
        };
        write(0x1800, 1, &(1 << 31 | cob_id).to_le_bytes());
        write(0x1A00, 0, &[0]);
        write(0x1A00, 1, &mapped[0].to_le_bytes());
        write(0x1A00, 2, &mapped[1].to_le_bytes());
        write(0x1A00, 0, &[2]);
        write(0x1800, 1, &cob_id.to_le_bytes());
    }
    for index in 0x1800..0x1804 {
        client.download(index, 2, &[1]).expect("it is written");
    }
    rig.nmt("01 01");
    let sync = Frame::data(Id::Standard(0x080), &[]);
    let [without, with] = [false, true].map(|has_sync| {
        let from = rig.network.now();
        let (_, before) = rig.network.board(0).cycles();
        for _ in 0..ROUNDS {
            if has_sync {
                rig.network.send(rig.master, sync);
            }
            rig.network.run_for(Time::from_ms(1));
        }
        let sent = if has_sync { 4 * ROUNDS } else { 0 };
        assert_eq!(rig.requested(0, from).count() as u64, sent);
        rig.network.board(0).cycles().1 - before
    });
    let cycles = (with - without) / ROUNDS;
    println!("{:40} {cycles:5} cycles", "SYNC and four TPDOs");
    assert!(cycles < ROUND_CYCLES, "{cycles}");
}
