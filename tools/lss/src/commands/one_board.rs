//! The commands for one board: inquire, set-id, store, blink, identify and raw.

use std::time::Duration;

use can_bus::sdo;
use canopen_node::{
    Frame, NodeId,
    lss::{Address, AddressPart, REQUEST_COB_ID, RESPONSE_COB_ID, Request},
};
use lss_master::{Find, Identify, InquireAddress, InquireNodeId, SelectAlone};

use crate::{
    address::{self, Assigned, Which, counted, id_text},
    arguments::{Ranges, Target},
    failure::{Failure, Result},
    network::{
        board::{Gift, RESET_COMMUNICATION, configure, give, take_effect},
        nodes, rows, scan,
    },
    recorder,
    session::{GLANCE, Session},
};

/// How long the board shows itself if there is nobody to press Enter.
const ALONE: Duration = Duration::from_secs(10);

/// Prints the LSS address and the node-ID of a board.
pub fn inquire(session: &mut Session, target: Target) -> Result {
    choose(session, target)?;
    let address = session.carry_out(InquireAddress::new())?;
    let node_id = session.carry_out(InquireNodeId)?;
    let rate = session.bus.rate();
    session.found(&serde_json::json!({
        "lss_address": address.to_string(),
        "node_id": node_id.map(NodeId::get),
        "bit_rate": rate.kbit_per_s(),
    }))?;
    let Address { vendor_id, product_code, revision_number, serial_number } = address;
    writeln!(session.out, "LSS address      {address}")?;
    writeln!(session.out, "vendor-ID        {vendor_id:08X}h")?;
    writeln!(session.out, "product code     {product_code:08X}h")?;
    writeln!(session.out, "revision number  {revision_number:08X}h")?;
    writeln!(session.out, "serial number    {serial_number:08X}h = {serial_number}")?;
    writeln!(session.out, "node-ID          {}", id_text(node_id))?;
    Ok(writeln!(session.out, "bit rate         {rate}")?)
}

/// Makes a node-ID pending, and says when it takes effect. With `stores`, it stays after a power cut. With `resets`, it
/// takes effect at once on a board that has another node-ID.
pub fn set_id(
    session: &mut Session,
    Assigned(id): Assigned,
    target: Target,
    stores: bool,
    resets: bool,
) -> Result {
    let address = choose(session, target)?;
    let before = session.carry_out(InquireNodeId)?;
    if let Some(id) = id
        && before != Some(id)
        && is_taken(session, id)?
    {
        return Err(Failure::Refused(format!(
            "another node has the node-ID {id}: two with one node-ID disturb each other. Nothing was changed"
        )));
    }
    let gift = Gift { address, before, to: id, rate: None };
    let takes_effect = before != id && (before.is_none() || resets);
    let outcome = match stores && takes_effect {
        true => give(session, gift).map(drop),
        false => session.uninterrupted(|session| {
            configure(session, gift, stores)?;
            session.bus.request(Request::SwitchToWaiting)?;
            match takes_effect {
                true => take_effect(session, gift, RESET_COMMUNICATION).map(drop),
                false => Ok(()),
            }
        }),
    };
    let board = format!("board {address}");
    outcome.map_err(|failure| match failure {
        Failure::Refused(why) => Failure::Refused(format!("{board}: {why}")),
        failure => failure,
    })?;
    session.found(&serde_json::json!({
        "lss_address": address.to_string(),
        "node_id": id.map(NodeId::get),
        "is_in_use": takes_effect || before == id,
        "is_stored": stores,
    }))?;
    let kept = if stores { ", stored" } else { ", until a power cut: `lss store` keeps it" };
    if let (Some(before), false) = (before.filter(|_| before != id), takes_effect) {
        let id = id_text(id);
        writeln!(
            session.out,
            "{board}: node-ID {before}, and {id} from NMT reset communication on (--reset){kept}"
        )?;
        return Ok(());
    }
    writeln!(session.out, "{board}: node-ID {}{kept}", id_text(id))?;
    Ok(session.bus.check_interrupt()?)
}

/// Whether a node answers with this node-ID, or sends of its own accord. Reads object 1000h, which every node has.
fn is_taken(session: &mut Session, id: NodeId) -> Result<bool> {
    let cob_id = u16::from(id.get());
    session.bus.send_to(0x600 + cob_id, &sdo::read_request(0x1000, 0))?;
    let wait = session.bus.short();
    let answer = session.bus.wait_for(wait, |frame| frame.cob_id() == 0x580 + cob_id)?;
    Ok(answer.is_some() || session.bus.heard.contains_key(&id.get()))
}

/// Stores the pending node-ID and bit rate of a board.
pub fn store(session: &mut Session, target: Target) -> Result {
    let address = choose(session, target)?;
    session.carry_out(Request::StoreConfiguration)?;
    writeln!(session.out, "board {address}: node-ID and bit rate stored")?;
    Ok(())
}

/// Keeps a board in LSS configuration state, in which both LEDs flicker in turn (CiA 303-3).
pub fn blink(session: &mut Session, which: Which) -> Result {
    let address = match which {
        Which::Address(address) => address,
        Which::Node(id) => address_of(session, id)?,
    };
    choose(session, Target { address: Some(address) })?;
    let id = session.carry_out(InquireNodeId)?;
    let is_attended = session.person.is_present();
    let board = match id {
        Some(id) => format!("node {id}"),
        None => "board".into(),
    };
    let until = match is_attended {
        true => "until you press Enter",
        false => "for 10 s",
    };
    session.progress.clear();
    writeln!(session.out, "{board}  {address}  both LEDs flicker in turn {until}")?;
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
fn address_of(session: &mut Session, id: NodeId) -> Result<Address> {
    let id = id.get();
    let numbers = nodes::serial_numbers(session, id)?;
    if numbers.is_empty() {
        return Err(Failure::NoAnswer(format!(
            "node {id} does not answer at {}. `lss list` shows who answers",
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

/// Says whether a board is within the ranges, or which ones are.
pub fn identify(session: &mut Session, ranges: &Ranges) -> Result {
    let mut within = Identify {
        vendor_id: ranges.vendor,
        product_code: ranges.product,
        revision_numbers: ranges.revision.clone(),
        serial_numbers: ranges.serial.clone(),
    };
    session.found(&serde_json::json!({ "answers": false }))?;
    if !session.carry_out(within.clone())? {
        return Err(Failure::NoAnswer(format!(
            "no board within these ranges answers at {}. Is the bit rate right (--bit-rate)? Some slaves do not support \
             identify remote slave",
            session.bus.rate()
        )));
    }
    if !ranges.each {
        session.found(&serde_json::json!({ "answers": true }))?;
        return Ok(writeln!(session.out, "a board within these ranges answers")?);
    }
    let mut boards: Vec<String> = Vec::new();
    loop {
        session.found(&serde_json::json!({ "answers": true, "boards": boards }))?;
        session.progress.say(|| format!("{} found", counted(boards.len(), "board")));
        let Some(found) = session.carry_out(Find::new(within.clone()))? else { return Ok(()) };
        writeln!(session.out, "{found}")?;
        boards.push(found.to_string());
        scan::check_count(boards.len(), "identify remote slave")?;
        let Some(next) = found.serial_number.checked_add(1) else { return Ok(()) };
        within.serial_numbers = next..=*within.serial_numbers.end();
        if within.serial_numbers.is_empty() {
            return Ok(());
        }
    }
}

/// Sends a request and prints it and each answer, with their meaning.
pub fn raw(session: &mut Session, bytes: &[u8]) -> Result {
    let mut data = [0; 8];
    for (to, from) in data.iter_mut().zip(bytes) {
        *to = *from;
    }
    let Some(request) = Frame::new(REQUEST_COB_ID, &data) else { return Ok(()) };
    writeln!(session.out, "{}", recorder::words(&request))?;
    session.bus.send(&request)?;
    let patience = session.bus.patience();
    let is_answer = |frame: &Frame| frame.cob_id() == RESPONSE_COB_ID;
    while let Some(answer) = session.bus.wait_for(patience, is_answer)? {
        writeln!(session.out, "{}", recorder::words(&answer.frame))?;
    }
    Ok(())
}

/// Brings the board that is meant to LSS configuration state, and all others to LSS waiting state.
pub fn choose(session: &mut Session, target: Target) -> Result<Address> {
    let address = match target.address {
        Some(address) => address,
        None => only(session)?,
    };
    let rate = session.bus.rate();
    session.carry_out(SelectAlone::new(address)).map_err(|failure| match failure {
        Failure::NoAnswer(_) => Failure::NoAnswer(format!(
            "no board with the LSS address {address} answers at {rate}. Is the bit rate right (--bit-rate)?"
        )),
        failure => failure,
    })?;
    Ok(address)
}

/// The LSS address of the only board. Boards that differ answer one after the other, and are all told.
fn only(session: &mut Session) -> Result<Address> {
    session.bus.request(Request::SwitchToConfiguration)?;
    let mut numbers = [0; 4];
    for (number, part) in numbers.iter_mut().zip((0..).map_while(AddressPart::new)) {
        let answers = all_answers(session, part)?;
        *number = match answers[..] {
            [one] => one,
            [] => return Err(nobody(session, part)?),
            _ => return Err(several(&answers, part)),
        };
    }
    Ok(numbers.into())
}

/// The different numbers that boards in LSS configuration state answer.
fn all_answers(session: &mut Session, part: AddressPart) -> Result<Vec<u32>> {
    let request = Request::Inquire(part);
    let [specifier, ..] = request.to_bytes();
    let is_answer = |frame: &Frame| {
        frame.cob_id() == RESPONSE_COB_ID && frame.data().first() == Some(&specifier)
    };
    session.bus.request(request)?;
    let mut wait: Duration = session.bus.patience();
    let mut answers = Vec::new();
    while let Some(received) = session.bus.wait_for(wait, is_answer)? {
        if let &[_, a, b, c, d, ..] = received.frame.data() {
            answers.push(u32::from_le_bytes([a, b, c, d]));
        }
        // Others are not much slower.
        wait = session.bus.short();
    }
    answers.sort_unstable();
    answers.dedup();
    Ok(answers)
}

fn nobody(session: &mut Session, part: AddressPart) -> Result<Failure> {
    let rate = session.bus.rate();
    if part != AddressPart::VendorId {
        return Ok(Failure::NoAnswer(format!("the board falls silent: no answer to {part:?}")));
    }
    let status = session.bus.status()?.unwrap_or_default();
    Ok(Failure::NoAnswer(match status.has_errors || status.is_error_passive {
        true => format!(
            "nobody takes part in the bus at {rate}. Has the board power? Is the bit rate right (--bit-rate)? Are CANH, \
             CANL and ground connected, with 60 ohm between CANH and CANL?"
        ),
        false => format!(
            "no LSS slave answers at {rate}. Is the bit rate right (--bit-rate)? Is the board one with LSS, and not \
             locked while NMT operational?"
        ),
    }))
}

fn several(answers: &[u32], part: AddressPart) -> Failure {
    let numbers = address::parts(answers);
    Failure::Refused(format!(
        "several boards answer, with the {part}s {numbers}: choose one with --address"
    ))
}
