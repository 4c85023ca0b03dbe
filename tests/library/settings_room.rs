//! The room in the settings log: how many stores each start leaves at least, however full the log was before.

use canopen_node::Application;
use example_io::application as io;
use testkit::{
    flash::BoardFlash,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    sdo::Client,
};

type Example = NodeRig<io::Application>;

/// The least number of stores that fit after a start, however many places other stores have taken before it. `fill`
/// takes a place and `store` those of a store, if there is room.
fn least_room<B>(
    start: impl Fn(&BoardFlash) -> B,
    mut fill: impl FnMut(&mut B) -> bool,
    mut store: impl FnMut(&mut B) -> bool,
) -> usize {
    let flash = BoardFlash::blank(0);
    start(&flash);
    let mut board = start(&flash);
    let mut least = usize::MAX;
    for filled in 0.. {
        // Now and then, and always where a bank may be full.
        if filled % 170 == 0 || (filled + 20) % 401 < 40 {
            let mut other = start(&flash.duplicate(0));
            let room = (0..).take_while(|_| store(&mut other)).count();
            least = least.min(room);
        }
        if !fill(&mut board) {
            assert!(filled > 700, "two banks were full");
            break;
        }
    }
    least
}

/// A store of another node-ID by LSS.
fn store_by_lss<A: Application + Clone>(board: &mut NodeRig<A>) -> bool {
    let next = board.stored().and_then(|stored| stored.node_id).map_or(1, |id| id.get() % 100 + 1);
    board.lss("04 01");
    board.lss(&format!("11 {next:02X}"));
    let answer = board.lss("17");
    assert!(answer == ["17 00"] || answer == ["17 02"], "{answer:?}");
    answer == ["17 00"]
}

fn example(flash: &BoardFlash) -> Example {
    let device = device(ADDRESS).with_defaults(defaults(0x40));
    NodeRig::with_application(device, flash.clone(), 0, io::Application::new())
}

/// A save of another filter constant.
fn save(board: &mut Example) -> bool {
    let next = board.number(0x2100, 0) % 8 + 1;
    board.download(0x2100, 0, &[next as u8]).expect("a legal value");
    let outcome = board.save(1);
    assert!(matches!(outcome, Ok(()) | Err(0x0800_0022)), "{outcome:X?}");
    outcome.is_ok()
}

#[test]
fn every_start_leaves_room_for_401_stores_by_lss() {
    let device = device(ADDRESS).with_defaults(defaults(0x40));
    let start = |flash: &BoardFlash| NodeRig::with_device(device, flash.clone(), 0);
    assert_eq!(least_room(start, store_by_lss, store_by_lss), 401);
}

/// The example after a start, with stored parameters.
fn example_in_use(flash: &BoardFlash) -> Example {
    let mut board = example(flash);
    assert!(!board.stored_parameters().is_empty() || save(&mut board));
    board
}

#[test]
fn every_start_leaves_room_for_390_stores_by_lss_of_the_example() {
    assert_eq!(least_room(example_in_use, store_by_lss, store_by_lss), 390);
}

#[test]
fn every_start_leaves_room_for_33_saves_of_the_example() {
    assert_eq!(least_room(example_in_use, store_by_lss, save), 33);
}
