//! The release image with power cuts in any flash operation of a commissioning: reachable afterwards, with the old or
//! the new settings.

use emulator::{
    Time,
    chip::{PowerCut, ResetCause},
};
use lss_slave::{BitRate, Settings};
use testkit::{
    image_rig::{
        DEFAULT_BIT_RATE, ImageRig, SETTINGS_OFFSET, bit_per_s, flash_in_use, flash_with, settings,
    },
    random::Random,
};

/// Node-ID and bit rate; FF: none.
type Shown = (u8, BitRate);

const OLD: Shown = (0x21, BitRate::Kbit250);
const NEW: Shown = (0x42, BitRate::Kbit1000);

/// Flash operations: an erase, a mark and a record of eight words each; a record.
const FORMAT_STEPS: u64 = 17;
const STORE_STEPS: u64 = 8;

/// Switches the supply on; returns the board's settings, and leaves it in LSS configuration state.
fn power_on(rig: &mut ImageRig) -> Shown {
    // The master takes no part until it knows the bit rate: its errors would make the board search for another.
    rig.network.adapter_mut(rig.master).close();
    let since = rig.network.now();
    rig.power_on(0);
    let (_, first) = rig.bit_rates(0, since)[0];
    let rate = BitRate::ALL.into_iter().find(|&rate| bit_per_s(rate) == first).expect("a bit rate");
    rig.set_master_bit_rate(rate);
    rig.network.adapter_mut(rig.master).open();
    rig.collect(Time::from_ms(20));
    rig.lss("04 01");
    let answers = rig.lss("5E");
    let [answer] = answers.0.as_slice() else { panic!("one answer, not {answers:?}") };
    (answer.data()[1], rate)
}

fn power_cycle(rig: &mut ImageRig) -> Shown {
    rig.network.power_off(0);
    power_on(rig)
}

/// Replaces the content of the settings' flash, then powers on with a cut in the flash operation after the next
/// `steps`.
fn power_on_in_vain(rig: &mut ImageRig, content: &[u8], steps: u64, random: &mut Random) {
    rig.network.power_off(0);
    rig.network.board_mut(0).set_flash(SETTINGS_OFFSET, content);
    cut_power_after(rig, steps, random);
    rig.network.power_on(0);
    rig.expect_reset(0, ResetCause::PowerOn);
    rig.collect(Time::from_ms(300));
    assert!(!rig.network.board(0).is_powered(), "step {steps}");
}

/// Configures and stores; returns whether the store was confirmed.
fn commission(rig: &mut ImageRig, (node_id, rate): Shown) -> bool {
    rig.lss("04 01");
    rig.lss(&format!("11 {node_id:02X}"));
    rig.lss(&format!("13 00 {:02X}", rate.index()));
    rig.lss("17") == ["17 00"]
}

/// Cuts the power in the flash operation after the next `steps`.
fn cut_power_after(rig: &ImageRig, steps: u64, random: &mut Random) {
    let board = rig.network.board(0);
    let operation = board.chip().flash().operations() + steps;
    board.chip().flash_mut().cut_power(PowerCut { operation, seed: random.u64() });
}

#[test]
fn a_cut_in_any_step_of_a_store_leaves_the_old_settings_or_the_new() {
    let mut random = Random::from_environment();
    let mut kept = 0;
    for step in 0..STORE_STEPS {
        for _ in 0..3 {
            let mut rig = ImageRig::with(settings(OLD.0, OLD.1));
            cut_power_after(&rig, step, &mut random);
            assert!(!commission(&mut rig, NEW), "confirmed without power, step {step}");
            assert!(!rig.network.board(0).is_powered(), "step {step}");
            let found = power_on(&mut rig);
            // The last word makes a record valid.
            let may_be_new = step == STORE_STEPS - 1;
            assert!(found == OLD || may_be_new && found == NEW, "{found:02X?} after step {step}");
            kept += u32::from(found == OLD);
            assert!(commission(&mut rig, NEW), "step {step}");
            assert_eq!(power_cycle(&mut rig), NEW);
        }
    }
    println!("{kept} of {} kept the old settings", 3 * STORE_STEPS);
}

#[test]
fn a_cut_behind_the_last_step_of_a_store_leaves_the_new_settings() {
    let mut rig = ImageRig::with(settings(OLD.0, OLD.1));
    assert!(commission(&mut rig, NEW));
    assert_eq!(power_cycle(&mut rig), NEW);
}

#[test]
fn cuts_in_formatting_and_the_first_store_leave_defaults_or_new_settings() {
    let mut random = Random::from_environment();
    let defaults = (0xFF, DEFAULT_BIT_RATE);
    for step in 0..FORMAT_STEPS {
        let mut rig = ImageRig::blank();
        power_on_in_vain(&mut rig, &[0xFF; 0x8000], step, &mut random);
        assert_eq!(power_on(&mut rig), defaults, "step {step}");
        let second = random.within(0..STORE_STEPS);
        cut_power_after(&rig, second, &mut random);
        assert!(!commission(&mut rig, NEW), "confirmed without power, steps {step}, {second}");
        let found = power_on(&mut rig);
        assert!(found == defaults || found == NEW, "{found:02X?} after steps {step}, {second}");
    }
}

/// Stores that leave room for `room` in the first bank, which begins with a mark and the defaults, twice.
fn stores_until(room: u16) -> Vec<Settings> {
    (0..509 - room).map(|n| settings((n % 100) as u8 + 1, OLD.1)).collect()
}

#[test]
fn a_cut_in_any_step_of_a_store_in_the_other_sector_leaves_old_or_new() {
    let mut random = Random::from_environment();
    // The copy of the last record fills the sector.
    let content = flash_with(&stores_until(1));
    let last = (((508 - 1) % 100 + 1) as u8, OLD.1);
    for step in 0..=STORE_STEPS {
        let mut rig = ImageRig::with(settings(OLD.0, OLD.1));
        rig.network.power_off(0);
        rig.network.board_mut(0).set_flash(SETTINGS_OFFSET, &content);
        assert_eq!(power_on(&mut rig), last);
        if step < STORE_STEPS {
            cut_power_after(&rig, step, &mut random);
        }
        assert_eq!(commission(&mut rig, NEW), step == STORE_STEPS, "step {step}");
        let found = power_cycle(&mut rig);
        assert!(found == NEW || found == last && step < STORE_STEPS, "{found:02X?}, step {step}");
        assert_eq!(power_cycle(&mut rig), found);
        assert!(commission(&mut rig, OLD), "step {step}");
        assert_eq!(power_cycle(&mut rig), OLD);
    }
}

#[test]
fn a_cut_in_any_step_of_a_start_that_erases_leaves_the_settings() {
    let mut random = Random::from_environment();
    // The last store has moved to the other sector.
    let stores = [stores_until(0), vec![settings(NEW.0, NEW.1)]].concat();
    let content = flash_in_use(&stores);
    // The record once more, the invalidation of the old mark, an erase, a mark.
    for step in 0..18 {
        let mut rig = ImageRig::with(settings(OLD.0, OLD.1));
        power_on_in_vain(&mut rig, &content, step, &mut random);
        assert_eq!(power_on(&mut rig), NEW, "step {step}");
        assert!(commission(&mut rig, OLD), "step {step}");
        assert_eq!(power_cycle(&mut rig), OLD);
    }
}
