//! The program's side on the board: hand-over, trial and confirmation, carried out by the task that stores.

use canopen_node::Application;
use cortex_m::peripheral::SCB;
use program_update::{
    Command,
    program::{Confirm, Program, Wanted},
};
use rtic_core::Mutex;

use super::{Update, areas::Areas, objects::Request};
use crate::{can::Peripheral, clock, mailbox, runner::Runner, watchdog};

/// The part of the task that stores: what the objects of program download have asked for.
pub struct Steps {
    areas: Areas,
}

fn now() -> u32 {
    clock::now().as_micros()
}

impl Update {
    /// Begins the program's side, when the clock runs; returns what the task that stores needs.
    pub fn begin(&mut self, confirm: Confirm) -> Steps {
        let mut areas = Areas::new(now);
        self.program = Some(Program::new(&mut areas, mailbox::read(), confirm, now()));
        Steps { areas }
    }
}

impl Steps {
    /// Does what is due. `update` finds the objects in the application.
    pub fn step<C: Peripheral, A: Application>(
        &mut self,
        runner: &mut impl Mutex<T = Runner<C, A>>,
        update: fn(&mut A) -> &mut Update,
    ) {
        let (request, wanted) = runner.lock(|runner| {
            let is_well = watchdog::all_have_answered() && !runner.is_bus_off();
            let is_idle = runner.is_idle();
            runner.application(|application| {
                let update = update(application);
                let Some(program) = &mut update.program else { return (None, None) };
                if update.is_answering && is_idle {
                    update.is_answering = false;
                    program.answered(now());
                }
                (
                    update.request.take_if(|request| !matches!(request, Request::Reset) || is_idle),
                    program.poll(is_well, now()),
                )
            })
        });
        match request {
            Some(Request::Stop) => runner.lock(|runner| {
                mailbox::hand_over(runner.node(), Command::Stop);
                SCB::sys_reset();
            }),
            Some(Request::Reset) => runner.lock(|_| mailbox::reset()),
            Some(Request::Confirm) => {
                let outcome = self.confirm(runner, update);
                runner.lock(|runner| runner.answer(outcome.map_err(super::objects::code)));
            }
            None => {}
        }
        match wanted {
            Some(Wanted::Confirm) => {
                let _ = self.confirm(runner, update);
            }
            Some(Wanted::Reset) => {
                defmt::error!("not confirmed within 60 s, resetting");
                runner.lock(|_| mailbox::reset());
            }
            Some(Wanted::HasRun) => mailbox::note_has_run(),
            None => {}
        }
    }

    /// Confirms the program. Meanwhile the tasks of the bus run.
    fn confirm<C: Peripheral, A: Application>(
        &mut self,
        runner: &mut impl Mutex<T = Runner<C, A>>,
        update: fn(&mut A) -> &mut Update,
    ) -> Result<(), program_update::Abort> {
        let copy = runner
            .lock(|runner| runner.application(|application| update(application).program.clone()));
        let Some(mut program) = copy else { return Ok(()) };
        let outcome = program.confirm(&mut self.areas);
        runner.lock(|runner| {
            runner.application(|application| update(application).program = Some(program));
        });
        outcome
    }
}
