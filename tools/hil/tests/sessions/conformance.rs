//! The cases of a conformance test on an emulated board, over its SLCAN adapter.

use std::fs;

use testkit::{cargo::workspace, emulated::Emulated};

use crate::{folder::new_folder, run};

#[test]
fn the_cases_of_a_conformance_test_run_over_an_adapter() {
    let emulated = Emulated::start(&["--node-id", "5"]);
    let folder = new_folder("conformance");
    let eds = workspace().join("eds/lss-slave.eds");
    let eds = eds.to_str().expect("UTF-8");
    let cases = ["--case", "SDO 0", "--case", "Transition 02"];
    let arguments = [&["--conformance", eds][..], &cases].concat();
    let output = run::command(&folder, &emulated.adapter(), &arguments).output().expect("it runs");
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    assert!(text.contains("node 5") && text.contains("10 cases, 9 passed, 0 failed"), "{text}");
    let junit = fs::read_to_string(folder.join("report.xml")).expect("the JUnit report");
    assert!(junit.contains("tests=\"10\" failures=\"0\" skipped=\"1\""), "{junit}");
    assert!(folder.join("report.html").exists());
}

#[test]
fn the_lss_chapter_runs_over_an_adapter_on_any_identity() {
    let emulated = Emulated::start(&["--node-id", "9"]);
    let folder = new_folder("conformance-lss");
    let cases = ["--case", "LSS unconfigured", "--case", "LSS frames 0", "--without", "sdo,detect"];
    let run = |identity: &[&str]| {
        let arguments = [&["--conformance", "lss"][..], identity, &cases].concat();
        run::command(&folder, &emulated.adapter(), &arguments).output().expect("it runs")
    };
    let output = run(&["--vendor-id", "0"]);
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    assert!(text.contains("12 cases, 12 passed, 0 failed, 0 skipped"), "{text}");
    let output = run(&["--vendor-id", "0x1A2"]);
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && text.contains("not 000001A2h"), "{text}");
}
