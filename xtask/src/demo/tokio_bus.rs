//! Boards and an adapter on one bus, whose virtual time is tokio's paused clock.

use std::{
    convert::Infallible,
    sync::{Arc, Mutex, MutexGuard},
    time::Duration,
};

use emulator::{
    Time,
    board::Board,
    can::{Adapter, Frame, Id},
    chip::Finding,
    network::{AdapterId, Event, Network},
};
use lss_slave::BitRate;
use testkit::image_rig::bit_per_s;
use tokio::time::Instant;
use zencan_client::common::{
    CanId, CanMessage,
    traits::{AsyncCanReceiver, AsyncCanSender, CanSendError},
};

use super::span;

/// The master's polling interval for received frames; tokio's clock has no finer steps.
const POLL: Duration = Duration::from_millis(1);

/// The boards, and the master's adapter. Clones share both.
#[derive(Clone)]
pub struct TokioBus(Arc<Mutex<Inner>>);

struct Inner {
    network: Network,
    adapter: AdapterId,
    begin: Instant,
}

impl TokioBus {
    /// A bus with boards that are switched on now, and an adapter at `bit_rate`.
    pub fn new(boards: impl IntoIterator<Item = Board>, bit_rate: BitRate) -> Self {
        let mut network = Network::new();
        for board in boards {
            network.add_board(board);
        }
        let adapter = network.add_adapter(Adapter::new(bit_per_s(bit_rate)));
        Self(Arc::new(Mutex::new(Inner { network, adapter, begin: Instant::now() })))
    }

    /// The network, advanced to tokio's current time.
    fn now_inner(&self) -> MutexGuard<'_, Inner> {
        let mut inner = self.0.lock().expect("no panic while the bus was in use");
        let now = span(inner.begin.elapsed());
        inner.network.run_until(now);
        inner
    }

    /// Virtual time.
    pub fn now(&self) -> Time {
        self.now_inner().network.now()
    }

    /// All events so far.
    pub fn events(&self) -> Vec<Event> {
        self.now_inner().network.trace().to_vec()
    }

    /// The findings about the boards' firmware.
    pub fn findings(&self) -> Vec<Finding> {
        self.now_inner().network.boards().iter().flat_map(Board::findings).collect()
    }

    /// Lets time pass.
    pub async fn pass(&self, duration: Duration) {
        tokio::time::sleep(duration).await;
    }

    /// Sends a frame, and returns when it is on the bus.
    pub async fn send(&self, frame: Frame) {
        self.now_inner().send(frame);
        while self.now_inner().unsent() > 0 {
            self.pass(POLL).await;
        }
    }

    /// The adapter's next received frame; `None` after `timeout`.
    pub async fn receive(&self, timeout: Duration) -> Option<Frame> {
        let next = async {
            loop {
                if let Some(frame) = self.now_inner().receive() {
                    return frame;
                }
                self.pass(POLL).await;
            }
        };
        tokio::time::timeout(timeout, next).await.ok()
    }

    /// Changes the adapter's bit rate.
    pub fn set_bit_rate(&self, bit_rate: BitRate) {
        let mut inner = self.now_inner();
        let adapter = inner.adapter;
        inner.network.adapter_mut(adapter).set_bit_rate(bit_per_s(bit_rate));
    }

    /// Switches the supply of board 0 off.
    pub fn power_off(&self) {
        self.now_inner().network.power_off(0);
    }

    /// Switches the supply of board 0 on.
    pub fn power_on(&self) {
        self.now_inner().network.power_on(0);
    }
}

impl Inner {
    fn send(&mut self, frame: Frame) {
        self.network.send(self.adapter, frame);
    }

    fn unsent(&mut self) -> usize {
        self.network.adapter_mut(self.adapter).unsent()
    }

    fn receive(&mut self) -> Option<Frame> {
        self.network.receive(self.adapter).map(|(_, frame)| frame)
    }
}

impl AsyncCanSender for TokioBus {
    type Error = NotSent;

    async fn send(&mut self, message: CanMessage) -> Result<(), NotSent> {
        self.now_inner().send(to_frame(&message));
        Ok(())
    }
}

impl AsyncCanReceiver for TokioBus {
    type Error = Infallible;

    fn try_recv(&mut self) -> Option<CanMessage> {
        self.now_inner().receive().map(|frame| to_message(&frame))
    }

    async fn recv(&mut self) -> Result<CanMessage, Infallible> {
        loop {
            if let Some(message) = self.try_recv() {
                return Ok(message);
            }
            tokio::time::sleep(POLL).await;
        }
    }
}

/// An error that never happens: the adapter's queue has no limit.
#[derive(Debug)]
pub enum NotSent {}

impl CanSendError for NotSent {
    fn into_can_message(self) -> CanMessage {
        match self {}
    }

    fn message(&self) -> String {
        match *self {}
    }
}

fn to_frame(message: &CanMessage) -> Frame {
    let id = match message.id() {
        CanId::Std(id) => Id::Standard(id),
        CanId::Extended(id) => Id::Extended(id),
    };
    if message.is_rtr() { Frame::remote(id, message.dlc) } else { Frame::data(id, message.data()) }
}

fn to_message(frame: &Frame) -> CanMessage {
    let id = match frame.id {
        Id::Standard(id) => CanId::std(id),
        Id::Extended(id) => CanId::extended(id),
    };
    if frame.remote { CanMessage::new_rtr(id) } else { CanMessage::new(id, frame.payload()) }
}
