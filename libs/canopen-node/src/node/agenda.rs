//! The work of the node: the tasks that are due, and the deadlines of the others.

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
    /// Heartbeats and RPDOs that are missing, and errors of process data that are over.
    Producers,
    Sdo,
    Store,
    /// Boot-up, emergency messages and heartbeat.
    Messages,
    Pdos,
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

    const fn bit(self) -> u8 {
        1 << self as u8
    }
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

    pub const fn has(self, task: Task) -> bool {
        self.0 & task.bit() != 0
    }

    pub const fn add(&mut self, others: Self) {
        self.0 |= others.0;
    }

    const fn remove(&mut self, others: Self) {
        self.0 &= !others.0;
    }

    fn first(self) -> Option<Task> {
        Task::EACH.get(self.0.trailing_zeros() as usize).copied()
    }
}

impl Iterator for Tasks {
    type Item = Task;

    fn next(&mut self) -> Option<Task> {
        let first = self.first()?;
        self.0 &= !first.bit();
        Some(first)
    }
}

/// The tasks that are due, and the deadlines of the others.
#[derive(Clone, Debug)]
pub(super) struct Agenda {
    due: Tasks,
    /// The tasks that must not be done now.
    held: Tasks,
    /// The tasks that have a deadline.
    timed: Tasks,
    /// The deadlines of those tasks, by task.
    deadlines: [Instant; Task::EACH.len()],
    /// The earliest deadline.
    next: Option<Instant>,
}

impl Agenda {
    /// All tasks are due.
    pub const fn new() -> Self {
        Self {
            due: Tasks::ALL,
            held: Tasks::NONE,
            timed: Tasks::NONE,
            deadlines: [Instant::from_micros(0); Task::EACH.len()],
            next: None,
        }
    }

    /// Makes these tasks due, except those that are held.
    pub const fn add(&mut self, tasks: Tasks) {
        self.due.0 |= tasks.0 & !self.held.0;
    }

    /// Ends a task until it is added again, or its deadline comes.
    pub fn end(&mut self, task: Task, deadline: Option<Instant>) {
        let only = Tasks::of(&[task]);
        self.due.remove(only);
        self.timed.remove(only);
        if let Some(deadline) = deadline
            && !self.held.has(task)
        {
            self.timed.add(only);
            self.deadlines[task as usize] = deadline;
        }
    }

    /// Holds these tasks until the next call, and makes all others due. Returns those that were held so far.
    pub const fn hold(&mut self, tasks: Tasks) -> Tasks {
        let released = Tasks(self.held.0 & !tasks.0);
        self.held = tasks;
        self.due = Tasks(!tasks.0);
        self.timed.remove(tasks);
        released
    }

    /// Whether any task must not be done now.
    pub fn is_holding(&self) -> bool {
        self.held != Tasks::NONE
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
        if self.next.is_some_and(|next| next.has_come(now)) {
            for task in self.timed {
                if self.deadlines[task as usize].has_come(now) {
                    self.timed.remove(Tasks::of(&[task]));
                    self.add(Tasks::of(&[task]));
                }
            }
            self.find_next();
        }
    }

    /// The first task that is due.
    pub fn first(&self) -> Option<Task> {
        self.due.first()
    }

    /// Finds the earliest deadline.
    pub fn find_next(&mut self) {
        let deadlines = self.timed.map(|task| self.deadlines[task as usize]);
        self.next = deadlines.reduce(Instant::earlier);
    }
}
