//! The diagnosis of the bench: the bit rate at which the boards answer, or the reason why none does, in words.

use std::time::{Duration, Instant};

use canopen_node::{
    BitRate,
    lss::{AddressPart, Request},
};

use crate::{board, bus::Bus, product::Product, report::Report, stop::Stop};

/// The wait for a frame on a bus where nodes send heartbeats: by default one a second.
const HEARTBEAT: Duration = Duration::from_millis(1150);
/// The wait for an answer at each rate: a lone controller repeats its request for ever, and boards that detect the bit
/// rate or look for others need some attempts.
const ATTEMPTS: u32 = 3;

/// What one rate showed.
#[derive(Clone, Copy, Default)]
struct Sight {
    /// A board of this product answers.
    has_boards: bool,
    /// Frames that were understood, none of them from a master.
    frames: usize,
    has_errors: bool,
    is_error_passive: bool,
}

/// Finds the rate at which boards of this product answer, and stays there. Nothing is changed on any board.
///
/// # Errors
/// [`Stop::Bench`] says what is wrong.
pub fn find_rate(bus: &mut Bus, product: &Product, report: &mut Report) -> Result<BitRate, Stop> {
    let first = bus.fixed_rate().unwrap_or(product.first_rate);
    let rates: Vec<_> = match bus.fixed_rate() {
        Some(rate) => vec![rate],
        None => board::rates_from(first).collect(),
    };

    report.progress(&format!("listening at {first}"));
    let heard = Stop::without_rate(listen(bus, first))?.unwrap_or_default();
    let mut order = rates.clone();
    if heard.has_errors && heard.frames == 0 && rates.len() > 1 {
        report.bench("somebody sends at another bit rate than the default");
        for &rate in &rates[1..] {
            report.progress(&format!("listening at {rate}"));
            if Stop::without_rate(listen(bus, rate))?.is_some_and(|sight| sight.frames > 0) {
                order.retain(|other| *other != rate);
                order.insert(0, rate);
                break;
            }
        }
    }

    let (mut sights, mut lacking) = (Vec::new(), Vec::new());
    for rate in order {
        report.progress(&format!("asking at {rate}"));
        let Some(sight) = Stop::without_rate(ask(bus, product, rate))? else {
            lacking.push(rate.to_string());
            continue;
        };
        if sight.has_boards {
            if sight.has_errors {
                report.bench("the adapter saw errors while the boards answered");
            }
            report.bench(&format!("boards answer at {rate}"));
            return Ok(rate);
        }
        if let Some(words) = stranger(bus, product, sight)? {
            return Err(Stop::Bench(words));
        }
        sights.push((rate, sight));
    }
    bus.leave();
    let mut words = explain(&sights, heard, bus.fixed_rate());
    if !lacking.is_empty() {
        words += &format!(". This adapter lacks {}: nobody was asked there", lacking.join(", "));
    }
    Err(Stop::Bench(words))
}

/// Listens without a sign of life on the bus.
fn listen(bus: &mut Bus, rate: BitRate) -> Result<Sight, Stop> {
    bus.listen(rate)?;
    let until = Instant::now() + HEARTBEAT;
    let mut sight = Sight::default();
    while bus.receive(until)?.is_some() {
        sight.frames += 1;
    }
    sight.has_errors = bus.status()?.is_some_and(|status| status.has_errors);
    Ok(sight)
}

fn ask(bus: &mut Bus, product: &Product, rate: BitRate) -> Result<Sight, Stop> {
    bus.open(rate)?;
    let mut sight = Sight::default();
    for _ in 0..ATTEMPTS {
        sight.has_boards = board::is_anyone(bus, product.all())?;
        if sight.has_boards {
            break;
        }
    }
    sight.frames = bus.take_unasked().len();
    if let Some(status) = bus.status()? {
        (sight.has_errors, sight.is_error_passive) = (status.has_errors, status.is_error_passive);
    }
    Ok(sight)
}

/// The words for a rate at which other nodes take part, but no board of this product; `None` if nobody takes part.
fn stranger(bus: &mut Bus, product: &Product, sight: Sight) -> Result<Option<String>, Stop> {
    let rate = bus.rate();
    let is_acknowledged = bus.status()?.is_some() && !sight.has_errors && !sight.is_error_passive;
    if sight.frames == 0 && !is_acknowledged {
        return Ok(None);
    }
    bus.request(Request::SwitchToConfiguration)?;
    let vendor = bus.probe(Request::Inquire(AddressPart::VendorId))?;
    let code = bus.probe(Request::Inquire(AddressPart::ProductCode))?;
    bus.request(Request::SwitchToWaiting)?;
    bus.leave();
    let number = |answer: Option<[u8; 8]>| match answer {
        Some([_, a, b, c, d, ..]) => format!("{:08X}", u32::from_le_bytes([a, b, c, d])),
        None => "unknown".into(),
    };
    Ok(Some(match (vendor, code) {
        (None, None) => format!(
            "not our board: a node takes part at {rate}, but answers no LSS request. Is the firmware flashed, \
             and does it run (`cargo flash` shows its log)? Nothing was changed"
        ),
        _ => format!(
            "not our board: the LSS slave at {rate} has vendor-ID {} and product code {}, but {} says {:08X} and \
             {:08X}. Give the data sheet of a product with `--eds`. Nothing was changed",
            number(vendor),
            number(code),
            product.source,
            product.vendor_id,
            product.product_code
        ),
    }))
}

/// The words for a bus on which nobody takes part at any rate.
fn explain(sights: &[(BitRate, Sight)], heard: Sight, fixed: Option<BitRate>) -> String {
    let rates = match fixed {
        Some(rate) => format!("at {rate}, the adapter's only rate"),
        None => "at any bit rate".into(),
    };
    let knows_errors = sights.iter().any(|(_, sight)| sight.has_errors);
    if heard.has_errors {
        return format!(
            "wrong rate or bad wires: there are signals on the bus, but not one valid frame {rates}. A node may run at \
             a rate that is not CiA 301's, CANH and CANL may be swapped, or a termination of 120 ohm may be missing \
             (60 ohm between CANH and CANL without power is right)"
        );
    }
    if knows_errors {
        return format!(
            "nobody acknowledges {rates}: the adapter sends, and no other node answers. In this order: has the board \
             power; is the transceiver connected (D to PB9, R to PB8, 3.3 V, ground; its standby or silent pin on the \
             active level); CANH to CANH, CANL to CANL, ground to ground; 60 ohm between CANH and CANL without power; \
             does the firmware run (`cargo flash` shows its log)"
        );
    }
    format!(
        "no answer {rates}, and this adapter does not report whether anybody acknowledges. Has the board power and \
         firmware (`cargo flash` shows its log)? Are CANH, CANL and ground connected, with 60 ohm between CANH and CANL?"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_state_of_a_silent_bus_has_its_words() {
        let of = |ask: Sight, heard: Sight| explain(&[(BitRate::Kbit125, ask)], heard, None);
        let errors = Sight { has_errors: true, ..Sight::default() };
        assert!(of(errors, errors).starts_with("wrong rate or bad wires"));
        assert!(of(errors, Sight::default()).starts_with("nobody acknowledges at any bit rate"));
        assert!(of(Sight::default(), Sight::default()).starts_with("no answer at any bit rate"));
        let fixed =
            explain(&[(BitRate::Kbit125, errors)], Sight::default(), Some(BitRate::Kbit125));
        assert!(fixed.contains("at 125 kbit/s, the adapter's only rate"), "{fixed}");
    }
}
