//! `lss blink`: shows a person which board it is.

use std::time::Duration;

use canopen_node::{NodeId, lss::Address};
use lss_master::InquireNodeId;

use crate::{
    address::{self, Which},
    arguments::Target,
    commands::one_board::choose,
    failure::Failure,
    network::{nodes, rows},
    session::{GLANCE, Session},
};

/// How long the board shows itself if there is nobody to press Enter.
const ALONE: Duration = Duration::from_secs(10);

/// Keeps a board in LSS configuration state, in which both LEDs flicker in turn (CiA 303-3).
pub fn blink(session: &mut Session<'_>, which: Which) -> Result<(), Failure> {
    let address = match which {
        Which::Address(address) => address,
        Which::Node(id) => address_of(session, id)?,
    };
    choose(session, Target { address: Some(address) })?;
    let id = session.carry_out(InquireNodeId)?;
    let is_attended = session.person.is_there();
    let board = match id {
        Some(id) => format!("node {}", id.get()),
        None => "board".into(),
    };
    let until = match is_attended {
        true => "until you press Enter",
        false => "for 10 s",
    };
    session.progress.clear();
    writeln!(
        session.out,
        "{board}  {}  both LEDs flicker in turn {until}",
        address::text(&address)
    )?;
    if id.is_none() {
        writeln!(
            session.out,
            "it has no node-ID: all boards of this repository without one flicker. `lss assign` gives it one first"
        )?;
    }
    session.out.flush()?;
    let Session { bus, person, .. } = session;
    if is_attended {
        person.answer(|| bus.pass(GLANCE).map(|()| true))?;
    } else {
        bus.pass(ALONE)?;
    }
    Ok(())
}

/// The LSS address of the only node with this node-ID.
fn address_of(session: &mut Session<'_>, id: NodeId) -> Result<Address, Failure> {
    let id = id.get();
    let numbers = nodes::serial_numbers(session, id)?;
    if numbers.is_empty() {
        return Err(Failure::NoAnswer(format!(
            "node {id} does not answer at {}. `lss list` shows who is there",
            session.bus.rate()
        )));
    }
    let rows = rows::node(session, id, &numbers)?;
    match &rows[..] {
        [row] => row.lss_address.ok_or_else(|| {
            Failure::Refused(format!("node {id} does not tell its LSS address by object 1018h"))
        }),
        _ => Err(Failure::Refused(format!(
            "{} boards have node-ID {id}: `lss blink` with the LSS address of one, which `lss list` shows",
            rows.len()
        ))),
    }
}
