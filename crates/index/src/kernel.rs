use setloc_features::DESCRIPTOR_LEN;

/// Squared distances of one descriptor to all rows of `base`, appended nowhere: `out[i]` belongs to row `i`.
///
/// Unlike a [`DescriptorBlock`](setloc_features::DescriptorBlock), which knows the best two rows only, it tells what the
/// two nearest *points* of several rows each are made of.
///
/// `base` has `out.len()` rows of [`DESCRIPTOR_LEN`] bytes; further rows are ignored.
pub fn squared_distances(query: &[u8], base: &[u8], out: &mut [u32]) {
    for path in PATHS {
        if path(query, base, out) {
            return;
        }
    }
}

/// Queries that are compared with a row at a time: the row is read and widened once for all of them.
pub(crate) const TILE: usize = 4;

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

    /// [`squared_distances`] of each query, by ‖q‖² + ‖b‖² − 2 q·b; `base_norms` are ‖b‖².
    pub(crate) fn squared_distances<const ROWS: usize>(
        &self,
        base: &[u8],
        base_norms: &[i32],
        out: &mut [[u32; ROWS]; TILE],
    ) {
        #[cfg(target_arch = "x86_64")]
        {
            /// The portable loop, compiled for 512-bit integer arithmetic with its multiply-accumulate.
            #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
            fn by_avx512<const ROWS: usize>(
                tile: &TiledQueries,
                base: &[u8],
                base_norms: &[i32],
                out: &mut [[u32; ROWS]; TILE],
            ) {
                tile.portable(base, base_norms, out);
            }
            /// The portable loop, compiled for 256-bit integer arithmetic.
            #[target_feature(enable = "avx2")]
            fn by_avx2<const ROWS: usize>(
                tile: &TiledQueries,
                base: &[u8],
                base_norms: &[i32],
                out: &mut [[u32; ROWS]; TILE],
            ) {
                tile.portable(base, base_norms, out);
            }
            if is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512vnni")
            {
                // SAFETY: the processor has all features that the function asks for.
                return unsafe { by_avx512(self, base, base_norms, out) };
            }
            if is_x86_feature_detected!("avx2") {
                // SAFETY: the processor has the only feature that the function asks for.
                return unsafe { by_avx2(self, base, base_norms, out) };
            }
        }
        self.portable(base, base_norms, out);
    }

    #[inline(always)]
    fn portable<const ROWS: usize>(&self, base: &[u8], base_norms: &[i32], out: &mut [[u32; ROWS]; TILE]) {
        let (rows, _) = base.as_chunks::<DESCRIPTOR_LEN>();
        for (at, (row, norm)) in rows.iter().zip(base_norms).enumerate().take(ROWS) {
            let mut products = [0_i32; TILE];
            for i in 0..DESCRIPTOR_LEN {
                let byte = i32::from(i16::from(row[i]));
                for (product, wide) in products.iter_mut().zip(&self.wide) {
                    *product += i32::from(wide[i]) * byte;
                }
            }
            for ((out, product), own) in out.iter_mut().zip(products).zip(self.norms) {
                out[at] = (own + norm - 2 * product) as u32;
            }
        }
    }
}

/// ‖b‖² of a descriptor.
pub(crate) fn squared_norm(descriptor: &[u8; DESCRIPTOR_LEN]) -> i32 {
    descriptor.iter().map(|&byte| i32::from(byte) * i32::from(byte)).sum()
}

/// One way to [`squared_distances`]; `false`, with `out` untouched, where the processor lacks the instructions.
type Path = fn(&[u8], &[u8], &mut [u32]) -> bool;

/// All ways, the fastest first; the results are the same.
const PATHS: &[Path] = &[
    #[cfg(target_arch = "x86_64")]
    by_avx512,
    #[cfg(target_arch = "x86_64")]
    by_avx2,
    by_any_processor,
];

#[cfg(target_arch = "x86_64")]
fn by_avx512(query: &[u8], base: &[u8], out: &mut [u32]) -> bool {
    /// The portable loop, compiled for 512-bit integer arithmetic with its multiply-accumulate.
    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
    fn compiled(query: &[u8], base: &[u8], out: &mut [u32]) {
        portable(query, base, out);
    }
    let is_there = is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512vnni");
    if is_there {
        // SAFETY: the processor has all features that the function asks for.
        unsafe { compiled(query, base, out) };
    }
    is_there
}

#[cfg(target_arch = "x86_64")]
fn by_avx2(query: &[u8], base: &[u8], out: &mut [u32]) -> bool {
    /// The portable loop, compiled for 256-bit integer arithmetic.
    #[target_feature(enable = "avx2")]
    fn compiled(query: &[u8], base: &[u8], out: &mut [u32]) {
        portable(query, base, out);
    }
    let is_there = is_x86_feature_detected!("avx2");
    if is_there {
        // SAFETY: the processor has the only feature that the function asks for.
        unsafe { compiled(query, base, out) };
    }
    is_there
}

fn by_any_processor(query: &[u8], base: &[u8], out: &mut [u32]) -> bool {
    portable(query, base, out);
    true
}

#[inline(always)]
fn portable(query: &[u8], base: &[u8], out: &mut [u32]) {
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

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use setloc_features::squared_distance;

    #[test]
    fn every_path_agrees_with_the_definition() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let rows = 37;
        let mut base: Vec<u8> = (0..rows * DESCRIPTOR_LEN).map(|_| rng.random()).collect();
        base[..DESCRIPTOR_LEN].fill(255);
        let queries: [Vec<u8>; 2] =
            [vec![0; DESCRIPTOR_LEN], (0..DESCRIPTOR_LEN).map(|_| rng.random()).collect()];
        for query in &queries {
            let expected: Vec<u32> =
                base.chunks_exact(DESCRIPTOR_LEN).map(|row| squared_distance(query, row)).collect();
            let by = |path: Path| {
                let mut found = vec![0; rows];
                path(query, &base, &mut found).then_some(found)
            };
            let found: Vec<Vec<u32>> = PATHS.iter().filter_map(|path| by(*path)).collect();
            assert!(!found.is_empty() && found.iter().all(|found| *found == expected));
            let mut found = vec![0; rows];
            squared_distances(query, &base, &mut found);
            assert_eq!(found, expected);
        }
        assert_eq!(squared_distance(&queries[0], &base[..DESCRIPTOR_LEN]), 128 * 255 * 255);
    }

    #[test]
    fn queries_side_by_side_have_the_distances_that_they_have_alone() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut base: Vec<u8> = (0..37 * DESCRIPTOR_LEN).map(|_| rng.random()).collect();
        base[..DESCRIPTOR_LEN].fill(255);
        let mut queries: Vec<u8> = (0..TILE * DESCRIPTOR_LEN).map(|_| rng.random()).collect();
        queries[..DESCRIPTOR_LEN].fill(0);
        let norms: Vec<i32> = base.as_chunks().0.iter().map(squared_norm).collect();
        let (mut by_tile, mut by_portable) = ([[0; 37]; TILE], [[0; 37]; TILE]);
        let tile = TiledQueries::new(&queries);
        tile.squared_distances(&base, &norms, &mut by_tile);
        tile.portable(&base, &norms, &mut by_portable);
        assert_eq!(by_tile, by_portable);
        for (query, found) in queries.chunks_exact(DESCRIPTOR_LEN).zip(&by_tile) {
            let mut alone = [0; 37];
            squared_distances(query, &base, &mut alone);
            assert_eq!(*found, alone);
        }
    }
}
