//! The meaning of a CANopen frame in one sentence: LSS, NMT, SDO and the other services with predefined COB-IDs.

use canopen_node::{
    BitRate, NodeId,
    lss::{self, AddressPart, FastscanStep, IdentifyKey, Request},
    nmt,
};

/// The meaning of a frame with this COB-ID, without its sender: a short sentence on one line.
pub fn explain(cob_id: u16, data: &[u8]) -> String {
    let node = cob_id & 0x7F;
    match cob_id {
        lss::REQUEST_COB_ID => lss_message(data, lss_request),
        lss::RESPONSE_COB_ID => lss_message(data, lss_response),
        nmt::COMMAND_COB_ID => nmt_command(data),
        0x080 => "SYNC".into(),
        0x081..=0x0FF => emergency(node, data),
        0x100 => "TIME".into(),
        0x181..=0x57F if node != 0 => pdo(cob_id),
        0x581..=0x5FF => sdo(&format!("SDO, node {node}"), data, sdo_answer),
        0x601..=0x67F => sdo(&format!("SDO to node {node}"), data, sdo_request),
        0x701..=0x77F => error_control(node, data),
        _ => "no CANopen service".into(),
    }
}

fn lss_message(data: &[u8], explain: fn(&[u8; 8]) -> String) -> String {
    match data.try_into() {
        Ok(data) => format!("LSS {}", explain(data)),
        Err(_) => format!("LSS, but {} bytes instead of 8", data.len()),
    }
}

fn lss_request(data: &[u8; 8]) -> String {
    let Some(request) = Request::from_bytes(data) else {
        return format!("command {:02X}, unknown", data[0]);
    };
    match request {
        Request::SwitchToWaiting => "switch state global: waiting".into(),
        Request::SwitchToConfiguration => "switch state global: configuration".into(),
        Request::ConfigureNodeId(id) => format!("configure node-ID: {}", node_id(id)),
        Request::ConfigureBitTiming { table, index } => {
            format!("configure bit timing: {}", bit_timing(table, index))
        }
        Request::ActivateBitTiming(delay) => {
            format!("activate bit timing: switch delay {delay} ms")
        }
        Request::StoreConfiguration => "store configuration".into(),
        Request::Select(part, number) => {
            format!("switch state selective: {part} {number:08X}")
        }
        Request::Identify(key, number) => {
            let name = match key {
                IdentifyKey::VendorId => "vendor-ID",
                IdentifyKey::ProductCode => "product code",
                IdentifyKey::RevisionNumberLow => "revision number from",
                IdentifyKey::RevisionNumberHigh => "revision number to",
                IdentifyKey::SerialNumberLow => "serial number from",
                IdentifyKey::SerialNumberHigh => "serial number to",
            };
            format!("identify remote slave: {name} {number:08X}")
        }
        Request::IdentifyNonConfigured => "identify non-configured remote slave".into(),
        Request::Fastscan(step) => fastscan(step),
        Request::Inquire(part) => format!("inquire {part}"),
        Request::InquireNodeId => "inquire node-ID".into(),
    }
}

fn fastscan(FastscanStep { id_number, bit_check, sub, next }: FastscanStep) -> String {
    if bit_check == 0x80 {
        return "Fastscan: is anyone not configured?".into();
    }
    let Some(scanned) = AddressPart::new(sub).filter(|_| bit_check < 32) else {
        return format!("Fastscan: impossible (bit {bit_check}, part {sub})");
    };
    match AddressPart::new(next) {
        Some(_) if bit_check == 0 && next < sub => {
            format!("Fastscan: {scanned} {id_number:08X}? If so, to configuration state")
        }
        Some(next) if bit_check == 0 && next != scanned => {
            format!("Fastscan: {scanned} {id_number:08X}? Then the {next}")
        }
        _ if bit_check == 31 => format!("Fastscan: {scanned}, bit 31 of {id_number:08X}?"),
        _ => format!("Fastscan: {scanned}, bits 31..{bit_check} of {id_number:08X}?"),
    }
}

fn lss_response(data: &[u8; 8]) -> String {
    let [command, error, specific, ..] = *data;
    let number = u32::from_le_bytes([data[1], data[2], data[3], data[4]]);
    let outcome = |accepted: &str, meanings: &[&str]| match error {
        0 => accepted.to_owned(),
        0xFF => format!("refused, manufacturer-specific error {specific:02X}"),
        _ => match meanings.get(usize::from(error) - 1) {
            Some(meaning) => format!("refused: {meaning}"),
            None => format!("refused, error {error:02X}"),
        },
    };
    match command {
        0x11 => format!("configure node-ID: {}", outcome("accepted", &["out of range"])),
        0x13 => format!("configure bit timing: {}", outcome("accepted", &["not supported"])),
        0x17 => {
            let meanings = ["storing is not supported", "the storage medium failed"];
            format!("store configuration: {}", outcome("stored", &meanings))
        }
        0x44 => "slave selected: now in configuration state".into(),
        0x4F => "identify slave: that is me".into(),
        0x50 => "identify non-configured slave: that is me".into(),
        0x5A..=0x5D if let Some(part) = AddressPart::new(command - 0x5A) => {
            format!("{part} is {number:08X}")
        }
        0x5E => format!("node-ID is {}", node_id(error)),
        _ => format!("answer {command:02X}, unknown"),
    }
}

fn node_id(byte: u8) -> String {
    match NodeId::from_lss(byte) {
        Ok(Some(id)) => id.get().to_string(),
        Ok(None) => "not configured (FF)".into(),
        Err(_) => format!("{byte:02X}, invalid"),
    }
}

fn bit_timing(table: u8, index: u8) -> String {
    match (BitRate::from_table(table, index), table, index) {
        (Some(rate), ..) => format!("{} kbit/s (table 0, index {index})", rate.kbit_per_s()),
        (None, 0, 9) => "automatic detection (table 0, index 9)".into(),
        _ => format!("table {table}, index {index}"),
    }
}

fn nmt_command(data: &[u8]) -> String {
    let &[command, addressee] = data else {
        return format!("NMT, but {} bytes instead of 2", data.len());
    };
    let name = match command {
        1 => "start",
        2 => "stop",
        128 => "enter pre-operational",
        129 => "reset node",
        130 => "reset communication",
        _ => return format!("NMT command {command:02X}, unknown"),
    };
    match addressee {
        0 => format!("NMT {name}: all nodes"),
        _ => format!("NMT {name}: node {addressee}"),
    }
}

fn error_control(node: u16, data: &[u8]) -> String {
    match *data {
        [0] => format!("boot-up of node {node}"),
        [state] => format!("heartbeat of node {node}: {}", nmt_state(state)),
        _ => format!("heartbeat of node {node}: unknown"),
    }
}

/// The NMT state in a heartbeat (CiA 301, 7.2.8.3.2).
pub fn nmt_state(byte: u8) -> &'static str {
    const OPERATIONAL: u8 = nmt::State::Operational as u8;
    const PRE_OPERATIONAL: u8 = nmt::State::PreOperational as u8;
    const STOPPED: u8 = nmt::State::Stopped as u8;
    match byte {
        0 => "boot-up",
        OPERATIONAL => "operational",
        PRE_OPERATIONAL => "pre-operational",
        STOPPED => "stopped",
        _ => "unknown",
    }
}

fn pdo(id: u16) -> String {
    let node = id & 0x7F;
    match id & 0x80 {
        0 => format!("RPDO {} of node {node}", (id >> 8) - 1),
        _ => format!("TPDO {} of node {node}", id >> 8),
    }
}

fn emergency(node: u16, data: &[u8]) -> String {
    match data {
        [0, 0, ..] => format!("emergency of node {node}: error reset"),
        &[low, high, ..] => {
            let words = error_code(u16::from_le_bytes([low, high]));
            format!("emergency of node {node}: error code {high:02X}{low:02X}, {words}")
        }
        _ => format!("emergency of node {node}"),
    }
}

/// The meaning of an emergency error code (CiA 301, table 26).
pub fn error_code(code: u16) -> &'static str {
    match code {
        0x0000..=0x00FF => "error reset",
        0x2100..=0x21FF => "current at the input",
        0x2200..=0x22FF => "current inside the device",
        0x2300..=0x23FF => "current at the output",
        0x2000..=0x2FFF => "current",
        0x3100..=0x31FF => "mains voltage",
        0x3200..=0x32FF => "voltage inside the device",
        0x3300..=0x33FF => "output voltage",
        0x3000..=0x3FFF => "voltage",
        0x4100..=0x41FF => "ambient temperature",
        0x4200..=0x42FF => "device temperature",
        0x4000..=0x4FFF => "temperature",
        0x5000..=0x5FFF => "device hardware",
        0x6100..=0x61FF => "internal software",
        0x6200..=0x62FF => "user software",
        0x6300..=0x63FF => "data set",
        0x6000..=0x6FFF => "device software",
        0x7000..=0x7FFF => "additional modules",
        0x8110 => "CAN overrun: frames were lost",
        0x8120 => "CAN is error passive",
        0x8130 => "a heartbeat is missing",
        0x8140 => "recovered from bus-off",
        0x8150 => "another node sends with the same CAN-ID",
        0x8210 => "a PDO is too short",
        0x8220 => "a PDO is too long",
        0x8230 => "the destination of a DAM MPDO is missing",
        0x8240 => "SYNC has a wrong length",
        0x8250 => "an RPDO is missing",
        0x8100..=0x81FF => "communication",
        0x8200..=0x82FF => "protocol error",
        0x8000..=0x8FFF => "monitoring",
        0x9000..=0x9FFF => "external error",
        0xF000..=0xF0FF => "additional functions",
        0xFF00..=0xFFFF => "device-specific",
        _ => "generic error",
    }
}

fn sdo(who: &str, data: &[u8], explain: fn(&[u8; 8]) -> String) -> String {
    match data.try_into() {
        Ok(data) => format!("{who}: {}", explain(data)),
        Err(_) => format!("{who}, but {} bytes instead of 8", data.len()),
    }
}

/// CiA 301, 7.2.4.3: the client's command specifier is in the upper three bits.
fn sdo_request(data: &[u8; 8]) -> String {
    match data[0] >> 5 {
        0 => "write, next segment".into(),
        1 => format!("write {}{}", object(data), sdo_value(data)),
        2 => format!("read {}", object(data)),
        3 => "read, next segment".into(),
        4 => sdo_abort(data),
        _ => "block transfer".into(),
    }
}

/// CiA 301, 7.2.4.3: the server's command specifiers differ from the client's.
fn sdo_answer(data: &[u8; 8]) -> String {
    match data[0] >> 5 {
        0 => {
            let length = 7 - usize::from(data[0] >> 1 & 7);
            format!("segment \"{}\"", data[1..1 + length].escape_ascii())
        }
        1 => "segment written".into(),
        2 => format!("{}{}", object(data), sdo_value(data)),
        3 => format!("{} written", object(data)),
        4 => sdo_abort(data),
        _ => "block transfer".into(),
    }
}

fn object(data: &[u8; 8]) -> String {
    format!("{:04X}:{:02X}", u16::from_le_bytes([data[1], data[2]]), data[3])
}

fn sdo_value(data: &[u8; 8]) -> String {
    let number = u32::from_le_bytes([data[4], data[5], data[6], data[7]]);
    let is_expedited = data[0] & 2 != 0;
    let is_sized = data[0] & 1 != 0;
    match (is_expedited, is_sized) {
        (true, true) => {
            let length = 4 - usize::from(data[0] >> 2 & 3);
            let number = number & u32::MAX >> (32 - 8 * length);
            format!(" = {number:0width$X}", width = 2 * length)
        }
        (true, false) => format!(" = {number:08X}"),
        (false, true) => format!(", {number} bytes in segments"),
        (false, false) => ", in segments".into(),
    }
}

fn sdo_abort(data: &[u8; 8]) -> String {
    let code = u32::from_le_bytes([data[4], data[5], data[6], data[7]]);
    format!("abort {}, code {code:08X}", object(data))
}

/// The width of a terminal in characters.
const WIDTH: usize = 80;

/// The text in lines that fit a terminal, of which the further ones begin with so many blanks.
pub fn wrapped(text: &str, indent: usize) -> String {
    wrapped_at(WIDTH, text, indent)
}

/// The same in lines of another width.
pub fn wrapped_at(limit: usize, text: &str, indent: usize) -> String {
    let (mut lines, mut width) = (String::new(), 0);
    for (number, word) in text.split(' ').enumerate() {
        let length = word.chars().count();
        if width > indent && width + 1 + length > limit {
            lines += &format!("\n{:indent$}", "");
            width = indent;
        } else if number > 0 {
            lines.push(' ');
            width += 1;
        }
        lines += word;
        width += length;
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_emergency_has_the_words_of_its_code_or_of_its_group() {
        assert_eq!(
            explain(0x085, &[0x20, 0x81, 0x11, 0, 0, 0, 0, 0]),
            "emergency of node 5: error code 8120, CAN is error passive"
        );
        let words = [0x1000, 0x2310, 0x2400, 0x81AA, 0x82FF, 0x8F00, 0xFF01].map(error_code);
        assert_eq!(
            words,
            [
                "generic error",
                "current at the output",
                "current",
                "communication",
                "protocol error",
                "monitoring",
                "device-specific"
            ]
        );
    }

    #[test]
    fn a_long_line_is_wrapped_between_words() {
        let text = "  passed  ".to_owned() + &"a rate ".repeat(20);
        let lines = wrapped(&text, 10);
        assert!(lines.lines().all(|line| line.chars().count() <= WIDTH), "{lines}");
        assert_eq!(lines.lines().count(), 2);
        assert_eq!(lines.replace("\n         ", ""), text);
        let word = "x".repeat(100);
        assert_eq!(wrapped(&word, 0), word);
    }

    #[test]
    fn every_identifier_with_any_first_byte_and_length_has_a_sentence() {
        for id in 0..=0x7FF {
            for command in 0..=0xFF {
                for length in 1..=8 {
                    assert!(!explain(id, &[command; 8][..length]).is_empty());
                }
            }
        }
    }
}
