//! What local points tie of a set's standpoints.

/// Local points that tie two standpoints.
const MIN_TIE: usize = 8;

/// How many local points each two standpoints share.
pub(super) struct Ties(Vec<Vec<usize>>);

impl Ties {
    /// Of so many standpoints; `tracks` are those that see each point, as often as each is to count.
    pub fn new(standpoints: usize, tracks: impl IntoIterator<Item: AsRef<[usize]>>) -> Self {
        let mut shared = vec![vec![0_usize; standpoints]; standpoints];
        for track in tracks {
            for &a in track.as_ref() {
                for &b in track.as_ref() {
                    shared[a][b] += 1;
                }
            }
        }
        Self(shared)
    }

    /// Which standpoints are tied to one, be it by others, but for ties that are cut.
    pub fn reached(&self, from: usize, is_cut: impl Fn(usize, usize) -> bool) -> Vec<bool> {
        let mut reached = vec![false; self.0.len()];
        let mut waiting = vec![from];
        while let Some(at) = waiting.pop() {
            if !std::mem::replace(&mut reached[at], true) {
                let is_tied = |&other: &usize| self.0[at][other] >= MIN_TIE && !is_cut(at, other);
                waiting.extend((0..self.0.len()).filter(is_tied));
            }
        }
        reached
    }
}
