//! What happened to each board, read from the frames of a run.

use std::time::Duration;

use can_bus::{bus::What, explain::explain};
use canopen_node::{
    BitRate, Frame, NodeId,
    lss::{self, Address, AddressPart, FastscanStep, Request},
    nmt,
};

use crate::recorder::Entry;

/// Steps of one kind that follow each other within this time are one.
const PAUSE: Duration = Duration::from_millis(300);
/// The index of the serial number in an LSS address.
const SERIAL: usize = AddressPart::SerialNumber as usize;

/// What a step is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A Fastscan, or another search.
    Search,
    /// The board is asked, by LSS or by SDO.
    Check,
    Configure,
    Store,
    /// An NMT reset, or the time of a switch of the bit rate.
    Reset,
    BootUp,
    /// No answer, or a refusal.
    Problem,
}

/// A step: what was done with a board, and when.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Step {
    pub kind: Kind,
    pub from: Duration,
    pub to: Duration,
    pub words: String,
}

/// The line of a station in the picture.
#[derive(Clone, Debug, Default)]
pub struct Lane {
    pub steps: Vec<Step>,
    /// The frames: when, and whether it is a request of the master.
    pub frames: Vec<(Duration, bool)>,
}

impl Lane {
    fn step(&mut self, kind: Kind, from: Duration, to: Duration, words: impl Into<String>) {
        if let Some(last) = self.steps.last_mut()
            && [last.kind, kind] == [Kind::Check; 2]
            && from.saturating_sub(last.to) < PAUSE
        {
            last.to = to;
            return;
        }
        self.steps.push(Step { kind, from, to, words: words.into() });
    }
}

/// A board, as far as the frames tell.
#[derive(Clone, Debug, Default)]
pub struct Board {
    parts: [Option<u32>; 4],
    /// The node-ID at the beginning; `None` if it is not known.
    pub before: Option<Option<u8>>,
    /// The node-ID in the end.
    pub id: Option<u8>,
    pending: Option<u8>,
    /// The bit rate that it was told.
    pub rate: Option<BitRate>,
    pub is_stored: bool,
    pub has_answered: bool,
    /// Since when a question by SDO has no answer.
    asked: Option<Duration>,
    /// The last thing that it did not answer or refused.
    pub problem: Option<String>,
    pub lane: Lane,
}

impl Board {
    /// The LSS address, or the serial number, or nothing.
    pub fn name(&self) -> String {
        match self.parts {
            [Some(vendor), Some(product), Some(revision), Some(serial)] => {
                Address::from([vendor, product, revision, serial]).to_string()
            }
            [.., Some(serial_number)] => format!("serial number {serial_number:08X}"),
            _ => "does not tell its LSS address".into(),
        }
    }

    fn hear(&mut self) {
        self.has_answered = true;
        self.problem = None;
    }

    fn fail(&mut self, from: Duration, to: Duration, words: String) {
        self.lane.step(Kind::Problem, from, to, words.clone());
        self.problem = Some(words);
    }

    fn may_be(&self, parts: [Option<u32>; 4]) -> bool {
        let agree = |(own, other): (&Option<u32>, Option<u32>)| {
            own.is_none() || other.is_none() || *own == other
        };
        self.parts[SERIAL].is_some()
            && self.parts[SERIAL] == parts[SERIAL]
            && self.parts.iter().zip(parts).all(agree)
    }
}

/// The run.
#[derive(Debug, Default)]
pub struct History {
    /// What concerns no board, or all of them.
    pub master: Lane,
    /// In the order in which they were found.
    pub boards: Vec<Board>,
    /// The bit rates of the adapter, with their beginning.
    pub rates: Vec<(Duration, BitRate)>,
    pub end: Duration,
    /// The frames of a search that is under way.
    search: Vec<(Duration, bool)>,
    parts: [Option<u32>; 4],
    scanned: Option<FastscanStep>,
    /// The board that was selected and has not answered yet.
    called: Option<usize>,
    /// The boards in LSS configuration state, as far as they are known.
    selected: Vec<usize>,
    /// A request that has no answer yet.
    open: Option<(Request, Duration)>,
}

impl History {
    pub fn of(entries: &[Entry]) -> Self {
        let mut history = Self::default();
        for Entry { at, what } in entries {
            history.end = history.end.max(*at);
            match what {
                What::Opened(rate) => history.open_at(*at, *rate),
                What::Sent(frame) => history.sent(*at, frame),
                What::Received(frame) => history.received(*at, frame),
            }
        }
        history.no_answer(history.end);
        for board in &mut history.boards {
            if let Some(from) = board.asked {
                board.fail(from, from, "no answer by SDO".into());
            }
        }
        history.end_search();
        history
    }

    fn open_at(&mut self, at: Duration, rate: BitRate) {
        if self.rates.last().is_none_or(|(_, before)| *before != rate) {
            self.rates.push((at, rate));
        }
    }

    fn sent(&mut self, at: Duration, frame: &Frame) {
        match (frame.cob_id(), frame.data()) {
            (lss::REQUEST_COB_ID, data) => {
                let bytes: Option<[u8; 8]> = data.try_into().ok();
                match bytes.and_then(|bytes| Request::from_bytes(&bytes)) {
                    Some(request) => self.request(at, request),
                    None => self.master.frames.push((at, true)),
                }
            }
            (nmt::COMMAND_COB_ID, &[command @ (129 | 130), id]) => {
                self.master.frames.push((at, true));
                let words = explain(nmt::COMMAND_COB_ID, &[command, id]);
                for board in &mut self.boards {
                    if board.id.is_some() && (id == 0 || board.id == Some(id)) {
                        board.lane.step(Kind::Reset, at, at, words.clone());
                    }
                }
            }
            (cob_id @ 0x601..=0x67F, _) => {
                let id = (cob_id & 0x7F) as u8;
                match self.boards.iter_mut().find(|board| board.id == Some(id)) {
                    Some(board) => {
                        board.asked.get_or_insert(at);
                        board.lane.frames.push((at, true));
                    }
                    None => {
                        self.master.frames.push((at, true));
                        self.master.step(Kind::Check, at, at, "asks each node-ID by SDO");
                    }
                }
            }
            _ => self.master.frames.push((at, true)),
        }
    }

    fn request(&mut self, at: Duration, request: Request) {
        self.no_answer(at);
        // The master asks who it is if the answer to the last question of a Fastscan is late or lost.
        let is_last_question =
            matches!(request, Request::Inquire(_)) && self.scanned.is_some_and(is_last);
        let is_search =
            is_last_question || matches!(request, Request::Fastscan(_) | Request::Select(..));
        if !is_search {
            self.end_search();
        }
        match request {
            _ if is_last_question => {}
            Request::Fastscan(step) => {
                if step.bit_check == 0x80 {
                    self.end_search();
                    self.parts = [None; 4];
                } else if let Some(part) = self.parts.get_mut(usize::from(step.sub))
                    && step.bit_check == 0
                {
                    *part = Some(step.id_number);
                }
                self.scanned = Some(step);
            }
            Request::Select(part, number) => {
                if part == AddressPart::VendorId {
                    self.end_search();
                    self.parts = [None; 4];
                    self.selected.clear();
                }
                self.parts[part as usize] = Some(number);
                if part == AddressPart::SerialNumber {
                    self.called = Some(self.board(self.parts));
                }
            }
            Request::SwitchToWaiting => self.selected.clear(),
            Request::SwitchToConfiguration => self.selected = (0..self.boards.len()).collect(),
            Request::ActivateBitTiming(delay) => {
                let to = at + 2 * Duration::from_millis(delay.into());
                let words = format!("all switch, with a delay of {delay} ms");
                self.master.step(Kind::Reset, at, to, words);
            }
            Request::Identify(..) | Request::IdentifyNonConfigured => {
                self.master.step(Kind::Check, at, at, "looks for boards");
            }
            _ => self.open = Some((request, at)),
        }
        match self.selected[..] {
            _ if is_search => self.search.push((at, true)),
            [one] => self.boards[one].lane.frames.push((at, true)),
            _ => self.master.frames.push((at, true)),
        }
    }

    fn received(&mut self, at: Duration, frame: &Frame) {
        match (frame.cob_id(), frame.data()) {
            (lss::RESPONSE_COB_ID, data) => self.answer(at, data),
            (cob_id @ 0x581..=0x5FF, data) => {
                let number = match *data {
                    [command, 0x18, 0x10, sub @ 1..=4, a, b, c, d] if command != 0x80 => {
                        Some((usize::from(sub - 1), u32::from_le_bytes([a, b, c, d])))
                    }
                    _ => None,
                };
                let at_board = self.node((cob_id & 0x7F) as u8, number);
                let board = &mut self.boards[at_board];
                board.hear();
                board.asked = None;
                board.lane.frames.push((at, false));
                board.lane.step(Kind::Check, at, at, "answers by SDO");
            }
            (cob_id @ 0x701..=0x77F, &[0]) => self.boot_up(at, (cob_id & 0x7F) as u8),
            (cob_id @ 0x701..=0x77F, _) => {
                let node = self.node((cob_id & 0x7F) as u8, None);
                self.boards[node].lane.frames.push((at, false));
            }
            _ => self.master.frames.push((at, false)),
        }
    }

    fn answer(&mut self, at: Duration, data: &[u8]) {
        let Some((&specifier, rest)) = data.split_first() else { return };
        match specifier {
            0x44 => {
                self.search.push((at, false));
                if let Some(board) = self.called.take() {
                    self.found(board, Kind::Check, at, "selected by its LSS address".into());
                }
            }
            0x4F | 0x5D if self.scanned.is_some() => {
                self.search.push((at, false));
                if self.scanned.take().is_some_and(is_last) {
                    let board = self.board(self.parts);
                    self.boards[board].before.get_or_insert(None);
                    let count = self.search.iter().filter(|(_, is_request)| *is_request).count();
                    let words = format!("found by Fastscan, {count} requests");
                    self.found(board, Kind::Search, at, words);
                }
            }
            _ => self.service(at, specifier, rest),
        }
    }

    /// The answer of the selected board, or of all of them.
    fn service(&mut self, at: Duration, specifier: u8, rest: &[u8]) {
        let &[one] = &self.selected[..] else {
            self.open = None;
            self.master.frames.push((at, false));
            return;
        };
        let board = &mut self.boards[one];
        board.lane.frames.push((at, false));
        // An answer to an earlier request may come late.
        let is_answered = |(request, _): &mut (Request, _)| request.to_bytes()[0] == specifier;
        let Some((request, from)) = self.open.take_if(is_answered) else { return };
        let first = rest.first().copied().unwrap_or_default();
        if first != 0 && matches!(specifier, 0x11 | 0x13 | 0x17) {
            let answer = [specifier, first, 0, 0, 0, 0, 0, 0];
            board.fail(from, at, explain(lss::RESPONSE_COB_ID, &answer));
            return;
        }
        match request {
            Request::ConfigureNodeId(id) => {
                board.pending = NodeId::from_lss(id).ok().flatten().map(NodeId::get);
                let words = board.pending.map_or("no node-ID".into(), |id| format!("node-ID {id}"));
                board.lane.step(Kind::Configure, from, at, words);
            }
            Request::ConfigureBitTiming { table, index } => {
                board.rate = BitRate::from_table(table, index);
                let words = board.rate.map_or("a bit rate".into(), |rate| rate.to_string());
                board.lane.step(Kind::Configure, from, at, words);
            }
            Request::StoreConfiguration => {
                board.is_stored = true;
                board.lane.step(Kind::Store, from, at, "stored");
            }
            Request::InquireNodeId => {
                let id = NodeId::from_lss(first).ok().flatten().map(NodeId::get);
                board.before.get_or_insert(id);
                board.id = id;
            }
            Request::Inquire(part) => {
                if let &[a, b, c, d, ..] = rest {
                    board.parts[part as usize] = Some(u32::from_le_bytes([a, b, c, d]));
                }
            }
            _ => {}
        }
    }

    fn boot_up(&mut self, at: Duration, id: u8) {
        let pending = self.boards.iter().position(|board| board.pending == Some(id));
        let node = pending.unwrap_or_else(|| self.node(id, None));
        let board = &mut self.boards[node];
        board.pending = None;
        board.id = Some(id);
        board.hear();
        board.lane.frames.push((at, false));
        board.lane.step(Kind::BootUp, at, at, format!("boots up as node {id}"));
    }

    /// A board that was searched for is there.
    fn found(&mut self, board: usize, kind: Kind, at: Duration, words: String) {
        self.selected = vec![board];
        let from = self.search_begin(at);
        let board = &mut self.boards[board];
        board.hear();
        board.lane.frames.append(&mut self.search);
        board.lane.step(kind, from, at, words);
    }

    /// When the search that is under way has begun.
    fn search_begin(&self, now: Duration) -> Duration {
        self.search.first().map_or(now, |(from, _)| *from)
    }

    /// A search has found nobody.
    fn end_search(&mut self) {
        if let (Some((from, _)), Some((to, _))) = (self.search.first(), self.search.last()) {
            let (from, to) = (*from, *to);
            self.master.step(Kind::Search, from, to, "Fastscan");
        }
        self.master.frames.append(&mut self.search);
        self.scanned = None;
    }

    /// What was asked before this time has no answer.
    fn no_answer(&mut self, at: Duration) {
        if let Some(board) = self.called.take() {
            let from = self.search_begin(at);
            let board = &mut self.boards[board];
            board.lane.frames.append(&mut self.search);
            board.fail(from, at, "no answer to switch state selective".into());
        }
        let Some((request, from)) = self.open.take() else { return };
        if let &[one] = &self.selected[..] {
            let words = explain(lss::REQUEST_COB_ID, &request.to_bytes());
            let words = format!("no answer to {}", words.trim_start_matches("LSS "));
            self.boards[one].fail(from, at, words);
        }
    }

    /// The board with this LSS address.
    fn board(&mut self, parts: [Option<u32>; 4]) -> usize {
        let known = self.boards.iter().position(|board| board.may_be(parts));
        let at = known.unwrap_or_else(|| self.add(Board::default()));
        for (own, part) in self.boards[at].parts.iter_mut().zip(parts) {
            *own = own.or(part);
        }
        at
    }

    /// The node with this node-ID, which may tell a part of its LSS address.
    fn node(&mut self, id: u8, part: Option<(usize, u32)>) -> usize {
        let agrees = |board: &Board| {
            part.is_none_or(|(at, number)| board.parts[at].is_none_or(|own| own == number))
        };
        let has_id = |board: &Board| board.id == Some(id) || board.pending == Some(id);
        let known = self.boards.iter().position(|board| has_id(board) && agrees(board));
        let at = known.unwrap_or_else(|| {
            self.add(Board { before: Some(Some(id)), id: Some(id), ..Board::default() })
        });
        if let Some((sub, number)) = part {
            self.boards[at].parts[sub] = Some(number);
        }
        at
    }

    fn add(&mut self, board: Board) -> usize {
        self.boards.push(board);
        self.boards.len() - 1
    }
}

/// Whether this is the last question of a Fastscan, which brings the slave to LSS configuration state.
fn is_last(step: FastscanStep) -> bool {
    step.bit_check == 0 && usize::from(step.sub) == SERIAL && step.next < step.sub
}
