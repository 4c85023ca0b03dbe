//! Random changes, SYNCs, RPDOs and NMT commands, compared with a second model that counts milliseconds.

use testkit::{
    frames::{Frames, SILENCE},
    random::Random,
};

use crate::process_data::{Board, board, change, map, receive, set};

/// A TPDO with buttons and lamps, and an RPDO with lamps and speed, written from CiA 301.
#[derive(Default)]
struct Model {
    now: u64,
    is_operational: bool,
    buttons: u8,
    lamps: u8,
    speed: u16,
    tpdo_type: u64,
    rpdo_type: u64,
    inhibit_ms: u64,
    event_ms: u64,
    /// What the TPDO last carried since the node became operational, and when.
    last: Option<([u8; 2], u64)>,
    /// It is sent at the next opportunity, whatever it last carried.
    is_due: bool,
    syncs: u64,
    waiting: Option<(u8, u16)>,
}

impl Model {
    fn data(&self) -> [u8; 2] {
        [self.buttons, self.lamps]
    }

    fn send(&mut self) -> Option<[u8; 2]> {
        self.last = Some((self.data(), self.now));
        self.is_due = false;
        Some(self.data())
    }

    fn start(&mut self) {
        if !self.is_operational {
            *self = Self {
                is_operational: true,
                last: None,
                is_due: false,
                syncs: 0,
                waiting: None,
                ..*self
            };
        }
    }

    /// The TPDO that is sent without a SYNC.
    fn act(&mut self) -> Option<[u8; 2]> {
        if !self.is_operational || self.tpdo_type < 254 {
            return None;
        }
        let Some((data, at)) = self.last else {
            return self.send();
        };
        let age = self.now - at;
        let is_old = self.event_ms > 0 && age >= self.event_ms;
        let is_sent = age >= self.inhibit_ms && (self.is_due || is_old || data != self.data());
        if is_sent { self.send() } else { None }
    }

    fn sync(&mut self) -> Option<[u8; 2]> {
        if !self.is_operational {
            return None;
        }
        if let Some((lamps, speed)) = self.waiting.take() {
            self.obey(lamps, speed);
        }
        self.syncs += 1;
        let is_sent = match self.tpdo_type {
            0 => self.is_due || self.last.is_none_or(|(data, _)| data != self.data()),
            1..=240 => self.syncs.is_multiple_of(self.tpdo_type),
            _ => return self.act(),
        };
        if is_sent { self.send() } else { None }
    }

    /// The TPDO is made invalid and valid again, or of another type. Its inhibit time goes on.
    fn renew(&mut self) -> Option<[u8; 2]> {
        self.syncs = 0;
        self.is_due = true;
        self.act()
    }

    fn receive(&mut self, lamps: u8, speed: u16) {
        if self.is_operational {
            if self.rpdo_type <= 240 {
                self.waiting = Some((lamps, speed));
            } else {
                self.obey(lamps, speed);
            }
        }
    }

    fn obey(&mut self, lamps: u8, speed: u16) {
        if lamps != 0xEE {
            self.lamps = lamps;
        }
        if speed <= 1000 {
            self.speed = speed;
        }
    }
}

fn new_board(random: &mut Random) -> (Board, Model) {
    let model = Model {
        tpdo_type: random.pick(&[0, 1, 2, 5, 254, 255]),
        rpdo_type: random.pick(&[0, 240, 254, 255]),
        inhibit_ms: random.pick(&[0, 0, 3, 20]),
        event_ms: random.pick(&[0, 0, 2, 15]),
        ..Model::default()
    };
    let mut board = board();
    set(&mut board, 0x1801, 1, 0x8000_02C0, 4);
    set(&mut board, 0x1800, 1, 0x8000_01C0, 4);
    set(&mut board, 0x1800, 2, model.tpdo_type as u32, 1);
    set(&mut board, 0x1800, 3, model.inhibit_ms as u32 * 10, 2);
    set(&mut board, 0x1800, 5, model.event_ms as u32, 2);
    set(&mut board, 0x1400, 2, model.rpdo_type as u32, 1);
    map(&mut board, 0x1800, 0x1C0, &[0x6000_0108, 0x6200_0108]);
    (board, model)
}

fn check(frames: &Frames, expected: Option<[u8; 2]>, step: &str) {
    let data: Vec<_> = frames.0.iter().map(|frame| (frame.cob_id(), frame.data())).collect();
    let expected: Vec<_> = expected.iter().map(|data| (0x1C0, data.as_slice())).collect();
    assert_eq!(data, expected, "{step}");
}

#[test]
fn random_events_have_the_same_effect_on_a_second_model() {
    let mut random = Random::from_environment();
    let mut sent = 0;
    for _ in 0..200 {
        let (mut board, mut model) = new_board(&mut random);
        for _ in 0..200 {
            let (frames, expected, step) = match random.within(0..12) {
                0 => {
                    model.start();
                    (board.nmt("01 40"), model.act(), "start")
                }
                1 if random.one_in(5) => {
                    model.is_operational = false;
                    (board.nmt("80 40"), None, "enter pre-operational")
                }
                2..=3 => {
                    model.buttons = random.byte() % 3;
                    let frames = change(&mut board, |machine| machine.buttons = model.buttons);
                    (frames, model.act(), "change")
                }
                4..=5 => (receive(&mut board, "080:"), model.sync(), "SYNC"),
                6..=7 => {
                    let lamps = random.pick(&[0, 1, 0xEE]);
                    let speed: u16 = random.pick(&[0, 1000, 1001]);
                    let [low, high] = speed.to_le_bytes();
                    model.receive(lamps, speed);
                    let text = format!("240: {lamps:02X} {low:02X} {high:02X}");
                    (receive(&mut board, &text), model.act(), "RPDO")
                }
                8 if random.one_in(4) => {
                    // A clock that wraps every 71.6 minutes must not let the inhibit time begin again.
                    let ms = random.pick(&[1, 60_000 * 36, 60_000 * 71, 60_000 * 72]);
                    set(&mut board, 0x1800, 1, 0x8000_01C0, 4);
                    assert_eq!(board.pass_ms(ms), SILENCE, "{ms} ms");
                    model.now += ms;
                    let frames = board.sdo("23 00 18 01 C0 01 00 00");
                    let pdos = frames.0.into_iter().filter(|frame| frame.cob_id() != 0x5C0);
                    (Frames(pdos.collect()), model.renew(), "valid again")
                }
                _ => {
                    model.now += 1;
                    (board.pass_ms(1), model.act(), "1 ms")
                }
            };
            sent += frames.0.len();
            check(&frames, expected, step);
            let outputs = (board.node.application().lamps, board.node.application().speed);
            assert_eq!(outputs, (model.lamps, model.speed), "{step}");
        }
    }
    assert!(sent > 1_000, "{sent} PDOs");
}
