//! What the frames of a network tell while somebody watches it: no I/O, and no clock.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::{Duration, Instant},
};

use can_bus::{
    adapter::Received,
    explain::{error_code, nmt_state},
};

use super::rows::Row;

/// The number of events that are kept for the screen.
const KEPT: usize = 100;
/// More than a heartbeat is late because of other frames and the computer.
const JITTER: Duration = Duration::from_millis(100);
/// The emergency of this repository's nodes at another bit rate than their home rate (docs/reference.md).
const GUEST_ERROR_CODE: u16 = 0xFF10;
/// The heartbeat of node guarding has a toggle bit.
const STATE: u8 = 0x7F;

/// A node, and what it has sent since the beginning.
#[derive(Default)]
pub struct Node {
    pub row: Row,
    pub boot_ups: u32,
    pub emergencies: u32,
    /// The last emergency in words.
    pub last_emergency: Option<String>,
    pub last_heartbeat: Option<Instant>,
    /// The time from one heartbeat to the next; `None` if it sends none or if it is not known.
    interval: Option<Duration>,
    pub is_gone: bool,
}

impl Node {
    pub fn new(row: Row) -> Self {
        Self { row, ..Self::default() }
    }
}

/// The nodes with a node-ID, and the boards without one.
pub struct Network {
    pub nodes: BTreeMap<u8, Node>,
    /// The boards that had no node-ID at the beginning. They send nothing.
    pub blank: Vec<Row>,
    start: Instant,
    /// The nodes that have appeared, or come back by a boot-up, and that nobody has asked yet.
    unasked: BTreeSet<u8>,
    /// What happened, with the time from the start.
    pub events: VecDeque<(Duration, String)>,
}

impl Network {
    /// The network of the list, watched from `start` on.
    pub fn new(rows: Vec<Row>, start: Instant) -> Self {
        let mut network = Self {
            nodes: BTreeMap::new(),
            blank: Vec::new(),
            start,
            unasked: BTreeSet::new(),
            events: VecDeque::new(),
        };
        for row in rows {
            match row.node_id {
                Some(id) => _ = network.nodes.entry(id).or_insert(Node::new(row)),
                None => network.blank.push(row),
            }
        }
        network
    }

    /// Notes a frame.
    pub fn note(&mut self, received: &Received) {
        let (cob_id, at) = (received.frame.cob_id(), received.here);
        let id = (cob_id & 0x7F) as u8;
        match (cob_id, received.frame.data()) {
            (0x701..=0x77F, &[byte]) => self.heartbeat(id, byte & STATE, at),
            (0x081..=0x0FF, data) => self.emergency(id, data, at),
            _ => {}
        }
    }

    fn heartbeat(&mut self, id: u8, byte: u8, at: Instant) {
        let is_boot_up = byte == 0;
        let node = self.node(id, at);
        let was_gone = std::mem::take(&mut node.is_gone);
        let before = node.row.state.replace(nmt_state(byte));
        let last = node.last_heartbeat.replace(at);
        if is_boot_up {
            node.boot_ups += 1;
            let count = node.boot_ups;
            if was_gone {
                self.unasked.insert(id);
            }
            self.event(at, format!("node {id}: boot-up ({count})"));
            return;
        }
        // The time from a boot-up to the first heartbeat may be shorter.
        if let Some(last) = last
            && before != Some(nmt_state(0))
            && at > last
        {
            node.interval = Some(at.saturating_duration_since(last));
        }
        if was_gone {
            self.event(at, format!("node {id} is back: {}", nmt_state(byte)));
        } else if before != Some(nmt_state(byte)) {
            self.event(at, format!("node {id}: {}", nmt_state(byte)));
        }
    }

    fn emergency(&mut self, id: u8, data: &[u8], at: Instant) {
        let &[low, high, _, ref rest @ ..] = data else { return };
        let code = u16::from_le_bytes([low, high]);
        let node = self.node(id, at);
        let words = match *rest {
            // The code is the manufacturer's: only nodes of this repository mean that by it.
            [a, b, c, d, _] if code == GUEST_ERROR_CODE && node.row.home_bit_rate.is_some() => {
                let [rate, home] = [[a, b], [c, d]].map(u16::from_le_bytes);
                format!("at {rate} kbit/s, and not at its home rate {home} kbit/s")
            }
            _ => error_code(code).to_owned(),
        };
        node.emergencies += 1;
        node.last_emergency = Some(format!("{code:04X}h {words}"));
        self.event(at, format!("node {id}: emergency {code:04X}h, {words}"));
    }

    /// The node; one that is not known yet appears.
    fn node(&mut self, id: u8, at: Instant) -> &mut Node {
        if !self.nodes.contains_key(&id) {
            self.unasked.insert(id);
            self.event(at, format!("node {id} appears"));
        }
        let node = self.nodes.entry(id).or_default();
        node.row.node_id = Some(id);
        node
    }

    /// The next node to ask who it is; each is asked once.
    pub fn next_unasked(&mut self) -> Option<u8> {
        self.unasked.pop_first()
    }

    /// Notes the answers of a node that was asked: a row for each board that has the node-ID.
    pub fn identify(&mut self, id: u8, rows: Vec<Row>, at: Instant) {
        let node = self.nodes.entry(id).or_default();
        let before = node.row.lss_address;
        let state = node.row.state;
        let count = rows.len();
        let Some(first) = rows.into_iter().next() else {
            let words = format!("node {id} does not answer by SDO who it is");
            return self.event(at, words);
        };
        let text = first.lss_address.map_or("unknown".into(), |address| address.to_string());
        let name = first.name.clone().unwrap_or_default();
        node.row = Row { state: state.or(first.state), ..first };
        let now = node.row.lss_address;
        if now.is_some() && now == before && count == 1 {
            return;
        }
        self.blank.retain(|row| row.lss_address.is_none() || row.lss_address != now);
        self.event(at, format!("node {id} is board {text} {name}").trim_end().to_owned());
        if count > 1 {
            self.event(at, format!("{count} boards share node-ID {id}: `lss list` tells which"));
        }
    }

    /// Notes how often a node says that it sends a heartbeat (object 1017h).
    pub fn set_interval(&mut self, id: u8, ms: u32, at: Instant) {
        if let Some(node) = self.nodes.get_mut(&id) {
            node.interval = (ms > 0).then(|| Duration::from_millis(ms.into()));
            // From now on it can be missing.
            if node.interval.is_some() {
                node.last_heartbeat.get_or_insert(at);
            }
        }
    }

    /// Finds the nodes whose heartbeat fails to come.
    pub fn look(&mut self, now: Instant) {
        let mut gone = Vec::new();
        for (&id, node) in self.nodes.iter_mut().filter(|(_, node)| !node.is_gone) {
            let (Some(last), Some(interval)) = (node.last_heartbeat, node.interval) else {
                continue;
            };
            let silence = now.saturating_duration_since(last);
            if silence > 2 * interval + JITTER {
                node.is_gone = true;
                gone.push((id, silence.as_secs_f64()));
            }
        }
        for (id, seconds) in gone {
            self.event(now, format!("node {id} has vanished: no heartbeat for {seconds:.1} s"));
        }
    }

    fn event(&mut self, at: Instant, words: String) {
        self.events.push_back((at.saturating_duration_since(self.start), words));
        if self.events.len() > KEPT {
            self.events.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use canopen_node::Frame;

    use super::*;

    /// A network that is watched from now on, and the frames of it.
    struct Watched {
        network: Network,
        start: Instant,
    }

    impl Watched {
        fn new() -> Self {
            let start = Instant::now();
            let row = Row { node_id: Some(5), ..Row::default() };
            Self { network: Network::new(vec![row], start), start }
        }

        fn at(&mut self, ms: u64, cob_id: u16, data: &[u8]) -> Vec<String> {
            let span = Duration::from_millis(ms);
            let frame = Frame::new(cob_id, data).expect("a frame");
            self.network.note(&Received { frame, at: span, here: self.start + span });
            self.events()
        }

        fn look(&mut self, ms: u64) -> Vec<String> {
            self.network.look(self.start + Duration::from_millis(ms));
            self.events()
        }

        fn events(&mut self) -> Vec<String> {
            self.network.events.drain(..).map(|(_, words)| words).collect()
        }
    }

    #[test]
    fn a_node_vanishes_after_two_heartbeats_and_comes_back() {
        let mut watched = Watched::new();
        assert_eq!(watched.at(0, 0x705, &[5]), ["node 5: operational"]);
        assert_eq!(watched.look(60_000), [""; 0], "one heartbeat has no interval");
        assert_eq!(watched.at(1_000, 0x705, &[5]), [""; 0]);
        assert_eq!(watched.look(3_100), [""; 0]);
        assert_eq!(watched.look(3_101), ["node 5 has vanished: no heartbeat for 2.1 s"]);
        assert_eq!(watched.look(9_000), [""; 0], "it is said once");
        assert_eq!(watched.at(9_000, 0x705, &[0x7F]), ["node 5 is back: pre-operational"]);
        assert_eq!(watched.network.next_unasked(), None);
        // Two at one moment tell no interval.
        assert_eq!(watched.at(10_000, 0x705, &[4]), ["node 5: stopped"]);
        assert_eq!(watched.at(10_000, 0x705, &[4]), [""; 0]);
        assert_eq!(watched.look(11_000), [""; 0]);
    }

    #[test]
    fn the_last_100_events_are_kept() {
        let Watched { mut network, start } = Watched::new();
        for number in 0..=100 {
            network.event(start, number.to_string());
        }
        assert_eq!((network.events.len(), &*network.events[0].1), (100, "1"));
    }

    #[test]
    fn a_node_without_a_heartbeat_never_vanishes() {
        let mut watched = Watched::new();
        watched.network.set_interval(5, 0, watched.start);
        assert_eq!(watched.look(3_600_000), [""; 0]);
        watched.network.set_interval(5, 500, watched.start);
        assert_eq!(watched.look(1_100), [""; 0]);
        assert_eq!(watched.look(1_101), ["node 5 has vanished: no heartbeat for 1.1 s"]);
    }

    #[test]
    fn a_node_that_boots_up_after_it_was_missing_is_asked_again() {
        let mut watched = Watched::new();
        watched.network.set_interval(5, 1_000, watched.start);
        assert_eq!(watched.at(100, 0x705, &[0]), ["node 5: boot-up (1)"]);
        assert_eq!(watched.network.next_unasked(), None);
        assert_eq!(watched.look(2_201).len(), 1);
        assert_eq!(watched.at(5_000, 0x705, &[0]), ["node 5: boot-up (2)"]);
        assert_eq!(watched.network.next_unasked(), Some(5));
        assert_eq!(watched.network.next_unasked(), None);
        // The first heartbeat comes when it comes: the interval stays.
        assert_eq!(watched.at(5_010, 0x705, &[0x7F]), ["node 5: pre-operational"]);
        assert_eq!(watched.look(7_100), [""; 0]);
        assert_eq!(watched.look(7_111).len(), 1);
    }

    #[test]
    fn an_emergency_has_words_and_a_new_node_appears_once() {
        let mut watched = Watched::new();
        let passive = [0x20, 0x81, 0x11, 0, 0, 0, 0, 0];
        let expected = ["node 9 appears", "node 9: emergency 8120h, CAN is error passive"];
        assert_eq!(watched.at(0, 0x089, &passive), expected);
        assert_eq!(watched.at(0, 0x089, &[0; 8]), ["node 9: emergency 0000h, error reset"]);
        assert_eq!(watched.network.nodes[&9].emergencies, 2);
        assert_eq!(watched.network.next_unasked(), Some(9));
        assert_eq!(watched.network.next_unasked(), None);
        let guest = [0x10, 0xFF, 0x81, 125, 0, 0xF4, 1, 0];
        assert_eq!(watched.at(0, 0x089, &guest), ["node 9: emergency FF10h, device-specific"]);
        let ours = Row { home_bit_rate: Some(500), ..Row::default() };
        watched.network.identify(9, vec![ours], watched.start);
        let words = "at 125 kbit/s, and not at its home rate 500 kbit/s";
        let expected = format!("node 9: emergency FF10h, {words}");
        assert_eq!(watched.at(0, 0x089, &guest)[1..], [expected]);
        assert_eq!(watched.network.nodes[&9].last_emergency, Some(format!("FF10h {words}")));
        // SYNC and node 0 are nobody.
        assert_eq!(watched.at(0, 0x080, &[]), [""; 0]);
        assert_eq!(watched.at(0, 0x700, &[0]), [""; 0]);
    }

    #[test]
    fn a_board_that_had_no_node_id_is_known_by_its_address() {
        let start = Instant::now();
        let lss_address = Some([1, 2, 3, 4].into());
        let blank = Row { lss_address, ..Row::default() };
        let other = Row { lss_address: Some([1, 2, 3, 5].into()), ..Row::default() };
        let mut network = Network::new(vec![blank.clone(), Row::default(), other.clone()], start);
        network.heartbeat(7, 0x7F, start);
        network.events.clear();
        let row = Row { node_id: Some(7), ..blank };
        network.identify(7, vec![row.clone()], start);
        assert_eq!(network.blank.len(), 2, "only it");
        assert_eq!(network.nodes[&7].row.state, Some("pre-operational"));
        network.identify(7, vec![row, other], start);
        let words: Vec<&str> = network.events.iter().map(|(_, words)| &**words).collect();
        let board = "node 7 is board 00000001:00000002:00000003:00000004";
        let shared = "2 boards share node-ID 7: `lss list` tells which";
        assert_eq!(words, [board, board, shared]);
    }
}
