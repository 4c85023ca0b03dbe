//! The report as one HTML page, with the answer times and the switches of the bit rate drawn as SVG.

use ::conformance::{head_table, page};
use can_bus::svg::{bar, escape, label};

use super::{Answer, Outcome, Report, Switch, text};

/// The width of a drawing, and of the margins of its plot.
const WIDTH: f64 = 720.0;
const LEFT: f64 = 90.0;
const RIGHT: f64 = 36.0;
const PLOT: f64 = WIDTH - LEFT - RIGHT;

pub fn whole(report: &Report) -> String {
    let mut rows = String::new();
    for check in &report.checks {
        let class = match check.outcome {
            Outcome::Passed => "",
            Outcome::Failed => "failed",
            Outcome::NotTried => "skipped",
        };
        let outcome = text::outcome(check);
        let expected = check.expected.as_deref().unwrap_or_default();
        let cells = [check.session, &check.what, outcome, expected, &check.seen, check.rule];
        let cells = cells.map(|cell| format!("<td>{}</td>", escape(cell)));
        rows += &format!("<tr class=\"{class}\">{}</tr>\n", cells.concat());
    }
    let lines = report.bench.iter().chain(&report.boards);
    let bench: String = lines.map(|line| format!("<li>{}</li>\n", escape(line))).collect();
    page(
        "cargo hil",
        &format!(
            "{}<ul>\n{bench}</ul>\n<pre>{}</pre>\n{}{}<h2>All checks</h2>\n<table>\
             <tr><th>session<th>check<th>outcome<th>expected<th>seen<th>rule</tr>\n{rows}</table>\n",
            head_table(report.head.lines()),
            escape(text::summary(report).trim()),
            histograms(&report.answers),
            switches(&report.switches)
        ),
    )
}

/// A drawing with its heading and an explanation.
fn drawing(heading: &str, explanation: &str, height: f64, content: &str) -> String {
    format!(
        "<h2>{heading}</h2>\n<p>{explanation}</p>\n<svg width=\"{WIDTH}\" height=\"{height}\" \
         viewBox=\"0 0 {WIDTH} {height}\" role=\"img\">\n{content}</svg>\n"
    )
}

/// A histogram of the answer times for each bit rate.
fn histograms(answers: &[Answer]) -> String {
    const BINS: usize = 40;
    const ROW: f64 = 60.0;
    const WIDTH_OF_BIN: f64 = PLOT / BINS as f64;
    let ms = |answer: &Answer| answer.us as f64 / 1e3;
    let longest = answers.iter().map(ms).fold(0.0, f64::max);
    if longest == 0.0 {
        return String::new();
    }
    let step = (longest / BINS as f64).max(0.05);
    let mut rates: Vec<u16> = answers.iter().map(|answer| answer.kbit_per_s).collect();
    rates.sort_by(|a, b| b.cmp(a));
    rates.dedup();
    let mut content = String::new();
    let mut base = 0.0;
    for rate in rates {
        base += ROW;
        let mut counts = [0_usize; BINS];
        for answer in answers.iter().filter(|answer| answer.kbit_per_s == rate) {
            counts[((ms(answer) / step) as usize).min(BINS - 1)] += 1;
        }
        let most = counts.iter().copied().max().unwrap_or(1) as f64;
        content += &label(LEFT - 8.0, base - 4.0, "end", &format!("{rate} kbit/s"));
        for (bin, &count) in counts.iter().enumerate().filter(|(_, count)| **count > 0) {
            let (x, height) =
                (LEFT + bin as f64 * WIDTH_OF_BIN, (ROW - 12.0) * count as f64 / most);
            let (from, to) = (bin as f64 * step, (bin + 1) as f64 * step);
            let title = format!("{count} of {from:.2} to {to:.2} ms");
            content += &bar(x, base - height, [WIDTH_OF_BIN - 1.0, height], "#3b7dd8", &title);
        }
        content += &bar(LEFT, base, [PLOT, 1.0], "#999", "");
    }
    for quarter in 0..=4 {
        let part = f64::from(quarter) / 4.0;
        let text = format!("{:.1} ms", part * step * BINS as f64);
        content += &label(LEFT + part * PLOT, base + 16.0, "middle", &text);
    }
    let explanation = "From a request to its answer at the computer, both frames and the adapter's latency included.";
    drawing("Answer times", explanation, base + 24.0, &content)
}

/// The time line of each switch.
fn switches(switches: &[Switch]) -> String {
    const ROW: f64 = 84.0;
    if switches.is_empty() {
        return String::new();
    }
    let mut content = String::new();
    for (row, switch) in switches.iter().enumerate() {
        let Switch { from_kbit_per_s: from, to_kbit_per_s: to, delay_ms, .. } = switch;
        let delay = f64::from(*delay_ms);
        let end = switch.first_frame_ms.unwrap_or(0.0).max(2.0 * delay) * 1.1 + 1.0;
        let x = |ms: f64| LEFT + (ms.clamp(-0.05 * end, end) + 0.05 * end) / (1.05 * end) * PLOT;
        let y = row as f64 * ROW + 30.0;
        let title = format!("{from} to {to} kbit/s, switch delay {delay_ms} ms");
        content += &label(LEFT, y - 12.0, "start", &title);
        for (begin, color) in [(0.0, "#f2c14e"), (delay, "#f7dd9c")] {
            content += &bar(x(begin), y, [x(begin + delay) - x(begin), 22.0], color, "");
        }
        for (ms, is_acknowledged) in &switch.acknowledged {
            let color = if *is_acknowledged { "#2b8a3e" } else { "#c92a2a" };
            content += &bar(x(*ms) - 4.0, y + 7.0, [8.0, 8.0], color, "");
        }
        let frames = [
            (Some(switch.last_frame_ms), "last frame", "start"),
            (switch.first_frame_ms, "first frame", "end"),
        ];
        for (ms, name, anchor) in frames {
            let Some(ms) = ms else { continue };
            content += &bar(x(ms) - 1.0, y - 4.0, [2.0, 30.0], "#1b4f9c", "");
            content += &label(x(ms), y + 40.0, anchor, &format!("{name} {ms:.0} ms"));
        }
    }
    let explanation = "Time zero is the request to activate. In the dark period the board stays at the old rate, in \
                       the light one at the new; it must send in neither. Green: a frame of the master was \
                       acknowledged; red: it was not.";
    drawing("Switches of the bit rate", explanation, switches.len() as f64 * ROW + 10.0, &content)
}
