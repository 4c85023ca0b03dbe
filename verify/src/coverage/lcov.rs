//! The report in the format of LCOV.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt::{self, Write},
};

use super::report::Report;

/// The records of our files: `DA` for the lines, `BRDA` for the branches, each branch as a block of its own.
pub fn lcov(report: &Report) -> Result<String, fmt::Error> {
    let mut text = String::new();
    let files: BTreeSet<&String> = report.lines.keys().map(|place| &place.file).collect();
    for file in files {
        writeln!(text, "TN:\nSF:{file}")?;
        let lines =
            || report.lines.iter().filter(|(place, _)| place.file == *file && place.line > 0);
        let (mut found, mut hit) = (0, 0);
        let mut blocks = 0;
        for (place, line) in lines() {
            for branch in &line.branches {
                let was_executed = branch.outcomes.iter().any(|outcome| outcome.was_seen);
                for (number, outcome) in branch.outcomes.iter().enumerate() {
                    let taken = match (was_executed, outcome.was_seen) {
                        (false, _) => "-",
                        (true, false) => "0",
                        (true, true) => "1",
                    };
                    writeln!(text, "BRDA:{},{blocks},{number},{taken}", place.line)?;
                    found += 1;
                    hit += u32::from(outcome.was_seen);
                }
                blocks += 1;
            }
        }
        writeln!(text, "BRF:{found}\nBRH:{hit}")?;
        // A line may belong to several functions.
        let mut executed = BTreeMap::new();
        for (place, line) in lines() {
            *executed.entry(place.line).or_insert(false) |= line.was_executed;
        }
        for (line, was_executed) in &executed {
            writeln!(text, "DA:{line},{}", u8::from(*was_executed))?;
        }
        let hit = executed.values().filter(|was_executed| **was_executed).count();
        writeln!(text, "LF:{}\nLH:{hit}\nend_of_record", executed.len())?;
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coverage::report::{Branch, Line, Outcome, Place};

    #[test]
    fn lines_and_branches_are_recorded_once() {
        let outcome = |was_seen| Outcome { name: String::new(), was_seen };
        let branch = |seen: [bool; 2]| Branch {
            image: "stm32f405",
            address: 0,
            mnemonic: String::new(),
            outcomes: seen.map(outcome).into(),
        };
        let place = |function: &str, line| Place {
            file: "src/can.rs".to_owned(),
            line,
            function: function.to_owned(),
            is_ours: true,
        };
        let mut report = Report::default();
        let mut add = |function, line, was_executed, branches| {
            report.lines.insert(place(function, line), Line { was_executed, branches });
        };
        add("a", 5, true, vec![branch([true, false]), branch([false, false])]);
        add("b", 5, false, Vec::new());
        add("b", 6, false, Vec::new());
        add("b", 0, true, Vec::new());
        let expected = "TN:\nSF:src/can.rs\nBRDA:5,0,0,1\nBRDA:5,0,1,0\nBRDA:5,1,0,-\nBRDA:5,1,1,-\nBRF:4\nBRH:1\n\
                        DA:5,1\nDA:6,0\nLF:2\nLH:1\nend_of_record\n";
        assert_eq!(lcov(&report).expect("text"), expected);
    }
}
