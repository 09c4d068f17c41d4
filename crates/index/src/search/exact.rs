use setloc_features::{DESCRIPTOR_LEN, squared_norm, vectorized::Level};
use setloc_sfm::PointId;

use crate::kernel::{BLOCK_ROWS, TILE, TiledQueries};
use crate::{NearestPoints, squared_distances};

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
        offer(out, start, &owner, nearest);
        start = end;
    }
}

/// Offers the rows from `start` on, which are so far off.
fn offer(distances: &[u32], start: usize, owner: impl Fn(usize) -> PointId, nearest: &mut NearestPoints) {
    let mut bound = nearest.bound();
    for (offset, &distance2) in distances.iter().enumerate() {
        if distance2 < bound {
            nearest.offer(owner(start + offset), distance2);
            bound = nearest.bound();
        }
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
    let tiled = nearest.len() / TILE * TILE;
    let (in_tiles, alone) = queries.split_at(tiled * DESCRIPTOR_LEN);
    let tiles: Vec<TiledQueries> =
        in_tiles.chunks_exact(TILE * DESCRIPTOR_LEN).map(TiledQueries::new).collect();
    let level = Level::detect();
    let mut distances = [[0_u32; BLOCK_ROWS]; TILE];
    let mut start = 0;
    while start < rows {
        let end = rows.min(start + BLOCK_ROWS);
        let base = &descriptors[start * DESCRIPTOR_LEN..end * DESCRIPTOR_LEN];
        let norms: Vec<i32> = base.chunks_exact(DESCRIPTOR_LEN).map(squared_norm).collect();
        for (tile, nearest) in tiles.iter().zip(nearest.chunks_exact_mut(TILE)) {
            tile.squared_distances(level, base, &norms, &mut distances);
            for (distances, nearest) in distances.iter().zip(nearest) {
                offer(&distances[..end - start], start, &owner, nearest);
            }
        }
        for (query, nearest) in alone.chunks_exact(DESCRIPTOR_LEN).zip(&mut nearest[tiled..]) {
            scan_rows(query, descriptors, start..end, &owner, nearest);
        }
        start = end;
    }
    nearest
}
