//! The diagram of the LSS states, `docs/lss-states.svg`: drawn from the node's behaviour with each service in each
//! state.
//!
//! `WRITE_DIAGRAM=1 cargo test --test library lss_states` writes it again.

use std::{env, fs, path::Path};

use lss_slave::{
    lss::{self, State},
    nmt,
};
use testkit::{
    frames::{SILENCE, bytes, text},
    node_rig::NodeRig,
};

/// A service: its command specifiers, its name, and the requests that use it, separated by commas. Several equivalent
/// requests are each tried.
type Service = (&'static str, &'static str, &'static [&'static str]);

const IDENTIFY: &str = "46 44 33 22 11, 47 88 77 66 55, 48, 49 FF FF FF FF, 4A, 4B FF FF FF FF";

const SERVICES: [Service; 14] = [
    ("04 01", "switch state global", &["04 01"]),
    (
        "40 41 42 43",
        "switch state selective",
        &["40 44 33 22 11, 41 88 77 66 55, 42 03 02 01 00, 43 EF BE AD DE"],
    ),
    (
        "51",
        "Fastscan",
        &["51 00 00 00 00 80, 51 44 33 22 11 00 00 01, 51 88 77 66 55 00 01 02,
            51 03 02 01 00 00 02 03, 51 EF BE AD DE 00 03 00"],
    ),
    ("11", "configure node-ID", &["11 04"]),
    ("13", "configure bit timing", &["13 00 02"]),
    ("15", "activate bit timing", &["15 0A 00"]),
    ("17", "store configuration", &["17"]),
    ("5A 5B 5C 5D", "inquire identity", &["5A", "5B", "5C", "5D"]),
    ("5E", "inquire node-ID", &["5E"]),
    ("46 .. 4B", "identify remote slave", &[IDENTIFY]),
    ("4C", "identify non-configured remote slave", &["4C"]),
    ("04 00", "switch state global", &["04 00"]),
    ("NMT 81", "reset node", &["81 00"]),
    ("NMT 82", "reset communication", &["82 00"]),
];

/// An effect that is not visible at once.
const FORGETS: &str = "progress is cleared";

/// A node before a request, by its node-ID.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Kind {
    Unconfigured,
    /// Without an active node-ID; one is pending.
    GivenItsFirst,
    Configured,
}

use Kind::{Configured, GivenItsFirst, Unconfigured};

/// The kinds of node in a state: one with its first node-ID leaves configuration as one with a node-ID.
fn kinds(state: State) -> &'static [Kind] {
    match state {
        State::Waiting => &[Unconfigured, Configured],
        State::Configuration => &[Unconfigured, GivenItsFirst, Configured],
    }
}

/// The outcome of a service.
#[derive(Clone, PartialEq, Eq, Debug)]
struct Outcome {
    /// In words; empty: no answer or other effect.
    effect: String,
    then: State,
}

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
    let is_nmt = ["81 00", "82 00"].contains(&request);
    let sent = if is_nmt { board.nmt(request) } else { board.lss(request) };
    let acts = board.timeline().into_iter().filter_map(|line| match line.as_str() {
        "0 ms stop" => Some("silence, then the new bit rate".to_owned()),
        "0 ms store" => Some("stored".to_owned()),
        _ => None,
    });
    let answers = sent.0.iter().map(|frame| match (frame.cob_id(), frame.data()) {
        (lss::RESPONSE_COB_ID, answer) if answer[0] == bytes(request)[0] => "answered".to_owned(),
        (lss::RESPONSE_COB_ID, answer) => format!("answer {:02X}", answer[0]),
        (id, [0]) if id & !0x7F == nmt::ERROR_CONTROL_COB_ID => "boot-up".to_owned(),
        _ => panic!("{request}: {}", text(frame)),
    });
    acts.chain(answers).collect::<Vec<_>>().join(", ")
}

/// Whether a request makes the node forget the steps of an identify that it has seen.
fn loses_progress(kind: Kind, state: State, request: &str) -> bool {
    let mut board = board(kind, state);
    let (steps, last) = IDENTIFY.rsplit_once(", ").expect("steps");
    for step in steps.split(", ") {
        assert_eq!(board.lss(step), SILENCE);
    }
    effect(&mut board, request);
    board.lss(last) == SILENCE
}

/// The outcome of the last of the requests.
fn outcome(kind: Kind, state: State, requests: &str) -> Outcome {
    let mut board = board(kind, state);
    let mut last_effect = String::new();
    for request in requests.split(',') {
        last_effect = effect(&mut board, request.trim());
    }
    board.pass_ms(100);
    let then = board.node.lss().state();
    let is_nothing = last_effect.is_empty() && then == state;
    if is_nothing && !requests.contains(',') && loses_progress(kind, state, requests) {
        last_effect.push_str(FORGETS);
    }
    Outcome { effect: last_effect, then }
}

/// The text for a service in a state: its effect in words, and the next state. `None`: no effect.
fn drawn(state: State, requests: &[&str]) -> Option<Outcome> {
    let [outcomes, others @ ..] = &requests
        .iter()
        .map(|requests| kinds(state).iter().map(|&kind| outcome(kind, state, requests)).collect())
        .collect::<Vec<Vec<Outcome>>>()[..]
    else {
        panic!("no request");
    };
    assert!(others.iter().all(|other| other == outcomes), "{requests:?} do not do the same");
    let nothing = Outcome { effect: String::new(), then: state };
    let mut groups: Vec<(&Outcome, Vec<Kind>)> = Vec::new();
    for (outcome, &kind) in outcomes.iter().zip(kinds(state)) {
        match groups.iter_mut().find(|group| group.0 == outcome) {
            _ if *outcome == nothing => {}
            Some((_, kinds)) => kinds.push(kind),
            None => groups.push((outcome, vec![kind])),
        }
    }
    let then = groups.first()?.0.then;
    assert!(groups.iter().all(|(outcome, _)| outcome.then == then), "{requests:?}: {groups:?}");
    // Effects visible on the bus stand before the others.
    groups.sort_by_key(|(outcome, _)| ["", FORGETS].contains(&outcome.effect.as_str()));
    let is_all = groups.len() == 1 && groups[0].1 == kinds(state);
    let only = if groups.len() == 1 { " only" } else { "" };
    let words = groups.into_iter().enumerate().map(|(i, (outcome, kinds))| {
        let effect = if outcome.effect.is_empty() { "no answer" } else { &outcome.effect };
        let condition = match kinds[..] {
            _ if is_all || i > 0 => "",
            [Unconfigured] => " without a node-ID",
            [Configured] if state == State::Configuration => " with an active node-ID",
            [Configured] => " with a node-ID",
            [GivenItsFirst, Configured] => " with a node-ID, active or pending",
            [GivenItsFirst] => " with its first node-ID",
            _ => panic!("{requests:?}: no words for {kinds:?}"),
        };
        match (i, condition) {
            (0, "") => effect.to_owned(),
            (0, _) => format!("{effect}{only}{condition}"),
            _ => format!("else {effect}"),
        }
    });
    Some(Outcome { effect: words.collect::<Vec<_>>().join(", "), then })
}

/// Pixels: the boxes of the states and the space between them.
const BOX_WIDTH: u32 = 345;
const GAP: u32 = 380;
const MARGIN: u32 = 20;
const TOP: u32 = 96;
/// The first line in a box.
const FIRST: u32 = TOP + 60;
const ROW: u32 = 44;
const ARROW: u32 = 62;
const LEFT: u32 = MARGIN + BOX_WIDTH;
const RIGHT: u32 = LEFT + GAP;

const BOXES: [(State, u32, &str, &str); 2] = [
    (State::Waiting, MARGIN, "LSS waiting", "#e8eef7"),
    (State::Configuration, RIGHT, "LSS configuration", "#fdf0df"),
];

/// A service in two lines of text: its name and its effect.
fn service(x: u32, y: u32, anchor: &str, (specifiers, name, _): Service, effect: &str) -> String {
    let below = y + 16;
    format!(
        r##"<text x="{x}" y="{y}" text-anchor="{anchor}"><tspan font-family="monospace" font-weight="bold">{specifiers}</tspan> {name}</text>
<text x="{x}" y="{below}" text-anchor="{anchor}" fill="#666">{effect}</text>
"##
    )
}

fn arrow([x1, y1]: [u32; 2], [x2, y2]: [u32; 2]) -> String {
    format!(
        r##"<line x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}" stroke="#4a7ab5" stroke-width="1.5" marker-end="url(#tip)"/>
"##
    )
}

/// The services that stay in a state, and those without effect; and the end of the text.
fn draw_services(state: State, x: u32) -> (String, u32) {
    let (x, mut y) = (x + 14, FIRST);
    let (mut svg, mut ignored) = (String::new(), Vec::new());
    for of in SERVICES {
        match drawn(state, of.2) {
            None => ignored.push(of.0),
            Some(Outcome { effect, then }) if then == state => {
                svg += &service(x, y, "start", of, &effect);
                y += ROW;
            }
            Some(_) => {}
        }
    }
    let (below, last, ignored) = (y + 18, y + 36, ignored.join(", "));
    svg += &format!(
        r##"<text x="{x}" y="{y}">without any effect:</text>
<text x="{x}" y="{below}" fill="#666" font-family="monospace" font-size="11">{ignored}</text>
<text x="{x}" y="{last}" fill="#666">and all other command specifiers</text>
"##
    );
    (svg, last + 20)
}

/// The services that lead from one state to the other.
fn draw_transitions() -> String {
    let mut svg = String::new();
    let mut y = TOP + 40;
    for (state, from, to) in [(State::Waiting, LEFT, RIGHT), (State::Configuration, RIGHT, LEFT)] {
        for of in SERVICES {
            if let Some(Outcome { effect, then }) = drawn(state, of.2)
                && then != state
            {
                svg += &service((LEFT + RIGHT) / 2, y, "middle", of, &effect);
                svg += &arrow([from, y + 24], [to, y + 24]);
                y += ARROW;
            }
        }
    }
    svg
}

fn draw() -> String {
    let services = BOXES.map(|(state, x, ..)| draw_services(state, x));
    let bottom = services.iter().map(|(_, bottom)| *bottom).max().expect("two boxes");
    let (width, height) = (RIGHT + LEFT, bottom - TOP);
    let boxes = BOXES.map(|(_, x, name, fill)| {
        let (middle, y) = (x + BOX_WIDTH / 2, TOP + 26);
        format!(
            r##"<rect x="{x}" y="{TOP}" width="{BOX_WIDTH}" height="{height}" rx="10" fill="{fill}" stroke="#888"/>
<text x="{middle}" y="{y}" text-anchor="middle" font-size="15" font-weight="bold">{name}</text>
"##
        )
    });
    let (middle, end) = (MARGIN + BOX_WIDTH / 2, bottom + 66);
    let mut svg = format!(
        r##"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {end}" font-family="sans-serif" font-size="12">
<defs><marker id="tip" viewBox="0 0 10 10" refX="10" refY="5" markerWidth="9" markerHeight="9" orient="auto"><path d="M 0 0 L 10 5 L 0 10 z" fill="#4a7ab5"/></marker></defs>
<rect width="100%" height="100%" fill="white"/>
<text x="{MARGIN}" y="28" font-size="16">The states of an LSS slave, and the effect of each service</text>
<circle cx="{middle}" cy="56" r="6" fill="#444"/>
<text x="{}" y="60">power-on: {}</text>
"##,
        middle + 14,
        power_on()
    );
    svg += &boxes.concat();
    svg += &arrow([middle, 62], [middle, TOP]);
    svg += &services.map(|(svg, _)| svg).concat();
    svg += &draw_transitions();
    for (y, line) in (bottom + 22..).step_by(16).zip(LEGEND) {
        svg += &format!("<text x=\"{MARGIN}\" y=\"{y}\" fill=\"#666\">{line}</text>\n");
    }
    svg + "</svg>\n"
}

const LEGEND: [&str; 3] = [
    r#""answered": with the same command specifier. First node-ID: configured (11) while none is active."#,
    "Progress: the steps of 40..43, 46..4B and 51. Services with several steps are shown with all of them right.",
    "Drawn by tests/library/lss_states.rs from the behaviour of the node.",
];

/// The node's behaviour at power-on, with and without a node-ID.
fn power_on() -> &'static str {
    for (kind, sent) in [(Unconfigured, &[][..]), (Configured, &["740: 00"])] {
        let mut board = board(kind, State::Configuration);
        assert_eq!(board.power_cycle(), sent);
        assert_eq!(board.node.lss().state(), State::Waiting);
    }
    "boot-up with a node-ID"
}

#[test]
fn the_diagram_shows_the_states_of_the_node() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/lss-states.svg");
    let drawn = draw();
    if env::var_os("WRITE_DIAGRAM").is_some() {
        fs::write(&path, &drawn).expect("docs can be written");
    }
    let file = fs::read_to_string(&path).expect("docs/lss-states.svg");
    assert!(
        file.replace("\r\n", "\n") == drawn,
        "docs/lss-states.svg is out of date: WRITE_DIAGRAM=1 cargo test --test library lss_states"
    );
}
