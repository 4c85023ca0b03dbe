//! The abort codes of SDO (CiA 301, 7.2.4.3.17) that the cases accept.

pub const WRONG_TOGGLE: u32 = 0x0503_0000;
pub const TIMEOUT: u32 = 0x0504_0000;
pub const UNKNOWN_COMMAND: u32 = 0x0504_0001;
pub const WRONG_BLOCK_SIZE: u32 = 0x0504_0002;
pub const WRONG_SEQUENCE_NUMBER: u32 = 0x0504_0003;
pub const WRONG_CRC: u32 = 0x0504_0004;
pub const UNSUPPORTED_ACCESS: u32 = 0x0601_0000;
pub const CANNOT_BE_READ: u32 = 0x0601_0001;
pub const CANNOT_BE_WRITTEN: u32 = 0x0601_0002;
pub const NO_OBJECT: u32 = 0x0602_0000;
pub const CANNOT_BE_MAPPED: u32 = 0x0604_0041;
pub const PDO_LENGTH: u32 = 0x0604_0042;
pub const INCOMPATIBLE: u32 = 0x0604_0043;
pub const WRONG_LENGTH: u32 = 0x0607_0010;
pub const TOO_LONG: u32 = 0x0607_0012;
pub const TOO_SHORT: u32 = 0x0607_0013;
pub const NO_SUB_INDEX: u32 = 0x0609_0011;
pub const INVALID_VALUE: u32 = 0x0609_0030;
pub const TOO_HIGH: u32 = 0x0609_0031;
pub const TOO_LOW: u32 = 0x0609_0032;
pub const GENERAL: u32 = 0x0800_0000;
pub const CANNOT_BE_STORED: u32 = 0x0800_0020;
pub const NOT_NOW: u32 = 0x0800_0022;
pub const NO_DATA: u32 = 0x0800_0024;

/// A write to a value that can only be read.
pub const READ_ONLY: &[u32] = &[UNSUPPORTED_ACCESS, CANNOT_BE_WRITTEN, GENERAL];
/// A read of a value that can only be written.
pub const WRITE_ONLY: &[u32] = &[UNSUPPORTED_ACCESS, CANNOT_BE_READ, GENERAL];
pub const ABOVE_LIMIT: &[u32] = &[INVALID_VALUE, TOO_HIGH, GENERAL];
pub const BELOW_LIMIT: &[u32] = &[INVALID_VALUE, TOO_LOW, GENERAL];
