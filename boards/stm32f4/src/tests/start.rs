//! What the drivers use of [`start`](crate::start), where nothing changes meanwhile.

/// Without the wait.
pub fn comes_in_100_ms(it_is_there: impl Fn() -> bool) -> bool {
    it_is_there()
}
