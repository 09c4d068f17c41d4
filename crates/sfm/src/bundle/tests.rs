use nalgebra::{UnitQuaternion, Vector2, Vector3, Vector6};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use setloc_features::{Camera, CameraModel};

use super::*;
use crate::{Rigid, Similarity, synthetic::normal};

fn vector(rng: &mut ChaCha8Rng) -> Vector3<f64> {
    Vector3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0))
}

fn pinhole() -> Camera {
    Camera {
        model: CameraModel::Pinhole,
        width: 1600,
        height: 1200,
        params: vec![900.0, 900.0, 800.0, 600.0],
    }
}

/// Panoramas (even poses) in a box of points all around, and pinhole photos (odd poses).
fn scene(pose_count: usize, point_count: usize, noise_px: f64, seed: u64) -> BundleProblem {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut problem = BundleProblem {
        cameras: vec![Camera::equirectangular(4096, 2048), pinhole()],
        ..BundleProblem::default()
    };
    for index in 0..pose_count {
        let rotation = UnitQuaternion::from_scaled_axis(vector(&mut rng) * 0.4);
        let centre = Vector3::new(index as f64 - pose_count as f64 / 2.0, 0.0, 0.0) + vector(&mut rng) * 0.6;
        let world_from_camera = Rigid::new(rotation, centre);
        problem.poses.push(BundlePose { camera: (index % 2) as u32, world_from_camera, fixed: false });
    }
    for point in 0..point_count as u32 {
        let direction = vector(&mut rng).normalize();
        let position = direction * rng.random_range(6.0..12.0);
        let before = problem.observations.len();
        problem.points.push(BundlePoint { position, fixed: false });
        for (index, pose) in problem.poses.iter().enumerate() {
            let camera = &problem.cameras[pose.camera as usize];
            let Some(pixel) = camera.project(&pose.world_from_camera.inverse_transform_point(&position))
            else {
                continue;
            };
            let (width, height) = (f64::from(camera.width), f64::from(camera.height));
            // Near the poles a panorama's pixels are no longer square: its noise would not be what is assumed.
            let (low, high) =
                if camera.is_panoramic() { (0.3 * height, 0.7 * height) } else { (0.0, height) };
            if pixel.x < 0.0 || pixel.x >= width || pixel.y < low || pixel.y >= high {
                continue;
            }
            let bearing = camera.unproject(&pixel).unwrap();
            let sigma = camera.pixel_angle(&pixel).unwrap() * noise_px;
            let (u, v) = residual::tangent_basis(&bearing);
            let moved =
                (bearing + u * (normal(&mut rng) * sigma) + v * (normal(&mut rng) * sigma)).normalize();
            problem.observations.push(BundleObservation {
                pose: index as u32,
                point,
                pixel: camera.project(&moved).unwrap(),
                noise_px: if noise_px > 0.0 { noise_px } else { 1.0 },
            });
        }
        // Well-conditioned tracks only: what is seen once has its own test, and a point on the baseline may slide
        // into a camera.
        let ray = |observation: &BundleObservation| {
            (position - problem.poses[observation.pose as usize].world_from_camera.translation).normalize()
        };
        let track = &problem.observations[before..];
        if !track.iter().any(|a| track.iter().any(|b| ray(a).dot(&ray(b)) < 0.995)) {
            problem.observations.truncate(before);
        }
    }
    problem
}

fn perturb(problem: &mut BundleProblem, amount: f64, seed: u64) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    for pose in problem.poses.iter_mut().filter(|pose| !pose.fixed) {
        let turn = UnitQuaternion::from_scaled_axis(vector(&mut rng) * amount);
        pose.world_from_camera.rotation *= turn;
        pose.world_from_camera.translation += vector(&mut rng) * amount;
    }
    for point in problem.points.iter_mut().filter(|point| !point.fixed) {
        point.position += vector(&mut rng) * (5.0 * amount);
    }
}

/// Largest rotation (rad) and centre difference after the similarity that aligns the centres.
fn largest_error(found: &BundleProblem, truth: &BundleProblem) -> (f64, f64) {
    let centres = |problem: &BundleProblem| -> Vec<_> {
        problem.poses.iter().map(|pose| pose.world_from_camera.translation).collect()
    };
    let align = Similarity::from_point_pairs(&centres(found), &centres(truth)).unwrap();
    let mut worst = (0.0_f64, 0.0_f64);
    for (found, truth) in found.poses.iter().zip(&truth.poses) {
        let aligned = align.transform_pose(&found.world_from_camera);
        worst.0 = worst.0.max(aligned.rotation.angle_to(&truth.world_from_camera.rotation));
        worst.1 = worst.1.max((aligned.translation - truth.world_from_camera.translation).norm());
    }
    worst
}

fn assert_seen_points_are_found(found: &BundleProblem, truth: &BundleProblem) {
    let mut seen = vec![false; truth.points.len()];
    truth.observations.iter().for_each(|observation| seen[observation.point as usize] = true);
    for (index, (found, truth)) in found.points.iter().zip(&truth.points).enumerate() {
        assert!(!seen[index] || (found.position - truth.position).norm() < 1e-7);
    }
}

fn tight() -> BundleParams {
    BundleParams { function_tolerance: 0.0, parameter_tolerance: 0.0, ..BundleParams::default() }
}

#[test]
fn exact_panoramas_and_photos_recover_truth_in_a_free_gauge() {
    let truth = scene(8, 300, 0.0, 1);
    let mut problem = truth.clone();
    perturb(&mut problem, 0.05, 2);
    let report = solve(&tight(), &mut problem);
    let (rotation, position) = largest_error(&problem, &truth);
    assert!(rotation < 1e-9 && position < 1e-9, "{rotation} {position} {report:?}");
    // The frame stays about where the perturbed start put it.
    assert!(
        problem.poses.iter().zip(&truth.poses).all(|(a, b)| {
            (a.world_from_camera.translation - b.world_from_camera.translation).norm() < 0.2
        })
    );
}

#[test]
fn every_loss_recovers_truth_from_exact_data() {
    for loss in [RobustLoss::Huber(2.0), RobustLoss::Cauchy(2.0), RobustLoss::SoftL1(2.0)] {
        let truth = scene(5, 150, 0.0, 3);
        let mut problem = truth.clone();
        perturb(&mut problem, 0.01, 4);
        let report = solve(&BundleParams { loss, max_iterations: 200, ..tight() }, &mut problem);
        let (rotation, position) = largest_error(&problem, &truth);
        assert!(rotation < 1e-8 && position < 1e-8, "{loss:?} {rotation} {position} {report:?}");
    }
}

#[test]
fn robust_loss_withstands_gross_outliers() {
    let truth = scene(6, 300, 0.0, 5);
    let mut problem = truth.clone();
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    for observation in problem.observations.iter_mut().step_by(12) {
        observation.pixel += Vector2::new(rng.random_range(-300.0..300.0), rng.random_range(-300.0..300.0));
    }
    perturb(&mut problem, 0.005, 7);
    let params = BundleParams { loss: RobustLoss::Cauchy(1.0), max_iterations: 100, ..tight() };
    solve(&params, &mut problem);
    let (rotation, position) = largest_error(&problem, &truth);
    assert!(rotation < 1e-3 && position < 5e-3, "{rotation} {position}");
}

#[test]
fn cost_per_degree_of_freedom_is_one_under_noise() {
    let mut problem = scene(8, 500, 0.7, 8);
    let report = solve(&tight(), &mut problem);
    // Seven of the unknowns are gauge.
    let reduced = 2.0 * report.final_cost / (report.degrees_of_freedom + 7) as f64;
    assert!((0.94..1.06).contains(&reduced), "{reduced}");
}

#[test]
fn fixed_poses_and_points_stay_bit_identical_and_hold_the_frame() {
    let truth = scene(8, 300, 0.0, 9);
    let mut problem = truth.clone();
    for pose in &mut problem.poses[..2] {
        pose.fixed = true;
    }
    for point in problem.points.iter_mut().step_by(10) {
        point.fixed = true;
    }
    perturb(&mut problem, 0.05, 10);
    let start = problem.clone();
    solve(&tight(), &mut problem);
    assert_eq!(problem.poses[..2], start.poses[..2]);
    assert_eq!(problem.cameras, start.cameras);
    for (found, before) in problem.points.iter().zip(&start.points).filter(|(_, before)| before.fixed) {
        assert_eq!(found, before);
    }
    for (found, truth) in problem.poses.iter().zip(&truth.poses) {
        assert!((found.world_from_camera.translation - truth.world_from_camera.translation).norm() < 1e-9);
    }
    assert_seen_points_are_found(&problem, &truth);
}

#[test]
fn poses_alone_are_found_when_all_points_are_fixed() {
    let truth = scene(4, 60, 0.0, 11);
    let mut problem = truth.clone();
    for point in &mut problem.points {
        point.fixed = true;
    }
    perturb(&mut problem, 0.1, 12);
    solve(&tight(), &mut problem);
    for (found, truth) in problem.poses.iter().zip(&truth.poses) {
        let (found, truth) = (&found.world_from_camera, &truth.world_from_camera);
        assert!((found.translation - truth.translation).norm() < 1e-10);
        assert!(found.rotation.angle_to(&truth.rotation) < 1e-10);
    }
}

#[test]
fn points_alone_are_found_when_all_poses_are_fixed() {
    let truth = scene(6, 200, 0.0, 13);
    let mut problem = truth.clone();
    for pose in &mut problem.poses {
        pose.fixed = true;
    }
    perturb(&mut problem, 0.05, 14);
    solve(&tight(), &mut problem);
    assert_seen_points_are_found(&problem, &truth);
}

#[test]
fn shared_focal_length_is_recovered() {
    let truth = scene(8, 400, 0.0, 15);
    let mut problem = truth.clone();
    problem.camera_freedom = vec![
        IntrinsicsFreedom::FREE,
        IntrinsicsFreedom { principal_point: false, ..IntrinsicsFreedom::FREE },
    ];
    problem.cameras[1].params[0] = 840.0;
    problem.cameras[1].params[1] = 850.0;
    perturb(&mut problem, 0.02, 16);
    let report = solve(&BundleParams { max_iterations: 200, ..tight() }, &mut problem);
    let params = &problem.cameras[1].params;
    assert!((params[0] - 900.0).abs() < 1e-5 && (params[1] - 900.0).abs() < 1e-5, "{params:?} {report:?}");
    assert_eq!(params[2..], truth.cameras[1].params[2..]);
    assert_eq!(problem.cameras[0], truth.cameras[0]);
}

#[test]
fn principal_point_is_recovered_when_it_is_free() {
    let truth = scene(8, 400, 0.0, 17);
    let mut problem = truth.clone();
    problem.camera_freedom = vec![
        IntrinsicsFreedom::FIXED,
        IntrinsicsFreedom { principal_point: true, ..IntrinsicsFreedom::FIXED },
    ];
    problem.cameras[1].params[2] += 20.0;
    problem.cameras[1].params[3] -= 15.0;
    solve(&BundleParams { max_iterations: 200, ..tight() }, &mut problem);
    let params = &problem.cameras[1].params;
    assert!((params[2] - 800.0).abs() < 1e-5 && (params[3] - 600.0).abs() < 1e-5, "{params:?}");
    assert_eq!(params[..2], truth.cameras[1].params[..2]);
}

#[test]
fn what_is_known_of_a_camera_counts_by_its_standard_deviation() {
    let mut seen = scene(4, 300, 0.0, 29);
    seen.poses.iter_mut().for_each(|pose| pose.fixed = true);
    seen.points.iter_mut().for_each(|point| point.fixed = true);
    seen.camera_freedom = vec![IntrinsicsFreedom::FREE, IntrinsicsFreedom::FREE];
    let found = |sigma: f64, aspect_sigma: f64| {
        let known = |value: f64| ParameterEstimate { value, sigma };
        let parameters = [860.0, 900.0, 790.0, 606.0].map(known).to_vec();
        let mut problem = seen.clone();
        let loss = RobustLoss::Trivial;
        problem.camera_priors.push(CameraPrior { camera: 1, parameters, aspect_sigma, loss });
        let report = solve(&BundleParams { max_iterations: 200, ..tight() }, &mut problem);
        (problem.cameras[1].params.clone(), report)
    };
    let near = |found: &[f64], wanted: [f64; 4], tolerance: f64| {
        assert!(found.iter().zip(wanted).all(|(a, b)| (a - b).abs() < tolerance), "{found:?} {wanted:?}");
    };
    let (of_the_photo, loose) = found(1e6, f64::INFINITY);
    near(&of_the_photo, [900.0, 900.0, 800.0, 600.0], 1e-3);
    near(&found(1e-6, f64::INFINITY).0, [860.0, 900.0, 790.0, 606.0], 1e-3);
    // Square pixels, by all means, between two focal lengths that are known alike.
    let (square, both) = found(1e-3, 1e-9);
    near(&square, [880.0, 880.0, 790.0, 606.0], 0.1);
    assert_eq!((loose.degrees_of_freedom + 1, both.ignored), (both.degrees_of_freedom, 0));
    // What is a hundred deviations off is let go of.
    let mut unusual = seen.clone();
    let parameters = vec![ParameterEstimate { value: 700.0, sigma: 1.0 }; 4];
    let loss = RobustLoss::Cauchy(2.0);
    unusual.camera_priors.push(CameraPrior { camera: 1, parameters, aspect_sigma: 0.1, loss });
    solve(&BundleParams { max_iterations: 200, ..tight() }, &mut unusual);
    near(&unusual.cameras[1].params, [900.0, 900.0, 800.0, 600.0], 0.1);
    // Of a camera that is not there, or not as it is.
    let mut wrong = seen.clone();
    for (camera, parameters) in [(9, 4), (1, 3)] {
        let parameters = vec![ParameterEstimate { value: 0.0, sigma: 1.0 }; parameters];
        let loss = RobustLoss::Trivial;
        wrong.camera_priors.push(CameraPrior { camera, parameters, aspect_sigma: 0.1, loss });
    }
    assert_eq!(solve(&tight(), &mut wrong).ignored, 2);
}

#[test]
fn usual_photos_have_their_principal_point_in_the_middle_and_panoramas_nothing_to_estimate() {
    let params = vec![1180.0, 1185.0, 803.0, 596.0, -0.06, 0.02, 0.0, 0.0];
    let photo = Camera { model: CameraModel::Opencv, width: 1600, height: 1200, params };
    let CameraPrior { camera, parameters, aspect_sigma, .. } =
        CameraPrior::of_usual_photo(3, &photo).unwrap();
    let values: Vec<f64> = parameters.iter().map(|known| known.value).collect();
    assert_eq!((camera, values), (3, vec![0.0, 0.0, 800.0, 600.0, 0.0, 0.0, 0.0, 0.0]));
    assert!(parameters[..2].iter().all(|focal| focal.sigma == f64::INFINITY));
    assert!(parameters[6].sigma < parameters[5].sigma && parameters[5].sigma < parameters[4].sigma);
    assert!(aspect_sigma < 0.01);
    assert_eq!(CameraPrior::of_usual_photo(0, &Camera::equirectangular(200, 100)), None);
}

#[test]
fn position_priors_set_scale_and_place() {
    let truth = scene(6, 200, 0.0, 18);
    let mut problem = truth.clone();
    for (pose, of_truth) in truth.poses.iter().enumerate() {
        let position = of_truth.world_from_camera.translation;
        let loss = RobustLoss::Cauchy(3.0);
        problem.position_priors.push(PositionPrior {
            pose: pose as u32,
            position,
            sigma: Vector3::repeat(0.5),
            loss,
        });
    }
    perturb(&mut problem, 0.05, 19);
    solve(&tight(), &mut problem);
    for (found, truth) in problem.poses.iter().zip(&truth.poses) {
        let error = (found.world_from_camera.translation - truth.world_from_camera.translation).norm();
        assert!(error < 1e-6, "{error}");
    }
}

#[test]
fn antipodal_point_is_not_explained() {
    let mut problem = scene(3, 40, 0.0, 20);
    for pose in &mut problem.poses {
        pose.fixed = true;
    }
    let observation = problem.observations[0];
    let centre = problem.poses[observation.pose as usize].world_from_camera.translation;
    let point = &mut problem.points[observation.point as usize];
    point.position = centre - (point.position - centre);
    point.fixed = true;
    problem.observations.truncate(1);
    let report = solve(&BundleParams::default(), &mut problem);
    assert!(report.initial_cost > 1e6 && report.final_cost.is_finite());
}

#[test]
fn odd_input_is_survived_and_counted() {
    let mut problem = scene(5, 100, 0.3, 21);
    let good = problem.observations.len();
    let template = problem.observations[0];
    let nan = f64::NAN;
    problem.observations.push(BundleObservation { pixel: Vector2::new(nan, 1.0), ..template });
    problem.observations.push(BundleObservation { noise_px: 0.0, ..template });
    problem.observations.push(BundleObservation { pose: 99, ..template });
    problem.observations.push(BundleObservation { point: 9999, ..template });
    let lone = problem.points.len() as u32;
    problem.points.push(BundlePoint { position: Vector3::new(3.0, 2.0, 1.0), fixed: false });
    problem.observations.push(BundleObservation { point: lone, ..template });
    problem.points.push(BundlePoint { position: Vector3::new(nan, 2.0, 1.0), fixed: false });
    problem.observations.push(BundleObservation { point: lone + 1, ..template });
    // A point in a camera's centre.
    let position = problem.poses[template.pose as usize].world_from_camera.translation;
    problem.points.push(BundlePoint { position, fixed: false });
    problem.observations.push(BundleObservation { point: lone + 2, ..template });
    problem.observations.push(problem.observations[1]);
    let report = solve(&BundleParams::default(), &mut problem);
    assert_eq!((report.observations, report.ignored), (good + 3, 5));
    assert!(report.final_cost.is_finite());
    assert!(problem.poses.iter().all(|pose| pose.world_from_camera.translation.norm() < 100.0));
    assert_eq!(
        solve(&BundleParams::default(), &mut BundleProblem::default()).termination,
        Termination::NothingToDo
    );
}

/// Rays that are all but parallel make one of it, of which the first step of all others is a share below any tolerance.
#[test]
fn a_point_that_is_all_but_infinitely_far_away_does_not_end_the_adjustment() {
    let mut truth = scene(8, 300, 0.0, 40);
    let far = Vector3::new(0.3, 0.2, 1.0) * 1e13;
    let point = truth.points.len() as u32;
    truth.points.push(BundlePoint { position: far, fixed: false });
    for pose in [0, 2] {
        let in_camera = truth.poses[pose].world_from_camera.inverse().transform_point(&far);
        let pixel = truth.cameras[0].project(&in_camera).expect("panoramas see all round");
        truth.observations.push(BundleObservation { pose: pose as u32, point, pixel, noise_px: 0.5 });
    }
    let mut problem = truth.clone();
    let away = problem.points.pop().expect("was pushed");
    perturb(&mut problem, 0.02, 41);
    problem.points.push(away);
    let report = solve(&BundleParams::default(), &mut problem);
    assert!(report.iterations > 2, "{report:?}");
    let (rotation, position) = largest_error(&problem, &truth);
    assert!(rotation < 1e-5 && position < 1e-4, "{rotation} {position} {report:?}");
}

#[test]
fn bytes_do_not_depend_on_the_number_of_threads() {
    let mut start = scene(12, 1500, 0.5, 22);
    start.camera_freedom = vec![IntrinsicsFreedom::FIXED, IntrinsicsFreedom::FREE];
    perturb(&mut start, 0.02, 23);
    for linear_solver in [LinearSolver::Direct, LinearSolver::Iterative] {
        let params = BundleParams { linear_solver, ..BundleParams::default() };
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut problem = start.clone();
            let report = pool.install(|| solve(&params, &mut problem));
            (report, problem)
        };
        let one = run(1);
        assert_eq!(one, run(2));
        assert_eq!(one, run(3));
    }
}

#[test]
fn conjugate_gradients_reach_the_optimum_of_cholesky() {
    let mut start = scene(10, 500, 0.7, 27);
    start.camera_freedom = vec![IntrinsicsFreedom::FIXED, IntrinsicsFreedom::FREE];
    for (pose, of_pose) in start.poses.iter().enumerate() {
        let position = of_pose.world_from_camera.translation + Vector3::new(0.01, -0.02, 0.005);
        let loss = RobustLoss::Cauchy(3.0);
        start.position_priors.push(PositionPrior {
            pose: pose as u32,
            position,
            sigma: Vector3::repeat(0.1),
            loss,
        });
    }
    start.poses[3].fixed = true;
    start.points.iter_mut().step_by(11).for_each(|point| point.fixed = true);
    perturb(&mut start, 0.02, 28);
    start.cameras[1].params[0] = 880.0;
    let run = |linear_solver: LinearSolver| {
        let mut problem = start.clone();
        let loss = RobustLoss::Cauchy(2.0);
        let report =
            solve(&BundleParams { loss, linear_solver, max_iterations: 200, ..tight() }, &mut problem);
        (problem, report)
    };
    let ((exact, by_cholesky), (found, by_gradients)) =
        (run(LinearSolver::Direct), run(LinearSolver::Iterative));
    assert!(by_cholesky.linear_iterations == 0 && by_gradients.linear_iterations > 0);
    let difference = by_gradients.final_cost - by_cholesky.final_cost;
    assert!(difference.abs() < 1e-10 * by_cholesky.final_cost, "{by_cholesky:?} {by_gradients:?}");
    for (found, exact) in found.poses.iter().zip(&exact.poses) {
        let (found, exact) = (&found.world_from_camera, &exact.world_from_camera);
        assert!((found.translation - exact.translation).norm() < 1e-6);
        assert!(found.rotation.angle_to(&exact.rotation) < 1e-7);
    }
    for (found, exact) in found.cameras[1].params.iter().zip(&exact.cameras[1].params) {
        assert!((found - exact).abs() < 1e-6 * exact.abs(), "{found} {exact}");
    }
    assert_eq!(found.poses[3], start.poses[3]);
}

#[test]
fn conjugate_gradients_recover_truth_from_exact_data_in_a_free_gauge() {
    let truth = scene(8, 300, 0.0, 29);
    let mut problem = truth.clone();
    perturb(&mut problem, 0.05, 30);
    let params = BundleParams { linear_solver: LinearSolver::Iterative, ..tight() };
    let report = solve(&params, &mut problem);
    let (rotation, position) = largest_error(&problem, &truth);
    assert!(rotation < 1e-9 && position < 1e-9, "{rotation} {position} {report:?}");
}

#[test]
fn conjugate_gradients_take_points_alone_and_poses_alone() {
    let params = BundleParams { linear_solver: LinearSolver::Iterative, ..tight() };
    let truth = scene(6, 200, 0.0, 31);
    let (mut points_alone, mut poses_alone) = (truth.clone(), truth.clone());
    points_alone.poses.iter_mut().for_each(|pose| pose.fixed = true);
    poses_alone.points.iter_mut().for_each(|point| point.fixed = true);
    for mut problem in [points_alone, poses_alone] {
        perturb(&mut problem, 0.05, 32);
        let report = solve(&params, &mut problem);
        assert!(report.final_cost < 1e-12 * report.initial_cost, "{report:?}");
    }
}

/// Panoramas every 3 m along streets of so many each, 20 m apart and driven to and fro; points seen by 7 panoramas in a
/// row, and landmarks seen by 12 anywhere; GPS of 0.1 m.
fn streets(count: usize, each: usize, landmarks: usize, seed: u64) -> BundleProblem {
    let pose_count = count * each;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut problem =
        BundleProblem { cameras: vec![Camera::equirectangular(4096, 2048)], ..BundleProblem::default() };
    for index in 0..pose_count {
        let rotation = UnitQuaternion::from_scaled_axis(vector(&mut rng) * 0.4);
        let (street, along) = (index / each, index % each);
        let along = if street % 2 == 0 { along } else { each - 1 - along };
        let centre = Vector3::new(3.0 * along as f64, 20.0 * street as f64, 0.0) + vector(&mut rng) * 0.3;
        let world_from_camera = Rigid::new(rotation, centre);
        problem.poses.push(BundlePose { camera: 0, world_from_camera, fixed: index < 2 });
        let position = centre + Vector3::from_fn(|_, _| normal(&mut rng)) * 0.1;
        let (pose, loss) = (index as u32, RobustLoss::Trivial);
        problem.position_priors.push(PositionPrior { pose, position, sigma: Vector3::repeat(0.1), loss });
    }
    let mut see = |problem: &mut BundleProblem,
                   position: Vector3<f64>,
                   poses: &mut dyn Iterator<Item = usize>| {
        let point = problem.points.len() as u32;
        problem.points.push(BundlePoint { position, fixed: false });
        for pose in poses {
            let in_camera = problem.poses[pose].world_from_camera.inverse_transform_point(&position);
            let noise = Vector2::new(normal(&mut rng), normal(&mut rng)) * 0.5;
            let pixel = problem.cameras[0].project(&in_camera).unwrap() + noise;
            problem.observations.push(BundleObservation { pose: pose as u32, point, pixel, noise_px: 0.5 });
        }
    };
    let mut rng = ChaCha8Rng::seed_from_u64(seed + 1);
    for pose in 0..pose_count {
        for _ in 0..20 {
            let offset = Vector3::new(rng.random_range(-1.5..1.5), 0.0, rng.random_range(-2.0..6.0));
            let side = Vector3::new(0.0, if rng.random() { 8.0 } else { -8.0 }, 0.0);
            let position = problem.poses[pose].world_from_camera.translation + offset + side;
            see(&mut problem, position, &mut (pose.saturating_sub(3)..(pose + 4).min(pose_count)));
        }
    }
    let (length, width) = (3.0 * each as f64, 20.0 * count as f64);
    for _ in 0..landmarks {
        let (x, y) = (rng.random_range(0.0..length), rng.random_range(0.0..width));
        let position = Vector3::new(x, y, rng.random_range(20.0..80.0));
        let poses: Vec<_> = (0..12).map(|_| rng.random_range(0..pose_count)).collect();
        see(&mut problem, position, &mut poses.into_iter());
    }
    problem
}

#[test]
fn large_problem_with_a_full_system_goes_to_conjugate_gradients_and_converges() {
    let mut start = streets(20, 30, 2000, 33);
    perturb(&mut start, 0.01, 35);
    let run = |linear_solver: LinearSolver| {
        let mut problem = start.clone();
        let report = solve(&BundleParams { linear_solver, ..BundleParams::default() }, &mut problem);
        (problem, report)
    };
    let (found, report) = run(LinearSolver::Auto);
    assert!(report.linear_iterations > 0 && report.truncated_steps == 0, "{report:?}");
    assert!(report.termination == Termination::Converged, "{report:?}");
    let per_freedom = 2.0 * report.final_cost / report.degrees_of_freedom as f64;
    assert!((0.97..1.03).contains(&per_freedom), "{per_freedom}");
    assert_eq!(run(LinearSolver::Iterative), (found, report));
}

#[test]
fn long_street_stays_with_cholesky_and_is_the_same_by_conjugate_gradients() {
    let mut start = streets(1, 600, 0, 36);
    perturb(&mut start, 0.01, 37);
    let run = |linear_solver: LinearSolver| {
        let mut problem = start.clone();
        let report = solve(&BundleParams { linear_solver, ..BundleParams::default() }, &mut problem);
        (problem, report)
    };
    let ((exact, by_cholesky), (found, by_gradients)) =
        (run(LinearSolver::Auto), run(LinearSolver::Iterative));
    assert_eq!(by_cholesky.linear_iterations, 0);
    assert!(by_gradients.linear_iterations > 0 && by_gradients.truncated_steps == 0, "{by_gradients:?}");
    let difference = by_gradients.final_cost - by_cholesky.final_cost;
    assert!(difference.abs() < 1e-6 * by_cholesky.final_cost, "{by_cholesky:?} {by_gradients:?}");
    // Far less than what the noise does.
    for (found, exact) in found.poses.iter().zip(&exact.poses) {
        let (found, exact) = (&found.world_from_camera, &exact.world_from_camera);
        let distance = (found.translation - exact.translation).norm();
        assert!(distance < 1e-3, "{distance}");
    }
}

#[test]
fn chain_that_nothing_holds_takes_few_conjugate_gradients() {
    let mut start = streets(1, 300, 0, 38);
    start.position_priors.clear();
    perturb(&mut start, 0.01, 39);
    let [by_cholesky, by_gradients] = [LinearSolver::Direct, LinearSolver::Iterative].map(|linear_solver| {
        solve(&BundleParams { linear_solver, ..BundleParams::default() }, &mut start.clone())
    });
    let iterations = by_gradients.linear_iterations;
    assert!(iterations <= 5 * u64::from(by_gradients.iterations), "{by_gradients:?}");
    let difference = by_gradients.final_cost - by_cholesky.final_cost;
    assert!(difference.abs() < 1e-6 * by_cholesky.final_cost, "{by_cholesky:?} {by_gradients:?}");
}

#[test]
fn covariance_predicts_the_errors() {
    let (mut sum, mut count) = (0.0, 0);
    for seed in 0..250 {
        let mut problem = scene(4, 250, 0.8, 1000 + seed);
        for pose in &mut problem.poses[..2] {
            pose.fixed = true;
        }
        let truth = problem.clone();
        solve(&tight(), &mut problem);
        let covariances = covariance(&problem, RobustLoss::Trivial, &[2, 3]).unwrap();
        for (pose, covariance) in [2, 3].into_iter().zip(&covariances) {
            let (found, truth) =
                (&problem.poses[pose].world_from_camera, &truth.poses[pose].world_from_camera);
            let turn = (truth.rotation.inverse() * found.rotation).scaled_axis();
            let shift = found.translation - truth.translation;
            let error = Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z);
            sum += error.dot(&(covariance.cholesky().unwrap().inverse() * error));
            count += 6;
        }
    }
    let ratio = sum / f64::from(count);
    assert!((0.9..1.1).contains(&ratio), "{ratio}");
}

#[test]
fn covariance_says_when_the_gauge_is_free() {
    let mut problem = scene(5, 100, 0.5, 24);
    assert_eq!(covariance(&problem, RobustLoss::Trivial, &[1]), None);
    problem.poses[0].fixed = true;
    assert_eq!(covariance(&problem, RobustLoss::Trivial, &[1]), None, "scale is free");
    problem.poses[1].fixed = true;
    let found = covariance(&problem, RobustLoss::Trivial, &[1, 2]).unwrap();
    assert_eq!(found[0], Matrix6::zeros());
    assert!(found[1].diagonal().iter().all(|&variance| variance > 0.0));
    assert_eq!(covariance(&problem, RobustLoss::Trivial, &[77]), None);
}

#[test]
fn point_seen_once_changes_no_covariance() {
    let mut problem = scene(5, 100, 0.5, 25);
    problem.poses[0].fixed = true;
    problem.poses[1].fixed = true;
    let before = covariance(&problem, RobustLoss::Trivial, &[2, 3]).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(26);
    for _ in 0..50 {
        let point = problem.points.len() as u32;
        problem.points.push(BundlePoint { position: vector(&mut rng) * 9.0, fixed: false });
        let pose = rng.random_range(0..5);
        let pixel = Vector2::new(rng.random_range(0.0..1600.0), rng.random_range(0.0..1200.0));
        problem.observations.push(BundleObservation { pose, point, pixel, noise_px: 1.0 });
    }
    let after = covariance(&problem, RobustLoss::Trivial, &[2, 3]).unwrap();
    for (before, after) in before.iter().zip(&after) {
        assert!((before - after).norm() < 1e-6 * before.norm());
    }
}

#[test]
fn a_step_is_what_an_adjustment_does_about_a_small_change() {
    for loss in
        [RobustLoss::Trivial, RobustLoss::Huber(1.0), RobustLoss::Cauchy(1.0), RobustLoss::SoftL1(1.0)]
    {
        let mut problem = scene(6, 400, 0.5, 21);
        solve(&BundleParams { loss, ..tight() }, &mut problem);
        let weighted = problem.reweighted(loss);
        let respond = |by: f64, seed: u64| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let (mut adjusted, mut stepped) = (problem.clone(), weighted.clone());
            let shift = Vector2::new(normal(&mut rng), normal(&mut rng)) * by;
            // Half of one image, as an error that its directions share.
            for (a, b) in adjusted.observations.iter_mut().zip(&mut stepped.observations) {
                if a.pose == 2 && a.pixel.x < 2048.0 {
                    (a.pixel, b.pixel) = (a.pixel + shift, b.pixel + shift);
                }
            }
            solve(&BundleParams { loss, ..tight() }, &mut adjusted);
            let mut unmoved = weighted.clone();
            assert!(step(&mut unmoved) && step(&mut stepped));
            let (_, by_adjustment) = largest_error(&adjusted, &problem);
            let (_, by_step) = largest_error(&stepped, &unmoved);
            let (_, apart) = largest_error(&stepped, &adjusted);
            (by_adjustment, by_step, apart)
        };
        let (mut adjusted, mut stepped, mut apart) = (0.0, 0.0, 0.0);
        for seed in 0..8 {
            let errors = respond(0.3, seed);
            adjusted += errors.0.powi(2);
            stepped += errors.1.powi(2);
            apart += errors.2.powi(2);
        }
        // By squares to first order; a loss also lets go of one observation and takes up another.
        if loss == RobustLoss::Trivial {
            assert!(apart < 1e-4 * adjusted, "{adjusted} {stepped} {apart}");
        } else {
            assert!((0.6..1.6).contains(&(stepped / adjusted)), "{loss:?} {adjusted} {stepped} {apart}");
        }
    }
}

#[test]
fn residuals_of_one_sign_move_no_minimum_and_those_of_one_point_do_as_leaving_it_out() {
    for loss in [RobustLoss::Trivial, RobustLoss::Huber(1.0), RobustLoss::Cauchy(1.0)] {
        let mut problem = scene(5, 300, 0.5, 24);
        solve(&BundleParams { loss, ..tight() }, &mut problem);
        let weighted = problem.reweighted(loss);
        let residuals = problem.residuals_under(loss);
        let respond = |factor: &dyn Fn(u32) -> f64| {
            let mut moved = weighted.clone();
            for (seen, residual) in moved.observations.iter_mut().zip(&residuals) {
                let camera = &weighted.cameras[weighted.poses[seen.pose as usize].camera as usize];
                let bearing = camera.unproject(&seen.pixel).unwrap() + residual * factor(seen.point);
                seen.pixel = camera.project(&bearing).unwrap();
            }
            assert!(step(&mut moved));
            moved
        };
        let unmoved = respond(&|_| 0.0);
        let apart = |moved: &BundleProblem| largest_error(moved, &unmoved).1;
        let one_of_many = apart(&respond(&|point| f64::from(u8::from(point < 30))));
        let all = apart(&respond(&|_| 1.0));
        // Cauchy's loss has some residuals at the largest factor.
        let bound = if let RobustLoss::Cauchy(_) = loss { 0.25 } else { 0.02 };
        assert!(all < bound * one_of_many, "{loss:?} {all} {one_of_many}");
        // A point that pulls no more has its residuals taken off it.
        let mut without = problem.clone();
        without.observations.retain(|seen| seen.point >= 30);
        solve(&BundleParams { loss, ..tight() }, &mut without);
        let taken_off = respond(&|point| -f64::from(u8::from(point < 30)));
        let (left_out, by_residuals) = (largest_error(&without, &problem).1, apart(&taken_off));
        assert!((0.5..2.0).contains(&(by_residuals / left_out)), "{loss:?} {by_residuals} {left_out}");
    }
}

#[test]
fn a_step_moves_nothing_where_nothing_is_free_or_known() {
    let mut problem = scene(4, 100, 0.5, 23);
    for pose in &mut problem.poses {
        pose.fixed = true;
    }
    for point in &mut problem.points {
        point.fixed = true;
    }
    let before = problem.clone();
    assert!(!step(&mut problem));
    assert_eq!(problem, before);
    problem.observations.clear();
    assert!(!step(&mut problem));
}
