//! The head of a report: when, by which version, on what it was made.

use std::time::{SystemTime, UNIX_EPOCH};

use can_bus::date::date_and_time;
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
            date: date_and_time(since_1970),
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
