//! Time per call of the solvers and estimators, and how often they find the truth.
//!
//! `cargo bench --bench solvers` prints, before the timings, solutions and misses per 1000 exact problems (100 000
//! problems each) and the medians of the robust estimators over 1000 problems.

use std::hint::black_box;
use std::time::Instant;

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use nalgebra::Vector3;
use rand_chacha::ChaCha8Rng;
use setloc_sfm::robust::{
    GeneralizedPoseOptions, GeneralizedSolver, RansacParams, estimate_absolute_pose, estimate_generalized_pose,
    estimate_relative_pose,
};
use setloc_sfm::solvers::essential::essential_from_pose;
use setloc_sfm::solvers::{dlt, five_point, gp3p, gp4ps, p3p, ugp3ps};
use setloc_sfm::synthetic::{
    AbsoluteProblem, GeneralizedProblem, RelativeProblem, rotation_angle, same_similarity, seeded,
};
use setloc_sfm::{Rigid, Similarity};

/// Exact problems per count of misses.
const PROBLEMS: usize = 100_000;
/// A solution this near to the truth has found it.
const TOLERANCE: f64 = 1e-5;
/// 0.5 px at a focal length of 800 px.
const SIGMA: f64 = 0.5 / 800.0;

type Rays<const N: usize> = ([Vector3<f64>; N], [Vector3<f64>; N], [Vector3<f64>; N]);

fn generalized<const N: usize>(rng: &mut ChaCha8Rng, cameras: [u32; N], upright: bool) -> (Rays<N>, Similarity) {
    let problem = GeneralizedProblem::exact(rng, &cameras, upright);
    (problem.sample(), problem.world_from_set)
}

fn central(rng: &mut ChaCha8Rng) -> (([Vector3<f64>; 3], [Vector3<f64>; 3]), Rigid) {
    let problem = AbsoluteProblem::exact(rng, 3);
    let of = |list: &[Vector3<f64>]| std::array::from_fn(|i| list[i]);
    ((of(&problem.bearings), of(&problem.points)), problem.world_from_camera)
}

/// Counts solutions and misses over exact problems, then times the solver on 1000 of them.
fn solver<P: Clone, T>(
    criterion: &mut Criterion,
    name: &str,
    mut problem: impl FnMut(&mut ChaCha8Rng) -> (P, T),
    mut solve: impl FnMut(&P, Option<&T>) -> (usize, bool),
) {
    let mut rng = seeded(name);
    let (mut solutions, mut missed) = (0, 0);
    for _ in 0..PROBLEMS {
        let (input, truth) = problem(&mut rng);
        let (count, found) = solve(&input, Some(&truth));
        solutions += count;
        missed += usize::from(!found);
    }
    let per_thousand = 1000.0 / PROBLEMS as f64;
    eprintln!(
        "{name}: found {:.2} of 1000, valid solutions {:.0} per 1000",
        1000.0 - missed as f64 * per_thousand,
        solutions as f64 * per_thousand
    );
    let inputs: Vec<P> = (0..1000).map(|_| problem(&mut rng).0).collect();
    let mut next = 0;
    criterion.bench_function(name, |bencher| {
        bencher.iter(|| {
            next = (next + 1) % inputs.len();
            black_box(solve(black_box(&inputs[next]), None))
        });
    });
}

fn rigid_found(found: &[Rigid], truth: Option<&Rigid>) -> bool {
    truth.is_none_or(|truth| {
        found.iter().any(|pose| same_similarity(&(*pose).into(), &(*truth).into(), TOLERANCE))
    })
}

fn similarity_found(found: &[Similarity], truth: Option<&Similarity>) -> bool {
    truth.is_none_or(|truth| found.iter().any(|similarity| same_similarity(similarity, truth, TOLERANCE)))
}

fn minimal(criterion: &mut Criterion) {
    solver(criterion, "p3p", central, |(bearings, points), truth| {
        let found = p3p(bearings, points);
        (found.len(), rigid_found(&found, truth))
    });
    let relative = |rng: &mut ChaCha8Rng| {
        let problem = RelativeProblem::exact(rng, 5);
        (problem.sample::<5>(), essential_from_pose(&problem.second_from_first))
    };
    solver(criterion, "five_point", relative, |(first, second), truth| {
        let found = five_point(first, second);
        let near = |e: &nalgebra::Matrix3<f64>| {
            truth.is_none_or(|truth| (e - truth).norm().min((e + truth).norm()) < TOLERANCE)
        };
        (found.len(), truth.is_none() || found.iter().any(near))
    });
    for (name, cameras) in [
        ("gp4ps 1+1+1+1", [0, 1, 2, 3]),
        ("gp4ps 2+1+1", [0, 0, 1, 2]),
        ("gp4ps 2+2", [0, 0, 1, 1]),
        ("gp4ps 3+1", [0, 0, 0, 1]),
    ] {
        let problem = |rng: &mut ChaCha8Rng| generalized(rng, cameras, false);
        solver(criterion, name, problem, |(origins, directions, points), truth| {
            let found = gp4ps(origins, directions, points);
            (found.len(), similarity_found(&found, truth))
        });
    }
    let unscaled = |rng: &mut ChaCha8Rng| {
        let ((origins, directions, points), truth) = generalized(rng, [0, 1, 2], false);
        let pose = Rigid::new(truth.rotation, truth.translation);
        ((origins.map(|p| p * truth.scale), directions, points), pose)
    };
    solver(criterion, "gp3p", unscaled, |(origins, directions, points), truth| {
        let found = gp3p(origins, directions, points);
        (found.len(), rigid_found(&found, truth))
    });
    let upright = |rng: &mut ChaCha8Rng| generalized(rng, [0, 1, 2], true);
    solver(criterion, "ugp3ps", upright, |(origins, directions, points), truth| {
        let found = ugp3ps(origins, directions, points);
        (found.len(), similarity_found(&found, truth))
    });
    let eight = |rng: &mut ChaCha8Rng| generalized(rng, [0, 1, 2, 3, 0, 1, 2, 3], false);
    solver(criterion, "dlt of 8", eight, |(origins, directions, points), truth| {
        let found = dlt(origins, directions, points);
        (usize::from(found.is_some()), similarity_found(found.as_slice(), truth))
    });
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Runs the generalized estimator on 1000 noisy problems and prints success and medians.
fn generalized_accuracy(name: &str, options: &GeneralizedPoseOptions, outliers: f64, problems: u64) {
    let mut rng = seeded(name);
    let cameras: Vec<u32> = (0..200).map(|i| i % 4).collect();
    let (mut rotations, mut positions, mut scales, mut times) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for seed in 0..problems {
        let mut problem = GeneralizedProblem::exact(&mut rng, &cameras, false);
        problem.disturb(&mut rng, SIGMA, outliers);
        let start = Instant::now();
        let params = RansacParams::default();
        let found = estimate_generalized_pose(&params, &problem.rays, &problem.points, options, seed);
        times.push(start.elapsed().as_secs_f64() * 1e3);
        let Some(found) = found else { continue };
        let truth = problem.world_from_set;
        let rotation = rotation_angle(&found.world_from_set.rotation, &truth.rotation).to_degrees();
        if rotation > 0.5 {
            continue;
        }
        rotations.push(rotation);
        let origin = problem.rays[0].origin;
        let extent = 10.0 * truth.scale;
        let shift = found.world_from_set.transform_point(&origin) - truth.transform_point(&origin);
        positions.push(100.0 * shift.norm() / extent);
        scales.push(100.0 * (found.world_from_set.scale / truth.scale - 1.0).abs());
    }
    eprintln!(
        "{name}: {} of {problems}; medians {:.4}°, {:.4} % of the extent, {:.4} % scale, {:.2} ms",
        rotations.len(),
        median(rotations),
        median(positions),
        median(scales),
        median(times)
    );
}

fn robust(criterion: &mut Criterion) {
    let minimal = GeneralizedPoseOptions::default();
    let dlt = GeneralizedPoseOptions { solver: GeneralizedSolver::Dlt, ..minimal };
    generalized_accuracy("generalized, no outliers", &minimal, 0.0, 1000);
    generalized_accuracy("generalized, 60 % outliers", &minimal, 0.6, 1000);
    generalized_accuracy("generalized by dlt, 30 % outliers", &dlt, 0.3, 200);
    let mut rng = seeded("robust timings");
    criterion.bench_function("estimate_generalized_pose 200 rays 60 %", |bencher| {
        let cameras: Vec<u32> = (0..200).map(|i| i % 4).collect();
        let setup = || {
            let mut problem = GeneralizedProblem::exact(&mut rng, &cameras, false);
            problem.disturb(&mut rng, SIGMA, 0.6);
            problem
        };
        let run = |problem: GeneralizedProblem| {
            estimate_generalized_pose(&RansacParams::default(), &problem.rays, &problem.points, &minimal, 1)
        };
        bencher.iter_batched(setup, run, BatchSize::SmallInput);
    });
    criterion.bench_function("estimate_absolute_pose 100 bearings 60 %", |bencher| {
        let setup = || {
            let mut problem = AbsoluteProblem::exact(&mut rng, 100);
            problem.disturb(&mut rng, SIGMA, 0.6);
            problem
        };
        let run = |problem: AbsoluteProblem| {
            let params = RansacParams::default();
            estimate_absolute_pose(&params, &problem.bearings, &[SIGMA; 100], &problem.points, 1)
        };
        bencher.iter_batched(setup, run, BatchSize::SmallInput);
    });
    criterion.bench_function("estimate_relative_pose 200 pairs 40 %", |bencher| {
        let setup = || {
            let mut problem = RelativeProblem::exact(&mut rng, 200);
            problem.disturb(&mut rng, SIGMA, 0.4);
            problem
        };
        let run = |problem: RelativeProblem| {
            let (params, sigmas) = (RansacParams::default(), [SIGMA; 200]);
            estimate_relative_pose(&params, &problem.first, &problem.second, &sigmas, &sigmas, 1)
        };
        bencher.iter_batched(setup, run, BatchSize::SmallInput);
    });
}

criterion_group!(benches, minimal, robust);
criterion_main!(benches);
