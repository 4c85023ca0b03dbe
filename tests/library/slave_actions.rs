//! The actions of `lss_slave::Slave`: a loop that polls for them ends, in every state, and the answer to a store comes when it
//! may be sent.

use lss_slave::{
    Action, BitRate, BitRateSetting, BitRates, BusEvent, Frame, Instant, NodeId, Settings, Slave,
    lss::{Address, FastscanStep, Request, Response, StoreError},
};
use testkit::{node_rig::ADDRESS, random::Random};

/// More actions than any input causes.
const ENDLESS: usize = 8;

const EVENTS: [BusEvent; 7] = [
    BusEvent::Received,
    BusEvent::Acknowledged,
    BusEvent::Error,
    BusEvent::FormError,
    BusEvent::HeldDominant,
    BusEvent::BusOff,
    BusEvent::BusOffRecovered,
];

/// Slaves after power-on, with each kind of bit rate and node-ID.
fn slaves() -> impl Iterator<Item = Slave> + Clone {
    let rates = BitRates::possible(40_000_000).with_automatic();
    let settings = [BitRate::Kbit125.into(), BitRateSetting::Automatic].into_iter();
    let settings = settings.flat_map(|rate| {
        [None, NodeId::new(5)].map(|node_id| Settings::new(rate).with_node_id(node_id))
    });
    settings.flat_map(move |settings| {
        let slave = Slave::new(ADDRESS, rates, settings);
        [slave.clone(), slave.with_rescue()]
    })
}

fn requests() -> Vec<Frame> {
    let Address { vendor_id, product_code, revision_number, serial_number } = ADDRESS;
    let parts = [vendor_id, product_code, revision_number, serial_number];
    let select = [0x40, 0x41, 0x42, 0x43].into_iter().zip(parts).map(|(command, number)| {
        let [b1, b2, b3, b4] = number.to_le_bytes();
        Frame::new(0x7E5, &[command, b1, b2, b3, b4, 0, 0, 0]).expect("a frame")
    });
    let others = [
        Request::SwitchToWaiting,
        Request::SwitchToConfiguration,
        Request::ConfigureNodeId(5),
        Request::ConfigureNodeId(255),
        Request::ConfigureBitTiming { table: 0, index: 2 },
        Request::ConfigureBitTiming { table: 0, index: 9 },
        Request::ActivateBitTiming(0),
        Request::ActivateBitTiming(100),
        Request::StoreConfiguration,
        Request::IdentifyNonConfigured,
        Request::Fastscan(FastscanStep { id_number: 0, bit_check: 0x80, sub: 0, next: 0 }),
        Request::InquireNodeId,
    ];
    let of_others = [(0x000, &[0x82, 0][..]), (0x18A, &[1, 2]), (0x70A, &[0])]
        .map(|(cob_id, data)| Frame::new(cob_id, data).expect("a frame"));
    select.chain(others.map(Request::to_frame)).chain(of_others).collect()
}

/// A slave with its time, and the states and actions that were seen.
struct Run {
    slave: Slave,
    now: Instant,
    /// Those that have begun and not ended.
    stores: u32,
    seen: Seen,
}

#[derive(Default)]
struct Seen {
    is_settled: bool,
    is_switching: bool,
    is_listening: bool,
    is_guest: bool,
    has_stored: bool,
    actions: [bool; 4],
}

impl Run {
    /// Carries out all actions that are due; panics if they do not end.
    fn poll(&mut self, input: &str) {
        let mut number = 0;
        while let Some(action) = self.slave.poll(self.now) {
            self.note(action);
            number += 1;
            assert!(number < ENDLESS, "{action:?} without end after {input}: {:?}", self.slave);
        }
        // A timer that is set to it does not fire without end.
        let at = self.slave.poll_at();
        assert!(!at.is_some_and(|at| at.has_come(self.now)), "{at:?} after {input}");
        let bit_rate = self.slave.bit_rate();
        self.seen.is_settled |= bit_rate.is_settled();
        self.seen.is_switching |= bit_rate.is_switching();
        self.seen.is_listening |= bit_rate.is_listening();
        self.seen.is_guest |= bit_rate.is_guest();
    }

    fn note(&mut self, action: Action) {
        match action {
            Action::DropFrames => self.seen.actions[0] = true,
            Action::SetBitRate(_) => self.seen.actions[1] = true,
            Action::Listen(_) => self.seen.actions[2] = true,
            Action::FilterFrames => self.seen.actions[3] = true,
            Action::Transmit(frame) => {
                assert_eq!(frame.data()[0], 0x17, "the others are reactions to a frame");
                assert!(self.slave.may_send(), "{:?}", self.slave);
                self.seen.has_stored = true;
            }
            action => panic!("{action:?} is a reaction to a frame"),
        }
    }

    /// An input of any kind.
    fn step(&mut self, random: &mut Random, requests: &[Frame]) {
        match random.within(0..12) {
            0..3 => {
                let frame = random.pick(requests);
                match self.slave.handle_frame(&frame, self.now) {
                    Some(Action::Store) => self.stores += 1,
                    Some(Action::ResetCommunication) => self.slave.reset_communication(),
                    _ => {}
                }
                self.poll(&format!("{frame:?}"));
            }
            3..6 => {
                let event = random.pick(&EVENTS);
                // A fault lasts for a while.
                for _ in 0..random.within(1..20) {
                    self.slave.handle_bus_event(event, self.now);
                    self.poll(&format!("{event:?}"));
                }
            }
            6 => self.slave.note_asked(),
            7 => self.slave.note_sent(self.now),
            // As a program does that a debugger has halted: now and then for half a turn of the count, or a whole one.
            8 if random.one_in(4) => {
                let minutes = random.pick(&[36, 71, 72]);
                self.now = self.now.plus_micros((minutes * 60_000_000_u64) as u32);
            }
            8 => self.now = self.now.plus_micros(random.within(0..5_000_000) as u32),
            9 if self.stores > 0 => {
                self.stores -= 1;
                self.slave.handle_stored(random.pick(&[Ok(()), Err(StoreError::Full)]));
            }
            _ => self.now = self.slave.poll_at().unwrap_or(self.now),
        }
        self.poll("time or a note");
    }
}

#[test]
fn a_loop_that_polls_a_slave_ends_in_every_state() {
    let requests = requests();
    let mut random = Random::from_environment();
    let mut seen = Seen::default();
    for slave in slaves().cycle().take(8 * 30) {
        let mut run = Run { slave, now: Instant::from_micros(random.u32()), stores: 0, seen };
        run.poll("power-on");
        for _ in 0..300 {
            run.step(&mut random, &requests);
        }
        seen = run.seen;
    }
    let Seen { is_settled, is_switching, is_listening, is_guest, has_stored, actions } = seen;
    assert_eq!([is_settled, is_switching, is_listening, is_guest, has_stored], [true; 5]);
    assert_eq!(actions, [true; 4]);
}

#[test]
fn a_slave_that_answers_the_request_that_proves_its_rate_has_nothing_due() {
    let rates = BitRates::possible(40_000_000);
    let settings = Settings::new(BitRate::Kbit125.into());
    let mut slave = Slave::new(ADDRESS, rates, settings).with_rescue();
    let now = Instant::from_micros(0);
    assert!(slave.handle_frame(&Request::IdentifyNonConfigured.to_frame(), now).is_some());
    while slave.poll(now).is_some() {}
    assert_eq!(slave.poll_at(), None);
}

/// A slave at 500 kbit/s whose home is proven by this session: it is in LSS configuration state, and a store has begun.
fn in_a_store(now: Instant) -> Slave {
    let rates = BitRates::possible(40_000_000);
    let mut slave =
        Slave::new(ADDRESS, rates, Settings::new(BitRate::Kbit500.into())).with_rescue();
    let bit_timing = Request::ConfigureBitTiming { table: 0, index: BitRate::Kbit125.index() };
    for request in [Request::SwitchToConfiguration, bit_timing] {
        let _ = slave.handle_frame(&request.to_frame(), now);
        while slave.poll(now).is_some() {}
    }
    let action = slave.handle_frame(&Request::StoreConfiguration.to_frame(), now);
    assert_eq!(action, Some(Action::Store));
    slave
}

fn stored(outcome: Result<(), StoreError>) -> Action {
    Action::Transmit(Response::StoreConfiguration(outcome).to_frame())
}

#[test]
fn the_answer_to_a_store_that_ends_in_the_silence_of_a_switch_follows_it() {
    for (store_us, delay_ms) in
        (0..=3_000).step_by(250).flat_map(|it| [0, 1, 2, 20].map(|ms| (it, ms)))
    {
        let start = Instant::from_micros(u32::MAX - 1_000);
        let mut slave = in_a_store(start);
        let _ = slave.handle_frame(&Request::ActivateBitTiming(delay_ms).to_frame(), start);
        let end_us = 2_000 * u32::from(delay_ms);
        let mut answered_us = Vec::new();
        for us in (0..=50_000).step_by(250) {
            let now = start.plus_micros(us);
            if us == store_us {
                slave.handle_stored(Ok(()));
            }
            while let Some(action) = slave.poll(now) {
                if action == stored(Ok(())) {
                    answered_us.push(us);
                }
            }
        }
        assert_eq!(answered_us, [store_us.max(end_us)], "store {store_us} us, delay {delay_ms} ms");
    }
}

#[test]
fn each_request_to_store_has_an_answer_with_the_outcome_of_the_last() {
    let now = Instant::from_micros(0);
    let mut slave = in_a_store(now);
    assert_eq!(
        slave.handle_frame(&Request::StoreConfiguration.to_frame(), now),
        Some(Action::Store)
    );
    slave.handle_stored(Ok(()));
    slave.handle_stored(Err(StoreError::MediumAccess));
    let failed = stored(Err(StoreError::MediumAccess));
    assert_eq!([(); 3].map(|()| slave.poll(now)), [Some(failed), Some(failed), None]);
}

#[test]
fn the_answer_to_a_store_is_a_frame_that_somebody_must_acknowledge() {
    let now = Instant::from_micros(0);
    let mut slave = in_a_store(now);
    // The rate after the switch is not proven: a frame that nobody acknowledges pauses there after 100 ms.
    let _ = slave.handle_frame(&Request::ActivateBitTiming(0).to_frame(), now);
    slave.handle_stored(Ok(()));
    let actions: Vec<_> = std::iter::from_fn(|| slave.poll(now)).collect();
    assert_eq!(actions.last(), Some(&stored(Ok(()))));
    let pause = now.plus_micros(100_000);
    assert_eq!(slave.poll_at(), Some(pause));
    assert_eq!(slave.poll(pause), Some(Action::DropFrames));
}
