//! The cases of a conformance test on an emulated board, over its SLCAN adapter.

use std::fs;

use testkit::cargo::workspace;

use crate::{
    emulated::{Emulated, new_folder},
    run,
};

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
