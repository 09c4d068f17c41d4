//! The image set as one generalized camera, then as photos tied together by their local points.

mod correspondences;
mod cut;
mod joint;
mod merged;
mod rigid;
mod scale;
mod sights;

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Vector2;
use setloc_sfm::{
    CameraId, ImageId, OutvotedPair, Reconstruction, ReconstructionImage, Rigid, doubtful_images,
};

use crate::advice::{Link, advice_about, name_open_pairs, widest_paths};
use crate::{
    CamsetParams, LocalModels, PhotoEvidence, PhotoLocalization, PlacedModel, QueryPhoto, Scene,
    SetLocalization, Verdict, Views, verdict::standard_deviations,
};

use cut::doubt_beside_cut;
use joint::{Component, ComponentAnswer, ComponentPoses};

pub use merged::locate_set_anywhere;

/// Localizes a set in one component of the scene, through its local models (components of the photos' own reconstruction, largest first).
///
/// Models with fewer than two registered photos are left out.
/// `alone` is what [`locate_single`](crate::locate_single) says of each photo; photos beyond its end are left out.
/// Every other photo gets an answer: from the first model that localizes it, else alone. (L. Deng et al., "Image set
/// querying based localization", VCIP 2015.)
///
/// `views` is asked for what the photos share with the scene's images beside its points ([`crate::match_views`]), only
/// where photos are left that the points do not localize.
///
/// # Errors
/// Those of `views`.
pub fn locate_set<E>(
    params: &CamsetParams,
    scene: &Scene<'_>,
    photos: &[QueryPhoto<'_>],
    alone: &[PhotoEvidence<'_>],
    local_models: LocalModels<'_>,
    views: impl FnOnce() -> Result<Views, E>,
    seed: u64,
) -> Result<SetLocalization, E> {
    let mut found = answer(params, scene, photos, alone, local_models, views, seed)?;
    let alone: Vec<&PhotoLocalization> =
        alone.iter().take(photos.len()).map(|evidence| evidence.photo).collect();
    doubt_beside_cut(&mut found, photos, &alone);
    Ok(found.finished())
}

fn answer<E>(
    params: &CamsetParams,
    scene: &Scene<'_>,
    photos: &[QueryPhoto<'_>],
    alone: &[PhotoEvidence<'_>],
    local_models: LocalModels<'_>,
    views: impl FnOnce() -> Result<Views, E>,
    seed: u64,
) -> Result<Answer, E> {
    let photos = &photos[..photos.len().min(alone.len())];
    let evidence = &alone[..photos.len()];
    let by_points = locate_by(params, scene, (photos, evidence), local_models, &Views::default(), seed);
    if by_points.set.refined.iter().all(|photo| photo.verdict == Verdict::Localized) {
        return Ok(by_points);
    }
    let views = Views { pictures: local_models.pictures.cloned().unwrap_or_default(), ..views()? };
    if views.matches.is_empty() && !(params.scale_by_walls && views.pictures.are_some()) {
        return Ok(by_points);
    }
    let by_views = locate_by(params, scene, (photos, evidence), local_models, &views, seed);
    Ok(better_of(by_points, by_views))
}

/// What was found of a set, not yet in words.
#[derive(Debug, Clone, PartialEq, Default)]
struct Answer {
    /// Advice and contradictions are still empty.
    set: SetLocalization,
    remarks: Vec<Remark>,
    /// Whether each photo, localized alone, stands elsewhere.
    elsewhere: Vec<bool>,
    /// Whether where each photo is rests on a scale that too few matches give.
    lacks_scale: Vec<bool>,
    /// Where the principal point is of photos that show clearly more of the scene as parts of larger pictures.
    cut: Vec<Option<Vector2<f64>>>,
    /// What holds each photo: the scene points that it and the photos placed with it see, by photo.
    seen: Vec<Vec<(usize, usize)>>,
}

/// What is to be said of a local model.
#[derive(Debug, Clone, PartialEq)]
struct Remark {
    members: Vec<usize>,
    /// Whether it says that the model is not localized.
    is_refusal: bool,
    text: String,
}

impl Answer {
    /// With contradictions and advice: what happened to each model, then what to do about each photo that is not localized.
    fn finished(self) -> SetLocalization {
        let Self { mut set, remarks, elsewhere, .. } = self;
        let is_localized = |photo: &usize| set.refined[*photo].verdict == Verdict::Localized;
        let holds = |remark: &Remark| !(remark.is_refusal && remark.members.iter().all(is_localized));
        set.advice = remarks.into_iter().filter(holds).map(|remark| remark.text).collect();
        let photos = set.refined.iter().zip(&set.paths);
        let not_localized = photos.filter(|(photo, _)| photo.verdict != Verdict::Localized);
        set.advice.extend(advice_about(not_localized.map(|(_, path)| path)));
        let contradicted = set.refined.iter().zip(elsewhere).filter(|(_, elsewhere)| *elsewhere);
        set.contradicted = contradicted.map(|(photo, _)| photo.name.clone()).collect();
        set
    }
}

/// The second answer, which knows more, where anything is localized better in it or has a scale that the first lacks, but for
/// photos of which that holds the other way round; the first altogether where they contradict each other.
fn better_of(mut first: Answer, mut second: Answer) -> Answer {
    first.cut = first.cut.iter().zip(&second.cut).map(|(first, second)| first.or(*second)).collect();
    second.cut.clone_from(&first.cut);
    let pairs = || first.set.refined.iter().zip(&second.set.refined);
    let is_localized = |photo: &PhotoLocalization| photo.verdict == Verdict::Localized;
    let contradicts = |(a, b): (&PhotoLocalization, &PhotoLocalization)| {
        let (Some(of_a), Some(of_b)) = (a.world_from_camera, b.world_from_camera) else { return false };
        let sigma = |photo: &PhotoLocalization| {
            photo.covariance.as_ref().map_or(f64::INFINITY, |covariance| standard_deviations(covariance).1)
        };
        let apart = (of_a.translation - of_b.translation).norm();
        is_localized(a) && is_localized(b) && apart > MAX_APART * sigma(a).hypot(sigma(b))
    };
    let worth = |answer: &Answer, at: usize| {
        let photo = &answer.set.refined[at];
        (photo.verdict.rank(), photo.world_from_camera.is_some() && !answer.lacks_scale[at])
    };
    let gains = (0..pairs().len()).any(|at| worth(&second, at) > worth(&first, at));
    if !gains || pairs().any(contradicts) {
        return first;
    }
    let is_better: Vec<bool> = (0..pairs().len()).map(|at| worth(&first, at) > worth(&second, at)).collect();
    let mut best = second;
    for at in (0..is_better.len()).filter(|&at| is_better[at]) {
        best.set.refined[at].clone_from(&first.set.refined[at]);
        best.set.paths[at].clone_from(&first.set.paths[at]);
        best.elsewhere[at] = first.elsewhere[at];
        best.lacks_scale[at] = first.lacks_scale[at];
        best.seen[at].clone_from(&first.seen[at]);
    }
    for (kept, rigid) in best.set.rigid.iter_mut().zip(first.set.rigid) {
        if rigid.verdict.rank() > kept.verdict.rank() {
            *kept = rigid;
        }
    }
    best
}

/// Distance in standard deviations of both at which two places of a photo contradict each other.
const MAX_APART: f64 = 6.0;

fn locate_by(
    params: &CamsetParams,
    scene: &Scene<'_>,
    (photos, evidence): (&[QueryPhoto<'_>], &[PhotoEvidence<'_>]),
    local_models: LocalModels<'_>,
    views: &Views,
    seed: u64,
) -> Answer {
    let (mut answer, mut remarks) = (SetLocalization::default(), Vec::new());
    let mut elsewhere = vec![false; photos.len()];
    let mut lacks_scale = vec![false; photos.len()];
    let mut cut = vec![None; photos.len()];
    let mut seen: Vec<_> = evidence.iter().enumerate().map(|(at, e)| vec![(at, e.photo.inliers)]).collect();
    let mut rigid: Vec<Option<PhotoLocalization>> = vec![None; photos.len()];
    let mut refined: Vec<Option<PhotoLocalization>> = vec![None; photos.len()];
    let mut scene_links: Vec<usize> =
        evidence.iter().map(|e| e.photo.world_from_camera.map_or(0, |_| e.photo.inliers)).collect();
    let mut photo_links: BTreeMap<(usize, usize), usize> = BTreeMap::new();
    let by_themselves = if views.matches.is_empty() {
        Vec::new()
    } else {
        left_alone(photos, evidence, local_models.components)
    };
    for (number, model) in local_models.components.iter().chain(&by_themselves).enumerate() {
        let members: Vec<usize> =
            model.registered().map(ImageId::index).filter(|&photo| photo < photos.len()).collect();
        if members.len() < 2 && number < local_models.components.len() {
            continue;
        }
        for (pair, shared) in shared_points(model) {
            *photo_links.entry(pair).or_default() += shared;
        }
        let seed = seed.wrapping_add(0x1000 * (number as u64 + 1));
        let pictures = local_models.pictures;
        let component =
            Component { params, scene, photos, evidence, model, members: &members, views, pictures };
        match component.locate(seed) {
            ComponentAnswer::Localized(mut found) => {
                let outvoted = local_models.outvoted.get(number).map_or(&[][..], Vec::as_slice);
                for pair in outvoted {
                    doubt_beyond(pair, photos, evidence, &members, &mut found);
                }
                let doubtful = doubtful_images(model, outvoted, &[]);
                doubt_folded(&doubtful, params.verdict.min_inliers, evidence, &members, &mut found);
                let (component, world_from_set) = (scene.component, found.world_from_set);
                answer.placed.push(PlacedModel { component, world_from_set });
                let seen_by_all: Vec<_> = members.iter().copied().zip(found.scene_points.clone()).collect();
                for (slot, &photo) in members.iter().enumerate() {
                    cut[photo] = cut[photo].or(found.cut[slot]);
                    scene_links[photo] = scene_links[photo].max(found.scene_points[slot]);
                    keep_better(&mut rigid[photo], found.rigid[slot].clone());
                    if keep_better(&mut refined[photo], found.refined[slot].clone()) {
                        elsewhere[photo] = found.elsewhere[slot];
                        lacks_scale[photo] = found.lacks_scale;
                        seen[photo].clone_from(&seen_by_all);
                    }
                }
                let remark = |text| Remark { members: members.clone(), is_refusal: false, text };
                remarks.extend(found.remarks.into_iter().map(remark));
            }
            ComponentAnswer::Refused { reasons, scene_points } => {
                for (slot, &photo) in members.iter().enumerate() {
                    scene_links[photo] = scene_links[photo].max(scene_points[slot]);
                }
                let names: Vec<&str> = members.iter().map(|&photo| photos[photo].name).collect();
                let text =
                    format!("{} is not localized: {}", called(&names, scene.component), reasons.join("; "));
                remarks.push(Remark { members, is_refusal: true, text });
            }
        }
    }
    let names: Vec<&str> = photos.iter().map(|photo| photo.name).collect();
    answer.paths = widest_paths(&names, &scene_links, &photo_links);
    let enough = params.verdict.min_inliers;
    name_open_pairs(&mut answer.paths, &photo_links, local_models.open, enough);
    answer.rigid = or_alone(rigid, evidence);
    answer.refined = or_alone(refined, evidence);
    for (photo, path) in answer.refined.iter_mut().zip(&answer.paths) {
        let weak = |link: &&Link| link.from.is_some() && link.shared < params.verdict.min_link;
        if let Some(link) = path.weakest().filter(weak)
            && photo.verdict != Verdict::NotLocalized
        {
            photo.verdict = Verdict::Uncertain;
            photo.reasons.push(format!("its weakest link to the scene shares {} points only", link.shared));
        }
    }
    Answer { set: answer, remarks, elsewhere, lacks_scale, cut, seen }
}

/// Whether each photo of a local model is localized alone, at the place that the model gives it.
fn agree_alone(evidence: &[PhotoEvidence<'_>], members: &[usize], found: &ComponentPoses) -> Vec<bool> {
    let is_alone = |photo: &usize| evidence[*photo].photo.verdict == Verdict::Localized;
    members.iter().zip(&found.elsewhere).map(|(photo, elsewhere)| is_alone(photo) && !elsewhere).collect()
}

/// Makes photos uncertain that the local model joins to those that the scene holds against more matches than points.
///
/// The side that more photos localized alone agree with is held, else the one that sees more of the scene. On the other only
/// photos stay localized that are so alone, at the same place.
fn doubt_beyond(
    pair: &OutvotedPair,
    photos: &[QueryPhoto<'_>],
    evidence: &[PhotoEvidence<'_>],
    members: &[usize],
    found: &mut ComponentPoses,
) {
    let on_side: Vec<bool> =
        members.iter().map(|&photo| pair.side.binary_search(&ImageId(photo as u32)).is_ok()).collect();
    let agrees_alone = agree_alone(evidence, members, found);
    let held = |side: bool| {
        let slots = (0..members.len()).filter(|&slot| on_side[slot] == side);
        slots
            .map(|slot| (usize::from(agrees_alone[slot]), found.scene_points[slot]))
            .fold((0, 0), |(alone, seen), (is_alone, points)| (alone + is_alone, seen + points))
    };
    let is_first_held = held(true) >= held(false);
    let [first, second] =
        [pair.first, pair.second].map(|image| photos.get(image.index()).map_or("", |photo| photo.name));
    let reason = format!(
        "the {} matches of {first} and {second} contradict its local model, which {} points hold together between them",
        pair.matches, pair.held_by
    );
    for slot in (0..members.len()).filter(|&slot| on_side[slot] != is_first_held && !agrees_alone[slot]) {
        found.doubt(slot, &reason);
    }
    found.remarks.push(reason);
}

/// Makes photos uncertain about which the local model may be folded, but for those that the scene holds: localized alone at
/// the same place, or by points of their own.
fn doubt_folded(
    doubtful: &[ImageId],
    enough: usize,
    evidence: &[PhotoEvidence<'_>],
    members: &[usize],
    found: &mut ComponentPoses,
) {
    let agrees_alone = agree_alone(evidence, members, found);
    for (slot, &photo) in members.iter().enumerate() {
        let is_held = agrees_alone[slot] || found.scene_points[slot] >= enough;
        if !is_held && doubtful.binary_search(&ImageId(photo as u32)).is_ok() {
            found.doubt(slot, "its local model may be folded about it");
        }
    }
}

/// What photos that are placed together are called, and in which component where it is not the largest.
fn called(names: &[&str], component: usize) -> String {
    let together = match names {
        [name] => format!("{name} by itself"),
        names => format!("the local model of {}", names.join(", ")),
    };
    match component {
        0 => together,
        _ => format!("{together}, in component {},", component + 1),
    }
}

/// Models of one photo, of those that no local model has and that are not localized alone.
fn left_alone(
    photos: &[QueryPhoto<'_>],
    evidence: &[PhotoEvidence<'_>],
    local_models: &[Reconstruction],
) -> Vec<Reconstruction> {
    let in_model = |photo: usize| {
        let has = |model: &&Reconstruction| {
            model.images.get(photo).is_some_and(|image| image.world_from_camera.is_some())
        };
        local_models.iter().filter(|model| model.registered().count() > 1).any(|model| has(&model))
    };
    let model = |photo: usize| {
        let image = |(at, query): (usize, &QueryPhoto<'_>)| ReconstructionImage {
            name: query.name.to_owned(),
            camera: CameraId(0),
            world_from_camera: (at == photo).then(Rigid::identity),
        };
        Reconstruction {
            cameras: vec![photos[photo].camera.clone()],
            images: photos.iter().enumerate().map(image).collect(),
            ..Reconstruction::default()
        }
    };
    let alone = |photo: &usize| evidence[*photo].photo.verdict != Verdict::Localized && !in_model(*photo);
    (0..photos.len()).filter(alone).map(model).collect()
}

/// Number of local points that tie each pair of photos, by image ids in ascending order.
///
/// Two photos from one centre move together: each point that either of them sees ties both.
fn shared_points(model: &Reconstruction) -> BTreeMap<(usize, usize), usize> {
    let center = |photo: usize| model.images[photo].world_from_camera.map(|pose| pose.translation);
    let registered: Vec<usize> = model.registered().map(ImageId::index).collect();
    let turned: Vec<(usize, usize)> = registered
        .iter()
        .enumerate()
        .flat_map(|(i, &first)| registered[i + 1..].iter().map(move |&second| (first, second)))
        .filter(|&(first, second)| center(first) == center(second))
        .collect();
    let mut shared = BTreeMap::new();
    for point in &model.points {
        let mut photos: Vec<usize> = point.track.iter().map(|o| o.image.index()).collect();
        photos.sort_unstable();
        photos.dedup();
        let mut tied: BTreeSet<(usize, usize)> = BTreeSet::new();
        for (i, &first) in photos.iter().enumerate() {
            tied.extend(photos[i + 1..].iter().map(|&second| (first, second)));
        }
        let sees = |photo: usize| photos.binary_search(&photo).is_ok();
        tied.extend(turned.iter().filter(|&&(first, second)| sees(first) || sees(second)));
        for pair in tied {
            *shared.entry(pair).or_default() += 1;
        }
    }
    shared
}

/// Whether the other was better.
fn keep_better(kept: &mut Option<PhotoLocalization>, other: PhotoLocalization) -> bool {
    let is_better = kept.as_ref().is_none_or(|kept| other.verdict.rank() > kept.verdict.rank());
    if is_better {
        *kept = Some(other);
    }
    is_better
}

/// Answers of the set, and where it has none, those of the photos alone.
fn or_alone(
    answers: Vec<Option<PhotoLocalization>>,
    evidence: &[PhotoEvidence<'_>],
) -> Vec<PhotoLocalization> {
    let alone = |evidence: &PhotoEvidence<'_>| {
        let mut alone = evidence.photo.clone();
        let origin = match alone.verdict {
            Verdict::NotLocalized => "neither its local model nor the photo alone is localized",
            _ => "localized alone: no local model of the set leads to it",
        };
        alone.reasons.insert(0, origin.to_owned());
        alone
    };
    answers
        .into_iter()
        .zip(evidence)
        .map(|(answer, evidence)| answer.unwrap_or_else(|| alone(evidence)))
        .collect()
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use nalgebra::{UnitQuaternion, Vector3};
    use setloc_features::Camera;

    use super::*;
    use crate::jackknife::deviation;
    use crate::synthetic::{Place, World, along_street};
    use crate::types::DOUBTFUL;
    use crate::{CamsetMethod, PathToScene, SingleLocalization, SingleParams, locate_single};

    fn locate_photos(
        params: &CamsetParams,
        scene: &Scene<'_>,
        photos: &[QueryPhoto<'_>],
        local_models: &[Reconstruction],
        seed: u64,
    ) -> SetLocalization {
        let alone = photos.iter().map(|photo| locate_single(&SingleParams::default(), scene, photo, seed));
        let alone: Vec<SingleLocalization> = alone.collect();
        locate_with(params, scene, (photos, &alone), local_models, Views::default, seed)
    }

    fn locate_with(
        params: &CamsetParams,
        scene: &Scene<'_>,
        (photos, alone): (&[QueryPhoto<'_>], &[SingleLocalization]),
        local_models: &[Reconstruction],
        views: impl FnOnce() -> Views,
        seed: u64,
    ) -> SetLocalization {
        let alone: Vec<PhotoEvidence<'_>> = alone.iter().map(SingleLocalization::evidence).collect();
        let Ok(found) = locate_set(
            params,
            scene,
            photos,
            &alone,
            local_models.into(),
            || Ok::<_, Infallible>(views()),
            seed,
        );
        found
    }

    fn locate(world: &World, params: &CamsetParams) -> SetLocalization {
        locate_photos(params, &world.scene(), &world.queries(), std::slice::from_ref(&world.local), 7)
    }

    fn worst_errors(world: &World, photos: &[PhotoLocalization]) -> (f64, f64) {
        photos.iter().enumerate().fold((0.0, 0.0), |(center, rotation): (f64, f64), (i, photo)| {
            let pose = photo.world_from_camera.expect("has a pose");
            let (c, r) = world.errors(i, &pose);
            (center.max(c), rotation.max(r))
        })
    }

    #[test]
    fn a_set_carries_a_target_that_shares_nothing_with_the_scene() {
        let world = World::chain(9, 0.2, 1);
        assert_eq!(world.shared_with_scene(8), 0);
        let found = locate(&world, &CamsetParams::default());
        assert!(
            found.refined.iter().all(|photo| photo.verdict == Verdict::Localized),
            "{:#?}",
            found.refined[8]
        );
        let (center, rotation) = worst_errors(&world, &found.refined);
        assert!(center < 0.1 && rotation < 0.2, "{center} {rotation}");
        let target = &found.paths[8];
        assert!(target.links.len() > 2 && target.weakest().is_some_and(|link| link.shared >= 12));
    }

    #[test]
    fn a_told_focal_length_that_the_local_model_contradicts_is_estimated_and_named() {
        let world = World::chain(9, 0.2, 1);
        let mut told = world.camera.clone();
        told.params[0] *= 1.01;
        told.params[1] *= 1.01;
        let located = |camera: &Camera| {
            let queries = world.queries().into_iter().map(|photo| QueryPhoto { camera, ..photo });
            let queries: Vec<QueryPhoto<'_>> = queries.collect();
            let models = std::slice::from_ref(&world.local);
            locate_photos(&CamsetParams::default(), &world.scene(), &queries, models, 7)
        };
        let is_named = |found: &SetLocalization| found.advice.iter().any(|text| text.contains("is told for"));
        let found = located(&told);
        assert!(found.refined.iter().all(|photo| photo.verdict == Verdict::Localized));
        let (center, rotation) = worst_errors(&world, &found.refined);
        assert!(center < 0.1 && rotation < 0.2, "{center} {rotation}");
        let share = found.refined[0].camera.focal_length() / world.camera.focal_length() - 1.0;
        assert!(share.abs() < 2e-3, "{share}");
        assert_eq!(found.refined[0].camera.params[2..], world.camera.params[2..]);
        assert!(is_named(&found), "{:?}", found.advice);
        let found = located(&world.camera);
        assert!(!is_named(&found) && found.refined[0].camera == world.camera);
    }

    /// Locates the photos of a world as a set, with what was found of them alone changed.
    fn locate_with_alone(
        world: &World,
        change: impl Fn(&mut [SingleLocalization]),
    ) -> (Vec<SingleLocalization>, SetLocalization) {
        let (scene, queries) = (world.scene(), world.queries());
        let alone = queries.iter().map(|photo| locate_single(&SingleParams::default(), &scene, photo, 7));
        let mut alone: Vec<SingleLocalization> = alone.collect();
        change(&mut alone);
        let models = std::slice::from_ref(&world.local);
        let params = CamsetParams::default();
        let found = locate_with(&params, &scene, (&*queries, &*alone), models, Views::default, 7);
        (alone, found)
    }

    fn move_by(metres: f64) -> impl Fn(&mut SingleLocalization) {
        move |alone| {
            if let Some(pose) = &mut alone.answer.photo.world_from_camera {
                pose.translation.z += metres;
            }
        }
    }

    #[test]
    fn a_local_model_that_several_photos_contradict_localizes_nothing() {
        let world = World::chain(9, 0.2, 1);
        let located = |moved: usize, metres: f64| {
            locate_with_alone(&world, |alone| {
                let localized =
                    |photo: &&mut SingleLocalization| photo.answer.photo.verdict == Verdict::Localized;
                alone.iter_mut().rev().filter(localized).take(moved).for_each(move_by(metres));
            })
        };
        let (_, found) = located(1, 8.0);
        let verdicts = found.refined.iter().map(|photo| photo.verdict);
        assert_eq!(verdicts.filter(|verdict| *verdict == Verdict::Localized).count(), 8);
        assert_eq!(found.contradicted.len(), 1);
        // So far from where the others have them, the two of fewest matches are at a copy of what they show.
        for (metres, outweighed) in [(3.0, 0), (8.0, 2)] {
            let (alone, found) = located(2, metres);
            let mut doubted = Vec::new();
            for (photo, alone) in found.refined.iter().zip(&alone) {
                if alone.answer.photo.verdict != Verdict::Localized {
                    assert_ne!(photo.verdict, Verdict::Localized, "{photo:?}");
                    continue;
                }
                assert_eq!(photo.world_from_camera, alone.answer.photo.world_from_camera);
                if photo.verdict != Verdict::Localized {
                    assert!(photo.reasons.join("; ").contains("with more matches"), "{photo:?}");
                    doubted.push(photo.name.as_str());
                }
            }
            let localized = |alone: &&SingleLocalization| alone.answer.photo.verdict == Verdict::Localized;
            let names = alone.iter().rev().filter(localized).map(|alone| alone.answer.photo.name.as_str());
            let mut moved: Vec<&str> = names.take(outweighed).collect();
            moved.reverse();
            assert_eq!(doubted, moved, "moved by {metres} m");
            assert!(found.rigid.iter().all(|photo| photo.verdict != Verdict::Localized));
            assert!(found.contradicted.is_empty());
            assert_ne!(found.refined[8].verdict, Verdict::Localized);
        }
    }

    #[test]
    fn a_photo_that_shows_more_alone_stands_as_it_does_alone() {
        let world = World::chain(9, 0.2, 1);
        let (alone, found) = locate_with_alone(&world, |alone| {
            move_by(0.2)(&mut alone[1]);
            alone[1].answer.photo.inliers *= 2;
        });
        assert_eq!(found.refined[1].world_from_camera, alone[1].answer.photo.world_from_camera);
        assert_eq!(found.refined[1].verdict, Verdict::Localized);
        assert_ne!(found.rigid[1].verdict, Verdict::Localized);
        assert!(found.refined[1].reasons.join("; ").contains("scene points that it shows alone"));
        assert!(found.contradicted.is_empty());
        for (photo, alone) in found.refined.iter().zip(&alone) {
            let is_held =
                alone.answer.photo.verdict == Verdict::Localized || photo.verdict == Verdict::Localized;
            assert!(is_held || photo.reasons.join("; ").contains("too few of the scene points"), "{photo:?}");
        }
        assert_ne!(found.refined[8].verdict, Verdict::Localized);
    }

    #[test]
    fn where_hardly_any_match_agrees_guided_matching_tells_the_pose() {
        let world = World::chain(6, 0.2, 1);
        // All but one in 60 scene points have another that is as like, for the ratio test.
        let (_, found) = locate_with_alone(&world, |alone| {
            for alone in alone {
                alone.answer.photo.verdict = Verdict::NotLocalized;
                alone.answer.photo.world_from_camera = None;
                alone.answer.inliers.clear();
                for nearest in &mut alone.nearest {
                    let repeated = nearest.first.filter(|first| !first.point.0.is_multiple_of(60));
                    if let Some(first) = repeated {
                        let point = setloc_sfm::PointId(first.point.0 ^ 1);
                        nearest.second = Some(setloc_index::Neighbour { point, ..first });
                    }
                }
            }
        });
        let (center, rotation) = worst_errors(&world, &found.refined);
        assert!(center < 0.2 && rotation < 0.3, "{center} {rotation}");
        for photo in &found.refined {
            let reasons = photo.reasons.join("; ");
            assert_eq!(photo.verdict, Verdict::Localized, "{}: {reasons}", photo.name);
            assert!(reasons.contains("guided matching shows"), "{reasons}");
        }
    }

    #[test]
    fn what_is_seen_where_the_scene_may_be_wrong_is_uncertain() {
        let world = World::chain(6, 0.2, 1);
        let all: Vec<ImageId> = world.scene().reconstruction.registered().collect();
        for doubtful in [&all[..1], &all[..]] {
            let scene = Scene { doubtful, ..world.scene() };
            let alone: Vec<_> = (world.queries().iter())
                .map(|query| locate_single(&SingleParams::default(), &scene, query, 3))
                .collect();
            let references: Vec<PhotoEvidence<'_>> = alone.iter().map(SingleLocalization::evidence).collect();
            let (queries, models) = (world.queries(), std::slice::from_ref(&world.local).into());
            let no_views = || Ok::<_, Infallible>(Views::default());
            let params = CamsetParams::default();
            let set = locate_set(&params, &scene, &queries, &references, models, no_views, 3).unwrap();
            let is_doubted = doubtful.len() > 1;
            for photo in &set.refined {
                let expected = if is_doubted { Verdict::Uncertain } else { Verdict::Localized };
                assert_eq!(photo.verdict, expected, "{photo:?}");
            }
            let alone = alone.iter().map(|alone| &alone.answer.photo);
            for photo in alone.chain(&set.refined).filter(|photo| photo.world_from_camera.is_some()) {
                assert_eq!(photo.reasons.join("; ").contains(DOUBTFUL), is_doubted, "{photo:?}");
                assert!(!is_doubted || photo.verdict == Verdict::Uncertain, "{photo:?}");
            }
        }
    }

    #[test]
    fn one_photo_that_contradicts_counts_once_whatever_its_standpoint_has() {
        let turned = |i: u32| {
            let center = Vector3::new(0.5, -1.5, 20.0 + 6.0 * f64::from(i / 2));
            along_street(center, if i.is_multiple_of(2) { -0.1 } else { 0.9 })
        };
        let world = World::new(&Place::street(3500, 11), &(0..8).map(turned).collect::<Vec<_>>(), 0.2, 11);
        let (alone, found) = locate_with_alone(&world, |alone| {
            move_by(8.0)(&mut alone[0]);
            alone[1].answer.photo.verdict = Verdict::Uncertain;
        });
        assert_eq!(alone[0].answer.photo.verdict, Verdict::Localized);
        assert_eq!(found.contradicted, [found.refined[0].name.clone()]);
        assert!(found.refined[..2].iter().all(|photo| photo.verdict == Verdict::Uncertain));
        let said = |at: usize| found.refined[at].reasons.join("; ");
        assert!(said(0).contains("localized alone, it stands elsewhere"), "{}", said(0));
        assert!(said(1).contains("another photo of its standpoint stands elsewhere"), "{}", said(1));
        assert!(found.refined[2..].iter().all(|photo| photo.verdict == Verdict::Localized));
    }

    #[test]
    fn the_ground_alone_localizes_neither_photo_nor_set() {
        let alone = |world: &World| {
            let photo =
                locate_single(&SingleParams::default(), &world.scene(), &world.queries()[0], 7).answer.photo;
            (photo.verdict, photo.reasons.join("; "))
        };
        for standing in [0.0, 0.2] {
            let world = World::chain_in(&Place::street(3500, 1).paved(standing, 2), 6, 0.2, 1);
            let found = locate(&world, &CamsetParams::default());
            let (center, rotation) = worst_errors(&world, &found.refined);
            assert!(center < 0.2 && rotation < 0.3, "{center} {rotation}");
            let localized = found.refined.iter().filter(|photo| photo.verdict == Verdict::Localized).count();
            let (verdict, reasons) = alone(&world);
            if standing > 0.0 {
                assert_eq!((localized, verdict), (6, Verdict::Localized), "{reasons}");
            } else {
                assert_eq!((localized, verdict), (0, Verdict::Uncertain), "{reasons}");
                assert!(reasons.contains("lie on the ground"), "{reasons}");
            }
        }
    }

    /// A set whose scene has no point that any of its photos shows.
    fn locate_by_views(panoramas: &[u32], seed: u64) -> (World, SetLocalization) {
        locate_by_views_with(&CamsetParams::default(), panoramas, seed)
    }

    fn locate_by_views_with(params: &CamsetParams, panoramas: &[u32], seed: u64) -> (World, SetLocalization) {
        let mut world = World::chain(6, 0.2, seed);
        world.forget_seen_points();
        let alone = |photo| locate_single(&SingleParams::default(), &world.scene(), photo, 7);
        let alone: Vec<SingleLocalization> = world.queries().iter().map(alone).collect();
        let models = std::slice::from_ref(&world.local);
        let photos = (&*world.queries(), &*alone);
        let views = || world.views(panoramas);
        let found = locate_with(params, &world.scene(), photos, models, views, 7);
        (world, found)
    }

    #[test]
    fn without_other_hypotheses_only_the_solver_places_a_set() {
        // It goes by scene points, of which this set sees none.
        let params = CamsetParams { other_hypotheses: false, ..CamsetParams::default() };
        let (_, found) = locate_by_views_with(&params, &[5, 7], 1);
        assert!(found.placed.is_empty());
        assert!(!locate_by_views(&[5, 7], 1).1.placed.is_empty());
    }

    #[test]
    fn a_set_that_shares_no_scene_point_is_placed_by_what_panoramas_show() {
        for seed in [1, 2, 3] {
            let (world, found) = locate_by_views(&[5, 7], seed);
            for photo in &found.refined {
                assert_eq!(photo.verdict, Verdict::Localized, "{photo:#?}");
            }
            let (center, rotation) = worst_errors(&world, &found.refined);
            assert!(center < 0.15 && rotation < 0.2, "{seed}: {center} {rotation}");
            assert!(found.paths[5].weakest().is_some_and(|link| link.shared >= 12), "{:?}", found.paths[5]);
        }
    }

    #[test]
    fn one_panorama_gives_a_set_no_scale() {
        let (_, found) = locate_by_views(&[6], 1);
        for photo in &found.refined {
            assert_ne!(photo.verdict, Verdict::Localized, "{photo:#?}");
        }
        let (_, found) = locate_by_views(&[], 1);
        assert!(found.refined.iter().all(|photo| photo.world_from_camera.is_none()));
    }

    #[test]
    fn one_photo_is_placed_by_two_panoramas_that_share_no_point() {
        for seed in [1, 2, 3] {
            let mut world = World::chain(1, 0.2, seed);
            world.forget_seen_points();
            let alone = locate_single(&SingleParams::default(), &world.scene(), &world.queries()[0], 7);
            assert_ne!(alone.answer.photo.verdict, Verdict::Localized);
            let locate = |panoramas: &[u32]| {
                let views = || world.views(panoramas);
                let params = CamsetParams::default();
                let photos = (&*world.queries(), std::slice::from_ref(&alone));
                locate_with(&params, &world.scene(), photos, &[], views, 7)
            };
            let found = locate(&[5, 7]);
            assert_eq!(found.refined[0].verdict, Verdict::Localized, "{:#?}", found.refined[0]);
            let (center, rotation) = worst_errors(&world, &found.refined);
            assert!(center < 0.1 && rotation < 0.2, "{seed}: {center} {rotation}");
            let found = locate(&[6]);
            assert_ne!(found.refined[0].verdict, Verdict::Localized, "{:#?}", found.refined[0]);
        }
    }

    #[test]
    fn views_that_cannot_be_had_are_an_error_where_they_are_needed() {
        let mut world = World::chain(6, 0.2, 1);
        let photos = |world: &World| -> Vec<SingleLocalization> {
            let alone = |photo| locate_single(&SingleParams::default(), &world.scene(), photo, 7);
            world.queries().iter().map(alone).collect()
        };
        let locate = |world: &World| {
            let alone = photos(world);
            let alone: Vec<PhotoEvidence<'_>> = alone.iter().map(SingleLocalization::evidence).collect();
            let models = std::slice::from_ref(&world.local);
            let (params, queries) = (CamsetParams::default(), world.queries());
            locate_set(&params, &world.scene(), &queries, &alone, models.into(), || Err("damaged"), 7)
        };
        assert!(locate(&world).is_ok());
        world.forget_seen_points();
        assert_eq!(locate(&world), Err("damaged"));
    }

    #[test]
    fn views_of_another_place_localize_nothing() {
        let mut world = World::chain_in(&Place::street(3500, 21), 6, 0.2, 21);
        let other = World::chain_in(&Place::street(3500, 21).shuffled(4), 6, 0.2, 21);
        world.photos = other.photos;
        world.local = other.local;
        world.forget_seen_points();
        let alone = |photo| locate_single(&SingleParams::default(), &world.scene(), photo, 7);
        let alone: Vec<SingleLocalization> = world.queries().iter().map(alone).collect();
        for models in [vec![world.local.clone()], Vec::new()] {
            let views = || world.views(&[4, 5, 6, 7]);
            let params = CamsetParams::default();
            let photos = (&*world.queries(), &*alone);
            let found = locate_with(&params, &world.scene(), photos, &models, views, 7);
            for photo in &found.refined {
                assert_ne!(photo.verdict, Verdict::Localized, "{photo:#?}");
            }
        }
    }

    fn photo_at(verdict: Verdict, x: f64) -> PhotoLocalization {
        PhotoLocalization {
            name: String::new(),
            camera: crate::synthetic::pinhole(),
            component: 0,
            world_from_camera: Some(Rigid::new(UnitQuaternion::identity(), Vector3::new(x, 0.0, 0.0))),
            covariance: Some(nalgebra::Matrix6::identity() * 1e-4),
            inliers: 20,
            verdict,
            reasons: Vec::new(),
        }
    }

    /// An answer of two photos whose model was refused before.
    fn answer_of(photos: &[PhotoLocalization; 2]) -> Answer {
        let path = |shared| PathToScene {
            photo: "photo".to_owned(),
            links: vec![Link { from: None, to: "photo".to_owned(), shared }],
            open: None,
        };
        Answer {
            elsewhere: vec![false; 2],
            lacks_scale: vec![false; 2],
            cut: vec![None; 2],
            seen: vec![Vec::new(); 2],
            remarks: vec![Remark { members: vec![0, 1], is_refusal: true, text: "refused".to_owned() }],
            set: SetLocalization {
                rigid: photos.to_vec(),
                paths: vec![path(photos[0].inliers), path(photos[1].inliers)],
                refined: photos.to_vec(),
                ..SetLocalization::default()
            },
        }
    }

    #[test]
    fn answers_that_contradict_each_other_are_not_mixed() {
        let (photo, answer) = (photo_at, answer_of);
        let verdicts =
            |found: &Answer| found.set.refined.iter().map(|photo| photo.verdict).collect::<Vec<_>>();
        let first = || answer(&[photo(Verdict::Localized, 0.0), photo(Verdict::Uncertain, 1.0)]);
        let agreeing = answer(&[photo(Verdict::Uncertain, 0.01), photo(Verdict::Localized, 1.01)]);
        let best = better_of(first(), agreeing);
        assert_eq!(verdicts(&best), [Verdict::Localized; 2]);
        assert_eq!(best.set.refined[0].world_from_camera, first().set.refined[0].world_from_camera);
        // Neither that the models were refused nor what to do about a photo holds any more.
        assert_eq!(best.finished().advice, Vec::<String>::new());
        assert_eq!(first().finished().advice.len(), 2);
        let elsewhere = answer(&[photo(Verdict::Localized, 5.0), photo(Verdict::Localized, 6.0)]);
        assert_eq!(better_of(first(), elsewhere), first());
        let poorer = answer(&[photo(Verdict::Uncertain, 0.0), photo(Verdict::NotLocalized, 1.0)]);
        assert_eq!(better_of(first(), poorer), first());
    }

    #[test]
    fn of_two_uncertain_answers_the_one_whose_scale_is_told_is_taken() {
        let photos = |x: f64| [photo_at(Verdict::Localized, 0.0), photo_at(Verdict::Uncertain, x)];
        let lacking = || Answer { lacks_scale: vec![true, true], ..answer_of(&photos(1.0)) };
        assert_eq!(better_of(lacking(), answer_of(&photos(1.2))), answer_of(&photos(1.2)));
        assert_eq!(better_of(answer_of(&photos(1.2)), lacking()), answer_of(&photos(1.2)));
        assert_eq!(
            better_of(lacking(), Answer { lacks_scale: vec![true, true], ..answer_of(&photos(1.2)) }),
            lacking()
        );
    }

    #[test]
    fn the_papers_method_localizes_the_same_set() {
        let world = World::chain(9, 0.2, 2);
        let found = locate(&world, &CamsetParams::paper());
        let (center, rotation) = worst_errors(&world, &found.rigid);
        assert!(center < 0.3 && rotation < 0.5, "{center} {rotation}");
        assert_eq!(CamsetParams::paper().method, CamsetMethod::Dlt);
    }

    #[test]
    fn joint_refinement_undoes_the_drift_of_the_local_model() {
        let mut world = World::chain(9, 0.2, 3);
        world.bend(0.002, 0.002);
        let found = locate(&world, &CamsetParams::default());
        let (rigid, refined) = (worst_errors(&world, &found.rigid), worst_errors(&world, &found.refined));
        assert!(refined.0 < 0.4 * rigid.0 && refined.1 < 0.4 * rigid.1, "{rigid:?} {refined:?}");
        assert!(refined.0 < 0.15 && refined.1 < 0.2, "{refined:?}");
    }

    #[test]
    fn photos_that_outvoted_matches_speak_against_are_uncertain_but_where_they_are_localized_alone() {
        let world = World::chain(9, 0.2, 3);
        let photos = world.queries();
        let alone: Vec<SingleLocalization> = photos
            .iter()
            .map(|photo| locate_single(&SingleParams::default(), &world.scene(), photo, 7))
            .collect();
        let evidence: Vec<PhotoEvidence<'_>> = alone.iter().map(SingleLocalization::evidence).collect();
        let locate_with = |matches: usize, side: Vec<ImageId>| {
            let (first, second) = (ImageId(5), ImageId(6));
            let outvoted = [vec![OutvotedPair { first, second, matches, held_by: 60, side }]];
            let models = LocalModels { outvoted: &outvoted, ..std::slice::from_ref(&world.local).into() };
            let views = || Ok::<_, Infallible>(Views::default());
            let (params, scene) = (CamsetParams::default(), world.scene());
            locate_set(&params, &scene, &photos, &evidence, models, views, 7).unwrap()
        };
        let locate = |side: Vec<ImageId>| locate_with(80, side);
        let verdicts = |found: &SetLocalization| -> Vec<bool> {
            found.refined.iter().map(|photo| photo.verdict == Verdict::Localized).collect()
        };
        assert_eq!(verdicts(&locate(first_photos(9))), [true; 9]);
        // Whichever side the pair's first is on.
        for side in [first_photos(6), (6..9).map(ImageId).collect()] {
            let found = locate(side);
            assert_eq!(verdicts(&found), [true, true, true, true, true, true, false, false, false]);
            let reasons = &found.refined[8].reasons;
            assert!(reasons.iter().any(|reason| reason.contains("80 matches")), "{reasons:?}");
        }
        // Photos that are localized alone stay so on the other side.
        let by_themselves =
            alone.iter().filter(|found| found.answer.photo.verdict == Verdict::Localized).count();
        assert!(by_themselves >= 2 && verdicts(&locate(first_photos(1)))[..2] == [true; 2]);
        // By far more matches speak against those, too, that share points with them and that the scene does not hold.
        let found = locate_with(300, first_photos(6));
        assert_eq!(verdicts(&found), [true, true, true, true, true, false, false, false, false]);
        assert!(found.refined[5].reasons.join("; ").contains("may be folded"));
    }

    fn first_photos(count: u32) -> Vec<ImageId> {
        (0..count).map(ImageId).collect()
    }

    #[test]
    fn a_length_from_planes_is_held_and_its_uncertainty_is_the_targets() {
        for (seed, error, deviation) in [(41, 0.0, 0.02), (42, 0.05, 0.03), (43, -0.05, 0.03)] {
            let mut world = World::chain(7, 0.2, seed);
            world.cut_last(error, deviation);
            let found = locate(&world, &CamsetParams::default());
            let target = &found.refined[6];
            let pose = target.world_from_camera.expect("has a pose");
            let baseline = world.photos[6].pose.translation - world.photos[5].pose.translation;
            let along = baseline.normalize();
            let off = (pose.translation - world.photos[6].pose.translation).dot(&along) / baseline.norm();
            let of_center =
                target.covariance.expect("the length is held").fixed_view::<3, 3>(3, 3).into_owned();
            let sigma = along.dot(&(of_center * along)).sqrt() / baseline.norm();
            assert!((off - error).abs() < 0.02, "{seed}: {off}");
            assert!(sigma > 0.95 * deviation && sigma < 2.0 * deviation, "{seed}: {sigma}");
            assert!(
                found.advice.iter().any(|remark| remark.contains("rests on planes")),
                "{:?}",
                found.advice
            );
            assert!(target.reasons.iter().any(|reason| reason.contains("20 points")), "{:?}", target.reasons);
            let link = found.paths[6].links.last().expect("hangs on the photo before");
            assert!(link.shared >= 12, "{link:?}");
        }
    }

    #[test]
    fn a_target_stands_where_its_pair_by_a_wall_has_it_as_well_as_that_tells() {
        let mut world = World::chain(7, 0.2, 45);
        world.cut_last(0.0, 0.02);
        let turn = UnitQuaternion::from_euler_angles(0.0, 0.01, 0.0);
        let length = &mut world.local.lengths[0];
        length.pose.rotation *= turn;
        for axis in 0..3 {
            length.covariance[(axis, axis)] = 0.012_f64.powi(2);
        }
        let found = locate(&world, &CamsetParams::default());
        let [near, target] = [5, 6].map(|photo| &found.refined[photo]);
        assert_eq!((near.verdict, target.verdict), (Verdict::Localized, Verdict::Uncertain));
        let pose = target.world_from_camera.expect("has a pose");
        let turned = world.photos[6].pose.rotation * turn;
        assert!(pose.rotation.angle_to(&turned) < 0.002, "{}", pose.rotation.angle_to(&turned));
        let covariance = target.covariance.expect("is stated");
        let rotation = covariance.fixed_view::<3, 3>(0, 0).trace() / 3.0;
        assert!((1.0..1.3).contains(&(rotation / 0.012_f64.powi(2))), "{rotation}");
    }

    #[test]
    fn a_length_from_planes_that_is_hardly_known_leaves_the_target_uncertain() {
        let mut world = World::chain(7, 0.2, 44);
        world.cut_last(0.3, 0.3);
        let found = locate(&world, &CamsetParams::default());
        assert_eq!(found.refined[5].verdict, Verdict::Localized);
        assert_eq!(found.refined[6].verdict, Verdict::Uncertain, "{:#?}", found.refined[6]);
    }

    #[test]
    fn a_length_from_fewer_points_than_a_pose_needs_is_not_relied_upon() {
        let mut world = World::chain(7, 0.2, 44);
        world.cut_last(0.6, 0.02);
        world.local.lengths[0].votes = 11;
        let found = locate(&world, &CamsetParams::default());
        let [near, target] = [5, 6].map(|photo| &found.refined[photo]);
        assert_eq!((near.verdict, target.verdict), (Verdict::Localized, Verdict::Uncertain));
        let said = target.reasons.join("; ");
        assert!(said.contains("how far it is from photo_05 rests on "), "{said}");
        let (pose, covariance) = (target.world_from_camera.unwrap(), target.covariance.unwrap());
        let off = pose.translation - world.photos[6].pose.translation;
        let of_center = covariance.fixed_view::<3, 3>(3, 3).into_owned();
        let normalized = off.dot(&(of_center.try_inverse().unwrap() * off)) / 3.0;
        assert!(off.norm() > 1.0 && normalized < 2.0, "{off} {normalized}");
    }

    #[test]
    fn aligned_places_outdo_keypoints_that_err_alike() {
        let mut world = World::chain(9, 0.2, 3);
        world.stretch_keypoints(0.001);
        let by_keypoints = worst_errors(&world, &locate(&world, &CamsetParams::default()).refined);
        world.align(0.05, 1);
        let found = locate(&world, &CamsetParams::default());
        let aligned = worst_errors(&world, &found.refined);
        assert!(aligned.0 < 0.5 * by_keypoints.0 && aligned.0 < 0.1, "{by_keypoints:?} {aligned:?}");
        assert!(found.refined.iter().all(|photo| photo.verdict == Verdict::Localized));
    }

    #[test]
    fn a_set_from_one_centre_has_no_scale() {
        let place = Place::street(3500, 4);
        let center = Vector3::new(0.0, -1.5, 22.0);
        let poses: Vec<_> = (0..4).map(|i| along_street(center, 0.1 * f64::from(i))).collect();
        let world = World::new(&place, &poses, 0.1, 4);
        let found = locate(&world, &CamsetParams::default());
        for (i, photo) in found.rigid.iter().enumerate() {
            assert_ne!(photo.verdict, Verdict::Localized);
            assert!(photo.reasons.iter().any(|reason| reason.contains("scale")), "{i}: {:?}", photo.reasons);
        }
    }

    #[test]
    fn photos_of_one_standpoint_stay_together() {
        let place = Place::street(3500, 11);
        let poses: Vec<_> = (0..8)
            .map(|i| {
                let center = Vector3::new(0.5, -1.5, 20.0 + 6.0 * f64::from(i / 2));
                along_street(center, if i % 2 == 0 { -0.1 } else { 0.9 })
            })
            .collect();
        let world = World::new(&place, &poses, 0.2, 11);
        let found = locate(&world, &CamsetParams::default());
        let (center, rotation) = worst_errors(&world, &found.refined);
        assert!(center < 0.1 && rotation < 0.2, "{center} {rotation}");
        for turned in found.refined.chunks(2) {
            let [a, b] = [0, 1].map(|i| turned[i].world_from_camera.unwrap());
            assert!((a.translation - b.translation).norm() < 1e-12, "{a:?} {b:?}");
            assert!((a.rotation.angle_to(&b.rotation) - 1.0).abs() < 1e-6);
            assert_eq!(turned.iter().filter(|photo| photo.verdict == Verdict::Localized).count(), 2);
        }
    }

    #[test]
    fn foreign_photos_are_not_localized() {
        let world = World::chain(5, 0.2, 5);
        for seed in 0..10 {
            let elsewhere = World::chain(5, 0.2, 100 + seed);
            let (photos, local) = (elsewhere.queries(), std::slice::from_ref(&elsewhere.local));
            let found = locate_photos(&CamsetParams::default(), &world.scene(), &photos, local, seed);
            for photo in found.rigid.iter().chain(&found.refined) {
                assert_eq!(photo.verdict, Verdict::NotLocalized, "{seed}: {photo:#?}");
            }
            assert!(found.advice.iter().any(|sentence| sentence.contains("take")), "{:?}", found.advice);
        }
    }

    #[test]
    fn photos_of_the_same_details_in_another_arrangement_are_not_localized() {
        let world = World::chain(5, 0.2, 5);
        for seed in 0..4 {
            let elsewhere = World::chain_in(&Place::street(3500, 5).shuffled(seed), 5, 0.2, 300 + seed);
            let (photos, local) = (elsewhere.queries(), std::slice::from_ref(&elsewhere.local));
            let found = locate_photos(&CamsetParams::default(), &world.scene(), &photos, local, seed);
            for photo in found.rigid.iter().chain(&found.refined) {
                assert_ne!(photo.verdict, Verdict::Localized, "{seed}: {photo:#?}");
            }
        }
    }

    #[test]
    fn two_equal_places_leave_a_set_uncertain() {
        let place = Place::street(3500, 6);
        let poses: Vec<_> =
            (0..4).map(|i| along_street(Vector3::new(0.0, -1.5, 18.0 + 3.0 * f64::from(i)), 0.0)).collect();
        let mut world = World::new(&place, &poses, 0.1, 6);
        world.split_scene(Vector3::new(300.0, 0.0, 0.0));
        let found = locate(&world, &CamsetParams::default());
        for photo in &found.refined {
            assert_ne!(photo.verdict, Verdict::Localized, "{photo:#?}");
        }
    }

    #[test]
    fn a_set_without_local_model_is_localized_photo_by_photo() {
        let world = World::chain(3, 0.2, 8);
        let found = locate_photos(&CamsetParams::default(), &world.scene(), &world.queries(), &[], 1);
        assert!(found.placed.is_empty());
        assert!(
            found.refined.iter().all(|photo| photo.verdict == Verdict::Localized),
            "{:#?}",
            found.refined
        );
    }

    #[test]
    fn the_same_seed_gives_the_same_answer() {
        let world = World::chain(5, 0.3, 9);
        assert_eq!(locate(&world, &CamsetParams::default()), locate(&world, &CamsetParams::default()));
    }

    /// Mean squared normalized error of the six pose parameters, whose expectation is 1, of target and first photo.
    fn mean_squared_normalized_error(seeds: std::ops::Range<u64>) -> [f64; 2] {
        let count = (seeds.end - seeds.start) as f64;
        let mut sums = [0.0; 2];
        for seed in seeds {
            let world = World::chain(6, 0.2, seed);
            let found = locate(&world, &CamsetParams::default());
            for (sum, photo) in sums.iter_mut().zip([5, 0]) {
                let answer = &found.refined[photo];
                let (pose, covariance) = (answer.world_from_camera.unwrap(), answer.covariance.unwrap());
                let error = deviation(&pose, &world.photos[photo].pose);
                *sum += error.dot(&(covariance.try_inverse().unwrap() * error)) / 6.0;
            }
        }
        sums.map(|sum| sum / count)
    }

    #[test]
    fn errors_fit_the_covariance() {
        let mean = mean_squared_normalized_error(1000..1024);
        assert!(mean.iter().all(|mean| (0.5..1.6).contains(mean)), "{mean:?}");
    }

    #[test]
    #[ignore = "takes minutes; prints the figures"]
    fn measure_calibration_over_five_hundred_trials() {
        let mean = mean_squared_normalized_error(5000..5500);
        println!("mean squared normalized error: target {:.3}, first photo {:.3}", mean[0], mean[1]);
        assert!(mean.iter().all(|mean| (0.8..1.25).contains(mean)), "{mean:?}");
    }
}
