//! Random events and times, checked against the invariants of the bit-rate supervision.

use canopen_node::{
    Action, BitRate, BitRates,
    BusEvent::{self, Acknowledged, BusOff, Error, FormError, HeldDominant, Received},
    Services,
};
use testkit::{
    flash::BoardFlash,
    frames::{self},
    node_rig::{ADDRESS, NodeRig, defaults, device},
    random::Random,
    sdo::Client,
};

/// Sequences of events that a controller reports for a while.
const MOODS: [&[BusEvent]; 9] = [
    &[Error],
    &[FormError],
    &[Error, FormError],
    &[Error, Error, Error, Error, FormError, BusOff],
    &[Error, Error, Error, Error, Error, Error, Received],
    &[Error, Error, Error, Error, Acknowledged],
    &[Received, Received, Acknowledged, FormError],
    &[Received, Acknowledged, Error, FormError, BusOff],
    &[Error, FormError, HeldDominant],
];

/// The greatest interval between two events in microseconds.
const GAPS_US: [u64; 6] = [2, 500, 20_000, 200_000, 900_000, 4_000_000];

/// A node, and the knowledge about it from outside.
struct Run {
    board: NodeRig,
    heartbeat_ms: u16,
    default: BitRate,
    home: BitRate,
    /// Configured by `13` and not activated.
    configured: Option<BitRate>,
    trusted_until: u64,
    /// A frame was received or acknowledged at home.
    is_proven: bool,
    /// The time since which the node listens at other rates than home.
    away_since: Option<u64>,
    is_guest: bool,
    looks: u32,
    rescues: u32,
    switches: u32,
}

impl Run {
    fn new(random: &mut Random) -> Self {
        let bit_rates = BitRates::possible(random.pick(&[40_000_000, 42_000_000]));
        let device = device(ADDRESS).with_bit_rates(bit_rates).with_rescue(true);
        let rates = BitRate::ALL.into_iter().filter(|&rate| bit_rates.contains(rate));
        let home = random.pick(&rates.collect::<Vec<_>>());
        let heartbeat_ms = random.pick(&[0, 10, 250, 1_000]);
        let settings = defaults(0x40).with_bit_rate(home.into());
        let anywhere = random.u32();
        let clock_at_start = random.pick(&[0, u32::MAX, u32::MAX - 20_000_000, anywhere]);
        Self {
            board: NodeRig::with_device(
                device.with_defaults(settings).with_heartbeat_ms(heartbeat_ms),
                BoardFlash::blank(0),
                clock_at_start,
            ),
            heartbeat_ms,
            default: home,
            home,
            configured: None,
            trusted_until: 0,
            is_proven: true,
            away_since: None,
            is_guest: false,
            looks: 0,
            rescues: 0,
            switches: 0,
        }
    }

    /// Checks the node's actions since the last call.
    fn check(&mut self) {
        for (at, action) in self.board.take_timed_actions().collect::<Vec<_>>() {
            match action {
                Action::Listen(_) if self.is_proven => panic!("a proven rate is never left"),
                Action::Listen(rate) if rate != self.home => {
                    assert!(at >= self.trusted_until, "home counts alone");
                    self.away_since.get_or_insert(at);
                    self.looks += 1;
                }
                Action::Listen(_) => self.end_stay(at),
                Action::SetBitRate(rate) => {
                    self.end_stay(at);
                    self.rescues += u32::from(rate != self.home);
                    self.is_guest = rate != self.home;
                }
                Action::Transmit(frame, _) if self.is_guest => {
                    let is_asked = match frame.cob_id() {
                        0x740 => frame.data() == [0],
                        0x0C0 => frame.data().starts_with(&[0x10, 0xFF]),
                        _ => true,
                    };
                    assert!(is_asked, "a guest sends {}", frames::text(&frame));
                }
                _ => {}
            }
        }
        if let Some(since) = self.away_since {
            assert!(self.board.now() - since <= 2_000_000, "home has a turn every 2 s");
        }
        if self.board.now() < self.trusted_until {
            assert_eq!(self.board.bit_rate(), self.home);
        }
    }

    fn skip_actions(&mut self) {
        self.board.take_actions();
        self.away_since = None;
        self.is_guest = self.board.bit_rate() != self.home;
    }

    fn end_stay(&mut self, at: u64) {
        if let Some(since) = self.away_since.take() {
            assert!(at - since <= 2_000_000, "home has a turn every 2 s");
        }
    }

    fn see(&mut self, events: &[BusEvent], gap_us: u64, random: &mut Random) {
        let event = random.pick(events);
        self.board.see(event);
        self.note(event);
        self.board.pass_us(random.within(0..gap_us));
    }

    /// Notes whether the event has proven home.
    fn note(&mut self, event: BusEvent) {
        let takes_part = !self.board.node.is_listening() && self.board.bit_rate() == self.home;
        if takes_part && matches!(event, Received | Acknowledged) {
            self.check();
            self.is_proven = true;
        }
    }

    fn configure(&mut self, rate: BitRate) {
        self.board.lss("04 01");
        let request = format!("13 00 {:02X}", rate.index());
        let answers = self.board.lss(&request).0;
        if answers.first().is_some_and(|answer| answer.data()[..2] == [0x13, 0]) {
            self.configured = Some(rate);
        }
    }

    fn activate(&mut self, random: &mut Random) {
        self.check();
        let delay_ms = random.pick(&[0_u16, 1, 50, 2_000]);
        let in_use = self.board.bit_rate();
        let [low, high] = delay_ms.to_le_bytes();
        self.board.lss(&format!("15 {low:02X} {high:02X}"));
        let is_accepted = self.board.actions().any(|action| action == Action::Drop(Services::ALL));
        if !is_accepted {
            return;
        }
        let end = self.board.now() + 2_000 * u64::from(delay_ms);
        while self.board.now() + 100_000 < end {
            self.see(MOODS[7], 100_000, random);
        }
        self.board.pass_us(end - self.board.now());
        assert!(!self.board.actions().any(|action| matches!(action, Action::Listen(_))));
        let home = self.configured.take().unwrap_or(in_use);
        self.is_proven &= self.home == home;
        self.home = home;
        self.trusted_until = end + 30_000_000;
        self.switches += 1;
        assert_eq!(self.board.bit_rate(), self.home);
        self.skip_actions();
    }

    fn cut_power(&mut self) {
        self.check();
        self.board.power_cycle();
        let stored = self.board.stored().map(|settings| settings.bit_rate);
        assert!(stored.is_none_or(|stored| stored == self.board.bit_rate().into()));
        self.home = self.board.bit_rate();
        if stored.is_none() {
            assert_eq!(self.home, self.default);
        }
        self.configured = None;
        self.is_proven = false;
        self.trusted_until = 0;
        self.skip_actions();
    }

    fn live_on(&mut self, random: &mut Random) {
        let (events, gap_us) = (random.pick(&MOODS), random.pick(&GAPS_US));
        self.board.is_acknowledged = random.one_in(2);
        for _ in 0..random.within(1..60) {
            self.see(events, gap_us, random);
            self.check();
        }
        match random.within(0..16) {
            0..3 => self.cut_power(),
            3..5 => self.configure(random.pick(&BitRate::ALL)),
            5..7 => self.activate(random),
            7 => assert_ne!(self.board.lss("17"), ["17 01"]),
            8 => {
                self.board.nmt(random.pick(&["01 00", "02 00", "80 00", "82 00"]));
            }
            9 => {
                self.board.receive(&frames::stranger());
            }
            10 => {
                let ms = random.within(0..40_000);
                self.board.be_late_ms(ms);
                // After late calls the turn at home is late too.
                self.skip_actions();
            }
            11 => {
                // Also half a turn of the count, and a whole one; frequent heartbeats would make it slow.
                let any = random.within(0..40_000);
                let is_long = self.heartbeat_ms.is_multiple_of(1_000) && random.one_in(2);
                let long = 60_000 * random.pick(&[36, 71, 72]);
                self.board.pass_ms(if is_long { long } else { any });
            }
            _ => {}
        }
        self.check();
    }

    /// A quiet bus, and errors at an unused rate, bring the node home, and it knows its home rate.
    fn come_home(&mut self) {
        self.board.is_acknowledged = true;
        self.board.pass_ms(5_000);
        self.check();
        if self.board.bit_rate() != self.home {
            self.board.see(Error);
            self.board.see(Error);
            self.board.pass_ms(5_000);
            self.check();
        }
        assert_eq!(self.board.bit_rate(), self.home);
        self.board.nmt("82 00");
        let home = u32::from(self.home.kbit_per_s());
        assert_eq!([5, 6].map(|sub_index| self.board.number(0x2000, sub_index)), [home; 2]);
    }
}

#[test]
fn home_has_its_turns_and_once_proven_is_never_left() {
    let mut random = Random::from_environment();
    let [mut looks, mut rescues, mut switches] = [0; 3];
    for _ in 0..100 {
        let mut run = Run::new(&mut random);
        for _ in 0..30 {
            run.live_on(&mut random);
        }
        run.come_home();
        looks += run.looks;
        rescues += run.rescues;
        switches += run.switches;
    }
    println!("{looks} looks, {rescues} rescues, {switches} switches");
    assert!(looks > 1_000 && rescues > 50 && switches > 50);
}
