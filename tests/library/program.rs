//! Program download (CiA 302-3) at the node.

use canopen_node::{
    Action, Application, Instant, Node, Program,
    application::Domain,
    nmt,
    object_dictionary::DataType,
    objects,
    sdo::{Abort, Answer},
};
use testkit::{
    frames::{Frames, SILENCE},
    node_rig::{ADDRESS, NodeRig, device},
    sdo::Client,
};

/// A program that is being replaced.
#[derive(Clone, Debug)]
struct Download {
    /// What a client has written.
    bytes: Vec<u8>,
    is_full: bool,
    ends: usize,
    aborts: usize,
    requests: usize,
    answers: usize,
}

impl Download {
    const NONE: Self =
        Self { bytes: Vec::new(), is_full: false, ends: 0, aborts: 0, requests: 0, answers: 0 };
}

impl Program for Download {
    fn read(&mut self, index: u16, sub_index: u8) -> u32 {
        u32::from(index) % 0x100 + u32::from(sub_index)
    }

    fn control(&mut self, value: u8, state: nmt::State) -> Result<Answer, Abort> {
        assert_eq!(state, nmt::State::PreOperational);
        match value {
            0 => Ok(Answer::Now),
            1 => Ok(Answer::Later),
            _ => Err(Abort::InvalidValue),
        }
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Abort> {
        assert_eq!(offset as usize, self.bytes.len());
        self.bytes.extend(bytes);
        Ok(())
    }

    fn end(&mut self, len: u32) -> Result<Answer, Abort> {
        assert_eq!(len as usize, self.bytes.len());
        self.ends += 1;
        Ok(Answer::Later)
    }

    fn grant(&mut self) -> u8 {
        2
    }

    fn granted(&mut self) -> u8 {
        2
    }

    fn holds(&mut self, _: Instant) -> bool {
        self.is_full
    }

    fn abort(&mut self) {
        self.aborts += 1;
    }

    fn requested(&mut self) {
        self.requests += 1;
    }

    fn answering(&mut self) {
        self.answers += 1;
    }
}

objects! {
    /// A loader.
    pub struct Loader, values LoaderValue;

    private download: Download = Download::NONE;

    private notes: Vec<u8> = Vec::new();

    0x2100 {
        0 "Value" value: u8 = 7, rw;
    }
    0x2101 {
        0 "Notes" notes_domain: Domain = Domain, rw with read_notes and write_notes;
    }
}

impl Loader {
    fn read_notes(&self) -> &[u8] {
        &self.notes
    }

    fn write_notes(&mut self, offset: usize, bytes: &[u8]) -> Result<(), Abort> {
        self.notes.truncate(offset);
        self.notes.extend(bytes);
        Ok(())
    }

    /// Lets the program have no room, or have room again.
    pub fn set_full(&mut self, is_full: bool) {
        self.download.is_full = is_full;
    }
}

impl Application for Loader {
    const PROGRAM_DOWNLOAD: bool = true;
    const MAY_OPERATE: bool = false;

    fn program(&mut self) -> Option<&mut dyn Program> {
        Some(&mut self.download)
    }
}

type Board = NodeRig<Loader>;

fn board() -> Board {
    NodeRig::running(Loader::new())
}

fn download(board: &mut Board) -> &mut Download {
    &mut board.node.application_mut().download
}

/// Sends requests; returns the answers to the last one.
fn send(board: &mut Board, requests: &[&str]) -> Frames {
    let mut answers = Frames(Vec::new());
    requests.iter().for_each(|request| answers = board.sdo(request));
    answers
}

/// Gives the answer that the program has put off.
fn give(board: &mut Board, outcome: Result<(), Abort>) -> Frames {
    Frames(match board.node.answer(outcome) {
        Some(Action::Transmit(frame, _)) => vec![frame],
        _ => Vec::new(),
    })
}

#[test]
fn the_objects_of_a_program_have_its_values_and_their_names() {
    let mut board = board();
    for (index, sub_index, value) in
        [(0x1F51, 1, 0x52), (0x1F56, 1, 0x57), (0x1F57, 1, 0x58), (0x2001, 1, 2), (0x2001, 2, 3)]
    {
        assert_eq!(board.number(index, sub_index), value, "{index:04X}h:{sub_index}");
    }
    assert_eq!(board.number(0x2001, 0), 2);
    assert_eq!(board.upload(0x1F50, 1), Err(Abort::WriteOnly as u32));
    assert_eq!(board.number(0x2100, 0), 7, "those of the application stay its own");

    let own = |index| matches!(index, 0x1F50..=0x1F57 | 0x2001);
    let rows = Node::<Loader>::entries(&device(ADDRESS)).filter(|(entry, _)| own(entry.index));
    let names: Vec<_> = rows
        .map(|(entry, words)| {
            let object = words.object.map(|name| name.to_string()).unwrap_or_default();
            (entry.index, entry.sub_index, object, words.name.to_string())
        })
        .collect();
    let highest = "Highest sub-index supported";
    let expected = [
        (0x1F50, 0, "Program data", highest),
        (0x1F50, 1, "", "Program 1"),
        (0x1F51, 0, "Program control", highest),
        (0x1F51, 1, "", "Program 1"),
        (0x1F56, 0, "Program software identification", highest),
        (0x1F56, 1, "", "Program 1"),
        (0x1F57, 0, "Flash status indication", highest),
        (0x1F57, 1, "", "Program 1"),
        (0x2001, 0, "Update", highest),
        (0x2001, 1, "", "State"),
        (0x2001, 2, "", "Starts on trial"),
    ];
    assert_eq!(names, expected.map(|(i, s, object, name)| (i, s, object.into(), name.into())));
    let data = Node::<Loader>::entries(&device(ADDRESS)).find(|(entry, _)| entry.index == 0x1F50);
    assert_eq!(data.map(|(entry, _)| entry.data_type), Some(DataType::Unsigned8));
}

#[test]
fn a_program_grants_blocks_and_holds_the_answer_to_each_while_it_is_full() {
    let mut board = board();
    assert_eq!(send(&mut board, &["C2 50 1F 01 16"]), ["5C0: A4 50 1F 01 02 00 00 00"]);
    download(&mut board).is_full = true;
    assert_eq!(send(&mut board, &["01 01 02 03 04 05 06 07"]), SILENCE);
    assert!(download(&mut board).bytes.is_empty(), "it may have been the last");
    assert_eq!(send(&mut board, &["02 08 09 0A 0B 0C 0D 0E"]), SILENCE);
    board.pass_ms(100);
    download(&mut board).is_full = false;
    assert_eq!(board.pass_ms(100), SILENCE, "nobody has asked again");
    board.node.resume();
    assert_eq!(board.pass_us(0), ["5C0: A2 02 02 00 00 00 00 00"]);

    // The last segment of all within a block.
    download(&mut board).is_full = true;
    assert_eq!(send(&mut board, &["81 0F 10 11 12 13 14 15"]), SILENCE);
    download(&mut board).is_full = false;
    board.node.resume();
    assert_eq!(board.pass_us(0), ["5C0: A2 01 02 00 00 00 00 00"]);
}

#[test]
fn a_full_program_holds_no_answer_but_those_to_its_own_data() {
    let mut board = board();
    download(&mut board).is_full = true;
    assert_eq!(board.number(0x2001, 1), 2);
    assert_eq!(send(&mut board, &["2F 00 21 00 05"]), ["5C0: 60 00 21 00 00 00 00 00"]);
    // A download of another object in blocks, and in segments.
    assert_eq!(send(&mut board, &["C2 00 21 00 01"]), ["5C0: A4 00 21 00 7F 00 00 00"]);
    assert_eq!(send(&mut board, &["81 06"]), ["5C0: A2 01 7F 00 00 00 00 00"]);
    assert_eq!(send(&mut board, &["D9"]), ["5C0: A1 00 00 00 00 00 00 00"]);
    assert_eq!(send(&mut board, &["21 00 21 00 01"]), ["5C0: 60 00 21 00 00 00 00 00"]);
    assert_eq!(send(&mut board, &["0D 08"]), ["5C0: 20 00 00 00 00 00 00 00"]);
    assert_eq!(board.number(0x2100, 0), 8);

    assert_eq!(send(&mut board, &["21 50 1F 01 07"]), ["5C0: 60 50 1F 01 00 00 00 00"]);
    assert_eq!(send(&mut board, &["00 01 02 03 04 05 06 07"]), SILENCE);
    download(&mut board).is_full = false;
    board.node.resume();
    assert_eq!(board.pass_us(0), ["5C0: 20 00 00 00 00 00 00 00"]);
    assert_eq!(download(&mut board).bytes, [1, 2, 3, 4, 5, 6, 7]);
}

#[test]
fn the_end_of_a_program_is_answered_later_as_it_turns_out() {
    let requests = ["C2 50 1F 01 02", "81 01 02", "D5"];
    let mut board = board();
    assert_eq!(send(&mut board, &requests), SILENCE);
    assert_eq!(download(&mut board).bytes, [1, 2]);
    assert_eq!(give(&mut board, Ok(())), ["5C0: A1 00 00 00 00 00 00 00"]);

    download(&mut board).bytes.clear();
    assert_eq!(send(&mut board, &requests), SILENCE);
    let refused = give(&mut board, Err(Abort::Hardware));
    assert_eq!(refused, ["5C0: 80 50 1F 01 00 00 06 06"]);

    download(&mut board).bytes.clear();
    assert_eq!(send(&mut board, &requests), SILENCE);
    board.nmt("02 40");
    assert_eq!(give(&mut board, Ok(())), SILENCE, "NMT stopped has no SDO");
}

#[test]
fn a_program_shorter_than_announced_is_none() {
    let mut board = board();
    let answer = send(&mut board, &["C2 50 1F 01 03", "81 01 02", "D5"]);
    assert_eq!(answer, ["5C0: 80 50 1F 01 13 00 07 06"]);
    assert_eq!((download(&mut board).ends, download(&mut board).aborts), (0, 1));
    assert_eq!(give(&mut board, Ok(())), SILENCE);
}

#[test]
fn program_control_is_answered_at_once_or_later() {
    let mut board = board();
    assert_eq!(send(&mut board, &["2F 51 1F 01 00"]), ["5C0: 60 51 1F 01 00 00 00 00"]);
    assert_eq!(send(&mut board, &["2F 51 1F 01 02"]), ["5C0: 80 51 1F 01 30 00 09 06"]);
    assert_eq!(send(&mut board, &["2F 51 1F 01 01"]), SILENCE);
    assert_eq!(give(&mut board, Ok(())), ["5C0: 60 51 1F 01 00 00 00 00"]);
    let Download { requests, answers, .. } = *download(&mut board);
    assert_eq!((requests, answers), (3, 3));
    assert_eq!(give(&mut board, Ok(())), SILENCE, "each has one answer");
}

#[test]
fn a_program_whose_end_has_no_answer_yet_is_answered_no_more_once_the_next_is_refused() {
    let mut board = board();
    send(&mut board, &["C2 50 1F 01 02", "81 01 02", "D5"]);
    send(&mut board, &["21 50 1F 01 09", "80 50 1F 01"]);
    assert_eq!(give(&mut board, Ok(())), SILENCE);
}

#[test]
fn program_control_and_a_store_that_both_take_time_are_each_answered() {
    let mut board = board();
    board.let_stores_take_time();
    assert_eq!(send(&mut board, &["2F 51 1F 01 01"]), SILENCE);
    assert_eq!(send(&mut board, &["23 10 10 01 73 61 76 65"]), SILENCE);
    assert_eq!(give(&mut board, Ok(())), ["5C0: 60 51 1F 01 00 00 00 00"]);
    assert_eq!(board.finish_store(), ["5C0: 60 10 10 01 00 00 00 00"]);
}

#[test]
fn a_loader_answers_what_a_program_has_left_to_it() {
    let mut board = board();
    board.node.owe_control();
    assert_eq!(give(&mut board, Ok(())), ["5C0: 60 51 1F 01 00 00 00 00"]);
}

#[test]
fn a_client_that_aborts_has_the_program_discarded() {
    let mut board = board();
    send(&mut board, &["21 50 1F 01 09", "00 01 02 03 04 05 06 07", "80 50 1F 01"]);
    assert_eq!(download(&mut board).aborts, 1);
}

#[test]
fn a_loader_stays_in_nmt_pre_operational() {
    let mut board = board();
    board.nmt("01 00");
    assert_eq!(board.node.nmt_state(), nmt::State::PreOperational);
}

/// A program that is only controlled.
#[derive(Clone, Debug)]
struct Controlled;

impl Program for Controlled {
    fn read(&mut self, _: u16, _: u8) -> u32 {
        0
    }

    fn control(&mut self, _: u8, _: nmt::State) -> Result<Answer, Abort> {
        Ok(Answer::Now)
    }
}

objects! {
    /// A product whose program a loader replaces.
    struct Product, values ProductValue;

    private program: Controlled = Controlled;
}

impl Application for Product {
    const PROGRAM_DOWNLOAD: bool = true;

    fn program(&mut self) -> Option<&mut dyn Program> {
        Some(&mut self.program)
    }
}

#[test]
fn a_program_that_takes_no_data_refuses_it() {
    let mut board = NodeRig::running(Product::new());
    assert_eq!(board.sdo("C2 50 1F 01 03"), ["5C0: A4 50 1F 01 7F 00 00 00"]);
    assert_eq!(board.sdo("81 01 02 03"), ["5C0: A2 01 7F 00 00 00 00 00"]);
    assert_eq!(board.sdo("D1"), ["5C0: 80 50 1F 01 22 00 00 08"]);
    assert_eq!(board.sdo("C2 50 1F 01 0E"), ["5C0: A4 50 1F 01 7F 00 00 00"]);
    assert_eq!(
        board.sdo("7F 01 02 03 04 05 06 07"),
        ["5C0: A2 00 7F 00 00 00 00 00"],
        "segment 127"
    );
    assert_eq!(board.sdo("01 01 02 03 04 05 06 07"), SILENCE, "one of 127");
    assert_eq!(board.sdo("02 08 09 0A 0B 0C 0D 0E"), ["5C0: 80 50 1F 01 22 00 00 08"]);
}

#[test]
fn a_domain_of_the_application_is_no_program() {
    let mut board = board();
    let notes: Vec<_> = (1..=20).collect();
    assert_eq!(board.download(0x2101, 0, &notes), Ok(()));
    assert_eq!(board.upload(0x2101, 0), Ok(notes));
    send(&mut board, &["21 01 21 00 09", "00 01 02 03 04 05 06 07", "80 01 21"]);
    assert_eq!((download(&mut board).bytes.len(), download(&mut board).aborts), (0, 0));
}
