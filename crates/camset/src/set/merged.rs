//! The set in all components of a scene: each component's answer, then for each photo the one that says most.

use super::{Answer, Remark, answer, cut::doubt_beside_cut};
use crate::anywhere::{Candidate, choose, is_rival};
use crate::{
    AnywhereLocalization, CamsetParams, LocalModels, NearestAnywhere, PhotoEvidence, PhotoLocalization,
    QueryPhoto, Scene, SetLocalization, Verdict, VerdictParams, Views,
};

/// Localizes a set in the components of a scene, the largest first, of which there is at least one.
///
/// As [`locate_set`](crate::locate_set) in each of them, until every photo is localized and none of the components left
/// supports another place for a photo alone. `alone` is what
/// [`locate_single_anywhere`](crate::locate_single_anywhere) says of each photo, with the scene points that it was sought
/// by. `views` is asked for one component, with what is known there of each photo alone.
///
/// # Errors
/// Those of `views`.
pub fn locate_set_anywhere<'a, E>(
    params: &CamsetParams,
    components: &[Scene<'_>],
    photos: &[QueryPhoto<'_>],
    alone: &[(&'a AnywhereLocalization, &'a NearestAnywhere)],
    local_models: LocalModels<'_>,
    views: impl Fn(&Scene<'_>, &[PhotoEvidence<'_>]) -> Result<Views, E>,
    seed: u64,
) -> Result<SetLocalization, E> {
    let mut answers = Vec::new();
    for (at, scene) in components.iter().enumerate() {
        let of_photo = |(photo, nearest): &(&'a AnywhereLocalization, &'a NearestAnywhere)| {
            Some(photo.components.get(at)?.evidence(nearest.components.get(at)?))
        };
        let evidence: Vec<PhotoEvidence<'_>> = alone.iter().filter_map(of_photo).collect();
        let of_scene = || views(scene, &evidence);
        answers.push(answer(params, scene, photos, &evidence, local_models, of_scene, seed)?);
        if is_settled(&params.verdict, &answers, alone) {
            break;
        }
    }
    let mut found = merged(&params.verdict, components, answers);
    let alone: Vec<&PhotoLocalization> =
        alone.iter().take(found.set.refined.len()).map(|(alone, _)| &alone.photo).collect();
    doubt_beside_cut(&mut found, photos, &alone);
    Ok(found.finished())
}

/// Whether every photo is localized, and none of the components not tried yet supports another place for one.
fn is_settled(
    params: &VerdictParams,
    answers: &[Answer],
    alone: &[(&AnywhereLocalization, &NearestAnywhere)],
) -> bool {
    let is_settled = |(photo, (alone, _)): (usize, &(&AnywhereLocalization, &NearestAnywhere))| {
        let localized = answers.iter().filter_map(|answer| answer.set.refined.get(photo));
        let localized = localized.filter(|answer| answer.verdict == Verdict::Localized);
        let Some(support) = localized.map(|answer| answer.inliers).max() else { return false };
        let untried = alone.components.iter().skip(answers.len()).map(|found| &found.photo);
        let mut placed = untried.filter(|photo| photo.world_from_camera.is_some());
        placed.all(|rival| !is_rival(params, rival.inliers, support))
    };
    alone.iter().enumerate().all(is_settled)
}

/// For each photo the answer of the component that says most of it, or, where none has a pose, that leads nearest to it.
fn merged(params: &VerdictParams, components: &[Scene<'_>], mut answers: Vec<Answer>) -> Answer {
    if answers.len() < 2 {
        return answers.pop().unwrap_or_default();
    }
    for answer in &mut answers {
        lead_by_paths(answer);
    }
    let mut merged = Answer::default();
    let photos = answers.iter().map(|answer| answer.set.refined.len()).min().unwrap_or(0);
    for photo in 0..photos {
        let chosen = |of_set| chosen(params, components, &answers, photo, of_set);
        let (Some((at, refined)), Some((_, rigid))) = (chosen(|set| &set.refined), chosen(|set| &set.rigid))
        else {
            continue;
        };
        merged.set.refined.push(refined);
        merged.set.rigid.push(rigid);
        merged.set.paths.push(answers[at].set.paths[photo].clone());
        merged.elsewhere.push(answers[at].elsewhere[photo]);
        merged.lacks_scale.push(answers[at].lacks_scale[photo]);
        merged.cut.push(answers.iter().find_map(|answer| answer.cut[photo]));
        merged.seen.push(answers[at].seen[photo].clone());
    }
    for (answer, scene) in answers.into_iter().zip(components) {
        let refined = &merged.set.refined;
        let is_used = refined
            .iter()
            .any(|photo| photo.component == scene.component && photo.world_from_camera.is_some());
        merged.set.placed.extend(answer.set.placed.into_iter().filter(|_| is_used));
        let remarks = answer.remarks.into_iter().filter(|remark| holds(remark, scene.component, refined));
        merged.remarks.extend(remarks);
    }
    merged
}

/// The answer that stands of those of one method, and which component's it is.
fn chosen(
    params: &VerdictParams,
    components: &[Scene<'_>],
    answers: &[Answer],
    photo: usize,
    of_set: fn(&SetLocalization) -> &[PhotoLocalization],
) -> Option<(usize, PhotoLocalization)> {
    let candidates: Vec<Candidate<'_>> = answers
        .iter()
        .zip(components)
        .map(|(answer, scene)| Candidate {
            answer: &of_set(&answer.set)[photo],
            is_placed: scene.is_placed,
            seen: &answer.seen[photo],
        })
        .collect();
    choose(params, &candidates)
}

/// Lets photos without a pose be held by the weakest link of their path.
fn lead_by_paths(answer: &mut Answer) {
    let photos = answer.set.refined.iter().zip(&answer.set.paths).zip(&mut answer.seen).enumerate();
    for (at, ((photo, path), seen)) in photos {
        if photo.world_from_camera.is_none() {
            *seen = vec![(at, path.weakest().map_or(0, |link| link.shared))];
        }
    }
}

/// Whether a component's remark still says something: one of the photos is answered by it, and what it refuses no other
/// component has placed.
fn holds(remark: &Remark, component: usize, answers: &[PhotoLocalization]) -> bool {
    let members = || remark.members.iter().filter_map(|&photo| answers.get(photo));
    let is_placed_elsewhere =
        |photo: &PhotoLocalization| photo.component != component && photo.world_from_camera.is_some();
    members().any(|photo| photo.component == component)
        && !(remark.is_refusal && members().any(is_placed_elsewhere))
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::convert::Infallible;

    use super::*;
    use crate::synthetic::World;
    use crate::{
        SingleLocalization, SingleParams, locate_set, locate_single, locate_single_anywhere, nearest_anywhere,
    };

    type Alone = (AnywhereLocalization, NearestAnywhere);

    fn alone(components: &[Scene<'_>], world: &World) -> Vec<Alone> {
        let locate = |photo: &QueryPhoto<'_>| {
            let nearest = nearest_anywhere(components, photo.features);
            (locate_single_anywhere(&SingleParams::default(), components, photo, &nearest, 7), nearest)
        };
        world.queries().iter().map(locate).collect()
    }

    fn locate(components: &[Scene<'_>], world: &World, alone: &[Alone]) -> SetLocalization {
        let alone: Vec<_> = alone.iter().map(|(found, nearest)| (found, nearest)).collect();
        let views = |_: &Scene<'_>, _: &[PhotoEvidence<'_>]| Ok::<_, Infallible>(Views::default());
        let models = std::slice::from_ref(&world.local);
        let params = CamsetParams::default();
        let Ok(found) =
            locate_set_anywhere(&params, components, &world.queries(), &alone, models.into(), views, 7);
        found
    }

    fn in_first(world: &World) -> SetLocalization {
        let alone = |photo| locate_single(&SingleParams::default(), &world.scene(), photo, 7);
        let alone: Vec<SingleLocalization> = world.queries().iter().map(alone).collect();
        let alone: Vec<PhotoEvidence<'_>> = alone.iter().map(SingleLocalization::evidence).collect();
        let views = || Ok::<_, Infallible>(Views::default());
        let (params, models) = (CamsetParams::default(), std::slice::from_ref(&world.local));
        let Ok(found) =
            locate_set(&params, &world.scene(), &world.queries(), &alone, models.into(), views, 7);
        found
    }

    #[test]
    fn a_set_of_the_second_component_is_localized_there_and_no_refusal_is_left() {
        let (other, world) = (World::chain(2, 0.2, 41), World::chain(7, 0.2, 42));
        let components = [other.scene(), Scene { component: 1, ..world.scene() }];
        let found = locate(&components, &world, &alone(&components, &world));
        for (photo, answer) in found.refined.iter().chain(&found.rigid).enumerate() {
            assert_eq!((answer.verdict, answer.component), (Verdict::Localized, 1), "{photo}: {answer:#?}");
        }
        let expected = in_first(&world);
        for (answer, expected) in found.refined.iter().zip(&expected.refined) {
            assert_eq!(answer.world_from_camera, expected.world_from_camera);
        }
        assert_eq!(found.placed.iter().map(|placed| placed.component).collect::<Vec<_>>(), [1]);
        assert_eq!(found.paths, expected.paths);
        assert!(!found.advice.iter().any(|text| text.contains("not localized")), "{:?}", found.advice);
        assert!(found.advice.iter().any(|text| text.contains("component 2")), "{:?}", found.advice);
        assert!(found.contradicted.is_empty());
    }

    #[test]
    fn components_that_look_alike_leave_a_set_uncertain() {
        let world = World::chain(5, 0.2, 43);
        let components = [0, 1].map(|component| Scene { component, ..world.scene() });
        let found = locate(&components, &world, &alone(&components, &world));
        for photo in &found.refined {
            assert_eq!((photo.verdict, photo.component), (Verdict::Uncertain, 0), "{photo:#?}");
            assert!(photo.reasons.iter().any(|reason| reason.contains("components 1 and 2")), "{photo:#?}");
        }
        let placed = components.map(|scene| Scene { is_placed: true, ..scene });
        let found = locate(&placed, &world, &alone(&placed, &world));
        assert!(found.refined.iter().all(|photo| photo.verdict == Verdict::Localized));
    }

    #[test]
    fn a_set_that_the_first_component_localizes_is_sought_in_no_other() {
        let world = World::chain(5, 0.2, 44);
        let twins = [0, 1].map(|component| Scene { component, ..world.scene() });
        // Alone nothing supports the twin, which the set would find.
        let mut alone = alone(&twins, &world);
        for ((found, _), query) in alone.iter_mut().zip(world.queries()) {
            found.components[1].photo = PhotoLocalization::not_localized(&query, 1, "");
        }
        assert_eq!(locate(&twins, &world, &alone), in_first(&world));
    }

    #[test]
    fn a_set_of_no_component_gets_the_advice_of_one() {
        let (first, second) = (World::chain(2, 0.2, 45), World::chain(2, 0.2, 46));
        let elsewhere = World::chain(5, 0.2, 145);
        let components = [first.scene(), Scene { component: 1, ..second.scene() }];
        let alone = alone(&components, &elsewhere);
        let asked = Cell::new(0);
        let views = |_: &Scene<'_>, _: &[PhotoEvidence<'_>]| {
            asked.set(asked.get() + 1);
            Ok::<_, Infallible>(Views::default())
        };
        let borrowed: Vec<_> = alone.iter().map(|(found, nearest)| (found, nearest)).collect();
        let (params, models) = (CamsetParams::default(), std::slice::from_ref(&elsewhere.local));
        let photos = elsewhere.queries();
        let Ok(found) =
            locate_set_anywhere(&params, &components, &photos, &borrowed, models.into(), views, 7);
        assert_eq!(asked.get(), 2);
        assert!(found.refined.iter().all(|photo| photo.verdict == Verdict::NotLocalized));
        assert!(found.placed.is_empty());
        let of_photos: Vec<&String> = found.advice.iter().filter(|text| text.contains("take ")).collect();
        let [advice] = of_photos[..] else { panic!("{:?}", found.advice) };
        assert!(found.refined.iter().all(|photo| advice.contains(&photo.name)), "{advice}");
    }
}
