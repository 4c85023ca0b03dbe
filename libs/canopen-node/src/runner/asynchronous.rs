//! The runner over async drivers, without an executor.

use core::{
    future::{Future, poll_fn},
    pin::pin,
    task::Poll,
};

use embedded_storage::nor_flash::NorFlash;

use super::{Controller, Runner, System};
use crate::{
    Application, Instant, Node,
    indicator::{self, Lit},
    lss::StoreError,
    settings::Log,
};

/// The steps of the indicators between two looks at the controller's state: four looks a second.
const STEPS: u8 = 250 / indicator::STEP_MS as u8;

/// A controller with an async driver.
pub trait AsyncController: Controller {
    /// Waits until a frame was received or sent, or an error was detected. It may return early, and must lose nothing
    /// if it is dropped before.
    fn changed(&mut self) -> impl Future<Output = ()>;
}

/// A system with an async timer.
pub trait AsyncSystem: System {
    /// Waits until `at`; returns at once if that has passed.
    fn wait_until(&mut self, at: Instant) -> impl Future<Output = ()>;
}

impl<C: AsyncController, S: AsyncSystem, A: Application> Runner<C, S, A> {
    /// Runs the node until the indicators' next step, 50 ms at most, and returns the indicators to light. To be called
    /// in a loop, which may also feed a watchdog.
    ///
    /// The future may be dropped at any time: a product can `select` it against its own inputs, and call
    /// [`application`](Self::application) between two calls.
    pub async fn run_step<F: NorFlash, const STORED_LEN: usize>(
        &mut self,
        log: &mut Log<F, STORED_LEN>,
    ) -> Lit {
        const {
            assert!(
                Node::<A>::STORED_LEN <= STORED_LEN,
                "the log has no room for the stored parameters of the application"
            );
        }
        loop {
            self.handle_received();
            self.handle_transmitted();
            self.handle_status();
            if let Some(lit) = self.handle_alarm() {
                self.count_step();
                return lit;
            }
            if !self.store(log) {
                self.wait().await;
            }
        }
    }

    fn count_step(&mut self) {
        self.steps = self.steps.wrapping_add(1) % STEPS;
        if self.steps == 0 {
            self.supervise();
        }
    }

    /// Stores what the node has asked for; returns whether there was something.
    fn store<F: NorFlash, const STORED_LEN: usize>(
        &mut self,
        log: &mut Log<F, STORED_LEN>,
    ) -> bool {
        let mut parameters = [0; STORED_LEN];
        let Some((settings, len)) = self.take_store(log.parameters(), &mut parameters) else {
            return false;
        };
        let parameters = parameters.get(..len).unwrap_or_default();
        let outcome = log.store_with_parameters(settings, parameters);
        self.handle_stored(outcome.map_err(StoreError::from));
        true
    }

    /// Waits for the controller or the next deadline.
    async fn wait(&mut self) {
        let alarm_at = self.alarm_at();
        let mut changed = pin!(self.bus.can.changed());
        let mut alarm = pin!(self.system.wait_until(alarm_at));
        poll_fn(|context| {
            let has_changed = changed.as_mut().poll(context).is_ready();
            if has_changed || alarm.as_mut().poll(context).is_ready() {
                return Poll::Ready(());
            }
            Poll::Pending
        })
        .await;
    }
}
