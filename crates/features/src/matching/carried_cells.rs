//! What photos show that moves with the camera: a car's bonnet, a robot's arm, a clock in the corner, the black edge of
//! pictures that are rectified.
//!
//! It is at the same pixels in all photos of a camera, and its matches agree that the camera did not move, which is wrong but
//! for photos that stand still. One pair does not tell: what is far off stays where it is, too, while a camera goes straight ahead, and two photos
//! of one pose that share little are like two that share a clock. So a part of the picture counts as such by what half of the photos
//! of a size show at the very same place, and a pair by what stays of it.

use std::collections::BTreeSet;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{Match, squared_distance};
use crate::{DESCRIPTOR_NORM, ImageFeatures, Keypoint};

/// Cells along the longer side of a photo.
const CELLS: f32 = 64.0;
/// With about so many others each photo is compared.
const MOST_OTHERS: usize = 24;
/// Fewest others that show the same in a cell.
const FEWEST_ALIKE: usize = 3;
/// Share of all others that show the same in a cell or in those about it.
const SHARE: f32 = 0.5;
/// Share of a photo's cells with keypoints beyond which the camera stands still.
const STANDS_STILL: f32 = 0.6;
/// Matches of a pair elsewhere, at the same pixels, by which it stands still: at least so many, and this share of all elsewhere.
const FEWEST_STILL: usize = 8;
const SHARE_STILL: f64 = 0.5;
/// How far a thing may be from where it is in another photo, in pixels and in sizes of its keypoint.
const SAME_PX: f32 = 1.0;
const SAME_SIZES: f32 = 0.1;
/// How much larger its keypoint may be, and how far it may be turned (radians).
const SAME_SCALE: f32 = 1.3;
const SAME_TURN: f32 = 0.35;
/// Largest distance of its descriptors, as unit vectors.
const SAME_LOOK: f32 = 0.6;

/// The parts of a photo that show what moves with its camera, as cells of a grid.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct CarriedCells(Vec<u32>);

impl CarriedCells {
    /// Changes whenever the same photos give other cells.
    pub const VERSION: u32 = 1;
    /// Fewest photos of a size that tell.
    pub const FEWEST_PHOTOS: usize = 4;

    /// Of each of some photos of one size; those of another size than the first have none.
    pub fn of_each(photos: &[ComparedPhoto]) -> Vec<Self> {
        let count = photos.len();
        let Some(grid) = photos.first().map(|photo| photo.grid).filter(|_| count >= Self::FEWEST_PHOTOS)
        else {
            return vec![Self::default(); count];
        };
        let is_of_size = |at: usize| photos[at].grid == grid;
        let mut pairs: Vec<(usize, usize)> = compared(count).into_iter().collect();
        pairs.retain(|&(a, b)| is_of_size(a) && is_of_size(b));
        let alike: Vec<Vec<usize>> =
            pairs.par_iter().map(|&(a, b)| photos[a].cells_alike(&photos[b])).collect();
        let mut votes = vec![Votes::none(grid); count];
        for (&(a, b), cells) in pairs.iter().zip(&alike) {
            votes[a].count(cells, grid);
            votes[b].count(cells, grid);
        }
        votes.iter().zip(photos).map(|(votes, photo)| votes.carried(photo.occupied)).collect()
    }

    /// Whether nothing of the photo is such.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Their share of a photo of this size.
    pub fn share(&self, width: u32, height: u32) -> f64 {
        let grid = Grid::new(width, height);
        self.0.len() as f64 / (grid.columns * grid.rows) as f64
    }

    fn hold(&self, cell: usize) -> bool {
        self.0.binary_search(&(cell as u32)).is_ok()
    }

    /// Whether the keypoint is in one of them.
    fn show(&self, keypoint: &Keypoint, grid: Grid) -> bool {
        self.hold(grid.cell_of(keypoint))
    }

    /// Whether the keypoint is in one of them or next to one.
    fn are_next_to(&self, keypoint: &Keypoint, grid: Grid) -> bool {
        grid.around(grid.cell_of(keypoint)).any(|cell| self.hold(cell))
    }
}

/// The matches of two photos without those of what their cameras carry; all where both were taken from one pose or have two sizes.
pub fn without_carried_cells(
    matches: Vec<Match>,
    [of_first, of_second]: [&CarriedCells; 2],
    first: &ImageFeatures,
    second: &ImageFeatures,
) -> Vec<Match> {
    let grid = Grid::of(first);
    if of_first.is_empty() || of_second.is_empty() || grid != Grid::of(second) {
        return matches;
    }
    let ends = |m: &Match| (&first.keypoints[m.first as usize], &second.keypoints[m.second as usize]);
    let is_still = |m: &&Match| {
        let (a, b) = ends(m);
        is_at(a, b)
    };
    // Beside what is carried there may be more of it that other photos do not show as well.
    let is_carried = |m: &&Match| {
        let (a, b) = ends(m);
        of_first.show(a, grid) && of_second.show(b, grid)
            || is_at(a, b) && of_first.are_next_to(a, grid) && of_second.are_next_to(b, grid)
    };
    let kept: Vec<Match> = matches.iter().filter(|m| !is_carried(m)).copied().collect();
    let still = kept.iter().filter(is_still).count();
    let stands_still = still >= FEWEST_STILL && still as f64 >= SHARE_STILL * kept.len() as f64;
    if stands_still { matches } else { kept }
}

/// Whether a keypoint of one photo is at the pixels of one of another.
fn is_at(a: &Keypoint, b: &Keypoint) -> bool {
    (a.x - b.x).hypot(a.y - b.y) <= SAME_PX.max(SAME_SIZES * a.size)
}

/// Whether two keypoints are the same at the same place, but for what they look like.
fn is_same(a: &Keypoint, b: &Keypoint) -> bool {
    let turned = (a.orientation - b.orientation + std::f32::consts::PI).rem_euclid(std::f32::consts::TAU)
        - std::f32::consts::PI;
    is_at(a, b) && a.size <= SAME_SCALE * b.size && b.size <= SAME_SCALE * a.size && turned.abs() <= SAME_TURN
}

/// Square cells that cover the photos of a size.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Grid {
    side: f32,
    columns: usize,
    rows: usize,
}

impl Grid {
    fn of(image: &ImageFeatures) -> Self {
        Self::new(image.width, image.height)
    }

    fn new(width: u32, height: u32) -> Self {
        let (width, height) = (width as f32, height as f32);
        let side = (width.max(height) / CELLS).max(1.0);
        let along = |length: f32| (length / side).ceil().max(1.0) as usize;
        Self { side, columns: along(width), rows: along(height) }
    }

    fn column_of(self, x: f32) -> usize {
        ((x / self.side).max(0.0) as usize).min(self.columns - 1)
    }

    fn row_of(self, y: f32) -> usize {
        ((y / self.side).max(0.0) as usize).min(self.rows - 1)
    }

    fn cell_of(self, keypoint: &Keypoint) -> usize {
        self.row_of(keypoint.y) * self.columns + self.column_of(keypoint.x)
    }

    /// A cell and those about it.
    fn around(self, cell: usize) -> impl Iterator<Item = usize> {
        let (row, column) = (cell / self.columns, cell % self.columns);
        let rows = row.saturating_sub(1)..=(row + 1).min(self.rows - 1);
        rows.flat_map(move |row| {
            let columns = column.saturating_sub(1)..=(column + 1).min(self.columns - 1);
            columns.map(move |column| row * self.columns + column)
        })
    }
}

/// What is compared of a photo.
#[derive(Debug, Clone)]
pub struct ComparedPhoto {
    grid: Grid,
    /// Its strongest features.
    strongest: ImageFeatures,
    /// These by cell, bright and dark ones.
    bins: [Vec<Vec<u32>>; 2],
    /// In how many cells it has keypoints.
    occupied: usize,
}

impl ComparedPhoto {
    /// Bright keypoints that are compared, the strongest, and as many dark ones.
    pub const STRONGEST: usize = 1024;

    /// Of a photo with these features.
    pub fn of(features: &ImageFeatures) -> Self {
        let (grid, strongest) = (Grid::of(features), features.strongest(Self::STRONGEST));
        let own = &features.keypoints[..features.own_len()];
        let occupied = own.iter().map(|keypoint| grid.cell_of(keypoint)).collect::<BTreeSet<_>>().len();
        let bins = strongest.parts().map(|part| {
            let mut bins = vec![Vec::new(); grid.columns * grid.rows];
            for at in part {
                bins[grid.cell_of(&strongest.keypoints[at])].push(at as u32);
            }
            bins
        });
        Self { grid, strongest, bins, occupied }
    }

    /// The cells in which another photo shows the same at the same place.
    fn cells_alike(&self, other: &Self) -> Vec<usize> {
        let (grid, first, second) = (self.grid, &self.strongest, &other.strongest);
        let limit = SAME_LOOK * f32::from(DESCRIPTOR_NORM);
        let limit = (limit * limit) as u32;
        let is_alike = |a: u32, b: u32| {
            let (a, b) = (a as usize, b as usize);
            is_same(&first.keypoints[a], &second.keypoints[b])
                && squared_distance(first.descriptor(a), second.descriptor(b)) <= limit
        };
        let are_alike = |cell: usize| {
            self.bins.iter().zip(&other.bins).any(|(bins, others)| {
                let near = || grid.around(cell).flat_map(|cell| &others[cell]);
                bins[cell].iter().any(|&a| near().any(|&b| is_alike(a, b)))
            })
        };
        (0..grid.columns * grid.rows).filter(|&cell| are_alike(cell)).collect()
    }
}

/// Which photos are compared: each with all others, or with some at steps through the list.
fn compared(count: usize) -> BTreeSet<(usize, usize)> {
    let farthest = count / 2;
    let steps = farthest.min(MOST_OTHERS / 2);
    let step = |at: usize| if steps > 1 { 1 + at * (farthest - 1) / (steps - 1) } else { 1 };
    let pairs = (0..steps).flat_map(|at| (0..count).map(move |a| (a, (a + step(at)) % count)));
    pairs.map(|(a, b)| (a.min(b), a.max(b))).collect()
}

/// How many other photos show the same as one, by cell.
#[derive(Debug, Clone)]
struct Votes {
    others: u32,
    /// In the cell itself.
    here: Vec<u16>,
    /// In it or in those about it.
    around: Vec<u16>,
}

impl Votes {
    fn none(grid: Grid) -> Self {
        let none = vec![0; grid.columns * grid.rows];
        Self { others: 0, here: none.clone(), around: none }
    }

    fn count(&mut self, cells: &[usize], grid: Grid) {
        self.others += 1;
        let mut around = BTreeSet::new();
        for &cell in cells {
            self.here[cell] += 1;
            around.extend(grid.around(cell));
        }
        for cell in around {
            self.around[cell] += 1;
        }
    }

    /// Of a photo that has keypoints in so many cells.
    fn carried(&self, occupied: usize) -> CarriedCells {
        let enough = SHARE * self.others as f32;
        let is_carried = |cell: &usize| {
            usize::from(self.here[*cell]) >= FEWEST_ALIKE && f32::from(self.around[*cell]) >= enough
        };
        let cells: Vec<u32> = (0..self.here.len()).filter(is_carried).map(|cell| cell as u32).collect();
        let stands_still = cells.len() as f32 > STANDS_STILL * occupied as f32;
        if stands_still { CarriedCells::default() } else { CarriedCells(cells) }
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::DESCRIPTOR_LEN;

    /// A thing that photos show: where, and what it looks like.
    type Thing = ((f32, f32), [u8; DESCRIPTOR_LEN]);

    fn things(rng: &mut ChaCha8Rng, count: usize, [left, top, right, bottom]: [f32; 4]) -> Vec<Thing> {
        let mut thing = || {
            let place = (rng.random_range(left..right), rng.random_range(top..bottom));
            (place, std::array::from_fn(|_| rng.random_range(0..90)))
        };
        (0..count).map(|_| thing()).collect()
    }

    /// A photo of things of the place, so far aside, and of those that the camera carries. Keypoints are off by up to a third of a pixel.
    fn photo(rng: &mut ChaCha8Rng, place: &[Thing], aside: f32, carried: &[Thing]) -> ImageFeatures {
        let shown = place.iter().map(|&((x, y), look)| ((x - aside, y), look));
        let shown = shown.filter(|((x, _), _)| (0.0..800.0).contains(x)).chain(carried.iter().copied());
        let mut features = ImageFeatures { width: 800, height: 600, ..ImageFeatures::default() };
        for ((x, y), look) in shown {
            let mut off = || rng.random_range(-0.3..0.3);
            let (x, y) = (x + off(), y + off());
            features.keypoints.push(Keypoint { x, y, size: 5.0, orientation: 0.5, noise_px: 0.3 });
            features.descriptors.extend_from_slice(&look);
            features.colors.push([0; 3]);
        }
        features.light = features.keypoints.len() as u32;
        features
    }

    /// Matches of what looks alike.
    fn matches(first: &ImageFeatures, second: &ImageFeatures) -> Vec<Match> {
        let of = |a: usize| (0..second.len()).find(|&b| first.descriptor(a) == second.descriptor(b));
        let all = (0..first.len()).filter_map(|a| Some((a, of(a)?)));
        all.map(|(a, b)| Match { first: a as u32, second: b as u32 }).collect()
    }

    fn cells_of(photos: &[ImageFeatures]) -> Vec<CarriedCells> {
        CarriedCells::of_each(&photos.iter().map(ComparedPhoto::of).collect::<Vec<_>>())
    }

    const BONNET: [f32; 4] = [100.0, 500.0, 700.0, 600.0];
    const CLOCK: [f32; 4] = [600.0, 5.0, 790.0, 25.0];

    /// What stays of two photos' matches of the place and of what is carried, where the camera moves by so much a photo.
    fn stay(step: f32, count: usize) -> (usize, usize, [usize; 2]) {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let place = things(&mut rng, 1500, [0.0, 30.0, 2000.0, 490.0]);
        let carried = [things(&mut rng, 150, BONNET), things(&mut rng, 40, CLOCK)].concat();
        let photos: Vec<_> =
            (0..count).map(|at| photo(&mut rng, &place, step * at as f32, &carried)).collect();
        let cells = cells_of(&photos);
        let (first, second) = (&photos[0], &photos[1]);
        let all = matches(first, second);
        let is_of_place = |m: &&Match| (30.0..495.0).contains(&first.keypoints[m.first as usize].y);
        let of_place = all.iter().filter(is_of_place).count();
        let kept = without_carried_cells(all.clone(), [&cells[0], &cells[1]], first, second);
        let kept_of_place = kept.iter().filter(is_of_place).count();
        (of_place, all.len() - of_place, [kept_of_place, kept.len() - kept_of_place])
    }

    #[test]
    fn what_the_camera_carries_is_left_out_and_the_place_stays() {
        for (step, count) in [(40.0, 4), (40.0, 12), (15.0, 60)] {
            let (of_place, carried, [kept, kept_carried]) = stay(step, count);
            assert!(kept >= of_place - 5, "{kept} of {of_place}, {count} photos");
            assert!(carried >= 180 && kept_carried <= 8, "{kept_carried} of {carried}, {count} photos");
        }
    }

    #[test]
    fn photos_that_stand_still_keep_all() {
        for (step, count) in [(0.0, 12), (40.0, 3)] {
            let (of_place, carried, kept) = stay(step, count);
            assert_eq!(kept, [of_place, carried], "{count} photos");
        }
    }

    #[test]
    fn two_of_one_pose_among_others_keep_all() {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let place = things(&mut rng, 1500, [0.0, 30.0, 2000.0, 490.0]);
        let carried = things(&mut rng, 150, BONNET);
        let aside = [0.0, 0.0, 40.0, 80.0, 120.0, 200.0, 300.0];
        let photos: Vec<_> = aside.iter().map(|&aside| photo(&mut rng, &place, aside, &carried)).collect();
        let cells = cells_of(&photos);
        assert!(cells.iter().all(|cells| !cells.is_empty()));
        let all = matches(&photos[0], &photos[1]);
        assert_eq!(without_carried_cells(all.clone(), [&cells[0], &cells[1]], &photos[0], &photos[1]), all);
    }

    #[test]
    fn some_photos_are_compared_with_some_others_however_many_there_are() {
        assert_eq!(compared(4).len(), 6);
        assert_eq!(compared(25).len(), 300);
        assert_eq!(compared(1000).len(), 11_500);
        assert!(compared(0).is_empty() && compared(1).is_empty());
        assert!(CarriedCells::of_each(&[]).is_empty());
    }

    #[test]
    fn photos_of_another_size_have_none_and_change_nothing() {
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let carried = things(&mut rng, 150, BONNET);
        let mut photos: Vec<_> = (0..6)
            .map(|_| {
                let place = things(&mut rng, 300, [0.0, 30.0, 800.0, 490.0]);
                photo(&mut rng, &place, 0.0, &carried)
            })
            .collect();
        let alone = cells_of(&photos);
        assert!(alone.iter().all(|cells| !cells.is_empty()));
        photos.push(ImageFeatures { width: 8000, height: 300, ..photos[0].clone() });
        let with = cells_of(&photos);
        assert_eq!((&with[..6], &with[6]), (&alone[..], &CarriedCells::default()));
    }
}
