use std::ops::Deref;

/// The real solutions of a minimal problem: a list of at most `N` without heap.
#[derive(Debug, Clone, Copy)]
pub struct Solutions<T, const N: usize> {
    items: [T; N],
    len: usize,
}

impl<T: Copy + Default, const N: usize> Default for Solutions<T, N> {
    fn default() -> Self {
        Self { items: [T::default(); N], len: 0 }
    }
}

impl<T: Copy + Default, const N: usize> Solutions<T, N> {
    /// Appends a solution; returns `false`, without change, when the list is full.
    #[inline]
    pub fn push(&mut self, item: T) -> bool {
        if self.len == N {
            return false;
        }
        self.items[self.len] = item;
        self.len += 1;
        true
    }

    /// Sorts the solutions by a key, smallest first; keys that are not numbers go last.
    pub fn sort_by_key(&mut self, key: impl Fn(&T) -> f64) {
        self.items[..self.len].sort_by(|a, b| key(a).total_cmp(&key(b)));
    }
}

impl<T: Copy + Default, const N: usize> Solutions<(f64, T), N> {
    /// The solutions without their residuals, smallest residual first.
    pub fn by_residual(mut self) -> Solutions<T, N> {
        self.sort_by_key(|(residual, _)| *residual);
        let mut sorted = Solutions::default();
        for (_, solution) in &self {
            sorted.push(*solution);
        }
        sorted
    }
}

impl<T, const N: usize> Deref for Solutions<T, N> {
    type Target = [T];

    #[inline]
    fn deref(&self) -> &[T] {
        &self.items[..self.len]
    }
}

impl<'a, T, const N: usize> IntoIterator for &'a Solutions<T, N> {
    type Item = &'a T;
    type IntoIter = std::slice::Iter<'a, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::Solutions;

    #[test]
    fn refuses_more_than_its_capacity() {
        let mut list = Solutions::<u32, 2>::default();
        assert!(list.push(7) && list.push(3));
        assert!(!list.push(9));
        list.sort_by_key(|item| f64::from(*item));
        assert_eq!(&*list, &[3, 7]);
    }

    #[test]
    fn residuals_order_the_solutions() {
        let mut list = Solutions::<(f64, char), 3>::default();
        for item in [(0.5, 'c'), (f64::NAN, 'd'), (0.1, 'a')] {
            assert!(list.push(item));
        }
        assert_eq!(&*list.by_residual(), &['a', 'c', 'd']);
    }
}
