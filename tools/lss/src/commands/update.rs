//! `lss update`: installs a program on one board after the other, each with a way back. Once it runs on one, the next
//! boards clear ahead.

use can_bus::{person, sdo};
use canopen_node::{BitRate, NodeId};
use program_update::{Release, header::HEADER_LEN};
use serde::Serialize;

use crate::{
    arguments::Update,
    failure::{Failure, Result},
    network::{
        loader::{Fate, Loader},
        nodes,
        rows::{self, Row},
    },
    plan::update_file::{Description, UpdateFile},
    session::Session,
};

/// The object with the hardware version.
const HARDWARE: u16 = 0x1009;
/// How often a node that was named is asked: a transfer of an earlier run ends after a second.
const ATTEMPTS: usize = 10;

/// What became of a board.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
enum Outcome {
    Installed,
    /// It had the program on trial.
    Confirmed,
    Present,
    LeftAlone,
    /// It has refused the header.
    Refused,
    ProgramFailed,
    Failed,
}

/// A board on the bus, and what became of it.
#[derive(Serialize)]
struct Board {
    #[serde(flatten)]
    row: Row,
    outcome: Outcome,
    why: Option<String>,
}

/// The report as JSON.
#[derive(Serialize)]
struct Report<'a> {
    file: Description,
    boards: &'a [Board],
}

/// Installs the file on the boards with these node-IDs, or on all that it is for.
pub fn update(session: &mut Session, arguments: &Update) -> Result {
    let file = UpdateFile::read(&arguments.file)?;
    let rows = match arguments.nodes[..] {
        [] => rows_of_all(session)?,
        _ => rows_of(session, &arguments.nodes)?,
    };
    let mut boards = Vec::new();
    for row in rows {
        let mut why = misfit(session, &file, &row)?;
        if why.is_none() && !arguments.yes {
            why = step_back(session, &file, &row)?;
        }
        boards.push(Board { row, outcome: Outcome::LeftAlone, why });
    }
    session.progress.clear();
    writeln!(session.out, "{}", file.words())?;
    let misfits = boards.iter().filter(|board| board.why.is_some());
    let misfits: Vec<String> = misfits.map(Board::line).collect();
    if misfits.len() == boards.len() || !arguments.nodes.is_empty() && !misfits.is_empty() {
        return Err(Failure::Refused(format!("{}\nNothing was changed", misfits.join("\n"))));
    }
    for line in misfits {
        writeln!(session.out, "{line}")?;
    }
    let outcome = install_all(session, &file, &mut boards);
    session.progress.clear();
    session.found(&Report { file: file.description(), boards: &boards })?;
    if let Err(Failure::Stop(_)) = outcome {
        writeln!(session.out, "not finished: start `lss update` again, and it goes on")?;
    }
    outcome?;
    let failed = boards.iter().filter(|board| {
        matches!(board.outcome, Outcome::Refused | Outcome::ProgramFailed | Outcome::Failed)
    });
    let problems: Vec<String> = failed.map(Board::line).collect();
    Failure::of(&problems)
}

/// Installs the file on each board that it is for. The others do not get one that has failed or was refused on one.
fn install_all(session: &mut Session, file: &UpdateFile, boards: &mut [Board]) -> Result {
    let mut fitting: Vec<(NodeId, &mut Board)> = boards
        .iter_mut()
        .filter(|board| board.why.is_none())
        .filter_map(|board| Some((board.row.node_id.and_then(NodeId::new)?, board)))
        .collect();
    let all = fitting.len();
    let who = |at: usize, id: NodeId| format!("node {id} ({} of {all})", at + 1);
    let ids: Vec<NodeId> = fitting.iter().map(|(id, _)| *id).collect();
    let ahead = ahead(file, session.bus.rate());
    // The number of boards that had their turn or were let clear, and those of the latter.
    let (mut begun, mut clearing) = (0, Vec::new());
    let (mut is_proven, mut bad) = (false, None);
    for (at, (id, board)) in fitting.iter_mut().enumerate() {
        let who_it_is = who(at, *id);
        if let Some(what) = bad {
            let mut why = format!("{what} another board");
            if clearing.contains(id) {
                why += ". Now ";
                why += Loader::new(session, *id, &who_it_is).go_back()?;
            }
            board.why = Some(why);
            session.progress.clear();
            writeln!(session.out, "{}", board.line())?;
            continue;
        }
        begun = begun.max(at + 1);
        while is_proven && begun < all.min(at + 1 + ahead) {
            let next = ids[begun];
            if begin(session, file, next, &who(begun, next))? {
                clearing.push(next);
            }
            begun += 1;
        }
        (board.outcome, board.why) = match install(session, file, *id, &who_it_is) {
            Ok(outcome) => outcome,
            Err(failure) => (Outcome::Failed, Some(failure.of_board()?)),
        };
        bad = match board.outcome {
            Outcome::ProgramFailed => Some("the program has failed on"),
            Outcome::Refused => Some("the file was refused by"),
            _ => None,
        };
        is_proven |= board.why.is_none();
        if board.why.is_none() {
            let was_operational = board.row.state == Some("operational");
            session.progress.clear();
            let version = program_update::header::text_of(&file.header.version);
            let before = board.row.version.as_deref().unwrap_or("-");
            let mut words = match board.outcome {
                Outcome::Installed => format!("{before} -> {version}, confirmed"),
                Outcome::Confirmed => format!("{version}, was on trial: confirmed"),
                _ => format!("{version}, has it already"),
            };
            if was_operational && board.outcome == Outcome::Installed {
                words += ", pre-operational since the reset";
            }
            writeln!(session.out, "{}  {words}", board.row.name())?;
            session.out.flush()?;
        }
    }
    Ok(())
}

/// How many boards clear while another one takes the program: a clear takes as long as some downloads, and a loader
/// that is not asked for 60 s goes back.
fn ahead(file: &UpdateFile, rate: BitRate) -> usize {
    // A segment has 7 bytes in some 130 bits.
    let download_ms = file.bytes.len() * 19 / usize::from(rate.kbit_per_s());
    match download_ms {
        ..2_000 => 4,
        2_000..20_000 => 1,
        _ => 0,
    }
}

/// Lets a board clear whose turn comes soon; returns whether it may have begun. What fails is told in its turn.
fn begin(session: &mut Session, file: &UpdateFile, id: NodeId, who: &str) -> Result<bool> {
    let mut loader = Loader::new(session, id, who);
    let outcome = loader.begin(file.header.crc, &file.bytes[..HEADER_LEN]);
    outcome.or_else(|failure| failure.of_board().map(|_| true))
}

/// Installs the file on a board; goes back to the program before if that fails.
fn install(
    session: &mut Session,
    file: &UpdateFile,
    id: NodeId,
    who: &str,
) -> Result<(Outcome, Option<String>)> {
    let crc = file.header.crc;
    let mut loader = Loader::new(session, id, who);
    let installed = loader.installed()?;
    let is_started = installed.crc == crc && installed.runs;
    if is_started && !installed.is_on_trial {
        return Ok((Outcome::Present, None));
    }
    if installed.crc != crc {
        if installed.runs {
            loader.stop()?;
        }
        let checked = loader.check(&file.bytes[..HEADER_LEN]);
        let failed = if checked.is_err() { Outcome::Refused } else { Outcome::Failed };
        let outcome = checked.and_then(|()| loader.install(&file.bytes));
        if let Err(Failure::Refused(why)) = outcome {
            let back = loader.go_back()?;
            return Ok((failed, Some(format!("{why}. Now {back}"))));
        }
        outcome?;
    }
    // A program that nobody confirms would be taken back.
    let fate = session.uninterrupted(|session| {
        let mut loader = Loader::new(session, id, who);
        if is_started { loader.confirm(crc) } else { loader.start(crc) }
    })?;
    Ok(match fate {
        Fate::Confirmed if is_started => (Outcome::Confirmed, None),
        Fate::Confirmed => (Outcome::Installed, None),
        Fate::Failed(why) => (Outcome::ProgramFailed, Some(why)),
    })
}

/// All nodes that answer.
fn rows_of_all(session: &mut Session) -> Result<Vec<Row>> {
    let nodes = nodes::nodes(session)?;
    match nodes.is_empty() {
        true => Err(Failure::nobody(session.bus.rate())),
        false => rows::of(session, nodes),
    }
}

/// The nodes with these node-IDs.
fn rows_of(session: &mut Session, ids: &[NodeId]) -> Result<Vec<Row>> {
    let mut rows = Vec::new();
    for id in ids {
        let id = id.get();
        let mut numbers = Vec::new();
        for _ in 0..ATTEMPTS {
            numbers = nodes::serial_numbers(session, id)?;
            if !numbers.is_empty() {
                break;
            }
        }
        if numbers.is_empty() {
            return Err(Failure::NoAnswer(format!(
                "node {id} does not answer at {}. `lss list` shows who answers. Nothing was changed",
                session.bus.rate()
            )));
        }
        rows.extend(rows::node(session, id, &numbers)?);
    }
    Ok(rows)
}

/// Why the file is not for a board.
fn misfit(session: &mut Session, file: &UpdateFile, row: &Row) -> Result<Option<String>> {
    let Some(id) = row.node_id.and_then(NodeId::new) else { return Ok(None) };
    if row.is_duplicate {
        return Ok(Some("another board has the same node-ID".into()));
    }
    let Some(address) = row.lss_address else {
        return Ok(Some("it does not tell which product it is (1018h)".into()));
    };
    let hardware = sdo::read(&mut session.bus, id.get(), HARDWARE, 0)?.unwrap_or_default();
    let hardware = String::from_utf8_lossy(&hardware);
    if let Some(why) = file.misfit(&address, hardware.trim_end_matches('\0')) {
        return Ok(Some(why));
    }
    Loader::new(session, id, "").misses()
}

/// Why a board with a later version keeps it, unless the person wants the lower one.
fn step_back(session: &mut Session, file: &UpdateFile, row: &Row) -> Result<Option<String>> {
    let version = row.version.as_deref().unwrap_or_default();
    if Release::parse(version).is_none_or(|release| release <= file.header.release) {
        return Ok(None);
    }
    let question = format!(
        "{} has the later version {version}. Does it go back to {}? [y = yes, Enter = no: it is left alone]",
        row.name(),
        file.header.release
    );
    let is_wanted = session.ask(&question)?.is_some_and(|answer| person::is_yes(&answer));
    Ok((!is_wanted).then(|| format!("it has the later version {version}: with --yes it goes back")))
}

impl Row {
    /// Which board it is.
    fn name(&self) -> String {
        format!("node {}  {}", self.id_text(), self.address_text())
    }
}

impl Board {
    /// The same, and why it was left alone or failed.
    fn line(&self) -> String {
        let why = self.why.as_deref().unwrap_or_default();
        match self.outcome {
            Outcome::LeftAlone => format!("{}  left alone: {why}", self.row.name()),
            _ => format!("{}  {why}", self.row.name()),
        }
    }
}
