use setloc_features::DESCRIPTOR_LEN;
use setloc_sfm::PointId;

use crate::{NearestPoints, squared_distances};

/// Rows compared at a time: 64 KiB of descriptors stay in the second-level cache for all queries of a tile.
const BLOCK_ROWS: usize = 512;

/// Offers the rows `range` of `descriptors` (row-major, `owner[row]` each row's point) to one query.
pub(crate) fn scan_rows(
    query: &[u8],
    descriptors: &[u8],
    range: std::ops::Range<usize>,
    owner: impl Fn(usize) -> PointId,
    nearest: &mut NearestPoints,
) {
    let mut distances = [0_u32; BLOCK_ROWS];
    let mut start = range.start;
    while start < range.end {
        let end = range.end.min(start + BLOCK_ROWS);
        let out = &mut distances[..end - start];
        squared_distances(query, &descriptors[start * DESCRIPTOR_LEN..end * DESCRIPTOR_LEN], out);
        let mut bound = nearest.bound();
        for (offset, &distance2) in out.iter().enumerate() {
            if distance2 < bound {
                nearest.offer(owner(start + offset), distance2);
                bound = nearest.bound();
            }
        }
        start = end;
    }
}

/// The two nearest points of each query, by comparing all rows; block by block so that rows are read once a tile.
pub(crate) fn nearest_exact(
    queries: &[u8],
    descriptors: &[u8],
    owner: impl Fn(usize) -> PointId,
) -> Vec<NearestPoints> {
    let rows = descriptors.len() / DESCRIPTOR_LEN;
    let mut nearest = vec![NearestPoints::default(); queries.len() / DESCRIPTOR_LEN];
    let mut start = 0;
    while start < rows {
        let end = rows.min(start + BLOCK_ROWS);
        for (query, nearest) in queries.chunks_exact(DESCRIPTOR_LEN).zip(&mut nearest) {
            scan_rows(query, descriptors, start..end, &owner, nearest);
        }
        start = end;
    }
    nearest
}
