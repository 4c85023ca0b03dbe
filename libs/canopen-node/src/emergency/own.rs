//! The error codes of the node itself: a row for each, from which its messages, the refusal of
//! [`Node::report`](crate::Node::report) and a page for people are made.

use super::{COMMUNICATION, GENERIC};
use crate::declaration_error::DeclarationError;

/// An error code of the node, with what people ask about its message (CiA 301, 7.2.7).
#[derive(Clone, Copy, Debug)]
pub struct OwnCode {
    /// The error code.
    pub code: u16,
    /// Its bits of the error register 1001h.
    pub register: u8,
    /// What has happened.
    pub cause: &'static str,
    /// Bytes 3 to 7 of the message; empty if they are 0.
    pub information: &'static str,
    /// What ends it.
    pub end: &'static str,
}

const fn row(
    code: u16,
    register: u8,
    cause: &'static str,
    information: &'static str,
    end: &'static str,
) -> OwnCode {
    OwnCode { code, register, cause, information, end }
}

/// Ends in the same message.
const AT_ONCE: &str = "at once: it is over when it is reported";
const RPDO: &str = "3: number of the RPDO";
const RESTART: &str = "3: cause, 4 to 7: address, as in 2000h sub-index 8 and 9";

pub(super) const CLOCK: OwnCode =
    row(0x5000, GENERIC, "the crystal has failed, and the device was reset", RESTART, AT_ONCE);
pub(super) const RESTARTED: OwnCode =
    row(0x6100, GENERIC, "the firmware has failed, and the device was reset", RESTART, AT_ONCE);
pub(super) const SETTINGS_LOST: OwnCode = row(
    0x6310,
    GENERIC,
    "the stored settings were damaged, and the defaults are in use",
    "",
    "settings are stored",
);
pub(super) const OVERRUN: OwnCode = row(
    0x8110,
    GENERIC | COMMUNICATION,
    "frames came faster than they were read, and were lost",
    "",
    AT_ONCE,
);
pub(super) const ERROR_PASSIVE: OwnCode = row(
    0x8120,
    GENERIC | COMMUNICATION,
    "the controller is error passive",
    "",
    "TEC is below 128 and REC below 96",
);
pub(crate) const HEARTBEAT_LOST: OwnCode = row(
    0x8130,
    GENERIC | COMMUNICATION,
    "a heartbeat that 1016h watches is missing",
    "3: node-ID",
    "none is missing",
);
pub(super) const BUS_OFF_RECOVERED: OwnCode =
    row(0x8140, GENERIC | COMMUNICATION, "the controller has recovered from bus-off", "", AT_ONCE);
pub(crate) const PDO_TOO_SHORT: OwnCode = row(
    0x8210,
    GENERIC | COMMUNICATION,
    "an RPDO is shorter than its mapping, and was ignored",
    RPDO,
    "one of the right length",
);
pub(crate) const PDO_TOO_LONG: OwnCode = row(
    0x8220,
    GENERIC | COMMUNICATION,
    "an RPDO is longer than its mapping; its first bytes are used",
    RPDO,
    "one of the right length",
);
pub(crate) const SYNC_LENGTH: OwnCode = row(
    0x8240,
    GENERIC | COMMUNICATION,
    "the length of a SYNC does not fit 1019h, and it was ignored",
    "3: its length",
    "one of the right length",
);
pub(crate) const PDO_LATE: OwnCode = row(
    0x8250,
    GENERIC | COMMUNICATION,
    "an RPDO has not come within its event timer",
    RPDO,
    "it comes",
);
pub(super) const AWAY_FROM_HOME_RATE: OwnCode = row(
    0xFF10,
    GENERIC | COMMUNICATION,
    "the node takes part at another bit rate than the last commanded one, its home rate",
    "3, 4: bit rate in use, 5, 6: home rate, in kbit/s",
    "it is at its home rate",
);

impl OwnCode {
    /// All of them, by their codes.
    pub const ALL: [Self; 12] = [
        CLOCK,
        RESTARTED,
        SETTINGS_LOST,
        OVERRUN,
        ERROR_PASSIVE,
        HEARTBEAT_LOST,
        BUS_OFF_RECOVERED,
        PDO_TOO_SHORT,
        PDO_TOO_LONG,
        SYNC_LENGTH,
        PDO_LATE,
        AWAY_FROM_HOME_RATE,
    ];
}

/// The codes alone, and that of no error.
const CODES: [u16; OwnCode::ALL.len() + 1] = {
    let mut codes = [0; OwnCode::ALL.len() + 1];
    let mut at = 0;
    while at < OwnCode::ALL.len() {
        codes[at] = OwnCode::ALL[at].code;
        at += 1;
    }
    codes
};

/// Whether only the node itself sends this code.
pub(crate) fn is_own(code: u16) -> bool {
    CODES.contains(&code)
}

/// The error code of an application: [`error_code!`](crate::error_code) calls it at compile time.
pub const fn of_application(code: u16) -> u16 {
    let mut at = 0;
    while at < CODES.len() {
        if CODES[at] == code {
            let cause = if code == 0 { "no error is left" } else { OwnCode::ALL[at].cause };
            let error = DeclarationError::new("error code ").hexadecimal(code);
            error.text("h is the node's own: ").text(cause).raise();
        }
        at += 1;
    }
    code
}

/// An error code for [`Node::report`](crate::Node::report). One that the node sends itself does not compile:
///
/// ```
/// const ON_TOO_LONG: u16 = canopen_node::error_code!(0xFF01);
/// assert_eq!(ON_TOO_LONG, 0xFF01);
/// ```
///
/// ```compile_fail
/// const ALARM: u16 = canopen_node::error_code!(0xFF10);
/// assert_eq!(ALARM, 0xFF10);
/// ```
///
/// `error code FF10h is the node's own: the node takes part at another bit rate than ...` is what the compiler says.
#[macro_export]
macro_rules! error_code {
    ($code:expr) => {
        const { $crate::private::of_application($code) }
    };
}
