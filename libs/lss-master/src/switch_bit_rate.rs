//! The switch of a whole network to another bit rate.

use lss_slave::{
    BitRate,
    lss::{Address, Request},
};

use crate::{Error, Outcome, Procedure, Service, Step};

/// A slave that takes part in a switch, and what became of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Member {
    /// The slave's LSS address.
    pub address: Address,
    /// Why it did not accept the bit rate or, after the switch, did not answer at it.
    pub outcome: Result<(), Error>,
}

impl Member {
    /// A slave that is to take part.
    pub const fn new(address: Address) -> Self {
        Self { address, outcome: Ok(()) }
    }
}

/// Switches a network to another bit rate, and finds out whether all members are there (CiA 305, activate bit timing).
///
/// Each member is selected and configured, with an answer. If one of them fails, those before it get the old rate as
/// pending again, and nothing is switched. Then all change together: the last frame at the old rate, one switch delay,
/// the change of all bit rates, and another delay until the first frame at the new one. In the end each member is
/// selected at the new rate, and all are in LSS waiting state. Nothing is stored.
///
/// It fails with the first member's error; the outcome of each member says more.
#[derive(Debug)]
pub struct SwitchBitRate<'a> {
    members: &'a mut [Member],
    from: BitRate,
    to: BitRate,
    delay_ms: u16,
    state: State,
}

/// What was sent last; a number is that of the member.
#[derive(Clone, Copy, Debug)]
enum State {
    Select(usize),
    Configure(usize),
    SelectAgain(usize),
    ConfigureBack(usize),
    SwitchToConfiguration,
    Activate,
    OldBitRate,
    SetBitRate,
    NewBitRate,
    Confirm(usize),
    SwitchToWaiting,
}

impl<'a> SwitchBitRate<'a> {
    /// The time after the second switch delay until all clocks have reached its end, in microseconds.
    const TOLERANCE: u32 = 10_000;

    /// The switch from one bit rate to another, with a switch delay in milliseconds that is long enough for a request
    /// to leave the adapter and for each CAN controller to change its bit rate: such as 100, and not 0.
    pub const fn new(members: &'a mut [Member], from: BitRate, to: BitRate, delay_ms: u16) -> Self {
        Self { members, from, to, delay_ms, state: State::SwitchToWaiting }
    }

    /// Selects the member with this number; what `end` says after the last one.
    fn select(
        &mut self,
        number: usize,
        state: fn(usize) -> State,
        end: impl FnOnce(&mut Self) -> Step<()>,
    ) -> Step<()> {
        match self.members.get(number) {
            Some(member) => {
                self.state = state(number);
                Step::Ask(Service::Select(member.address))
            }
            None => end(self),
        }
    }

    fn ask(&mut self, state: State, request: Request) -> Step<()> {
        self.state = state;
        Step::ask(request)
    }

    fn configure(&mut self, state: State, rate: BitRate) -> Step<()> {
        self.ask(state, Request::ConfigureBitTiming { table: 0, index: rate.index() })
    }

    /// Half of the switch delay in microseconds.
    const fn half_delay(&self) -> u32 {
        self.delay_ms as u32 * 500
    }

    fn switch_to_waiting(&mut self) -> Step<()> {
        self.ask(State::SwitchToWaiting, Request::SwitchToWaiting)
    }

    /// The old rate for the members before this one.
    fn take_back(&mut self, number: usize) -> Step<()> {
        match number.checked_sub(1) {
            Some(before) => self.select(before, State::SelectAgain, Self::switch_to_waiting),
            None => self.switch_to_waiting(),
        }
    }

    fn note(&mut self, number: usize, outcome: Outcome) {
        if let Some(member) = self.members.get_mut(number) {
            member.outcome = outcome.map(drop);
        }
    }
}

impl Procedure for SwitchBitRate<'_> {
    type Output = ();

    fn begin(&mut self) -> Step<()> {
        for member in &mut *self.members {
            member.outcome = Ok(());
        }
        self.select(0, State::Select, Self::switch_to_waiting)
    }

    fn next(&mut self, outcome: Outcome) -> Step<()> {
        match self.state {
            State::Select(number) if outcome.is_err() => {
                self.note(number, outcome);
                self.take_back(number)
            }
            // It may have accepted the bit rate, and its answer may be lost.
            State::Configure(number) if outcome.is_err() => {
                self.note(number, outcome);
                self.take_back(number.saturating_add(1))
            }
            State::Select(number) => self.configure(State::Configure(number), self.to),
            State::Configure(number) => {
                self.select(number.saturating_add(1), State::Select, |this| {
                    this.ask(State::SwitchToConfiguration, Request::SwitchToConfiguration)
                })
            }
            State::SelectAgain(number) => self.configure(State::ConfigureBack(number), self.from),
            State::ConfigureBack(number) => self.take_back(number),
            State::SwitchToConfiguration => {
                self.ask(State::Activate, Request::ActivateBitTiming(self.delay_ms))
            }
            // Halfway through the second delay: the request may have left late, and nobody sends before its end.
            State::Activate => {
                self.state = State::OldBitRate;
                Step::Pause(3 * self.half_delay())
            }
            State::OldBitRate => {
                self.state = State::SetBitRate;
                Step::SetBitRate(self.to)
            }
            State::SetBitRate => {
                self.state = State::NewBitRate;
                Step::Pause(self.half_delay() + Self::TOLERANCE)
            }
            State::NewBitRate => self.select(0, State::Confirm, Self::switch_to_waiting),
            State::Confirm(number) => {
                self.note(number, outcome);
                self.select(number.saturating_add(1), State::Confirm, Self::switch_to_waiting)
            }
            State::SwitchToWaiting => {
                let mut outcomes = self.members.iter().map(|member| member.outcome);
                Step::Done(outcomes.find(Result::is_err).unwrap_or(Ok(())))
            }
        }
    }
}
