//! The flash's wait states and the ART accelerator, which hides most of them (RM0090 3.5).
//!
//! - A read gives a line of 128 bits and takes six cycles; the flash does one read at a time.
//! - The line of the present instruction, the prefetched line after it, and 64 lines of instructions and eight of data in
//!   caches, the least recently used of which are replaced, need no read. Each line that is used goes into its cache.
//! - A prefetch under way is finished before the next read. One that has not begun gives way to it.
//!
//! The words that a Cortex-M4 fetches ahead of the present instruction are left out: they hide some waits, and cause
//! others behind a jump.

/// The fields of FLASH_ACR.
const LATENCY: u32 = 0xF;
const PRFTEN: u32 = 1 << 8;
const ICEN: u32 = 1 << 9;
const DCEN: u32 = 1 << 10;
const ICRST: u32 = 1 << 11;
const DCRST: u32 = 1 << 12;

/// The bits of an address within a line of 128 bits.
const LINE_BITS: u32 = 4;
const INSTRUCTION_LINES: usize = 64;
const DATA_LINES: usize = 8;

/// A cache of lines, the least recently used one first.
#[derive(Debug)]
struct Cache {
    lines: Vec<u32>,
    size: usize,
}

impl Cache {
    fn new(size: usize) -> Self {
        Self { lines: Vec::with_capacity(size), size }
    }

    fn contains(&self, line: u32) -> bool {
        self.lines.contains(&line)
    }

    /// Whether it has the line, which thereby becomes the most recently used.
    fn hits(&mut self, line: u32) -> bool {
        let Some(position) = self.lines.iter().rposition(|&held| held == line) else {
            return false;
        };
        self.lines[position..].rotate_left(1);
        true
    }

    fn insert(&mut self, line: u32) {
        if self.lines.len() == self.size {
            self.lines.remove(0);
        }
        self.lines.push(line);
    }
}

/// The way of a fetch or a load to the flash, in core cycles.
///
/// A read of a line takes the wait states and a cycle more, one read after the other. The fetches that a Cortex-M4 makes
/// ahead of the instruction that it executes are left out.
#[derive(Debug)]
pub struct Accelerator {
    acr: u32,
    /// The line that the present instruction came from.
    current: Option<u32>,
    /// The line after it, and the first cycle that can use it.
    prefetched: Option<(u32, u64)>,
    instructions: Cache,
    data: Cache,
    /// The cycle at which the flash can begin another read.
    free: u64,
    /// The waits since the last call of [`take_waits`](Self::take_waits).
    waits: u64,
}

impl Accelerator {
    /// The state after a reset: no wait states, and everything off.
    pub fn new() -> Self {
        Self {
            acr: 0,
            current: None,
            prefetched: None,
            instructions: Cache::new(INSTRUCTION_LINES),
            data: Cache::new(DATA_LINES),
            free: 0,
            waits: 0,
        }
    }

    /// Follows FLASH_ACR. A cache that is reset is emptied.
    pub fn configure(&mut self, acr: u32) {
        if acr == self.acr {
            return;
        }
        if acr & ICRST != 0 {
            self.instructions.lines.clear();
        }
        if acr & DCRST != 0 {
            self.data.lines.clear();
        }
        if acr & PRFTEN == 0 {
            self.prefetched = None;
        }
        self.acr = acr;
    }

    /// The cycles that reads have waited since the last call.
    pub fn take_waits(&mut self) -> u64 {
        std::mem::take(&mut self.waits)
    }

    fn latency(&self) -> u64 {
        (self.acr & LATENCY).into()
    }

    /// Reads a line from the flash at `now`, once the flash is free; returns the wait.
    fn read(&mut self, now: u64) -> u64 {
        let begin = self.free.max(now);
        self.free = begin + self.latency() + 1;
        begin - now + self.latency()
    }

    /// Takes back a prefetch whose read has not begun by `now`, and returns its line: the next read goes first.
    fn take_waiting_prefetch(&mut self, now: u64) -> Option<u32> {
        let latency = self.latency();
        let (line, ready) = self.prefetched.take_if(|(_, ready)| *ready > now + latency)?;
        self.free = ready - latency;
        Some(line)
    }

    fn prefetch(&mut self, line: u32, now: u64) {
        let ready = now + self.read(now);
        self.prefetched = Some((line, ready));
    }

    /// Fetches an instruction in the cycle `cycle`, to which the waits since the last call are added.
    pub fn fetch(&mut self, address: u32, cycle: u64) {
        let line = address >> LINE_BITS;
        if self.latency() == 0 || self.current == Some(line) {
            return;
        }
        self.current = Some(line);
        let now = cycle + self.waits;
        self.take_waiting_prefetch(now);
        let caches = self.acr & ICEN != 0;
        let wait = if caches && self.instructions.hits(line) {
            0
        } else {
            if caches {
                self.instructions.insert(line);
            }
            match self.prefetched {
                Some((prefetched, ready)) if prefetched == line => ready.saturating_sub(now),
                _ => self.read(now),
            }
        };
        self.waits += wait;
        let next = line + 1;
        let is_there = self.prefetched.is_some_and(|(prefetched, _)| prefetched == next)
            || caches && self.instructions.contains(next);
        if self.acr & PRFTEN != 0 && !is_there {
            self.prefetch(next, now + wait);
        }
    }

    /// Loads data in the cycle `cycle`, to which the waits since the last call are added.
    pub fn load(&mut self, address: u32, cycle: u64) {
        let line = address >> LINE_BITS;
        if self.latency() == 0 || self.acr & DCEN != 0 && self.data.hits(line) {
            return;
        }
        if self.acr & DCEN != 0 {
            self.data.insert(line);
        }
        let now = cycle + self.waits;
        let waiting = self.take_waiting_prefetch(now);
        self.waits += self.read(now);
        if let Some(line) = waiting {
            self.prefetch(line, now);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FIVE: u32 = 5;

    /// Executes instructions of one cycle and of the given length at these addresses; returns the cycles they take.
    fn run(accelerator: &mut Accelerator, from: u64, addresses: impl Iterator<Item = u32>) -> u64 {
        let mut cycle = from;
        for address in addresses {
            accelerator.fetch(address, cycle);
            cycle += 1 + accelerator.take_waits();
        }
        cycle - from
    }

    fn with(acr: u32) -> Accelerator {
        let mut accelerator = Accelerator::new();
        accelerator.configure(acr);
        accelerator
    }

    /// Ten lines of instructions of this length.
    fn straight(length: usize) -> impl Iterator<Item = u32> {
        (0..10 * 16).step_by(length)
    }

    #[test]
    fn each_line_costs_the_wait_states_unless_prefetch_hides_them() {
        for (acr, length, cycles) in [
            (0, 2, 80),
            (FIVE, 2, 80 + 10 * 5),
            (2, 2, 80 + 10 * 2),
            (FIVE | PRFTEN, 2, 80 + 5),
            // Four long instructions last as long as the read of the next line.
            (FIVE | PRFTEN, 4, 5 + 4 + 9 * 6),
        ] {
            assert_eq!(run(&mut with(acr), 0, straight(length)), cycles, "{acr:#x}, {length}");
        }
    }

    /// Jumps from line to line, each to the one after the next.
    fn jumps(lines: u32) -> impl Iterator<Item = u32> {
        (0..lines).map(|line| line * 32)
    }

    #[test]
    fn prefetched_lines_are_cached_too() {
        let mut accelerator = with(FIVE | ICEN | PRFTEN);
        assert_eq!(run(&mut accelerator, 0, straight(4)), 5 + 4 + 9 * 6);
        assert_eq!(run(&mut accelerator, 100, straight(4)), 40);
    }

    #[test]
    fn a_loop_of_64_lines_waits_in_its_first_turn_only_and_one_of_65_always() {
        for (lines, later) in [(64, 64), (65, 65 * 6)] {
            let mut accelerator = with(FIVE | ICEN);
            let first = run(&mut accelerator, 0, jumps(lines));
            assert_eq!(first, u64::from(lines) * 6);
            assert_eq!(run(&mut accelerator, first, jumps(lines)), later);
            assert_eq!(run(&mut accelerator, 2 * first, jumps(lines)), later);
        }
    }

    #[test]
    fn a_jump_waits_for_the_prefetch_that_is_under_way() {
        let mut accelerator = with(FIVE | PRFTEN);
        // The line after the first one is read in cycles 6 to 11, and the jump comes in cycle 6.
        assert_eq!(run(&mut accelerator, 0, [0, 0x1000].into_iter()), 6 + 6 + 6);
    }

    #[test]
    fn prefetches_do_not_queue_up_behind_one_another() {
        let mut accelerator = with(FIVE | ICEN | PRFTEN);
        let mut cycle = 0;
        // Two cached lines in turn, whose next lines are not: each entry asks for another prefetch.
        for line in [0x000, 0x100].repeat(20) {
            accelerator.fetch(line, cycle);
            cycle += 1 + accelerator.take_waits();
        }
        accelerator.fetch(0x1000, cycle);
        assert!(accelerator.take_waits() <= 11);
    }

    #[test]
    fn eight_lines_of_data_are_kept() {
        let mut accelerator = with(FIVE | DCEN);
        let mut loads = |lines: u32, from: u64| {
            (0..lines).fold(from, |cycle, line| {
                accelerator.load(line * 16, cycle);
                cycle + 1 + accelerator.take_waits()
            }) - from
        };
        assert_eq!(loads(8, 0), 8 * 6);
        assert_eq!(loads(8, 100), 8);
        assert_eq!(loads(9, 200), 8 + 6);
        assert_eq!(loads(9, 300), 9 * 6);
    }

    #[test]
    fn a_reset_of_a_cache_empties_it() {
        let mut accelerator = with(FIVE | ICEN);
        run(&mut accelerator, 0, jumps(4));
        accelerator.configure(FIVE);
        accelerator.configure(FIVE | ICRST);
        accelerator.configure(FIVE | ICEN);
        assert_eq!(run(&mut accelerator, 100, jumps(4)), 4 * 6);
    }
}
