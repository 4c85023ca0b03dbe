//! A flash that refuses or fails: the loader or the old program is on the bus, with a status that says why; once the
//! flash works again, so does an update.

use emulator::Time;
use program_update::Status;
use testkit::{random::every, sdo::Client};

use super::{
    power_cut::Files,
    rig::{Rig, board_with},
};

/// The sectors of RUN, then those of BACKUP.
const SECTORS: [u32; 4] = [4, 5, 6, 7];
const HARDWARE: u32 = 0x0606_0000;

fn stopped() -> Rig {
    let mut rig = Rig::of(board_with(&Files::small().old));
    rig.0.network.permit_misuse();
    assert!(rig.try_control(0).unwrap());
    rig
}

impl Rig {
    /// Stages a fault in the operation with this number from now on.
    fn stage(&self, fault: Fault, after: u64) {
        let from = self.operations() + after;
        let board = self.0.network.board(0);
        let mut chip = board.chip();
        chip.flash_mut().fail_from(from);
        fault(chip.flash_mut());
    }

    /// Clears; returns the status.
    fn status_of_clear(&mut self) -> u32 {
        assert!(self.try_control(3).unwrap());
        self.try_finish().unwrap()
    }

    /// The old program comes back by itself, and then an update succeeds.
    fn recovers(mut self, name: &str) {
        assert!(self.try_control(2).unwrap(), "{name}");
        self.0.collect(Time::from_ms(150));
        self.revive();
        assert_eq!(self.version(), "0.1.0", "{name}");
        assert!(self.try_control(0).unwrap());
        assert_eq!(self.status_of_clear(), 0, "{name}");
        assert!(self.try_download(&Files::small().new).unwrap(), "{name}");
        assert!(self.try_control(1).unwrap(), "{name}");
        self.0.collect(Time::from_ms(150));
        self.revive();
        assert!(self.try_control(0x80).unwrap());
        assert_eq!((&*self.version(), self.number(0x2001, 1)), ("0.2.0", 3), "{name}");
        self.check_settings();
        assert_eq!(self.0.network.board(0).misuse(), None, "{name}");
    }
}

#[test]
fn a_write_protected_sector_is_reported_and_the_old_program_stays() {
    for sector in [SECTORS[0], SECTORS[2]] {
        let mut rig = stopped();
        rig.0.network.board(0).chip().flash_mut().protect_sectors(1 << sector);
        let name = format!("sector {sector}");
        assert_eq!(rig.status_of_clear(), Status::Protected.value(false), "{name}");
        rig.0.network.board(0).chip().flash_mut().protect_sectors(0);
        rig.recovers(&name);
    }
}

#[test]
fn an_erase_that_fails_is_reported_and_the_old_program_comes_back() {
    // BACKUP, then RUN.
    for erase in 0..2 {
        let mut rig = stopped();
        let from = rig.operations() as usize;
        let fail = |rig: &Rig| rig.0.network.board(0).chip().flash_mut().fail_erases(1, 7);
        if erase == 0 {
            fail(&rig);
        }
        assert!(rig.try_control(3).unwrap());
        let erases = |rig: &Rig| {
            let board = rig.0.network.board(0);
            let chip = board.chip();
            let times = &chip.flash().operation_times()[from..];
            times.iter().filter(|time| time.end - time.start > Time::from_ms(100)).count()
        };
        while erases(&rig) < erase {
            rig.0.collect(Time::from_ms(1));
        }
        if erase > 0 {
            fail(&rig);
        }
        let name = format!("erase {erase}");
        if erase == 1 {
            // The words that are written there read otherwise.
            assert_eq!(rig.try_finish().unwrap(), 0);
            let outcome = rig.client().block_download(0x1F50, 1, &Files::small().new);
            assert_eq!(outcome, Err(HARDWARE));
            rig.0.collect(Time::from_ms(10));
        }
        assert_eq!(rig.try_finish().unwrap(), Status::WriteFailed.value(false), "{name}");
        rig.recovers(&name);
    }
}

/// How a word fails.
type Fault = fn(&mut emulator::chip::Flash);
const FAULTS: [(&str, Fault); 2] = [
    ("a bit stays", |flash| flash.fail_programs(1)),
    ("refused", |flash| flash.refuse_programs(1)),
];

/// The faults in these operations: each fifth, or with `FULL` each.
fn some<const N: usize>(operations: [u64; N]) -> impl Iterator<Item = (&'static str, Fault, u64)> {
    let of = move |(name, fault): (_, Fault)| operations.map(|after| (name, fault, after));
    FAULTS.into_iter().flat_map(of).step_by(every(5))
}

#[test]
fn a_word_that_fails_in_a_clear_is_reported_and_the_old_program_comes_back() {
    // In the words SAVED, and in the copy.
    for (name, fault, after) in some([0, 1, 2, 3, 200, 1000]) {
        let mut rig = stopped();
        rig.stage(fault, after);
        let name = format!("{name}, operation {after}");
        assert_eq!(rig.status_of_clear(), Status::WriteFailed.value(false), "{name}");
        rig.recovers(&name);
    }
}

#[test]
fn a_word_that_fails_in_a_download_is_reported_and_the_old_program_comes_back() {
    let file = Files::small().new;
    // Words of the program, the magic bytes and the CRC of the header, and LOADED.
    for (name, fault, after) in some([0, 100, 1023, 1024, 1087, 1136]) {
        let mut rig = stopped();
        assert_eq!(rig.status_of_clear(), 0);
        rig.stage(fault, after);
        let name = format!("{name}, operation {after}");
        let outcome = rig.client().block_download(0x1F50, 1, &file);
        assert_eq!(outcome, Err(HARDWARE), "{name}");
        rig.0.collect(Time::from_ms(10));
        assert_eq!(rig.number(0x1F57, 1), Status::WriteFailed.value(false), "{name}");
        assert!(!rig.try_control(1).unwrap(), "{name}");
        rig.recovers(&name);
    }
}
