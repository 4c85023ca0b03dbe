//! The LSS slave compared after each frame with a second model of CiA 305: a table of services over plain numbers.

use std::collections::HashSet;

use canopen_node::{
    BitRateSetting, BitRates, NodeId,
    lss::{Address, Reaction, State, StateMachine},
};
use testkit::{frames::bytes, random::Random};

/// FF: not configured.
const NONE: u8 = 0xFF;
/// An APB1 clock from which 800 kbit/s, index 1, cannot be made.
const CLOCK_HZ: u32 = 42_000_000;
const RATES: [u8; 8] = [0, 2, 3, 4, 6, 7, 8, 9];

/// The effect of a request.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Effect {
    Nothing,
    Answer([u8; 8]),
    Activate(u16),
    Store,
    ResetCommunication,
}

/// The slave as the tables of the standard describe it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
struct Model {
    address: [u32; 4],
    is_configuration: bool,
    /// The number of right steps of a select (40..43).
    select: usize,
    /// The number of right steps of an identify (46..4B).
    identify: usize,
    position: u8,
    pending_id: u8,
    active_id: u8,
    pending_rate: u8,
}

type Service = fn(&mut Model, &[u8; 8]) -> Effect;

/// Command specifiers from..=to, whether they are served in waiting and in configuration state, and the service.
const SERVICES: [(u8, u8, bool, bool, Service); 11] = [
    (0x04, 0x04, true, true, Model::switch_global),
    (0x11, 0x11, false, true, Model::configure_node_id),
    (0x13, 0x13, false, true, Model::configure_bit_timing),
    (0x15, 0x15, false, true, |_, frame| {
        Effect::Activate(u16::from_le_bytes([frame[1], frame[2]]))
    }),
    (0x17, 0x17, false, true, |_, _| Effect::Store),
    (0x40, 0x43, true, false, Model::select),
    (0x46, 0x4B, true, true, Model::identify),
    (0x4C, 0x4C, true, true, Model::identify_non_configured),
    (0x51, 0x51, true, false, Model::fastscan),
    (0x5A, 0x5D, false, true, |model, frame| {
        answer_number(frame[0], model.address[usize::from(frame[0] - 0x5A)])
    }),
    (0x5E, 0x5E, false, true, |model, _| answer(0x5E, model.active_id)),
];

/// The part of the address and the comparison of each step of an identify: 0 equal, -1 at most, 1 at least.
const IDENTIFY: [(usize, i8); 6] = [(0, 0), (1, 0), (2, -1), (2, 1), (3, -1), (3, 1)];

fn answer(command: u8, byte: u8) -> Effect {
    answer_number(command, byte.into())
}

fn answer_number(command: u8, number: u32) -> Effect {
    let [a, b, c, d] = number.to_le_bytes();
    Effect::Answer([command, a, b, c, d, 0, 0, 0])
}

fn number(frame: &[u8; 8]) -> u32 {
    u32::from_le_bytes([frame[1], frame[2], frame[3], frame[4]])
}

impl Model {
    fn new(address: [u32; 4], node_id: u8, rate: u8) -> Self {
        Self {
            address,
            pending_id: node_id,
            active_id: node_id,
            pending_rate: rate,
            ..Self::default()
        }
    }

    fn handle(&mut self, frame: &[u8; 8]) -> Effect {
        let served = SERVICES.iter().find(|(from, to, waiting, configuration, _)| {
            (*from..=*to).contains(&frame[0])
                && if self.is_configuration { *configuration } else { *waiting }
        });
        served.map_or(Effect::Nothing, |(.., service)| service(self, frame))
    }

    fn enter(&mut self, is_configuration: bool) {
        *self = Self { is_configuration, select: 0, identify: 0, position: 0, ..self.clone() };
    }

    fn reset_communication(&mut self) {
        self.active_id = self.pending_id;
        self.enter(false);
    }

    fn switch_global(&mut self, frame: &[u8; 8]) -> Effect {
        let gets_its_id = frame[1] == 0
            && self.is_configuration
            && self.active_id == NONE
            && self.pending_id != NONE;
        if frame[1] <= 1 {
            self.enter(frame[1] == 1);
        }
        if gets_its_id { Effect::ResetCommunication } else { Effect::Nothing }
    }

    fn configure_node_id(&mut self, frame: &[u8; 8]) -> Effect {
        if !matches!(frame[1], 0x01..=0x7F | NONE) {
            return answer(0x11, 1);
        }
        self.pending_id = frame[1];
        answer(0x11, 0)
    }

    fn configure_bit_timing(&mut self, frame: &[u8; 8]) -> Effect {
        if frame[1] != 0 || !RATES.contains(&frame[2]) {
            return answer(0x13, 1);
        }
        self.pending_rate = frame[2];
        answer(0x13, 0)
    }

    fn select(&mut self, frame: &[u8; 8]) -> Effect {
        let step = usize::from(frame[0] - 0x40);
        let is_right = number(frame) == self.address[step] && (step == 0 || step == self.select);
        self.select = if is_right { step + 1 } else { 0 };
        if self.select < 4 {
            return Effect::Nothing;
        }
        self.select = 0;
        self.is_configuration = true;
        answer(0x44, 0)
    }

    fn identify(&mut self, frame: &[u8; 8]) -> Effect {
        let step = usize::from(frame[0] - 0x46);
        let (part, comparison) = IDENTIFY[step];
        let fits = number(frame).cmp(&self.address[part]) as i8;
        let is_right = (fits == 0 || fits == comparison) && (step == 0 || step == self.identify);
        self.identify = if is_right { step + 1 } else { 0 };
        if self.identify < 6 {
            return Effect::Nothing;
        }
        self.identify = 0;
        answer(0x4F, 0)
    }

    fn is_unconfigured(&self) -> bool {
        (self.active_id, self.pending_id) == (NONE, NONE)
    }

    fn identify_non_configured(&mut self, _: &[u8; 8]) -> Effect {
        if self.is_unconfigured() { answer(0x50, 0) } else { Effect::Nothing }
    }

    fn fastscan(&mut self, frame: &[u8; 8]) -> Effect {
        let [.., bit_check, sub, next] = *frame;
        if !self.is_unconfigured() {
            return Effect::Nothing;
        }
        if bit_check == 0x80 {
            self.position = 0;
            return answer(0x4F, 0);
        }
        if bit_check > 0x1F || sub > 3 || next > 3 || sub != self.position {
            return Effect::Nothing;
        }
        let difference = self.address[usize::from(sub)] ^ number(frame);
        if (bit_check..32).any(|bit| difference & 1 << bit != 0) {
            return Effect::Nothing;
        }
        self.position = next;
        self.is_configuration |= bit_check == 0 && next < sub;
        answer(0x4F, 0)
    }
}

/// The slave and the model, which must not differ.
#[derive(Clone)]
struct Pair {
    slave: StateMachine,
    model: Model,
}

/// An event for a slave.
#[derive(Clone, Copy, Debug)]
enum Event {
    Request([u8; 8]),
    /// The switch delay after an activate bit timing is over.
    Activated,
    ResetCommunication,
}

impl Pair {
    fn new(address: [u32; 4], node_id: u8, rate: u8) -> Self {
        let [vendor_id, product_code, revision_number, serial_number] = address;
        let slave = StateMachine::new(
            Address { vendor_id, product_code, revision_number, serial_number },
            BitRates::possible(CLOCK_HZ).with_automatic(),
            NodeId::from_lss(node_id).expect("1..=127 or FF"),
            BitRateSetting::from_table(0, rate).expect("in the table"),
        );
        Self { slave, model: Model::new(address, node_id, rate) }
    }

    /// # Panics
    /// They differ.
    fn handle(&mut self, event: Event) {
        let before = self.clone();
        match event {
            Event::Request(data) => {
                let expected = self.model.handle(&data);
                let effect = match self.slave.handle(&data) {
                    None => Effect::Nothing,
                    Some(Reaction::Answer(answer)) => Effect::Answer(answer.padded_data()),
                    Some(Reaction::ActivateBitTiming(delay)) => Effect::Activate(delay),
                    Some(Reaction::StoreConfiguration) => Effect::Store,
                    Some(Reaction::ResetCommunication) => Effect::ResetCommunication,
                };
                assert_eq!(effect, expected, "{data:02X?} in {:?}", before.model);
                if effect == Effect::ResetCommunication {
                    self.handle(Event::ResetCommunication);
                }
            }
            Event::Activated => {
                let active = self.slave.activate_bit_rate(self.slave.pending_bit_rate());
                assert_eq!(active.index(), self.model.pending_rate, "in {:?}", before.model);
            }
            Event::ResetCommunication => {
                self.slave.reset_communication();
                self.model.reset_communication();
            }
        }
        let slave = &self.slave;
        let seen = (
            slave.state() == State::Configuration,
            NodeId::to_lss(slave.pending_node_id()),
            NodeId::to_lss(slave.active_node_id()),
            slave.pending_bit_rate().index(),
        );
        let model = &self.model;
        let expected =
            (model.is_configuration, model.pending_id, model.active_id, model.pending_rate);
        assert_eq!(seen, expected, "{event:02X?} in {:?}", before.model);
    }
}

const ADDRESS: [u32; 4] = [0x11, 0x22, 0x33, 0x8000_0044];
/// Each service with accepted and refused values, for `ADDRESS`.
const ALPHABET: &str = "04 00, 04 01, 04 02, 11 05, 11 7F, 11 00, 11 80, 11 FF, 15 E8 03, 17,
    13 00 02, 13 00 09, 13 00 01, 13 00 05, 13 01 02, 4C, 5A, 5B, 5C, 5D, 5E, 44, 4F, 50, 00, FF,
    40 11, 40 12, 41 22, 42 33, 42 34, 43 44 00 00 80, 43 44,
    46 11, 46 10, 47 22, 48 33, 48 34, 49 33, 49 32,
    4A 44 00 00 80, 4A FF FF FF FF, 4B 44 00 00 80, 4B 44,
    51 00 00 00 00 80 09 09, 51 11 00 00 00 00 00 01, 51 01 00 00 00 05 00 02,
    51 11 00 00 00 04 00 09, 51 22 00 00 00 00 01 02, 51 33 00 00 00 00 02 03,
    51 32 00 00 00 00 02 03, 51 33 00 00 00 00 02 00, 51 44 00 00 80 00 03 00,
    51 44 00 00 00 00 03 00, 51 00 00 00 00 1F 03 03, 51 00 00 00 00 20 00 00";

#[test]
fn no_sequence_from_a_small_alphabet_distinguishes_slave_and_model() {
    let mut alphabet = vec![Event::Activated, Event::ResetCommunication];
    for request in ALPHABET.split(',') {
        let mut data = bytes(request);
        data.resize(8, 0);
        alphabet.push(Event::Request(data.try_into().expect("eight bytes")));
    }
    let begin = Pair::new(ADDRESS, NONE, 4);
    let mut known = HashSet::from([(format!("{:?}", begin.slave), begin.model.clone())]);
    let mut open = vec![begin];
    let mut compared = 0;
    // Every reachable pair of states, and every event in each.
    while let Some(pair) = open.pop() {
        for &event in &alphabet {
            let mut pair = pair.clone();
            pair.handle(event);
            compared += 1;
            if known.insert((format!("{:?}", pair.slave), pair.model.clone())) {
                open.push(pair);
            }
        }
    }
    println!("{} states, {} events, {compared} comparisons", known.len(), alphabet.len());
    assert!(known.len() > 2_000);
}

/// A request of a master that sometimes makes errors.
fn request(random: &mut Random, model: &Model) -> [u8; 8] {
    let (from, to, ..) = SERVICES[random.within(0..11) as usize];
    let command = random.within(from.into()..u64::from(to) + 1) as u8;
    let own = match command {
        0x51 if !random.one_in(4) => model.address[usize::from(model.position)],
        _ => random.pick(&model.address),
    };
    let number = match random.within(0..8) {
        0 => own.wrapping_add(1),
        1 => own.wrapping_sub(1),
        2 => own ^ 1 << random.within(0..32),
        3 => random.pick(&[0, u32::MAX]),
        4 => random.u32(),
        _ => own,
    };
    let [b1, b2, b3, b4] = number.to_le_bytes();
    let mut data = [command, b1, b2, b3, b4, random.byte(), random.byte(), random.byte()];
    match command {
        0x04 => data[1] = random.within(0..3) as u8,
        0x11 if random.one_in(2) => data[1] = random.pick(&[0x00, 0x01, 0x7F, 0x80, 0xFE, NONE]),
        0x13 => {
            data[1..3].copy_from_slice(&[u8::from(random.one_in(8)), random.within(0..12) as u8])
        }
        0x51 => {
            let [bit_check, sub, next] = random.bytes();
            let bit_check = random.pick(&[0, bit_check % 34, 0x80]);
            let sub = random.pick(&[model.position, model.position, sub % 5]);
            data[5..].copy_from_slice(&[bit_check, sub, next % 5]);
        }
        _ => {}
    }
    data
}

/// A select, an identify or the Fastscan of the four parts without errors, sometimes from a later step on.
fn procedure(random: &mut Random, model: &Model) -> Vec<[u8; 8]> {
    let part = |part: usize| model.address[part].to_le_bytes();
    let step = |command: u8, [a, b, c, d]: [u8; 4]| [command, a, b, c, d, 0, 0, 0];
    let steps: Vec<_> = match random.within(0..3) {
        0 => (0..4).map(|n| step(0x40 + n as u8, part(n))).collect(),
        1 => (0..6).map(|n| step(0x46 + n as u8, part(IDENTIFY[n].0))).collect(),
        _ => {
            let scan = (0..4_u8).map(|n| {
                let mut data = step(0x51, part(n.into()));
                data[5..].copy_from_slice(&[0, n, (n + 1) % 4]);
                data
            });
            [[0x51, 0, 0, 0, 0, 0x80, 0, 0]].into_iter().chain(scan).collect()
        }
    };
    let skipped = if random.one_in(4) { random.within(0..steps.len() as u64) } else { 0 };
    steps[skipped as usize..].to_vec()
}

#[test]
fn long_random_sequences_do_not_distinguish_slave_and_model() {
    let mut random = Random::from_environment();
    let (mut frames, mut configured) = (0, 0);
    for _ in 0..200 {
        let address = std::array::from_fn(|_| match random.within(0..4) {
            0 => random.pick(&[0, 1, u32::MAX]),
            _ => random.u32(),
        });
        let node_id = random.pick(&[NONE, NONE, 1, 0x7F]);
        let mut pair = Pair::new(address, node_id, random.pick(&RATES));
        let mut planned: Vec<[u8; 8]> = Vec::new();
        for _ in 0..2_000 {
            if planned.is_empty() && random.one_in(4) {
                planned = procedure(&mut random, &pair.model);
                planned.reverse();
            }
            let event = match random.within(0..200) {
                0 => Event::ResetCommunication,
                1 => Event::Activated,
                2 => Event::Request(random.bytes()),
                3..40 => Event::Request(request(&mut random, &pair.model)),
                _ => Event::Request(match planned.pop() {
                    Some(data) => data,
                    None => request(&mut random, &pair.model),
                }),
            };
            pair.handle(event);
            frames += 1;
            configured += usize::from(pair.model.is_configuration);
        }
    }
    println!("{frames} events, {configured} of them ended in configuration state");
    assert!(configured > frames / 10 && configured < frames * 9 / 10);
}
