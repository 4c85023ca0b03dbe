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

#[cfg(test)]
mod tests {
    use super::*;

    fn depth(halves: &[u16], functions: &[(usize, &str)]) -> anyhow::Result<u32> {
        Depths::new(&Program::of(halves, functions)).function(Program::BASE)
    }

    #[test]
    fn frames_of_callees_add_up() {
        // PUSH {R4, LR}; SUB SP, #8; BL; ADD SP, #8; POP {R4, PC}, and PUSH {R4-R6}; POP {R4-R6}; BX LR.
        let halves = [0xB510, 0xB082, 0xF000, 0xF802, 0xB002, 0xBD10, 0xB470, 0xBC70, 0x4770];
        let functions = [(0, "outer"), (6, "inner")];
        assert_eq!(depth(&halves, &functions).expect("a depth"), 8 + 8 + 12);
    }

    #[test]
    fn a_conditional_return_leaves_the_stack_to_what_follows() {
        // PUSH {R4, LR}; IT EQ; POPEQ {R4, PC}; PUSH {R5}; POP {R5}; POP {R4, PC}.
        let halves = [0xB510, 0xBF08, 0xBD10, 0xB420, 0xBC20, 0xBD10];
        assert_eq!(depth(&halves, &[(0, "f")]).expect("a depth"), 12);
    }

    #[test]
    fn recursion_has_no_depth() {
        // PUSH {LR}; BL itself; POP {PC}.
        let error = depth(&[0xB500, 0xF7FF, 0xFFFD, 0xBD00], &[(0, "f")]).expect_err("recursion");
        assert!(error.to_string().contains("calls itself"), "{error}");
    }

    #[test]
    fn a_stack_pointer_out_of_a_register_is_refused() {
        // MOV SP, R7; BX LR.
        assert!(depth(&[0x46BD, 0x4770], &[(0, "f")]).is_err());
        // PUSH {R4} on one of two ways: CBZ R0; PUSH {R4}; BX LR.
        assert!(depth(&[0xB100, 0xB410, 0x4770], &[(0, "f")]).is_err());
    }
}
