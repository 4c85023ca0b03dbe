//! The branches of a program, and what a record says of them.

use std::collections::BTreeMap;

use emulator::coverage::Record;
use testkit::thumb::{Flow, Instruction};

/// An instruction after which the program may continue at more than one place.
pub struct Branch {
    /// The address of the instruction.
    pub address: u32,
    /// Its length in bytes.
    length: u32,
    /// The places at which the program may continue.
    kind: Kind,
}

/// The kind of a branch.
enum Kind {
    /// `B<cond>`, `CBZ` or `CBNZ`.
    Conditional { mnemonic: &'static str },
    /// An instruction of an IT block: the first, or one whose flags are newer than those of the one before.
    It { condition: &'static str },
    /// `TBB` or `TBH`: each target once, with the indices of its entries.
    Table { targets: BTreeMap<u32, Vec<usize>> },
    /// A jump or call to an address in a register or in memory.
    Computed,
}

/// A way in which the program may continue after a branch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// A verb phrase, such as "jumps".
    pub name: String,
    /// Whether the program has continued so.
    pub was_seen: bool,
}

impl Branch {
    /// The branch that an instruction is, if it is one.
    pub fn of(instruction: Instruction) -> Option<Self> {
        let Instruction { address, length, flow, condition, .. } = instruction;
        let kind = match (condition, flow) {
            (Some(condition), _) => Kind::It { condition },
            (None, Flow::Branch { mnemonic, .. }) => Kind::Conditional { mnemonic },
            (None, Flow::Table(targets)) => Kind::Table { targets },
            (None, Flow::Computed) => Kind::Computed,
            _ => return None,
        };
        Some(Self { address, length, kind })
    }

    /// The name of the instruction, as in the manual.
    pub fn mnemonic(&self) -> String {
        match &self.kind {
            Kind::Conditional { mnemonic } => (*mnemonic).to_owned(),
            Kind::It { condition } => format!("it {condition}"),
            Kind::Table { .. } => "table branch".to_owned(),
            Kind::Computed => "computed jump".to_owned(),
        }
    }

    /// The outcomes, with those of the record.
    pub fn outcomes(&self, record: &Record) -> Vec<Outcome> {
        let outcome = |name: &str, was_seen| Outcome { name: name.to_owned(), was_seen };
        match &self.kind {
            Kind::Conditional { .. } => {
                let [next, jump] = record.branch(self.address, self.length);
                vec![outcome("falls through", next), outcome("jumps", jump)]
            }
            Kind::It { .. } => {
                let [no, yes] = record.condition(self.address);
                vec![outcome("is false", no), outcome("is true", yes)]
            }
            Kind::Table { targets } => targets
                .iter()
                .map(|(&to, indices)| {
                    let indices: Vec<String> = indices.iter().map(usize::to_string).collect();
                    let name = format!("jumps by index {}", indices.join(", "));
                    outcome(&name, record.has_jumped(self.address, to))
                })
                .collect(),
            Kind::Computed => vec![outcome("runs", record.was_executed(self.address))],
        }
    }
}
