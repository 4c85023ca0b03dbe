//! The emulated bus for the masters of zencan-client: its virtual time is tokio's paused clock.

use std::{
    convert::Infallible,
    sync::{Arc, Mutex, MutexGuard},
    time::Duration,
};

use emulator::{
    Time,
    board::Board,
    can::{Adapter, Frame, Id},
    network::{AdapterId, Network},
};
use lss_slave::BitRate;
use testkit::{boards::FIRST_START, image_rig::bit_per_s};
use tokio::time::Instant;
use zencan_client::common::{
    CanId, CanMessage,
    traits::{AsyncCanReceiver, AsyncCanSender, CanSendError},
};

/// The master's polling interval for received frames; tokio's clock has no finer steps.
const POLL: Duration = Duration::from_millis(1);

/// The time until a board has booted for the first time.
pub const START: Duration = Duration::from_millis(FIRST_START.as_ms());

/// The boards, and the master's adapter. Clones share both.
#[derive(Clone)]
pub struct TokioBus(Arc<Mutex<Inner>>);

struct Inner {
    network: Network,
    adapter: AdapterId,
    begin: Instant,
}

impl TokioBus {
    /// A bus with boards that are switched on now, and an adapter at `bit_rate`. A board that misuses its chip panics.
    pub fn new(boards: impl IntoIterator<Item = Board>, bit_rate: BitRate) -> Self {
        let mut network = Network::new();
        network.forbid_misuse();
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

/// Runs a session while tokio's clock stands still, except when all wait.
///
/// # Panics
/// There is no runtime.
pub fn run<T>(session: impl Future<Output = T>) -> T {
    let mut builder = tokio::runtime::Builder::new_current_thread();
    let runtime = builder.enable_time().start_paused(true).build();
    runtime.expect("a runtime").block_on(session)
}

/// Converts a duration of tokio's clock to the emulation's.
fn span(duration: Duration) -> Time {
    Time::from_ns(duration.as_nanos() as u64)
}
