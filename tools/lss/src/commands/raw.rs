//! `lss raw`: one LSS request as bytes, and its answers.

use canopen_node::{
    Frame,
    lss::{REQUEST_COB_ID, RESPONSE_COB_ID},
};

use crate::{failure::Failure, recorder, session::Session};

/// Sends a request and prints it and each answer, with their meaning.
pub fn raw(session: &mut Session<'_>, bytes: &[u8]) -> Result<(), Failure> {
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
