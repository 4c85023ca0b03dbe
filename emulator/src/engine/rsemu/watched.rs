//! Reports to a watcher.

use rsemu::cpu::arm::v7m::sys::Exception;

use super::{
    super::{Engine, Step, Watcher},
    Rsemu,
};

impl Rsemu {
    /// The state before a step, if there is a watcher.
    pub(super) fn observe(&self) -> Option<Step> {
        self.watcher.as_ref()?;
        let (systick, systick_pending) = self.cpu.with_sys(|sys| {
            let registers = [sys.syst_csr, sys.syst_rvr, sys.syst_cvr, sys.syst_calib];
            (registers, sys.is_pending(Exception::SYSTICK))
        });
        Some(Step {
            from_reset: self.cpu.reset_pending(),
            before: self.registers(),
            irqs: self.irqs,
            systick,
            systick_pending,
            requests_reset: false,
            transfers: Vec::new(),
        })
    }

    /// Reports a step that has been made. Sleep is not a step.
    pub(super) fn notify_step(&mut self, mut step: Step) {
        if self.cpu.is_asleep() && step.before == self.registers() {
            return;
        }
        step.requests_reset = self.cpu.reset_requested();
        step.transfers = self.link.take_transfers();
        self.notify(|watcher, core| watcher.stepped(&step, core));
    }

    pub(super) fn notify(&mut self, what: impl FnOnce(&mut dyn Watcher, &dyn Engine)) {
        if let Some(mut watcher) = self.watcher.take() {
            what(watcher.as_mut(), self);
            self.watcher = Some(watcher);
        }
    }
}
