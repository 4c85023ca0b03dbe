//! `lss list`: every node, with and without a node-ID.

use crate::{
    address,
    failure::Failure,
    network::rows::{self, Row},
    session::Session,
};

/// Prints a row for each node, as a table or as JSON.
pub fn list(session: &mut Session<'_>, is_json: bool) -> Result<(), Failure> {
    let rows = rows::rows(session)?;
    session.progress.clear();
    if rows.is_empty() {
        return Err(Failure::nobody(session.bus.rate()));
    }
    if is_json {
        let rate = session.bus.rate().kbit_per_s();
        let network = serde_json::json!({ "bit_rate": rate, "nodes": rows });
        writeln!(session.out, "{network:#}")?;
    } else {
        print(session, &rows)?;
    }
    let duplicates = rows.iter().filter(|row| row.is_duplicate);
    let duplicates = duplicates.filter_map(|row| row.lss_address.as_ref());
    let mut duplicates: Vec<String> = duplicates.map(address::text).collect();
    let mut problems = rows::twins(&rows);
    duplicates.retain(|address| !problems.iter().any(|problem| problem.contains(address)));
    if !duplicates.is_empty() {
        problems.push(format!(
            "boards share a node-ID: give all but one another, with `lss set-id ID --reset --address` and one of {}",
            duplicates.join(", ")
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

/// Prints the table.
pub fn print(session: &mut Session<'_>, rows: &[Row]) -> Result<(), Failure> {
    let mut line = |cells: [&str; 6]| {
        let [id, address, name, version, state, rate] = cells;
        let text = format!("{id:7}  {address:35}  {name:16}  {version:8}  {state:15}  {rate}");
        writeln!(session.out, "{}", text.trim_end())
    };
    line(["node-ID", "LSS address", "name", "version", "NMT state", "kbit/s"])?;
    for row in rows {
        let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".into());
        line([
            &row.id_text(),
            &or_dash(row.lss_address.as_ref().map(address::text)),
            &or_dash(row.name.clone()),
            &or_dash(row.version.clone()),
            row.state.unwrap_or("-"),
            &row.bit_rate_text(),
        ])?;
    }
    Ok(())
}
