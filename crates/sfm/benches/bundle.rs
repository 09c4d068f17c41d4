//! Bundle adjustment: a synthetic local problem as the mapper poses it, towns of up to 3000 panoramas by Cholesky and by
//! conjugate gradients, and the BAL benchmark where its files are.
//!
//! Before it times a town it says what one run did, with the peak of memory where the system tells it (Linux).
//! BAL files are looked for in `$SETLOC_BAL_DIR`, else in `../shared/data/bal` beside the workspace.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use nalgebra::{UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use setloc_features::Camera;
use setloc_sfm::Rigid;
use setloc_sfm::bundle::bal::BalProblem;
use setloc_sfm::bundle::{
    BundleObservation, BundleParams, BundlePoint, BundlePose, BundleProblem, LinearSolver, RobustLoss, solve,
};

/// Panoramas along a street; all but the last `free` are fixed. 1 px noise, starts off by centimetres.
fn street(poses: usize, points: usize, free: usize) -> BundleProblem {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut vector = |scale: f64| {
        Vector3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0))
            * scale
    };
    let mut problem =
        BundleProblem { cameras: vec![Camera::equirectangular(4096, 2048)], ..BundleProblem::default() };
    for index in 0..poses {
        let rotation = UnitQuaternion::from_scaled_axis(vector(1.0));
        let centre = Vector3::new(3.0 * index as f64, 0.0, 0.0) + vector(0.3);
        let fixed = index + free < poses;
        problem.poses.push(BundlePose { camera: 0, world_from_camera: Rigid::new(rotation, centre), fixed });
    }
    let length = 3.0 * poses as f64;
    for point in 0..points as u32 {
        let offset = vector(1.0);
        let position =
            Vector3::new((offset.x + 1.0) * length / 2.0, 8.0 * offset.y, 8.0_f64.copysign(offset.z));
        for (pose, of_pose) in problem.poses.iter().enumerate() {
            if (of_pose.world_from_camera.translation - position).norm() < 20.0 {
                let in_camera = of_pose.world_from_camera.inverse_transform_point(&position);
                if let Some(pixel) = problem.cameras[0].project(&in_camera) {
                    let pixel = pixel + vector(1.0).xy();
                    problem.observations.push(BundleObservation {
                        pose: pose as u32,
                        point,
                        pixel,
                        noise_px: 1.0,
                    });
                }
            }
        }
        problem.points.push(BundlePoint { position: position + vector(0.1), fixed: false });
    }
    for pose in problem.poses.iter_mut().filter(|pose| !pose.fixed) {
        pose.world_from_camera.translation += vector(0.05);
    }
    problem
}

/// Panoramas every 6 m along the streets of a square town, blocks of 60 m. Each adds 30 points around it, seen from up
/// to 22 m away; landmarks are seen by 20 panoramas anywhere, which fills S. 1 px noise, starts off by centimetres.
fn town(poses: usize, landmarks: usize) -> BundleProblem {
    const REACH: f64 = 22.0;
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut vector = |scale: f64| {
        Vector3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0))
            * scale
    };
    let mut problem =
        BundleProblem { cameras: vec![Camera::equirectangular(4096, 2048)], ..BundleProblem::default() };
    // As many streets along x as along y, each with ten panoramas to the block.
    let blocks = (1..=poses).find(|&blocks| 20 * blocks * (blocks + 1) >= poses).unwrap_or(1);
    let cell = |position: &Vector3<f64>| [position.x, position.y].map(|value| (value / REACH).floor() as i64);
    let (mut cells, mut centres) = (BTreeMap::<_, Vec<usize>>::new(), Vec::new());
    for index in 0..poses {
        let (street, along) = (index / (10 * blocks), index % (10 * blocks));
        let (along, across) = (6.0 * along as f64 + 3.0, 60.0 * (street / 2) as f64);
        let (x, y) = if street % 2 == 0 { (along, across) } else { (across, along) };
        let centre = Vector3::new(x, y, 2.0) + vector(0.3);
        let world_from_camera = Rigid::new(UnitQuaternion::from_scaled_axis(vector(1.0)), centre);
        problem.poses.push(BundlePose { camera: 0, world_from_camera, fixed: false });
        cells.entry(cell(&centre)).or_default().push(index);
        centres.push(centre);
    }
    let side = 60.0 * blocks as f64;
    for index in 0..30 * poses + landmarks {
        let (position, seen_by) = if let Some(centre) = centres.get(index / 30) {
            let offset = vector(1.0);
            let aside = |offset: f64| 10.0 * offset + 5.0_f64.copysign(offset);
            let position = centre + Vector3::new(aside(offset.x), aside(offset.y), 6.0 * offset.z + 3.0);
            let [x, y] = cell(&position);
            let around = (x - 1..=x + 1).flat_map(|x| (y - 1..=y + 1).map(move |y| [x, y]));
            let near = around.filter_map(|cell| cells.get(&cell)).flatten().copied();
            (position, near.filter(|&pose| (centres[pose] - position).norm() < REACH).collect())
        } else {
            let offset = vector(0.5) + Vector3::repeat(0.5);
            let anywhere = || ((vector(0.5).x + 0.5) * poses as f64) as usize;
            let seen_by: Vec<_> = std::iter::repeat_with(anywhere).take(20).collect();
            (Vector3::new(side * offset.x, side * offset.y, 20.0 + 40.0 * offset.z), seen_by)
        };
        for pose in seen_by {
            let in_camera = problem.poses[pose].world_from_camera.inverse_transform_point(&position);
            if let Some(pixel) = problem.cameras[0].project(&in_camera) {
                let pixel = pixel + vector(1.0).xy();
                let (pose, point) = (pose as u32, index as u32);
                problem.observations.push(BundleObservation { pose, point, pixel, noise_px: 1.0 });
            }
        }
        problem.points.push(BundlePoint { position: position + vector(0.1), fixed: false });
    }
    for pose in &mut problem.poses {
        pose.world_from_camera.translation += vector(0.05);
        pose.world_from_camera.rotation *= UnitQuaternion::from_scaled_axis(vector(0.005));
    }
    problem
}

/// Starts the peak of memory anew.
fn forget_peak() {
    // Where this is not possible, no peak is told either.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// Peak of memory in MiB since [`forget_peak`].
fn peak_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.split_whitespace().next()?.parse::<f64>().ok()? / 1024.0)
}

fn scale(criterion: &mut Criterion) {
    use LinearSolver::{Direct, Iterative};
    let both: &[LinearSolver] = &[Direct, Iterative];
    // By Cholesky the last takes gigabytes and minutes.
    for (poses, landmarks, solvers) in
        [(600, 0, both), (600, 1000, both), (1000, 2000, both), (3000, 0, both), (3000, 6000, &[Iterative])]
    {
        let problem = town(poses, landmarks);
        for &linear_solver in solvers {
            let params =
                BundleParams { loss: RobustLoss::Cauchy(2.0), linear_solver, ..BundleParams::default() };
            let name = format!("town, {poses} poses, {landmarks} landmarks, {linear_solver:?}");
            let mut is_said = false;
            criterion.bench_function(&name, |bencher| {
                if !is_said {
                    is_said = true;
                    forget_peak();
                    let mut problem = problem.clone();
                    let start = Instant::now();
                    let report = solve(&params, &mut problem);
                    let elapsed = start.elapsed().as_secs_f64();
                    eprintln!("{name}: {elapsed:.2} s, peak {:?} MiB, {report:?}", peak_mib());
                }
                bencher.iter_batched_ref(
                    || problem.clone(),
                    |problem| solve(&params, problem),
                    BatchSize::LargeInput,
                );
            });
        }
    }
}

fn bundle(criterion: &mut Criterion) {
    let params = BundleParams { loss: RobustLoss::Cauchy(2.0), ..BundleParams::default() };
    for (poses, points, free) in [(10, 3000, 2), (10, 3000, 8), (200, 20000, 198)] {
        let problem = street(poses, points, free);
        let name =
            format!("street, {free} of {poses} poses free, {} observations", problem.observations.len());
        criterion.bench_function(&name, |bencher| {
            bencher.iter_batched_ref(
                || problem.clone(),
                |problem| solve(&params, problem),
                BatchSize::LargeInput,
            );
        });
    }
    let beside = || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data/bal");
    let folder = std::env::var_os("SETLOC_BAL_DIR").map_or_else(beside, PathBuf::from);
    for name in ["problem-16-22106-pre.txt", "problem-49-7776-pre.txt"] {
        let path = folder.join(name);
        let problem = std::fs::read_to_string(&path).map_err(|error| error.to_string());
        match problem.and_then(|text| text.parse::<BalProblem>().map_err(|error| error.to_string())) {
            Ok(problem) => {
                for linear_solver in [LinearSolver::Direct, LinearSolver::Iterative] {
                    let params = BundleParams { linear_solver, ..BundleParams::default() };
                    criterion.bench_function(&format!("{name}, {linear_solver:?}"), |bencher| {
                        bencher.iter_batched_ref(
                            || problem.clone(),
                            |problem| problem.solve(&params),
                            BatchSize::LargeInput,
                        );
                    });
                }
            }
            Err(error) => eprintln!("skipped {name}: {}: {error}", path.display()),
        }
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(10);
    targets = bundle, scale
}
criterion_main!(benches);
