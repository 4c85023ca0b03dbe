//! The response of the whole node under the worst legal bus load: from the times of the tasks to lost frames and the
//! latest answer.

use super::costs::{Costs, STORE_ACTIONS};

/// Core cycles in a bit at 1 Mbit/s.
pub const BIT: u64 = 160;
/// The places of the receive FIFO.
const PLACES: u64 = 3;
/// Programming a word of the flash takes at most 100 us.
pub const FLASH_WORD: u64 = 100 * BIT;

/// The least producer heartbeat time.
const LEAST_HEARTBEAT: u64 = 1_000 * BIT;
/// An LSS or SDO answer, and a heartbeat or a boot-up.
const ANSWER_BYTES: u64 = 8;
const HEARTBEAT_BYTES: u64 = 1;

/// Bits of a data frame with this number of bytes and the space after it, without a stuff bit.
pub const fn bits(bytes: u64) -> u64 {
    const SPACE: u64 = 3;
    44 + 8 * bytes + SPACE
}

/// What the interrupt of a frame of the node takes beyond the time of that frame on the bus, by which all later frames
/// come later.
const fn beyond_own_frame(costs: &Costs, bytes: u64) -> u64 {
    costs.transmitted.saturating_sub(bits(bytes) * BIT)
}

/// A heartbeat: the action, and the rest of its interrupt.
pub const fn heartbeat(costs: &Costs) -> u64 {
    costs.action + beyond_own_frame(costs, HEARTBEAT_BYTES)
}

/// Frames for the node, one directly after the other.
#[derive(Clone, Copy, Debug)]
pub struct Stream {
    pub name: &'static str,
    /// The bytes of each frame.
    pub bytes: u64,
    /// The cycles for each frame, one of several in an activation.
    pub cycles: u64,
}

impl Stream {
    /// The streams that reach the FIFO: the filters let pass the requests of LSS and of SDO and the commands of NMT, of
    /// any length.
    pub fn all(costs: &Costs) -> [Self; 6] {
        let with = |actions| costs.more_silent_frames() + actions * costs.action;
        let stream = |name, bytes, cycles| Self { name, bytes, cycles };
        let sent = beyond_own_frame(costs, ANSWER_BYTES);
        [
            stream("LSS requests", 8, costs.more_frames.max(with(1)) + sent),
            stream("SDO requests", 8, with(1) + sent),
            stream("LSS requests without an answer", 8, with(0)),
            stream("NMT commands, without a reset", 2, with(0)),
            stream("NMT resets of communication", 2, with(2)),
            stream("frames without data", 0, with(0)),
        ]
    }

    /// The cycles between two of the frames.
    pub const fn period(&self) -> u64 {
        bits(self.bytes) * BIT
    }

    /// The first of the frames that may be lost, if there is one. The first frame comes when something else begins that
    /// keeps the node busy for `blocking`; `every` is the producer heartbeat time in cycles, if there are heartbeats.
    pub fn first_loss(&self, costs: &Costs, blocking: u64, every: Option<u64>) -> Option<u64> {
        const MANY: u64 = 1_000;
        let is_late = |&frame: &u64| self.slack(costs, blocking, frame, every).is_none();
        let lost = (1..MANY).find(is_late).map(|frame| frame + PLACES);
        lost.or_else(|| (!self.is_safe_from(costs, blocking, MANY, every)).then_some(MANY))
    }

    /// The cycles between the release of a frame and the arrival of the one that needs its place.
    pub fn slack(
        &self,
        costs: &Costs,
        blocking: u64,
        frame: u64,
        every: Option<u64>,
    ) -> Option<u64> {
        let arrival = (frame + PLACES - 1) * self.period();
        let own = blocking + costs.transmitted + (frame - 1) * self.cycles + costs.release;
        // Each heartbeat makes the release later, which may be long enough for another.
        let mut release = own;
        while release <= arrival {
            let beats = every.map_or(0, |every| release / every);
            let later = own + beats * heartbeat(costs);
            if later == release {
                return Some(arrival - release);
            }
            release = later;
        }
        None
    }

    /// Whether no frame after this one is lost: with at least as many heartbeats as there are, each frame has its slack,
    /// and the next ones have no less.
    fn is_safe_from(&self, costs: &Costs, blocking: u64, frame: u64, every: Option<u64>) -> bool {
        let beats = |cycles: u64| match every {
            Some(every) => cycles as f64 / every as f64 * heartbeat(costs) as f64,
            None => 0.0,
        };
        let gain = self.period() as f64 - self.cycles as f64 - beats(self.period());
        let arrival = (frame + PLACES - 1) * self.period();
        let release = blocking + costs.transmitted + (frame - 1) * self.cycles + costs.release;
        gain >= 0.0 && release as f64 + beats(arrival) <= arrival as f64
    }

    /// The least heartbeat time in milliseconds with which heartbeats do not change the first frame that may be lost.
    pub fn least_heartbeat_ms(&self, costs: &Costs, blocking: u64) -> u64 {
        const MOST: u64 = 65_535;
        let without = self.first_loss(costs, blocking, None);
        let with = |ms: &u64| self.first_loss(costs, blocking, Some(ms * LEAST_HEARTBEAT));
        (1..=MOST).find(|ms| with(ms) == without).unwrap_or(MOST)
    }
}

/// Something that keeps the node from a frame.
#[derive(Clone, Copy, Debug)]
pub struct Blocking {
    pub name: &'static str,
    pub cycles: u64,
    /// Whether it needs a store.
    pub is_of_store: bool,
}

/// What may be under way when a frame comes. The interrupts of the node's tasks have one priority, so that none
/// interrupts another; the task that stores raises it in its critical sections. While the core waits for a word of the
/// flash, it may have taken the interrupt of the timer.
pub fn blocking(costs: &Costs) -> [Blocking; 6] {
    let of = |name, cycles| Blocking { name, cycles, is_of_store: false };
    let of_store = |name, cycles| Blocking { name, cycles, is_of_store: true };
    let timer = costs.due + heartbeat(costs);
    let section = costs.section + (STORE_ACTIONS - 1) * costs.action + heartbeat(costs);
    [
        of("timer, with a heartbeat", timer),
        of("error state, four times a second, with a heartbeat", costs.status + heartbeat(costs)),
        of_store(
            "critical section of the store, with its answer, the next store and a heartbeat",
            section,
        ),
        of_store("log line of the store", costs.log),
        of_store("a word of the flash", FLASH_WORD),
        of_store("a word of the flash, then the timer with a heartbeat", FLASH_WORD + timer),
    ]
}

/// The longest of them, while a store may be under way or not.
pub fn longest_blocking(costs: &Costs, with_store: bool) -> u64 {
    let all = blocking(costs).into_iter().filter(|blocking| with_store || !blocking.is_of_store);
    all.map(|blocking| blocking.cycles).max().unwrap_or(0)
}

/// The longest time from a request to the transmit request of its answer, with frames in the FIFO before it that take
/// `before` cycles, two frames of the node that are sent meanwhile, and heartbeats as fast as they can be.
pub fn answer(costs: &Costs, before: u64) -> u64 {
    let own = longest_blocking(costs, true) + 2 * costs.transmitted + before + costs.answer;
    own + own / LEAST_HEARTBEAT * costs.action
}

#[cfg(test)]
mod tests {
    use super::*;

    const FREE: Costs = Costs {
        frame: 0,
        more_frames: 0,
        silent_frame: 0,
        action: 0,
        transmitted: 0,
        status: 0,
        due: 0,
        release: 0,
        answer: 0,
        section: 0,
        log: 0,
        start: 0,
        transmit: 0,
    };

    fn stream(bytes: u64, us: u64) -> Stream {
        Stream { name: "", bytes, cycles: us * BIT }
    }

    #[test]
    fn a_frame_has_the_bits_of_iso_11898() {
        assert_eq!((bits(0), bits(8)), (47, 111));
    }

    #[test]
    fn a_fast_task_loses_no_frame_if_it_begins_within_three_frames() {
        assert_eq!(stream(0, 47).first_loss(&FREE, 141 * BIT, None), None);
        assert_eq!(stream(0, 47).first_loss(&FREE, 141 * BIT + 1, None), Some(4));
    }

    #[test]
    fn a_slow_task_loses_a_frame_when_its_delay_is_three_frames() {
        // Each frame takes 10 us too long, and the first may be 141 us late: the 16th begins 150 us late.
        assert_eq!(stream(0, 57).first_loss(&FREE, 0, None), Some(16 + 3));
        assert_eq!(stream(0, 57).first_loss(&FREE, 47 * BIT, None), Some(11 + 3));
    }

    #[test]
    fn heartbeats_take_what_the_frames_leave() {
        let costs = Costs { action: 100 * BIT, ..FREE };
        // Of each frame 7 us are left, which are 111 us in a millisecond and 89 us in 800 us.
        let stream = stream(2, 56);
        assert!(stream.first_loss(&costs, 0, Some(1_000 * BIT)).is_none());
        assert!(stream.first_loss(&costs, 0, Some(800 * BIT)).is_some());
        assert_eq!(stream.least_heartbeat_ms(&costs, 0), 1);
        assert_eq!(self::stream(2, 57).least_heartbeat_ms(&costs, 0), 2);
    }

    #[test]
    fn the_interrupt_of_a_heartbeat_counts_beyond_its_time_on_the_bus() {
        let costs = |us| Costs { action: 7, transmitted: us * BIT, ..FREE };
        assert_eq!((heartbeat(&costs(55)), heartbeat(&costs(56))), (7, 7 + BIT));
    }

    #[test]
    fn a_word_of_the_flash_may_precede_the_timer() {
        let costs = Costs { due: 5, action: 3, ..FREE };
        assert_eq!(longest_blocking(&costs, true), FLASH_WORD + 8);
        assert_eq!(longest_blocking(&costs, false), 8);
    }
}
