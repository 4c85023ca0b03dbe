//! The emulated bus for the masters of zencan-client: its virtual time is tokio's paused clock.

use std::{
    convert::Infallible,
    sync::{Arc, Mutex, MutexGuard},
    time::Duration,
};

use emulator::{
    Time,
    board::Board,
    can::{Frame, Id},
};
use lss_slave::BitRate;
use testkit::image_rig::ImageRig;
use tokio::time::Instant;
use zencan_client::common::{
    CanId, CanMessage,
    traits::{AsyncCanReceiver, AsyncCanSender, CanSendError},
};

/// The master's polling interval for received frames; tokio's clock has no finer steps.
const POLL: Duration = Duration::from_millis(1);

/// The boards, and the adapter of the master. Clones share both.
#[derive(Clone)]
pub struct TokioBus {
    rig: Arc<Mutex<ImageRig>>,
    /// One time by the clock of tokio and by that of the emulation.
    begin: (Instant, Time),
}

impl TokioBus {
    /// A bus with boards that have booted, and an adapter at `bit_rate`. A board that misuses its chip panics.
    pub fn new(boards: impl IntoIterator<Item = Board>, bit_rate: BitRate) -> Self {
        let rig = ImageRig::new(bit_rate, boards);
        let begin = (Instant::now(), rig.network.now());
        Self { rig: Arc::new(Mutex::new(rig)), begin }
    }

    /// The rig, advanced to tokio's current time.
    ///
    /// # Panics
    /// Another user of the bus has panicked.
    pub fn rig(&self) -> MutexGuard<'_, ImageRig> {
        let mut rig = self.rig.lock().expect("no panic while the bus was in use");
        let (instant, time) = self.begin;
        rig.network.run_until(time + Time::from_ns(instant.elapsed().as_nanos() as u64));
        rig
    }

    /// Lets time pass.
    pub async fn pass(&self, duration: Duration) {
        tokio::time::sleep(duration).await;
    }

    fn queue(&self, frame: Frame) {
        let mut rig = self.rig();
        let adapter = rig.master;
        rig.network.send(adapter, frame);
    }

    fn received(&self) -> Option<Frame> {
        let mut rig = self.rig();
        let adapter = rig.master;
        rig.network.receive(adapter).map(|(_, frame)| frame)
    }

    /// Sends a frame, and returns when it is on the bus.
    pub async fn send(&self, frame: Frame) {
        self.queue(frame);
        loop {
            self.pass(POLL).await;
            let mut rig = self.rig();
            let adapter = rig.master;
            if rig.network.adapter_mut(adapter).unsent() == 0 {
                return;
            }
        }
    }

    /// The adapter's next received frame; `None` after `timeout`.
    pub async fn receive(&self, timeout: Duration) -> Option<Frame> {
        tokio::time::timeout(timeout, self.next()).await.ok()
    }

    async fn next(&self) -> Frame {
        loop {
            if let Some(frame) = self.received() {
                return frame;
            }
            self.pass(POLL).await;
        }
    }
}

impl AsyncCanSender for TokioBus {
    type Error = NotSent;

    async fn send(&mut self, message: CanMessage) -> Result<(), NotSent> {
        self.queue(to_frame(&message));
        Ok(())
    }
}

impl AsyncCanReceiver for TokioBus {
    type Error = Infallible;

    fn try_recv(&mut self) -> Option<CanMessage> {
        self.received().map(|frame| to_message(&frame))
    }

    async fn recv(&mut self) -> Result<CanMessage, Infallible> {
        Ok(to_message(&self.next().await))
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
