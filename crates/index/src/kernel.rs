use setloc_features::{DESCRIPTOR_LEN, vectorized, vectorized::Level};

/// Squared distances of one descriptor to all rows of `base`, appended nowhere: `out[i]` belongs to row `i`.
///
/// For one descriptor at a time; many are compared faster by [`setloc_features::offer_nearer`].
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
        let (queries, base) = descriptors(4, 37);
        assert_eq!(squared_distance(&queries[..DESCRIPTOR_LEN], &base[..DESCRIPTOR_LEN]), 128 * 255 * 255);
        for level in Level::all() {
            for query in queries.chunks_exact(DESCRIPTOR_LEN) {
                let mut found = [0; 37];
                distances_alone(level, query, &base, &mut found);
                assert_eq!(found[..], by_definition(query, &base));
            }
        }
    }
}
