//! The way from the scene through the bridging photos to a photo, and where to take another one.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

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
}

impl PathToScene {
    /// The weakest link, the first of equals; `None` when nothing leads to the photo.
    pub fn weakest(&self) -> Option<&Link> {
        self.links.iter().min_by_key(|link| link.shared)
    }

    /// What to do about a photo that is not localized well.
    pub fn advice(&self) -> String {
        match self.weakest() {
            None => format!(
                "{}: shares nothing with the scene or with photos that do; take photos on the way from the scene to it, \
                 each overlapping the one before by more than half",
                self.photo
            ),
            Some(link @ Link { from: None, .. }) => format!(
                "{}: its weakest link is the one to the scene: {}; take a photo nearer to the panoramas than {}, \
                 towards the same surfaces",
                self.photo,
                link.sentence(),
                link.to
            ),
            Some(link @ Link { from: Some(from), .. }) => format!(
                "{}: its weakest link: {}; take another photo between {from} and {}",
                self.photo,
                link.sentence(),
                link.to
            ),
        }
    }
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
            PathToScene { photo: names[photo].to_owned(), links }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_widest_path_avoids_the_weak_short_cut() {
        let links = BTreeMap::from([((0, 1), 200), ((1, 2), 40), ((0, 2), 9)]);
        let paths = widest_paths(&["a", "b", "c"], &[150, 3, 0], &links);
        let target = &paths[2];
        assert_eq!(target.links.iter().map(|l| l.to.as_str()).collect::<Vec<_>>(), ["a", "b", "c"]);
        assert_eq!(target.weakest().unwrap().shared, 40);
        assert!(target.advice().contains("between b and c"), "{}", target.advice());
        assert_eq!(paths[0].links.len(), 1);
        assert!(paths[0].advice().contains("150 scene points"));
    }

    #[test]
    fn an_unconnected_photo_has_no_path() {
        let paths = widest_paths(&["a", "b"], &[30, 0], &BTreeMap::new());
        assert!(paths[1].links.is_empty() && paths[1].weakest().is_none());
        assert!(paths[1].advice().starts_with("b: shares nothing"));
    }
}
