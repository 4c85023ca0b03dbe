//! The commands for nodes in their network: start, stop, reset, read and write.

use std::{collections::BTreeMap, path::Path, time::Duration};

use can_bus::{
    adapter,
    eds::{self, Eds, Entry},
    explain::nmt_state,
    sdo,
};
use canopen_node::{NodeId, nmt::State};

use crate::{
    arguments::Object,
    failure::{Failure, Result},
    network::nodes,
    plan::sheet::{Sheet, address_words},
    session::Session,
};

/// The time in which a node tells its state: a boot-up, or two heartbeats once a second.
const TOLD: Duration = Duration::from_millis(2200);

/// NMT commands, and the state that each leads to; a reset leads to a boot-up message.
pub const START: (u8, Option<State>) = (1, Some(State::Operational));
pub const STOP: (u8, Option<State>) = (2, Some(State::Stopped));
pub const RESET: (u8, Option<State>) = (129, None);

/// Sends the NMT command to a node, or to all, and prints in which state they are then, as far as they tell it.
pub fn nmt(
    session: &mut Session,
    (command, wanted): (u8, Option<State>),
    node: Option<NodeId>,
) -> Result {
    session.bus.take_unasked();
    session.bus.nmt(command, node.map_or(0, NodeId::get))?;
    let mut told = BTreeMap::new();
    let mut booted = Vec::new();
    let is_it = |id: u8| node.is_none_or(|node| node.get() == id);
    for received in session.bus.collect(TOLD)? {
        booted.extend(nodes::booted(&received.frame).filter(|id| is_it(*id)));
        if let (cob_id @ 0x701..=0x77F, &[state]) = (received.frame.cob_id(), received.frame.data())
        {
            told.insert((cob_id & 0x7F) as u8, state);
        }
    }
    told.retain(|id, _| is_it(*id));
    let is_wrong = |(id, state): &(&u8, &u8)| match wanted {
        Some(wanted) => **state != wanted as u8,
        None => !booted.contains(id),
    };
    let wrong: Vec<String> = told.iter().filter(is_wrong).map(|(id, _)| id.to_string()).collect();
    for (id, state) in &told {
        let boot = if booted.contains(id) && *state != 0 { "boot-up, " } else { "" };
        writeln!(session.out, "node {id}  {boot}{}", nmt_state(*state))?;
    }
    match (told.is_empty(), wanted) {
        (true, None) => Err(Failure::NoAnswer("no boot-up message after the reset".into())),
        (true, _) => Ok(writeln!(session.out, "sent; no heartbeat tells the state since then")?),
        _ if wrong.is_empty() => Ok(()),
        _ => Err(Failure::Refused(format!("node {} has not obeyed", wrong.join(", ")))),
    }
}

/// Prints the value of an object.
pub fn read(session: &mut Session, object: &Object) -> Result {
    let sheet = object.sheet()?;
    let (address, entry) = object.entry(sheet.as_ref())?;
    let bytes = sdo::read(&mut session.bus, object.node.get(), address.0, address.1)?
        .map_err(|why| failed(session, object, address, why))?;
    let text = match entry {
        Some(entry) => entry.text(&bytes),
        None => {
            let hex: Vec<String> = bytes.iter().map(|byte| format!("{byte:02X}")).collect();
            hex.join(" ")
        }
    };
    Ok(writeln!(session.out, "{text}")?)
}

/// Writes a value to an object, until the next reset.
pub fn write(session: &mut Session, object: &Object, value: &str) -> Result {
    let sheet = object.sheet()?;
    let (address, entry) = object.entry(sheet.as_ref())?;
    let Some((sheet, entry)) = sheet.as_ref().zip(entry) else {
        let why = "of which type? --type u16, for example, or --eds FILE";
        return Err(Failure::Refused(why.into()));
    };
    let bytes = sheet.written(entry, value, object.node.get()).map_err(Failure::Refused)?;
    sdo::download(&mut session.bus, object.node.get(), address, &bytes, WAIT)?
        .map_err(|why| failed(session, object, address, why))
}

/// A node may store before it answers.
const WAIT: Duration = Duration::from_secs(5);

fn failed(session: &Session, object: &Object, address: eds::Address, why: sdo::Error) -> Failure {
    let words = format!("node {}, {}: {why}", object.node, address_words(address, None));
    match why {
        sdo::Error::NoAnswer => {
            let rate = session.bus.rate();
            Failure::NoAnswer(format!("{words} at {rate}. `lss find` looks for the bit rate"))
        }
        _ => Failure::Refused(words),
    }
}

impl Object {
    /// The data sheet, or one with the only object that is meant.
    fn sheet(&self) -> Result<Option<Sheet>> {
        if let Some(path) = &self.eds {
            return Sheet::read(path).map(Some).map_err(Failure::Refused);
        }
        let Some(data_type) = self.data_type else { return Ok(None) };
        let Some((index, sub_index)) = eds::parts(&self.object) else { return Ok(None) };
        let eds = Eds::parse(&format!(
            "[{index:04X}sub{sub_index:X}]\nDataType={data_type}\nAccessType=rw"
        ));
        Ok(Some(Sheet { eds, path: Path::new("--type").into() }))
    }

    fn entry<'a>(&self, sheet: Option<&'a Sheet>) -> Result<(eds::Address, Option<&'a Entry>)> {
        match sheet {
            Some(sheet) => {
                let entry = sheet.named(&self.object).map_err(Failure::Refused)?;
                Ok((entry.address, Some(entry)))
            }
            None => match eds::parts(&self.object) {
                Some(address) => Ok((address, None)),
                None => Err(Failure::Refused(format!(
                    "{} is no object: 1017, or 2101:1 for a sub-index; a name needs --eds FILE",
                    self.object
                ))),
            },
        }
    }
}

/// The data types by their short names, and their numbers in CiA 301, table 44.
const TYPES: [&str; 13] =
    ["bool", "i8", "i16", "i32", "i64", "u8", "u16", "u32", "u64", "f32", "f64", "text", "hex"];
const NUMBERS: [u8; 13] = [1, 2, 3, 4, 0x15, 5, 6, 7, 0x1B, 8, 0x11, 9, 0x0A];

/// The data type with this short name.
pub fn data_type(name: &str) -> Result<u8, String> {
    let at = TYPES.iter().position(|known| *known == name);
    at.map(|at| NUMBERS[at]).ok_or_else(|| TYPES.join(", "))
}

/// Prints the adapters that this computer has.
pub fn adapters(out: &mut dyn std::io::Write) -> Result {
    let all = adapter::list();
    for (place, words) in &all {
        writeln!(out, "{place}  {words}")?;
    }
    match all.is_empty() {
        true => Err(can_bus::stop::Stop::NoAdapter("no adapter was found".into()).into()),
        false => Ok(()),
    }
}
