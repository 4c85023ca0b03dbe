//! The times of an update in the time of the emulated board, as docs/size-and-speed.md has them.

use canopen_node::BitRate;
use emulator::{Time, chip::Timing};
use testkit::{
    image_rig::{ImageRig, settings},
    sdo::Client,
};

use super::rig::{NODE, Rig, board_of, padded};

const BOOT_UP: &str = "705: 00";

/// A board with a program of this size.
fn board(kb: usize, rate: BitRate, timing: Timing) -> Rig {
    let board = board_of(&padded("0.1.0", kb), settings(NODE, rate));
    board.chip().flash_mut().set_timing(timing);
    let mut rig = Rig(ImageRig::new(rate, [board]), Time::from_s(2));
    rig.0.network.permit_misuse();
    rig.0.collect(Time::from_ms(100));
    rig
}

impl Rig {
    fn now(&self) -> Time {
        self.0.network.now()
    }

    /// The time from stop to its answer.
    fn time_to_stop(&mut self) -> Time {
        let from = self.now();
        assert!(self.try_control(0).unwrap());
        self.now() - from
    }

    fn time_to_clear(&mut self) -> Time {
        let from = self.now();
        assert!(self.try_control(3).unwrap());
        while self.try_number(0x1F57, 1).unwrap() & 1 == 1 {
            self.0.collect(Time::from_ms(1));
        }
        self.now() - from
    }

    fn time_to_download(&mut self, kb: usize) -> Time {
        let from = self.now();
        assert_eq!(self.client().block_download(0x1F50, 1, &padded("0.2.0", kb)), Ok(()));
        self.now() - from
    }

    /// The time from NMT reset node to the boot-up of the program.
    fn time_to_boot(&mut self) -> Time {
        let from = self.0.transmit_command("81 05");
        self.0.expect(BOOT_UP, Time::from_s(1)) - from
    }

    /// The time to the boot-up of the old program, after a download that was not completed.
    fn time_to_restore(&mut self) -> Time {
        self.0.network.power_off(0);
        self.0.network.run_for(Time::from_ms(10));
        let from = self.now();
        self.0.network.power_on(0);
        // The loader's boot-up comes first.
        self.0.expect(BOOT_UP, Time::from_s(1));
        let time = self.0.expect(BOOT_UP, Time::from_s(10)) - from;
        assert_eq!(self.try_number(0x2001, 1).unwrap(), 4, "restored");
        time
    }
}

/// Prints a time in a line of the table, and checks it.
fn check(what: &str, time: Time, most: Time) {
    println!("{what:68} {:8.4} s", time.as_ps() as f64 / 1e12);
    assert!(time <= most, "{what}");
}

#[test]
#[ignore = "measures for half a minute"]
fn stop_clear_download_restore_and_start_take_the_times_promised() {
    let (typical, worst) = (Timing::Typical, Timing::Worst);
    for (rate, most) in [(1000, 50), (500, 50), (125, 50)] {
        let rate = BitRate::ALL.into_iter().find(|one| one.kbit_per_s() == rate).unwrap();
        let what = format!("stop to its answer, 100 KB, {} kbit/s", rate.kbit_per_s());
        check(&what, board(100, rate, typical).time_to_stop(), Time::from_ms(most));
    }
    let fast = BitRate::Kbit1000;
    // The product's own program is a little larger.
    let own = padded("0.1.0", 40).len() / 1024;
    for (kb, most) in [(own, 8), (100, 9)] {
        let time = board(kb, fast, typical).time_to_boot();
        check(&format!("reset to boot-up, {kb} KB"), time, Time::from_ms(most));
    }
    // The flash alone takes 7,659 ms for the last one, the frames 1,709 ms for the first download, the flash 5,660 ms for
    // the last restore.
    for (kb, timing, most) in
        [(own, typical, 1740), (own, worst, 4175), (100, typical, 3000), (100, worst, 7690)]
    {
        let mut rig = board(kb, fast, timing);
        rig.time_to_stop();
        let what = format!("clear, {kb} KB, {timing:?} flash");
        check(&what, rig.time_to_clear(), Time::from_ms(most));
    }
    for (rate, timing, most) in [
        (BitRate::Kbit1000, typical, 1720),
        (BitRate::Kbit1000, worst, 2600),
        (BitRate::Kbit500, typical, 3430),
        (BitRate::Kbit125, typical, 13800),
    ] {
        let mut rig = board(100, rate, timing);
        rig.time_to_stop();
        rig.time_to_clear();
        let what = format!("100 KB by blocks, {} kbit/s, {timing:?} flash", rate.kbit_per_s());
        check(&what, rig.time_to_download(100), Time::from_ms(most));
    }
    for (timing, most) in [(typical, 2010), (worst, 5710)] {
        let mut rig = board(100, fast, timing);
        rig.time_to_stop();
        rig.time_to_clear();
        let half = &padded("0.2.0", 100)[..50_000];
        assert!(!rig.try_download(half).unwrap(), "it is cut short");
        let what = format!("restore, 100 KB, {timing:?} flash");
        check(&what, rig.time_to_restore(), Time::from_ms(most));
    }
}
