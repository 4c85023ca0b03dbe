//! The report in the format of LCOV.

use std::{
    collections::BTreeMap,
    fmt::{self, Write},
};

use super::report::{Report, Verdict};

/// The records of our files: `DA` for the lines, `BRDA` for the branches, each branch as a block of its own.
pub fn lcov(report: &Report) -> Result<String, fmt::Error> {
    let mut text = String::new();
    for file in report.sources.keys() {
        writeln!(text, "TN:\nSF:{file}")?;
        let lines = || report.ours().filter(|(place, _)| place.file == *file && place.line > 0);
        let (mut found, mut hit) = (0, 0);
        let mut blocks = 0;
        for (place, line) in lines() {
            for branch in &line.branches {
                let was_executed = branch.outcomes.iter().any(Verdict::was_seen);
                for (number, verdict) in branch.outcomes.iter().enumerate() {
                    let taken = if was_executed {
                        u8::from(verdict.was_seen()).to_string()
                    } else {
                        "-".to_owned()
                    };
                    writeln!(text, "BRDA:{},{blocks},{number},{taken}", place.line)?;
                    found += 1;
                    hit += u32::from(verdict.was_seen());
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
    use crate::coverage::{
        branch::Outcome,
        program::Place,
        report::{Judged, Line},
    };

    #[test]
    fn lines_and_branches_are_recorded_once() {
        let verdict = |was_seen| Verdict {
            outcome: Outcome { name: String::new(), target: None, was_seen },
            target: None,
            explanation: None,
        };
        let branch = |seen: [bool; 2]| Judged {
            image: "stm32f405",
            address: 0,
            mnemonic: String::new(),
            outcomes: seen.map(verdict).into(),
        };
        let place = |function: &str, line| Place {
            file: "src/can.rs".to_owned(),
            line,
            function: function.to_owned(),
            is_ours: true,
        };
        let mut report = Report::default();
        report.sources.insert("src/can.rs".to_owned(), Vec::new());
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
