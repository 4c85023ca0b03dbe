//! `lss list --watch`: the nodes live, as a table on a terminal and as lines elsewhere.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use can_bus::{bus::Masters, sdo, stop::Stop};
use canopen_node::lss::Request;

use crate::{
    commands::list,
    failure::{Failure, Result},
    network::{
        live::{Network, Node},
        nodes, rows,
    },
    session::{Screen, Session},
};

/// The time between two drawings of the table.
const REFRESH: Duration = Duration::from_millis(250);
/// The lines around the table: two above it, an empty one, and one for the boards that do not fit.
const FRAME: usize = 4;
/// The least number of events that are shown below the table.
const EVENTS: usize = 3;

/// Lists all nodes, and then only listens until Ctrl-C. A node that appears is asked once who it is.
pub fn watch(session: &mut Session, is_json: bool) -> Result {
    session.screen = session.screen.filter(|_| !is_json);
    let start = session.bus.time();
    let mut problems = Vec::new();
    let mut rows = rows::rows(session, &mut problems)?;
    problems.iter().for_each(|problem| session.progress.note(problem));
    // Boards without a node-ID were asked in LSS configuration state.
    session.bus.request(Request::SwitchToWaiting)?;
    session.bus.flush()?;
    if rows.is_empty() {
        // The adapter must not ask later what nobody has heard now.
        session.bus.open(session.bus.rate())?;
    }
    session.all_wait = true;
    // Others may configure the network that is watched.
    session.bus.mind(Masters::None);
    session.progress.clear();
    for row in &mut rows {
        row.state = row.node_id.and_then(|id| rows::heard_state(session, id));
    }
    if is_json {
        writeln!(session.out, "{}", serde_json::json!({ "nodes": rows }))?;
        session.out.flush()?;
    } else if session.screen.is_none() {
        list::print(session, &rows)?;
        if rows.is_empty() {
            let rate = session.bus.rate();
            writeln!(
                session.out,
                "nobody answers at {rate} yet. `lss find` looks for the bit rate"
            )?;
        }
        session.out.flush()?;
    }
    let mut network = Network::new(rows, start);
    for received in session.bus.take_unasked() {
        network.note(&received);
    }
    match listen(session, &mut network, is_json) {
        Err(Failure::Stop(Stop::Interrupted)) => {}
        outcome => return outcome,
    }
    match session.screen {
        Some(_) => Ok(writeln!(session.out)?),
        None => Ok(()),
    }
}

fn listen(session: &mut Session, network: &mut Network, is_json: bool) -> Result {
    let known: Vec<u8> = network.nodes.keys().copied().collect();
    for id in known {
        ask_interval(session, network, id)?;
    }
    let mut shown = VecDeque::new();
    let mut next = session.bus.time();
    loop {
        for received in session.bus.take_unasked() {
            network.note(&received);
        }
        if let Some(id) = network.next_unasked() {
            ask(session, network, id)?;
            continue;
        }
        let now = session.bus.time();
        network.look(now);
        match session.screen {
            Some(size) if now >= next => {
                shown.extend(network.events.drain(..));
                draw(session, size, network, &shown, now)?;
                next = now + REFRESH;
            }
            Some(_) => {}
            None => {
                for (time, words) in network.events.drain(..) {
                    let time = time.as_secs_f64();
                    match is_json {
                        true => {
                            let line = serde_json::json!({ "time": time, "event": words });
                            writeln!(session.out, "{line}")?;
                        }
                        false => writeln!(session.out, "{time:9.3}  {words}")?,
                    }
                }
                session.out.flush()?;
            }
        }
        if let Some(received) = session.bus.receive(now + REFRESH)? {
            network.note(&received);
        }
    }
}

/// Asks a node who it is.
fn ask(session: &mut Session, network: &mut Network, id: u8) -> Result {
    let numbers = nodes::serial_numbers(session, id)?;
    let rows = match numbers.is_empty() {
        true => Vec::new(),
        false => rows::node(session, id, &numbers)?,
    };
    network.identify(id, rows, session.bus.time());
    if !numbers.is_empty() {
        ask_interval(session, network, id)?;
    }
    Ok(())
}

/// Asks a node how often it sends a heartbeat.
fn ask_interval(session: &mut Session, network: &mut Network, id: u8) -> Result {
    if let Ok(ms) = sdo::read_number(&mut session.bus, id, 0x1017, 0)? {
        network.set_interval(id, ms, session.bus.time());
    }
    Ok(())
}

/// Draws the table and the latest events over the ones before.
fn draw(
    session: &mut Session,
    size: Screen,
    network: &Network,
    events: &VecDeque<(Duration, String)>,
    now: Instant,
) -> Result {
    let (width, height) = size();
    let mut rows: Vec<String> = network.nodes.values().map(|node| row(node, now)).collect();
    rows.extend(network.blank.iter().map(|blank| row(&Node::new(blank.clone()), now)));
    let room = usize::from(height).saturating_sub(FRAME + EVENTS).max(1);
    let hidden = rows.len().saturating_sub(room);
    rows.truncate(room);
    if hidden > 0 {
        rows.push(format!("and {hidden} more: make the window higher, or write to a file"));
    }
    let rate = session.bus.rate();
    let here = network.nodes.values().filter(|node| !node.is_gone).count();
    let mut lines = vec![
        format!(
            "{rate}, nodes: {here}, boards without a node-ID: {}. Ctrl-C ends",
            network.blank.len()
        ),
        line([
            "node-ID",
            "NMT state",
            "heartbeat",
            "boot-ups",
            "kbit/s",
            "serial",
            "name",
            "last emergency",
        ]),
    ];
    lines.extend(rows);
    lines.push(String::new());
    let rest = usize::from(height).saturating_sub(lines.len());
    let skipped = events.len().saturating_sub(rest);
    for (time, words) in events.iter().skip(skipped) {
        lines.push(format!("{:9.3}  {words}", time.as_secs_f64()));
    }
    let cut = |line: &String| -> String { line.chars().take(width.into()).collect() };
    let text: Vec<String> = lines.iter().map(cut).collect();
    // To the first place; each line clears the rest of its own, and the last one what is below.
    write!(session.out, "\x1B[H{}\x1B[K\x1B[J", text.join("\x1B[K\n"))?;
    session.out.flush()?;
    Ok(())
}

fn row(node: &Node, now: Instant) -> String {
    let age = |at| format!("{:.1} s", now.saturating_duration_since(at).as_secs_f64());
    let state = if node.is_gone { "vanished" } else { node.row.state.unwrap_or("-") };
    let serial = node.row.lss_address.map(|address| format!("{:08X}", address.serial_number));
    let emergency = node.last_emergency.as_ref();
    let emergency = emergency.map(|words| format!("{words} ({})", node.emergencies));
    let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".into());
    line([
        &node.row.id_text(),
        state,
        &or_dash(node.last_heartbeat.map(age)),
        &node.boot_ups.to_string(),
        &node.row.bit_rate_text(),
        &or_dash(serial),
        &or_dash(node.row.name.clone()),
        &emergency.unwrap_or_default(),
    ])
}

fn line(cells: [&str; 8]) -> String {
    let [id, state, heartbeat, boot_ups, rate, serial, name, emergency] = cells;
    let text = format!(
        "{id:7}  {state:15}  {heartbeat:>9}  {boot_ups:>8}  {rate:6}  {serial:8}  {name:16}  {emergency}"
    );
    text.trim_end().to_owned()
}
