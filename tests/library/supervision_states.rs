//! The diagram of the bit-rate supervision, `docs/bit-rate-supervision.svg`: drawn from the node's behaviour with each
//! event in each state, with measured times.
//!
//! `WRITE_DIAGRAM=1 cargo test --test library supervision_states` writes it again.

use std::{env, fs, path::Path};

use lss_slave::{
    BitRate,
    BusEvent::{self, Acknowledged, BusOff, Error, ErrorPassive, FormError, Received},
};
use testkit::{
    node_rig::NodeRig,
    sdo::Client,
    supervised::{TURN_US, guest, looking, powered_on, proven, switched, unproven},
};

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum State {
    Home,
    Elsewhere,
    SilentTurn,
    OpenTurn,
    Guest,
}

use State::{Elsewhere, Guest, Home, OpenTurn, SilentTurn};

const EVENTS: [(BusEvent, &str); 6] = [
    (Received, "a valid frame"),
    (Acknowledged, "an acknowledge"),
    (FormError, "a form error"),
    (Error, "another error"),
    (BusOff, "bus-off"),
    (ErrorPassive, "error passive"),
];

/// A board in a state. Its home rate is 125 kbit/s; it has found, or listens at, 1000 kbit/s.
fn board(state: State) -> NodeRig {
    let mut board = match state {
        Home => proven(),
        Guest => guest(),
        Elsewhere | SilentTurn | OpenTurn => looking(),
    };
    board.pass_us(match state {
        SilentTurn => 40_000,
        OpenTurn => 40_000 + TURN_US,
        _ => 0,
    });
    board.timeline();
    board
}

/// The state of a board, which the question changes.
fn state(mut board: NodeRig) -> State {
    let is_at_home = board.bit_rate() == BitRate::Kbit125;
    match (board.node.is_listening(), is_at_home) {
        (true, true) => SilentTurn,
        (true, false) => Elsewhere,
        (false, true) => {
            board.see(Error);
            board.pass_us(TURN_US);
            if board.node.is_listening() { OpenTurn } else { Home }
        }
        (false, false) => {
            let home = board.number(0x2000, 5);
            if home == u32::from(board.bit_rate().kbit_per_s()) { Home } else { Guest }
        }
    }
}

/// The microseconds of silence after which a board leaves `from`, and its next state.
fn leaves(from: State, make: impl Fn() -> NodeRig) -> (u64, State) {
    for deadlines in 1..10 {
        let mut board = make();
        let begin = board.now();
        for _ in 0..deadlines {
            board.pass_us(board.us_to_deadline().expect("something changes"));
        }
        let us = board.now() - begin;
        let then = state(board);
        if then != from {
            return (us, then);
        }
    }
    panic!("{from:?} does not end");
}

/// A board after an event; its timeline is kept.
fn after(from: State, event: BusEvent) -> NodeRig {
    let mut board = board(from);
    board.see(event);
    board
}

/// The number of errors `spacing_ms` apart that make a board listen, and the time this takes in microseconds.
fn errors_until_it_listens(mut board: NodeRig, spacing_ms: u64) -> (u64, u64) {
    let begin = board.now();
    for count in 1..100_000 {
        board.see(Error);
        if board.node.is_listening() {
            return (count, board.now() - begin);
        }
        board.pass_ms(spacing_ms);
    }
    panic!("errors do not make it listen");
}

/// The time for which the heartbeats of a node wait after an event, in microseconds.
fn wait_us(event: BusEvent) -> u64 {
    let mut board = powered_on(BitRate::Kbit125, 1);
    board.is_acknowledged = false;
    board.see(event);
    board.us_to_deadline().expect("they go on")
}

fn time(us: u64) -> String {
    if us >= 1_000_000 {
        format!("{} s", us as f64 / 1_000_000.0)
    } else {
        format!("{} ms", us as f64 / 1_000.0)
    }
}

/// The causes of a transition between two states, in words.
fn causes(from: State, to: State) -> Vec<String> {
    let leads = |&&(event, _): &&(BusEvent, _)| from != to && state(after(from, event)) == to;
    let events: Vec<_> = EVENTS.iter().filter(leads).map(|&(_, name)| name).collect();
    let mut causes = vec![events.join(" or ")];
    let mut add = |condition: &str, (us, then): (u64, State)| {
        if then == to {
            causes.push(format!("{}{condition}", time(us)));
        }
    };
    match from {
        Elsewhere => {
            add(" after the first error", leaves(from, || after(from, FormError)));
            add(" without anything heard", leaves(from, second_look));
            add(" in the first look", leaves(from, || board(from)));
        }
        SilentTurn => {
            add(" without an error", leaves(from, || board(from)));
            add(" with an error", leaves(from, || after(from, Error)));
        }
        OpenTurn => {
            add(" after the first error", leaves(from, || after(from, Error)));
            add(" of silence", leaves(from, || board(from)));
            add(" if something was heard elsewhere", leaves(from, heard_elsewhere));
        }
        Home | Guest => {}
    }
    if (from, to) == (Home, Elsewhere) {
        let unproven = match errors_until_it_listens(unproven(), 100) {
            (1, _) => "an error".to_owned(),
            (count, _) => format!("{count} errors"),
        };
        let (proven_count, _) = errors_until_it_listens(proven(), 1_000);
        let (_, us) = errors_until_it_listens(proven(), 1);
        let (_, trust_us) = errors_until_it_listens(switched(), 1);
        let (trust, us) = (time(trust_us), time(us));
        causes.push(format!("no valid frame, but {unproven} at an unproven home rate or"));
        causes.push(format!(
            "{proven_count} over {us} at a proven one; not for {trust} after a switch"
        ));
    }
    if (from, to) == (Guest, SilentTurn) {
        let (count, _) = errors_until_it_listens(guest(), 100);
        causes.push(format!("{count} errors without a valid frame,"));
        let (us, then) = leaves(from, unanswered_guest);
        assert_eq!(then, to);
        causes.push(format!("or no acknowledge for {}", time(us)));
    }
    if (from, to) == (Guest, Home) {
        let mut board = board(from);
        board.lss("04 01");
        board.lss("15 00 00");
        assert_eq!((board.bit_rate(), state(board)), (BitRate::Kbit1000, to));
        causes.push("activate bit timing (15): the rate found is home".into());
    }
    causes.retain(|cause| !cause.is_empty());
    causes
}

/// A board in the open turn at home after a look that heard something.
fn heard_elsewhere() -> NodeRig {
    let mut board = after(Elsewhere, FormError);
    board.pass_us(40_000 + TURN_US);
    board
}

/// A board in a second look after it has heard something in the first.
fn second_look() -> NodeRig {
    let mut board = heard_elsewhere();
    board.pass_ms(150);
    board
}

/// A guest that has just sent an answer without receiving an acknowledge.
fn unanswered_guest() -> NodeRig {
    let mut board = board(Guest);
    board.lss("04 01");
    board.is_acknowledged = false;
    board.lss("5E");
    board
}

/// The effects, in words, of events that lead to no other state.
fn effects(of: State) -> Vec<String> {
    let effect = |&(event, name): &(BusEvent, &str)| {
        let mut board = after(of, event);
        let acts = board.timeline();
        if state(board) != of {
            return None;
        }
        let acts: Vec<_> = acts.iter().map(String::as_str).collect();
        Some(match acts[..] {
            [] if (of, event) == (Elsewhere, FormError) => format!("{name}: the rate stays"),
            [] => return None,
            ["0 ms listen at 800 kbit/s"] => format!("{name}: the next slower rate"),
            ["0 ms 125 kbit/s" | "0 ms 1000 kbit/s", "0 ms resume"] => {
                format!("{name}: the controller restarts,|frames wait {}", time(wait_us(event)))
            }
            ["0 ms stop", "0 ms resume"] if of == OpenTurn => {
                format!("{name}: frames are dropped and wait")
            }
            ["0 ms stop", "0 ms resume"] => {
                format!("{name} by reception:|frames are dropped and wait {}", time(wait_us(event)))
            }
            _ => panic!("{name}: no words for {acts:?}"),
        })
    };
    EVENTS.iter().filter_map(effect).collect()
}

fn place(of: State) -> String {
    let board = board(of);
    let act = if board.node.is_listening() { "listens silently" } else { "takes part" };
    let is_home = board.bit_rate() == BitRate::Kbit125;
    format!("{act} at {}", if is_home { "the home rate" } else { "another rate" })
}

/// Pixels: the upper left corners of the boxes.
const WIDTH: u32 = 246;
const HEIGHT: u32 = 128;
const LEFT: u32 = 20;
const GAP: u32 = 210;
const MIDDLE: u32 = LEFT + WIDTH + GAP;
const RIGHT: u32 = MIDDLE + WIDTH + GAP;
const TOP: u32 = 60;
const CENTRE: u32 = TOP + HEIGHT + 120;
const BOTTOM: u32 = CENTRE + HEIGHT + 90;

const BOXES: [(State, &str, u32, u32, &str); 5] = [
    (Guest, "guest", MIDDLE, TOP, "#e6f3e6"),
    (Home, "home", LEFT, CENTRE, "#e8eef7"),
    (OpenTurn, "open turn of home", MIDDLE, CENTRE, "#e8eef7"),
    (Elsewhere, "look elsewhere", RIGHT, CENTRE, "#fdf0df"),
    (SilentTurn, "silent turn of home", MIDDLE, BOTTOM, "#fdf0df"),
];

/// An arrow: from, to, its points, and the place of its text.
type Arrow = (State, State, &'static [[u32; 2]], [u32; 2]);

/// The number of letters that fit between two boxes.
const COLUMNS: usize = 30;

const UP: u32 = CENTRE - 36;
const SIDE: u32 = CENTRE + HEIGHT / 2;
const FAR: u32 = RIGHT + WIDTH + 24;
const END: u32 = MIDDLE + WIDTH;

#[rustfmt::skip]
const ARROWS: [Arrow; 10] = [
    (Home, Elsewhere, &[[LEFT + 180, CENTRE], [LEFT + 180, UP], [RIGHT + 60, UP], [RIGHT + 60, CENTRE]], [LEFT + 196, UP - 24]),
    (Elsewhere, Guest, &[[RIGHT + 180, CENTRE], [RIGHT + 180, TOP + 90], [END, TOP + 90]], [END + 20, TOP + 82]),
    (Guest, Home, &[[MIDDLE, TOP + 64], [LEFT + 60, TOP + 64], [LEFT + 60, CENTRE]], [LEFT + 76, TOP + 56]),
    (Guest, SilentTurn, &[[END, TOP + 34], [FAR, TOP + 34], [FAR, BOTTOM + 112], [END, BOTTOM + 112]], [END + 20, TOP + 10]),
    (Elsewhere, SilentTurn, &[[RIGHT + 180, CENTRE + HEIGHT], [RIGHT + 180, BOTTOM + 78], [END, BOTTOM + 78]], [END + 20, BOTTOM + 38]),
    (SilentTurn, Elsewhere, &[[END, BOTTOM + 20], [RIGHT + 60, BOTTOM + 20], [RIGHT + 60, CENTRE + HEIGHT]], [END + 20, BOTTOM + 12]),
    (SilentTurn, OpenTurn, &[[MIDDLE + 60, BOTTOM], [MIDDLE + 60, CENTRE + HEIGHT]], [MIDDLE + 70, CENTRE + HEIGHT + 40]),
    (SilentTurn, Home, &[[MIDDLE, BOTTOM + 64], [LEFT + 120, BOTTOM + 64], [LEFT + 120, CENTRE + HEIGHT]], [LEFT + 136, BOTTOM + 56]),
    (OpenTurn, Home, &[[MIDDLE, SIDE], [LEFT + WIDTH, SIDE]], [LEFT + WIDTH + 14, SIDE + 20]),
    (OpenTurn, Elsewhere, &[[END, SIDE], [RIGHT, SIDE]], [END + 14, SIDE + 20]),
];

fn lines(x: u32, y: u32, lines: &[String]) -> String {
    let line = |(y, line): (u32, &String)| format!("<text x=\"{x}\" y=\"{y}\">{line}</text>\n");
    (y..).step_by(16).zip(lines).map(line).collect()
}

/// Breaks a line that does not fit between two boxes.
fn wrap(text: &str) -> Vec<String> {
    let mut lines = vec![String::new()];
    for word in text.split(' ') {
        let line = lines.last_mut().expect("a line");
        if line.is_empty() {
            line.push_str(word);
        } else if line.len() + 1 + word.len() <= COLUMNS {
            *line += " ";
            *line += word;
        } else {
            lines.push(word.to_owned());
        }
    }
    lines
}

fn draw_box(&(of, name, x, y, fill): &(State, &str, u32, u32, &str)) -> String {
    let words: Vec<_> = [place(of)].into_iter().chain(effects(of)).collect();
    let words: Vec<_> = words.iter().flat_map(|line| line.split('|')).map(str::to_owned).collect();
    let (text_x, name_y) = (x + 12, y + 24);
    format!(
        r##"<rect x="{x}" y="{y}" width="{WIDTH}" height="{HEIGHT}" rx="10" fill="{fill}" stroke="#888"/>
<text x="{text_x}" y="{name_y}" font-size="15" font-weight="bold">{name}</text>
"##
    ) + &lines(text_x, y + 44, &words)
}

fn draw_arrow(&(from, to, points, [x, y]): &Arrow) -> String {
    let causes = causes(from, to);
    assert!(!causes.is_empty(), "nothing leads from {from:?} to {to:?}");
    let is_between_boxes = from == OpenTurn;
    let words = if is_between_boxes {
        causes.iter().flat_map(|cause| wrap(cause)).collect()
    } else {
        causes
    };
    let points: Vec<_> = points.iter().map(|[x, y]| format!("{x},{y}")).collect();
    let points = points.join(" ");
    format!(
        r##"<polyline points="{points}" fill="none" stroke="#4a7ab5" stroke-width="1.5" marker-end="url(#tip)"/>
"##
    ) + &lines(x, y, &words)
}

const LEGEND: [&str; 4] = [
    "Home is the rate that was stored at power-on or activated since, here 125 kbit/s. It is proven by a valid frame or an acknowledge.",
    "An error is a stuff, form, CRC or bit recessive error. Automatic detection (index 9) is not shown.",
    "Not shown either: a bus that is held dominant ends a search, and the boot-up of another node does not make a guest.",
    "Drawn by tests/library/supervision_states.rs from the behaviour of the node.",
];

fn draw() -> String {
    for (from, ..) in BOXES {
        for (to, ..) in BOXES {
            let has_arrow = ARROWS.iter().any(|arrow| (arrow.0, arrow.1) == (from, to));
            assert!(from == to || has_arrow != causes(from, to).is_empty(), "{from:?} to {to:?}");
        }
    }
    let (width, height) = (FAR + 20, BOTTOM + HEIGHT + 92);
    let legend_y = height - 60;
    let (start_x, start_y) = (LEFT + 40, CENTRE + HEIGHT + 50);
    assert_eq!(state(powered_on(BitRate::Kbit125, 0)), Home);
    let legend = LEGEND.map(str::to_owned);
    format!(
        r##"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="12">
<defs><marker id="tip" viewBox="0 0 10 10" refX="10" refY="5" markerWidth="9" markerHeight="9" orient="auto"><path d="M 0 0 L 10 5 L 0 10 z" fill="#4a7ab5"/></marker></defs>
<rect width="100%" height="100%" fill="white"/>
<text x="{LEFT}" y="28" font-size="16">The bit-rate supervision: where a node takes part or listens, and the causes of each transition</text>
<circle cx="{start_x}" cy="{start_y}" r="6" fill="#444"/>
<text x="{}" y="{}">power-on</text>
<polyline points="{start_x},{start_y} {start_x},{}" fill="none" stroke="#4a7ab5" stroke-width="1.5" marker-end="url(#tip)"/>
"##,
        start_x + 14,
        start_y + 4,
        CENTRE + HEIGHT
    ) + &BOXES.iter().map(draw_box).collect::<String>()
        + &ARROWS.iter().map(draw_arrow).collect::<String>()
        + &lines(LEFT, legend_y, &legend)
        + "</svg>\n"
}

#[test]
fn the_diagram_shows_the_states_of_the_supervision() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/bit-rate-supervision.svg");
    let drawn = draw();
    if env::var_os("WRITE_DIAGRAM").is_some() {
        fs::write(&path, &drawn).expect("docs can be written");
    }
    let file = fs::read_to_string(&path).expect("docs/bit-rate-supervision.svg");
    assert!(
        file.replace("\r\n", "\n") == drawn,
        "docs/bit-rate-supervision.svg is out of date: WRITE_DIAGRAM=1 cargo test --test library supervision_states"
    );
}
