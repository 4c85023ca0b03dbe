//! The table of frames beside this file, `frames.txt`: what a node answers to LSS, SDO, PDO and NMT, a line a frame.

use canopen_node::{Application, Frame};
use testkit::{frames::bytes, node_rig::NodeRig};

use crate::{process_data, sdo_machine};

const TABLE: &str = include_str!("frames.txt");

/// The frames of LSS, SDO and emergency messages have eight bytes.
fn padded(text: &str) -> Frame {
    let (cob_id, data) = text.split_once(':').expect("a COB-ID");
    let mut data = bytes(data);
    if matches!(cob_id, "7E5" | "7E4" | "640" | "5C0" | "0C0") {
        data.resize(8, 0);
    }
    Frame::new(u16::from_str_radix(cob_id, 16).expect("a COB-ID"), &data).expect("a frame")
}

/// Plays a section; returns what differs from it.
fn play<A: Application + Clone>(
    mut board: NodeRig<A>,
    section: &str,
    press: impl Fn(&mut A, u8),
) -> Vec<String> {
    let mut differences = Vec::new();
    for row in section.lines().filter(|row| row.contains(" | ")) {
        let mut columns = row.split('|').map(str::trim);
        let (input, expected) = (columns.next().unwrap(), columns.next().unwrap());
        let sent = if let Some(ms) = input.strip_prefix('+') {
            board.pass_ms(ms.trim_end_matches(" ms").parse().expect("milliseconds"))
        } else if let Some(buttons) = input.strip_prefix("buttons ") {
            press(board.node.application_mut(), buttons.parse().expect("a number"));
            board.pass_ms(0)
        } else {
            board.receive(&padded(input))
        };
        let expected: Vec<_> = expected.split(" ; ").filter(|it| *it != "-").map(padded).collect();
        if sent.0 != expected {
            differences.push(format!("{row}\n    it sends {:?}", sent.texts()));
        }
    }
    differences
}

#[test]
fn a_node_sends_what_the_table_of_frames_says() {
    let (mut rows, mut differences) = (0, Vec::new());
    for section in TABLE.split("\n== ").skip(1) {
        rows += section.lines().filter(|row| row.contains(" | ")).count();
        differences.extend(match section.split_once(": ").expect("a board").0 {
            "new" => play(NodeRig::unconfigured(), section, |_, _| {}),
            "node 40h" => play(NodeRig::with_node_id(0x40), section, |_, _| {}),
            "values" => play(sdo_machine::board(), section, |_, _| {}),
            "process data" => {
                play(process_data::board(), section, |machine, buttons| machine.buttons = buttons)
            }
            board => panic!("there is no board {board}"),
        });
    }
    assert!(rows >= 150, "{rows} rows");
    assert!(differences.is_empty(), "{}", differences.join("\n"));
}
