//! A timing diagram of a bit-rate switch, drawn from the record of a run: senders, times and rates.

use std::time::Duration;

use anyhow::Context;
use can_bus::svg::{Plot, Scale, Step, Timeline, colored_label, label};
use emulator::{
    Time,
    can::{Frame, Id},
    network::{Event, Source, What},
};
use lss_slave::lss::{self, Request};

/// The time shown before the request and after the second delay.
const MARGIN: Time = Time::from_ms(12);
/// Pixels for a millisecond.
const PER_MS: f64 = 62.0;
/// The greatest width of a period without events.
const LONGEST_GAP: f64 = 210.0;
const LEFT: f64 = 110.0;
const RIGHT: f64 = 50.0;
const TOP: f64 = 66.0;
/// The height of the master's line, and the distance to the line of each board.
const MASTER: f64 = 100.0;
const LANE: f64 = 65.0;
const BOX_HEIGHT: f64 = 26.0;
const GRAY: &str = "#666";
const RED: &str = "#c03028";

/// The diagram of the last activation of bit timing among `events`, as SVG.
///
/// # Errors
/// There is no activation, or its delays have not passed.
pub fn draw(events: &[Event]) -> anyhow::Result<String> {
    let (t0, delay) =
        events.iter().rev().find_map(activation).context("no bit rate was switched")?;
    let (t1, t2) = (t0 + delay, t0 + delay * 2);
    let is_shown =
        |event: &&Event| t0.saturating_sub(MARGIN) <= event.time && event.time <= t2 + MARGIN;
    let shown: Vec<&Event> = events.iter().filter(is_shown).collect();
    let scale = scale(&shown, [t0, t1, t2]);
    let right = scale.x(Duration::MAX) + RIGHT;
    let boards = events.iter().filter_map(|event| match event.source {
        Source::Board(number) => Some(number + 1),
        Source::Adapter(_) => None,
    });
    let boards = boards.max().unwrap_or(0);
    let bottom = lane(Source::Board(boards)) + 6.0;
    let title = format!("Activate bit timing, switch delay {} ms", delay.as_ms());
    let plot = Plot { left: LEFT, right: right - RIGHT / 2.0, top: TOP, bottom };
    let mut diagram = Timeline::new([right, bottom + 64.0], &title, plot, scale);
    for (from, to, color, name, rule) in
        [(t0, t1, "#e8eef7", "d1", "old bit rate"), (t1, t2, "#fdf0df", "d2", "new bit rate")]
    {
        let name = format!("{name} = {} ms", delay.as_ms());
        let [from, to] = diagram.shade([from, to].map(span), TOP, color, &name);
        for (y, text) in [
            (TOP - 10.0, &*name),
            (bottom - 20.0, &format!("{rule}:")),
            (bottom - 6.0, "no frame is started"),
        ] {
            diagram.svg += &label((from + to) / 2.0, y, "middle", text);
        }
    }
    let names = (0..boards).map(|number| (lane(Source::Board(number)), format!("board {number}")));
    for (y, name) in [(MASTER, "LSS master".to_owned())].into_iter().chain(names) {
        diagram.svg += &label(16.0, y + 4.0, "start", &name);
        diagram.lane(y);
    }
    for (time, name) in [(t0, "t0"), (t1, "t0 + d1"), (t2, "t0 + d1 + d2")] {
        let x = diagram.line(span(time), "stroke=\"#444\" stroke-dasharray=\"4 3\"");
        let ms = format!("{:.3} ms", time.as_us() as f64 / 1000.0);
        diagram.svg += &label(x, bottom + 16.0, "middle", name);
        diagram.svg += &colored_label(x, bottom + 32.0, "middle", GRAY, &ms);
    }
    for event in shown {
        draw_event(&mut diagram, event, event.source);
        if let What::Frame { also, .. } = &event.what {
            also.iter().for_each(|source| draw_event(&mut diagram, event, *source));
        }
    }
    let words = format!(
        "Frames to scale, one millisecond is {PER_MS} pixels; long silences are shortened."
    );
    diagram.svg += &colored_label(16.0, bottom + 54.0, "start", GRAY, &words);
    Ok(diagram.finish())
}

/// The height of a station's line.
fn lane(source: Source) -> f64 {
    match source {
        Source::Adapter(_) => MASTER,
        Source::Board(number) => MASTER + LANE * (number + 1) as f64,
    }
}

/// Draws an event on the line of `source`, its sender or a participant.
fn draw_event(diagram: &mut Timeline, event: &Event, source: Source) {
    let (y, to) = (lane(source), span(event.time));
    match &event.what {
        What::Frame { frame, start, bit_rate, .. } => {
            let from = span(*start);
            let (title, rate) = (short(frame), format!("{} kbit/s", bit_rate / 1000));
            let step = Step { from, to, is_moment: false, color: "#4a7ab5", title: title.clone() };
            for x in diagram.steps(y - BOX_HEIGHT / 2.0, BOX_HEIGHT, &[step]) {
                diagram.svg += &small(&label(x, y - 18.0, "middle", &title));
                diagram.svg += &small(&colored_label(x, y + 26.0, "middle", GRAY, &rate));
            }
        }
        What::BitTiming { bit_rate, .. } => {
            let words = format!("goes to {} kbit/s", bit_rate / 1000);
            let x = diagram.scale.x(to);
            diagram.svg += &format!("<path d=\"M {x:.1} {y} l -6 -12 h 12 z\" fill=\"{RED}\"/>\n");
            diagram.svg += &colored_label(x + 9.0, y - 6.0, "start", RED, &words);
        }
        _ => {}
    }
}

/// A text in a size that fits a frame.
fn small(text: &str) -> String {
    format!("<g font-size=\"9\">{text}</g>\n")
}

/// The end of the request and the switch delay, if this is one to activate a bit rate.
fn activation(event: &Event) -> Option<(Time, Time)> {
    match event.what {
        What::Frame { frame, .. } if frame.id == Id::Standard(lss::REQUEST_COB_ID) => {
            match Request::from_bytes(&frame.data)? {
                Request::ActivateBitTiming(ms) => Some((event.time, Time::from_ms(ms.into()))),
                _ => None,
            }
        }
        _ => None,
    }
}

/// Identifier and data of a frame, without the zeros at the end of an LSS message.
fn short(frame: &Frame) -> String {
    let mut data = frame.payload();
    while data.len() > 1 && data.ends_with(&[0]) {
        data = &data[..data.len() - 1];
    }
    data.iter().fold(format!("{}:", frame.id), |text, byte| format!("{text} {byte:02X}"))
}

/// The scale of the time, with all instants of interest.
fn scale(events: &[&Event], others: [Time; 3]) -> Scale {
    let mut times: Vec<Time> = others.into();
    for event in events {
        match event.what {
            What::Frame { start, .. } => times.extend([start, event.time]),
            What::BitTiming { .. } => times.push(event.time),
            _ => {}
        }
    }
    Scale::new(times.into_iter().map(span).collect(), LEFT, 1000.0 * PER_MS, LONGEST_GAP)
}

fn span(time: Time) -> Duration {
    Duration::from_nanos(time.as_ns())
}
