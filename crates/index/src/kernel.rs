use setloc_features::{DESCRIPTOR_LEN, squared_norm, vectorized, vectorized::Level};

/// Squared distances of one descriptor to all rows of `base`, appended nowhere: `out[i]` belongs to row `i`.
///
/// Unlike a [`DescriptorBlock`](setloc_features::DescriptorBlock), which knows the best two rows only, it tells what the
/// two nearest *points* of several rows each are made of.
///
/// `base` has `out.len()` rows of [`DESCRIPTOR_LEN`] bytes; further rows are ignored.
pub fn squared_distances(query: &[u8], base: &[u8], out: &mut [u32]) {
    distances_alone(Level::detect(), query, base, out);
}

vectorized! {
    /// [`squared_distances`].
    fn distances_alone(query: &[u8], base: &[u8], out: &mut [u32]) {
        let mut wide = [0_i16; DESCRIPTOR_LEN];
        for (wide, &byte) in wide.iter_mut().zip(query) {
            *wide = i16::from(byte);
        }
        let (rows, _) = base.as_chunks::<DESCRIPTOR_LEN>();
        for (out, row) in out.iter_mut().zip(rows) {
            let mut sum = 0_i32;
            for i in 0..DESCRIPTOR_LEN {
                let difference = wide[i] - i16::from(row[i]);
                sum += i32::from(difference) * i32::from(difference);
            }
            *out = sum as u32;
        }
    }
}

/// Queries that are compared with a row at a time: the row is read and widened once for all of them.
pub(crate) const TILE: usize = 4;
/// Rows that a tile is compared with at a time: 64 KiB of descriptors stay in the second-level cache for all tiles.
pub(crate) const BLOCK_ROWS: usize = 512;

/// Some queries prepared for [`TiledQueries::squared_distances`].
pub(crate) struct TiledQueries {
    wide: [[i16; DESCRIPTOR_LEN]; TILE],
    norms: [i32; TILE],
}

impl TiledQueries {
    /// Of row-major descriptors, [`TILE`] of them.
    pub(crate) fn new(queries: &[u8]) -> Self {
        let (rows, _) = queries.as_chunks::<DESCRIPTOR_LEN>();
        let mut tile = Self { wide: [[0; DESCRIPTOR_LEN]; TILE], norms: [0; TILE] };
        for ((wide, norm), row) in tile.wide.iter_mut().zip(&mut tile.norms).zip(rows) {
            *wide = row.map(i16::from);
            *norm = squared_norm(row);
        }
        tile
    }

    /// [`squared_distances`] of each query to at most [`BLOCK_ROWS`] rows, by ‖q‖² + ‖b‖² − 2 q·b; `base_norms` are
    /// ‖b‖².
    pub(crate) fn squared_distances(
        &self,
        level: Level,
        base: &[u8],
        base_norms: &[i32],
        out: &mut [[u32; BLOCK_ROWS]; TILE],
    ) {
        distances_of_tile(level, self, base, base_norms, out);
    }
}

vectorized! {
    /// [`TiledQueries::squared_distances`].
    fn distances_of_tile(
        tile: &TiledQueries,
        base: &[u8],
        base_norms: &[i32],
        out: &mut [[u32; BLOCK_ROWS]; TILE],
    ) {
        let (rows, _) = base.as_chunks::<DESCRIPTOR_LEN>();
        for (at, (row, norm)) in rows.iter().zip(base_norms).enumerate().take(BLOCK_ROWS) {
            let mut products = [0_i32; TILE];
            for i in 0..DESCRIPTOR_LEN {
                let byte = i32::from(i16::from(row[i]));
                for (product, wide) in products.iter_mut().zip(&tile.wide) {
                    *product += i32::from(wide[i]) * byte;
                }
            }
            for ((out, product), own) in out.iter_mut().zip(products).zip(tile.norms) {
                out[at] = (own + norm - 2 * product) as u32;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use setloc_features::squared_distance;

    /// Some queries and rows, some of them as far apart as bytes allow.
    fn descriptors(queries: usize, rows: usize) -> (Vec<u8>, Vec<u8>) {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut random = |rows: usize| (0..rows * DESCRIPTOR_LEN).map(|_| rng.random()).collect();
        let (mut queries, mut base): (Vec<u8>, Vec<u8>) = (random(queries), random(rows));
        queries[..DESCRIPTOR_LEN].fill(0);
        base[..DESCRIPTOR_LEN].fill(255);
        (queries, base)
    }

    fn by_definition(query: &[u8], base: &[u8]) -> Vec<u32> {
        base.chunks_exact(DESCRIPTOR_LEN).map(|row| squared_distance(query, row)).collect()
    }

    #[test]
    fn distances_are_the_definitions_on_every_processor() {
        let (queries, base) = descriptors(TILE, 37);
        assert_eq!(squared_distance(&queries[..DESCRIPTOR_LEN], &base[..DESCRIPTOR_LEN]), 128 * 255 * 255);
        for level in Level::all() {
            for query in queries.chunks_exact(DESCRIPTOR_LEN) {
                let mut found = [0; 37];
                distances_alone(level, query, &base, &mut found);
                assert_eq!(found[..], by_definition(query, &base));
            }
        }
    }

    #[test]
    fn queries_side_by_side_have_the_distances_that_they_have_alone() {
        let (queries, base) = descriptors(TILE, 37);
        let norms: Vec<i32> = base.chunks_exact(DESCRIPTOR_LEN).map(squared_norm).collect();
        let tile = TiledQueries::new(&queries);
        for level in Level::all() {
            let mut found = [[u32::MAX; BLOCK_ROWS]; TILE];
            tile.squared_distances(level, &base, &norms, &mut found);
            for (query, found) in queries.chunks_exact(DESCRIPTOR_LEN).zip(&found) {
                assert_eq!(found[..37], by_definition(query, &base));
                assert!(found[37..].iter().all(|&untouched| untouched == u32::MAX));
            }
        }
    }
}
