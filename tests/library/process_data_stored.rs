//! Stored parameters of process data: what 1010h stores and 1011h restores, over resets, power cycles, power cuts and
//! another firmware.

use canopen_node::{
    Application, Device, Node,
    lss::StoreError,
    nmt::State,
    object_dictionary::{Access, Object},
    objects,
    pdo::{Rpdo, Tpdo},
    settings::parameters::Parameter,
};
use testkit::{
    flash::BoardFlash,
    frames::SILENCE,
    node_rig::{ADDRESS, NodeRig, defaults, device},
    random::Random,
    sdo::Client,
};

use crate::process_data::{Board, Machine, With, board, map, receive, set, write};

/// The bytes of a stored value beside it.
const HEADER: usize = 6;

fn test_device() -> Device {
    device(ADDRESS).with_defaults(defaults(0x40))
}

/// The parameters of process data, without the entries of mappings that the PDO does not carry.
fn parameters<A: Application + Clone>(board: &mut NodeRig<A>) -> Vec<(u16, u8, u32)> {
    let entries: Vec<_> = Node::<A>::entries(&test_device()).collect();
    let mut parameters = Vec::new();
    for (entry, _) in entries {
        let is_here = match entry.object {
            Object::CobIdEmergency
            | Object::InhibitTimeEmergency
            | Object::CommunicationErrorBehaviour
            | Object::SyncCobId
            | Object::CommunicationCyclePeriod
            | Object::SynchronousWindowLength
            | Object::SyncCounterOverflow
            | Object::ConsumerHeartbeatTime(_)
            | Object::RpdoParameter(_)
            | Object::TpdoParameter(_) => true,
            Object::RpdoMapping(_) | Object::TpdoMapping(_) => {
                u32::from(entry.sub_index) <= board.number(entry.index, 0)
            }
            _ => false,
        };
        if is_here {
            assert_eq!(entry.access, Access::ReadWrite);
            let value = board.number(entry.index, entry.sub_index);
            parameters.push((entry.index, entry.sub_index, value));
        }
    }
    parameters
}

/// Changes each kind of parameter.
fn change_all(board: &mut Board) {
    set(board, 0x1005, 0, 0x81, 4);
    set(board, 0x1019, 0, 10, 1);
    set(board, 0x1006, 0, 20_000, 4);
    set(board, 0x1007, 0, 5_000, 4);
    set(board, 0x1016, 2, 0x0005_03E8, 4);
    set(board, 0x1029, 1, 2, 1);
    set(board, 0x1014, 0, 0x8000_0333, 4);
    set(board, 0x1015, 0, 50, 2);
    map(board, 0x1400, 0x333, &[0x0005_0008, 0x6200_0320]);
    set(board, 0x1400, 2, 3, 1);
    set(board, 0x1400, 5, 60_000, 2);
    set(board, 0x1801, 1, 0x8000_02C0, 4);
    set(board, 0x1802, 3, 100, 2);
    set(board, 0x1802, 6, 7, 1);
    map(board, 0x1802, 0x3C0, &[0x6000_0210, 0x6200_0108, 0x6000_0108]);
    set(board, 0x1802, 2, 254, 1);
    set(board, 0x1802, 5, 5000, 2);
}

/// A board whose changed parameters are stored.
fn board_with_stored_parameters() -> Board {
    let mut board = board();
    change_all(&mut board);
    assert_eq!(board.save(1), Ok(()));
    board
}

#[test]
fn stored_pdos_and_producers_work_after_a_power_cycle() {
    let mut board = board_with_stored_parameters();
    board.power_cycle();
    let frames = board.nmt("01 40");
    assert_eq!(frames, ["1C0: 00 00 00", "3C0: 00 00 00 00"]);
    assert_eq!(receive(&mut board, "333: 00 04 03 02 01"), SILENCE);
    assert_eq!(board.node.application().command, 0);
    receive(&mut board, "081: 01");
    assert_eq!(board.node.application().command, 0x0102_0304);
    assert_eq!(receive(&mut board, "705: 05"), SILENCE);
    board.pass_ms(1001);
    assert_eq!(board.node.nmt_state(), State::Stopped, "the error behaviour");
    board.nmt("80 40");
    assert_eq!(board.number(0x1001, 0), 0x11, "the heartbeat of node 5 is missing");
    assert_eq!(board.save(2), Ok(()));
    board.nmt("82 40");
    assert_eq!(board.number(0x1001, 0), 0, "that it is missing is not stored");
}

#[test]
fn entries_behind_sub_index_0_of_a_mapping_are_not_stored() {
    let mut board = board();
    map(&mut board, 0x1802, 0x3C0, &[0x6000_0108, 0x6000_0210]);
    map(&mut board, 0x1400, 0x333, &[0x6200_0108, 0x6200_0210]);
    for (parameter, number) in [(0x1802, 0), (0x1400, 1)] {
        let cob_id = board.number(parameter, 1);
        set(&mut board, parameter, 1, cob_id & 0x7FF | 1 << 31, 4);
        set(&mut board, parameter + 0x200, 0, number, 1);
    }
    let entries = |board: &mut Board| {
        [(0x1A02, 1), (0x1A02, 2), (0x1600, 1), (0x1600, 2)].map(|(at, sub)| board.number(at, sub))
    };
    let all = [0x6000_0108, 0x6000_0210, 0x6200_0108, 0x6200_0210];
    assert_eq!(board.save(1), Ok(()));
    assert_eq!(entries(&mut board), all, "a master may go on with them");
    for restart in ["82 40", "81 40"] {
        board.nmt(restart);
        assert_eq!(entries(&mut board), [0, 0, 0x6200_0108, 0], "{restart}");
    }
}

#[test]
fn only_cob_ids_at_their_default_follow_a_new_node_id() {
    let mut board = board_with_stored_parameters();
    board.configure("11 05, 17");
    let cob_ids = |board: &mut Board| {
        [(0x1400, 1), (0x1401, 1), (0x1800, 1), (0x1801, 1), (0x1802, 1)]
            .map(|(index, sub_index)| board.number(index, sub_index))
    };
    let expected = [0x333, 0x305, 0x4000_0185, 0x8000_0285, 0x385];
    board.power_cycle();
    assert_eq!(cob_ids(&mut board), expected);
    board.nmt("82 05");
    assert_eq!(cob_ids(&mut board), expected);
}

#[test]
fn reset_communication_in_a_store_returns_to_the_parameters_before_it() {
    for (resets, writes) in [(true, true), (true, false), (false, true)] {
        for outcome in [Ok(()), Err(StoreError::MediumAccess)] {
            let mut board = board();
            let declared = parameters(&mut board);
            change_all(&mut board);
            let changed = parameters(&mut board);
            board.let_stores_take_time();
            assert_eq!(board.sdo("23 10 10 02 73 61 76 65"), SILENCE);
            if resets {
                board.nmt("82 40");
                assert_eq!(parameters(&mut board), declared, "nothing is persistent yet");
            }
            if writes {
                set(&mut board, 0x1005, 0, 0x85, 4);
            }
            match outcome {
                Ok(()) => board.finish_store(),
                failure => board.end_store(failure),
            };
            let stored = if outcome.is_ok() { &changed } else { &declared };
            board.nmt("82 40");
            assert_eq!(parameters(&mut board), *stored, "after {outcome:?}, {resets}, {writes}");
            board.power_cycle();
            assert_eq!(parameters(&mut board), *stored, "after {outcome:?}, {resets}, {writes}");
        }
    }
}

objects! {
    /// The same machine in a later version: an input is gone, one has another type, an output can no longer be written.
    pub struct NewMachine, values NewMachineValue;

    0x6000 "Inputs" {
        1 "Buttons" buttons: u8 = 0, ro, mappable;
        3 "Position" position: i32 = 0, ro, mappable;
    }
    0x6200 "Outputs" {
        1 "Lamps" lamps: u8 = 0, rw, mappable;
        2 "Speed" speed: u16 = 0, rw, mappable;
        3 "Command" command: u32 = 0, ro, mappable;
    }
}

impl Application for NewMachine {
    const TPDOS: &'static [Tpdo] =
        &[Tpdo::new(&[(0x6000, 3)]), Tpdo::new(&[(0x6200, 3)]), Tpdo::UNUSED, Tpdo::UNUSED];
    const RPDOS: &'static [Rpdo] = &[Rpdo::new(&[(0x6200, 2)]), Rpdo::UNUSED];
    const PRODUCERS: usize = 1;
}

/// COB-ID, transmission type and mapping of a PDO.
fn pdo(board: &mut NodeRig<NewMachine>, parameter: u16) -> (u32, u32, Vec<u32>) {
    let mapping = parameter + 0x200;
    let number = board.number(mapping, 0) as u8;
    let mapped = (1..=number).map(|sub_index| board.number(mapping, sub_index)).collect();
    (board.number(parameter, 1), board.number(parameter, 2), mapped)
}

#[test]
fn a_stored_pdo_whose_objects_are_gone_stays_as_it_is_declared() {
    let mut old = board();
    map(&mut old, 0x1800, 0x333, &[0x6000_0108, 0x6200_0108]);
    // An object that is gone, and one of another length; a write to a constant.
    map(&mut old, 0x1801, 0x334, &[0x6000_0108, 0x6000_0210]);
    map(&mut old, 0x1802, 0x335, &[0x6000_0340]);
    map(&mut old, 0x1400, 0x336, &[0x6200_0108, 0x6200_0320]);
    map(&mut old, 0x1401, 0x337, &[0x6200_0210]);
    for parameter in [0x1800, 0x1801, 0x1802, 0x1400, 0x1401] {
        set(&mut old, parameter, 2, 5, 1);
    }
    set(&mut old, 0x1016, 1, 0x0005_0001, 4);
    set(&mut old, 0x1016, 2, 0x0006_0001, 4);
    assert_eq!(old.save(2), Ok(()));
    let flash = old.flash.clone();
    let mut new: NodeRig<NewMachine> =
        NodeRig::with_application(test_device(), flash, 0, NewMachine::new());
    let all: Vec<_> = (0..4).map(|at| pdo(&mut new, 0x1800 + at)).collect();
    let declared = [
        (0x333, 5, vec![0x6000_0108, 0x6200_0108]),
        (0x4000_02C0, 255, vec![0x6200_0320]),
        (0xC000_03C0, 255, vec![]),
        (0xC000_04C0, 255, vec![]),
    ];
    assert_eq!(all, declared);
    assert_eq!(pdo(&mut new, 0x1400), (0x240, 255, vec![0x6200_0210]));
    assert_eq!(pdo(&mut new, 0x1401), (0x337, 5, vec![0x6200_0210]));
    assert_eq!(new.number(0x1016, 1), 0x0005_0001);
    new.nmt("82 40");
    assert_eq!((0..4).map(|at| pdo(&mut new, 0x1800 + at)).collect::<Vec<_>>(), declared);
}

#[test]
fn a_power_cut_leaves_all_old_parameters_or_all_new_ones() {
    let new = parameters(&mut board_with_stored_parameters());
    let mut outcomes = [0; 2];
    for step in 0.. {
        let mut board = board();
        set(&mut board, 0x1005, 0, 0x85, 4);
        set(&mut board, 0x1801, 2, 9, 1);
        assert_eq!(board.save(1), Ok(()));
        let old = parameters(&mut board);
        set(&mut board, 0x1801, 2, 1, 1);
        change_all(&mut board);
        board.flash.cut_power_after(step);
        let is_saved = board.save(2).is_ok();
        let is_over = board.flash.is_powered();
        board.flash.power_on();
        board.power_cycle();
        let found = parameters(&mut board);
        assert!(found == new || !is_saved && found == old, "step {step}: {found:X?}");
        outcomes[usize::from(found == new)] += 1;
        board.power_cycle();
        assert_eq!(parameters(&mut board), found, "step {step}");
        if is_over {
            break;
        }
    }
    assert!(outcomes[0] > 40 && outcomes[1] > 0, "{outcomes:?}");
}

#[test]
fn illegal_stored_parameters_are_not_taken() {
    let mut board = board();
    let declared = parameters(&mut board);
    let pdo =
        |words: &[u32]| -> Vec<u8> { words.iter().flat_map(|word| word.to_le_bytes()).collect() };
    let number = |number: u32| number.to_le_bytes().to_vec();
    let tpdo = [0x800, 255, 0, 0, 0];
    let with = |at: usize, value| {
        let mut tpdo = tpdo;
        tpdo[at] = value;
        pdo(&tpdo)
    };
    let bad: Vec<(u16, u8, u8, Vec<u8>)> = vec![
        (0x1005, 0, 0x07, number(0)),
        (0x1005, 0, 0x07, vec![0x80, 0, 0]),
        (0x1005, 0, 0x06, number(0x81)),
        (0x1005, 1, 0x07, number(0x81)),
        (0x1006, 0, 0x06, vec![1, 0]),
        (0x1007, 0, 0x07, vec![1, 0, 0]),
        (0x1019, 0, 0x05, vec![1]),
        (0x1019, 0, 0x05, vec![]),
        (0x1016, 0, 0x07, number(0x0005_03E8)),
        (0x1016, 3, 0x07, number(0x0005_03E8)),
        (0x1016, 1, 0x07, number(0x0105_03E8)),
        (0x1017, 0, 0x06, vec![1]),
        (0x1017, 0, 0x07, number(1)),
        (0x1017, 1, 0x06, vec![1, 0]),
        (0x1018, 0, 0x06, vec![1, 0]),
        (0x1014, 0, 0x07, number(0x81 | 1 << 30)),
        (0x1014, 0, 0x07, number(0x701)),
        (0x1014, 0, 0x06, vec![0x81, 0]),
        (0x1015, 0, 0x06, vec![1]),
        (0x1015, 1, 0x06, vec![1, 0]),
        (0x1400, 0, 0x20, pdo(&[0x800])),
        (0x1400, 0, 0x20, pdo(&[0x800, 241])),
        (0x1400, 0, 0x20, pdo(&[0x800, 255, 0x6000_0108])),
        (0x1402, 0, 0x20, pdo(&[0x800, 255])),
        (0x1402, 5, 0x06, vec![1, 0]),
        (0x1400, 5, 0x06, vec![1]),
        (0x1400, 5, 0x05, vec![1]),
        (0x1400, 1, 0x20, pdo(&[0x800, 255])),
        (0x1400, 0, 0x21, pdo(&[0x800, 255])),
        (0x1600, 0, 0x20, pdo(&[0x800, 255])),
        (0x1800, 0, 0x20, with(0, 0x601)),
        (0x1800, 0, 0x20, with(0, 0x2000_0333)),
        (0x1800, 0, 0x20, with(1, 0x1FF)),
        (0x1800, 0, 0x20, with(2, 0x1_0000)),
        (0x1800, 0, 0x20, with(3, 0x1_0000)),
        (0x1800, 0, 0x20, with(4, 241)),
        (0x1800, 0, 0x20, pdo(&[&tpdo[..], &[0x6000_0340, 0x6000_0108]].concat())),
        (0x1800, 0, 0x20, pdo(&[&tpdo[..], &[0x6000_0108; 9]].concat())),
        (0x1800, 0, 0x20, [pdo(&tpdo), vec![0]].concat()),
    ];
    for (index, sub_index, data_type, value) in bad {
        let parameter = Parameter { index, sub_index, data_type, value: &value };
        assert!(!board.node.restore(&parameter), "{parameter:02X?}");
    }
    assert_eq!(parameters(&mut board), declared);
    let value = &pdo(&tpdo);
    let good = Parameter { index: 0x1800, sub_index: 0, data_type: 0x20, value };
    assert!(board.node.restore(&good));
}

#[test]
fn the_parameters_of_process_data_are_packed_as_documented() {
    let application = With::<2, 2, 2>::new();
    let mut board = NodeRig::with_application(test_device(), BoardFlash::blank(0), 0, application);
    set(&mut board, 0x1016, 1, 0x0005_03E8, 4);
    set(&mut board, 0x1801, 1, 0x8000_02C0, 4);
    set(&mut board, 0x1801, 5, 10_000, 2);
    assert_eq!(board.save(2), Ok(()));
    let expected = [
        &[0x00, 0x14, 0, 0x20, 16, 0, 0, 8, 0, 0, 255, 0, 0, 0][..],
        &[0x08, 1, 0, 0x62, 0x10, 2, 0, 0x62],
        &[0x01, 0x14, 0, 0x20, 16, 0, 0, 8, 0, 0, 0, 0, 0, 0],
        &[0x10, 0, 6, 0, 0x20, 3, 0, 0x62],
        &[0x00, 0x18, 0, 0x20, 28, 0, 0, 8, 0, 0, 255, 0, 0, 0],
        &[0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x08, 1, 0, 0x60, 0x10, 2, 0, 0x60],
        &[0x01, 0x18, 0, 0x20, 24, 0, 0, 8, 0, 0xC0, 1, 0, 0, 0],
        &[0, 0, 0, 0, 0x10, 0x27, 0, 0, 0, 0, 0, 0, 0x40, 3, 0, 0x60],
        &[0x17, 0x10, 0, 0x06, 2, 0, 0, 0],
        &[0x19, 0x10, 0, 0x05, 1, 0, 0],
        &[0x16, 0x10, 1, 0x07, 4, 0, 0xE8, 3, 5, 0],
        &[0x05, 0x10, 0, 0x07, 4, 0, 0x80, 0, 0, 0],
    ];
    assert_eq!(board.stored_parameters(), expected.concat());
}

#[test]
fn the_capacity_is_that_of_pdos_with_eight_values_and_all_producers() {
    let of_sync = 3 * (HEADER + 4) + HEADER + 1;
    let of_rpdo = HEADER + 4 * (2 + 8) + HEADER + 2;
    let pdos = 3 * (HEADER + 4 * (5 + 8)) + 2 * of_rpdo;
    let of_heartbeat = HEADER + 2;
    let of_error_behaviour = HEADER + 1;
    let of_emergency = HEADER + 4 + HEADER + 2;
    let of_verification = 2 * (HEADER + 4);
    let of_every_node = of_heartbeat + of_error_behaviour + of_emergency + of_verification;
    let capacity = of_sync + of_every_node + pdos + 2 * (HEADER + 4);
    assert_eq!(Node::<Machine>::STORED_LEN, capacity);
    let mut board = board();
    for (parameter, cob_id, value) in [
        (0x1400, 0x333, 0x0005_0008),
        (0x1401, 0x334, 0x0005_0008),
        (0x1800, 0x335, 0x6000_0108),
        (0x1801, 0x336, 0x6000_0108),
        (0x1802, 0x337, 0x6000_0108),
    ] {
        map(&mut board, parameter, cob_id, &[value; 8]);
    }
    set(&mut board, 0x1016, 1, 0x0005_0001, 4);
    set(&mut board, 0x1016, 2, 0x0006_0001, 4);
    set(&mut board, 0x1029, 1, 1, 1);
    set(&mut board, 0x1014, 0, 0x8000_00C0, 4);
    set(&mut board, 0x1015, 0, 100, 2);
    set(&mut board, 0x1006, 0, 1, 4);
    set(&mut board, 0x1007, 0, 1, 4);
    set(&mut board, 0x1400, 5, 1, 2);
    set(&mut board, 0x1401, 5, 1, 2);
    set(&mut board, 0x1020, 1, 1, 4);
    set(&mut board, 0x1020, 2, 1, 4);
    assert_eq!(board.save(1), Ok(()));
    assert_eq!(board.stored_parameters().len(), capacity);
}

/// Writes a random value, often a legal one, to a random parameter.
fn change_randomly(board: &mut Board, random: &mut Random) {
    let parameter = random.pick(&[0x1400, 0x1401, 0x1800, 0x1801, 0x1802]);
    let id = random.pick(&[0x333, 0x334, 0, 0x1C0, 0x2C0, 0x3C0, 0x240, 0x340, 0x280, 0x200]);
    let code = random.pick(&[0x6000_0108, 0x6000_0210, 0x6000_0340, 0x6200_0108, 0x6200_0320]);
    let number = random.within(0..9) as u32;
    let (index, sub_index, value, size) = match random.within(0..13) {
        0..=2 => (parameter, 1, id | random.pick(&[0, 0x8000_0000, 0x8000_0000]), 4),
        3 => (parameter, 2, random.pick(&[0, 1, 240, 254, 255]), 1),
        4 => (parameter, 3, random.u32(), 2),
        5 => (parameter, 5, random.u32(), 2),
        6 => (parameter, 6, random.byte().into(), 1),
        7 => (parameter + 0x200, 0, random.pick(&[0, 0, 0, number]), 1),
        8..=9 => (parameter + 0x200, random.within(1..9) as u8, code, 4),
        10 => (0x1016, random.within(1..3) as u8, random.u32() & 0x0003_0001, 4),
        11 => (0x1029, 1, random.within(0..4) as u32, 1),
        _ if random.one_in(2) => (0x1005, 0, random.pick(&[0x80, 0x81, 0x333]), 4),
        _ => (0x1019, 0, random.byte().into(), 1),
    };
    let _ = write(board, index, sub_index, value, size);
}

#[test]
fn random_changes_stores_and_resets_agree_with_a_list_of_the_parameters() {
    let mut random = Random::from_environment();
    let mut stores_that_changed = 0;
    for _ in 0..20 {
        let mut board = board();
        let declared = parameters(&mut board);
        let mut stored = declared.clone();
        for _ in 0..100 {
            for _ in 0..random.within(0..40) {
                change_randomly(&mut board, &mut random);
            }
            let current = parameters(&mut board);
            match random.within(0..8) {
                0..=1 => {
                    let sub_index = random.within(1..4) as u8;
                    let is_saved = board.save(sub_index).is_ok();
                    if is_saved && sub_index != 3 {
                        stores_that_changed += u32::from(stored != current);
                        stored = current;
                    }
                }
                2 if random.one_in(4) => {
                    let sub_index = random.within(1..4) as u8;
                    assert_eq!(board.load(sub_index), Ok(()));
                    if sub_index != 3 {
                        stored = declared.clone();
                    }
                }
                3..=4 => {
                    board.nmt(random.pick(&["82 40", "81 40"]));
                    assert_eq!(parameters(&mut board), stored);
                }
                5 if random.one_in(2) => {
                    let answers = board.configure("11 40, 13 00 02, 17, 04 00");
                    assert!(answers.0.len() == 3, "{answers:?}");
                }
                5 => {
                    board.power_cycle();
                    assert_eq!(parameters(&mut board), stored);
                }
                6 => {
                    // A PDO beside the answer would not be expected.
                    board.nmt("01 40");
                    receive(&mut board, "080:");
                    board.nmt("80 40");
                }
                _ => {
                    board.pass_ms(random.within(0..20));
                }
            }
        }
    }
    assert!(stores_that_changed > 50, "{stores_that_changed}");
}
