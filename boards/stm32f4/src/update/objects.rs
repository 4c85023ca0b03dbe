//! The objects of program download in a program: it hands over to its loader, and is confirmed.

use canopen_node::{
    nmt,
    sdo::{self, Answer},
};
use program_update::{
    Abort, Object,
    program::{Control, Program},
};

/// What the objects of program download do in a program: a part of the product's application.
#[derive(Clone, Debug)]
pub struct Update {
    pub(super) program: Option<Program>,
    pub(super) request: Option<Request>,
    /// An SDO answer has been given that nobody may have acknowledged.
    pub(super) is_answering: bool,
}

/// What a client has asked for, for the task that stores.
#[derive(Clone, Copy, Debug)]
pub(super) enum Request {
    Stop,
    Reset,
    Confirm,
}

impl Update {
    /// The state before the board has started.
    pub const fn new() -> Self {
        Self { program: None, request: None, is_answering: false }
    }
}

impl Default for Update {
    fn default() -> Self {
        Self::new()
    }
}

impl canopen_node::Program for Update {
    fn read(&mut self, index: u16, sub_index: u8) -> u32 {
        self.program.as_ref().map_or(0, |program| program.read(object(index, sub_index)))
    }

    fn control(&mut self, value: u8, state: nmt::State) -> Result<Answer, sdo::Abort> {
        let program = self.program.as_ref().ok_or(sdo::Abort::DeviceState)?;
        let is_pre_operational = state == nmt::State::PreOperational;
        let (request, answer) = match program.write_control(value, is_pre_operational) {
            Ok(Control::Answer) => (None, Answer::Now),
            Ok(Control::Reset) => (Some(Request::Reset), Answer::Now),
            Ok(Control::Confirm) => (Some(Request::Confirm), Answer::Later),
            Ok(Control::Stop) => (Some(Request::Stop), Answer::Later),
            Err(abort) => return Err(code(abort)),
        };
        if request.is_some() {
            self.request = request;
            #[cfg(target_os = "none")]
            cortex_m::peripheral::NVIC::pend(crate::watchdog::STORE);
        }
        Ok(answer)
    }

    fn answering(&mut self) {
        self.is_answering = true;
    }
}

/// The object with this address.
pub(super) const fn object(index: u16, sub_index: u8) -> Object {
    match (index, sub_index) {
        (0x1F51, _) => Object::Control,
        (0x1F56, _) => Object::Software,
        (0x1F57, _) => Object::FlashStatus,
        (_, 1) => Object::State,
        _ => Object::Starts,
    }
}

/// The abort code as the SDO server has it.
pub(super) const fn code(abort: Abort) -> sdo::Abort {
    match abort {
        Abort::Memory => sdo::Abort::Memory,
        Abort::Hardware => sdo::Abort::Hardware,
        Abort::InvalidValue => sdo::Abort::InvalidValue,
        Abort::NotStored => sdo::Abort::NotStored,
        Abort::DeviceState => sdo::Abort::DeviceState,
    }
}
