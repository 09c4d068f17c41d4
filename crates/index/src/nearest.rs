use serde::{Deserialize, Serialize};
use setloc_sfm::PointId;

/// A scene point and its squared descriptor distance to a query.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Neighbour {
    /// The scene point.
    pub point: PointId,
    /// Smallest squared distance between the query's and the point's descriptors.
    pub distance2: u32,
}

/// The nearest and second-nearest *distinct* scene points of a query.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct NearestPoints {
    /// The nearest point.
    pub first: Option<Neighbour>,
    /// The nearest of all other points.
    pub second: Option<Neighbour>,
}

impl NearestPoints {
    /// Takes a descriptor of `point` at `distance2` into account; equal distances keep what came first.
    pub fn offer(&mut self, point: PointId, distance2: u32) {
        let offered = Neighbour { point, distance2 };
        match self.first {
            None => self.first = Some(offered),
            Some(first) if first.point == point => {
                if distance2 < first.distance2 {
                    self.first = Some(offered);
                }
            }
            Some(first) if distance2 < first.distance2 => {
                self.second = Some(first);
                self.first = Some(offered);
            }
            Some(_) => {
                if self.second.is_none_or(|second| distance2 < second.distance2) {
                    self.second = Some(offered);
                }
            }
        }
    }

    /// The nearest points of the union of two queries (two descriptors of one local point).
    ///
    /// Exact: the second-nearest point of the union is among the two nearest of the query that is nearest to it.
    pub fn merge(&mut self, other: &Self) {
        for neighbour in [other.first, other.second].into_iter().flatten() {
            self.offer(neighbour.point, neighbour.distance2);
        }
    }

    /// Distances larger than this cannot change the answer any more.
    pub(crate) fn bound(&self) -> u32 {
        self.second.map_or(u32::MAX, |second| second.distance2)
    }

    /// Distance to the nearest point over distance to the second, in 0 ..= 1; 1 when there is no second point.
    ///
    /// A scene of a single point gives no evidence of distinctness, hence 1.
    pub fn ratio(&self) -> f64 {
        match (self.first, self.second) {
            (Some(first), Some(second)) if second.distance2 > 0 => {
                (f64::from(first.distance2) / f64::from(second.distance2)).sqrt()
            }
            _ => 1.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn observations_of_one_point_do_not_compete() {
        let mut nearest = NearestPoints::default();
        for (point, distance2) in [(4, 100), (4, 90), (4, 95), (7, 400), (9, 360), (7, 380)] {
            nearest.offer(PointId(point), distance2);
        }
        assert_eq!(nearest.first, Some(Neighbour { point: PointId(4), distance2: 90 }));
        assert_eq!(nearest.second, Some(Neighbour { point: PointId(9), distance2: 360 }));
        assert!((nearest.ratio() - 0.5).abs() < 1e-12);
    }

    #[test]
    fn the_second_point_may_become_the_first() {
        let mut nearest = NearestPoints::default();
        for (point, distance2) in [(1, 100), (2, 200), (2, 50)] {
            nearest.offer(PointId(point), distance2);
        }
        assert_eq!(nearest.first.map(|n| n.point), Some(PointId(2)));
        assert_eq!(nearest.second, Some(Neighbour { point: PointId(1), distance2: 100 }));
    }
}
