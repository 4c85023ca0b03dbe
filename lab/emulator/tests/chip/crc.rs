//! The CRC unit as seen by a program (RM0090 chapter 4).

use emulator::chip::{Part, Problem, ResetCause, Width};

use crate::rig::{RCC_AHB1ENR, Rig};

const RCC_AHB1RSTR: u32 = 0x4002_3810;
const CRCEN: u32 = 1 << 12;
const DR: u32 = 0x4002_3000;
const IDR: u32 = 0x4002_3004;
const CR: u32 = 0x4002_3008;

fn clocked(part: Part) -> Rig {
    let mut rig = Rig::new(part);
    rig.write(RCC_AHB1ENR, CRCEN);
    rig
}

#[test]
fn the_words_of_the_check_string_give_the_crc_of_mpeg_2() {
    for part in Part::F4 {
        let mut rig = clocked(part);
        assert_eq!(rig.read(DR), u32::MAX);
        // "1234" and "5678" as big-endian words.
        rig.write_all(&[(DR, 0x3132_3334), (DR, 0x3536_3738)]);
        assert_eq!(rig.read(DR), 0x49E3_C2FB, "{part:?}");
        assert_eq!(rig.findings(), [], "{part:?}");
    }
}

#[test]
fn bits_in_reverse_order_give_the_crc_32_of_zlib() {
    let mut rig = clocked(Part::Stm32f405);
    for word in [*b"1234", *b"5678"].map(u32::from_le_bytes) {
        rig.write(DR, word.reverse_bits());
    }
    assert_eq!(!rig.read(DR).reverse_bits(), 0x9AE0_DAAF);
}

#[test]
fn a_reset_by_the_unit_keeps_idr_and_one_by_rcc_does_not() {
    let mut rig = clocked(Part::Stm32f405);
    rig.write_all(&[(DR, 0), (IDR, 0x1234_56A5), (CR, 0)]);
    assert_ne!(rig.read(DR), u32::MAX);
    rig.write(CR, 1);
    assert_eq!([DR, IDR, CR].map(|register| rig.read(register)), [u32::MAX, 0xA5, 0]);
    rig.write_all(&[(DR, 0), (RCC_AHB1RSTR, CRCEN), (RCC_AHB1RSTR, 0)]);
    assert_eq!([DR, IDR].map(|register| rig.read(register)), [u32::MAX, 0]);
    rig.write(DR, 0);
    rig.reset_now(ResetCause::Software);
    rig.write(RCC_AHB1ENR, CRCEN);
    assert_eq!(rig.read(DR), u32::MAX);
}

#[test]
fn the_unit_needs_its_clock_and_whole_words() {
    let mut rig = Rig::new(Part::Stm32f405);
    rig.write(DR, 0);
    rig.write(RCC_AHB1ENR, CRCEN);
    rig.store(DR, Width::Byte, 0).expect("no bus error");
    assert_eq!(rig.read(DR), u32::MAX);
    assert_eq!(rig.problems(), [Problem::ClockOff, Problem::Width]);
}
