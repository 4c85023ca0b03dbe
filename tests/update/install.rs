//! A new program is installed over the bus.

use emulator::Time;
use testkit::sdo::Client;

use super::rig::{NODE, Rig, file};

#[test]
fn a_new_program_is_installed_by_segments_and_by_blocks() {
    let mut rig = Rig::new();
    assert_eq!(rig.version(), "0.1.0");
    for (version, by_blocks) in [("0.2.0", false), ("0.3.0", true)] {
        let file = file(version);
        let stalls = rig.0.network.board(0).flash_stalls();
        rig.stop_and_clear();
        let size = Some(file.len() as u32);
        let outcome = match by_blocks {
            true => rig.client().block_download(0x1F50, 1, &file),
            false => rig.client().download_segments(0x1F50, 1, &file, size),
        };
        assert_eq!(outcome, Ok(()), "status {:X}", rig.number(0x1F57, 1));
        assert_eq!(rig.number(0x1F57, 1), 0);
        assert_eq!(
            rig.0.network.board(0).flash_stalls(),
            stalls,
            "the loader has waited for the flash"
        );
        rig.start();
        assert_eq!((rig.version().as_str(), rig.number(0x2001, 1)), (version, 2));
        assert_eq!(rig.control(0x80), Ok(()));
        assert_eq!(rig.number(0x2001, 1), 3);
        rig.0.power_cycle(0);
        rig.0.expect(&format!("7{NODE:02X}: 00"), Time::from_ms(100));
        assert_eq!(rig.version(), version);
    }
    rig.check_settings();
}
