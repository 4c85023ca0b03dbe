//! Starts from a damaged settings log: the release images make of it exactly what the node in the process makes of it.

use canopen_node::{Device, application::NoApplication};
use example_io::application as io;
use testkit::{
    flash::BoardFlash,
    image::example,
    node_rig::{self, NodeRig},
};

use crate::rig::*;

/// The length of a bank in bytes.
const BANK: usize = SETTINGS_LENGTH / 2;
/// More than a start with the erases of both banks takes.
const START: Time = Time::from_ms(1_300);
const STARTS: usize = 150;

type ExampleNode = NodeRig<io::Application>;

fn device() -> Device {
    node_rig::device(node_rig::ADDRESS).with_defaults(*settings(0xFF, BitRate::Kbit125))
}

fn example_node(content: Vec<u8>) -> ExampleNode {
    let flash = BoardFlash::with_content(content, 0);
    NodeRig::with_application(device(), flash, 0, io::Application::new())
}

/// What a plain node makes of a log.
fn plain(content: Vec<u8>) -> Vec<u8> {
    let flash = BoardFlash::with_content(content, 0);
    NodeRig::with_application(device(), flash, 0, NoApplication).flash.content()
}

/// A log with settings and parameters, in one or in both banks.
fn log(random: &mut Random) -> Vec<u8> {
    let stores = random.pick(&[1_u16, 1, 400, 480, 508]);
    let stores: Vec<_> =
        (0..stores).map(|n| settings((n % 127) as u8 + 1, BitRate::Kbit1000)).collect();
    let mut node = example_node(flash_with(&stores));
    node.take_actions();
    for _ in 0..random.within(0..8) {
        let label: Vec<u8> = (0..random.within(1..17)).map(|_| b'a' + random.byte() % 26).collect();
        node.download(0x2101, 3, &label).expect("it is writable");
        // It may be full.
        let _ = node.download(0x1010, 1, b"save");
    }
    node.flash.content()
}

/// Changes bytes in use, places or a whole bank.
fn damage(random: &mut Random, content: &mut [u8]) {
    let used: Vec<usize> = (0..content.len()).filter(|&at| content[at] != 0xFF).collect();
    // The rest of a bank behind its last place counts as one.
    let place = |at: usize| {
        let start = at - at % BANK % PLACE;
        start..(start + PLACE).min(at - at % BANK + BANK)
    };
    let (at, other) = (random.pick(&used), random.pick(&used));
    // The last places decide most.
    let near_end = used[used.len() - 1 - random.within(0..used.len().min(200) as u64) as usize];
    match random.within(0..8) {
        0..3 => content[near_end] &= random.byte(),
        3 => content[at] &= random.byte(),
        4 => content[near_end - near_end % 4..][..4].fill(random.pick(&[0x00, 0xFF])),
        5 => content[place(near_end)].fill(0xFF),
        6 => {
            let (from, to) = (place(at), place(other));
            let length = from.len().min(to.len());
            content.copy_within(from.start..from.start + length, to.start);
        }
        _ => content[at - at % BANK..][..BANK].fill(random.pick(&[0x00, 0xFF, 0xFF])),
    }
}

/// Starts `board` with damaged logs, and compares what is in its flash afterwards with what `node` has made of the same.
fn assert_starts_alike(board: Board, node: impl Fn(Vec<u8>) -> Vec<u8>) {
    let mut random = Random::from_environment();
    let mut rig = ImageRig::unattended(board);
    for start in 0..STARTS / every(10) {
        let mut content = log(&mut random);
        for _ in 0..random.within(0..5) {
            damage(&mut random, &mut content);
            if content.iter().all(|byte| *byte == 0xFF) {
                break;
            }
        }
        rig.network.board_mut(0).set_flash(SETTINGS_OFFSET, &content);
        rig.restart_unattended();
        rig.network.run_for(START);
        let flash = rig.network.board(0).flash();
        let after = &flash[SETTINGS_OFFSET as usize..][..SETTINGS_LENGTH];
        assert!(after == node(content), "start {start} ends with another log");
    }
}

#[test]
fn the_firmware_makes_of_a_damaged_log_what_its_node_does() {
    assert_starts_alike(blank_board(0), plain);
}

#[test]
fn the_example_makes_of_a_damaged_log_what_its_node_does() {
    let board = Board::new(PART, example(), Default::default());
    assert_starts_alike(board, |content| example_node(content).flash.content());
}
