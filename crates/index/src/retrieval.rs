use std::sync::atomic::{AtomicU32, Ordering};

use rayon::prelude::*;
use setloc_features::{DESCRIPTOR_LEN, offer_nearer};

use crate::search::{InvertedLists, descriptor};

/// Other images that a descriptor may vote for. With 8 and 4 of them the 48 first of 1200 rendered panoramas hold 0.64 and
/// 0.58 in place of 0.68 of what an exact comparison finds most alike, with 32 the same.
const VOTED_FOR: usize = 16;

/// A whole vote. Votes are whole numbers, so that they add up to the same in any order.
const VOTE: f64 = 256.0;

/// For each image the others that most of its descriptors speak for, most first: candidates for a closer look.
///
/// Of so many others at most `most` each; `descriptors[i]` are those of image `i`, row-major, `n ×`
/// [`DESCRIPTOR_LEN`] bytes. Descriptors are compared within inverted lists, so that work grows with the images' number to the power
/// of 1.5. Each votes for the 16 images that it has the nearest descriptors in, by 1 − d / d₁₆ of their distances: what is in many images
/// alike speaks for none. (H. Jégou, M. Douze, C. Schmid, "Exploiting descriptor distances for precise image search", INRIA
/// RR-7656, 2011.)
pub fn images_alike(descriptors: &[&[u8]], most: usize, seed: u64) -> Vec<Vec<u32>> {
    let rows = descriptors.concat();
    let of_image = |(image, of_image): (u32, &&[u8])| {
        std::iter::repeat_n(image, of_image.len() / DESCRIPTOR_LEN).collect::<Vec<_>>()
    };
    let owners: Vec<u32> = (0..).zip(descriptors).flat_map(of_image).collect();
    let (lists, order) = InvertedLists::train(&rows, seed);
    let votes = Votes::new(descriptors.len());
    (0..lists.lists()).into_par_iter().with_max_len(1).for_each(|list| {
        let of_list = &order[lists.rows_of(list)];
        let descriptors =
            of_list.iter().map(|&row| descriptor(&rows, row as usize)).collect::<Vec<_>>().concat();
        let images: Vec<u32> = of_list.iter().map(|&row| owners[row as usize]).collect();
        let mut nearest: Vec<NearestImages> =
            images.iter().map(|&image| NearestImages { image, found: Vec::new() }).collect();
        offer_nearer(
            &descriptors,
            &descriptors,
            &mut nearest,
            NearestImages::bound,
            |nearest, at, distance2| {
                nearest.offer(images[at], distance2);
            },
        );
        for nearest in &nearest {
            votes.add(nearest);
        }
    });
    (0..descriptors.len() as u32).into_par_iter().map(|image| votes.most_of(image, most)).collect()
}

/// The other images with the descriptors nearest to one of an image.
struct NearestImages {
    image: u32,
    /// Squared distance of an image's nearest descriptor and the image, ascending.
    found: Vec<(u32, u32)>,
}

impl NearestImages {
    /// Descriptors as far off as this do not matter any more.
    fn bound(&self) -> u32 {
        self.found.get(VOTED_FOR - 1).map_or(u32::MAX, |&(distance2, _)| distance2)
    }

    fn offer(&mut self, image: u32, distance2: u32) {
        if image == self.image {
            return;
        }
        if let Some(known) = self.found.iter().position(|&(_, found)| found == image) {
            if self.found[known].0 <= distance2 {
                return;
            }
            self.found.remove(known);
        }
        let at = self.found.partition_point(|&(found, _)| found <= distance2);
        self.found.insert(at, (distance2, image));
        self.found.truncate(VOTED_FOR);
    }
}

/// Votes of each two images for each other.
struct Votes {
    count: usize,
    /// Of the pairs (1, 0), (2, 0), (2, 1), (3, 0) …
    votes: Vec<AtomicU32>,
}

impl Votes {
    fn new(count: usize) -> Self {
        let pairs = count * count.saturating_sub(1) / 2;
        Self { count, votes: (0..pairs).map(|_| AtomicU32::new(0)).collect() }
    }

    fn of(&self, a: u32, b: u32) -> &AtomicU32 {
        let (low, high) = (a.min(b) as usize, a.max(b) as usize);
        &self.votes[high * (high - 1) / 2 + low]
    }

    fn add(&self, nearest: &NearestImages) {
        let Some(&(farthest2, _)) = nearest.found.last() else { return };
        let farthest = f64::from(farthest2.max(1)).sqrt();
        for &(distance2, image) in &nearest.found {
            let vote = VOTE * (1.0 - f64::from(distance2).sqrt() / farthest);
            self.of(nearest.image, image).fetch_add(vote as u32, Ordering::Relaxed);
        }
    }

    fn most_of(&self, image: u32, most: usize) -> Vec<u32> {
        let others = (0..self.count as u32).filter(|&other| other != image);
        let mut others: Vec<(u32, u32)> = others
            .map(|other| (self.of(image, other).load(Ordering::Relaxed), other))
            .filter(|&(votes, _)| votes > 0)
            .collect();
        others.sort_unstable_by_key(|&(votes, other)| (std::cmp::Reverse(votes), other));
        others.truncate(most);
        others.into_iter().map(|(_, other)| other).collect()
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// Views along a street, one after the other: each shares a third of its descriptors with the next and a sixth with the next but
    /// one, as far as noise lets it, and a third with all.
    fn street(count: usize) -> Vec<Vec<u8>> {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let mut things = |count: usize| -> Vec<Vec<u8>> {
            (0..count).map(|_| (0..DESCRIPTOR_LEN).map(|_| rng.random_range(0..90)).collect()).collect()
        };
        let (windows, houses) = (things(20), things(10 * (count + 3)));
        let mut noise = ChaCha8Rng::seed_from_u64(8);
        let mut seen =
            |thing: &Vec<u8>| thing.iter().map(|value| value + noise.random_range(0..8)).collect::<Vec<u8>>();
        let view =
            |at: usize| houses[10 * at..10 * at + 40].iter().chain(&windows).flat_map(&mut seen).collect();
        (0..count).map(view).collect()
    }

    #[test]
    fn neighbours_look_most_alike_though_all_show_the_same_windows() {
        let street = street(90);
        let views: Vec<&[u8]> = street.iter().map(Vec::as_slice).collect();
        let alike = images_alike(&views, 4, 1);
        for (at, others) in (0_u32..).zip(&alike).skip(2).take(86) {
            let mut first = [others[0], others[1]];
            first.sort_unstable();
            assert_eq!(first, [at - 1, at + 1], "{at}: {others:?}");
            assert!(others.contains(&(at - 2)) && others.contains(&(at + 2)), "{at}: {others:?}");
        }
    }

    #[test]
    fn images_without_descriptors_are_like_no_other() {
        assert_eq!(images_alike(&[], 4, 1), Vec::<Vec<u32>>::new());
        assert!(images_alike(&[&[], &[]], 4, 1).iter().all(Vec::is_empty));
        let one = [3; DESCRIPTOR_LEN];
        assert_eq!(images_alike(&[&one, &[], &one], 4, 1).len(), 3);
    }

    #[test]
    fn an_image_counts_by_its_nearest_descriptor() {
        let mut nearest = NearestImages { image: 0, found: Vec::new() };
        for (image, distance2) in [(3, 50), (0, 1), (2, 40), (3, 60), (3, 30), (2, 40)] {
            nearest.offer(image, distance2);
        }
        assert_eq!(nearest.found, [(30, 3), (40, 2)]);
        assert_eq!(nearest.bound(), u32::MAX);
        (4..30).for_each(|image| nearest.offer(image, 100 + image));
        assert_eq!((nearest.found.len(), nearest.bound()), (VOTED_FOR, 117));
    }
}
