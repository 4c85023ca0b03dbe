//! Emergency 01..06: emergency messages and their history (CiA 301, 7.2.7).

use canopen_node::Frame;
use testkit::sdo_messages::initiate;

use crate::{
    Bench, Case, Command, Group, Step, abort, ms,
    pdo::{self, Direction},
};

pub const GROUP: Group =
    Group { name: "Emergency", prepare: |bench| bench.restore(), cases: CASES };

const CASES: &[Case] = &[
    Case::new("1014h is 80h and the node-ID", cob_id),
    Case::new("1001h is 0 without an error", error_register),
    Case::new("1003h is empty without an error", no_history),
    Case::new("An RPDO that is too short causes an emergency message", forced),
    Case::new("1001h is the error register of the latest message", register_after_message),
    Case::new("1003h sub 1 holds the error code of the message", history).with_remark(
        "The tool compares the upper 16 bits with bytes 3 and 4 of the message. CiA 301 leaves \
             them to the manufacturer, so this case compares the error code only.",
    ),
];

/// The error code of a PDO with too few bytes.
const LENGTH_ERROR: u16 = 0x8210;
/// An error field without an error.
const EMPTY: &[u32] = &[abort::NO_DATA, abort::NO_SUB_INDEX, abort::GENERAL];

fn cob_id(bench: &mut Bench) -> Step {
    bench.needs((0x1014, 0))?;
    let cob_id = bench.number((0x1014, 0))?;
    let expected = 0x80 + u64::from(bench.node);
    bench.check(cob_id == expected, format!("1014h is {expected:03X}h"))
}

fn error_register(bench: &mut Bench) -> Step {
    let register = bench.number((0x1001, 0))?;
    bench.check(register == 0, "1001h is 0")
}

pub fn no_history(bench: &mut Bench) -> Step {
    bench.needs((0x1003, 0))?;
    let count = bench.number((0x1003, 0))?;
    bench.check(count == 0, "1003h sub 0 is 0")?;
    bench.expect_abort(initiate(0x40, (0x1003, 1), 0), EMPTY)?;
    Ok(())
}

/// The emergency messages within `span`: error code, error register and manufacturer-specific bytes.
pub fn messages(bench: &mut Bench, span: std::time::Duration) -> Step<Vec<Frame>> {
    let cob_id = 0x80 + u16::from(bench.node);
    Ok(bench.collect(span, cob_id)?.into_iter().map(|(_, frame)| frame).collect())
}

/// The error code of an emergency message.
pub fn code(frame: &Frame) -> u16 {
    let [low, high, ..] = frame.padded_data();
    u16::from_le_bytes([low, high])
}

/// Sends the first RPDO without data to the operational device, which stays so: another state may end the error.
/// Returns the emergency messages.
pub fn force(bench: &mut Bench) -> Step<Vec<Frame>> {
    let (pdo, cob_id) = pdo::valid(bench, &[Direction::Receive])?[0];
    pdo.set_transmission(bench, 254, 0)?;
    bench.nmt(Command::Start)?;
    bench.pass(ms(20))?;
    bench.send(cob_id as u16 & 0x7FF, &[])?;
    messages(bench, ms(500))
}

fn forced(bench: &mut Bench) -> Step {
    let messages = force(bench)?;
    let is_sent = messages.iter().any(|message| code(message) == LENGTH_ERROR);
    bench.check(is_sent, "an emergency message with error code 8210h")?;
    let is_complete = messages.iter().all(|message| message.data().len() == 8);
    bench.check(is_complete, "eight bytes in an emergency message")
}

fn register_after_message(bench: &mut Bench) -> Step {
    let messages = force(bench)?;
    let Some(last) = messages.last() else { return bench.fail("an emergency message") };
    let expected = last.padded_data()[2];
    let register = bench.number((0x1001, 0))?;
    bench.check(register == u64::from(expected), format!("1001h is {expected:02X}h"))
}

fn history(bench: &mut Bench) -> Step {
    bench.needs((0x1003, 1))?;
    let messages = force(bench)?;
    let last = messages.iter().rev().map(code).find(|code| *code != 0);
    let Some(last) = last else { return bench.fail("an emergency message") };
    let field = bench.number((0x1003, 1))? as u16;
    bench.check(field == last, format!("the low half of 1003h sub 1 is {last:04X}h"))
}
