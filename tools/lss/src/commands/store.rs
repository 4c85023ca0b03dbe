//! `lss store`: lets a board keep its node-ID and its bit rate.

use canopen_node::lss::Request;

use crate::{
    address, arguments::Target, commands::one_board::choose, failure::Failure, session::Session,
};

/// Stores the pending node-ID and bit rate of a board.
pub fn store(session: &mut Session<'_>, target: Target) -> Result<(), Failure> {
    let address = choose(session, target)?;
    session.carry_out(Request::StoreConfiguration)?;
    writeln!(session.out, "board {}: node-ID and bit rate stored", address::text(&address))?;
    Ok(())
}
