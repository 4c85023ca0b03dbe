//! The indicators (CiA 303-3) over time: one character for 50 ms, `#` lit and `.` dark.

use canopen_node::{
    indicator::{BusState, Indicators, STEP_MS},
    nmt::State,
};

const NMT_STATES: [State; 4] =
    [State::Initialisation, State::PreOperational, State::Operational, State::Stopped];

const OFF: &str = "........................";
const ON: &str = "########################";
/// 50 ms on, 50 ms off.
const FLICKERING: &str = "#.#.#.#.#.#.#.#.#.#.#.#.";
/// The inverse.
const FLICKERING_IN_TURN: &str = ".#.#.#.#.#.#.#.#.#.#.#.#";
/// 200 ms on, 200 ms off.
const BLINKING: &str = "####....####....####....";
/// 200 ms on, 1000 ms off.
const SINGLE_FLASH: &str = "####....................";

/// The states of RUN and ERR in the next 1200 ms.
fn watch(
    indicators: &mut Indicators,
    nmt: State,
    is_lss_active: bool,
    bus: BusState,
) -> [String; 2] {
    let mut shown = [String::new(), String::new()];
    for _ in 0..1_200 / STEP_MS {
        let lit = indicators.step(nmt, is_lss_active, bus);
        for (shown, is_lit) in shown.iter_mut().zip([lit.run, lit.error]) {
            shown.push(if is_lit { '#' } else { '.' });
        }
    }
    shown
}

/// Over more periods than the step counter can count.
fn assert_shows(nmt: State, is_lss_active: bool, bus: BusState, run: &str, error: &str) {
    let mut indicators = Indicators::default();
    for _ in 0..50 {
        let shown = watch(&mut indicators, nmt, is_lss_active, bus);
        assert_eq!(shown, [run, error], "{nmt:?} {is_lss_active} {bus:?}");
    }
}

#[test]
fn run_shows_the_nmt_state_and_err_the_state_of_the_bus() {
    let runs = [OFF, BLINKING, ON, SINGLE_FLASH];
    for (nmt, run) in NMT_STATES.into_iter().zip(runs) {
        assert_shows(nmt, false, BusState::Good, run, OFF);
        assert_shows(nmt, false, BusState::Warning, run, SINGLE_FLASH);
        assert_shows(nmt, false, BusState::BusOff, run, ON);
    }
}

#[test]
fn both_flicker_in_turn_while_lss_is_at_work() {
    for nmt in NMT_STATES {
        assert_shows(nmt, true, BusState::Good, FLICKERING, FLICKERING_IN_TURN);
        assert_shows(nmt, true, BusState::Warning, FLICKERING, FLICKERING_IN_TURN);
        assert_shows(nmt, true, BusState::BusOff, FLICKERING, ON);
    }
}

#[test]
fn a_new_state_is_shown_from_the_next_step_on() {
    let mut indicators = Indicators::default();
    for _ in 0..5 {
        indicators.step(State::PreOperational, false, BusState::Good);
    }
    assert!(indicators.step(State::Operational, false, BusState::Good).run);
    assert!(indicators.step(State::Operational, false, BusState::BusOff).error);
    assert!(!indicators.step(State::Initialisation, false, BusState::Good).run);
}

#[test]
fn a_pattern_that_comes_back_is_whole_again_within_its_period() {
    let mut indicators = Indicators::default();
    for steps in 0..100 {
        for _ in 0..steps {
            indicators.step(State::Operational, false, BusState::Good);
        }
        let [run, _] = watch(&mut indicators, State::Stopped, false, BusState::Good);
        assert_eq!(run.matches('#').count(), 4, "200 ms in 1200 ms: {run}");
        assert!(run.repeat(2).contains(SINGLE_FLASH));
    }
}
