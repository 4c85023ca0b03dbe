//! `lss update`, on boards in the process whose loader and program are those of `program_update`.

mod board;
mod fleet;
mod interrupted;
mod program;

use can_bus::person::Person;
use canopen_node::{BitRate, Frame};
use program_update::{FlashError, Header, Release, header::text};
use serde_json::Value;
use testkit::node_rig::{ADDRESS, device};

use crate::in_process::Wire;
use fleet::{Fault, Fleet, crc_of, new, old, write};
use program::{Kind, RUN, file_of, file_with};

/// Whether a frame is a request to write 1F51h.
fn is_control(frame: &Frame, value: u8) -> bool {
    frame.data().starts_with(&[0x2F, 0x51, 0x1F, 1, value])
}

#[test]
fn a_board_gets_a_program_which_is_confirmed() {
    let fleet = Fleet::new(&[5]);
    let outcome = fleet.update(&new(), "5");
    assert_eq!((outcome.code, &*outcome.error), (0, ""));
    assert_eq!(
        outcome.text,
        "version 1.1 (1.2.3) for product 11223344:55667788 on stm32f405, 2 KB\n\
         node 5  11223344:55667788:00010203:00000001  1.2.3 -> 1.1, confirmed\n"
    );
    assert_eq!(fleet.kept(), [Some(crc_of(&new()))]);
    // As other clients do it: stop, clear, blocks, start, confirm.
    let sent = fleet.sent();
    let at = |is_it: &dyn Fn(&Frame) -> bool| sent.iter().position(is_it).expect("it was sent");
    let begin = |frame: &Frame| frame.data().starts_with(&[0xC6, 0x50, 0x1F, 1]);
    let nmt = |frame: &Frame| (frame.cob_id(), frame.data()) == (0, &[0x80, 5]);
    let control = |value| move |frame: &Frame| is_control(frame, value);
    let order = [
        at(&nmt),
        at(&control(0)),
        at(&control(3)),
        at(&begin),
        at(&control(1)),
        at(&control(0x80)),
    ];
    assert!(order.is_sorted(), "{order:?}");
    fleet.assert_waiting();
}

#[test]
fn once_the_program_runs_on_a_board_the_next_ones_clear_ahead() {
    let fleet = Fleet::new(&[5, 6, 7]);
    assert_eq!(fleet.update(&new(), "").code, 0);
    assert_eq!(fleet.kept(), [Some(crc_of(&new())); 3]);
    let sent = fleet.sent();
    let control = |node: u16, value| {
        let is_it = |frame: &Frame| frame.cob_id() == 0x600 + node && is_control(frame, value);
        sent.iter().position(is_it).expect("it was sent")
    };
    let order = [control(5, 0x80), control(7, 3), control(6, 1), control(7, 1)];
    assert!(order.is_sorted(), "{order:?}");
    let erases = [0, 1, 2].map(|board| fleet.board(board).chip.borrow().erases);
    assert_eq!(erases[1..], [erases[0]; 2], "none clears twice");
}

#[test]
fn a_board_that_has_cleared_ahead_goes_back_when_the_program_fails_on_another() {
    let fleet = Fleet::new(&[5, 6, 7]);
    assert_eq!(fleet.update(&new(), "").code, 0);
    let is_confirm = |frame: &Frame| frame.cob_id() == 0x606 && is_control(frame, 0x80);
    let confirm = fleet.sent().iter().position(is_confirm).expect("it was sent");
    let fleet = Fleet::new(&[5, 6, 7]);
    fleet.fail_at(confirm, Fault::FlashFails(1));
    let outcome = fleet.update(&new(), "");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.contains("cannot be confirmed"), "{}", outcome.error);
    assert_eq!(fleet.kept(), [Some(crc_of(&new())), None, Some(crc_of(&old()))]);
    assert_ne!(fleet.board(2).chip.borrow().erases, 0, "it has cleared");
    let words = "left alone: the program has failed on another board. Now the program before runs";
    assert!(outcome.text.contains(words), "{}", outcome.text);
}

#[test]
fn only_the_boards_named_get_the_program() {
    let fleet = Fleet::new(&[5, 6, 7]);
    assert_eq!(fleet.update(&new(), "7 5").code, 0);
    let [old, new] = [old(), new()].map(|file| Some(crc_of(&file)));
    assert_eq!(fleet.kept(), [new, old, new]);
    assert_eq!(fleet.update(&file_with("1.2", Kind::Good, 2000, |_| ()), "7 9").code, 3);
    assert_eq!(fleet.kept(), [new, old, new]);
}

#[test]
fn all_boards_of_the_product_get_the_program_and_no_other() {
    let other = canopen_node::lss::Address { product_code: 1, ..ADDRESS };
    let revised = device(ADDRESS).with_versions("B", "1.2.3");
    let fleet =
        Fleet::of(&[(5, device(ADDRESS)), (6, device(other)), (7, revised), (8, device(ADDRESS))]);
    let outcome = fleet.update(&new(), "");
    assert_eq!((outcome.code, &*outcome.error), (0, ""));
    let [old, new] = [old(), new()].map(|file| Some(crc_of(&file)));
    assert_eq!(fleet.kept(), [new, old, old, new]);
    for words in [
        "node 6  11223344:00000001:00010203:00000002  left alone: it is for another product",
        "node 7  11223344:55667788:00010203:00000003  left alone: it is for another hardware version",
    ] {
        assert!(outcome.text.contains(words), "{}", outcome.text);
    }
    // Who names one of the others is told so, and nobody gets anything.
    let outcome = fleet.update(&file_with("1.2", Kind::Good, 2000, |_| ()), "5 6");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.contains("node 6") && outcome.error.contains("Nothing was changed"));
    assert_eq!(fleet.kept(), [new, old, old, new]);
}

#[test]
fn a_file_for_another_board_is_refused_before_anything_is_erased() {
    let fleet = Fleet::new(&[5]);
    let refused = |file: &[u8], words: &str| {
        let outcome = fleet.update(file, "");
        assert_eq!(outcome.code, 1, "{words}");
        assert!(outcome.error.contains(words), "{}", outcome.error);
        assert_eq!(fleet.board(0).chip.borrow().erases, 0, "{words}");
        assert_eq!(fleet.kept(), [Some(crc_of(&old()))], "{words}");
        fleet.assert_waiting();
    };
    let with = |change: fn(&mut Header)| file_with("1.1", Kind::Good, 1200, change);
    refused(&with(|header| header.vendor_id += 1), "it is for another product");
    refused(&with(|header| header.product_code += 1), "it is for another product");
    refused(&with(|header| header.hardware += 1), "it is for another hardware version");
    refused(&with(|header| header.chip = text("stm32f446")), "it is for another chip");
    refused(&with(|header| header.controller = 2), "it is for another CAN controller");
    refused(&with(|header| header.release = Release(1)), "it has the later version 1.2.3");
    refused(&file_with("1.1", Kind::Good, 0x4000, |_| ()), "the program is too long");
    let mut elsewhere = new()[512..].to_vec();
    elsewhere[4..8].copy_from_slice(&(RUN + 0x1_0211).to_le_bytes());
    let elsewhere = file_of(&elsewhere, "1.1", |header| header.address = RUN + 0x1_0000);
    refused(&elsewhere, "it is for another place in the flash");
}

#[test]
fn a_file_that_one_board_refuses_stops_the_program_of_no_other() {
    let fleet = Fleet::new(&[5, 6, 7]);
    let file = file_with("1.1", Kind::Good, 1200, |header| header.chip = text("stm32f446"));
    let outcome = fleet.update(&file, "");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.starts_with("node 5  "), "{}", outcome.error);
    for (node, number) in [(6, 2), (7, 3)] {
        let line = format!(
            "node {node}  11223344:55667788:00010203:{number:08X}  left alone: the file was refused by another board"
        );
        assert!(outcome.text.lines().any(|it| it == line), "{}", outcome.text);
    }
    let stops = fleet.sent().into_iter().filter(|frame| is_control(frame, 0));
    assert!(stops.map(|frame| frame.cob_id()).eq([0x605]), "only board 5 stops its program");
    let outcome = fleet.update(&file, "--json");
    let json: Value = serde_json::from_str(&outcome.text).expect("JSON");
    let outcomes = [0, 1, 2].map(|board| json["boards"][board]["outcome"].clone());
    assert_eq!(outcomes, ["refused", "left-alone", "left-alone"]);
}

#[test]
fn a_board_goes_back_to_a_lower_release_only_if_the_person_wants_it_and_its_loader_takes_it() {
    let fleet = |may_go_back| {
        let fleet = Fleet::of(&[
            (5, device(ADDRESS)),
            (6, device(ADDRESS).with_versions("A", "1.2.2")),
            (7, device(ADDRESS).with_versions("A", "some text")),
        ]);
        (0..3).for_each(|board| fleet.board(board).allows_downgrade = may_go_back);
        fleet
    };
    let lower = |header: &mut Header| header.release = Release::parse("1.2.2").expect("a release");
    let path = write("lower", &file_with("1.1", Kind::Good, 2000, lower));
    let new = Some(crc_of(&std::fs::read(&path).expect("it was written")));
    let old = Some(crc_of(&old()));
    for (answers, rest, kept) in [
        (None, "", [old, new, new]),
        (Some("n"), "", [old, new, new]),
        (Some("y"), "", [new; 3]),
        (None, "--yes", [new; 3]),
    ] {
        let fleet = fleet(true);
        let person = answers.map_or_else(Person::absent, |answer| Person::who_says(&[answer]));
        let outcome =
            fleet.lss_with(person, &format!("--bit-rate 1000 update {} {rest}", path.display()));
        assert_eq!((outcome.code, &*outcome.error), (0, ""), "{answers:?} {rest}");
        assert_eq!(fleet.kept(), kept, "{answers:?} {rest}");
        let words = "left alone: it has the later version 1.2.3: with --yes it goes back";
        assert_eq!(outcome.text.contains(words), kept[0] == old, "{}", outcome.text);
    }
    let fleet = fleet(false);
    let outcome = fleet.lss(&format!("--bit-rate 1000 update {} 5 --yes", path.display()));
    assert!(outcome.error.contains("its release is lower"), "{}", outcome.error);
    assert_eq!(fleet.kept(), [old; 3]);
}

#[test]
fn a_damaged_file_is_refused_before_anybody_is_asked() {
    let fleet = Fleet::new(&[5]);
    let good = new();
    let refused = |file: &[u8], words: &str| {
        let outcome = fleet.update(file, "5");
        assert_eq!(outcome.code, 1, "{words}");
        assert!(outcome.error.contains(words), "{}", outcome.error);
        assert!(fleet.sent().iter().all(|frame| frame.cob_id() == 0x7E5), "{words}");
    };
    let damaged = |at: usize| {
        let mut file = good.clone();
        file[at] ^= 1;
        file
    };
    refused(&damaged(0), "it does not begin as an update file");
    refused(&damaged(20), "its header is damaged");
    refused(&damaged(400), "its header is damaged");
    refused(&damaged(600), "its checksum is wrong");
    refused(&good[..good.len() - 4], "another length than its header says");
    refused(&good[..100], "another length than its header says");
    let mut program = good[512..].to_vec();
    program[4] = 0;
    refused(&file_of(&program, "1.1", |_| ()), "no stack pointer and reset vector");
    let outcome = fleet.lss("update none.update.bin");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.starts_with("none.update.bin: "), "{}", outcome.error);
}

#[test]
fn a_board_that_has_the_program_is_left_as_it_is() {
    let fleet = Fleet::new(&[5]);
    let outcome = fleet.update(&old(), "");
    assert_eq!(outcome.code, 0);
    assert!(outcome.text.ends_with("  1.0, has it already\n"), "{}", outcome.text);
    assert!(!fleet.sent().iter().any(|frame| frame.data().starts_with(&[0x2F, 0x51])));
}

#[test]
fn a_program_that_hangs_is_taken_back_and_no_other_board_gets_it() {
    let fleet = Fleet::new(&[5, 6]);
    let outcome = fleet.update(&file_with("1.1", Kind::Hangs, 3000, |_| ()), "");
    assert_eq!(outcome.code, 1);
    let words = "the program does not run; the one before runs again";
    assert!(outcome.error.contains(words), "{}", outcome.error);
    assert_eq!(fleet.kept(), [Some(crc_of(&old())); 2]);
    assert_eq!(fleet.board(1).chip.borrow().erases, 0);
    let words = "node 6  11223344:55667788:00010203:00000002  left alone: the program has failed on another board\n";
    assert!(outcome.text.ends_with(words), "{}", outcome.text);
}

#[test]
fn a_program_that_is_not_confirmed_is_taken_back() {
    let fleet = Fleet::new(&[5, 6]);
    let outcome = fleet.update(&file_with("1.1", Kind::RefusesConfirmation, 3000, |_| ()), "");
    assert_eq!(outcome.code, 1);
    let words = "cannot be confirmed (the hardware fails (abort 06060000))";
    assert!(outcome.error.contains(words), "{}", outcome.error);
    fleet.pass_s(200);
    assert_eq!(fleet.kept(), [Some(crc_of(&old())); 2]);
    assert_eq!(fleet.board(1).chip.borrow().erases, 0);
}

#[test]
fn a_board_whose_flash_fails_says_so_and_the_others_go_on() {
    for (fault, words) in [
        (FlashError::Failed, "its flash cannot be erased or written"),
        (FlashError::Protected, "its flash is write-protected"),
        (FlashError::SupplyLow, "its supply is too low to write the flash"),
    ] {
        let fleet = Fleet::new(&[5, 6]);
        fleet.board(0).chip.borrow_mut().fault = Some(fault);
        let outcome = fleet.update(&new(), "");
        assert_eq!(outcome.code, 1);
        assert!(
            outcome.error.contains(&format!("it does not clear: {words}")),
            "{}",
            outcome.error
        );
        let [old, new] = [old(), new()].map(|file| Some(crc_of(&file)));
        assert_eq!(fleet.kept(), [old, new]);
        fleet.board(0).chip.borrow_mut().fault = None;
        assert_eq!(fleet.update(&fleet::new(), "").code, 0);
        assert_eq!(fleet.kept(), [new, new]);
    }
}

#[test]
fn a_board_whose_flash_does_not_become_ready_is_told() {
    let fleet = Fleet::new(&[5]);
    fleet.board(0).chip.borrow_mut().erase_us = 100_000_000;
    let outcome = fleet.update(&new(), "");
    assert_eq!(outcome.code, 1);
    let words = "clearing: its flash does not become ready";
    assert!(outcome.error.contains(words), "{}", outcome.error);
}

#[test]
fn a_program_that_the_board_finds_wrong_is_taken_back() {
    let fleet = || {
        let fleet = Fleet::new(&[5]);
        // The restore takes longer than a board may be silent.
        fleet.board(0).chip.borrow_mut().erase_us = 8_000_000;
        fleet
    };
    let (first, second) = (fleet(), fleet());
    // Its stack is where another chip has RAM.
    let mut program = new()[512..].to_vec();
    program[..4].copy_from_slice(&0x2003_0000_u32.to_le_bytes());
    let file = file_of(&program, "1.1", |_| ());
    let outcome = first.update(&file, "");
    assert_eq!(outcome.code, 1);
    let words = "no stack pointer and reset vector for this chip. Now the program before runs";
    assert!(outcome.error.contains(words), "{}", outcome.error);
    let clears = first.sent().iter().filter(|frame| is_control(frame, 3)).count();
    assert_eq!(clears, 1, "the download is not repeated");
    assert_eq!(first.kept(), [Some(crc_of(&old()))]);
    // Ctrl-C while it goes back.
    let reset = first.sent().iter().position(|frame| is_control(frame, 2));
    second.fail_at(reset.expect("it was sent") + 1, Fault::CtrlC);
    assert_eq!(second.update(&file, "").code, 130);
}

#[test]
fn lost_segments_are_sent_again() {
    let fleet = Fleet::new(&[5]);
    fleet.lose_each(100);
    let outcome = fleet.update(&new(), "");
    assert_eq!((outcome.code, &*outcome.error), (0, ""));
    assert_eq!(fleet.kept(), [Some(crc_of(&new()))]);
    let begins = fleet.sent();
    let begins = begins.iter().filter(|frame| frame.data().starts_with(&[0xC6]));
    assert_eq!(begins.count(), 1);
}

/// The number of the first frame of an update of node 5 that is one like this.
fn number_of(is_it: impl Fn(&Frame) -> bool) -> usize {
    let fleet = Fleet::new(&[5]);
    assert_eq!(fleet.update(&new(), "5").code, 0);
    fleet.sent().iter().position(is_it).expect("it was sent")
}

#[test]
fn a_request_or_an_answer_that_is_lost_fails_no_update() {
    let control = |value| number_of(|frame| is_control(frame, value));
    let status = number_of(|frame| frame.data().starts_with(&[0x40, 0x57, 0x1F]));
    let clear = control(3);
    for at in [status, control(0), clear, clear + 1, control(1), control(0x80)] {
        let fleet = Fleet::new(&[5]);
        fleet.fail_at(at, Fault::AnswerIsLost(0));
        let outcome = fleet.update(&new(), "5");
        assert_eq!((outcome.code, &*outcome.error), (0, ""), "answer {at}");
        assert_eq!(fleet.kept(), [Some(crc_of(&new()))], "answer {at}");
    }
    for at in [control(0), clear, control(0x80)] {
        let fleet = Fleet::new(&[5]);
        fleet.fail_at(at, Fault::FrameIsLost);
        let outcome = fleet.update(&new(), "5");
        assert_eq!((outcome.code, &*outcome.error), (0, ""), "request {at}");
    }
}

#[test]
fn a_board_that_loses_its_power_says_when_it_was_last_heard() {
    let (clear, start) =
        (number_of(|frame| is_control(frame, 3)), number_of(|frame| is_control(frame, 1)));
    let refused = "it does not clear: not in the present state of the device (abort 08000022)";
    for (at, fault, words) in [
        (clear + 1, Fault::PowerCut(0), "clearing: "),
        (start, Fault::PowerCut(0), "it does not answer any more"),
        // The program runs again.
        (clear, Fault::PowerFails(0), refused),
    ] {
        let fleet = Fleet::new(&[5]);
        fleet.fail_at(at, fault);
        let outcome = fleet.update(&new(), "5");
        assert_eq!(outcome.code, 1, "{words}");
        assert!(outcome.error.contains(words), "{}", outcome.error);
        assert!(!outcome.error.contains("does not become ready"), "{}", outcome.error);
    }
}

#[test]
fn a_board_without_block_transfer_gets_the_program_in_segments() {
    let fleet = Fleet::new(&[5]);
    fleet.forbid_blocks();
    let outcome = fleet.update(&new(), "");
    assert_eq!((outcome.code, &*outcome.error), (0, ""));
    assert_eq!(fleet.kept(), [Some(crc_of(&new()))]);
}

#[test]
fn a_product_without_a_loader_is_refused() {
    let wire = Wire::new(BitRate::Kbit125, &[5]);
    let of_io = |header: &mut Header| {
        let address = crate::in_process::address(0);
        (header.vendor_id, header.product_code) = (address.vendor_id, address.product_code);
        header.hardware = program_update::crc::of(b"1.0");
    };
    let path = write("no_loader", &file_with("1.1", Kind::Good, 1200, of_io));
    let outcome = wire.lss(&format!("update {}", path.display()));
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.contains("it has no program download"), "{}", outcome.error);
    wire.assert_waiting();
}

#[test]
fn two_boards_with_one_node_id_are_refused() {
    let fleet = Fleet::new(&[5, 5]);
    let outcome = fleet.update(&new(), "5");
    assert_eq!(outcome.code, 1);
    assert!(outcome.error.contains("another board has the same node-ID"), "{}", outcome.error);
    assert_eq!(fleet.kept(), [Some(crc_of(&old())); 2]);
}

#[test]
fn a_bus_without_a_board_is_told() {
    let fleet = Fleet::new(&[]);
    assert_eq!(fleet.update(&new(), "").code, 3);
    let outcome = fleet.update(&new(), "5");
    assert_eq!(outcome.code, 3);
    assert!(
        outcome.error.starts_with("node 5 does not answer at 1000 kbit/s"),
        "{}",
        outcome.error
    );
}

#[test]
fn the_report_as_json_has_each_board() {
    let other = canopen_node::lss::Address { vendor_id: 1, ..ADDRESS };
    let fleet = Fleet::of(&[(5, device(ADDRESS)), (6, device(other))]);
    let outcome = fleet.update(&new(), "--json");
    let json: Value = serde_json::from_str(&outcome.text).expect("JSON");
    assert_eq!(json["file"]["version"], "1.1");
    assert_eq!(json["file"]["crc"], crc_of(&new()));
    let outcomes = [0, 1].map(|board| json["boards"][board]["outcome"].clone());
    assert_eq!(outcomes, ["installed", "left-alone"]);
    assert_eq!(json["boards"][0]["why"], Value::Null);
    assert_eq!(json["boards"][1]["node_id"], 6);
}
