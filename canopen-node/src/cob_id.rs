//! The CAN-IDs that a master cannot give to a PDO or to SYNC.

/// Whether CiA 301 reserves a CAN-ID (7.3.5, restricted CAN-IDs).
pub(crate) const fn is_restricted(id: u16) -> bool {
    matches!(
        id,
        0x000..=0x07F | 0x101..=0x180 | 0x581..=0x5FF | 0x601..=0x67F | 0x6E0..=0x6FF | 0x701..
    )
}
