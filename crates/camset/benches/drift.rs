//! Sets whose local model drifts: errors of the rigid set and of the joint refinement.
//!
//! `cargo bench --bench drift -p setloc-camset` prints a table. Each photo of a chain of nine along a street, six units
//! from one to the next, is turned and stretched against the one before by so much; only the first of them see the scene.
//! Errors are those of a set's worst photo, as median and worst over the sets.

#![allow(clippy::print_stdout)]

use std::convert::Infallible;

use setloc_camset::synthetic::World;
use setloc_camset::{
    CamsetParams, PhotoLocalization, SingleLocalization, SingleParams, Verdict, Views, locate_set,
    locate_single,
};

/// Sets of each strength.
const SETS: u64 = 30;
/// Photos of a set.
const PHOTOS: usize = 9;
/// Share of features that look like other points.
const OUTLIERS: f64 = 0.2;
/// Turn in radians, and stretch, of each photo against the one before.
const STRENGTHS: [f64; 6] = [0.0, 0.0005, 0.001, 0.002, 0.004, 0.008];

/// Largest errors of a set's photos in position and rotation; `None` when a photo has no pose.
fn worst(world: &World, photos: &[PhotoLocalization]) -> Option<[f64; 2]> {
    photos.iter().enumerate().try_fold([0.0_f64; 2], |[center, rotation], (photo, found)| {
        let (c, r) = world.errors(photo, &found.world_from_camera?);
        Some([center.max(c), rotation.max(r)])
    })
}

/// Median and largest.
fn spread(mut values: Vec<f64>) -> String {
    values.sort_by(f64::total_cmp);
    match values.last() {
        Some(largest) => format!("{:.3} / {largest:.3}", values[values.len() / 2]),
        None => "–".to_owned(),
    }
}

fn main() {
    println!(
        "| turn, stretch per photo | rigid: centre, units | rigid: ° | refined: centre | refined: ° | all localized |"
    );
    println!("|---|---|---|---|---|---|");
    for strength in STRENGTHS {
        let mut errors: [[Vec<f64>; 2]; 2] = Default::default();
        let mut localized = 0;
        for seed in 1..=SETS {
            let mut world = World::chain(PHOTOS, OUTLIERS, seed);
            world.bend(strength, strength);
            let (scene, photos) = (world.scene(), world.queries());
            let alone: Vec<SingleLocalization> = photos
                .iter()
                .map(|photo| locate_single(&SingleParams::default(), &scene, photo, seed))
                .collect();
            let alone: Vec<_> = alone.iter().map(SingleLocalization::evidence).collect();
            let models = std::slice::from_ref(&world.local);
            let no_views = || Ok::<_, Infallible>(Views::default());
            let Ok(found) =
                locate_set(&CamsetParams::default(), &scene, &photos, &alone, models.into(), no_views, seed);
            localized += usize::from(found.refined.iter().all(|photo| photo.verdict == Verdict::Localized));
            for (errors, photos) in errors.iter_mut().zip([&found.rigid, &found.refined]) {
                for (errors, error) in errors.iter_mut().zip(worst(&world, photos).into_iter().flatten()) {
                    errors.push(error);
                }
            }
        }
        let columns: Vec<String> = errors.into_iter().flatten().map(spread).collect();
        println!(
            "| {:.2}°, {:.2} % | {} | {localized} of {SETS} |",
            strength.to_degrees(),
            100.0 * strength,
            columns.join(" | ")
        );
    }
}
