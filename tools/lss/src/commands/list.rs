//! `lss list`: every node, with and without a node-ID.

use canopen_node::NodeId;
use lss_master::InquireNodeId;

use super::one_board::choose;
use crate::{
    address,
    arguments::Target,
    failure::{Failure, Result},
    network::rows::{self, Row},
    session::Session,
};

/// Prints a row for each node. A node that does not tell its LSS address is asked for it by LSS if
/// it `asks`.
pub fn list(session: &mut Session, asks: bool) -> Result {
    let mut problems = Vec::new();
    let mut rows = rows::rows(session, &mut problems)?;
    for row in rows.iter_mut().filter(|row| asks && row.lss_address.is_none()) {
        let asked = choose(session, Target { address: None });
        match asked.and_then(|address| Ok((address, session.carry_out(InquireNodeId)?))) {
            Ok((address, id)) if id.map(NodeId::get) == row.node_id => {
                row.lss_address = Some(address);
            }
            Err(Failure::NoAnswer(_)) => {
                problems.push(format!("{} does not answer to LSS", row.words()))
            }
            Err(stop @ Failure::Stop(_)) => return Err(stop),
            // Others answer, too.
            _ => problems.push(format!(
                "{} can be asked for its LSS address only alone on the bus",
                row.words()
            )),
        }
    }
    session.progress.clear();
    if rows.is_empty() {
        Failure::of(&problems)?;
        return Err(Failure::nobody(session.bus.rate()));
    }
    let rate = session.bus.rate().kbit_per_s();
    session.found(&serde_json::json!({ "bit_rate": rate, "nodes": rows }))?;
    print(session, &rows)?;
    problems.extend(rows::twins(&rows));
    let is_named = |address: &String| problems.iter().any(|problem| problem.contains(address));
    let duplicates = rows.iter().filter(|row| row.is_duplicate && row.lss_address.is_some());
    let duplicates = duplicates.map(Row::address_text).filter(|address| !is_named(address));
    let duplicates = address::list(duplicates);
    if !duplicates.is_empty() {
        problems.push(format!(
            "boards share a node-ID: give all but one another, with `lss set-id ID --reset --address` and one of {duplicates}"
        ));
    }
    Failure::of(&problems)?;
    match rows.iter().any(|row| row.is_duplicate) {
        true => Err(Failure::Refused(
            "boards share a node-ID, and do not tell their LSS addresses: take all but one off the bus".into(),
        )),
        false => Ok(()),
    }
}

/// Prints the table, within the width of a terminal.
pub fn print(session: &mut Session, rows: &[Row]) -> Result {
    let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".into());
    let id = if session.screen.is_some() { "ID" } else { "node-ID" };
    let head = [id, "LSS address", "name", "version", "NMT state", "kbit/s"];
    let mut lines = vec![head.map(str::to_owned)];
    lines.extend(rows.iter().map(|row| {
        [
            row.id_text(),
            row.address_text(),
            or_dash(row.name.clone()),
            or_dash(row.version.clone()),
            row.state.unwrap_or("-").to_owned(),
            row.bit_rate_text(),
        ]
    }));
    let (mut widths, mut limit) = ([7, 35, 16, 8, 15, 0], usize::MAX);
    if let Some(screen) = session.screen {
        limit = screen().0.into();
        let longest = |column: usize| lines.iter().map(|cells| cells[column].chars().count()).max();
        widths = std::array::from_fn(|column| longest(column).unwrap_or(0));
        // The name gives way, and then the version.
        for (column, least) in [(2, 5), (3, 5)] {
            let over = (widths.iter().sum::<usize>() + 10).saturating_sub(limit);
            widths[column] = widths[column].saturating_sub(over).max(least.min(widths[column]));
        }
    }
    for cells in lines {
        let cell = |(text, width): (&String, usize)| match session.screen {
            Some(_) => format!("{text:width$.width$}"),
            None => format!("{text:width$}"),
        };
        let line = cells.iter().zip(widths).map(cell).collect::<Vec<_>>().join("  ");
        let line: String = line.chars().take(limit).collect();
        writeln!(session.out, "{}", line.trim_end())?;
    }
    Ok(())
}
