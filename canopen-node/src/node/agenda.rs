//! What the node has to do: the tasks that are due, and the deadlines of the others.

use crate::Instant;

/// A part of the node's work. Those that are due are done in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum Task {
    /// A new NMT state, for the application and process data.
    State,
    /// The steps of a switch and of the supervision, which decide whether the others may be done.
    BitRate,
    /// An NMT command.
    Command,
    /// Heartbeats that are missing, and errors of process data that are over.
    Producers,
    Sdo,
    Store,
    /// Boot-up, emergency messages and heartbeat.
    Messages,
    Pdos,
}

/// A set of tasks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Tasks(u8);

impl Tasks {
    pub const NONE: Self = Self(0);
    pub const ALL: Self = Self(u8::MAX);
    /// Those that send frames or store settings.
    pub const SENDING: Self = Self::of(&[Task::Sdo, Task::Store, Task::Messages, Task::Pdos]);
    /// Those that wait for the end of a switch.
    pub const AFTER_SWITCH: Self = Self(Self::ALL.0 & !Self::of(&[Task::State, Task::BitRate]).0);

    pub const fn of(tasks: &[Task]) -> Self {
        let (mut set, mut rest) = (Self::NONE, tasks);
        while let [task, others @ ..] = rest {
            set.0 |= task.bit();
            rest = others;
        }
        set
    }

    const fn has(self, task: Task) -> bool {
        self.0 & task.bit() != 0
    }
}

impl Task {
    const EACH: [Self; 8] = [
        Self::State,
        Self::BitRate,
        Self::Command,
        Self::Producers,
        Self::Sdo,
        Self::Store,
        Self::Messages,
        Self::Pdos,
    ];
    /// Those that have deadlines.
    const TIMED: [Self; 5] =
        [Self::BitRate, Self::Producers, Self::Sdo, Self::Messages, Self::Pdos];

    const fn bit(self) -> u8 {
        1 << self as u8
    }
}

/// The tasks that are due, and the deadlines of the others.
#[derive(Clone, Debug)]
pub(super) struct Agenda {
    due: Tasks,
    /// The tasks that must not be done now.
    held: Tasks,
    /// The tasks whose deadline may have changed.
    changed: Tasks,
    /// The deadlines of [`Task::TIMED`], in that order.
    deadlines: [Option<Instant>; Task::TIMED.len()],
    /// The earliest deadline.
    next: Option<Instant>,
}

impl Agenda {
    /// All tasks are due.
    pub const fn new() -> Self {
        Self {
            due: Tasks::ALL,
            held: Tasks::NONE,
            changed: Tasks::ALL,
            deadlines: [None; Task::TIMED.len()],
            next: None,
        }
    }

    /// Makes these tasks due, except those that are held.
    pub const fn add(&mut self, tasks: Tasks) {
        self.due.0 |= tasks.0 & !self.held.0;
    }

    /// Ends a task until it is added again.
    pub const fn end(&mut self, task: Task) {
        self.due.0 &= !task.bit();
        self.changed.0 |= task.bit();
    }

    /// Holds these tasks until the next call, and makes all others due.
    pub const fn hold(&mut self, tasks: Tasks) {
        self.held = tasks;
        self.due = Tasks(!tasks.0);
        self.changed = Tasks::ALL;
    }

    /// Whether anything is due at `now`.
    pub const fn is_due(&self, now: Instant) -> bool {
        self.due.0 != 0
            || match self.next {
                Some(next) => next.has_come(now),
                None => false,
            }
    }

    /// The earliest deadline.
    pub const fn next_deadline(&self) -> Option<Instant> {
        self.next
    }

    /// Makes the tasks due whose deadline has come.
    pub fn begin(&mut self, now: Instant) {
        if !self.next.is_some_and(|next| next.has_come(now)) {
            return;
        }
        let mut come = Tasks::NONE;
        for (task, deadline) in Task::TIMED.into_iter().zip(&mut self.deadlines) {
            if deadline.take_if(|deadline| deadline.has_come(now)).is_some() {
                come.0 |= task.bit();
            }
        }
        self.add(come);
        self.find_next();
    }

    /// The first task that is due.
    pub fn first(&self) -> Option<Task> {
        Task::EACH.get(self.due.0.trailing_zeros() as usize).copied()
    }

    /// Finds the deadlines that may have changed, by `deadline`.
    pub fn find_deadlines(&mut self, deadline: impl Fn(Task) -> Option<Instant>) {
        for (task, place) in Task::TIMED.into_iter().zip(&mut self.deadlines) {
            if self.changed.has(task) {
                *place = deadline(task);
            }
        }
        self.changed = Tasks::NONE;
        self.find_next();
    }

    fn find_next(&mut self) {
        self.next = self.deadlines.into_iter().flatten().reduce(Instant::earlier);
    }
}
