//! The runner in a loop: one call does what is due, and says when to call again.

use embedded_storage::nor_flash::NorFlash;

use super::{Controller, Runner, System};
use crate::{Application, Instant, Node, indicator::Lit, lss::StoreError, settings::Log};

/// When to call [`Runner::poll`] again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub struct Wake {
    /// The latest time of the next call, within 50 ms; it may have come. The call is due earlier if the controller has
    /// received or sent a frame, or detected an error.
    pub at: Instant,
    /// The indicators to light, at the start of each of their steps.
    pub lit: Option<Lit>,
}

impl<C: Controller, S: System, A: Application> Runner<C, S, A> {
    /// Handles what the controller has received, sent and detected, does what is due and stores what the node has asked
    /// for. It waits for nothing but the flash.
    ///
    /// A loop that calls it may wait in between, by an async driver or not at all, and for inputs of the product too.
    pub fn poll<F: NorFlash, const STORED_LEN: usize>(
        &mut self,
        log: &mut Log<F, STORED_LEN>,
    ) -> Wake {
        const {
            assert!(
                Node::<A>::STORED_LEN <= STORED_LEN,
                "the log has no room for the stored parameters of the application"
            );
        }
        self.handle_received();
        self.handle_transmitted();
        self.handle_status();
        let lit = self.handle_alarm();
        self.store(log);
        Wake { at: self.alarm_at(), lit }
    }

    /// Stores what the node has asked for.
    fn store<F: NorFlash, const STORED_LEN: usize>(&mut self, log: &mut Log<F, STORED_LEN>) {
        let mut parameters = [0; STORED_LEN];
        if let Some((settings, len)) = self.take_store(log.parameters(), &mut parameters) {
            let parameters = parameters.get(..len).unwrap_or_default();
            let outcome = log.store_with_parameters(settings, parameters);
            self.handle_stored(outcome.map(|()| parameters).map_err(StoreError::from));
        }
    }
}
