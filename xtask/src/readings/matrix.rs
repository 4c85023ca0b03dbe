//! The readings: how a chip may differ from the emulated board's default.

use emulator::{
    board::Settings,
    can::bxcan::{Acknowledge, Readings as Can, TransmitLock},
};

/// A reading, and the board on which it holds.
pub struct Reading {
    pub name: &'static str,
    pub settings: Settings,
}

/// All of them, after the default.
pub fn readings() -> Vec<Reading> {
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
    let on_can = |(name, can_readings)| Reading {
        name,
        settings: Settings { can_readings, ..Settings::default() },
    };
    can.map(on_can).into()
}
