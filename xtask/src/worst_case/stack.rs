//! The deepest stack of a function and all that it calls.

use std::collections::{BTreeMap, HashMap};

use anyhow::{bail, ensure};

use super::{instruction::Stack, program::Program};

/// The search for the deepest stack.
pub struct Depths<'a> {
    program: &'a Program,
    known: HashMap<u32, u32>,
    under_way: Vec<u32>,
}

impl<'a> Depths<'a> {
    pub fn new(program: &'a Program) -> Self {
        Self { program, known: HashMap::new(), under_way: Vec::new() }
    }

    /// The most stack bytes that the function at `entry` and its callees take.
    pub fn function(&mut self, entry: u32) -> anyhow::Result<u32> {
        if let Some(&depth) = self.known.get(&entry) {
            return Ok(depth);
        }
        ensure!(
            !self.under_way.contains(&entry),
            "{} calls itself, directly or not: its stack has no bound",
            self.program.name(entry)
        );
        self.under_way.push(entry);
        let mut deepest = 0;
        for (at, before) in self.frame(entry)? {
            deepest = deepest.max(self.at(entry, at, before)?);
        }
        self.under_way.pop();
        self.known.insert(entry, deepest);
        Ok(deepest)
    }

    /// The depth during an instruction before which the function uses `before` bytes.
    fn at(&mut self, entry: u32, at: u32, before: i32) -> anyhow::Result<u32> {
        let instruction = &self.program.instructions[&at];
        let called = match self.program.callee(instruction, entry) {
            Some(callee) => self.function(callee)?,
            None => 0,
        };
        Ok((before + grows(instruction.stack).max(0)) as u32 + called)
    }

    /// The bytes on the stack before each instruction of a function.
    fn frame(&self, entry: u32) -> anyhow::Result<BTreeMap<u32, i32>> {
        let graph = self.program.graph(entry)?;
        let mut depths = BTreeMap::from([(entry, 0)]);
        let mut open = vec![entry];
        while let Some(at) = open.pop() {
            let instruction = &self.program.instructions[&at];
            ensure!(
                instruction.stack != Stack::Unknown,
                "{}: a stack pointer that is not known at {at:#x}, {}",
                self.program.name(entry),
                self.program.place(at)
            );
            // A conditional pop returns.
            let grows = if instruction.is_conditional { 0 } else { grows(instruction.stack) };
            let after = depths[&at] + grows;
            for &next in &graph[&at] {
                match depths.insert(next, after) {
                    None => open.push(next),
                    Some(known) if known != after => bail!(
                        "{}: the stack is {known} and {after} bytes deep at {next:#x}",
                        self.program.name(entry)
                    ),
                    Some(_) => {}
                }
            }
        }
        Ok(depths)
    }
}

const fn grows(stack: Stack) -> i32 {
    match stack {
        Stack::Grows(bytes) => bytes,
        Stack::Unknown => 0,
    }
}
