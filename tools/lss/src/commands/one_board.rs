//! `lss inquire`, and the choice of the board that a command is for.

use std::time::Duration;

use canopen_node::lss::{Address, AddressPart, RESPONSE_COB_ID, Request};
use lss_master::{InquireAddress, InquireNodeId, SelectAlone};

use crate::{
    address::{self, id_text},
    arguments::Target,
    failure::Failure,
    session::Session,
};

/// Prints the LSS address and the node-ID of a board.
pub fn inquire(session: &mut Session<'_>, target: Target) -> Result<(), Failure> {
    choose(session, target)?;
    let address = session.carry_out(InquireAddress::new())?;
    let node_id = session.carry_out(InquireNodeId)?;
    let Address { vendor_id, product_code, revision_number, serial_number } = address;
    writeln!(session.out, "LSS address      {}", address::text(&address))?;
    writeln!(session.out, "vendor-ID        {vendor_id:08X}h")?;
    writeln!(session.out, "product code     {product_code:08X}h")?;
    writeln!(session.out, "revision number  {revision_number:08X}h")?;
    writeln!(session.out, "serial number    {serial_number:08X}h = {serial_number}")?;
    writeln!(session.out, "node-ID          {}", id_text(node_id))?;
    writeln!(session.out, "bit rate         {}", session.bus.rate())?;
    Ok(())
}

/// Brings the board that is meant to LSS configuration state, and all others to LSS waiting state.
pub fn choose(session: &mut Session<'_>, target: Target) -> Result<Address, Failure> {
    let address = match target.address {
        Some(address) => address,
        None => only(session)?,
    };
    let rate = session.bus.rate();
    session.carry_out(SelectAlone::new(address)).map_err(|failure| match failure {
        Failure::NoAnswer(_) => Failure::NoAnswer(format!(
            "no board with the LSS address {} answers at {rate}. Is the bit rate right (--bit-rate)?",
            address::text(&address)
        )),
        failure => failure,
    })?;
    Ok(address)
}

/// The LSS address of the only board. Boards that differ answer one after the other, and are all told.
fn only(session: &mut Session<'_>) -> Result<Address, Failure> {
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
fn all_answers(session: &mut Session<'_>, part: AddressPart) -> Result<Vec<u32>, Failure> {
    let request = Request::Inquire(part);
    let [specifier, ..] = request.to_bytes();
    let is_answer = |frame: &canopen_node::Frame| {
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

fn nobody(session: &mut Session<'_>, part: AddressPart) -> Result<Failure, Failure> {
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
    let name = match part {
        AddressPart::VendorId => "vendor-IDs",
        AddressPart::ProductCode => "product codes",
        AddressPart::RevisionNumber => "revision numbers",
        AddressPart::SerialNumber => "serial numbers",
    };
    Failure::Refused(format!(
        "several boards answer, with the {name} {}: choose one with --address",
        address::parts(answers)
    ))
}
