//! The node with frames, time and events in any order: its actions come to an end, and it is silent when it must be.

#![no_main]

use libfuzzer_sys::fuzz_target;
use canopen_node::{
    Action, BitRate, BitRateSetting, BitRates, BusEvent, Device, Frame, Instant, Node, NodeId,
    Settings, emergency::Fault, lss::StoreError,
};
use canopen_node_fuzz::{ADDRESS, act_until_nothing_is_due};

/// A board that tracks the permissions of its node.
struct Board {
    node: Node,
    now: Instant,
    may_transmit: bool,
    is_storing: bool,
    is_reset: bool,
}

impl Board {
    /// `id` 1..=127: the node-ID, else none; `rate` 0..=4, 6..=8: a bit rate, else automatic.
    fn new(id: u8, rate: u8) -> Self {
        let bit_rates = BitRates::possible(40_000_000).with_automatic();
        let device = Device::new(ADDRESS, bit_rates)
            .with_name("Fuzz")
            .with_versions("A", "1.2.3")
            .with_rescue(true)
            .with_lss_lock(id & 1 == 1);
        let bit_rate = BitRate::from_table(0, rate).map_or(BitRateSetting::Automatic, Into::into);
        let settings = Settings::new(bit_rate).with_node_id(NodeId::new(id)).with_heartbeat_ms(5);
        let node = Node::new(device, Some(settings));
        let may_transmit = !node.is_listening();
        let now = Instant::from_micros(u32::MAX - 1_000_000);
        Self { node, now, may_transmit, is_storing: false, is_reset: false }
    }

    fn act(&mut self, action: Action) {
        match action {
            Action::Transmit(frame) => self.check(&frame),
            Action::StopTransmitting | Action::Listen(_) | Action::SetBitRate(_) => {
                self.may_transmit = false;
            }
            Action::ResumeTransmitting => self.may_transmit = true,
            Action::SetReceives | Action::DropPdos => {
                unreachable!("the node has no process data")
            }
            Action::SetNodeId(id) => assert_eq!(id, self.node.node_id()),
            Action::Store(_) => {
                assert!(!self.is_storing, "a store before the previous one has ended");
                self.is_storing = true;
            }
            Action::ResetDevice => self.is_reset = true,
        }
    }

    fn check(&self, frame: &Frame) {
        assert!(self.may_transmit, "{frame:?} while it must be silent");
        let of_node = |function: u16| {
            self.node.node_id().is_some_and(|id| frame.cob_id() == function + u16::from(id.get()))
        };
        assert!(frame.cob_id() == 0x7E4 || [0x080, 0x580, 0x700].into_iter().any(of_node));
    }

    fn act_until_nothing_is_due(&mut self) {
        act_until_nothing_is_due(|| {
            self.node.poll(self.now).map(|action| self.act(action)).is_some()
        });
    }

    fn step(&mut self, [kind, ms, data @ ..]: [u8; 10]) {
        self.now = self.now.plus_micros(u32::from(ms) * 1000);
        self.act_until_nothing_is_due();
        let len = usize::from(kind >> 4).min(8);
        let cob_id = match kind & 0xF {
            0 => 0x000,
            1..=6 => 0x7E5,
            7 | 8 => 0x600 + u16::from(self.node.node_id().map_or(data[7], NodeId::get)),
            9 => u16::from_le_bytes([data[6], data[7]]),
            kind => return self.report(kind, data),
        };
        let action = Frame::new(cob_id, &data[..len])
            .and_then(|frame| self.node.handle_frame(&frame, self.now));
        action.into_iter().for_each(|action| self.act(action));
        self.act_until_nothing_is_due();
    }

    /// Reports an event other than a frame.
    fn report(&mut self, kind: u8, [what, counter, ..]: [u8; 8]) {
        match kind {
            10 if self.is_storing => {
                self.is_storing = false;
                let outcome = if what == 0 { Err(StoreError::MediumAccess) } else { Ok(()) };
                self.node.handle_stored(outcome);
            }
            11 => self.node.handle_bus(BusEvent::Acknowledged, self.now),
            12 => {
                let event = match what % 8 {
                    0 => BusEvent::Received,
                    1 => BusEvent::Error,
                    2 => BusEvent::FormError,
                    3 => BusEvent::HeldDominant,
                    4 => BusEvent::BusOff,
                    5 => BusEvent::BusOffRecovered,
                    6 => BusEvent::Overrun,
                    _ => BusEvent::ErrorCounters { transmit: counter, receive: counter / 2 },
                };
                self.node.handle_bus(event, self.now);
            }
            13 => self.node.handle_fault(Fault::SettingsLost),
            // A long time, up to a minute.
            _ => self.now = self.now.plus_micros(u32::from(what) * 250_000),
        }
        self.act_until_nothing_is_due();
    }
}

fuzz_target!(|data: (u8, u8, Vec<[u8; 10]>)| {
    let (id, rate, steps) = data;
    let mut board = Board::new(id, rate);
    board.act_until_nothing_is_due();
    for step in steps {
        board.step(step);
        if board.is_reset {
            break;
        }
    }
});
