//! The coverage of the files, read from a report in the format of LCOV.

use std::collections::BTreeMap;

/// The lines of a file.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lines {
    /// Those that have code.
    pub found: usize,
    /// Those of them that were executed.
    pub executed: usize,
}

/// The lines of each file in `report`, by the path that stands there.
pub fn parse(report: &str) -> BTreeMap<String, Lines> {
    let mut files = BTreeMap::<String, Lines>::new();
    let mut file = "";
    for line in report.lines() {
        let Some((key, value)) = line.split_once(':') else { continue };
        let number = || value.parse().unwrap_or(0);
        match key {
            "SF" => file = value,
            "LF" => files.entry(file.to_owned()).or_default().found = number(),
            "LH" => files.entry(file.to_owned()).or_default().executed = number(),
            _ => {}
        }
    }
    files
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lines_of_each_file_are_read() {
        let report = "TN:\nSF:src/a.rs\nDA:1,1\nDA:2,0\nLF:2\nLH:1\nend_of_record\n\
            TN:\nSF:src/b.rs\nLF:3\nLH:3\nend_of_record\n";
        let expected = [
            ("src/a.rs".to_owned(), Lines { found: 2, executed: 1 }),
            ("src/b.rs".to_owned(), Lines { found: 3, executed: 3 }),
        ];
        assert_eq!(parse(report), BTreeMap::from(expected));
    }
}
