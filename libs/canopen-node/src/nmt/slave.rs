//! The NMT slave (CiA 301): the NMT state and the commands that change it, boot-up, heartbeat and error behaviour.

use core::mem;

use super::{Command, ErrorBehaviour, State, error_control, producer::HeartbeatTimes};
use crate::{Frame, Instant, NodeId, Service, Services, emergency::Allowed};

/// The NMT state of the node, and the messages that report it.
#[derive(Clone, Debug)]
pub(crate) struct NmtSlave {
    /// Initialisation until the first boot-up is sent.
    state: State,
    boot_up: BootUp,
    heartbeat: HeartbeatTimes,
    /// 1029h sub-index 1.
    error_behaviour: ErrorBehaviour,
    /// That has stopped the node.
    is_stopped_by_error: bool,
    /// The services whose pending frames a change of the state has made stale.
    stale: Services,
    /// A command that has not been executed; it waits for the end of a bit rate switch.
    command: Option<Command>,
}

/// The progress of the boot-up message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum BootUp {
    /// It is sent as soon as there is a node-ID and frames may be sent.
    Due,
    Sent,
    /// It has left, or the others know the node without it.
    Over,
}

impl NmtSlave {
    /// A slave after power-on, with this producer heartbeat time and this error behaviour.
    pub const fn new(heartbeat_ms: u16, error_behaviour: ErrorBehaviour) -> Self {
        Self {
            state: State::Initialisation,
            boot_up: BootUp::Due,
            heartbeat: HeartbeatTimes::new(heartbeat_ms),
            error_behaviour,
            is_stopped_by_error: false,
            stale: Services::NONE,
            command: None,
        }
    }

    /// Restarts with the boot-up.
    pub const fn reset_communication(&mut self) {
        self.state = State::Initialisation;
        self.boot_up = BootUp::Due;
        self.stale = Services::NONE;
        self.heartbeat.is_extra_due = false;
    }

    /// Sets the parameters with which it starts: the producer heartbeat time and the error behaviour.
    pub const fn configure(&mut self, heartbeat_ms: u16, error_behaviour: ErrorBehaviour) {
        self.heartbeat.period_ms = heartbeat_ms;
        self.error_behaviour = error_behaviour;
    }

    /// The NMT state.
    pub const fn state(&self) -> State {
        self.state
    }

    /// Whether the boot-up waits to be sent.
    pub const fn is_boot_up_due(&self) -> bool {
        matches!(self.boot_up, BootUp::Due)
    }

    /// Whether SDO requests are served in this NMT state.
    pub const fn serves_sdo(&self) -> bool {
        matches!(self.state, State::PreOperational | State::Operational)
    }

    /// The emergency messages that may be sent: none before the boot-up has left.
    pub const fn emergencies(&self) -> Allowed {
        match (self.boot_up, self.state) {
            (BootUp::Due | BootUp::Sent, _) => Allowed::None,
            (BootUp::Over, State::Stopped) if self.is_stopped_by_error => Allowed::Cause,
            (BootUp::Over, State::Stopped) => Allowed::None,
            (BootUp::Over, _) => Allowed::All,
        }
    }

    /// Returns, once, the services whose pending frames name another state, or are forbidden by the new one.
    pub const fn take_stale(&mut self) -> Services {
        mem::replace(&mut self.stale, Services::NONE)
    }

    /// Accepts a command. The latest of several waiting commands wins, but a reset takes precedence, and reset node
    /// over reset communication.
    pub const fn handle(&mut self, command: Command) {
        let counts = match self.command {
            Some(Command::ResetNode) => false,
            Some(Command::ResetCommunication) => command.is_reset(),
            _ => true,
        };
        if counts {
            self.command = Some(command);
        }
    }

    /// Returns the command to execute now.
    pub const fn take_command(&mut self) -> Option<Command> {
        self.command.take()
    }

    /// Enters a state, as a master commands it; does nothing in initialisation.
    pub fn enter(&mut self, state: State) {
        let was_stopped_by_error = mem::take(&mut self.is_stopped_by_error);
        if self.state == State::Initialisation || self.state == state && !was_stopped_by_error {
            return;
        }
        self.state = state;
        let forbidden: &[Service] = match state {
            State::Stopped => &[Service::Tpdo, Service::Sdo, Service::Emergency],
            State::Operational => &[],
            _ => &[Service::Tpdo],
        };
        self.stale = Services::of_all(forbidden).and(Services::of(Service::Heartbeat));
    }

    /// Reacts to a communication error as the error behaviour demands.
    pub fn handle_communication_error(&mut self) {
        let state = match (self.error_behaviour, self.state) {
            (_, State::Initialisation | State::Stopped) => return,
            (ErrorBehaviour::EnterPreOperational, State::Operational) => State::PreOperational,
            (ErrorBehaviour::EnterStopped, _) => State::Stopped,
            _ => return,
        };
        self.enter(state);
        self.is_stopped_by_error = state == State::Stopped;
        // Nobody has commanded it.
        self.request_heartbeat();
    }

    /// Records that the boot-up was acknowledged.
    pub const fn note_acknowledge(&mut self) {
        if let BootUp::Sent = self.boot_up {
            self.boot_up = BootUp::Over;
        }
    }

    /// Records that the pending frames were dropped; a boot-up among them is due again, unless a master has commanded the
    /// node since. The NMT state stays: a master that is on the bus by now is served.
    pub const fn frames_dropped(&mut self) {
        if let BootUp::Sent = self.boot_up {
            self.boot_up = match self.state {
                State::PreOperational => BootUp::Due,
                _ => BootUp::Over,
            };
        }
    }

    /// Makes one heartbeat due in addition to the regular ones.
    pub const fn request_heartbeat(&mut self) {
        self.heartbeat.is_extra_due = true;
    }

    /// Restarts the heartbeat period with a heartbeat now.
    pub const fn restart_heartbeat(&mut self, now: Instant) {
        self.heartbeat.due = now;
    }

    /// Returns the boot-up of `node`, which is due.
    pub fn next_boot_up(&mut self, node: NodeId, now: Instant) -> Frame {
        self.boot_up = BootUp::Sent;
        if self.state == State::Initialisation {
            self.state = State::PreOperational;
        }
        self.heartbeat.follow_boot_up(now);
        error_control(node, State::Initialisation)
    }

    /// The time since when a heartbeat is due, if one is. The boot-up precedes it.
    pub fn heartbeat_due_since(&mut self, now: Instant) -> Option<Instant> {
        self.heartbeat.due_since(now)
    }

    /// Returns the heartbeat of `node`, which is due.
    pub fn next_heartbeat(&mut self, node: NodeId, now: Instant) -> Frame {
        self.heartbeat.follow_heartbeat(now);
        error_control(node, self.state)
    }

    /// Leaves out the heartbeats that were due while the one before waited for the bus.
    pub fn skip_heartbeats(&mut self, now: Instant) {
        self.heartbeat.skip(now);
    }

    /// The time of the next heartbeat.
    pub fn poll_at(&self) -> Option<Instant> {
        let is_produced = self.heartbeat.period_ms > 0 && !self.is_boot_up_due();
        is_produced.then_some(self.heartbeat.due)
    }

    /// The producer heartbeat time 1017h in milliseconds; 0 disables the heartbeat.
    pub const fn heartbeat_ms(&self) -> u16 {
        self.heartbeat.period_ms
    }

    /// Sets the producer heartbeat time 1017h; the first heartbeat follows after that time.
    pub const fn set_heartbeat_ms(&mut self, ms: u16, now: Instant) {
        self.heartbeat.period_ms = ms;
        self.heartbeat.due = now.plus_micros(self.heartbeat.period_micros());
    }

    /// The error behaviour 1029h sub-index 1.
    pub const fn error_behaviour(&self) -> ErrorBehaviour {
        self.error_behaviour
    }

    /// Sets the error behaviour 1029h sub-index 1.
    pub const fn set_error_behaviour(&mut self, behaviour: ErrorBehaviour) {
        self.error_behaviour = behaviour;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Instant = Instant::from_micros(0);

    fn node() -> NodeId {
        NodeId::new(5).expect("a node-ID")
    }

    /// A slave whose boot-up has been sent.
    fn booted(heartbeat_ms: u16) -> NmtSlave {
        let mut slave = NmtSlave::new(heartbeat_ms, ErrorBehaviour::DEFAULT);
        let boot_up = slave.next_boot_up(node(), NOW);
        assert_eq!(Some(boot_up), Frame::new(0x705, &[0]));
        slave
    }

    #[test]
    fn a_boot_up_is_sent_once() {
        assert_eq!(NmtSlave::new(0, ErrorBehaviour::DEFAULT).state(), State::Initialisation);
        let slave = booted(0);
        assert_eq!(slave.state(), State::PreOperational);
        assert!(!slave.is_boot_up_due());
    }

    #[test]
    fn a_boot_up_that_was_dropped_is_due_again_until_it_is_acknowledged() {
        let mut slave = booted(0);
        slave.frames_dropped();
        assert_eq!(slave.state(), State::PreOperational);
        assert!(slave.is_boot_up_due());
        slave.next_boot_up(node(), NOW);
        slave.note_acknowledge();
        slave.frames_dropped();
        assert_eq!(slave.state(), State::PreOperational);
    }

    #[test]
    fn emergencies_wait_for_the_acknowledge_of_the_boot_up() {
        let mut slave = booted(0);
        assert_eq!(slave.emergencies(), Allowed::None);
        slave.note_acknowledge();
        assert_eq!(slave.emergencies(), Allowed::All);
        slave.enter(State::Stopped);
        assert_eq!(slave.emergencies(), Allowed::None);
    }

    #[test]
    fn a_heartbeat_comes_each_period_and_once_after_a_long_delay() {
        let mut slave = booted(10);
        let at = |ms: u32| NOW.plus_micros(ms * 1000);
        assert_eq!(slave.poll_at(), Some(at(10)));
        for (ms, is_sent) in
            [(9, false), (10, true), (11, false), (20, true), (75, true), (84, false)]
        {
            let is_due = slave.heartbeat_due_since(at(ms)).is_some();
            assert_eq!(is_due, is_sent, "{ms} ms");
            if is_due {
                assert_eq!(slave.next_heartbeat(node(), at(ms)), Frame::with_one_byte(0x705, 0x7F));
            }
        }
        assert_eq!(slave.poll_at(), Some(at(85)));
    }

    #[test]
    fn of_commands_that_wait_the_latest_counts_but_resets_go_first() {
        use Command::*;
        for (commands, expected) in [
            (&[Start, Stop][..], Stop),
            (&[ResetCommunication, Start], ResetCommunication),
            (&[ResetCommunication, ResetNode], ResetNode),
            (&[ResetNode, ResetCommunication], ResetNode),
        ] {
            let mut slave = booted(0);
            commands.iter().for_each(|&command| slave.handle(command));
            assert_eq!(slave.take_command(), Some(expected), "{commands:?}");
            assert_eq!(slave.take_command(), None);
        }
    }
}
