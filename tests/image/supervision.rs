//! The errors that the search of a board at a wrong bit rate costs the others.

use crate::rig::*;

/// The errors that another node counts while a board at a wrong rate searches, and then in its first visit home. It
/// receives a heartbeat a second.
fn errors_of_others(stored: BitRate, found: BitRate) -> (u64, u64) {
    let settings = settings(1, stored).with_heartbeat_ms(1000);
    let mut rig = ImageRig::new(found, [board_with(0, settings)]);
    rig.network.power_off(0);
    let other = rig.network.add_adapter(Adapter::new(bit_per_s(found)));
    rig.network.record(Recording::Off);
    rig.network.run_for(Time::from_ms(10));
    rig.network.power_on(0);
    let mut next = rig.network.now();
    // The errors when a condition comes to hold.
    let mut until = |rig: &mut ImageRig, is_silent: bool| {
        let begin = rig.network.now();
        loop {
            let chip = rig.network.board(0).chip();
            let (silent, rate) = (chip.can(1).is_silent(), chip.can(1).bit_rate());
            drop(chip);
            let is_guest = !silent && rate == bit_per_s(found);
            if if is_silent { silent } else { is_guest } {
                return rig.network.adapter_mut(other).errors();
            }
            assert!(rig.network.now() < begin + Time::from_s(20), "{stored:?}, {found:?}");
            if rig.network.now() >= next {
                next += Time::from_ms(1000);
                rig.network.send(rig.master, Frame::data(Id::Standard(0x705), &[0x05]));
            }
            rig.network.run_for(Time::from_us(500));
        }
    };
    let [begin, found] = [true, false].map(|is_silent| until(&mut rig, is_silent));
    let [visit, back] = [true, false].map(|is_silent| until(&mut rig, is_silent));
    (found - begin, back - visit)
}

#[test]
fn others_count_at_most_200_errors_a_search_and_30_a_visit() {
    for stored in BitRate::ALL {
        // A slower node may not notice a heartbeat: it is over before a bit is sampled twice.
        let is_noticed = |found: &BitRate| stored.kbit_per_s() >= 50 || found.kbit_per_s() <= 125;
        for found in BitRate::ALL.into_iter().filter(|found| *found != stored && is_noticed(found))
        {
            let (search, visit) = errors_of_others(stored, found);
            let what = format!("{stored:?} stored, {found:?}: {search} errors, {visit} in a visit");
            println!("{what}");
            assert!(search <= 200 && visit <= 30, "{what}");
        }
    }
}
