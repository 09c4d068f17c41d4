use setloc_features::offer_nearer;
use setloc_sfm::PointId;

use crate::NearestPoints;

/// The two nearest points of each query, by comparing all rows (row-major, `owner(row)` each row's point).
pub(crate) fn nearest_exact(
    queries: &[u8],
    descriptors: &[u8],
    owner: impl Fn(usize) -> PointId + Sync,
) -> Vec<NearestPoints> {
    let mut nearest = vec![NearestPoints::default(); queries.len() / setloc_features::DESCRIPTOR_LEN];
    offer_nearer(queries, descriptors, &mut nearest, NearestPoints::bound, |nearest, row, distance2| {
        nearest.offer(owner(row), distance2);
    });
    nearest
}
