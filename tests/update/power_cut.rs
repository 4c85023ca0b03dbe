//! The power fails in an operation of the flash, while a program is installed, restored or rolled back.
//!
//! Of a board that loses its power only the flash remains. So each session runs once; then a board with the flash that
//! each cut would leave is switched on.

use std::{
    collections::BTreeSet,
    ops::Range,
    sync::LazyLock,
    time::{Duration, Instant},
};

use emulator::{
    Time,
    chip::{Cells, Done, Timing},
    image::Image,
};
use testkit::{parallel, product, random::Random};

use super::{
    bad_programs::{UNDEFINED, with_first_instruction},
    rig::{self, PART, RUN, Rig, file, file_of, program, with_version},
};

/// An operation that takes longer is an erase.
const ERASE: Time = Time::from_ms(100);
/// The operations before and after an erase or a step of the master that are cut in any case.
const AROUND: u64 = 2;
/// 2001h sub-index 1: no update, a program on trial, a confirmed update.
const NONE: u32 = 0;
const TRIAL: u32 = 2;
const KEPT: u32 = 3;
/// The length of the small programs.
const SMALL: usize = 4096;
const CODE: u32 = RUN + 0x200;

/// What happens on a board.
#[derive(Clone, Copy, Debug)]
enum Session {
    /// On a board that was updated before: a download that is cut short, another one, and the confirmation.
    Update,
    /// The way back to the old program, since the download was not completed.
    Restore,
    /// The way back from a program that fails at each start.
    RollBack,
}

/// The files of an old program, a new one, and one that fails at each start.
pub struct Files {
    pub old: Vec<u8>,
    pub new: Vec<u8>,
    failing: Vec<u8>,
}

impl Files {
    /// Those of the product.
    fn product() -> Self {
        let failing = with_first_instruction(&program("0.2.0"), UNDEFINED);
        let failing = file_of(&failing, "0.2.0");
        Self { old: file("0.1.0"), new: file("0.2.0"), failing }
    }

    /// Those of a program of 4 KB.
    pub fn small() -> Self {
        static IMAGE: LazyLock<Image> = LazyLock::new(|| {
            let change = |path: &str, content: String| match path {
                "src/main.rs" => include_str!("small.rs").into(),
                // It has no log.
                "build.rs" => content.replace(", \"-Tdefmt.x\"", ""),
                _ => content,
            };
            product::build_program("small", PART, 1, change)
                .unwrap_or_else(|error| panic!("{error}"))
        });
        let of = |version| {
            let mut bytes: Vec<u8> = Vec::new();
            for (address, segment) in with_version(&IMAGE, version).segments() {
                bytes.resize((address - CODE) as usize, 0xFF);
                bytes.extend(segment);
            }
            assert!(bytes.len() < SMALL, "{} bytes", bytes.len());
            let mut random = Random::from_seed(bytes.len() as u64);
            bytes.resize_with(SMALL, || random.byte());
            bytes
        };
        let file = |bytes, version| file_of(&Image::from_segments(vec![(CODE, bytes)]), version);
        let mut failing = of("0.2.0");
        // The reset vector leads to an undefined instruction in the random bytes.
        failing[SMALL / 2..][..2].copy_from_slice(&UNDEFINED.to_le_bytes());
        failing[4..8].copy_from_slice(&(CODE + SMALL as u32 / 2 + 1).to_le_bytes());
        Self {
            old: file(of("0.1.0"), "0.1.0"),
            new: file(of("0.2.0"), "0.2.0"),
            failing: file(failing, "0.2.0"),
        }
    }
}

/// The operations of the flash in a session.
struct Recorded {
    before: Cells,
    operations: Vec<Done>,
    /// Those beside an erase or a step of the master: the erases, and the words of the journal.
    decisive: BTreeSet<u64>,
    /// The number of operations before the first erase.
    before_erase: usize,
}

impl Session {
    fn record(self, files: &Files) -> Recorded {
        let mut rig = Rig::of(rig::board_with(&files.old));
        rig.0.network.permit_misuse();
        let mut marks = Vec::new();
        match self {
            Self::Update => {
                rig.load(&files.old, &mut Vec::new());
                rig.start_and_confirm(&mut Vec::new());
            }
            Self::Restore => rig.begin_download(&files.new, &mut Vec::new()),
            Self::RollBack => {
                rig.load(&files.failing, &mut Vec::new());
            }
        }
        let before = rig.0.network.board(0).chip().flash().cells();
        let from = rig.operations();
        match self {
            Self::Update => {
                rig.begin_download(&files.new, &mut marks);
                rig.load(&files.new, &mut marks);
                rig.start_and_confirm(&mut marks);
            }
            Self::Restore => {
                rig.0.network.power_off(0);
                rig.0.network.power_on(0);
                rig.revive();
            }
            Self::RollBack => {
                assert!(rig.try_control(1).unwrap());
                rig.0.network.run_for(Time::from_s(8));
                rig.revive();
                assert_eq!(rig.number(0x2001, 2), 3, "starts on trial");
            }
        }
        let end = rig.operations();
        marks.extend([from, end]);
        assert_eq!(rig.0.network.board(0).misuse(), None);
        let board = rig.0.network.board(0);
        let chip = board.chip();
        let flash = chip.flash();
        let times = flash.operation_times();
        let is_erase = |at: &u64| {
            let Range { start, end } = times[*at as usize];
            end - start > ERASE
        };
        let before_erase = (from..end).take_while(|at| !is_erase(at)).count();
        let near: Vec<u64> = (from..end).filter(is_erase).chain(marks).collect();
        let decisive = (from..end)
            .filter(|at| near.iter().any(|near| near.abs_diff(*at) <= AROUND))
            .map(|at| at - from)
            .collect();
        let operations = flash.done()[from as usize..].to_vec();
        let mut repeated = before.clone();
        operations.iter().for_each(|done| repeated.repeat(done));
        assert!(repeated.bytes() == flash.bytes(), "the operations are all that has happened");
        Recorded { before, operations, decisive, before_erase }
    }
}

impl Rig {
    /// Stops and clears the program, and sends the first half of a file.
    pub fn begin_download(&mut self, file: &[u8], marks: &mut Vec<u64>) {
        assert!(self.try_control(0).unwrap());
        self.clear_again(marks);
        assert!(!self.try_download(&file[..file.len() / 2]).unwrap(), "it is cut short");
        marks.push(self.operations());
    }

    /// Downloads a file into the loader.
    pub fn load(&mut self, file: &[u8], marks: &mut Vec<u64>) {
        if self.number(0x1F51, 1) == 1 {
            assert!(self.try_control(0).unwrap());
        }
        self.clear_again(marks);
        assert!(self.try_download(file).unwrap());
        marks.push(self.operations());
    }

    fn start_and_confirm(&mut self, marks: &mut Vec<u64>) {
        assert!(self.try_control(1).unwrap());
        self.0.expect("705: 00", Time::from_ms(500));
        marks.push(self.operations());
        assert!(self.try_control(0x80).unwrap());
    }

    fn clear_again(&mut self, marks: &mut Vec<u64>) {
        assert!(self.try_control(3).unwrap());
        assert_eq!(self.try_finish().unwrap(), 0);
        marks.push(self.operations());
    }
}

impl Recorded {
    /// The flash before an operation.
    fn cells(&self, operation: usize) -> Cells {
        let mut cells = self.before.clone();
        self.operations[..operation].iter().for_each(|done| cells.repeat(done));
        cells
    }

    /// A seed with which the word of an operation reads as programmed at the first power-on after the cut, and as before
    /// at the second one: what the first start makes of it has to last.
    fn worst_seed(&self, operation: usize, random: &mut Random) -> u64 {
        let before = self.cells(operation);
        let done = &self.operations[operation];
        let mut after = before.clone();
        after.repeat(done);
        let is_worst = |seed: &u64| {
            let mut cells = before.clone();
            cells.repeat_until_cut(done, true, *seed);
            [&after, &before].into_iter().all(|reads| {
                cells.flip_marginal();
                cells.bytes() == reads.bytes()
            })
        };
        let seeds: Vec<u64> = (0..100).map(|_| random.u64() | 1).collect();
        seeds.iter().copied().find(is_worst).unwrap_or(seeds[0])
    }

    /// Cuts the power in the middle of an operation. The old program, or in an update the new one, runs within 10 s then,
    /// with the settings of before, and after another power-on the same, unless it is on trial. Returns the time that it
    /// took.
    fn cut(&self, operation: usize, seed: u64, files: &Files, may_run: &[&str]) -> Time {
        let mut cells = self.cells(operation);
        let flips = seed & 1 == 1;
        cells.repeat_until_cut(&self.operations[operation], flips, seed);
        let mut rig = Rig::of(rig::board_with(&files.old));
        rig.0.network.permit_misuse();
        rig.0.network.power_off(0);
        {
            let board = rig.0.network.board(0);
            let mut chip = board.chip();
            chip.flash_mut().set_cells(cells);
            chip.flash_mut().set_timing([Timing::Typical, Timing::Worst][seed as usize >> 1 & 1]);
        }
        let (mut longest, mut before) = (Time::ZERO, None);
        for _ in 0..2 {
            rig.0.network.run_for(Time::from_ms(1));
            let from = rig.0.network.now();
            rig.0.network.power_on(0);
            rig.revive();
            longest = longest.max(rig.0.network.now() - from);
            let version = rig.version();
            assert!(may_run.contains(&&*version), "{version}");
            let state = match rig.number(0x2001, 1) {
                // The words of the update before are voided then. One that is cut may read either way: as that update, which
                // was confirmed, or as none. Nothing is pending in either.
                KEPT if operation < self.before_erase => NONE,
                state => state,
            };
            let is_as_before = before.is_none_or(|before| before == (version.clone(), state));
            assert!(is_as_before, "{version}, state {state}");
            before = (state != TRIAL).then_some((version, state));
            rig.check_settings();
            assert_eq!(rig.0.network.board(0).misuse(), None);
            rig.0.network.power_off(0);
        }
        longest
    }
}

/// Cuts the power in all operations of a session. With a number: in the decisive ones, at their worst, and in others up to
/// this number.
fn cut_all(files: &Files, session: Session, number: Option<usize>, random: &mut Random) {
    let recorded = session.record(files);
    let all = recorded.operations.len() as u64;
    let mut chosen = match number {
        None => (0..all).collect(),
        Some(_) => recorded.decisive.clone(),
    };
    while number.is_some_and(|number| chosen.len() < number) {
        chosen.insert(random.within(0..all));
    }
    let mut seed = |at| match number {
        Some(_) if recorded.decisive.contains(&(at as u64)) => recorded.worst_seed(at, random),
        _ => random.u64(),
    };
    let chosen = chosen.into_iter().map(|at| at as usize);
    let cuts: Vec<_> = chosen.map(|at| (at, seed(at))).collect();
    let may_run: &[&str] = match session {
        Session::Update => &["0.1.0", "0.2.0"],
        Session::Restore | Session::RollBack => &["0.1.0"],
    };
    let (mut longest, mut said) = (Time::ZERO, Instant::now());
    let cut = |&(operation, seed): &(usize, u64)| {
        let name = format!("{session:?}, operation {operation} of {all}, seed {seed}");
        let outcome = std::panic::catch_unwind(|| recorded.cut(operation, seed, files, may_run));
        outcome.unwrap_or_else(|_| panic!("{name}"))
    };
    parallel::map(&cuts, cut, |done, time| {
        longest = longest.max(time);
        if said.elapsed() > Duration::from_secs(60) {
            println!("{session:?}: {done} of {} cuts", cuts.len());
            said = Instant::now();
        }
    });
    let [count, ms] = [cuts.len() as u64, longest.as_ms()];
    println!("{session:?}: {count} cuts in {all} operations, a program answers within {ms} ms");
}

const SESSIONS: [Session; 3] = [Session::Update, Session::Restore, Session::RollBack];

#[test]
fn after_a_power_cut_in_a_decisive_operation_the_old_or_the_new_program_runs() {
    let mut random = Random::from_environment();
    for session in SESSIONS {
        cut_all(&Files::small(), session, Some(0), &mut random);
    }
}

#[test]
#[ignore = "a campaign of minutes"]
fn after_a_power_cut_in_any_operation_with_4_kb_the_old_or_the_new_program_runs() {
    let mut random = Random::from_environment();
    for session in SESSIONS {
        cut_all(&Files::small(), session, None, &mut random);
    }
}

#[test]
#[ignore = "a campaign of minutes"]
fn after_a_power_cut_in_1000_operations_with_40_kb_the_old_or_the_new_program_runs() {
    let mut random = Random::from_environment();
    for (session, number) in SESSIONS.into_iter().zip([400, 300, 300]) {
        cut_all(&Files::product(), session, Some(number), &mut random);
    }
}
