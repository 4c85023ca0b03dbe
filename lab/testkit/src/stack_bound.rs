//! An upper bound of a program's stack, from its object code: the graph of calls and the frames of its functions.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    fmt,
};

use crate::{
    elf::{self, Elf},
    thumb::{self, Flow, Instruction},
};

/// The registers that an exception stacks, with those of the floating-point unit, and a word for its alignment.
const EXCEPTION_FRAME: u32 = 104 + 4;

/// The most stack that a program can use, as a sum of levels that interrupt each other.
pub struct Bound {
    /// Each level's name and bytes: the start with all that it calls, and each exception with its frame.
    pub levels: Vec<(String, u32)>,
}

impl Bound {
    /// Follows the program from the reset and from each handler in its vector table. Each handler counts as if it
    /// interrupted all others at their deepest, whatever their priorities.
    ///
    /// # Errors
    /// Something in the program makes a bound impossible: a call by a pointer, recursion, a stack pointer from a register.
    pub fn of(elf: &[u8]) -> Result<Self, String> {
        let file = Elf::parse(elf).map_err(|error| error.to_string())?;
        let mut program = Program::parse(&file).map_err(|error| error.to_string())?;
        let vectors = elf::vectors(&file).map_err(|error| error.to_string())?;
        let mut levels = Vec::new();
        for vector in vectors {
            let name = program.name(vector).to_owned();
            let frame = if name == "Reset" { 0 } else { EXCEPTION_FRAME };
            levels.push((name, program.depth(vector)? + frame));
        }
        Ok(Self { levels })
    }

    /// The sum of the levels in bytes.
    pub fn bytes(&self) -> u32 {
        self.levels.iter().map(|(_, bytes)| bytes).sum()
    }
}

impl fmt::Display for Bound {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (name, bytes) in &self.levels {
            writeln!(f, "{name:28} {bytes:>8}")?;
        }
        writeln!(f, "{:28} {:>8}", "sum", self.bytes())
    }
}

/// The instructions and functions of a program.
#[derive(Default)]
struct Program {
    instructions: BTreeMap<u32, Instruction>,
    names: BTreeMap<u32, String>,
    /// The functions that return to their callers.
    returning: BTreeSet<u32>,
    /// The depth of each function that is known, and `None` for those under way.
    depths: HashMap<u32, Option<u32>>,
}

impl Program {
    fn parse(file: &Elf) -> object::Result<Self> {
        let codes = elf::codes(file)?;
        let instructions = codes.iter().flat_map(thumb::decode).map(|at| (at.address, at));
        Ok(Self::new(instructions.collect(), elf::functions(file)))
    }

    fn new(instructions: BTreeMap<u32, Instruction>, names: BTreeMap<u32, String>) -> Self {
        let mut program = Self { instructions, names, ..Self::default() };
        loop {
            let returns = |entry: &&u32| program.returns(**entry);
            let found: BTreeSet<u32> = program.names.keys().filter(returns).copied().collect();
            if found == program.returning {
                return program;
            }
            program.returning = found;
        }
    }

    fn name(&self, function: u32) -> &str {
        self.names.get(&function).map_or("?", String::as_str)
    }

    /// The function that an instruction of the function `entry` calls or jumps to, and the instructions in `entry` that
    /// may be next.
    fn next(&self, entry: u32, instruction: &Instruction) -> (Option<u32>, Vec<u32>) {
        let is_tail = |to: &u32| *to != entry && self.names.contains_key(to);
        let mut next = Vec::new();
        let (callee, falls_through) = match &instruction.flow {
            Flow::Call(to) => (Some(*to), self.returning.contains(to)),
            Flow::Jump(to) if is_tail(to) => (Some(*to), false),
            Flow::Branch(to) if is_tail(to) => (Some(*to), true),
            Flow::Jump(to) => {
                next.push(*to);
                (None, false)
            }
            Flow::Branch(to) => {
                next.push(*to);
                (None, true)
            }
            Flow::Table(targets) => {
                next.extend(targets.keys());
                (None, false)
            }
            Flow::Return | Flow::Fault | Flow::Computed => (None, false),
            Flow::Next => (None, true),
        };
        if falls_through || instruction.is_conditional {
            next.push(instruction.end());
        }
        (callee, next)
    }

    /// Whether a function returns, by those that are known to return.
    fn returns(&self, entry: u32) -> bool {
        let mut known = BTreeSet::new();
        let mut open = vec![entry];
        while let Some(address) = open.pop() {
            let Some(instruction) = self.instructions.get(&address) else { continue };
            let (callee, next) = self.next(entry, instruction);
            let is_call = matches!(instruction.flow, Flow::Call(_));
            if matches!(instruction.flow, Flow::Return | Flow::Computed)
                || !is_call && callee.is_some_and(|callee| self.returning.contains(&callee))
            {
                return true;
            }
            open.extend(next.into_iter().filter(|next| known.insert(*next)));
        }
        false
    }

    /// The most stack bytes that the function at `entry` and its callees take.
    fn depth(&mut self, entry: u32) -> Result<u32, String> {
        match self.depths.insert(entry, None) {
            Some(None) => return Err(format!("{} calls itself", self.name(entry))),
            Some(Some(depth)) => {
                self.depths.insert(entry, Some(depth));
                return Ok(depth);
            }
            None => {}
        }
        let mut deepest = 0;
        let mut before = BTreeMap::from([(entry, 0)]);
        let mut open = vec![entry];
        while let Some(address) = open.pop() {
            let at = |what: &str| format!("{}: {what} at {address:#x}", self.name(entry));
            let instruction = self.instructions.get(&address).ok_or_else(|| at("no code"))?;
            if instruction.flow == Flow::Computed {
                return Err(at("a jump or call by a pointer"));
            }
            let grows = instruction.stack.ok_or_else(|| at("an unknown stack pointer"))?;
            let (returns, is_conditional) =
                (instruction.flow == Flow::Return, instruction.is_conditional);
            if is_conditional && grows != 0 && !returns {
                return Err(at("a conditional change of the stack"));
            }
            let (callee, next) = self.next(entry, instruction);
            let used: i32 = before[&address];
            // A conditional pop is followed by what runs without it.
            let after = if is_conditional { used } else { used + grows };
            for next in next {
                match before.insert(next, after) {
                    None => open.push(next),
                    Some(known) if known != after => return Err(at("two depths of the stack")),
                    Some(_) => {}
                }
            }
            let called = callee.map_or(Ok(0), |callee| self.depth(callee))?;
            // A part that functions share may take down the frame of its caller.
            deepest = deepest.max((used + grows.max(0)).max(0) as u32 + called);
        }
        self.depths.insert(entry, Some(deepest));
        Ok(deepest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::elf::Code;

    const BASE: u32 = 0x0800_C000;

    /// The depth of the first of the functions, which begin at the given halfwords.
    fn depth(halves: &[u16], functions: &[u32]) -> Result<u32, String> {
        let bytes: Vec<u8> = halves.iter().flat_map(|half| half.to_le_bytes()).collect();
        let instructions = thumb::decode(&Code { base: BASE, bytes: &bytes, data: &[] });
        let instructions = instructions.into_iter().map(|at| (at.address, at)).collect();
        let names = functions.iter().map(|at| (BASE + 2 * at, format!("f{at}"))).collect();
        Program::new(instructions, names).depth(BASE)
    }

    #[test]
    fn frames_of_callees_add_up() {
        // PUSH {R4, LR}; SUB SP, #8; BL; ADD SP, #8; POP {R4, PC}, and PUSH {R4-R6}; POP {R4-R6}; BX LR.
        let halves = [0xB510, 0xB082, 0xF000, 0xF802, 0xB002, 0xBD10, 0xB470, 0xBC70, 0x4770];
        assert_eq!(depth(&halves, &[0, 6]), Ok(8 + 8 + 12));
    }

    #[test]
    fn a_jump_to_another_function_is_a_call_at_the_present_depth() {
        // PUSH {R4}; CBZ R0; POP {R4}; B, and PUSH {R4-R6}; POP {R4-R6}; BX LR.
        let halves = [0xB410, 0xB100, 0xBC10, 0xE7FF, 0xB470, 0xBC70, 0x4770];
        assert_eq!(depth(&halves, &[0, 4]).map_err(|_| ()), Err(()), "CBZ meets two depths");
        let halves = [0xB410, 0xBC10, 0xE7FF, 0xB470, 0xBC70, 0x4770];
        assert_eq!(depth(&halves, &[0, 3]), Ok(12));
    }

    #[test]
    fn what_follows_a_call_without_return_does_not_count() {
        // PUSH {LR}; BL; and behind it what is no code of this function, then UDF.
        let halves = [0xB500, 0xF000, 0xF801, 0x46BD, 0xB470, 0xDE00];
        assert_eq!(depth(&halves, &[0, 4]), Ok(4 + 12));
    }

    #[test]
    fn a_conditional_return_leaves_the_stack_to_what_follows() {
        // PUSH {R4, LR}; IT EQ; POPEQ {R4, PC}; PUSH {R5}; POP {R5}; POP {R4, PC}.
        let halves = [0xB510, 0xBF08, 0xBD10, 0xB420, 0xBC20, 0xBD10];
        assert_eq!(depth(&halves, &[0]), Ok(12));
    }

    #[test]
    fn what_has_no_bound_is_refused() {
        for (halves, why) in [
            // PUSH {LR}; BL itself; POP {PC}.
            (&[0xB500, 0xF7FF, 0xFFFD, 0xBD00][..], "calls itself"),
            // MOV SP, R7.
            (&[0x46BD, 0x4770], "an unknown stack pointer"),
            // CBZ R0 over PUSH {R4}.
            (&[0xB100, 0xB410, 0x4770], "two depths"),
            // IT EQ; PUSHEQ {R4}.
            (&[0xBF08, 0xB410, 0x4770], "a conditional change"),
            // BLX R3.
            (&[0x4798, 0x4770], "by a pointer"),
        ] {
            let error = depth(halves, &[0]).expect_err(why);
            assert!(error.contains(why), "{error}");
        }
    }
}
