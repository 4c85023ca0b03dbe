//! `lss identify`: who is within ranges of LSS addresses.

use lss_master::{Find, Identify};

use crate::{address, arguments::Ranges, failure::Failure, network::scan, session::Session};

/// Says whether a board is within the ranges, or which ones are.
pub fn identify(session: &mut Session<'_>, ranges: &Ranges) -> Result<(), Failure> {
    let mut within = Identify {
        vendor_id: ranges.vendor,
        product_code: ranges.product,
        revision_numbers: ranges.revision.clone(),
        serial_numbers: ranges.serial.clone(),
    };
    if !session.carry_out(within.clone())? {
        return Err(Failure::NoAnswer(format!(
            "no board within these ranges answers at {}. Is the bit rate right (--bit-rate)? Some slaves do not support \
             identify remote slave",
            session.bus.rate()
        )));
    }
    if !ranges.each {
        writeln!(session.out, "a board within these ranges answers")?;
        return Ok(());
    }
    let mut count = 0;
    loop {
        session.progress.say(|| format!("{count} boards found"));
        let Some(found) = session.carry_out(Find::new(within.clone()))? else { return Ok(()) };
        writeln!(session.out, "{}", address::text(&found))?;
        count += 1;
        scan::check_count(count, "identify remote slave")?;
        let Some(next) = found.serial_number.checked_add(1) else { return Ok(()) };
        within.serial_numbers = next..=*within.serial_numbers.end();
        if within.serial_numbers.is_empty() {
            return Ok(());
        }
    }
}
