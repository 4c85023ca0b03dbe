//! A classic CAN frame as on the wire: identifier, remote bit, data length code and data.

use core::fmt;

/// An identifier (ISO 11898-1, arbitration field).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Id {
    /// Base format: 11 bits, 0..=0x7FF.
    Standard(u16),
    /// Extended format: 29 bits, 0..=0x1FFF_FFFF.
    Extended(u32),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Frame {
    pub id: Id,
    /// Whether the RTR bit is recessive; the frame then carries no data.
    pub remote: bool,
    /// Data length code as on the wire, 0..=15. Codes 9..=15 mean eight bytes.
    pub dlc: u8,
    /// Data; bytes past the data length are zero.
    pub data: [u8; 8],
}

impl Frame {
    /// A data frame.
    ///
    /// # Panics
    /// More than eight bytes of `payload`, or an identifier out of range.
    pub fn data(id: Id, payload: &[u8]) -> Self {
        let mut data = [0; 8];
        data[..payload.len()].copy_from_slice(payload);
        Self { id: checked(id), remote: false, dlc: payload.len() as u8, data }
    }

    /// A remote frame.
    ///
    /// # Panics
    /// `dlc` above 15, or an identifier out of range.
    pub fn remote(id: Id, dlc: u8) -> Self {
        assert!(dlc <= 15, "a data length code has four bits");
        Self { id: checked(id), remote: true, dlc, data: [0; 8] }
    }

    /// The same frame with another data length code, such as 9..=15 with eight bytes.
    ///
    /// # Panics
    /// `dlc` above 15.
    pub fn with_dlc(self, dlc: u8) -> Self {
        assert!(dlc <= 15, "a data length code has four bits");
        Self { dlc, ..self }
    }

    /// The bytes in the data field: none in a remote frame, otherwise the lesser of DLC and eight.
    pub fn payload(&self) -> &[u8] {
        let length = if self.remote { 0 } else { self.dlc.min(8) };
        &self.data[..usize::from(length)]
    }

    /// The arbitration field as a number: of two frames that start together, the lower one wins.
    pub fn arbitration(&self) -> u32 {
        let remote = u32::from(self.remote);
        match self.id {
            Id::Standard(id) => u32::from(id) << 21 | remote << 20,
            Id::Extended(id) => id >> 18 << 21 | 0b11 << 19 | (id & 0x3_FFFF) << 1 | remote,
        }
    }
}

fn checked(id: Id) -> Id {
    match id {
        Id::Standard(id) => assert!(id <= 0x7FF, "{id:#x} is no 11-bit identifier"),
        Id::Extended(id) => assert!(id <= 0x1FFF_FFFF, "{id:#x} is no 29-bit identifier"),
    }
    id
}

impl fmt::Display for Id {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Standard(id) => write!(f, "{id:03X}"),
            Self::Extended(id) => write!(f, "{id:08X}"),
        }
    }
}

/// The notation of candump: `7E5#0401000000000000`, `000007E5#`, `7E5#R8`, and `_9` for a DLC above eight.
impl fmt::Display for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}#", self.id)?;
        if self.remote {
            write!(f, "R")?;
            if self.dlc > 0 {
                write!(f, "{}", self.dlc.min(8))?;
            }
        }
        for byte in self.payload() {
            write!(f, "{byte:02X}")?;
        }
        if self.dlc > 8 {
            write!(f, "_{:X}", self.dlc)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_written_as_candump_writes_them() {
        let id = Id::Standard(0x7E5);
        assert_eq!(Frame::data(id, &[4, 1]).to_string(), "7E5#0401");
        assert_eq!(Frame::data(Id::Extended(0x7E5), &[]).to_string(), "000007E5#");
        assert_eq!(Frame::remote(id, 8).to_string(), "7E5#R8");
        assert_eq!(Frame::data(id, &[0xAB; 8]).with_dlc(9).to_string(), "7E5#ABABABABABABABAB_9");
    }
}
