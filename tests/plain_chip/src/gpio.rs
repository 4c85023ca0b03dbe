//! Pins whose types have modes, as in the HAL, but whose registers nobody writes.

use std::marker::PhantomData;

pub struct Input;
pub struct Output;
pub struct Pin<const PORT: char, const NUMBER: u8, MODE = Input>(PhantomData<MODE>);

pub enum PinState {
    High,
}
pub enum Speed {
    High,
}
pub enum Pull {
    Up,
}

pub trait PinMode {}
impl PinMode for Input {}
impl PinMode for Output {}

pub trait PinSpeed: Sized {
    fn set_speed(self, _: Speed) -> Self {
        self
    }
}

pub trait PinPull: Sized {
    fn internal_resistor(self, _: Pull) -> Self {
        self
    }
}

impl<const PORT: char, const NUMBER: u8> Pin<PORT, NUMBER> {
    pub const fn new() -> Self {
        Self(PhantomData)
    }
}

impl<const PORT: char, const NUMBER: u8> Default for Pin<PORT, NUMBER> {
    fn default() -> Self {
        Self::new()
    }
}

impl<const PORT: char, const NUMBER: u8, MODE> Pin<PORT, NUMBER, MODE> {
    pub fn into_push_pull_output_in_state(self, _: PinState) -> Pin<PORT, NUMBER, Output> {
        Pin(PhantomData)
    }

    pub fn into_input(self) -> Pin<PORT, NUMBER> {
        Pin(PhantomData)
    }
}
