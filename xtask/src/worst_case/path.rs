//! The longest path through a function: instructions, waits, loops and calls.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use anyhow::{Context, bail, ensure};

use super::{
    instruction::{Flow, Instruction, Memory, REFILL},
    program::{Frame, Program, is_named},
    stated::{DEPENDENCIES, Dependency, Stated, Unit},
};

/// The cycles that memories and buses add to those of the core.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Waits {
    /// The fetch of the next line of the flash, whose read has begun with the line before.
    pub next_line: u64,
    /// The fetch of any other line.
    pub other_line: u64,
    /// A load from the flash.
    pub constant: u64,
    /// An access to a peripheral.
    pub peripheral: u64,
}

impl Waits {
    /// A core that never waits.
    pub const NONE: Self = Self { next_line: 0, other_line: 0, constant: 0, peripheral: 0 };
    /// Reads of the flash with five wait states that miss all caches. A read takes six cycles, and may come behind one
    /// that has just begun.
    pub const FLASH: Self = Self { next_line: 6, other_line: 11, constant: 11, peripheral: 0 };
    /// The same, and for each access to a peripheral three periods of APB1: one to synchronise, two for the transfer.
    pub const CHIP: Self = Self { peripheral: 12, ..Self::FLASH };

    /// The wait for an instruction after a jump, or after `before`. The read of the next line has begun when the present
    /// line was entered, at least `elapsed` cycles ago.
    pub fn fetch(
        &self,
        before: Option<&Instruction>,
        instruction: &Instruction,
        elapsed: u64,
    ) -> u64 {
        let (first, last) = (line(instruction.address), line(instruction.end() - 2));
        let next_line = self.next_line.saturating_sub(elapsed);
        match before {
            Some(before) if line(before.end() - 2) == first => {
                if last == first {
                    0
                } else {
                    next_line
                }
            }
            Some(before) if before.end() == instruction.address => next_line,
            _ if last == first => self.other_line,
            _ => self.other_line + self.next_line,
        }
    }
}

/// The line of the flash that an address is in.
const fn line(address: u32) -> u32 {
    address >> 4
}

/// A loop that a bound was found for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Loop {
    pub function: u32,
    pub header: u32,
    /// The instructions, from which jumps back to the header are counted.
    pub nodes: BTreeSet<u32>,
    /// How often the program may go back to the header.
    pub back: u64,
    /// The rounds that are stated.
    pub rounds: u64,
    pub place: String,
    /// The line of the bound.
    pub text: String,
    pub reason: String,
}

/// The search for longest paths, with one set of waits and one scope.
pub struct Search<'a> {
    pub program: &'a Program,
    pub stated: &'a Stated,
    pub waits: Waits,
    /// Functions that no path enters.
    pub excluded: BTreeSet<u32>,
    /// Whether the bounds in service hold.
    pub is_service: bool,
    /// The rounds of the loops with this text in their line, in place of the stated ones.
    pub rounds_of: BTreeMap<&'static str, u64>,
    /// Calls that no path makes: by this function, of that one.
    pub closed: BTreeSet<(u32, u32)>,
    /// The loops seen, by header.
    pub loops: BTreeMap<u32, Loop>,
    /// What has no bound, with what to do about it.
    pub missing: BTreeSet<String>,
    /// The instruction before each one on the longest path to it, by function.
    came: HashMap<(u32, u32), u32>,
    known: HashMap<u32, u64>,
    /// The functions under way, to find recursion.
    under_way: Vec<u32>,
    /// The length of the copy that is under way.
    bytes: Option<u64>,
}

type Graph = BTreeMap<u32, Vec<u32>>;

/// The places of the bounds of the loops around a region: a loop in it needs another.
type Taken = Vec<String>;

impl<'a> Search<'a> {
    pub fn new(program: &'a Program, stated: &'a Stated, waits: Waits) -> Self {
        Self {
            program,
            stated,
            waits,
            excluded: BTreeSet::new(),
            is_service: false,
            rounds_of: BTreeMap::new(),
            closed: BTreeSet::new(),
            loops: BTreeMap::new(),
            missing: BTreeSet::new(),
            came: HashMap::new(),
            known: HashMap::new(),
            under_way: Vec::new(),
            bytes: None,
        }
    }

    /// The instructions on the longest path through a function, with the cycles up to the end of each.
    pub fn explain(&mut self, entry: u32) -> anyhow::Result<Vec<String>> {
        let graph = self.graph(entry)?;
        let reached = self.region(entry, &graph, entry, None, &mut Taken::new())?;
        let mut at = reached.iter().max_by_key(|(at, cycles)| (**cycles, **at)).map(|(at, _)| *at);
        let mut lines = Vec::new();
        while let Some(address) = at {
            let instruction = &self.program.instructions[&address];
            let callee = self.program.callee(instruction, entry);
            let called = callee.map_or(String::new(), |callee| {
                let known = self.known.get(&callee).copied().unwrap_or(0);
                format!(" -> {} {known}", self.program.name(callee))
            });
            let place = self.program.place(address);
            let sum = reached.get(&address).copied().unwrap_or(0);
            lines.push(format!("{sum:8} {address:#x} {place}{called}"));
            at = self.came.get(&(entry, address)).copied().filter(|_| lines.len() < 5000);
        }
        lines.reverse();
        Ok(lines)
    }

    /// The cycles from the first instruction of a function to its return.
    pub fn function(&mut self, entry: u32) -> anyhow::Result<u64> {
        if self.bytes.is_none()
            && let Some(&cycles) = self.known.get(&entry)
        {
            return Ok(cycles);
        }
        ensure!(
            !self.under_way.contains(&entry),
            "{} calls itself, directly or not: its time and its stack have no bound",
            self.program.name(entry)
        );
        self.under_way.push(entry);
        let graph = self.graph(entry)?;
        let reached = self.region(entry, &graph, entry, None, &mut Taken::new())?;
        // What the scope excludes is no end of the function.
        let whole = self.program.graph(entry)?;
        let mut longest = None;
        for (at, cycles) in reached {
            let instruction = &self.program.instructions[&at];
            let tail = match self.program.callee(instruction, entry) {
                Some(_) if self.is_excluded(entry, at) => continue,
                Some(callee) if !matches!(instruction.flow, Flow::Call(_)) => {
                    self.call(callee, at)?
                }
                _ if whole[&at].is_empty() || instruction.flow == Flow::Return => 0,
                _ => continue,
            };
            longest = longest.max(Some(cycles + tail));
        }
        let longest = longest.with_context(|| {
            format!("{}: no path to its end is left in service", self.program.name(entry))
        })?;
        self.under_way.pop();
        if self.bytes.is_none() {
            self.known.insert(entry, longest);
        }
        Ok(longest)
    }

    /// The cycles from the first instruction of `entry` to the last one before `targets`, in the first round of the
    /// loops around them.
    pub fn until(&mut self, entry: u32, targets: &BTreeSet<u32>) -> anyhow::Result<u64> {
        let mut graph = self.graph(entry)?;
        let around: Vec<BTreeSet<u32>> = components(&graph, entry, None)
            .into_iter()
            .filter(|nodes| nodes.len() > 1 && !nodes.is_disjoint(targets))
            .collect();
        for nodes in around {
            let entered: BTreeSet<u32> = graph
                .iter()
                .filter(|(at, _)| !nodes.contains(at))
                .flat_map(|(_, next)| next.iter().copied().filter(|to| nodes.contains(to)))
                .collect();
            for at in &nodes {
                let next = graph.get_mut(at).expect("it is in the graph");
                next.retain(|to| !entered.contains(to));
            }
        }
        self.between(entry, &graph, entry, targets)
    }

    /// The cycles from the instruction `from` up to one of `targets`.
    pub fn between(
        &mut self,
        function: u32,
        graph: &Graph,
        from: u32,
        targets: &BTreeSet<u32>,
    ) -> anyhow::Result<u64> {
        let mut before: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
        for (&at, next) in graph.iter().filter(|(at, _)| !targets.contains(at)) {
            next.iter().for_each(|next| before.entry(*next).or_default().push(at));
        }
        let mut leads: BTreeSet<u32> = targets.clone();
        let mut open: Vec<u32> = targets.iter().copied().collect();
        while let Some(at) = open.pop() {
            open.extend(before.get(&at).into_iter().flatten().filter(|at| leads.insert(**at)));
        }
        ensure!(
            leads.contains(&from),
            "{}: no path from {from:#x} to its targets",
            self.program.name(function)
        );
        let is_kept = |at: &u32| leads.contains(at);
        let part: Graph = graph
            .iter()
            .filter(|(at, _)| is_kept(at))
            .map(|(at, next)| {
                let next = if targets.contains(at) { &[][..] } else { next };
                (*at, next.iter().copied().filter(is_kept).collect())
            })
            .collect();
        let reached = self.region(function, &part, from, None, &mut Taken::new())?;
        let mut longest = None;
        for target in targets {
            let instruction = &self.program.instructions[target];
            let mut own = self.own(function, instruction)?;
            if let Flow::Call(callee) = instruction.flow {
                own += self.call(callee, *target)?;
            }
            longest = longest.max(reached.get(target).map(|cycles| cycles - own));
        }
        longest.context("no target is reached")
    }

    /// The graph of a function, without the calls that the scope excludes.
    pub fn graph(&self, entry: u32) -> anyhow::Result<Graph> {
        let mut graph = self.program.graph(entry)?;
        // In an IT block a call is passed over.
        let is_conditional = |at: &u32| self.program.instructions[at].is_conditional;
        graph.retain(|at, _| is_conditional(at) || !self.is_excluded(entry, *at));
        let kept: BTreeSet<u32> = graph.keys().copied().collect();
        graph.values_mut().for_each(|next| next.retain(|at| kept.contains(at)));
        Ok(graph)
    }

    /// Whether an instruction of a function is a call that the scope excludes.
    pub fn is_excluded(&self, function: u32, at: u32) -> bool {
        self.program.callee(&self.program.instructions[&at], function).is_some_and(|callee| {
            self.excluded.contains(&callee)
                || self.closed.contains(&(function, callee))
                || self.is_service && self.stated.is_never(&self.program.frames[&at])
        })
    }

    /// The cycles of a call by the instruction at `at`, from the jump to the return.
    fn call(&mut self, callee: u32, at: u32) -> anyhow::Result<u64> {
        let begin = 2 * REFILL + self.waits.fetch(None, &self.program.instructions[&callee], 0);
        if self.program.endless.contains(&callee) {
            return Ok(begin);
        }
        if is_copy(self.program.name(callee)) {
            let length = self.length(callee, at);
            let outer = self.bytes.replace(length);
            let cycles = self.function(callee);
            self.bytes = outer;
            return Ok(begin + cycles?);
        }
        Ok(begin + self.function(callee)?)
    }

    /// The length of a copy: a constant, or stated.
    pub fn length(&mut self, callee: u32, at: u32) -> u64 {
        let frames = &self.program.frames[&at];
        let inlined = |name: &str| frames.iter().any(|frame| is_named(&frame.function, name));
        let of_dependency = || {
            DEPENDENCIES
                .iter()
                .find(|bound| bound.unit == Unit::Bytes && inlined(bound.function))
                .map(|bound| bound.number)
        };
        let stated = self.stated.at(frames, Unit::Bytes).map(|bound| bound.number);
        stated.or_else(|| self.program.copied(callee, at)).or_else(of_dependency).unwrap_or_else(|| {
            self.missing.insert(format!(
                "{}: write `// Bound: 8 bytes: reason.` above the line, for the copy of unknown length at {at:#x}",
                self.program.place(at)
            ));
            0
        })
    }

    /// The cycles of an instruction alone.
    pub fn own(&self, function: u32, instruction: &Instruction) -> anyhow::Result<u64> {
        let waits = match instruction.memory {
            Memory::None | Memory::Stack => 0,
            Memory::Constant => self.waits.constant,
            Memory::Barrier => self.waits.peripheral,
            Memory::Other { words, is_load } => {
                let lines = u64::from(words + 2) / 4 + 1;
                let name = self.program.name(function);
                let at = instruction.address;
                let may_be_constant = self.program.constant_loads.contains(&at)
                    || is_load
                        && (self.program.readers.contains(&function) || is_copy(name))
                        && !self.program.ram_loads.contains(&at);
                let constant = if may_be_constant { lines * self.waits.constant } else { 0 };
                // A store to a bit-band alias is a load and a store.
                let alias = u64::from(!is_load);
                let peripheral = if self.program.is_volatile(instruction.address) {
                    u64::from(words) * (self.waits.peripheral + alias)
                } else {
                    0
                };
                constant.max(peripheral)
            }
        };
        Ok(instruction.cycles + waits)
    }

    fn edge(&self, from: u32, to: u32) -> u64 {
        let (before, after) = (&self.program.instructions[&from], &self.program.instructions[&to]);
        if before.end() == to && !matches!(before.flow, Flow::Table(_)) {
            let came = (!matches!(before.flow, Flow::Call(_))).then_some(before);
            self.waits.fetch(came, after, self.elapsed(from))
        } else {
            REFILL + self.waits.fetch(Some(before), after, 0)
        }
    }

    /// The least cycles in the line of an instruction up to its end, wherever the line was entered.
    fn elapsed(&self, at: u32) -> u64 {
        let mut first = at;
        while !self.program.targets.contains(&first)
            && let Some((_, before)) = self.program.instructions.range(..first).next_back()
            && before.end() == first
            && line(before.end() - 2) == line(at)
        {
            first = before.address;
        }
        // The core may take no cycle for the instruction that begins an IT block.
        let begins_it = |instruction: &&Instruction| {
            let next = self.program.instructions.get(&instruction.end());
            !instruction.is_conditional && next.is_some_and(|next| next.is_conditional)
        };
        let instructions = self.program.instructions.range(first..=at).map(|(_, found)| found);
        instructions.filter(|instruction| !begins_it(instruction)).count() as u64
    }

    /// The cycles from `entry` to the end of each instruction of a part of a function. `header`: the loop that the part
    /// is the body of.
    fn region(
        &mut self,
        function: u32,
        graph: &Graph,
        entry: u32,
        header: Option<u32>,
        taken: &mut Taken,
    ) -> anyhow::Result<HashMap<u32, u64>> {
        let next = |at: u32| graph[&at].iter().copied().filter(move |next| Some(*next) != header);
        let mut reached: HashMap<u32, u64> = HashMap::new();
        let mut arrivals: HashMap<u32, u64> = HashMap::from([(entry, 0)]);
        for component in components(graph, entry, header) {
            let entries: Vec<u32> =
                component.iter().copied().filter(|at| arrivals.contains_key(at)).collect();
            let [first] = entries[..] else {
                bail!(
                    "{}: a loop with several entries, {}",
                    self.program.name(function),
                    entries.iter().map(|at| self.program.place(*at)).collect::<Vec<_>>().join("; ")
                );
            };
            let is_loop = component.len() > 1 || next(first).any(|at| at == first);
            let inner = if is_loop {
                self.rounds(function, graph, &component, first, taken)?
            } else {
                let instruction = &self.program.instructions[&first];
                let mut cycles = self.own(function, instruction)?;
                if let Flow::Call(callee) = instruction.flow
                    && !self.is_excluded(function, first)
                {
                    cycles += self.call(callee, first)?;
                }
                HashMap::from([(first, cycles)])
            };
            // In a cached loop a prefetch may wait for another one: the line behind it comes like any other.
            let is_cached = is_loop && self.fetches(&component).is_some();
            let left = if is_cached { self.waits.other_line } else { 0 };
            let arrival = arrivals[&first];
            for (at, cycles) in inner {
                reached.insert(at, arrival + cycles);
                for to in next(at).filter(|to| !component.contains(to)) {
                    let cycles = arrival + cycles + self.edge(at, to) + left;
                    let known = arrivals.entry(to).or_insert(0);
                    if cycles >= *known {
                        *known = cycles;
                        self.came.insert((function, to), at);
                    }
                }
            }
        }
        Ok(reached)
    }

    /// The cycles from the first entry of a loop to the end of each of its instructions in the last round.
    fn rounds(
        &mut self,
        function: u32,
        graph: &Graph,
        nodes: &BTreeSet<u32>,
        header: u32,
        taken: &mut Taken,
    ) -> anyhow::Result<HashMap<u32, u64>> {
        let part: Graph = nodes
            .iter()
            .map(|at| (*at, graph[at].iter().copied().filter(|to| nodes.contains(to)).collect()))
            .collect();
        let latches: Vec<u32> =
            nodes.iter().copied().filter(|at| graph[at].contains(&header)).collect();
        let found = self.bound(function, nodes, header, &latches, taken);
        // If the loop is left only where it goes back, a visit of the header is a round; otherwise the last visit may be
        // the test that ends it.
        let is_left = |at: &&u32| graph[*at].iter().any(|to| !nodes.contains(to));
        let ends_with_round = nodes.iter().filter(is_left).all(|at| latches.contains(at));
        let back = if ends_with_round { found.rounds.saturating_sub(1) } else { found.rounds };
        taken.push(found.place.clone());
        let fetches = self.fetches(nodes);
        let waits = self.waits;
        if fetches.is_some() {
            // A line that only a prefetch has read may be in no cache, and a prefetch may wait for another one.
            self.waits = Waits { next_line: waits.other_line, other_line: 0, ..waits };
        }
        let inner = self.region(function, &part, header, Some(header), taken);
        let longest_round = |inner: &HashMap<u32, u64>| {
            let rounds =
                latches.iter().filter_map(|at| Some(inner.get(at)? + self.edge(*at, header)));
            rounds.max().unwrap_or(0)
        };
        let round = inner.as_ref().map(longest_round).unwrap_or(0);
        self.waits = waits;
        let inner = inner?;
        taken.pop();
        self.loops.insert(header, Loop { back, nodes: nodes.clone(), ..found });
        let begin = fetches.unwrap_or(0) + back * round;
        Ok(inner.into_iter().map(|(at, cycles)| (at, begin + cycles)).collect())
    }

    /// The waits for the lines of a loop, if jumps find them in the cache in later rounds: the loop calls nothing and spans
    /// no more than the cache has, so that no organisation of the cache drops one of its lines for another.
    fn fetches(&self, nodes: &BTreeSet<u32>) -> Option<u64> {
        const CACHED_LINES: u32 = 64;
        let mut instructions = nodes.iter().map(|at| &self.program.instructions[at]);
        if instructions.any(|instruction| matches!(instruction.flow, Flow::Call(_))) {
            return None;
        }
        let (first, last) = (nodes.first()? >> 4, (nodes.last()? + 2) >> 4);
        let lines = last - first + 1;
        (lines <= CACHED_LINES).then_some(u64::from(lines) * self.waits.other_line)
    }

    /// The bound of a loop: stated in the sources, or for dependencies here.
    fn bound(
        &mut self,
        function: u32,
        nodes: &BTreeSet<u32>,
        header: u32,
        latches: &[u32],
        taken: &Taken,
    ) -> Loop {
        let found = |rounds, place: String, reason: &str| Loop {
            function,
            header,
            nodes: BTreeSet::new(),
            back: 0,
            rounds,
            place,
            text: String::new(),
            reason: reason.to_owned(),
        };
        let name = self.program.name(function);
        if let Some(bytes) = self.bytes.filter(|_| is_copy(name)) {
            // `src/memory.rs`: first the words, then the rest. `memcmp` has bytes only.
            let is_rest = self.loops.values().any(|other| {
                other.function == function && other.header < header && name != "memcmp"
            });
            let rounds = match name {
                "memcmp" => bytes,
                _ if is_rest => 4,
                _ => bytes / 4 + 1,
            };
            return found(rounds, name.to_owned(), "the length of the copy");
        }
        let is_free = |place: &String| !taken.contains(place);
        let ends = || latches.iter().chain([&header]);
        let mut bounds: Vec<Loop> = Vec::new();
        for at in ends().chain(nodes) {
            let frames = &self.program.frames[at];
            if let Some(bound) = self.stated.at(frames, Unit::Rounds) {
                let place = format!("{}:{}", bound.file, bound.line);
                let in_service = bound.in_service.filter(|_| self.is_service);
                let scoped = self.rounds_of.iter().find(|(text, _)| bound.text.contains(*text));
                let scoped = scoped.map(|(_, rounds)| *rounds);
                let rounds = scoped.or(in_service).unwrap_or(bound.number);
                bounds
                    .push(Loop { text: bound.text.clone(), ..found(rounds, place, &bound.reason) });
            }
            let is_of = |bound: &&Dependency| {
                let is_around = |frame: &Frame| is_named(&frame.function, bound.function);
                bound.unit == Unit::Rounds
                    && (is_named(name, bound.function) || frames.iter().any(is_around))
            };
            if let Some(bound) = DEPENDENCIES.iter().find(is_of) {
                bounds.push(found(bound.number, bound.function.to_owned(), bound.reason));
            }
            bounds.retain(|bound| is_free(&bound.place));
            // The ends of the loop say best where it is.
            if !bounds.is_empty() && *at == header {
                break;
            }
        }
        bounds.into_iter().max_by_key(|bound| bound.rounds).unwrap_or_else(|| {
            let mut places: Vec<String> = ends().map(|at| self.program.place(*at)).collect();
            places.sort();
            places.dedup();
            self.missing.insert(format!(
                "{}: write `// Bound: 8 rounds: reason.` above the line, for the loop at {header:#x} of {name}",
                places.join(", or ")
            ));
            found(0, "no bound".to_owned(), "")
        })
    }
}

/// Whether a function copies, clears or compares memory.
pub fn is_copy(name: &str) -> bool {
    ["__aeabi_memcpy", "__aeabi_memclr", "memcmp"].contains(&name)
}

/// The strongly connected components that `entry` reaches, each before those that follow it (Tarjan). Jumps to `header`
/// do not count.
fn components(graph: &Graph, entry: u32, header: Option<u32>) -> Vec<BTreeSet<u32>> {
    struct Visits<'a> {
        graph: &'a Graph,
        header: Option<u32>,
        numbers: HashMap<u32, usize>,
        stack: Vec<u32>,
        found: Vec<BTreeSet<u32>>,
    }

    /// Returns the lowest number of an open instruction that `at` leads to.
    fn visit(visits: &mut Visits, at: u32) -> usize {
        let number = visits.numbers.len();
        visits.numbers.insert(at, number);
        visits.stack.push(at);
        let mut lowest = number;
        let graph = visits.graph;
        for &to in graph[&at].iter().filter(|to| Some(**to) != visits.header).collect::<Vec<_>>() {
            let reached = match visits.numbers.get(&to) {
                None => visit(visits, to),
                Some(&reached) if visits.stack.contains(&to) => reached,
                Some(_) => continue,
            };
            lowest = lowest.min(reached);
        }
        if lowest == number {
            let from = visits.stack.iter().position(|open| *open == at).expect("it is open");
            visits.found.push(visits.stack.drain(from..).collect());
        }
        lowest
    }

    let mut visits =
        Visits { graph, header, numbers: HashMap::new(), stack: Vec::new(), found: Vec::new() };
    visit(&mut visits, entry);
    visits.found.reverse();
    visits.found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The cycles of the first function, with a bound for all loops.
    fn cycles(halves: &[u16], rounds: Option<u64>, waits: Waits) -> anyhow::Result<u64> {
        let mut program = Program::of(halves, &[(0, "f"), (100, "g")]);
        let mut stated = Stated::default();
        if let Some(rounds) = rounds {
            stated.add("a.rs", &format!("// Bound: {rounds} rounds: so.\nloop\n"))?;
            let (file, function) = ("a.rs".to_owned(), "f".to_owned());
            let frame = Frame { file, line: 2, function };
            program.frames.values_mut().for_each(|frames| frames.push(frame.clone()));
        }
        let mut search = Search::new(&program, &stated, waits);
        let cycles = search.function(Program::BASE)?;
        match search.missing.first() {
            Some(missing) => bail!("{missing}"),
            None => Ok(cycles),
        }
    }

    #[test]
    fn a_straight_function_takes_the_sum_of_its_instructions() {
        // PUSH {R4, LR}; LDR R0, [R1]; ADDS; UDIV; POP {R4, PC}.
        let halves = [0xB510, 0x6808, 0x1840, 0xFBB0, 0xF0F1, 0xBD10];
        let cycles = cycles(&halves, None, Waits::NONE).expect("a bound");
        assert_eq!(cycles, 3 + 2 + 1 + 12 + 3);
    }

    #[test]
    fn the_longer_way_counts() {
        // CBZ R0 over a division; BX LR. Taken it costs the refill, otherwise the division.
        let halves = [0xB108, 0xFBB0, 0xF0F1, 0x4770];
        assert_eq!(cycles(&halves, None, Waits::NONE).expect("a bound"), 1 + 12 + 1);
        // The same over a move.
        assert_eq!(
            cycles(&[0xB100, 0x2000, 0x4770], None, Waits::NONE).expect("a bound"),
            1 + 3 + 1
        );
    }

    #[test]
    fn a_return_in_an_it_block_is_no_end_of_the_function() {
        // IT EQ; BXEQ LR; UDIV; BX LR.
        let halves = [0xBF08, 0x4770, 0xFBB0, 0xF0F1, 0x4770];
        assert_eq!(cycles(&halves, None, Waits::NONE).expect("a bound"), 1 + 1 + 12 + 1);
    }

    /// `MOVS R0, #5`, then `SUBS R0, #1; BNE` to it, then `BX LR`.
    const COUNT: [u16; 4] = [0x2005, 0x3801, 0xD1FD, 0x4770];

    #[test]
    fn a_loop_takes_its_bound() {
        // Four times back, with a refill each.
        let bound = cycles(&COUNT, Some(5), Waits::NONE).expect("a bound");
        assert_eq!(bound, 1 + 5 * 2 + 4 * REFILL + 1);
    }

    #[test]
    fn a_loop_that_ends_at_its_start_has_one_more_test() {
        // CBZ R0 to the end; SUBS R0, #1; B back; BX LR.
        let halves = [0xB108, 0x3801, 0xE7FC, 0x4770];
        let bound = cycles(&halves, Some(5), Waits::NONE).expect("a bound");
        assert_eq!(bound, 5 * (3 + REFILL) + 1 + REFILL + 1);
    }

    #[test]
    fn a_loop_without_a_bound_is_named() {
        let error = cycles(&COUNT, None, Waits::NONE).expect_err("no bound");
        assert!(error.to_string().contains("write `// Bound: 8 rounds: reason.`"), "{error}");
    }

    #[test]
    fn a_loop_in_a_loop_needs_its_own_bound() {
        // COUNT with another counter around it.
        let halves = [0x2105, 0x2005, 0x3801, 0xD1FD, 0x3901, 0xD1FA, 0x4770];
        assert!(cycles(&halves, Some(5), Waits::NONE).is_err());
    }

    #[test]
    fn a_loop_with_two_entries_is_refused() {
        // CBZ R0 into the middle of COUNT's loop.
        let halves = [0xB100, 0x3801, 0x2005, 0xD1FC, 0x4770];
        let error = cycles(&halves, Some(5), Waits::NONE).expect_err("two entries");
        assert!(error.to_string().contains("several entries"), "{error}");
    }

    #[test]
    fn what_cannot_be_followed_is_refused() {
        // BLX R3, BX R3, a load of a float.
        for halves in [&[0x4798][..], &[0x4718], &[0xED93, 0x0A00]] {
            assert!(cycles(halves, None, Waits::NONE).is_err());
        }
        // CBZ R0 over BL itself.
        let error =
            cycles(&[0xB108, 0xF7FF, 0xFFFD, 0x4770], None, Waits::NONE).expect_err("recursion");
        assert!(error.to_string().contains("calls itself"), "{error}");
    }

    #[test]
    fn each_new_line_of_the_flash_waits() {
        // Eight narrow instructions fill a line; the read of the next one has ended by then.
        let mut halves = [0x2000; 16];
        halves[15] = 0x4770;
        assert_eq!(cycles(&halves, None, Waits::FLASH).expect("a bound"), 16);
        // B over the rest of the line: another line.
        halves[0] = 0xE006;
        let bound = cycles(&halves, None, Waits::FLASH).expect("a bound");
        assert_eq!(bound, 1 + REFILL + 11 + 8);
        // Four wide ones last four cycles of six.
        let wide = [[0xF04F, 0x0000]; 4].concat();
        let bound = cycles(&[&wide[..], &[0x4770]].concat(), None, Waits::FLASH).expect("a bound");
        assert_eq!(bound, 4 + 2 + 1);
    }
}
