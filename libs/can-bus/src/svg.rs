//! Drawings in SVG: texts and bars, and lanes over an axis of time.

use std::{fmt::Write, time::Duration};

/// The least width of a step on a lane, and the width of a moment.
const STEP: f64 = 4.0;
pub const MOMENT: f64 = 8.0;
/// Between two of them.
const GAP: f64 = 0.5;
/// The least distance of two marks on the time axis.
const MARKS: f64 = 54.0;
/// Steps between two of them, in seconds.
const SECONDS: [f64; 16] =
    [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0];

/// Text without the meaning that its characters have in markup.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// A text at a place; `anchor` is start, middle or end.
pub fn label(x: f64, y: f64, anchor: &str, text: &str) -> String {
    colored_label(x, y, anchor, "black", text)
}

/// The same in a color.
pub fn colored_label(x: f64, y: f64, anchor: &str, color: &str, text: &str) -> String {
    format!(
        "<text fill=\"{color}\" x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{}</text>\n",
        escape(text)
    )
}

/// A rectangle that shows `title` under the pointer.
pub fn bar(x: f64, y: f64, [width, height]: [f64; 2], color: &str, title: &str) -> String {
    format!(
        "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{height:.1}\" fill=\"{color}\">\
         <title>{}</title></rect>\n",
        escape(title)
    )
}

/// Maps times to places: in proportion between two times of interest, up to a greatest distance.
pub struct Scale {
    /// The times of interest and their places.
    known: Vec<(Duration, f64)>,
    per_second: f64,
}

impl Scale {
    /// The first of these times is at `left`; one second is `per_second` long, and no distance longer than `longest`.
    pub fn new(mut times: Vec<Duration>, left: f64, per_second: f64, longest: f64) -> Self {
        times.sort_unstable();
        let mut x = left;
        let mut before = times.first().copied().unwrap_or_default();
        let at = |time: Duration| {
            x += ((time - before).as_secs_f64() * per_second).min(longest);
            before = time;
            (time, x)
        };
        Self { known: times.into_iter().map(at).collect(), per_second }
    }

    /// The same, with all times within `width`. A silence is drawn as if it was as long as `longest` at most.
    pub fn within(width: f64, left: f64, mut times: Vec<Duration>, longest: Duration) -> Self {
        times.sort_unstable();
        let length: Duration = times.windows(2).map(|pair| (pair[1] - pair[0]).min(longest)).sum();
        let per_second = width / length.as_secs_f64().max(0.001);
        Self::new(times, left, per_second, longest.as_secs_f64() * per_second)
    }

    /// The place of a time; that of the first or the last for a time outside of them.
    pub fn x(&self, time: Duration) -> f64 {
        let after = self.known.partition_point(|(known, _)| *known <= time);
        let next = self.known.get(after).map(|(_, x)| *x);
        match after.checked_sub(1).and_then(|before| self.known.get(before)) {
            Some((before, x)) => match next {
                Some(next) => (x + (time - *before).as_secs_f64() * self.per_second).min(next),
                None => *x,
            },
            None => next.unwrap_or_default(),
        }
    }

    /// The silences that are shortened: from when to when.
    pub fn shortened(&self) -> impl Iterator<Item = (Duration, Duration)> {
        self.known.windows(2).filter_map(|pair| match pair {
            &[(from, x), (to, end)] => {
                let is_shorter = end - x < 0.99 * (to - from).as_secs_f64() * self.per_second;
                is_shorter.then_some((from, to))
            }
            _ => None,
        })
    }
}

/// Where a drawing has its lanes.
#[derive(Clone, Copy, Debug)]
pub struct Plot {
    pub left: f64,
    pub right: f64,
    pub top: f64,
    pub bottom: f64,
}

/// What goes on on a lane.
pub struct Step<'a> {
    pub from: Duration,
    pub to: Duration,
    /// It has no duration, and stands out.
    pub is_moment: bool,
    pub color: &'a str,
    pub title: String,
}

/// A drawing of what happened when: lanes below each other, over one axis of time.
pub struct Timeline {
    /// The elements so far.
    pub svg: String,
    pub scale: Scale,
    plot: Plot,
}

impl Timeline {
    /// A drawing of this width and height, with its title.
    pub fn new([width, height]: [f64; 2], title: &str, plot: Plot, scale: Scale) -> Self {
        let svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width:.0}\" height=\"{height:.0}\" viewBox=\"0 0 {width:.0} {height:.0}\" font-family=\"sans-serif\" \
             font-size=\"12\">\n<rect x=\"0.5\" y=\"0.5\" width=\"{:.0}\" height=\"{:.0}\" rx=\"6\" fill=\"white\" \
             stroke=\"#ccc\"/>\n<text x=\"16\" y=\"30\" font-size=\"18\">{}</text>\n",
            width - 1.0,
            height - 1.0,
            escape(title)
        );
        Self { svg, scale, plot }
    }

    /// Shades a time, from this height down to the end of the lanes; returns its two ends. [`Duration::MAX`] is the right
    /// end of the drawing's lanes.
    pub fn shade(&mut self, times: [Duration; 2], top: f64, color: &str, title: &str) -> [f64; 2] {
        let Plot { right, bottom, .. } = self.plot;
        let place = |time| if time == Duration::MAX { right } else { self.scale.x(time) };
        let [x, end] = times.map(place);
        self.svg += &bar(x, top, [end - x, bottom - top], color, title);
        [x, end]
    }

    /// Draws a line down through all lanes, with SVG's `style`; returns its place.
    pub fn line(&mut self, time: Duration, style: &str) -> f64 {
        let (x, Plot { top, bottom, .. }) = (self.scale.x(time), self.plot);
        let line = format!("<path d=\"M{x:.1} {top}V{bottom}\" {style}/>\n");
        self.svg += &line;
        x
    }

    /// Marks round times up to `end`.
    pub fn marks(&mut self, end: Duration) {
        let (mut last, end) = (f64::MIN, end.as_secs_f64());
        let shortened: Vec<_> = self.scale.shortened().collect();
        let is_wide = |step: &f64| step * self.scale.per_second >= MARKS;
        let step = SECONDS.into_iter().find(is_wide).unwrap_or(SECONDS[15]);
        let decimals = if step < 0.1 { 2 } else { usize::from(step < 1.0) };
        for number in 0..=(end / step) as u32 {
            let time = Duration::from_secs_f64(f64::from(number) * step);
            let is_left_out = shortened.iter().any(|(from, to)| *from < time && time < *to);
            if is_left_out || self.scale.x(time) < last + MARKS {
                continue;
            }
            last = self.line(time, "stroke=\"#d0d5db\"");
            let text = format!("{:.decimals$} s", time.as_secs_f64());
            for y in [self.plot.top - 6.0, self.plot.bottom + 16.0] {
                self.svg += &colored_label(last, y, "middle", "#666", &text);
            }
        }
    }

    /// Draws a lane.
    pub fn lane(&mut self, y: f64) {
        let Plot { left, right, .. } = self.plot;
        let line =
            format!("<path d=\"M {left} {y} H {right:.1}\" stroke=\"#b8bfc7\" fill=\"none\"/>\n");
        self.svg += &line;
    }

    /// Draws the steps of a lane, in their order, at this height and so high; those that are too short to be seen stand
    /// side by side. Returns their middles.
    pub fn steps(&mut self, y: f64, height: f64, steps: &[Step<'_>]) -> Vec<f64> {
        let mut free = f64::MIN;
        let mut places = Vec::new();
        for step in steps {
            let x = self.scale.x(step.from).max(free);
            let least = if step.is_moment { MOMENT } else { STEP };
            let width = (self.scale.x(step.to) - x).max(least);
            places.push((x, width));
            free = x + width + GAP;
        }
        // At the end they begin earlier.
        let mut limit = self.plot.right;
        for (x, width) in places.iter_mut().rev() {
            *x = x.min(limit - *width);
            limit = *x - GAP;
        }
        for (step, (x, width)) in steps.iter().zip(&places) {
            self.svg += &match step.is_moment {
                true => moment(*x, y + height / 2.0, step.color, &step.title),
                false => bar(*x, y, [*width, height], step.color, &step.title),
            };
        }
        places.iter().map(|(x, width)| x + width / 2.0).collect()
    }

    /// Draws a thin mark at each of these times.
    pub fn ticks(&mut self, y: f64, color: &str, times: impl Iterator<Item = Duration>) {
        let (mut path, mut last) = (String::new(), f64::MIN);
        for x in times.map(|time| self.scale.x(time)) {
            // What is closer cannot be seen.
            if x >= last + 0.7 {
                let _ = write!(path, "M{x:.1} {y}v6");
                last = x;
            }
        }
        if !path.is_empty() {
            let _ =
                writeln!(self.svg, "<path d=\"{path}\" stroke=\"{color}\" stroke-width=\"0.7\"/>");
        }
    }

    /// The whole drawing.
    pub fn finish(self) -> String {
        self.svg + "</svg>\n"
    }
}

/// A moment around this height.
pub fn moment(x: f64, y: f64, color: &str, title: &str) -> String {
    let half = MOMENT / 2.0;
    format!(
        "<path d=\"M {x:.1} {y} l {half} -6 l {half} 6 l -{half} 6 z\" fill=\"{color}\"><title>{}</title></path>\n",
        escape(title)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_no_markup() {
        assert_eq!(escape("<a> & \"b\""), "&lt;a&gt; &amp; &quot;b&quot;");
    }

    #[test]
    fn a_long_silence_is_shortened() {
        let seconds = Duration::from_secs;
        let scale = Scale::new(vec![seconds(12), seconds(1), seconds(2)], 100.0, 10.0, 30.0);
        let x = [0, 1, 2, 3, 8, 12, 99].map(|time| scale.x(seconds(time)));
        assert_eq!(x, [100.0, 100.0, 110.0, 120.0, 140.0, 140.0, 140.0]);
        assert_eq!(scale.shortened().collect::<Vec<_>>(), [(seconds(2), seconds(12))]);
        assert_eq!(Scale::new(Vec::new(), 5.0, 1.0, 1.0).x(seconds(1)), 0.0);
    }
}
