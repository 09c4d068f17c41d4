//! The way from the scene through the bridging photos to a photo, and where to take another one.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use setloc_sfm::{MOST_NAMED, PairGeometry, listed};

/// What ties two photos, or the scene and a photo, together.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Link {
    /// Name of the photo nearer to the scene, `None` for the scene itself.
    pub from: Option<String>,
    /// Name of the photo farther from the scene.
    pub to: String,
    /// Scene points the photo sees, or local points that both photos see.
    pub shared: usize,
}

impl Link {
    fn sentence(&self) -> String {
        match &self.from {
            None => format!("{} sees {} scene points", self.to, self.shared),
            Some(from) => format!("{from} and {} share {} points", self.to, self.shared),
        }
    }
}

/// The strongest way from the scene to a photo: the one whose weakest link is strongest.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PathToScene {
    /// Name of the photo.
    pub photo: String,
    /// The links from the scene to the photo; empty when nothing leads there.
    pub links: Vec<Link>,
    /// Where too little leads there: verified matches of two photos that are missing on the way, as they tell no distance (those
    /// of one wall).
    pub open: Option<Link>,
}

impl PathToScene {
    /// The weakest link, the first of equals; `None` when nothing leads to the photo.
    pub fn weakest(&self) -> Option<&Link> {
        self.links.iter().min_by_key(|link| link.shared)
    }

    /// What to do about a photo that is not localized well; photos beyond one weak link have it in common.
    fn remedy(&self) -> String {
        match (self.weakest(), &self.open) {
            (_, Some(Link { from: Some(from), to, shared })) => format!(
                "the weakest link: {from} and {to} share {shared} matches, which do not tell how far apart they were \
                 taken, as those of one wall; take another photo between {from} and {to} that also shows something near"
            ),
            (None, _) => "nothing is shared with the scene or with photos that share something with it; take photos on the \
                          way from the scene, each overlapping the one before by more than half"
                .to_owned(),
            (Some(link @ Link { from: None, .. }), _) => format!(
                "the weakest link is the one to the scene: {}; take a photo nearer to the panoramas than {}, towards the \
                 same surfaces",
                link.sentence(),
                link.to
            ),
            (Some(link @ Link { from: Some(from), .. }), _) => format!(
                "the weakest link: {}; take another photo between {from} and {}",
                link.sentence(),
                link.to
            ),
        }
    }
}

/// What to do about photos that are not localized well: each advice once, with all photos that it is for.
pub(crate) fn advice_about<'p>(paths: impl Iterator<Item = &'p PathToScene>) -> Vec<String> {
    let mut remedies: Vec<(String, Vec<&str>)> = Vec::new();
    for path in paths {
        let remedy = path.remedy();
        match remedies.iter_mut().find(|(other, _)| *other == remedy) {
            Some((_, photos)) => photos.push(&path.photo),
            None => remedies.push((remedy, vec![&path.photo])),
        }
    }
    remedies
        .into_iter()
        .map(|(remedy, photos)| format!("{}: {remedy}", listed(&photos, MOST_NAMED)))
        .collect()
}

/// Widest paths (maximum bottleneck) from the scene to every photo.
///
/// `scene_links[i]`: scene points that photo `i` sees; `photo_links[(i, j)]`, i < j: local points both see. Links of
/// no shared point do not exist. Prim's maximum spanning tree, whose paths are widest.
pub(crate) fn widest_paths(
    names: &[&str],
    scene_links: &[usize],
    photo_links: &BTreeMap<(usize, usize), usize>,
) -> Vec<PathToScene> {
    let count = names.len();
    // Best known link into each photo: (shared points, from), from = None for the scene.
    let mut into: Vec<(usize, Option<usize>)> = scene_links.iter().map(|&shared| (shared, None)).collect();
    let mut parent: Vec<Option<(usize, Option<usize>)>> = vec![None; count];
    let mut reached = vec![false; count];
    while let Some(next) = (0..count)
        .filter(|&photo| !reached[photo] && into[photo].0 > 0)
        .max_by_key(|&photo| (into[photo].0, std::cmp::Reverse(photo)))
    {
        reached[next] = true;
        parent[next] = Some(into[next]);
        for photo in (0..count).filter(|&photo| !reached[photo]).collect::<Vec<_>>() {
            let shared = photo_links.get(&(next.min(photo), next.max(photo))).copied().unwrap_or(0);
            if shared > into[photo].0 {
                into[photo] = (shared, Some(next));
            }
        }
    }
    (0..count)
        .map(|photo| {
            let mut links = Vec::new();
            let mut at = Some(photo);
            while let Some(here) = at {
                let Some((shared, from)) = parent[here] else { break };
                links.push(Link {
                    from: from.map(|f| names[f].to_owned()),
                    to: names[here].to_owned(),
                    shared,
                });
                at = from;
            }
            links.reverse();
            PathToScene { photo: names[photo].to_owned(), links, open: None }
        })
        .collect()
}

/// Names, for photos that links of fewer points than `enough` lead to, what is missing on the widest way to them: the
/// weakest of its pairs that tell no distance. Of `photo_links` (as for [`widest_paths`]) all are wide enough.
pub(crate) fn name_open_pairs(
    paths: &mut [PathToScene],
    photo_links: &BTreeMap<(usize, usize), usize>,
    open: &[PairGeometry],
    enough: usize,
) {
    let tied = photo_links.keys().map(|&(a, b)| (a, b, usize::MAX));
    let of_pair =
        |pair: &PairGeometry| (pair.first.index(), pair.second.index(), pair.two_view.inliers.len());
    let links: Vec<(usize, usize, usize)> = tied.chain(open.iter().map(of_pair)).collect();
    let is_reached = |path: &PathToScene| path.weakest().is_some_and(|link| link.shared >= enough);
    let mut width: Vec<usize> =
        paths.iter().map(|path| if is_reached(path) { usize::MAX } else { 0 }).collect();
    let mut missing: Vec<Option<(usize, usize)>> = vec![None; paths.len()];
    let mut done = vec![false; paths.len()];
    while let Some(next) = (0..paths.len())
        .filter(|&photo| !done[photo] && width[photo] > 0)
        .max_by_key(|&photo| (width[photo], std::cmp::Reverse(photo)))
    {
        done[next] = true;
        for &(a, b, shared) in links.iter().filter(|(a, b, _)| *a == next || *b == next) {
            let other = if a == next { b } else { a };
            let reaches = shared.min(width[next]);
            if width.get(other).is_some_and(|width| reaches > *width) {
                missing[other] = if shared < width[next] { Some((next, other)) } else { missing[next] };
                width[other] = reaches;
            }
        }
    }
    let names: Vec<String> = paths.iter().map(|path| path.photo.clone()).collect();
    for ((path, missing), shared) in paths.iter_mut().zip(missing).zip(width) {
        let link = |(from, to): (usize, usize)| Link {
            from: Some(names[from].clone()),
            to: names[to].clone(),
            shared,
        };
        path.open = missing.map(link);
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use setloc_features::Match;
    use setloc_sfm::{ImageId, Rigid, TwoView, TwoViewKind};

    use super::*;

    fn advice(path: &PathToScene) -> String {
        advice_about(std::iter::once(path)).concat()
    }

    #[test]
    fn the_widest_path_avoids_the_weak_short_cut() {
        let links = BTreeMap::from([((0, 1), 200), ((1, 2), 40), ((0, 2), 9)]);
        let paths = widest_paths(&["a", "b", "c"], &[150, 3, 0], &links);
        let target = &paths[2];
        assert_eq!(target.links.iter().map(|l| l.to.as_str()).collect::<Vec<_>>(), ["a", "b", "c"]);
        assert_eq!(target.weakest().unwrap().shared, 40);
        assert!(advice(target).contains("between b and c"), "{}", advice(target));
        assert_eq!(paths[0].links.len(), 1);
        assert!(advice(&paths[0]).contains("150 scene points"));
    }

    #[test]
    fn matches_that_tell_no_distance_are_named() {
        let pair = |first, second, matches: u32| PairGeometry {
            first: ImageId(first),
            second: ImageId(second),
            two_view: TwoView {
                kind: TwoViewKind::General,
                second_from_first: Rigid::new(nalgebra::UnitQuaternion::identity(), Vector3::x()),
                inliers: (0..matches).map(|at| Match { first: at, second: at }).collect(),
                median_parallax_rad: 0.1,
            },
        };
        let names = ["a", "b", "c", "d", "e"];
        let mut paths = widest_paths(&names, &[30, 20, 11, 0, 0], &BTreeMap::new());
        // The widest way to d leads by c, to which b leads.
        let open = [
            pair(0, 2, 40),
            pair(2, 1, 90),
            pair(1, 0, 500),
            pair(2, 3, 70),
            pair(9, 2, 800),
            pair(3, 0, 30),
        ];
        name_open_pairs(&mut paths, &BTreeMap::from([((2, 4), 60)]), &open, 12);
        assert!(advice(&paths[2]).contains("b and c share 90 matches, which do not tell how far"));
        assert!(advice(&paths[4]).starts_with("e: the weakest link: b and c share 90 matches"));
        assert!(advice(&paths[3]).starts_with("d: the weakest link: c and d share 70 matches"));
        assert!([0, 1].iter().all(|&at| paths[at].open.is_none()));
        let about = advice_about(paths[2..].iter());
        assert_eq!(about.len(), 2, "{about:?}");
        assert!(about[0].starts_with("c, e: the weakest link: b and c share 90 matches"), "{about:?}");
    }

    #[test]
    fn an_unconnected_photo_has_no_path() {
        let paths = widest_paths(&["a", "b"], &[30, 0], &BTreeMap::new());
        assert!(paths[1].links.is_empty() && paths[1].weakest().is_none());
        assert!(advice(&paths[1]).starts_with("b: nothing is shared"));
    }
}
