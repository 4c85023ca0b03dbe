//! QEMU's second opinion: its CPU, in place of the emulator's, runs the release image and answers alike; and beside it
//! holds the same in every register.

use std::{env, process::Command};

struct Outcome {
    succeeded: bool,
    text: String,
    errors: String,
}

fn xtask_qemu(arguments: &[&str]) -> Outcome {
    let cargo = env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(cargo);
    let output = command.args(["xtask", "qemu"]).args(arguments).output().expect("cargo runs");
    Outcome {
        succeeded: output.status.success(),
        text: String::from_utf8_lossy(&output.stdout).into_owned(),
        errors: String::from_utf8_lossy(&output.stderr).into_owned(),
    }
}

#[test]
#[ignore = "needs qemu-system-arm; `cargo xtask qemu` says how to install it"]
fn qemu_runs_the_release_image_and_answers_as_the_emulator_does() {
    let Outcome { succeeded, text, errors } = xtask_qemu(&[]);
    assert!(succeeded, "{text}{errors}");
    // Found, named, stored, and named still after a restart.
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
    let mut rest = text.as_str();
    for answer in answers {
        let (_, after) = rest.split_once(answer).unwrap_or_else(|| panic!("no {answer}:\n{text}"));
        rest = after;
    }
}

#[test]
#[ignore = "needs qemu-system-arm; `cargo xtask qemu` says how to install it"]
fn through_the_whole_session_qemus_registers_and_ram_are_the_emulators() {
    let Outcome { succeeded, text, errors } = xtask_qemu(&["--lock-step", "--stride", "1000"]);
    assert!(succeeded, "{text}{errors}");
    // It went on to the end, through interrupts of the CAN controller, tasks, and the restart that NMT asks for.
    for part in ["the whole session", " CAN1_RX0 ", " CAN1_TX ", " TIM2 ", " USART1 "] {
        assert!(text.contains(part), "no {part}:\n{text}");
    }
    assert!(text.contains("2 resets"), "{text}");
}

#[test]
#[ignore = "needs qemu-system-arm; `cargo xtask qemu` says how to install it"]
fn a_wrong_register_is_found_at_the_instruction_where_it_appears() {
    let arguments = ["--lock-step", "--instructions", "20000", "--corrupt", "12345"];
    let Outcome { succeeded, text, errors } = xtask_qemu(&arguments);
    assert!(!succeeded, "{text}{errors}");
    assert!(errors.contains("the first difference is after 0800"), "{errors}");
    assert!(errors.contains("at instruction 12345\n"), "{errors}");
    assert!(errors.contains("<- differs"), "{errors}");
}
