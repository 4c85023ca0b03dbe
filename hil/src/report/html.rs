//! The report as one HTML page, with the answer times and the switches of the bit rate drawn as SVG.

use canopen_node::BitRate;

use super::{Answer, Outcome, Report, Switch, text};

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;max-width:60em;margin:2em auto;padding:0 1em;color:#222}\
    table{border-collapse:collapse;width:100%}td,th{padding:.2em .6em;border-bottom:1px solid #ddd;text-align:left;\
    vertical-align:top}.failed{background:#fde8e8}.not{color:#777}pre{background:#f5f5f5;padding:1em;white-space:\
    pre-wrap}svg{display:block;margin:.5em 0 1.5em}svg text{font:12px system-ui,sans-serif;fill:#333}";

/// The width of a drawing, and of the margins of its plot.
const WIDTH: f64 = 720.0;
const LEFT: f64 = 90.0;
const RIGHT: f64 = 36.0;

pub fn whole(report: &Report) -> String {
    let mut rows = String::new();
    for check in &report.checks {
        let (class, outcome, expected) = match &check.outcome {
            Outcome::Passed => ("", "passed", String::new()),
            Outcome::Failed { expected } => ("failed", "FAILED", format!(", expected {expected}")),
            Outcome::NotTried => ("not", "not tried", String::new()),
        };
        rows += &format!(
            "<tr class=\"{class}\"><td>{}</td><td>{}</td><td>{outcome}</td><td>{}{}</td></tr>\n",
            check.session,
            escape(&check.what),
            escape(&check.seen),
            escape(&expected)
        );
    }
    let bench: String = report
        .bench
        .iter()
        .chain(&report.boards)
        .map(|line| format!("<li>{}</li>\n", escape(line)))
        .collect();
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><meta charset=\"utf-8\"><title>cargo hil</title><style>{STYLE}</style>\n\
         <h1>cargo hil</h1>\n<p>Adapter: {}</p>\n<ul>\n{bench}</ul>\n<pre>{}</pre>\n{}{}\
         <h2>All checks</h2>\n<table><tr><th>session<th>check<th>outcome<th>seen</tr>\n{rows}</table>\n</html>\n",
        escape(&report.adapter),
        escape(text::summary(report).trim()),
        histograms(&report.answers),
        switches(&report.switches)
    )
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

fn label(x: f64, y: f64, anchor: &str, text: &str) -> String {
    format!("<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{}</text>\n", escape(text))
}

fn drawing(height: f64, content: &str) -> String {
    format!(
        "<svg width=\"{WIDTH}\" height=\"{height}\" viewBox=\"0 0 {WIDTH} {height}\" role=\"img\">\n{content}</svg>\n"
    )
}

/// A histogram of the answer times for each bit rate.
fn histograms(answers: &[Answer]) -> String {
    const BINS: usize = 40;
    const ROW: f64 = 60.0;
    let longest = answers.iter().map(|answer| answer.time.as_secs_f64() * 1e3).fold(0.0, f64::max);
    if longest == 0.0 {
        return String::new();
    }
    let step = (longest / BINS as f64).max(0.05);
    let width = (WIDTH - LEFT - RIGHT) / BINS as f64;
    let rates: Vec<_> = BitRate::ALL
        .into_iter()
        .filter(|rate| answers.iter().any(|answer| answer.rate == *rate))
        .collect();
    let mut content = String::new();
    for (row, rate) in rates.iter().enumerate() {
        let mut counts = [0_usize; BINS];
        for answer in answers.iter().filter(|answer| answer.rate == *rate) {
            let bin = (answer.time.as_secs_f64() * 1e3 / step) as usize;
            counts[bin.min(BINS - 1)] += 1;
        }
        let most = counts.iter().copied().max().unwrap_or(1) as f64;
        let base = (row as f64 + 1.0) * ROW;
        content += &label(LEFT - 8.0, base - 4.0, "end", &format!("{} kbit/s", rate.kbit_per_s()));
        for (bin, &count) in counts.iter().enumerate().filter(|(_, count)| **count > 0) {
            let height = (ROW - 12.0) * count as f64 / most;
            content += &format!(
                "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{height:.1}\" fill=\"#3b7dd8\"><title>{count} \
                 of {:.2} to {:.2} ms</title></rect>\n",
                LEFT + bin as f64 * width,
                base - height,
                width - 1.0,
                bin as f64 * step,
                (bin + 1) as f64 * step
            );
        }
        content += &format!(
            "<line x1=\"{LEFT}\" x2=\"{:.1}\" y1=\"{base}\" y2=\"{base}\" stroke=\"#999\"/>\n",
            WIDTH - RIGHT
        );
    }
    let height = rates.len() as f64 * ROW;
    for quarter in 0..=4_usize {
        let bin = quarter * BINS / 4;
        let text = format!("{:.1} ms", bin as f64 * step);
        content += &label(LEFT + bin as f64 * width, height + 16.0, "middle", &text);
    }
    let heading = "<h2>Answer times</h2>\n<p>From a request to its answer at the computer, both frames and the \
                   adapter's latency included.</p>\n";
    heading.to_owned() + &drawing(height + 24.0, &content)
}

/// The time line of each switch.
fn switches(switches: &[Switch]) -> String {
    const ROW: f64 = 84.0;
    if switches.is_empty() {
        return String::new();
    }
    let mut content = String::new();
    for (row, switch) in switches.iter().enumerate() {
        let delay = f64::from(switch.delay_ms);
        let end = switch.first_frame.unwrap_or(0.0).max(2.0 * delay) * 1.1 + 1.0;
        let x = |ms: f64| {
            LEFT + (ms.clamp(-0.05 * end, end) + 0.05 * end) / (1.05 * end) * (WIDTH - LEFT - RIGHT)
        };
        let y = row as f64 * ROW + 30.0;
        let title = format!(
            "{} to {} kbit/s, switch delay {} ms",
            switch.from.kbit_per_s(),
            switch.to.kbit_per_s(),
            switch.delay_ms
        );
        content += &label(LEFT, y - 12.0, "start", &title);
        for (from, to, color) in [(0.0, delay, "#f2c14e"), (delay, 2.0 * delay, "#f7dd9c")] {
            content += &format!(
                "<rect x=\"{:.1}\" y=\"{y:.1}\" width=\"{:.1}\" height=\"22\" fill=\"{color}\"/>\n",
                x(from),
                x(to) - x(from)
            );
        }
        for (at, is_acknowledged) in &switch.acknowledged {
            let color = if *is_acknowledged { "#2b8a3e" } else { "#c92a2a" };
            content += &format!(
                "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"4\" fill=\"{color}\"/>\n",
                x(*at),
                y + 11.0
            );
        }
        for (at, name) in
            [(Some(switch.last_frame), "last frame"), (switch.first_frame, "first frame")]
        {
            let Some(at) = at else { continue };
            let place = x(at);
            content += &format!(
                "<line x1=\"{place:.1}\" x2=\"{place:.1}\" y1=\"{:.1}\" y2=\"{:.1}\" stroke=\"#1b4f9c\" \
                 stroke-width=\"2\"/>\n",
                y - 4.0,
                y + 26.0
            );
            let anchor = if name == "last frame" { "start" } else { "end" };
            content += &label(place, y + 40.0, anchor, &format!("{name} {at:.0} ms"));
        }
    }
    let heading = "<h2>Switches of the bit rate</h2>\n<p>Time zero is the request to activate. In the dark period \
                   the board stays at the old rate, in the light one at the new; it must send in neither. Green: a \
                   frame of the master was acknowledged; red: it was not.</p>\n";
    heading.to_owned() + &drawing(switches.len() as f64 * ROW + 10.0, &content)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn the_page_draws_answers_and_switches_and_escapes_text() {
        let mut report = Report::new("slcan:<x>".into());
        assert!(!whole(&report).contains("<svg"), "nothing to draw");
        report.answers =
            vec![Answer { rate: BitRate::Kbit125, time: Duration::from_micros(2500) }; 3];
        report.switches.push(Switch {
            from: BitRate::Kbit125,
            to: BitRate::Kbit500,
            delay_ms: 200,
            last_frame: -1.0,
            first_frame: Some(401.0),
            acknowledged: vec![(100.0, true), (300.0, false)],
        });
        report.failed("a & b", "<1>", "2");
        let page = whole(&report);
        assert_eq!(page.matches("<svg").count(), 2);
        assert!(
            page.contains("<title>3 of 2.44 to 2.50 ms") || page.contains("<title>3 of 2.50"),
            "{page}"
        );
        assert!(page.contains("first frame 401 ms") && page.contains("#c92a2a"));
        assert!(
            page.contains("slcan:&lt;x&gt;")
                && page.contains("a &amp; b")
                && page.contains("&lt;1&gt;")
        );
    }
}
