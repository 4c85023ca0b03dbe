//! The head of a report: when, by which version, on what it was made.

use std::time::{SystemTime, UNIX_EPOCH};

use serde::Serialize;

/// What a reader has to know to repeat the run.
#[derive(Clone, Debug, Serialize)]
pub struct Head {
    /// The begin of the run, in UTC.
    date: String,
    /// The version of this program, with its commit.
    version: &'static str,
    /// The identity of the product, and its data sheet or what is known of it instead.
    product: String,
    /// The chip, in the words of the command line: no service tells it.
    chip: String,
    pub adapter: String,
}

impl Head {
    /// A run that begins now.
    pub fn new(product: String, chip: Option<&str>, adapter: String) -> Self {
        let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Self {
            date: date(since_1970.as_secs()),
            version: concat!(env!("CARGO_PKG_VERSION"), " (commit ", env!("COMMIT"), ")"),
            product,
            chip: chip.unwrap_or("not named (--chip)").to_owned(),
            adapter,
        }
    }

    /// Its lines, with their names.
    pub fn lines(&self) -> [(&'static str, &str); 5] {
        [
            ("date", &self.date),
            ("version", self.version),
            ("product", &self.product),
            ("chip", &self.chip),
            ("adapter", &self.adapter),
        ]
    }
}

/// The date and time of day of a second since 1970, in the Gregorian calendar.
fn date(seconds: u64) -> String {
    let (mut days, time) = (seconds / 86_400, seconds % 86_400);
    let mut year = 1970;
    let leap = |year: u64| {
        year.is_multiple_of(4) && (!year.is_multiple_of(100) || year.is_multiple_of(400))
    };
    while days >= 365 + u64::from(leap(year)) {
        days -= 365 + u64::from(leap(year));
        year += 1;
    }
    let mut month = 1;
    for len in [31, 28 + u64::from(leap(year)), 31, 30, 31, 30, 31, 31, 30, 31, 30] {
        if days < len {
            break;
        }
        days -= len;
        month += 1;
    }
    let (hour, minute) = (time / 3600, time / 60 % 60);
    format!("{year}-{month:02}-{:02} {hour:02}:{minute:02} UTC", days + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_those_of_the_calendar() {
        for (seconds, text) in [
            (0, "1970-01-01 00:00 UTC"),
            (951_782_400, "2000-02-29 00:00 UTC"),
            (1_767_225_599, "2025-12-31 23:59 UTC"),
            (1_772_323_200, "2026-03-01 00:00 UTC"),
            (4_107_542_400, "2100-03-01 00:00 UTC"),
        ] {
            assert_eq!(date(seconds), text);
        }
    }
}
