//! The states of LSS: the effect of each service in each of them, for each kind of node.

use canopen_node::lss::{self, State};
use testkit::{
    frames::{SILENCE, bytes, text},
    node_rig::NodeRig,
};

/// The steps of a select that matches.
pub const SELECT: &str = "40 44 33 22 11, 41 88 77 66 55, 42 03 02 01 00, 43 EF BE AD DE";
const FASTSCAN: &str = "51 00 00 00 00 80, 51 44 33 22 11 00 00 01, 51 88 77 66 55 00 01 02, \
    51 03 02 01 00 00 02 03, 51 EF BE AD DE 00 03 00";
/// The steps of an identify that matches.
pub const IDENTIFY: &str = "46 44 33 22 11, 47 88 77 66 55, 48, 49 FF FF FF FF, 4A, 4B FF FF FF FF";

/// Requests, separated by commas, and the effect of the last of them on a node
/// - in waiting without a node-ID, and with one;
/// - in configuration without a node-ID, without an active one but with a pending one, and with an active one.
#[rustfmt::skip]
const EFFECTS: [(&str, [&str; 5]); 20] = [
    ("04 01", [TO_CONFIGURATION, TO_CONFIGURATION, CLEARED, CLEARED, CLEARED]),
    (SELECT, ["answer 44, to configuration", "answer 44, to configuration", "", "", ""]),
    (FASTSCAN, ["answer 4F, to configuration", "", "", "", ""]),
    ("11 04", IN_CONFIGURATION),
    ("13 00 02", IN_CONFIGURATION),
    ("15 0A 00", ["", "", SWITCH, SWITCH, SWITCH]),
    ("17", ["", "", "stored, answered", "stored, answered", "stored, answered"]),
    ("5A", IN_CONFIGURATION),
    ("5B", IN_CONFIGURATION),
    ("5C", IN_CONFIGURATION),
    ("5D", IN_CONFIGURATION),
    ("5E", IN_CONFIGURATION),
    (IDENTIFY, ["answer 4F"; 5]),
    ("4C", ["answer 50", "", "answer 50", "", ""]),
    ("04 00", [CLEARED, CLEARED, TO_WAITING, "boot-up, to waiting", TO_WAITING]),
    ("01 00", [""; 5]),
    ("02 00", [""; 5]),
    ("80 00", [""; 5]),
    ("81 00", [CLEARED, "boot-up", TO_WAITING, TO_WAITING, "boot-up, to waiting"]),
    ("82 00", [CLEARED, "boot-up", TO_WAITING, "boot-up, to waiting", "boot-up, to waiting"]),
];
const IN_CONFIGURATION: [&str; 5] = ["", "", "answered", "answered", "answered"];
const TO_CONFIGURATION: &str = "to configuration";
const TO_WAITING: &str = "to waiting";
const SWITCH: &str = "silence, then the new bit rate";
/// The steps of 40..43, 46..4B and 51 that were seen do not count any more.
const CLEARED: &str = "progress is cleared";

/// A node before a request, by its node-ID.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Kind {
    Unconfigured,
    /// Without an active node-ID; one is pending.
    GivenItsFirst,
    Configured,
}

use Kind::{Configured, GivenItsFirst, Unconfigured};

/// The columns of the table.
const NODES: [(State, Kind); 5] = [
    (State::Waiting, Unconfigured),
    (State::Waiting, Configured),
    (State::Configuration, Unconfigured),
    (State::Configuration, GivenItsFirst),
    (State::Configuration, Configured),
];

fn board(kind: Kind, state: State) -> NodeRig {
    let mut board = match kind {
        Configured => NodeRig::with_node_id(0x40),
        Unconfigured | GivenItsFirst => NodeRig::unconfigured(),
    };
    if state == State::Configuration {
        board.lss("04 01");
    }
    if kind == GivenItsFirst {
        assert_eq!(board.lss("11 05"), ["11 00"]);
    }
    board
}

/// Sends a request and names its immediate effect.
fn effect(board: &mut NodeRig, request: &str) -> String {
    board.timeline();
    let is_nmt = ["01 00", "02 00", "80 00", "81 00", "82 00"].contains(&request);
    let sent = if is_nmt { board.nmt(request) } else { board.lss(request) };
    let acts = board.timeline().into_iter().filter_map(|line| match line.as_str() {
        "0 ms drop all" => Some("silence, then the new bit rate".to_owned()),
        "0 ms store" => Some("stored".to_owned()),
        _ => None,
    });
    let answers = sent.0.iter().map(|frame| match (frame.cob_id(), frame.data()) {
        (lss::RESPONSE_COB_ID, answer) if answer[0] == bytes(request)[0] => "answered".to_owned(),
        (lss::RESPONSE_COB_ID, answer) => format!("answer {:02X}", answer[0]),
        (0x701..=0x77F, [0]) => "boot-up".to_owned(),
        _ => panic!("{request}: {}", text(frame)),
    });
    acts.chain(answers).collect::<Vec<_>>().join(", ")
}

/// Whether a request makes the node forget the steps that it has seen of all services that it serves.
fn loses_progress(kind: Kind, state: State, request: &str) -> bool {
    let loses = |steps: &str| {
        let mut board = board(kind, state);
        let (steps, last) = steps.rsplit_once(", ").expect("steps");
        steps.split(", ").for_each(|step| _ = board.lss(step));
        effect(&mut board, request);
        board.lss(last) == SILENCE
    };
    let is_waiting = state == State::Waiting;
    let is_lost = loses(IDENTIFY);
    assert!(!is_waiting || loses(SELECT) == is_lost, "{request}");
    assert!(!is_waiting || kind != Unconfigured || loses(FASTSCAN) == is_lost, "{request}");
    is_lost
}

/// The effect of the last of the requests, and the state behind it if that is another.
fn outcome(kind: Kind, state: State, requests: &str) -> String {
    let mut board = board(kind, state);
    let mut last_effect = String::new();
    for request in requests.split(", ") {
        last_effect = effect(&mut board, request);
    }
    assert_eq!(board.pass_ms(1_000), SILENCE, "{requests}");
    let then = board.node.lss().state();
    let is_nothing = last_effect.is_empty() && then == state;
    if is_nothing && !requests.contains(',') && loses_progress(kind, state, requests) {
        return CLEARED.to_owned();
    }
    let is_reset = ["81 00", "82 00"].contains(&requests);
    assert!(!is_reset || loses_progress(kind, state, requests), "{requests}");
    let words = match then {
        _ if then == state => None,
        State::Waiting => Some(TO_WAITING),
        State::Configuration => Some(TO_CONFIGURATION),
    };
    let effect = Some(last_effect.as_str()).filter(|effect| !effect.is_empty());
    effect.into_iter().chain(words).collect::<Vec<_>>().join(", ")
}

#[test]
fn each_service_has_its_effect_in_each_state() {
    for (requests, effects) in EFFECTS {
        let found = NODES.map(|(state, kind)| outcome(kind, state, requests));
        assert_eq!(found, effects, "{requests}");
    }
}

#[test]
fn power_on_leads_to_waiting_with_a_boot_up_of_a_node_with_a_node_id() {
    for (kind, sent) in [(Unconfigured, &[][..]), (Configured, &["740: 00"])] {
        let mut board = board(kind, State::Configuration);
        assert_eq!(board.power_cycle(), sent);
        assert_eq!(board.node.lss().state(), State::Waiting);
    }
}

/// In the picture each text and each arrow is a line: a service, its effect below it, and the arrow to another state
/// below the two, if there is one. What has no effect in any state is not in it.
#[test]
fn the_picture_of_the_states_shows_the_effect_of_each_service() {
    let picture: Vec<_> = include_str!("../../docs/lss-states.svg").lines().collect();
    let label_of = |requests: &str| match requests {
        SELECT => "40 41 42 43".to_owned(),
        IDENTIFY => "46 .. 4B".to_owned(),
        "5A" | "5B" | "5C" | "5D" => "5A 5B 5C 5D".to_owned(),
        "04 00" | "04 01" => requests.to_owned(),
        "81 00" | "82 00" => format!("NMT {}", &requests[..2]),
        _ => requests[..2].to_owned(),
    };
    let shown = EFFECTS.iter().filter(|(_, effects)| effects.iter().any(|it| !it.is_empty()));
    for (requests, effects) in shown {
        let service = label_of(requests);
        for (place, effects, arrow) in [
            ("<text x=\"34\"", &effects[..2], "<line x1=\"365\""),
            ("<text x=\"759\"", &effects[2..], "<line x1=\"745\""),
        ] {
            let is_label = |lines: &&[&str]| {
                lines[0].contains(&format!(">{service}</tspan> "))
                    && (lines[0].starts_with(place) || lines[2].starts_with(arrow))
            };
            let label = picture.windows(3).find(is_label);
            if effects.iter().all(|effect| effect.is_empty()) {
                let is_list = |lines: &&[&str]| {
                    lines[0].starts_with(place) && lines[0].contains(">without any effect:<")
                };
                let ignored = picture.windows(2).find(is_list).expect("a list")[1];
                let mut ignored = ignored.split(['>', '<']).nth(2).expect("a text").split(", ");
                assert!(ignored.any(|one| one == service), "{service} is in the list");
                assert_eq!(label, None, "{service} has no effect");
                continue;
            }
            let label = label.unwrap_or_else(|| panic!("{service} is in the picture"));
            let leaves = effects.iter().any(|effect| effect.contains("to "));
            assert_eq!(label[2].starts_with("<line "), leaves, "{service}: an arrow");
            for effect in effects.iter().flat_map(|effect| effect.split(", ")) {
                let is_arrow = effect.starts_with("to ");
                assert!(is_arrow || label[1].contains(effect), "{service}: {effect}");
            }
        }
    }
}
