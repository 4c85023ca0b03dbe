//! The mailbox: 32 bytes of RAM between stack and variables in which loader and program leave each other what is in force.

use canopen_node::{Application, BitRate, BitRateSetting, Node, NodeId, Settings};
use program_update::{Command, Mailbox, Started};

use crate::reset;

/// Its address, as program.x keeps it free.
const PLACE: *mut [u32; 8] = 0x2000_3FE0 as *mut _;

/// What is in force on the bus.
pub struct InForce {
    /// Node-ID and bit rate.
    pub settings: Settings,
    /// The producer heartbeat time in milliseconds.
    pub heartbeat_ms: u16,
}

pub fn read() -> Option<Mailbox> {
    // SAFETY: no variable and no stack has this RAM. It may have any content, as other code has written it.
    Mailbox::from_words(&unsafe { PLACE.read_volatile() })
}

pub fn write(mailbox: &Mailbox) {
    // SAFETY: as above.
    unsafe { PLACE.write_volatile(mailbox.to_words()) };
}

/// Takes what was in force before the start, if that was left.
pub fn take_in_force() -> Option<InForce> {
    let mailbox = read()?;
    write(&Mailbox { kbit: 0, node_id: 0, heartbeat_ms: 0, ..mailbox });
    let Mailbox { node_id, heartbeat_ms, kbit, .. } = mailbox;
    let rate = BitRate::from_kbit_per_s(kbit)?;
    let settings = Settings::new(BitRateSetting::Fixed(rate)).with_node_id(NodeId::new(node_id));
    Some(InForce { settings, heartbeat_ms })
}

/// Leaves what is in force on the bus to the one who starts next.
pub fn hand_over<A: Application>(node: &Node<A>, command: Command) {
    write(&Mailbox {
        command,
        started: Started::Loader,
        failures: 0,
        node_id: node.node_id().map_or(0, NodeId::get),
        heartbeat_ms: node.heartbeat_ms(),
        kbit: node.bit_rate().kbit_per_s(),
    });
}

/// Resets the chip, which is no failure of the program: without a mailbox none is.
pub fn reset() -> ! {
    // SAFETY: as above.
    unsafe { PLACE.cast::<u32>().write_volatile(0) };
    reset::end_by_command();
}

/// Records that the program has run for long.
pub fn note_has_run() {
    if let Some(mailbox) = read() {
        write(&Mailbox { failures: 0, ..mailbox });
    }
}
