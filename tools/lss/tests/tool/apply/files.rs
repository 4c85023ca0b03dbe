//! The files of `lss apply`: tables with mistakes, DCFs, lists of nodes.

use std::fs;

use super::{RATE, VALUES, assert_done, eds, file, folder, node, node_with};
use crate::in_process::Wire;

#[test]
fn wrong_files_are_told_before_anything_is_sent() {
    let wire = Wire::new(RATE, &[5]);
    let sheet = |values: &str| node_with(5, 0, values);
    let cases = [
        (
            sheet("\"2100\" = 9"),
            "node 5: 2100 Filter constant of the temperature: 9 is not within 0 to 8",
        ),
        (sheet("\"2100\" = 300"), "2100 Filter constant of the temperature: 300 is no UNSIGNED8"),
        (sheet("\"2100\" = 1.5"), "2100 Filter constant of the temperature: 1.5 is no UNSIGNED8"),
        (
            sheet("\"2101:3\" = 5"),
            "2101:3 Calibration of the temperature.Inspector: write it in quotes",
        ),
        (sheet("\"2101:1\" = \"x\""), "2101:1 Calibration of the temperature.Gain: x is no REAL32"),
        (sheet("\"1000\" = 5"), "1000 Device type can only be read"),
        (sheet("\"1010:1\" = 5"), "is no value to set: `lss apply` stores by itself"),
        (sheet("\"2FF0:1\" = 9"), "is no value to set: `lss apply` stores by itself, and node-ID"),
        (sheet("\"5000\" = 5"), "\"5000\" is not in "),
        (sheet("Gian = 5"), "\"Gian\" is not in "),
        (sheet("\"Mapped object\" = 5"), "\"Mapped object\" is not in "),
        (
            sheet("\"COB-ID used by TPDO\" = 5"),
            "several values are called \"COB-ID used by TPDO\": 1800:1 ",
        ),
        (sheet("\"1A02:1\" = 0x60000108"), "1A02:0 is missing: the number of mapped objects"),
        (
            node(5, 0) + "[node.values]\n\"2100\" = 1",
            "node 5: values need the data sheet of the board: eds = ",
        ),
        (node(5, 0) + "eds = \"none.eds\"", "none.eds: No such file"),
        (node(5, 0) + "vaules = 5", "node 5: \"vaules\" is no key of a node"),
        (node(5, 0) + &node(6, 0), " is given twice"),
        ("[[node]]\nid = 5\n".into(), "node 5: address = \"V:P:R:S\" says which board it is"),
        ("bit_rate = 126\n".to_owned() + &node(5, 0), "126 is no bit rate of CiA 301 in kbit/s"),
        (String::new(), "there is no node in the file"),
        (
            format!("[[node]]\nid = 5\naddress = \"1:2:3:4\"\neds = \"{}\"\n", eds()),
            "io.eds is the data sheet of 00000000:4C535334, and not of 00000001:00000002:00000003:00000004",
        ),
    ];
    for (text, why) in cases {
        let (outcome, _) = wire.apply(&file("wrong", &text), "");
        assert_eq!(outcome.code, 1, "{why}");
        assert!(outcome.error.contains(why), "{why}: {}", outcome.error);
        assert!(wire.record().sent.is_empty(), "{why}");
    }
    let (outcome, _) = wire.apply(&folder("wrong").join("network.yml"), "");
    assert!(
        outcome.error.ends_with("its name must end with .toml, .dcf or .cpj"),
        "{}",
        outcome.error
    );
    // All of them at once.
    let (outcome, _) = wire.apply(&file("wrong", &sheet("\"2100\" = 9\n\"1000\" = 1")), "");
    assert_eq!(outcome.error.lines().count(), 2, "{}", outcome.error);
}

#[test]
fn a_dcf_is_written_of_what_is_on_the_node_and_brings_it_back() {
    let wire = Wire::new(RATE, &[0xFF, 0xFF]);
    let five = node_with(5, 0, VALUES).replace("id = 5\n", "id = 5\nname = \"pump\"\n");
    let first = file("dcf", &(five + &node_with(6, 1, "\"2100\" = 1")));
    let written = folder("dcf-written");
    let (outcome, _) = wire.apply(&first, &format!("--write-dcf {}", written.display()));
    assert_eq!(outcome.code, 0);
    let dcf = written.join("node_5.dcf");
    assert!(outcome.text.contains(&format!("{}\n", dcf.display())), "{}", outcome.text);
    let text = fs::read_to_string(&dcf).expect("it is there");
    for line in [
        "FileName=node_5.dcf\nLastEDS=io.eds",
        "[2100]\nParameterValue=4\nParameterName=Filter constant of the temperature",
        "[2101sub1]\nParameterValue=0x3FA00000\n",
        "[2101sub3]\nParameterValue=Ada Lovelace\n",
        "[DeviceComissioning]\nNodeID=5\nNodeName=pump\nBaudrate=125\n",
        "LSS_SerialNumber=0x00001000\n",
    ] {
        assert!(text.contains(line), "{line}");
    }
    assert!(!text.contains("[1000]\nParameterValue"), "it can only be read");
    assert!(!text.contains("[2FF0sub1]\nParameterValue"), "LSS sets the node-ID");
    assert!(!text.contains("[1020sub1]\nParameterValue"), "the stamp is that of the files");
    // A DCF of a DCF is the same but for the name of its data sheet.
    let again = folder("dcf-again");
    let outcome = wire.lss(&format!("apply {} --write-dcf {}", dcf.display(), again.display()));
    assert_eq!(outcome.code, 0, "{}", outcome.error);
    let second = fs::read_to_string(again.join("node_5.dcf")).expect("it is there");
    let lines = |text: &str| -> Vec<String> {
        text.lines().filter(|line| !line.is_empty()).map(str::to_owned).collect()
    };
    assert_eq!(
        lines(&second.replace("=node_5.dcf\nLastEDS=node_5.dcf", "=node_5.dcf\nLastEDS=io.eds")),
        lines(&text)
    );
    wire.set(0, 0x1020, 1, &[0; 4]);
    // The node is as its file says, but for the stamp of another file.
    let (outcome, writes) = wire.apply(&dcf, "--plan");
    assert_eq!((outcome.code, writes), (1, 0));
    assert!(
        outcome.text.contains("it has the values; stores them, and the stamp"),
        "{}",
        outcome.text
    );
    assert_eq!(wire.apply(&dcf, "").0.code, 0);
    assert_done(&wire, &dcf);
    // What somebody changes comes back.
    wire.set(0, 0x2101, 1, &2.0_f32.to_le_bytes());
    wire.set(0, 0x1017, 0, &[0, 0]);
    let (outcome, _) = wire.apply(&dcf, "");
    assert!(outcome.text.contains("    ~ 2101:1 Calibration of the temperature.Gain: 2 -> 1.25\n"));
    assert!(outcome.text.contains("    ~ 1017 Producer heartbeat time: 0 -> 500\n"));
    assert!(outcome.text.contains("2 values written and stored, verified by a reset\n"));
    assert_done(&wire, &dcf);
    // Both files name all boards.
    let both = format!("apply {} {} --plan", dcf.display(), written.join("node_6.dcf").display());
    let outcome = wire.lss(&both);
    assert!(outcome.text.contains("plan: 1 of 2 boards change"), "{}", outcome.text);
    assert!(outcome.text.contains("node 5 \"pump\"  "), "{}", outcome.text);
    assert!(outcome.text.contains("node 6  "), "{}", outcome.text);
    let outcome = wire.lss(&format!("apply {0} {0}", dcf.display()));
    assert!(outcome.error.starts_with("node-ID 5 is given twice\n"), "{}", outcome.error);
}

/// The data sheet as a configuration file with a place in the network, and this value of 2100h.
fn dcf(id: u8, value: u8) -> String {
    let text = fs::read_to_string(eds()).expect("the data sheet");
    let text = text.replace("[2100]\n", &format!("[2100]\nParameterValue={value}\n"));
    format!("{text}\n[DeviceComissioning]\nNodeID=0x{id:02X}\nBaudrate=125\n")
}

#[test]
fn a_dcf_without_a_serial_number_is_for_the_one_board_that_it_can_mean() {
    let folder = folder("kind");
    let path = folder.join("lamp.dcf");
    fs::write(&path, dcf(5, 2)).expect("it can be written");
    let wire = Wire::new(RATE, &[0xFF]);
    assert_eq!(wire.apply(&path, "").0.code, 0);
    assert_eq!(wire.ids(), [(Some(5), Some(5))]);
    assert_eq!(wire.value(0, 0x2100, 0), [2]);
    assert_done(&wire, &path);

    let wire = Wire::new(RATE, &[0xFF, 9]);
    let (outcome, writes) = wire.apply(&path, "");
    assert_eq!((outcome.code, writes), (1, 0));
    let start = "node 5 may be each of 2 boards, 00000000:4C535334:00010000:0000100";
    assert!(outcome.error.starts_with(start), "{}", outcome.error);
    assert!(outcome.error.ends_with("or LSS_SerialNumber in the DCF"), "{}", outcome.error);
    // A table says which one.
    let table = folder.join("network.toml");
    let two_rates = format!("bit_rate = 500\n{}dcf = \"lamp.dcf\"\n", node(5, 1));
    fs::write(&table, two_rates).expect("it can be written");
    let (outcome, _) = wire.apply(&table, "");
    assert!(outcome.error.contains("125 kbit/s here, but 500 kbit/s before"), "{}", outcome.error);
    fs::write(&table, node(5, 1) + "dcf = \"lamp.dcf\"\n").expect("it can be written");
    assert_eq!(wire.apply(&table, "").0.code, 0);
    assert_eq!(wire.value(1, 0x2100, 0), [2]);
    // And then its node-ID does.
    assert_done(&wire, &path);
    let other = dcf(5, 2).replace("ProductNumber=0x4C535334", "ProductNumber=0x4C535335");
    fs::write(&path, other).expect("it can be written");
    let (outcome, _) = wire.apply(&path, "");
    let start = "node 5 is missing: no board 00000000:4C535335:";
    assert!(outcome.error.starts_with(start), "{}", outcome.error);
}

#[test]
fn a_list_of_nodes_names_their_files() {
    let folder = folder("list");
    fs::write(folder.join("a.dcf"), dcf(5, 2)).expect("it can be written");
    fs::write(folder.join("b.dcf"), dcf(9, 7)).expect("it can be written");
    let list = folder.join("nodelist.cpj");
    // As a tool on Windows writes it.
    let text = "\u{FEFF}[TOPOLOGY]\r\nNetName=Machine\nNodes=0x02\nNode5Present=0x01\nNode5Name=Lamp\n\
        Node5DCFName=.\\a.dcf\nNode9Present=0x01\nNode9DCFName=b.dcf\nNode10Present=0x00\nEDSBaseName=/eds\n";
    fs::write(&list, text).expect("it can be written");
    let wire = Wire::new(RATE, &[5, 9]);
    let (outcome, _) = wire.apply(&list, "");
    assert_eq!(outcome.code, 0);
    assert!(outcome.text.contains("node 5 \"Lamp\"  "), "{}", outcome.text);
    assert_eq!((wire.value(0, 0x2100, 0), wire.value(1, 0x2100, 0)), (vec![2], vec![7]));
    assert_done(&wire, &list);
}

#[test]
fn one_file_serves_assign_and_apply() {
    let wire = Wire::new(RATE, &[0xFF, 0xFF, 0xFF]);
    let text = format!(
        "bit_rate = 125\n{}[[node]]\nid = 1\neds = \"{}\"\n",
        node_with(5, 0, VALUES),
        eds()
    );
    let file = file("one-file", &text);
    // A node that has no address keeps its node-ID; `lss apply` asks which board it is.
    let outcome = wire.lss(&format!("assign --table {}", file.display()));
    assert_eq!(outcome.code, 0, "{}", outcome.error);
    let mut ids = wire.ids();
    ids.sort_unstable();
    assert_eq!(ids, [2, 3, 5].map(|id| (Some(id), Some(id))));
    let (outcome, _) = wire.apply(&file, "");
    assert!(outcome.error.contains("node 1: address = "), "{}", outcome.error);
    let grown = fs::read_to_string(&file).expect("it is there");
    fs::write(&file, grown.replace(&format!("[[node]]\nid = 1\neds = \"{}\"\n", eds()), ""))
        .expect("it can be written");
    assert_eq!(wire.apply(&file, "").0.code, 0);
    assert_eq!(wire.value(0, 0x2100, 0), [4]);
    assert_done(&wire, &file);
}
