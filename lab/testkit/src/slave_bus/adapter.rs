//! The tool's CAN adapter on the bus within the process.

use std::{
    cell::{RefCell, RefMut},
    rc::Rc,
    time::{Duration, Instant},
};

use can_bus::{
    adapter::{Adapter, Mode, Received, Status},
    stop::Stop,
};
use canopen_node::{Application, BitRate, Frame, application::NoApplication};

use super::{SlaveBus, Source};

/// The adapter, and a handle to its bus.
pub struct BusAdapter<A: Application = NoApplication> {
    bus: Rc<RefCell<SlaveBus<A>>>,
    start: Instant,
}

impl<A: Application> Clone for BusAdapter<A> {
    fn clone(&self) -> Self {
        Self { bus: Rc::clone(&self.bus), start: self.start }
    }
}

impl<A: Application + Clone> BusAdapter<A> {
    pub fn new(bus: SlaveBus<A>) -> Self {
        Self { bus: Rc::new(RefCell::new(bus)), start: Instant::now() }
    }

    pub fn bus(&self) -> RefMut<'_, SlaveBus<A>> {
        self.bus.borrow_mut()
    }

    fn instant(&self, us: u64) -> Instant {
        self.start + Duration::from_micros(us)
    }
}

impl<A: Application + Clone> Adapter for BusAdapter<A> {
    fn open(&mut self, rate: BitRate, mode: Mode) -> Result<(), Stop> {
        self.bus().open(rate, mode == Mode::Normal);
        Ok(())
    }

    fn close(&mut self) -> Result<(), Stop> {
        let mut bus = self.bus();
        // What was sent before leaves first.
        while bus.waiting.values().any(|(source, _)| *source == Source::Tool) {
            let until = bus.now + 1_000;
            bus.run(until);
        }
        (bus.is_open, bus.may_send) = (false, false);
        Ok(())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        self.bus().send(*frame);
        Ok(())
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Received>, Stop> {
        let received = {
            let mut bus = self.bus();
            let until = bus.now + wait.as_micros() as u64;
            bus.run(until)
        };
        let received = received.map(|(at, frame)| Received {
            frame,
            at: Duration::from_micros(at),
            here: self.instant(self.bus().now),
        });
        Ok(received)
    }

    fn status(&mut self) -> Result<Option<Status>, Stop> {
        let has_errors = std::mem::take(&mut self.bus().is_unacknowledged);
        Ok(Some(Status { is_error_passive: false, has_errors }))
    }

    fn now(&self) -> Instant {
        self.instant(self.bus.borrow().now)
    }

    fn latency(&self) -> Option<Duration> {
        Some(Duration::ZERO)
    }

    fn description(&self) -> String {
        "slaves in the process".into()
    }
}
