//! The release image under adverse input: frames of any kind, damaged flash, and a bus without nodes or at the wrong
//! rate.

use emulator::{
    Time,
    can::{Frame, Id},
    chip::PowerCut,
    network::{Short, What},
};
use lss_slave::BitRate;
use testkit::{
    frames::{self, SILENCE},
    image_rig::{
        DEFAULT_BIT_RATE, ImageRig, SETTINGS_OFFSET, blank_board, flash_with, on_the_wire, settings,
    },
    node_rig::{self as reference, NodeRig},
    random::Random,
    storm,
};

const LSS: Id = Id::Standard(0x7E5);

/// The answer of a node that understood `frame` in configuration state: an inquiry of the node-ID.
fn inquiry(id: Id) -> Frame {
    Frame::data(id, &[0x5E, 0, 0, 0, 0, 0, 0, 0])
}

/// Node 40 in configuration state, on which the frames sent must have no effect.
fn configured() -> ImageRig {
    let mut rig = ImageRig::with(settings(0x40, BitRate::Kbit1000));
    rig.collect(Time::from_ms(20));
    rig.lss("04 01");
    rig
}

/// Sends these frames without a pause and checks that there is no answer and no change.
fn assert_ignored(rig: &mut ImageRig, frames: &[Frame]) {
    let from = rig.network.now();
    frames.iter().for_each(|&frame| rig.network.send(rig.master, frame));
    while rig.network.adapter_mut(rig.master).unsent() > 0 {
        rig.network.run_for(Time::from_ms(1));
    }
    assert_eq!(rig.collect(Time::from_ms(10)), SILENCE);
    assert_eq!(rig.did(0, from).next(), None);
    assert_eq!(rig.lss("5E"), ["5E 40"], "still in configuration state");
}

#[test]
fn only_eight_bytes_in_a_base_format_data_frame_are_a_request() {
    let mut rig = configured();
    for dlc in (0..=15).filter(|&dlc| dlc != 8) {
        assert_ignored(&mut rig, &[inquiry(LSS).with_dlc(dlc)]);
    }
    for dlc in 0..=15 {
        assert_ignored(&mut rig, &[Frame::remote(LSS, dlc)]);
    }
    for id in [0x7E5, 0x7E5 << 18, 0x1F95_0000 | 0x7E5, 0x0000_07E5 << 3, 0x1FFF_FFFF, 0] {
        assert_ignored(&mut rig, &[inquiry(Id::Extended(id))]);
        assert_ignored(&mut rig, &[Frame::remote(Id::Extended(id), 8)]);
    }
    for id in [0x7E4, 0x7E6, 0x7E7, 0x7ED, 0x3E5, 0x5C0] {
        assert_ignored(&mut rig, &[inquiry(Id::Standard(id))]);
    }
}

#[test]
fn command_specifiers_that_are_no_request_are_ignored() {
    const REQUESTS: [u8; 22] = [
        0x04, 0x11, 0x13, 0x15, 0x17, 0x40, 0x41, 0x42, 0x43, 0x46, 0x47, 0x48, 0x49, 0x4A, 0x4B,
        0x4C, 0x51, 0x5A, 0x5B, 0x5C, 0x5D, 0x5E,
    ];
    let mut rig = configured();
    let others = (0..=0xFF).filter(|command| !REQUESTS.contains(command));
    let frames: Vec<Frame> =
        others.map(|command| Frame::data(LSS, &[command, 1, 2, 3, 4, 5, 6, 7])).collect();
    assert_ignored(&mut rig, &frames);
}

#[test]
fn an_nmt_command_of_another_form_or_for_another_node_is_ignored() {
    let mut rig = configured();
    let reset = Frame::data(Id::Standard(0), &[0x81, 0x00, 0, 0, 0, 0, 0, 0]);
    let mut frames: Vec<Frame> =
        (0..=15).filter(|&dlc| dlc != 2).map(|dlc| reset.with_dlc(dlc)).collect();
    frames.extend((0..=15).map(|dlc| Frame::remote(Id::Standard(0), dlc)));
    frames.push(Frame::data(Id::Extended(0), &[0x81, 0x00]));
    frames.push(Frame::data(Id::Standard(0), &[0x81, 0x41]));
    frames.push(Frame::data(Id::Standard(0), &[0x7F, 0x00]));
    assert_ignored(&mut rig, &frames);
}

/// A random frame without an effect on node 40 in configuration state, mostly almost a request.
fn meaningless(random: &mut Random) -> Frame {
    let id = match random.within(0..8) {
        0 => Id::Extended(random.u32() >> 3),
        1 => Id::Extended(random.pick(&[0x7E5, 0, 0x640, 0x7E5 << 18])),
        2 => Id::Standard(random.within(0..0x800) as u16),
        3 => Id::Standard(random.pick(&[0x000, 0x640])),
        _ => LSS,
    };
    let dlc = random.within(0..16) as u8;
    if random.one_in(8) {
        return Frame::remote(id, dlc);
    }
    let mut data = random.bytes::<8>();
    if random.one_in(2) {
        data[0] = random.pick(&[0x04, 0x11, 0x13, 0x15, 0x17, 0x81, 0x82, 0x40, 0x23]);
    }
    let mut frame = Frame::data(id, &data).with_dlc(dlc);
    match (id, dlc) {
        // Command specifiers of answers and undefined ones.
        (LSS, 8) => frame.data[0] = random.pick(&[0x00, 0x44, 0x4F, 0x50, 0x80, 0xE5, 0xFF]),
        (Id::Standard(0x000), 2) => frame.data[1] = random.within(0x41..0x100) as u8,
        (Id::Standard(0x640), 8) => frame.dlc = 9,
        _ => {}
    }
    (usize::from(dlc.min(8))..8).for_each(|unused| frame.data[unused] = 0);
    frame
}

#[test]
fn random_frames_that_ask_nothing_have_no_effect() {
    let mut random = Random::from_environment();
    let mut rig = configured();
    for _ in 0..30 {
        let frames: Vec<Frame> = (0..1_000).map(|_| meaningless(&mut random)).collect();
        assert_ignored(&mut rig, &frames);
    }
}

/// A request with a valid command specifier, mostly with sensible parameters. None activates bit timing, which takes
/// time, or stores, which wears the flash.
fn request(random: &mut Random, address: [u32; 4]) -> [u8; 8] {
    let mut data = random.bytes::<8>();
    data[0] = random.pick(&[
        0x04, 0x11, 0x13, 0x40, 0x41, 0x42, 0x43, 0x46, 0x47, 0x48, 0x49, 0x4A, 0x4B, 0x4C, 0x51,
        0x5A, 0x5B, 0x5C, 0x5D, 0x5E,
    ]);
    if random.one_in(10) {
        return data;
    }
    let number = match data[0] {
        0x40..=0x51 => storm::address_number(random, &mut data, address),
        0x04 => random.within(0..2) as u32,
        0x11 => random.pick(&[0x01, 0x40, 0x7F, 0xFF, 0xFF, 0x00]),
        0x13 => random.pick(&[0x0000, 0x0200, 0x0500, 0x0800, 0x0001]),
        _ => return data,
    };
    data[1..5].copy_from_slice(&number.to_le_bytes());
    data
}

#[test]
fn random_requests_are_answered_as_the_library_answers_them() {
    let mut random = Random::from_environment();
    let new = settings(0xFF, BitRate::Kbit1000);
    let mut rig = ImageRig::with(new);
    rig.lss("04 01");
    let parts = ["5A", "5B", "5C", "5D"].map(|inquiry| {
        let answer = rig.lss(inquiry);
        u32::from_le_bytes(*answer.0[0].data()[1..].first_chunk().expect("eight bytes"))
    });
    let [vendor_id, product_code, revision_number, serial_number] = parts;
    let address =
        lss_slave::lss::Address { vendor_id, product_code, revision_number, serial_number };
    let flash = testkit::flash::BoardFlash::blank(0);
    let mut node = NodeRig::with_device(reference::device(address).with_defaults(new), flash, 0);
    node.lss("04 01");
    let mut last_ones = Vec::new();
    for _ in 0..3_000 {
        let request = request(&mut random, parts);
        // Back to FF with a reset now and then: otherwise the node would have a node-ID for most of the test.
        let frame = match random.within(0..40) {
            0 => lss_slave::Frame::new(0x7E5, &[0x11, 0xFF, 0, 0, 0, 0, 0, 0]),
            1 => lss_slave::Frame::new(0x000, &[0x82, 0x00]),
            _ => lss_slave::Frame::new(0x7E5, &request),
        }
        .expect("a frame");
        last_ones.push(frames::text(&frame));
        rig.transmit(on_the_wire(&frame));
        let answers = rig.collect(Time::from_us(300));
        let from = last_ones.len().saturating_sub(10);
        assert_eq!(answers, node.receive(&frame), "after {:#?}", &last_ones[from..]);
    }
}

#[test]
fn a_damaged_flash_boots_the_default_settings_and_logs_why() {
    let mut random = Random::from_environment();
    for fill in [0x00, 0x55, 0xA5] {
        let mut board = blank_board(0);
        let garbage: Vec<u8> = (0..0x8000).map(|_| random.byte() ^ fill).collect();
        board.set_flash(SETTINGS_OFFSET, &garbage);
        let mut rig = ImageRig::new(DEFAULT_BIT_RATE, [board]);
        let log = rig.network.board(0).log();
        let why = "the settings in the flash are damaged; using the defaults";
        assert!(log.iter().any(|line| line.level == "error" && line.text == why), "{log:#?}");
        assert_eq!(rig.lss("4C"), ["50"]);
        rig.lss("04 01");
        rig.lss("11 04");
        assert_eq!(
            rig.lss("04 00"),
            ["704: 00", "084: 10 63 01 00 00 00 00 00"],
            "an emergency message once there is a node-ID"
        );
        rig.lss("04 01");
        let stored = rig.lss("17");
        assert!(stored.0.iter().any(|frame| frame.cob_id() == 0x7E4 && frame.data()[1] == 0));
        rig.power_cycle(0);
        assert_eq!(rig.collect(Time::from_ms(20)), ["704: 00"]);
    }
}

#[test]
fn after_a_torn_last_record_the_board_uses_the_one_before_and_logs_it() {
    let old = settings(0x40, BitRate::Kbit1000);
    let mut flash = flash_with(&[old, settings(0x04, BitRate::Kbit1000)]);
    let last =
        flash[..0x4000].chunks(32).rposition(|record| record != [0xFF; 32]).expect("a record");
    // Its copy by the last start has not been written.
    flash[32 * last..][..32].fill(0xFF);
    flash[32 * last - 4..][..4].fill(0xFF);
    let mut board = blank_board(0);
    board.set_flash(SETTINGS_OFFSET, &flash);
    let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
    assert_eq!(rig.collect(Time::from_ms(20)), ["740: 00"]);
    let log = rig.network.board(0).log();
    let why = "a store was interrupted or its record is unknown; using the settings before it";
    assert!(log.iter().any(|line| line.level == "warn" && line.text == why), "{log:#?}");
}

#[test]
fn a_power_cut_in_any_step_of_a_store_leaves_the_old_settings_or_the_new() {
    let mut random = Random::from_environment();
    const STEPS: u64 = 8;
    for step in 0..=STEPS {
        let mut rig = ImageRig::with(settings(0x40, BitRate::Kbit1000));
        rig.collect(Time::from_ms(20));
        rig.lss("04 01");
        rig.lss("11 04");
        let operation = rig.network.board(0).chip().flash().operations() + step;
        // The next start programs a word again.
        if step < STEPS {
            let cut = PowerCut { operation, seed: random.u64() };
            rig.network.board(0).chip().flash_mut().cut_power(cut);
        }
        let answer = rig.lss("17");
        let is_cut = !rig.network.board(0).is_powered();
        assert_eq!(is_cut, step < STEPS);
        if is_cut {
            assert_eq!(answer, SILENCE);
            rig.power_on(0);
        } else {
            assert_eq!(answer, ["17 00"]);
            rig.power_cycle(0);
        }
        let boot_up = rig.collect(Time::from_ms(20));
        let (old, new) = (boot_up == ["740: 00"], boot_up == ["704: 00"]);
        match step {
            0..7 => assert!(old, "step {step}: {boot_up:?}"),
            7 => assert!(old || new, "{boot_up:?}"),
            _ => assert!(new, "{boot_up:?}"),
        }
    }
}

#[test]
fn a_board_alone_on_the_bus_waits_and_answers_a_master_that_joins() {
    let mut rig = ImageRig::with(settings(0x40, BitRate::Kbit1000).with_heartbeat_ms(500));
    let from = rig.network.now();
    rig.network.adapter_mut(rig.master).close();
    rig.network.run_for(Time::from_s(6));
    assert!(rig.did(0, from).any(|event| matches!(event.what, What::Error { .. })));
    assert!(!rig.did(0, from).any(|event| event.what == What::BusOff), "only error passive");
    rig.network.adapter_mut(rig.master).open();
    let waiting = rig.collect(Time::from_ms(20));
    assert!(waiting.0.len() < 20, "only the waiting frames: {waiting:?}");
    rig.lss("04 01");
    assert_eq!(rig.lss("5E"), ["5E 40"]);
}

#[test]
fn a_board_that_is_driven_bus_off_recovers_and_reports_it() {
    let settings = settings(0x40, BitRate::Kbit500).with_heartbeat_ms(20);
    let mut rig = ImageRig::with(settings);
    rig.lss("04 01");
    let from = rig.network.now();
    rig.network.set_short(Some(Short::Recessive));
    rig.network.run_for(Time::from_ms(100));
    assert!(rig.did(0, from).any(|event| event.what == What::BusOff));
    rig.network.set_short(None);
    let frames = rig.collect(Time::from_s(1));
    let reported = |text: &str| frames.0.iter().any(|frame| frames::text(frame).starts_with(text));
    assert!(reported("740: 7F"), "{frames:?}");
    assert!(reported("0C0: 40 81 11"), "{frames:?}");
    assert!(reported("0C0: 00 00 00"), "{frames:?}");
    let answers = rig.lss("5E");
    assert!(answers.0.iter().any(|frame| frames::text(frame).starts_with("7E4: 5E 40")));
    let log = rig.network.board(0).log();
    let mut errors = log.iter().filter(|line| line.level == "error");
    assert!(errors.any(|line| line.text.starts_with("CAN: bus-off")));
}
