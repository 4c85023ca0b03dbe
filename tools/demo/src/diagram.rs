//! A timing diagram of a bit-rate switch, drawn from the record of a run: senders, times and rates.

use std::{fmt::Write, time::Duration};

use anyhow::Context;
use can_bus::svg::Scale;
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
    let [x0, x1, x2] = [t0, t1, t2].map(|time| scale.x(span(time)));
    let width = scale.x(Duration::MAX) + RIGHT;
    let boards = events.iter().filter_map(|event| match event.source {
        Source::Board(number) => Some(number + 1),
        Source::Adapter(_) => None,
    });
    let boards = boards.max().unwrap_or(0);
    let bottom = lane(Source::Board(boards)) + 6.0;
    let last = bottom + 64.0;

    let mut svg = String::new();
    writeln!(
        svg,
        r#"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0} {last}" font-family="sans-serif" font-size="12">
<rect width="100%" height="100%" fill="white"/>
<text x="10" y="24" font-size="16">Activate bit timing, switch delay {} ms</text>"#,
        delay.as_ms()
    )?;
    for (from, to, fill, name, rule) in
        [(x0, x1, "#e8eef7", "d1", "old bit rate"), (x1, x2, "#fdf0df", "d2", "new bit rate")]
    {
        let (middle, span) = ((from + to) / 2.0, to - from);
        let (height, above, below) = (bottom - TOP, bottom - 20.0, bottom - 6.0);
        writeln!(
            svg,
            r#"<rect x="{from:.1}" y="{TOP}" width="{span:.1}" height="{height}" fill="{fill}"/>
<text x="{middle:.1}" y="56" text-anchor="middle">{name} = {} ms</text>
<text x="{middle:.1}" y="{above}" text-anchor="middle">{rule}:</text>
<text x="{middle:.1}" y="{below}" text-anchor="middle">no frame is started</text>"#,
            delay.as_ms()
        )?;
    }
    let names = (0..boards).map(|number| (lane(Source::Board(number)), format!("board {number}")));
    for (y, name) in [(MASTER, "LSS master".to_owned())].into_iter().chain(names) {
        let (text, to) = (y + 4.0, width - RIGHT / 2.0);
        writeln!(
            svg,
            r##"<text x="10" y="{text}">{name}</text>
<line x1="{LEFT}" y1="{y}" x2="{to:.1}" y2="{y}" stroke="#888"/>"##
        )?;
    }
    for (time, x, name) in [(t0, x0, "t0"), (t1, x1, "t0 + d1"), (t2, x2, "t0 + d1 + d2")] {
        let (above, below) = (bottom + 16.0, bottom + 32.0);
        writeln!(
            svg,
            r##"<line x1="{x:.1}" y1="{TOP}" x2="{x:.1}" y2="{bottom}" stroke="#444" stroke-dasharray="4 3"/>
<text x="{x:.1}" y="{above}" text-anchor="middle">{name}</text>
<text x="{x:.1}" y="{below}" text-anchor="middle" fill="#666">{:.3} ms</text>"##,
            time.as_us() as f64 / 1000.0
        )?;
    }
    for event in shown {
        draw_event(&mut svg, event, event.source, &scale)?;
        if let What::Frame { also, .. } = &event.what {
            for source in also {
                draw_event(&mut svg, event, *source, &scale)?;
            }
        }
    }
    writeln!(
        svg,
        r##"<text x="10" y="{}" fill="#666">Frames to scale, one millisecond is {PER_MS} pixels; long silences are shortened.</text>
</svg>"##,
        bottom + 54.0
    )?;
    Ok(svg)
}

/// The height of a station's line.
fn lane(source: Source) -> f64 {
    match source {
        Source::Adapter(_) => MASTER,
        Source::Board(number) => MASTER + LANE * (number + 1) as f64,
    }
}

/// Draws an event on the line of `source`, its sender or a participant.
fn draw_event(
    svg: &mut String,
    event: &Event,
    source: Source,
    scale: &Scale,
) -> anyhow::Result<()> {
    let y = lane(source);
    let end = scale.x(span(event.time));
    match &event.what {
        What::Frame { frame, start, bit_rate, .. } => {
            let (x, rate) = (scale.x(span(*start)), bit_rate / 1000);
            let (width, middle) = (end - x, (x + end) / 2.0);
            let (corner, above, below) = (y - BOX_HEIGHT / 2.0, y - 18.0, y + 26.0);
            writeln!(
                svg,
                r##"<rect x="{x:.1}" y="{corner}" width="{width:.1}" height="{BOX_HEIGHT}" fill="#4a7ab5"/>
<text x="{middle:.1}" y="{above}" text-anchor="middle" font-size="9">{}</text>
<text x="{middle:.1}" y="{below}" text-anchor="middle" font-size="9" fill="#666">{rate} kbit/s</text>"##,
                short(frame)
            )?;
        }
        What::BitTiming { bit_rate, .. } => writeln!(
            svg,
            r##"<path d="M {end:.1} {y} l -6 -12 h 12 z" fill="#c03028"/>
<text x="{:.1}" y="{}" font-size="11" fill="#c03028">goes to {} kbit/s</text>"##,
            end + 9.0,
            y - 6.0,
            bit_rate / 1000
        )?,
        _ => {}
    }
    Ok(())
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
