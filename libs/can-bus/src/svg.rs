//! The pieces of drawings in SVG: text, bars, and a scale of time.

use std::time::Duration;

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

    /// The place of a time. One before the first or after the last is there.
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
