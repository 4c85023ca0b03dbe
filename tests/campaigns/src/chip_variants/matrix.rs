//! The variants: possible differences of a chip and of its surroundings from the emulated board's default.

use emulator::{
    Time,
    board::Settings,
    can::{
        Clock,
        bxcan::{Acknowledge, CanVariant as Can, TransmitLock},
    },
    chip::{ChipVariant as Chip, StartUp, Thresholds, Timing},
};

use testkit::boards::nastiest;

/// The names and settings of all variants, the default first.
pub fn variants() -> Vec<(&'static str, Settings)> {
    let lock =
        |every, frame| Can { transmit_lock: Some(TransmitLock { every, frame }), ..Can::default() };
    let acknowledge = |acknowledge| Can { acknowledge, ..Can::default() };
    let can = [
        ("as modelled", Can::default()),
        (
            "ERRI again at each error while passive",
            Can { passive_errors_interrupt: true, ..Can::default() },
        ),
        (
            "BOFIE interrupts as long as bus-off lasts",
            Can { bus_off_holds_interrupt: true, ..Can::default() },
        ),
        (
            "TEC shows its lower eight bits in bus-off",
            Can { bus_off_tec_overflows: true, ..Can::default() },
        ),
        ("a frame goes into both FIFOs", Can { both_fifos: true, ..Can::default() }),
        ("the mailbox is chosen at the SOF", Can { late_choice: true, ..Can::default() }),
        ("TX locked dominant at the first frame of each listening", lock(1, 1)),
        ("TX locked dominant at the second frame of each listening", lock(1, 2)),
        ("TX locked dominant in every second listening", lock(2, 1)),
        ("INAK 3 bits late", acknowledge(Acknowledge::Late(3))),
        ("INAK 11 bits late", acknowledge(Acknowledge::Late(11))),
        ("INAK lost every second time", acknowledge(Acknowledge::Lost { every: 2 })),
        ("INAK lost every third time", acknowledge(Acknowledge::Lost { every: 3 })),
    ];
    let usual = Chip::default();
    let chip = [
        ("no fault below RAM", Chip { no_fault_below_ram: true, ..usual }),
        ("flash with wait states", Chip { flash_waits: true, ..usual }),
        ("core twice as slow", Chip { slowdown: 2, ..usual }),
        ("core three times as slow", Chip { slowdown: 3, ..usual }),
        ("cut words read differently each time", Chip { cut_words_flip: true, ..usual }),
        ("LSI at 17 kHz", Chip { lsi_hz: 17_000, ..usual }),
        ("LSI at 47 kHz", Chip { lsi_hz: 47_000, ..usual }),
        ("crystal starts in 0.1 ms", Chip { hse_start: Time::from_us(100), ..usual }),
        ("crystal starts in 10 ms", Chip { hse_start: Time::from_ms(10), ..usual }),
        ("reset, PLL and LSI as fast as allowed", Chip { start_up: StartUp::Fastest, ..usual }),
        ("reset, PLL and LSI as slow as allowed", Chip { start_up: StartUp::Slowest, ..usual }),
        ("a boot loader starts the program", Chip { boot_loader: true, ..usual }),
        ("flash as slow as allowed", Chip { flash_timing: Timing::Worst, ..usual }),
        ("an external clock in place of the crystal", Chip { external_clock: true, ..usual }),
        ("HSI 8 % too slow", Chip { hsi_ppm: -80_000, ..usual }),
        ("HSI 4.5 % too fast", Chip { hsi_ppm: 45_000, ..usual }),
        ("RAM remembers over power cuts", Chip { ram_remembers: true, ..usual }),
        ("interrupt lines fall 12 cycles late", Chip { late_lines: 12, ..usual }),
        ("interrupt lines fall 60 cycles late", Chip { late_lines: 60, ..usual }),
        ("interrupt lines fall 400 cycles late", Chip { late_lines: 400, ..usual }),
    ];
    let settings = Settings::default();
    let can = can.map(|(name, can_variant)| (name, Settings { can_variant, ..settings }));
    let chip = chip.map(|(name, chip_variant)| (name, Settings { chip_variant, ..settings }));
    let supply = |supply_mv, thresholds| {
        let chip_variant = Chip { thresholds, ..usual };
        Settings { supply_mv, chip_variant, ..settings }
    };
    let crystal = |ppm| Settings { crystal: Clock { ppm, ..settings.crystal }, ..settings };
    let transceiver = |us| Settings { dominant_time_out: Some(Time::from_us(us)), ..settings };
    let board = [
        ("2.93 V, voltage levels as low as allowed", supply(2_930, Thresholds::Lowest)),
        ("2.93 V, voltage levels as high as allowed", supply(2_930, Thresholds::Highest)),
        ("2.4 V, voltage levels as low as allowed", supply(2_400, Thresholds::Lowest)),
        ("2.4 V, voltage levels as high as allowed", supply(2_400, Thresholds::Highest)),
        ("crystal 0.25 % too slow", crystal(-2_500)),
        ("crystal 0.25 % too fast", crystal(2_500)),
        ("transceiver with a dominant time-out of 1.2 ms", transceiver(1_200)),
        ("transceiver with a dominant time-out of 0.45 ms", transceiver(450)),
        ("transceiver with a dominant time-out of 0.3 ms", transceiver(300)),
        ("the surroundings at their nastiest, at once", nastiest()),
    ];
    can.into_iter().chain(chip).chain(board).collect()
}
