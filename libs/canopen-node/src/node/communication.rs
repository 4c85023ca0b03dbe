//! PDOs and heartbeat consumer.

use core::mem;

use crate::{
    Application, Frame, Instant, NodeId,
    count::Declares,
    emergency::Emergency,
    heartbeat::{self, Consumer, Producers},
    numbers::Numbers,
    object_dictionary::{DefaultValue, Description, Entry, Object},
    pdo::{self, Pdos},
    sdo::Abort,
    sync,
};

/// The services that a master parameterises. They take no code if all numbers are 0.
#[derive(Clone, Debug)]
pub(super) struct Communication<N: Numbers> {
    pub pdos: Pdos<N>,
    pub consumer: Consumer<N>,
    /// The COB-IDs to receive have changed since the board was informed.
    has_new_receives: bool,
}

impl<N: Numbers> Communication<N> {
    /// Whether there is anything to do.
    pub const IS_USED: bool = N::TPDOS + N::RPDOS + N::PRODUCERS > 0;

    /// The services as the application declares them. A wrong declaration does not compile.
    pub const fn new<A: Application>() -> Self
    where
        N: Declares<A>,
    {
        const {
            assert!(
                !Self::IS_USED || !A::OBJECTS.is_empty(),
                "process data and the heartbeat consumer need an application with objects"
            );
        }
        Self {
            pdos: Pdos::new(pdo::Configuration::new(N::DECLARED_TPDOS, N::DECLARED_RPDOS)),
            consumer: Consumer::new(Producers::new(N::DECLARED_PRODUCERS)),
            has_new_receives: false,
        }
    }

    /// The table that has the object with this index.
    pub fn table(index: u16) -> Option<&'static [Entry]> {
        // Most requests are for other objects.
        let may_be = matches!(index, 0x1005..=0x1007 | 0x1016 | 0x1019 | 0x1400..=0x1BFF);
        if !Self::IS_USED || !may_be {
            return None;
        }
        let has_it = |table: &&[Entry]| {
            table.first().is_some_and(|first| first.index <= index)
                && table.last().is_some_and(|last| index <= last.index)
        };
        N::TABLES.into_iter().find(has_it)
    }

    /// The rows in ascending order, with their descriptions. The defaults are those that the application declares.
    pub fn entries<A: Application>() -> impl Iterator<Item = (Entry, Description)>
    where
        N: Declares<A>,
    {
        let new = Self::new::<A>();
        let default = move |entry: &Entry| {
            let value = |node| new.read(entry.object, NodeId::new(node)).unwrap_or_default();
            match (entry.object, value(1), value(2)) {
                (Object::HighestSubIndex(_), ..) => DefaultValue::Varies,
                (_, one, other) if one != other => DefaultValue::NodeIdPlus(one.wrapping_sub(1)),
                (_, same, _) => DefaultValue::Number(same),
            }
        };
        let describe = move |entry: &Entry| match entry.object {
            Object::SyncCobId
            | Object::CommunicationCyclePeriod
            | Object::SynchronousWindowLength
            | Object::SyncCounterOverflow => sync::describe(entry, default(entry)),
            _ if entry.index == heartbeat::INDEX => heartbeat::describe(entry, default(entry)),
            _ => pdo::describe(entry, default(entry)),
        };
        N::TABLES.into_iter().flatten().map(move |entry| (*entry, describe(entry)))
    }

    /// Restarts as after power-on, with the persistent parameters.
    pub fn reset(&mut self) {
        if Self::IS_USED {
            self.pdos.reset();
            self.consumer.reset();
            self.has_new_receives = false;
        }
    }

    /// Makes the parameters in use the persistent ones.
    pub fn keep_current(&mut self) {
        if Self::IS_USED {
            self.pdos.keep_current();
            self.consumer.keep_current();
        }
    }

    /// Makes the parameters persistent that the application declares.
    pub fn forget_stored<A: Application>(&mut self)
    where
        N: Declares<A>,
    {
        if Self::IS_USED {
            self.pdos.persistent = pdo::Configuration::new(N::DECLARED_TPDOS, N::DECLARED_RPDOS);
            self.consumer.persistent = Producers::new(N::DECLARED_PRODUCERS);
        }
    }

    /// Whether the COB-IDs to receive have changed since the last call.
    pub fn take_new_receives(&mut self) -> bool {
        Self::IS_USED && mem::take(&mut self.has_new_receives)
    }

    /// Handles a frame that may be a PDO, SYNC or a heartbeat. Returns whether the next deadline may have changed: a
    /// heartbeat or an RPDO begins its time anew. A SYNC has no time.
    pub fn handle_frame<A: Application>(
        &mut self,
        frame: &Frame,
        application: &mut A,
        errors: &mut Emergency,
        now: Instant,
    ) -> bool {
        let is_sync = self.pdos.handle_frame(frame, application, errors, now);
        if !is_sync {
            self.consumer.handle_frame(frame, now, |event| application.handle(event));
        }
        !is_sync
    }

    /// The time at which a heartbeat or an RPDO is missing.
    pub fn late_at(&self) -> Option<Instant> {
        Instant::earliest(self.consumer.poll_at(), self.pdos.late_at())
    }

    /// Begins the watch of others anew, since nobody has sent anything during a switch of the bit rate.
    pub fn restart(&mut self, now: Instant) {
        self.consumer.restart(now);
        self.pdos.end_event_timers();
    }

    /// Ends the errors that are no longer present.
    pub fn end_errors(&self, errors: &mut Emergency) {
        if Self::IS_USED {
            self.pdos.end_errors(errors);
            self.consumer.end_errors(errors);
        }
    }

    /// The value of an object.
    ///
    /// # Errors
    /// [`Abort::NoObject`] for an object of another service.
    pub fn read(&self, object: Object, node: Option<NodeId>) -> Result<u32, Abort> {
        match object {
            Object::ConsumerHeartbeatTime(sub_index) => self.consumer.read(sub_index),
            _ => self.pdos.read(object, node),
        }
    }

    /// Writes an object; `objects` are those of the application.
    ///
    /// # Errors
    /// The abort code for the client.
    pub fn write(
        &mut self,
        object: Object,
        value: u32,
        node: Option<NodeId>,
        objects: &'static [Entry],
    ) -> Result<(), Abort> {
        match object {
            Object::ConsumerHeartbeatTime(sub_index) => self.consumer.write(sub_index, value)?,
            _ => self.pdos.write(object, value, node, objects)?,
        }
        self.has_new_receives |= matches!(
            object,
            Object::SyncCobId | Object::ConsumerHeartbeatTime(_) | Object::RpdoParameter(_)
        );
        Ok(())
    }
}
