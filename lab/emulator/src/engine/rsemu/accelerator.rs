//! The flash's wait states and its prefetch, which hides most of them (RM0090 3.5).
//!
//! - A read gives a line of 128 bits and takes the wait states and a cycle more; the flash does one read at a time.
//! - The line of the present instruction and the prefetched line after it need no read.
//! - A prefetch under way is finished before the next read. One that has not begun gives way to it.
//!
//! The caches are left out: our firmware has them off. So are the words that a Cortex-M4 fetches ahead of the present
//! instruction: they hide some waits, and cause others behind a jump.

/// The fields of FLASH_ACR.
const LATENCY: u32 = 0xF;
const PRFTEN: u32 = 1 << 8;

/// The bits of an address within a line of 128 bits.
const LINE_BITS: u32 = 4;

/// The way of a fetch or a load to the flash, in core cycles. By default the state after a reset: no wait states, and no
/// prefetch.
#[derive(Debug, Default)]
pub struct Accelerator {
    acr: u32,
    /// The line that the present instruction came from.
    current: Option<u32>,
    /// The line after it, and the first cycle that can use it.
    prefetched: Option<(u32, u64)>,
    /// The cycle at which the flash can begin another read.
    free: u64,
    /// The waits since the last call of [`take_waits`](Self::take_waits).
    waits: u64,
}

impl Accelerator {
    /// Follows FLASH_ACR.
    pub fn configure(&mut self, acr: u32) {
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
        let wait = match self.prefetched {
            Some((prefetched, ready)) if prefetched == line => ready.saturating_sub(now),
            _ => self.read(now),
        };
        self.waits += wait;
        let next = line + 1;
        let is_there = self.prefetched.is_some_and(|(prefetched, _)| prefetched == next);
        if self.acr & PRFTEN != 0 && !is_there {
            self.prefetch(next, now + wait);
        }
    }

    /// Loads data in the cycle `cycle`, to which the waits since the last call are added.
    pub fn load(&mut self, cycle: u64) {
        if self.latency() == 0 {
            return;
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
        Accelerator { acr, ..Accelerator::default() }
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

    #[test]
    fn a_jump_waits_for_the_prefetch_that_is_under_way() {
        let mut accelerator = with(FIVE | PRFTEN);
        // The line after the first one is read in cycles 6 to 11, and the jump comes in cycle 6.
        assert_eq!(run(&mut accelerator, 0, [0, 0x1000].into_iter()), 6 + 6 + 6);
    }
}
