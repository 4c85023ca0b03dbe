//! A run of a command, which leaves all boards in LSS waiting state.

use std::fs::{self, File};

use can_bus::{
    bus::{Masters, Pace},
    date::date_and_time,
    stop::Stop,
};

use crate::{
    arguments::{Arguments, Command},
    commands,
    failure::{Failure, Result},
    network::board,
    picture::{self, Caption},
    recorder::Record,
    session::{DEFAULT_RATE, Session},
};

impl Session {
    /// Carries out the command, leaves the bus, and draws what happened.
    pub fn run(&mut self, arguments: &Arguments) -> Result {
        let Some(path) = &arguments.svg else { return self.work(arguments) };
        let cannot = |error| Stop::Bench(format!("cannot write {}: {error}", path.display()));
        // Before the work: a file that is there keeps its content.
        File::options().append(true).create(true).open(path).map_err(cannot)?;
        let outcome = self.work(arguments);
        if let Some(Record { entries, time_of_day }) = &self.record {
            let adapter = self.bus.description();
            let caption = Caption {
                title: match arguments.command {
                    Command::SetRate { rate, .. } => format!("lss set-rate {}", rate.kbit_per_s()),
                    _ => format!("lss {}", arguments.name),
                },
                line: format!("{adapter}, from {}", date_and_time(*time_of_day)),
                failure: outcome.as_ref().err().map(ToString::to_string),
            };
            let svg = picture::draw(&entries.borrow(), &caption);
            fs::write(path, svg).map_err(cannot)?;
        }
        outcome
    }

    fn work(&mut self, arguments: &Arguments) -> Result {
        // A running network has an NMT master and SDO clients.
        self.bus.mind(Masters::Lss);
        self.bus.set_pace(Pace::Quick);
        self.remark();
        let outcome = match arguments.command.is_json() {
            true => self.in_json(arguments),
            false => self.dispatch(arguments),
        };
        self.remark();
        self.progress.clear();
        let is_over = match arguments.command {
            // It changes no state.
            Command::Find { .. } => true,
            // The user asks for each state that a raw request leads to.
            Command::Raw { .. } => outcome.is_ok(),
            _ => self.all_wait,
        };
        if !is_over {
            self.end();
        }
        self.bus.leave();
        self.out.flush()?;
        match (self.bus.short_answer, &arguments.command) {
            // It prints each answer.
            (_, Command::Raw { .. }) | (None, _) => outcome,
            (Some(answer), _) => short_answer(outcome, answer.data().len()),
        }
    }

    /// Carries out the command, and prints its result instead of its words.
    fn in_json(&mut self, arguments: &Arguments) -> Result {
        let out = std::mem::replace(&mut self.out, Box::new(std::io::sink()));
        let outcome = self.dispatch(arguments);
        self.out = out;
        if !self.result.is_empty() {
            writeln!(self.out, "{}", self.result)?;
        }
        outcome
    }

    fn dispatch(&mut self, arguments: &Arguments) -> Result {
        let rate = arguments.bit_rate.or(self.bus.fixed_rate()).unwrap_or(DEFAULT_RATE);
        match &arguments.command {
            Command::Find { ask, .. } => return commands::find(self, rate, *ask),
            Command::Apply(files) => return commands::apply(self, arguments.bit_rate, files),
            Command::Adapters | Command::Completion { .. } => return Ok(()),
            _ => self.bus.open(rate)?,
        }
        match &arguments.command {
            // These let boards store, send what the user asks for, or do it themselves.
            Command::Store(_) | Command::Raw { .. } | Command::Assign(_) => {}
            _ => board::end_earlier_run(self)?,
        }
        match &arguments.command {
            Command::Find { .. } | Command::Apply(_) => Ok(()),
            Command::Adapters | Command::Completion { .. } => Ok(()),
            Command::Start(which) => commands::nmt(self, commands::START, which.node),
            Command::Stop(which) => commands::nmt(self, commands::STOP, which.node),
            Command::Reset(which) => commands::nmt(self, commands::RESET, which.node),
            Command::Read(object) => commands::read(self, object),
            Command::Write { object, value } => commands::write(self, object, value),
            Command::List { watch: true, json, .. } => commands::watch(self, *json),
            Command::List { ask, .. } => commands::list(self, *ask),
            Command::Assign(assign) => commands::assign(self, assign),
            Command::Update(update) => commands::update(self, update),
            Command::SetRate { rate, delay } => commands::set_rate(self, *rate, *delay),
            Command::Inquire { target, .. } => commands::inquire(self, *target),
            Command::Blink { which } => commands::blink(self, *which),
            Command::Identify(ranges) => commands::identify(self, ranges),
            Command::SetId { id, target, store, reset, .. } => {
                commands::set_id(self, *id, *target, *store, *reset)
            }
            Command::Store(target) => commands::store(self, *target),
            Command::Raw { bytes } => commands::raw(self, bytes),
        }
    }
}

/// What became of a command while the answers of a device were passed over.
fn short_answer(outcome: Result, len: usize) -> Result {
    let words = format!(
        "a device answers LSS requests with {len} bytes, and not with 8 (CiA 305): it was passed over. Its firmware must be \
         mended, or `lss raw` configures it, alone on the bus"
    );
    Err(match outcome {
        Ok(()) => Failure::Refused(words),
        Err(stop @ Failure::Stop(_)) => stop,
        Err(failure) => Failure::Refused(format!("{failure}\n{words}")),
    })
}
