//! The application beside the node: a product's own objects (2000h to 9FFFh) as typed Rust values.
//!
//! [`objects!`](crate::objects) declares the objects; their values are the fields of a struct. The product implements
//! [`Application`] for it and gives it to [`Node::with_application`](crate::Node::with_application).
//!
//! ```
//! use canopen_node::{Application, objects, sdo::Abort};
//!
//! objects! {
//!     /// The objects of a dimmer.
//!     pub struct Dimmer, values DimmerValue;
//!
//!     0x2100 {
//!         0 "Brightness in percent" brightness: u8 = 50, rw in 0..=100, stored;
//!     }
//!     0x6000 "Inputs" {
//!         1 "Buttons" buttons: u8 = 0, ro, mappable;
//!     }
//! }
//!
//! impl Application for Dimmer {
//!     fn accept(&mut self, value: &DimmerValue) -> Result<(), Abort> {
//!         match value {
//!             DimmerValue::Brightness(1..=4) => Err(Abort::InvalidValue), // It would flicker.
//!             _ => Ok(()),
//!         }
//!     }
//! }
//!
//! assert_eq!(Dimmer::new().brightness, 50);
//! ```

pub(crate) mod check;
pub(crate) mod declaration;
pub(crate) mod event;
pub(crate) mod field;
pub(crate) mod process_data;
mod text;
mod value;

pub use event::Event;
pub use field::FieldType;
pub use text::{OctetString, Text};
pub use value::{
    Domain, Integer24, Integer40, Integer48, Integer56, LongText, Unsigned24, Unsigned40,
    Unsigned48, Unsigned56, ValueType,
};

use core::iter;

use lss_slave::bytes::copy;

use crate::{
    Program,
    count::{Count, Declares},
    nmt::ErrorBehaviour,
    object_dictionary::{Description, Entry},
    sdo::{self, Abort},
};
use process_data::{Rpdo, Tpdo};

/// The objects of a product: what [`objects!`](crate::objects) implements. By default there are none.
pub trait Dictionary {
    /// A value on its way into the dictionary, with the name of its field.
    type Value;
    /// The memory of the SDO server, with room for the longest value that a client can write.
    #[doc(hidden)]
    type SdoBuffer: sdo::Buffer;
    /// The numbers of PDOs and heartbeat producers, as the [`Application`] declares them.
    type Numbers: Declares<Self>;
    /// The objects, by index and sub-index.
    const OBJECTS: &'static [Entry] = &[];

    /// The descriptions of [`OBJECTS`](Self::OBJECTS), in the same order.
    fn descriptions() -> impl Iterator<Item = Description> {
        iter::empty()
    }

    /// The greatest number of bytes that the stored values take, with
    /// [`HEADER`](crate::settings::parameters::HEADER) bytes for each.
    const STORED_LEN: usize = 0;

    /// The length of the value of a field in bytes.
    fn len(&self, field: u8) -> usize {
        let _ = field;
        0
    }

    /// Copies the bytes of the value of a field from `offset` to `to`; returns their number.
    fn read(&self, field: u8, offset: usize, to: &mut [u8]) -> usize {
        let _ = (field, offset, to);
        0
    }

    /// The value of a field that a PDO can carry: its bytes, the first as the lowest.
    #[doc(hidden)]
    fn bits(&self, field: u8) -> u64 {
        let mut bytes = [0; 8];
        self.read(field, 0, &mut bytes);
        u64::from_le_bytes(bytes)
    }

    /// The value of a field in these bytes.
    ///
    /// # Errors
    /// The length is wrong, or the value is out of its limits.
    fn parse(field: u8, bytes: &[u8]) -> Result<Self::Value, Abort> {
        let _ = (field, bytes);
        Err(Abort::NoObject)
    }

    /// Replaces the value of a field.
    fn set(&mut self, value: Self::Value) {
        let _ = value;
    }

    /// The content of a value that is declared `with` a function to read it.
    #[doc(hidden)]
    fn domain(&self, index: u16, sub_index: u8) -> Option<&[u8]> {
        let _ = (index, sub_index);
        None
    }

    /// Writes a part of a value that is declared `with` a function for that.
    #[doc(hidden)]
    fn write_part(
        &mut self,
        index: u16,
        sub_index: u8,
        offset: u32,
        bytes: &[u8],
    ) -> Result<(), Abort> {
        let _ = (index, sub_index, offset, bytes);
        Err(Abort::Hardware)
    }
}

/// A product's behaviour beside the node. Each method does nothing by default.
pub trait Application: Dictionary {
    /// Device type 1000h: the number of a device profile of CiA and what the profile adds; 0 without a profile.
    const DEVICE_TYPE: u32 = 0;
    /// The TPDOs as a new device has them, 16 at most. [`Tpdo::UNUSED`] carries nothing before a master maps values.
    const TPDOS: &'static [Tpdo] = &[];
    /// The RPDOs as a new device has them, 16 at most. [`Rpdo::UNUSED`] carries nothing before a master maps values.
    const RPDOS: &'static [Rpdo] = &[];
    /// The number of nodes whose heartbeat a master can have watched: that of the entries of 1016h, 16 at most.
    const PRODUCERS: usize = 0;
    /// The nodes whose heartbeat a new device watches: the first entries of 1016h, each a node-ID and the time in
    /// milliseconds within which each heartbeat must come.
    const WATCHED: &'static [(u8, u16)] = &[];
    /// The reaction of a new device to bus-off and to a missing heartbeat: 1029h sub-index 1.
    const ERROR_BEHAVIOUR: ErrorBehaviour = ErrorBehaviour::EnterPreOperational;
    /// The time without a message of the client after which the SDO server ends a transfer, in milliseconds.
    ///
    /// CiA 301 gives no value. Usual clients wait 0.3 to 1 s for an answer, so a client that is silent for longer has
    /// given up. A client that makes longer pauses within a transfer needs a longer time.
    const SDO_TIMEOUT_MS: u16 = 1000;

    /// Whether a master without LSS can set node-ID and bit rate by SDO: object 2FF0h with the pending node-ID, which the
    /// next NMT reset communication activates, and the pending bit rate in kbit/s. 1010h stores both, sub-index 1 or 3. The
    /// object takes no code otherwise.
    const SETTINGS_BY_SDO: bool = false;

    /// Whether the node has the objects of program download (CiA 302-3) 1F50h, 1F51h, 1F56h and 1F57h, and 2001h with the
    /// state of an update. [`program`](Self::program) is what they do. They take no code otherwise.
    const PROGRAM_DOWNLOAD: bool = false;
    /// Whether the node may become NMT operational. A loader stays pre-operational, so that masters see that it is no
    /// device of their process.
    const MAY_OPERATE: bool = true;

    /// The program behind the objects of [program download](Self::PROGRAM_DOWNLOAD).
    fn program(&mut self) -> Option<&mut dyn Program> {
        None
    }

    /// Decides whether a client may write a value, which is within its limits. It is not called for stored values at
    /// the start.
    ///
    /// # Errors
    /// The abort code for the client, such as [`Abort::InvalidValue`], [`Abort::DeviceState`] or [`Abort::Hardware`].
    fn accept(&mut self, value: &Self::Value) -> Result<(), Abort> {
        let _ = value;
        Ok(())
    }

    /// Brings a value up to date that is about to be read: by a client, or for a TPDO. It is called before each look
    /// for a change in a TPDO, which follows every frame and change, so it must be short. A [`Domain`] and a store do
    /// without.
    fn before_read(&mut self, index: u16, sub_index: u8) {
        let _ = (index, sub_index);
    }

    /// Handles an event of the node: a new NMT state or bit rate, an RPDO that has taken effect or is late, a SYNC, and of
    /// each watched node the boot-up and the heartbeat that is missing or back. [`Event`] has them all.
    fn handle(&mut self, event: Event) {
        let _ = event;
    }

    /// The length of a [`Domain`] in bytes, at the beginning of an upload. What is read must not change until its end: a
    /// client that reads it by block transfer detects that by the CRC, others do not. A domain that may change is copied
    /// here.
    ///
    /// # Errors
    /// The abort code for the client, such as [`Abort::NoData`].
    fn domain_len(&mut self, index: u16, sub_index: u8) -> Result<u32, Abort> {
        self.domain(index, sub_index).map(|content| content.len() as u32).ok_or(Abort::NoData)
    }

    /// Copies a part of a [`Domain`], from `offset` to `to`; returns the number of bytes, which is that of `to` unless
    /// the domain ends.
    fn read_domain(&self, index: u16, sub_index: u8, offset: u32, to: &mut [u8]) -> usize {
        self.domain(index, sub_index).map_or(0, |content| copy(content, offset as usize, to))
    }

    /// Begins the download of a [`Domain`], before its first byte: of so many bytes, if the client `announced` that.
    ///
    /// # Errors
    /// The abort code for the client, such as [`Abort::TooLong`]. No other call follows.
    fn begin_domain(
        &mut self,
        index: u16,
        sub_index: u8,
        announced: Option<u32>,
    ) -> Result<(), Abort> {
        let _ = (index, sub_index, announced);
        Ok(())
    }

    /// Accepts the next part of a [`Domain`] from a client. The first part has offset 0; after the last one
    /// [`end_domain`](Self::end_domain) is called.
    ///
    /// # Errors
    /// The abort code for the client, such as [`Abort::Memory`].
    fn write_domain(
        &mut self,
        index: u16,
        sub_index: u8,
        offset: u32,
        bytes: &[u8],
    ) -> Result<(), Abort> {
        self.write_part(index, sub_index, offset, bytes)
    }

    /// Completes a [`Domain`] that a client has written: `len` bytes, whose CRC was right if the client sent one. A
    /// transfer that is cut short does not get here.
    ///
    /// # Errors
    /// The abort code for the client.
    fn end_domain(&mut self, index: u16, sub_index: u8, len: u32) -> Result<(), Abort> {
        let _ = (index, sub_index, len);
        Ok(())
    }

    /// Discards what a client has written of a [`Domain`]: the transfer was cut short, its CRC or length was wrong, or
    /// [`write_domain`](Self::write_domain) or [`end_domain`](Self::end_domain) refused it. Nothing may have been
    /// written yet.
    fn abort_domain(&mut self, index: u16, sub_index: u8) {
        let _ = (index, sub_index);
    }
}

/// The application of a node without one.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoApplication;

impl Dictionary for NoApplication {
    type Value = ();
    type SdoBuffer = [u8; declaration::longest(&[])];
    type Numbers = Count<0, 0, 0>;
}

impl Application for NoApplication {}
