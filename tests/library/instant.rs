//! Instants: microseconds of a counter that wraps.

use canopen_node::Instant;

#[test]
fn a_later_instant_comes_when_the_count_reaches_it_also_across_the_wrap() {
    for start in [0, 1_000, u32::MAX - 5, u32::MAX] {
        let now = Instant::from_micros(start);
        for span in [1, 10, u32::MAX / 2] {
            let later = now.plus_micros(span);
            assert!(!later.has_come(now));
            assert_eq!(later.micros_after(now), span);
            assert!(later.has_come(later));
            assert!(now.has_come(later));
            assert_eq!(now.micros_after(later), 0);
        }
    }
}
