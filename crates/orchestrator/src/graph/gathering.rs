//! A queue that hands on together what comes soon after each other.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// When what waits is handed on.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limits {
    /// How long an item waits for others.
    pub time: Duration,
    /// Bytes of items that wait for no others.
    pub enough_bytes: usize,
    /// Bytes of items that may wait; further ones hold up those who bring them.
    pub most_bytes: usize,
}

/// Items on their way from many threads to some.
///
/// Who takes is woken when the first item comes and when there are enough, not for each.
pub(super) struct Gathering<T> {
    limits: Limits,
    waiting: Mutex<Waiting<T>>,
    comes: Condvar,
    goes: Condvar,
}

struct Waiting<T> {
    items: Vec<T>,
    bytes: usize,
    /// When the first of the items came.
    since: Instant,
    is_closed: bool,
}

impl<T> Gathering<T> {
    pub fn new(limits: Limits) -> Self {
        let waiting = Waiting { items: Vec::new(), bytes: 0, since: Instant::now(), is_closed: false };
        Self { limits, waiting: Mutex::new(waiting), comes: Condvar::new(), goes: Condvar::new() }
    }

    /// Adds an item of so many bytes; waits while too much waits.
    pub fn add(&self, item: T, bytes: usize) {
        let is_full = |waiting: &mut Waiting<T>| waiting.bytes >= self.limits.most_bytes;
        let mut waiting = self.goes.wait_while(self.lock(), is_full).unwrap_or_else(PoisonError::into_inner);
        if waiting.items.is_empty() {
            waiting.since = Instant::now();
            self.comes.notify_one();
        }
        waiting.items.push(item);
        waiting.bytes += bytes;
        if waiting.bytes >= self.limits.enough_bytes {
            self.comes.notify_one();
        }
    }

    /// While this lives, more may come.
    pub fn open(&self) -> Open<'_, T> {
        Open(self)
    }

    /// The next items, in the order they came; none when no more will come.
    pub fn next(&self) -> Vec<T> {
        let mut waiting = self.lock();
        loop {
            let age = waiting.since.elapsed();
            let is_due = waiting.bytes >= self.limits.enough_bytes || age >= self.limits.time;
            if waiting.is_closed || (is_due && !waiting.items.is_empty()) {
                waiting.bytes = 0;
                self.goes.notify_all();
                return std::mem::take(&mut waiting.items);
            }
            waiting = if waiting.items.is_empty() {
                self.comes.wait(waiting).unwrap_or_else(PoisonError::into_inner)
            } else {
                let left = self.limits.time.saturating_sub(age);
                self.comes.wait_timeout(waiting, left).unwrap_or_else(PoisonError::into_inner).0
            };
        }
    }

    fn lock(&self) -> MutexGuard<'_, Waiting<T>> {
        // Nothing that panics happens under the lock.
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Says, when it is dropped, that no more will come: in a panic too, so that nobody waits forever.
pub(super) struct Open<'g, T>(&'g Gathering<T>);

impl<T> Drop for Open<'_, T> {
    fn drop(&mut self) {
        self.0.lock().is_closed = true;
        self.0.comes.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: Limits = Limits { time: Duration::from_hours(1), enough_bytes: 10, most_bytes: 20 };

    #[test]
    fn enough_items_go_together_and_the_rest_at_the_end() {
        let gathering = Gathering::new(LIMITS);
        for (item, bytes) in [(1, 4), (2, 4), (3, 4)] {
            gathering.add(item, bytes);
        }
        assert_eq!(gathering.next(), [1, 2, 3]);
        gathering.add(4, 1);
        drop(gathering.open());
        assert_eq!(gathering.next(), [4]);
        assert!(gathering.next().is_empty());
    }

    #[test]
    fn a_lone_item_goes_after_its_time() {
        let gathering = Gathering::new(Limits { time: Duration::from_millis(1), ..LIMITS });
        gathering.add(1, 1);
        assert_eq!(gathering.next(), [1]);
    }

    #[test]
    fn no_item_is_lost_between_threads_and_too_many_wait_for_room() {
        let gathering = Gathering::new(Limits { time: Duration::from_millis(1), ..LIMITS });
        let taken = Mutex::new(Vec::new());
        std::thread::scope(|threads| {
            let _open = gathering.open();
            for _ in 0..3 {
                threads.spawn(|| {
                    loop {
                        let items = gathering.next();
                        if items.is_empty() {
                            return;
                        }
                        taken.lock().unwrap().extend(items);
                    }
                });
            }
            std::thread::scope(|threads| {
                for from in 0..4 {
                    let gathering = &gathering;
                    threads.spawn(move || (0..100).for_each(|item| gathering.add(100 * from + item, 7)));
                }
            });
        });
        let mut taken = taken.into_inner().unwrap();
        taken.sort_unstable();
        assert_eq!(taken, (0..400).collect::<Vec<_>>());
    }
}
