//! The network: the bus with all that is heard there, and button, LED and watchdog, which are served during each wait.

use canopen_node::{
    BitRate, Count, Frame, Instant, NodeId, Receives, Service,
    lss::{REQUEST_COB_ID, RESPONSE_COB_ID},
    runner::{Controller as _, Mode, Received},
};
use canopen_stm32f4::{Alarm, Led, Watchdog, can::Controller, now};
use lss_master::Bus;
use stm32f4xx_hal::{
    gpio::{Input, PA0},
    pac::{CAN1, Interrupt},
};

pub const BIT_RATE: BitRate = BitRate::Kbit125;
/// The time between two looks at the button, in microseconds as all times.
const LOOK: u32 = 10_000;
/// How long a frame may have to wait for the bus.
const PATIENCE: u32 = 50_000;

/// Another LSS master is at work, which ends all that is under way.
pub struct Rival;

pub struct Network {
    pub can: Controller<CAN1>,
    pub alarm: Alarm,
    pub watchdog: Watchdog,
    pub button: PA0<Input>,
    pub led: Led,
    pub seen: Seen,
}

/// What was seen and heard.
#[derive(Default)]
pub struct Seen {
    /// The microseconds of the last look at the button, and what the last looks saw, the newest in bit 0.
    look: u32,
    looks: u8,
    /// The button was pressed: up once, then down three times.
    pub press: bool,
    /// What the LED shows: a bit for each of 16 steps of 50 ms.
    pub pattern: u16,
    /// Another master has sent a request.
    pub rival: bool,
    /// A node has booted up.
    pub boot_up: bool,
    /// The nodes that were heard, a bit for each node-ID.
    pub nodes: u128,
    /// LSS answers, less the questions that one board answers once.
    pub surplus: i32,
}

impl Network {
    pub fn start(&mut self) {
        let all =
            Receives::<Count<0, 0, 0>> { all: true, services: [0; 4], rpdos: [], heartbeats: [] };
        // The watchdog knows how to start a controller that does not.
        while !self.can.start(Mode::TakePart, BIT_RATE, &all) {}
    }

    /// Waits for so many microseconds.
    pub fn pause(&mut self, micros: u32) -> Result<(), Rival> {
        let until = now().plus_micros(micros);
        while !until.has_come(now()) {
            self.wait(until)?;
        }
        Ok(())
    }

    /// Waits until this instant at most; returns an LSS answer.
    fn wait(&mut self, until: Instant) -> Result<Option<Frame>, Rival> {
        self.watchdog.feed();
        let seen = &mut self.seen;
        let look_at = Instant::from_micros(seen.look).plus_micros(LOOK);
        if look_at.has_come(now()) {
            seen.look = now().as_micros();
            seen.looks = seen.looks << 1 | u8::from(self.button.is_high());
            seen.press |= seen.looks & 0b1111 == 0b0111;
            self.led.light(seen.pattern >> (seen.look / 50_000 % 16) & 1 == 1);
        }
        if seen.rival {
            return Err(Rival);
        }
        let received = self.can.receive();
        if received.is_none() {
            self.alarm.sleep_until(until.earlier(look_at), Interrupt::CAN1_RX0);
        }
        let Some(Received::Frame(frame)) = received else { return Ok(None) };
        match frame.cob_id() {
            RESPONSE_COB_ID => {
                seen.surplus += 1;
                return Ok(Some(frame));
            }
            REQUEST_COB_ID => seen.rival = true,
            // An emergency, a TPDO 1, an answer by SDO, a heartbeat or a boot-up.
            cob_id @ (0x081..=0x0FF | 0x181..=0x1FF | 0x581..=0x5FF | 0x701..=0x77F) => {
                seen.nodes |= 1 << (cob_id & 0x7F);
                seen.boot_up |= cob_id > 0x700 && frame.data() == [0];
            }
            _ => {}
        }
        Ok(None)
    }

    /// Whether a node has this node-ID: it was heard, or answers by SDO.
    pub fn is_taken(&mut self, node: NodeId) -> Result<bool, Rival> {
        let upload_device_type = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
        self.send(&Frame::with_eight_bytes(0x600 + u16::from(node.get()), upload_device_type))?;
        self.pause(50_000)?;
        Ok(self.seen.nodes >> node.get() & 1 == 1)
    }
}

impl Bus for Network {
    type Error = Rival;

    fn now(&self) -> Instant {
        now()
    }

    /// Sends a frame. It is lost if nobody acknowledges the one before.
    fn send(&mut self, frame: &Frame) -> Result<(), Rival> {
        // The last frame of a selection, inquiries, configure node-ID.
        let is_question = matches!(frame.data(), [0x43 | 0x5D | 0x5E | 0x11, ..]);
        self.seen.surplus -= i32::from(is_question);
        let until = now().plus_micros(PATIENCE);
        while !self.can.send(frame, Service::Lss) && !until.has_come(now()) {
            self.pause(200)?;
        }
        Ok(())
    }

    fn receive(
        &mut self,
        until: Instant,
        mut take: impl FnMut(&Frame, Instant),
    ) -> Result<(), Rival> {
        if let Some(answer) = self.wait(until)? {
            take(&answer, now());
        }
        Ok(())
    }

    fn set_bit_rate(&mut self, _: BitRate) -> Result<(), Rival> {
        Ok(())
    }
}
