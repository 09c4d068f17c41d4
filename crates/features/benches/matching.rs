//! Matcher throughput in multiply-adds per second against the processor's own peak, measured in the same run.
//!
//! Read criterion's `thrpt`: one element is one u8 multiply-add, so Gelem/s are GMAC/s.

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use setloc_features::{DESCRIPTOR_LEN, ImageFeatures, MatchParams, Posture, match_features, two_nearest};

/// Pairs of images that are matched at once.
const PAIRS: u64 = 16;
/// Keypoints of each of their images.
const PAIR_FEATURES: usize = 4096;

/// Descriptors of random directions with the stored norm, as RootSIFT's are.
fn random_features(seed: u64, count: usize) -> ImageFeatures {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut descriptors = Vec::with_capacity(count * DESCRIPTOR_LEN);
    for _ in 0..count {
        let values: Vec<f32> = (0..DESCRIPTOR_LEN).map(|_| rng.random::<f32>().powi(2)).collect();
        let norm = values.iter().map(|value| value * value).sum::<f32>().sqrt();
        descriptors.extend(values.iter().map(|value| (value / norm * 512.0).round() as u8));
    }
    ImageFeatures {
        keypoints: vec![bytemuck::Zeroable::zeroed(); count],
        descriptors,
        ..ImageFeatures::default()
    }
}

/// Two images of which every second keypoint of one is one of the other's, a little changed: they match, so all of them
/// are compared.
fn related_features(seed: u64, count: usize) -> (ImageFeatures, ImageFeatures) {
    let first = random_features(seed, count);
    let mut second = random_features(seed + 1, count);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let descriptors = second.descriptors.chunks_exact_mut(DESCRIPTOR_LEN);
    for (own, other) in descriptors.zip(first.descriptors.chunks_exact(DESCRIPTOR_LEN)).step_by(2) {
        for (own, other) in own.iter_mut().zip(other) {
            *own = other.saturating_add(rng.random_range(0..8));
        }
    }
    (first, second)
}

/// The fastest u8 multiply-add loop this processor can run: independent accumulators, no memory.
#[cfg(target_arch = "x86_64")]
mod peak {
    use std::arch::x86_64::{
        __m256i, __m512i, _mm256_add_epi16, _mm256_maddubs_epi16, _mm256_set1_epi32, _mm256_setzero_si256,
        _mm512_dpbusd_epi32, _mm512_set1_epi32, _mm512_setzero_si512,
    };
    use std::hint::black_box;

    pub const STEPS: u64 = 1 << 18;
    const ACCUMULATORS: usize = 12;

    /// Name of the instruction, multiply-adds per call, and the loop.
    pub fn best() -> Option<(&'static str, u64, fn())> {
        let loops = STEPS * ACCUMULATORS as u64;
        if std::arch::is_x86_feature_detected!("avx512vnni")
            && std::arch::is_x86_feature_detected!("avx512bw")
        {
            // SAFETY: the instructions are there, as just checked.
            Some(("vpdpbusd zmm", loops * 64, || unsafe { vnni() }))
        } else if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the instructions are there, as just checked.
            Some(("vpmaddubsw ymm", loops * 32, || unsafe { maddubs() }))
        } else {
            None
        }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512vnni")]
    fn vnni() {
        let (a, b) = (_mm512_set1_epi32(black_box(0x0102_0304)), _mm512_set1_epi32(black_box(0x0506_0708)));
        let mut sums: [__m512i; ACCUMULATORS] = [_mm512_setzero_si512(); ACCUMULATORS];
        for _ in 0..STEPS {
            for sum in &mut sums {
                *sum = _mm512_dpbusd_epi32(*sum, a, b);
            }
        }
        black_box(sums);
    }

    #[target_feature(enable = "avx2")]
    fn maddubs() {
        let a = _mm256_set1_epi32(black_box(0x0102_0304));
        let mut sums: [__m256i; ACCUMULATORS] = [_mm256_setzero_si256(); ACCUMULATORS];
        for _ in 0..STEPS {
            for sum in &mut sums {
                // The factor depends on the sum, so that the product cannot be taken out of the loop.
                *sum = _mm256_add_epi16(*sum, _mm256_maddubs_epi16(*sum, a));
            }
        }
        black_box(sums);
    }
}

fn matching(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("matching");
    group.sample_size(20);
    #[cfg(target_arch = "x86_64")]
    if let Some((name, multiply_adds, run)) = peak::best() {
        group.throughput(Throughput::Elements(multiply_adds));
        group.bench_function(format!("peak {name}"), |bencher| bencher.iter(run));
    }
    for count in [1024, 8192] {
        let (first, second) = (random_features(1, count), random_features(2, count));
        group.throughput(Throughput::Elements((count * count * DESCRIPTOR_LEN) as u64));
        // All 8 bits of a byte, and 7, as pairs of images are matched.
        for bits in [8, 7] {
            let [first, second] = [&first, &second].map(|features| -> Vec<u8> {
                features.descriptors.iter().map(|byte| byte >> (8 - bits)).collect()
            });
            group.bench_function(format!("two_nearest {count}×{count}, {bits} bits"), |bencher| {
                bencher.iter(|| two_nearest(black_box(&first), black_box(&second)));
            });
        }
        let (first, second) = related_features(3, count);
        let params = MatchParams::default();
        assert!(match_features(&params, Posture::Any, &first, &second).len() > count / 4);
        group.bench_function(format!("match_features mutual {count}×{count}"), |bencher| {
            bencher.iter(|| match_features(&params, Posture::Any, black_box(&first), black_box(&second)));
        });
    }
    // As a build does it: every pair on one thread, many pairs at once.
    let pairs: Vec<_> = (0..PAIRS).map(|pair| related_features(10 + 2 * pair, PAIR_FEATURES)).collect();
    group.throughput(Throughput::Elements(PAIRS * (PAIR_FEATURES * PAIR_FEATURES * DESCRIPTOR_LEN) as u64));
    for threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        group.bench_function(format!("{PAIRS} pairs of {PAIR_FEATURES}, {threads} threads"), |bencher| {
            let params = MatchParams::default();
            let matches = |(first, second): &(ImageFeatures, ImageFeatures)| {
                match_features(&params, Posture::Any, first, second).len()
            };
            bencher.iter(|| pool.install(|| black_box(&pairs).par_iter().map(matches).sum::<usize>()));
        });
    }
    group.finish();
}

criterion_group!(benches, matching);
criterion_main!(benches);
