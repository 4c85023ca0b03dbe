//! Filter banks of each kind.

use emulator::can::{Frame, Id, bxcan::CanVariant};

use crate::rig::{F0R1, FA1R, FFA1R, FM1R, FMR, FS1R, MEGABIT, RF0R, RI0R, Rig, standard};

/// Four banks, one of each kind.
fn with_filters(fifo_1: u32, active: u32) -> Rig {
    let mut rig = Rig::after_reset();
    let bank = |n: u32| F0R1 + 8 * n;
    rig.write_all(&[
        (FMR, 0x2A1C_0E01),
        // Bank 0: 16-bit list of 7E5, 000, 601 and 602. Bank 1: 16-bit mask 180/780 and remote
        // 000/000. Bank 2: 32-bit list of extended 12345 and standard 7E5. Bank 3: 32-bit mask of
        // any extended.
        (FM1R, 0b0101),
        (FS1R, 0b1100),
        (FFA1R, fifo_1),
        (bank(0), 0x7E5 << 5),
        (bank(0) + 4, 0x602 << 21 | 0x601 << 5),
        (bank(1), 0xF018 << 16 | 0x180 << 5),
        (bank(1) + 4, 0x0010 << 16 | 0x0010),
        (bank(2), 0x1_2345 << 3 | 4),
        (bank(2) + 4, 0x7E5 << 21),
        (bank(3), 4),
        (bank(3) + 4, 4),
        (FA1R, active),
        (FMR, 0x2A1C_0E00),
    ]);
    assert_eq!(rig.findings(), []);
    rig.join(0, MEGABIT);
    rig
}

fn match_indices(rig: &mut Rig, fifo: u32, frames: &[Frame]) -> Vec<Option<u32>> {
    let ask = |frame: &Frame| {
        rig.send(*frame);
        rig.run_us(300);
        rig.fifo(fifo).first().map(|message| message[1] >> 8)
    };
    frames.iter().map(ask).collect()
}

fn asked() -> [Frame; 9] {
    [
        standard(0x7E5, &[0; 8]),
        standard(0x000, &[0; 2]),
        standard(0x601, &[0; 8]),
        standard(0x602, &[0; 8]),
        standard(0x1FF, &[]),
        Frame::remote(Id::Standard(0x700), 0),
        Frame::data(Id::Extended(0x1_2345), &[]),
        Frame::data(Id::Extended(0x7E5), &[]),
        standard(0x603, &[]),
    ]
}

#[test]
fn each_kind_of_filter_accepts_its_identifiers() {
    // The active bank, alone in FIFO 0, and the match indices: inactive banks still occupy numbers.
    for (active, expected) in [
        (0b0001, [Some(0), Some(1), Some(2), Some(3), None, None, None, None, None]),
        (0b0010, [None, None, None, None, Some(4), Some(5), None, None, None]),
        (0b0100, [Some(7), None, None, None, None, None, Some(6), None, None]),
        (0b1000, [None, None, None, None, None, None, Some(8), Some(8), None]),
    ] {
        let indices = match_indices(&mut with_filters(0, active), 0, &asked());
        assert_eq!(indices, expected, "{active:04b}");
    }
}

#[test]
fn of_several_matches_the_wider_wins_and_then_the_list_and_each_fifo_numbers_its_own() {
    // The banks in FIFO 1, the FIFO, and the match indices.
    for (fifo_1, fifo, expected) in [
        (0, 0, [Some(7), Some(1), Some(2), Some(3), Some(4), Some(5), Some(6), Some(8), None]),
        (0b0110, 1, [Some(3), None, None, None, Some(0), Some(1), Some(2), None, None]),
        (0b0110, 0, [None, Some(1), Some(2), Some(3), None, None, None, Some(4), None]),
    ] {
        let mut rig = with_filters(fifo_1, 0b1111);
        assert_eq!(match_indices(&mut rig, fifo, &asked()), expected, "{fifo_1:04b}, FIFO {fifo}");
        if fifo == 1 {
            assert!(rig.read(RI0R + 0x10) != 0, "the output mailbox keeps what was released");
        }
    }
}

#[test]
fn filter_initialisation_stops_reception_and_guards_the_banks() {
    let mut rig = Rig::running(0);
    rig.write(FMR, 0x2A1C_0E01);
    rig.send(standard(0x7E5, &[]));
    rig.run_us(200);
    assert_eq!(rig.read(RF0R), 0);
    rig.write_all(&[(FMR, 0x2A1C_0E00), (F0R1, 0x1234)]);
    assert_eq!(rig.read(F0R1), 0, "the bank is active");
    rig.write(FM1R, 1);
    assert_eq!(rig.read(FM1R), 0);
    rig.write_all(&[(FA1R, 0), (F0R1, 0x1234)]);
    assert_eq!(rig.read(F0R1), 0x1234);
}

/// Renode's model stores the frame in both.
#[test]
fn a_frame_that_both_fifos_let_in_goes_into_one() {
    let held = |variant| {
        let mut rig = with_filters(0b0010, 0b0011);
        rig.can_mut(1).set_variant(variant);
        rig.write_all(&[(FA1R, 0), (F0R1 + 8, 0), (FA1R, 0b0011)]);
        rig.send(standard(0x7E5, &[]));
        rig.run_us(300);
        [rig.read(RF0R) & 3, rig.read(RF0R + 4) & 3]
    };
    assert_eq!(held(CanVariant::default()), [1, 0], "a list goes before a mask");
    assert_eq!(held(CanVariant { both_fifos: true, ..CanVariant::default() }), [1, 1]);
}
