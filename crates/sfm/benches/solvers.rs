//! Time per call of the solvers and estimators, and how often they find the truth.
//!
//! `cargo bench --bench solvers` prints, before the timings, solutions and misses per 1000 exact problems (100 000
//! problems each, with noise for triangulation) and the medians of the robust estimators over 1000 problems.

use std::hint::black_box;
use std::time::Instant;

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use nalgebra::{UnitQuaternion, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use setloc_sfm::robust::{
    GeneralizedPoseOptions, GeneralizedSolver, RansacParams, estimate_absolute_pose,
    estimate_generalized_pose, estimate_relative_pose,
};
use setloc_sfm::solvers::essential::essential_from_pose;
use setloc_sfm::solvers::triangulation::{WorldRay, triangulate, triangulate_two_views};
use setloc_sfm::solvers::{
    PoseWithFocal, dlt, five_point, gp3p, gp4ps, p3p, p4pf, ugp3ps, upright_three_point,
};
use setloc_sfm::synthetic::{
    AbsoluteProblem, FocalProblem, GeneralizedProblem, RaySample, RelativeProblem, perturb, random_unit,
    rotation_angle, same_similarity, seeded,
};
use setloc_sfm::{Rigid, Similarity};

/// Exact problems per count of misses.
const PROBLEMS: usize = 100_000;
/// A solution this near to the truth has found it.
const TOLERANCE: f64 = 1e-5;
/// 0.5 px at a focal length of 800 px.
const SIGMA: f64 = 0.5 / 800.0;

fn generalized<const N: usize>(
    rng: &mut ChaCha8Rng,
    cameras: [u32; N],
    upright: bool,
) -> (RaySample<N>, Similarity) {
    let problem = GeneralizedProblem::exact(rng, &cameras, upright);
    (problem.sample(), problem.world_from_set)
}

/// Bearings and points.
type Central = ([Vector3<f64>; 3], [Vector3<f64>; 3]);

fn central(rng: &mut ChaCha8Rng) -> (Central, Rigid) {
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
    let level = |rng: &mut ChaCha8Rng| {
        let problem = RelativeProblem::upright(rng, 3);
        (problem.sample::<3>(), problem.second_from_first)
    };
    solver(criterion, "upright_three_point", level, |(first, second), truth| {
        let found = upright_three_point(first, second);
        let near = |(rotation, translation): &(nalgebra::Matrix3<f64>, Vector3<f64>)| {
            rigid_found(&[Rigid::from_matrix(rotation, *translation)], truth)
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
    let one_point = |rng: &mut ChaCha8Rng| {
        let mut problem = GeneralizedProblem::exact(rng, &[0, 1, 2, 3], false);
        problem.see_one_point(0, 1);
        (problem.sample(), problem.world_from_set)
    };
    solver(criterion, "gp4ps, two rays at one point", one_point, |(origins, directions, points), truth| {
        let found = gp4ps(origins, directions, points);
        (found.len(), similarity_found(&found, truth))
    });
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
    let pinhole = |rng: &mut ChaCha8Rng| {
        let problem = FocalProblem::exact(rng, 4);
        let input: ([_; 4], [_; 4]) =
            (std::array::from_fn(|i| problem.pixels[i]), std::array::from_fn(|i| problem.points[i]));
        (input, (problem.world_from_camera, problem.focal))
    };
    solver(criterion, "p4pf", pinhole, |(pixels, points), truth| {
        let found = p4pf(pixels, points);
        let near = |solution: &PoseWithFocal| {
            truth.is_none_or(|(pose, focal)| {
                (solution.focal / focal).ln().abs() < TOLERANCE
                    && rigid_found(&[solution.world_from_camera], Some(pose))
            })
        };
        (found.len(), truth.is_none() || found.iter().any(near))
    });
    let eight = |rng: &mut ChaCha8Rng| generalized(rng, [0, 1, 2, 3, 0, 1, 2, 3], false);
    solver(criterion, "dlt of 8", eight, |(origins, directions, points), truth| {
        let found = dlt(origins, directions, points);
        (usize::from(found.is_some()), similarity_found(found.as_slice(), truth))
    });
}

/// Rays with noise to a point from centres on the unit sphere, and the point.
fn views(rng: &mut ChaCha8Rng, count: usize) -> (Vec<WorldRay>, Vector3<f64>) {
    let point = random_unit(rng) * rng.random_range(2.0..10.0);
    let ray = |_| {
        let origin = random_unit(rng);
        WorldRay { origin, direction: perturb(rng, &(point - origin).normalize(), SIGMA), sigma: SIGMA }
    };
    ((0..count).map(ray).collect(), point)
}

fn triangulation(criterion: &mut Criterion) {
    // With noise the point is found when its rays do: within four deviations of each.
    let fits = |rays: &[WorldRay], point: &Vector3<f64>| {
        rays.iter().all(|ray| ray.angular_error(point) < 4.0 * SIGMA)
    };
    let two = |rng: &mut ChaCha8Rng| {
        let (rays, point) = views(rng, 2);
        // Both cameras look along the axes of the world.
        let second_from_first = Rigid::new(UnitQuaternion::identity(), rays[0].origin - rays[1].origin);
        ((second_from_first, [rays[0], rays[1]]), point)
    };
    solver(criterion, "triangulate_two_views", two, |(second_from_first, rays), truth| {
        let found = triangulate_two_views(second_from_first, &rays[0].direction, &rays[1].direction);
        let right = truth.is_none() || found.is_some_and(|point| fits(rays, &(point + rays[1].origin)));
        (usize::from(found.is_some()), right)
    });
    for (name, count) in [("triangulate 2 views", 2), ("triangulate 8 views", 8)] {
        solver(
            criterion,
            name,
            |rng| views(rng, count),
            |rays, truth| {
                let found = triangulate(rays);
                let right = truth.is_none() || found.is_some_and(|point| fits(rays, &point));
                (usize::from(found.is_some()), right)
            },
        );
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Runs the generalized estimator on 1000 noisy problems and prints success and medians.
fn generalized_accuracy(name: &str, options: &GeneralizedPoseOptions, outliers: f64, problems: u64) {
    let mut rng = seeded(name);
    let cameras: Vec<u32> = (0..200).map(|i| i % 4).collect();
    let (mut rotations, mut positions, mut scales, mut times) =
        (Vec::new(), Vec::new(), Vec::new(), Vec::new());
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

criterion_group!(benches, minimal, triangulation, robust);
criterion_main!(benches);
