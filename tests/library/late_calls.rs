//! Instants, and boards with other calls: one that is late with every deadline acts like a punctual one, in the same order,
//! and misses only heartbeats. One that is called without need, and whose clock wraps, acts at the same times.

use canopen_node::{Action, Instant};
use testkit::{
    flash::BoardFlash,
    frames,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    random::Random,
};

const REQUESTS: [&str; 13] = [
    "04 01", "04 01", "04 01", "04 00", "11 05", "11 FF", "13 00 02", "13 00 00", "15 05 00",
    "15 00 00", "17", "5E", "4C",
];
const COMMANDS: [&str; 5] = ["01 00", "80 00", "02 00", "82 00", "81 00"];

/// The actions except heartbeats, and the number of heartbeats.
fn split(actions: Vec<Action>) -> (Vec<Action>, usize) {
    let is_heartbeat = |action: &Action| {
        matches!(action, Action::Transmit(frame, _)
            if frame.cob_id() & !0x7F == 0x700 && frame.data() != [0])
    };
    let (heartbeats, others): (Vec<_>, Vec<_>) = actions.into_iter().partition(is_heartbeat);
    (others, heartbeats.len())
}

#[test]
fn late_or_needless_calls_and_the_wrap_of_the_clock_change_no_action_and_no_order() {
    let mut random = Random::from_environment();
    let (mut acts, mut missed) = (0, 0);
    for _ in 0..50 {
        let settings = defaults(random.pick(&[0x40, 0xFF]));
        let device = device(ADDRESS).with_defaults(settings).with_heartbeat_ms(3);
        let mut punctual = NodeRig::of(device);
        let mut late = NodeRig::of(device);
        // The clock wraps, or is at half a turn, within the two seconds or so of the run, or when something is due.
        let any = 1_000 * random.within(0..2_000) as u32;
        let since_us = random.pick(&[0, 1, 3_000, 20_000, any, any]);
        let clock_at_start = random.pick(&[0_u32, 1 << 31]).wrapping_sub(since_us);
        let mut needless = NodeRig::with_device(device, BoardFlash::blank(0), clock_at_start);
        for step in 0..300 {
            let ms = random.pick(&[0, 0, 1, 2, 5, 10, 40]);
            punctual.pass_ms(ms);
            late.be_late_ms(ms);
            (0..ms * 4).for_each(|_| _ = needless.pass_us(250));
            let frame = match random.one_in(8) {
                true => frames::command(random.pick(&COMMANDS)),
                false => frames::request(random.pick(&REQUESTS)),
            };
            for board in [&mut punctual, &mut late, &mut needless] {
                board.receive(&frame);
            }
            let actions: Vec<_> = punctual.take_timed_actions().collect();
            assert!(needless.take_timed_actions().eq(actions.iter().copied()), "step {step}");
            let (expected, all) = split(actions.into_iter().map(|(_, action)| action).collect());
            let (found, some) = split(late.take_actions());
            assert_eq!(found, expected, "step {step}");
            // One for all missed heartbeats, and one right behind a switch without a delay.
            assert!(some <= 2, "step {step}: {some} heartbeats in a burst");
            acts += found.len();
            missed += all.saturating_sub(some);
        }
        assert_eq!(late.stored(), punctual.stored());
        assert_eq!(late.node.nmt_state(), punctual.node.nmt_state());
    }
    assert!(acts > 5_000 && missed > 1_000, "{acts} acts, {missed} heartbeats were missed");
}

#[test]
fn a_later_instant_comes_when_the_count_reaches_it_also_across_the_wrap() {
    for start in [0, 1_000, u32::MAX - 5, u32::MAX] {
        let now = Instant::from_micros(start);
        for span in [1, 10, u32::MAX / 2] {
            let later = now.plus_micros(span);
            assert!(!later.has_come(now));
            assert_eq!(later.micros_after(now), span);
            assert!(later.has_come(later));
            assert!(now.has_come(later));
            assert_eq!(now.micros_after(later), 0);
        }
    }
}
