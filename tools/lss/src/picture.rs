//! A picture of a run, as SVG: the network, what was done with each board and when, and what each has got.

mod history;

use std::time::Duration;

use can_bus::{
    explain::wrapped_at,
    svg::{Plot, Scale, Step, Timeline, bar, colored_label, escape, label, moment},
};

use crate::recorder::Entry;
use history::{Board, History, Kind, Lane};

const WIDTH: f64 = 1200.0;
const MARGIN: f64 = 16.0;
/// The wire of the bus, and the boxes at it.
const WIRE: f64 = 30.0;
const BOX: f64 = 56.0;
const BOX_WIDTH: f64 = 322.0;
const BADGE: f64 = 44.0;
/// The time axis.
const LEFT: f64 = 402.0;
const PLOT: f64 = 514.0;
const RIGHT: f64 = LEFT + PLOT;
/// The words on what a board has got, and how many characters have room there.
const WORDS: f64 = RIGHT + 10.0;
const LONGEST: usize = 42;
/// The rows: where the first one begins, and how high each is.
const TOP: f64 = 124.0;
const ROW: f64 = 46.0;
const BOX_HEIGHT: f64 = 38.0;
/// A silence is drawn as if it was this long at most.
const SILENCE: Duration = Duration::from_secs(1);
/// The characters of a line below the rows.
const LINE: usize = 165;

/// What the picture says besides the frames.
pub struct Caption {
    /// The command.
    pub title: String,
    /// The adapter, and when the run began.
    pub line: String,
    /// Why the command failed.
    pub failure: Option<String>,
}

/// Draws the run.
pub fn draw(entries: &[Entry], caption: &Caption) -> String {
    let mut history = History::of(entries);
    history.boards.sort_by_key(|board| board.id.unwrap_or(0xFF));
    let scale = scale(&history);
    let bottom = TOP + ROW * (history.boards.len() + 1) as f64;
    let failure = caption.failure.iter().flat_map(|text| text.lines());
    let failure: String = failure.map(|line| wrapped_at(LINE, line, 0) + "\n").collect();
    let height = bottom + 34.0 + 18.0 * failure.lines().count() as f64;
    let plot = Plot { left: LEFT, right: RIGHT, top: TOP, bottom };
    let mut picture = Timeline::new([WIDTH, height], &caption.title, plot, scale);
    picture.svg += &gray(MARGIN, 50.0, "start", &caption.line);
    picture.svg += &legend();
    rates(&mut picture, &history);
    picture.marks(history.end);
    picture.svg += &network(&history, bottom);
    lane(&mut picture, &history.master, center(0));
    for (row, board) in history.boards.iter().enumerate() {
        let (y, [first, second]) = (center(row + 1), outcome(board, &history));
        lane(&mut picture, &board.lane, y);
        let [first, second] = [first, second].map(|words| beginning(&words));
        let color = if board.problem.is_some() { "#c92a2a" } else { "#222" };
        picture.svg += &colored_label(WORDS, y - 3.0, "start", color, &first);
        picture.svg += &gray(WORDS, y + 13.0, "start", &second);
    }
    for (line, y) in failure.lines().zip((0..).map(|line| bottom + 42.0 + 18.0 * f64::from(line))) {
        picture.svg += &colored_label(MARGIN, y, "start", "#c92a2a", line);
    }
    picture.finish()
}

/// The middle of a row; the first one is the master's.
fn center(row: usize) -> f64 {
    TOP + ROW * (row as f64 + 0.5)
}

fn gray(x: f64, y: f64, anchor: &str, text: &str) -> String {
    colored_label(x, y, anchor, "#666", text)
}

/// The color of each [`Kind`] of steps, and its name in the legend.
const LOOKS: [(&str, &str); 7] = [
    ("#a9c1dd", "Fastscan"),
    ("#8d7bb8", "asked"),
    ("#1b4f9c", "configured"),
    ("#e8860c", "stored"),
    ("#868e96", "reset or switch"),
    ("#2b8a3e", "boot-up"),
    ("#e03131", "no answer, or refused"),
];

fn legend() -> String {
    let mut x = MARGIN;
    let mut svg = String::new();
    for (kind, (color, name)) in LOOKS.into_iter().enumerate() {
        svg += &match kind == Kind::BootUp as usize {
            true => moment(x, 72.0, color, name),
            false => bar(x, 66.0, [10.0, 12.0], color, name),
        };
        svg += &gray(x + 16.0, 76.0, "start", name);
        x += 34.0 + 6.4 * name.len() as f64;
    }
    svg + &gray(x + 6.0, 76.0, "start", "below: each frame, to the board and from it")
}

/// The scale of the time, on which silences are shortened.
fn scale(history: &History) -> Scale {
    let lanes = history.boards.iter().map(|board| &board.lane).chain([&history.master]);
    let mut times = vec![Duration::ZERO, history.end];
    for lane in lanes {
        // Heartbeats are no reason for a long axis.
        let requests = lane.frames.iter().filter(|(_, is_request)| *is_request);
        times.extend(requests.map(|(at, _)| *at));
        times.extend(lane.steps.iter().flat_map(|step| [step.from, step.to]));
    }
    Scale::within(PLOT - 20.0, LEFT, times, SILENCE)
}

/// Shades the bit rates, and the silences that are shortened.
fn rates(picture: &mut Timeline, history: &History) {
    for (number, (from, rate)) in history.rates.iter().enumerate() {
        // The last one goes on to the end of the axis.
        let to = history.rates.get(number + 1).map_or(Duration::MAX, |(at, _)| *at);
        let color = ["#f3f6fa", "#fdf3e4"][number % 2];
        let [x, end] = picture.shade([*from, to], TOP - 36.0, color, &rate.to_string());
        // A short stay has no room for its name.
        if end - x > 70.0 {
            picture.svg += &label(x + 4.0, TOP - 24.0, "start", &rate.to_string());
        }
    }
    for (from, to) in picture.scale.shortened().collect::<Vec<_>>() {
        let seconds = (to - from).as_secs_f64();
        let title = format!("{seconds:.1} s without a request");
        let [x, end] = picture.shade([from, to], TOP, "#e9ecef", &title);
        let text = format!("{seconds:.0} s");
        if end - x > 8.0 * text.len() as f64 {
            picture.svg += &gray((x + end) / 2.0, center(0) - 5.0, "middle", &text);
        }
    }
}

/// The wire of the bus, with the adapter and a box for each board.
fn network(history: &History, bottom: f64) -> String {
    let (top, end) =
        (center(0), if history.boards.is_empty() { bottom } else { bottom - ROW / 2.0 });
    let mut svg = format!(
        "<path d=\"M {WIRE} {top} V {end}\" stroke=\"#495057\" stroke-width=\"3\" fill=\"none\"/>\n"
    );
    svg += &station(0, ["#f1f3f5", "#495057"], "LSS", ["adapter", ""], true);
    for (row, board) in history.boards.iter().enumerate() {
        let colors = match (board.has_answered, board.before == Some(board.id)) {
            (false, _) => ["#fde8e8", "#c92a2a"],
            (true, true) => ["#f1f3f5", "#495057"],
            (true, false) => ["#e6f4ea", "#2b8a3e"],
        };
        let badge = board.id.map_or("-".into(), |id| id.to_string());
        let name = board.name();
        let before = match board.before {
            Some(Some(id)) => format!("before: node-ID {id}"),
            Some(None) => "before: no node-ID".into(),
            None => String::new(),
        };
        svg += &station(row + 1, colors, &badge, [&name, &before], board.has_answered);
    }
    svg
}

/// A station on the wire.
fn station(
    row: usize,
    [fill, color]: [&str; 2],
    badge: &str,
    [first, second]: [&str; 2],
    is_there: bool,
) -> String {
    let y = center(row);
    let top = y - BOX_HEIGHT / 2.0;
    let dashes = if is_there { "" } else { " stroke-dasharray=\"5 4\"" };
    let mut svg = format!(
        "<path d=\"M {WIRE} {y} H {BOX}\" stroke=\"#495057\" stroke-width=\"2\"{dashes}/>\n\
         <rect x=\"{BOX}\" y=\"{top}\" width=\"{BOX_WIDTH}\" height=\"{BOX_HEIGHT}\" rx=\"5\" fill=\"{fill}\" \
         stroke=\"{color}\"{dashes}/>\n\
         <text x=\"{}\" y=\"{}\" text-anchor=\"middle\" font-size=\"16\" font-weight=\"bold\" fill=\"{color}\">{}</text>\n",
        BOX + BADGE / 2.0,
        y + 6.0,
        escape(badge)
    );
    let x = BOX + BADGE + 4.0;
    match second {
        "" => svg += &label(x, y + 4.0, "start", first),
        _ => {
            svg += &label(x, y - 3.0, "start", first);
            svg += &gray(x, y + 13.0, "start", second);
        }
    }
    svg
}

/// The steps of a station, and its frames below them.
fn lane(picture: &mut Timeline, lane: &Lane, y: f64) {
    picture.lane(y);
    let step = |step: &history::Step| Step {
        from: step.from,
        to: step.to,
        is_moment: step.kind == Kind::BootUp,
        color: LOOKS[step.kind as usize].0,
        title: format!("{:.3} s: {}", step.from.as_secs_f64(), step.words),
    };
    let steps: Vec<Step<'_>> = lane.steps.iter().map(step).collect();
    picture.steps(y - 15.0, 12.0, &steps);
    for (is_request, color, top) in [(true, "#1b4f9c", y + 3.0), (false, "#2b8a3e", y + 11.0)] {
        let frames = lane.frames.iter().filter(|(_, request)| *request == is_request);
        picture.ticks(top, color, frames.map(|(at, _)| *at));
    }
}

/// What a board has got, in two lines.
fn outcome(board: &Board, history: &History) -> [String; 2] {
    let requests = board.lane.frames.iter().filter(|(_, is_request)| *is_request).count();
    let answers = board.lane.frames.len() - requests;
    let frames = format!("frames: {requests} to it, {answers} from it");
    if let Some(problem) = &board.problem {
        return [problem.clone(), frames];
    }
    let mut words = match (board.before, board.id) {
        (Some(before), id) if before == id => match id {
            Some(id) => format!("node-ID {id} as before"),
            None => "no node-ID".into(),
        },
        (_, Some(id)) => format!("got node-ID {id}"),
        (_, None) => "no node-ID".into(),
    };
    let final_rate = history.rates.last().map(|(_, rate)| *rate);
    if let Some(rate) = board.rate.filter(|rate| Some(*rate) == final_rate) {
        words += &format!(", {rate}");
    }
    if board.is_stored {
        words += ", stored";
    }
    let boots = board.lane.steps.iter().filter(|step| step.kind == Kind::BootUp).count();
    let frames = match boots {
        0 => frames,
        1 => format!("{frames}, 1 boot-up"),
        _ => format!("{frames}, {boots} boot-ups"),
    };
    [words, frames]
}

/// The beginning of words that are too long for their place; the step of a problem has all of them.
fn beginning(words: &str) -> String {
    match words.char_indices().nth(LONGEST) {
        Some((end, _)) => format!("{}…", &words[..end]),
        None => words.into(),
    }
}

#[cfg(test)]
mod tests {
    use can_bus::{bus::What, svg::MOMENT};
    use canopen_node::Frame;

    use super::*;

    #[test]
    fn steps_at_the_end_do_not_leave_the_time_axis() {
        let boot_up = Frame::new(0x705, &[0]).expect("a frame");
        let entry = |ms| {
            let at = Duration::from_millis(ms);
            Entry { at, what: What::Received(boot_up) }
        };
        let entries: Vec<Entry> = (0..12).chain(5000..5012).map(entry).collect();
        let caption = Caption { title: String::new(), line: String::new(), failure: None };
        let svg = draw(&entries, &caption);
        let places = svg
            .split("<path d=\"M ")
            .filter(|path| path.contains(" l 4 -6 ") && path.contains(" s: "));
        let ends: Vec<f64> = places
            .filter_map(|path| Some(path.split(' ').next()?.parse::<f64>().ok()? + MOMENT))
            .collect();
        assert_eq!(ends.len(), 24);
        assert!(ends.is_sorted() && ends.iter().all(|end| *end <= RIGHT), "{ends:?}");
    }

    #[test]
    fn an_answer_that_comes_late_is_not_that_to_the_next_question() {
        let question = |bytes: [u8; 8]| What::Sent(Frame::new(0x7E5, &bytes).expect("a frame"));
        let answer = |bytes: [u8; 8]| What::Received(Frame::new(0x7E4, &bytes).expect("a frame"));
        let confirmed = [0x4F, 0, 0, 0, 0, 0, 0, 0];
        let frames = [
            question([0x51, 0x1D, 0x10, 0, 0, 0, 3, 0]),
            answer(confirmed),
            question([0x5D, 0, 0, 0, 0, 0, 0, 0]),
            answer(confirmed),
            answer([0x5D, 0x1D, 0x10, 0, 0, 0, 0, 0]),
        ];
        let entry = |what| Entry { at: Duration::ZERO, what };
        let entries: Vec<Entry> = frames.into_iter().map(entry).collect();
        let caption = Caption { title: String::new(), line: String::new(), failure: None };
        assert!(draw(&entries, &caption).contains("serial number 0000101D"));
    }
}
