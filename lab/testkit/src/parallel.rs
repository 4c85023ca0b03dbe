//! Work spread over all cores.

use std::{
    num::NonZero,
    sync::{
        atomic::{AtomicUsize, Ordering},
        mpsc,
    },
    thread,
};

/// Applies `work` to each of `items`, and passes on each result, with the item's index, as it arrives.
pub fn map<T: Sync, R: Send>(
    items: &[T],
    work: impl Fn(&T) -> R + Sync,
    mut take: impl FnMut(usize, R),
) {
    let workers = thread::available_parallelism().map_or(1, NonZero::get);
    let next = AtomicUsize::new(0);
    let (done, results) = mpsc::channel();
    thread::scope(|scope| {
        for _ in 0..workers {
            let (done, next, work) = (done.clone(), &next, &work);
            scope.spawn(move || {
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    let Some(item) = items.get(index) else { return };
                    if done.send((index, work(item))).is_err() {
                        return;
                    }
                }
            });
        }
        drop(done);
        for (index, result) in results {
            take(index, result);
        }
    });
}

#[cfg(test)]
mod tests {
    #[test]
    fn each_item_is_processed_once() {
        let mut squares = [0; 100];
        let numbers: Vec<usize> = (0..100).collect();
        super::map(&numbers, |number| number * number, |index, square| squares[index] += square);
        assert!(squares.iter().enumerate().all(|(number, square)| *square == number * number));
    }
}
