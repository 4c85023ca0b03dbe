//! The response of the whole node under the worst legal bus load: from the times of the tasks to lost frames and the
//! latest answer.

use super::costs::Costs;

/// Core cycles in a bit at 1 Mbit/s.
pub const BIT: u64 = 160;
/// The places of the receive FIFO.
const PLACES: u64 = 3;
/// Programming a word of the flash takes at most 100 us.
pub const FLASH_WORD: u64 = 100 * BIT;

/// Bits of a data frame with this number of bytes and the space after it, without a stuff bit.
pub const fn bits(bytes: u64) -> u64 {
    const SPACE: u64 = 3;
    44 + 8 * bytes + SPACE
}

/// Frames for the node, one directly after the other.
#[derive(Clone, Copy, Debug)]
pub struct Stream {
    pub name: &'static str,
    /// The bytes of each frame.
    pub bytes: u64,
    /// The bytes of the answer to each, which wins the bus against the next frame.
    pub answer: Option<u64>,
    /// The cycles for each frame, one of several in an activation.
    pub cycles: u64,
}

impl Stream {
    /// The streams that reach the FIFO: the filters let pass the requests of LSS and of SDO and the commands of NMT, of
    /// any length.
    pub fn all(costs: &Costs) -> [Self; 5] {
        let with = |actions| costs.more_silent_frames() + actions * costs.action;
        let stream = |name, bytes, answer, cycles| Self { name, bytes, answer, cycles };
        [
            stream("LSS requests", 8, Some(8), costs.more_frames.max(with(1))),
            stream("SDO requests", 8, Some(8), with(1)),
            stream("NMT commands, without a reset", 2, None, with(0)),
            stream("NMT reset communication", 2, None, with(2)),
            stream("frames without data", 0, None, with(0)),
        ]
    }

    /// The cycles between two of the frames.
    pub const fn period(&self) -> u64 {
        bits(self.bytes) * BIT
    }

    /// The cycles between two of the frames if each has been answered.
    pub fn lasting_period(&self) -> u64 {
        self.period() + self.answer.map_or(0, |bytes| bits(bytes) * BIT)
    }

    /// The number of frames without a gap after which one may be lost, if there is such a number: the first frame comes
    /// when something else begins that keeps the node busy for `blocking`.
    pub fn first_loss(&self, costs: &Costs, blocking: u64) -> Option<u64> {
        const MANY: u64 = 1_000;
        (1..MANY)
            .find(|&frame| self.slack(costs, blocking, frame).is_none())
            .map(|frame| frame + PLACES - 1)
    }

    /// The cycles between the release of a frame and the arrival of the one that needs its place.
    pub fn slack(&self, costs: &Costs, blocking: u64, frame: u64) -> Option<u64> {
        // An answer is in a mailbox when its frame is done, and on the bus before the next frame but one.
        let answers = if self.answer.is_some() { frame.saturating_sub(2) } else { 0 };
        let arrival = (frame + PLACES - 1) * self.period()
            + answers * (self.lasting_period() - self.period());
        let release = blocking
            + (1 + answers) * costs.transmitted
            + (frame - 1) * self.cycles
            + costs.release;
        arrival.checked_sub(release)
    }
}

/// Something that keeps the node from a frame.
#[derive(Clone, Copy, Debug)]
pub struct Blocking {
    pub name: &'static str,
    pub cycles: u64,
}

/// What may be under way when a frame comes. The interrupts of the node's tasks have one priority, so that none
/// interrupts another; the task that stores raises it in its critical sections.
pub fn blocking(costs: &Costs) -> [Blocking; 5] {
    let of = |name, cycles| Blocking { name, cycles };
    [
        of("timer, with a heartbeat", costs.due + costs.action),
        of("error state, four times a second", costs.status),
        of("critical section of the store, with its answer", costs.section + costs.action),
        of("log line of the store", costs.log),
        of("a word of the flash", FLASH_WORD),
    ]
}

/// The longest of them.
pub fn longest_blocking(costs: &Costs) -> u64 {
    blocking(costs).iter().map(|blocking| blocking.cycles).max().unwrap_or(0)
}

/// The longest time from a request to the transmit request of its answer, with a full FIFO before it.
pub fn answer(costs: &Costs) -> u64 {
    let before = Stream::all(costs).iter().map(|stream| stream.cycles).max().unwrap_or(0);
    longest_blocking(costs) + costs.transmitted + (PLACES - 1) * before + costs.answer
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
    };

    fn stream(bytes: u64, answer: Option<u64>, us: u64) -> Stream {
        Stream { name: "", bytes, answer, cycles: us * BIT }
    }

    #[test]
    fn a_frame_has_the_bits_of_iso_11898() {
        assert_eq!((bits(0), bits(8)), (47, 111));
    }

    #[test]
    fn a_fast_task_loses_no_frame_if_it_begins_within_three_frames() {
        assert_eq!(stream(0, None, 47).first_loss(&FREE, 141 * BIT), None);
        assert_eq!(stream(0, None, 47).first_loss(&FREE, 141 * BIT + 1), Some(3));
    }

    #[test]
    fn a_slow_task_loses_a_frame_when_its_delay_is_three_frames() {
        // Each frame takes 10 us too long, and the first may be 141 us late: the 15th begins 140 us late.
        assert_eq!(stream(0, None, 57).first_loss(&FREE, 0), Some(15 + 3));
        assert_eq!(stream(0, None, 57).first_loss(&FREE, 47 * BIT), Some(10 + 3));
    }

    #[test]
    fn answers_on_the_bus_give_the_task_time() {
        assert_eq!(stream(8, Some(8), 222).first_loss(&FREE, 0), None);
        assert!(stream(8, None, 222).first_loss(&FREE, 0).is_some());
        assert!(stream(8, Some(8), 223).first_loss(&FREE, 0).is_some());
    }
}
