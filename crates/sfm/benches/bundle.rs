//! Bundle adjustment: a synthetic local problem as the mapper poses it, and the BAL benchmark where its files are.
//!
//! BAL files are looked for in `$SETLOC_BAL_DIR`, else in `../shared/data/bal` beside the workspace.

use std::path::PathBuf;

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use nalgebra::{UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use setloc_features::Camera;
use setloc_sfm::Rigid;
use setloc_sfm::bundle::bal::BalProblem;
use setloc_sfm::bundle::{
    BundleObservation, BundleParams, BundlePoint, BundlePose, BundleProblem, RobustLoss, solve,
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
                criterion.bench_function(name, |bencher| {
                    let params = BundleParams::default();
                    bencher.iter_batched_ref(
                        || problem.clone(),
                        |problem| problem.solve(&params),
                        BatchSize::LargeInput,
                    );
                });
            }
            Err(error) => eprintln!("skipped {name}: {}: {error}", path.display()),
        }
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(10);
    targets = bundle
}
criterion_main!(benches);
