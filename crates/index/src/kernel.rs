use setloc_features::DESCRIPTOR_LEN;

/// Squared distances of one descriptor to all rows of `base`, appended nowhere: `out[i]` belongs to row `i`.
///
/// Unlike a [`DescriptorBlock`](setloc_features::DescriptorBlock), which knows the best two rows only, it tells what the
/// two nearest *points* of several rows each are made of.
///
/// `base` has `out.len()` rows of [`DESCRIPTOR_LEN`] bytes; further rows are ignored.
pub fn squared_distances(query: &[u8], base: &[u8], out: &mut [u32]) {
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx512bw") && is_x86_feature_detected!("avx512vnni") {
            // SAFETY: the processor has the features that the function asks for.
            unsafe { squared_distances_avx512(query, base, out) };
            return;
        }
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has the only feature that the function asks for.
            unsafe { squared_distances_avx2(query, base, out) };
            return;
        }
    }
    squared_distances_portable(query, base, out);
}

/// The portable loop, compiled for 256-bit integer arithmetic.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn squared_distances_avx2(query: &[u8], base: &[u8], out: &mut [u32]) {
    squared_distances_portable(query, base, out);
}

/// The portable loop, compiled for 512-bit integer arithmetic with its multiply-accumulate.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
fn squared_distances_avx512(query: &[u8], base: &[u8], out: &mut [u32]) {
    squared_distances_portable(query, base, out);
}

#[inline(always)]
fn squared_distances_portable(query: &[u8], base: &[u8], out: &mut [u32]) {
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
            let (mut fast, mut portable) = (vec![0; rows], vec![0; rows]);
            squared_distances(query, &base, &mut fast);
            squared_distances_portable(query, &base, &mut portable);
            assert_eq!(fast, expected);
            assert_eq!(portable, expected);
        }
        assert_eq!(squared_distance(&queries[0], &base[..DESCRIPTOR_LEN]), 128 * 255 * 255);
    }
}
