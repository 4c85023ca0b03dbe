//! `lss set-id`: a node-ID for one board.

use can_bus::sdo;
use canopen_node::{NodeId, lss::Request};
use lss_master::InquireNodeId;

use crate::{
    address::{self, Assigned, id_text},
    arguments::Target,
    commands::one_board::choose,
    failure::Failure,
    network::board::{Gift, RESET_COMMUNICATION, configure, give, take_effect},
    session::Session,
};

/// Makes a node-ID pending, and says when it takes effect. With `stores`, it stays after a power cut. With `resets`, it
/// takes effect at once on a board that has another node-ID.
pub fn set_id(
    session: &mut Session<'_>,
    Assigned(id): Assigned,
    target: Target,
    stores: bool,
    resets: bool,
) -> Result<(), Failure> {
    let address = choose(session, target)?;
    let before = session.carry_out(InquireNodeId)?;
    if let Some(id) = id
        && before != Some(id)
        && is_taken(session, id)?
    {
        return Err(Failure::Refused(format!(
            "another node has the node-ID {}: two with one node-ID disturb each other. Nothing was changed",
            id.get()
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
    let board = format!("board {}", address::text(&address));
    outcome.map_err(|failure| match failure {
        Failure::Refused(why) => Failure::Refused(format!("{board}: {why}")),
        failure => failure,
    })?;
    let kept = if stores { ", stored" } else { ", until a power cut: `lss store` keeps it" };
    if let (Some(before), false) = (before.filter(|_| before != id), takes_effect) {
        let (before, id) = (before.get(), id_text(id));
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
fn is_taken(session: &mut Session<'_>, id: NodeId) -> Result<bool, Failure> {
    let cob_id = u16::from(id.get());
    session.bus.send_to(0x600 + cob_id, &sdo::read_request(0x1000, 0))?;
    let wait = session.bus.short();
    let answer = session.bus.wait_for(wait, |frame| frame.cob_id() == 0x580 + cob_id)?;
    Ok(answer.is_some() || session.bus.states.contains_key(&id.get()))
}
