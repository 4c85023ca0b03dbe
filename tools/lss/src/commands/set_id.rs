//! `lss set-id`: a node-ID for one board.

use std::time::Duration;

use can_bus::{bus::Masters, sdo};
use canopen_node::{
    NodeId,
    lss::{Address, Request},
};
use lss_master::InquireNodeId;

use crate::{
    address::{self, Assigned},
    arguments::Target,
    commands::inquire::{choose, id_text},
    failure::Failure,
    session::Session,
};

/// The NMT command reset communication.
pub const RESET_COMMUNICATION: u8 = 130;
/// The NMT command reset node.
const RESET_NODE: u8 = 129;
/// The time that a board takes to boot up after a reset of its communication.
const BOOT: Duration = Duration::from_secs(2);
/// How often a lost frame is made up for.
const ATTEMPTS: usize = 3;

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
    session.carry_out(Request::ConfigureNodeId(NodeId::to_lss(id)))?;
    if stores {
        session.carry_out(Request::StoreConfiguration)?;
    }
    session.bus.take_unasked();
    session.bus.request(Request::SwitchToWaiting)?;
    let board = format!("board {}", address::text(&address));
    let kept = if stores { ", stored" } else { ", until a power cut: `lss store` keeps it" };
    match (before, id) {
        // A board without a node-ID takes it when LSS configuration state ends (CiA 305).
        (None, Some(id)) => wait_for_boot_up(session, id)?,
        (Some(before), id) if before.get() != NodeId::to_lss(id) && resets => {
            session.bus.nmt(RESET_COMMUNICATION, before.get())?;
            if let Some(id) = id {
                wait_for_boot_up(session, id)?;
            }
        }
        (Some(before), id) if before.get() != NodeId::to_lss(id) => {
            let (before, id) = (before.get(), id_text(id));
            writeln!(
                session.out,
                "{board}: node-ID {before}, and {id} from NMT reset communication on (--reset){kept}"
            )?;
            return Ok(());
        }
        _ => {}
    }
    writeln!(session.out, "{board}: node-ID {}{kept}", id_text(id))?;
    Ok(())
}

/// Whether a node answers with this node-ID, or sends of its own accord. Reads object 1000h, which every node has.
pub fn is_taken(session: &mut Session<'_>, id: NodeId) -> Result<bool, Failure> {
    Ok(is_there(session, id)? || session.bus.states.contains_key(&id.get()))
}

/// Whether a node answers with this node-ID.
pub fn is_there(session: &mut Session<'_>, id: NodeId) -> Result<bool, Failure> {
    let id = u16::from(id.get());
    session.bus.send_to(0x600 + id, &sdo::read_request(0x1000, 0))?;
    let wait = session.bus.short();
    Ok(session.bus.wait_for(wait, |frame| frame.cob_id() == 0x580 + id)?.is_some())
}

/// Waits until a node boots up with this node-ID; ends LSS configuration state again if it does not.
pub fn wait_for_boot_up(session: &mut Session<'_>, id: NodeId) -> Result<(), Failure> {
    for _ in 0..ATTEMPTS {
        // The boot-up message may be lost.
        if boots_up(session, id)? || is_there(session, id)? {
            return Ok(());
        }
        session.bus.request(Request::SwitchToWaiting)?;
    }
    Err(silent(id))
}

/// Makes the node-ID pending again that a board had `before`: it must not take another one at the end of LSS
/// configuration state, nor must others that another master has brought there.
pub fn take_back(session: &mut Session<'_>, before: Option<NodeId>) {
    session.bus.mind(Masters::None);
    let _ = session.carry_out(Request::ConfigureNodeId(NodeId::to_lss(before)));
    session.bus.mind(Masters::Lss);
}

/// Resets a node, and checks that the board is there with its node-ID again: it has stored it. Returns whether it sends
/// a boot-up message: some slaves send another one.
pub fn reset(session: &mut Session<'_>, id: NodeId, address: &Address) -> Result<bool, Failure> {
    let mut boots = false;
    for _ in 0..ATTEMPTS {
        session.bus.take_unasked();
        session.bus.nmt(RESET_NODE, id.get())?;
        boots = boots_up(session, id)?;
        if boots {
            break;
        }
    }
    if !boots && !is_there(session, id)? {
        return Err(silent(id));
    }
    match sdo::read_number(&mut session.bus, id.get(), 0x1018, 4)? {
        Ok(number) if number != address.serial_number => Err(Failure::Refused(format!(
            "node {} is not board {}: its serial number is {number:08X}",
            id.get(),
            address::text(address)
        ))),
        // A node need not tell its serial number.
        _ => Ok(boots),
    }
}

/// Whether a node boots up with this node-ID.
fn boots_up(session: &mut Session<'_>, id: NodeId) -> Result<bool, Failure> {
    let is_boot_up = |frame: &canopen_node::Frame| {
        frame.cob_id() == 0x700 + u16::from(id.get()) && frame.data() == [0]
    };
    Ok(session.bus.wait_for(BOOT, is_boot_up)?.is_some())
}

/// A board that does not boot up with its node-ID.
fn silent(id: NodeId) -> Failure {
    Failure::NoAnswer(format!(
        "the board accepted node-ID {}, but sends no boot-up message",
        id.get()
    ))
}
