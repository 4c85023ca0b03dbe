//! A check with QEMU: its CPU, in place of the emulator's, runs the release image and gives the same answers.

use testkit::cargo::cargo;

#[test]
#[ignore = "needs qemu-system-arm; `cargo verify qemu` says how to install it"]
fn qemu_runs_the_release_image_and_answers_as_the_emulator_does() {
    let output = cargo().args(["verify", "qemu"]).output().expect("cargo runs");
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    // Found, commissioned, stored, and still so after a restart.
    let answers = [
        "7E4#5000000000000000",
        "7E4#5EFF000000000000",
        "7E4#1101000000000000",
        "7E4#1100000000000000",
        "7E4#1700000000000000",
        "705#00",
        "705#00",
        "7E4#5E05000000000000",
    ];
    let mut rest = text.as_ref();
    for answer in answers {
        let (_, after) = rest.split_once(answer).unwrap_or_else(|| panic!("no {answer}:\n{text}"));
        rest = after;
    }
}
