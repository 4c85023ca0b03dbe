//! The record of a run for other tools: a candump log, and a capture for Wireshark.

use emulator::{
    Time,
    can::{Frame, Id},
    network::{Event, What},
};

/// The name of the bus in a log.
const INTERFACE: &str = "can0";
/// Marks a capture with times in nanoseconds (pcap file format).
const PCAP_MAGIC: u32 = 0xA1B2_3C4D;
const PCAP_VERSION: (u16, u16) = (2, 4);
/// LINKTYPE_CAN_SOCKETCAN: identifier with its flags, big endian, length, three more bytes, data.
const LINK_TYPE: u32 = 227;
const PACKET_LIMIT: u32 = 0xFFFF;
const EXTENDED: u32 = 1 << 31;
const REMOTE: u32 = 1 << 30;

/// The frames among `events` as `candump -l` writes them; time 0 is the start of the run.
pub fn candump(events: &[Event]) -> String {
    let line = |(time, frame): (Time, Frame)| {
        let us = time.as_us();
        format!("({:010}.{:06}) {INTERFACE} {frame}\n", us / 1_000_000, us % 1_000_000)
    };
    frames(events).map(line).collect()
}

/// The frames among `events` as a pcap file; time 0 is the start of the run.
pub fn pcap(events: &[Event]) -> Vec<u8> {
    let mut file = Vec::new();
    file.extend(PCAP_MAGIC.to_le_bytes());
    file.extend(PCAP_VERSION.0.to_le_bytes());
    file.extend(PCAP_VERSION.1.to_le_bytes());
    file.extend([0; 8]);
    file.extend(PACKET_LIMIT.to_le_bytes());
    file.extend(LINK_TYPE.to_le_bytes());
    for (time, frame) in frames(events) {
        let packet = packet(&frame);
        let ns = time.as_ns();
        file.extend(((ns / 1_000_000_000) as u32).to_le_bytes());
        file.extend(((ns % 1_000_000_000) as u32).to_le_bytes());
        file.extend([(packet.len() as u32).to_le_bytes(); 2].concat());
        file.extend(packet);
    }
    file
}

fn packet(frame: &Frame) -> Vec<u8> {
    let id = match frame.id {
        Id::Standard(id) => u32::from(id),
        Id::Extended(id) => id | EXTENDED,
    };
    let id = if frame.remote { id | REMOTE } else { id };
    let mut packet = id.to_be_bytes().to_vec();
    // A data length code above eight goes into the last byte of the head.
    packet.extend([frame.dlc.min(8), 0, 0, if frame.dlc > 8 { frame.dlc } else { 0 }]);
    packet.extend(frame.payload());
    packet
}

fn frames(events: &[Event]) -> impl Iterator<Item = (Time, Frame)> {
    events.iter().filter_map(|event| match event.what {
        What::Frame { frame, .. } => Some((event.time, frame)),
        _ => None,
    })
}

#[cfg(test)]
mod tests {
    use emulator::network::Source;

    use super::*;

    fn run() -> [Event; 2] {
        let event = |time, what| Event { time, source: Source::Board(0), what };
        let frame = Frame::data(Id::Standard(0x705), &[0x7F]);
        let frame = What::Frame { frame, start: Time::ZERO, bit_rate: 125_000, also: Vec::new() };
        [event(Time::from_us(1_500_000), frame), event(Time::from_s(2), What::PowerOff)]
    }

    #[test]
    fn a_log_has_a_line_for_each_frame() {
        assert_eq!(candump(&run()), "(0000000001.500000) can0 705#7F\n");
    }

    #[test]
    fn a_capture_has_a_head_of_24_bytes_and_a_packet_for_each_frame() {
        let file = pcap(&run());
        assert_eq!(file[..4], [0x4D, 0x3C, 0xB2, 0xA1]);
        assert_eq!(file[20..24], [227, 0, 0, 0]);
        let head = [1, 0, 0, 0, 0x00, 0x65, 0xCD, 0x1D, 9, 0, 0, 0, 9, 0, 0, 0];
        assert_eq!(file[24..40], head);
        assert_eq!(file[40..], [0, 0, 0x07, 0x05, 1, 0, 0, 0, 0x7F]);
    }
}
