//! A board that is late with every deadline acts like a punctual one, in the same order, and misses only heartbeats.

use canopen_node::Action;
use testkit::{
    node_rig::{NodeRig, defaults},
    random::Random,
};

const REQUESTS: [&str; 13] = [
    "04 01", "04 01", "04 01", "04 00", "11 05", "11 FF", "13 00 02", "13 00 00", "15 05 00",
    "15 00 00", "17", "5E", "4C",
];
const COMMANDS: [&str; 5] = ["01 00", "80 00", "02 00", "82 00", "81 00"];

/// The board's actions since the last call except heartbeats, and the number of heartbeats.
fn done(board: &mut NodeRig) -> (Vec<Action>, usize) {
    let is_heartbeat = |action: &Action| {
        matches!(action, Action::Transmit(frame)
            if frame.cob_id() & !0x7F == 0x700 && frame.data() != [0])
    };
    let actions = board.take_actions();
    let (heartbeats, others): (Vec<_>, Vec<_>) = actions.into_iter().partition(is_heartbeat);
    (others, heartbeats.len())
}

#[test]
fn late_or_punctual_calls_lead_to_the_same_actions_in_the_same_order() {
    let mut random = Random::from_environment();
    let (mut acts, mut missed) = (0, 0);
    for _ in 0..50 {
        let settings = defaults(random.pick(&[0x40, 0xFF])).with_heartbeat_ms(3);
        let mut punctual = NodeRig::with_defaults(settings);
        let mut late = NodeRig::with_defaults(settings);
        for step in 0..300 {
            let ms = random.pick(&[0, 0, 1, 2, 5, 10, 40]);
            punctual.pass_ms(ms);
            late.be_late_ms(ms);
            if random.one_in(8) {
                let command = random.pick(&COMMANDS);
                punctual.nmt(command);
                late.nmt(command);
            } else {
                let request = random.pick(&REQUESTS);
                punctual.lss(request);
                late.lss(request);
            }
            let (expected, all) = done(&mut punctual);
            let (found, some) = done(&mut late);
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
