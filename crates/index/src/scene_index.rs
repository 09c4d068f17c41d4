use nalgebra::{Matrix3, Vector3};
use rand::SeedableRng;
use rand::seq::index;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use setloc_features::{DESCRIPTOR_LEN, ImageFeatures, squared_distance};
use setloc_sfm::{ImageId, Observation, PointId, Reconstruction, ReconstructionPoint};

use crate::search::{InvertedLists, PrincipalTree, Search, nearest_exact};
use crate::{Backend, IndexParams, NearestPoints};

/// Queries of the recall's measurement that are worth handing to another thread; exact ones are one by one.
const QUERIES_PER_TASK: usize = 8;
/// Points, or rows, of which the descriptors are gathered at once.
const GATHERED_AT_ONCE: usize = 4096;

/// One observation of a scene point.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// The observed point.
    pub point: PointId,
    /// The observing image.
    pub image: ImageId,
    /// Diameter of the described region at the point, in scene units; 0 when unknown.
    pub extent: f32,
}

/// What an index grows by; see [`SceneIndex::extended`].
#[derive(Debug, Clone, Copy, Default)]
pub struct IndexGrowth<'a> {
    /// Camera centres of the further images, in the scene's frame; their ids follow those of the others.
    pub centers: &'a [Option<Vector3<f64>>],
    /// Positions of the further points and their covariances; their ids follow those of the others.
    pub points: &'a [(Vector3<f64>, Matrix3<f32>)],
    /// Further observations with their descriptors.
    pub rows: &'a [(Row, &'a [u8])],
}

/// Searchable descriptors of a scene; self-contained (needs no features once built).
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SceneIndex {
    positions: Vec<Vector3<f64>>,
    /// What the scene's own rays leave undetermined of each position, in squared scene units.
    covariances: Vec<Matrix3<f32>>,
    /// Camera centres by image id; `None` for images outside the model.
    centers: Vec<Option<Vector3<f64>>>,
    rows: Vec<Row>,
    /// Row-major, one descriptor a row.
    #[serde(with = "crate::bytes")]
    descriptors: Vec<u8>,
    /// Rows of point `p`: `point_rows[point_starts[p] .. point_starts[p + 1]]`.
    point_starts: Vec<u32>,
    point_rows: Vec<u32>,
    search: Search,
    recall: Option<f64>,
}

impl SceneIndex {
    /// Indexes the descriptors of all observations of all points; `features[i]` belongs to image `i`.
    ///
    /// Observations whose image or keypoint is not in `features` are left out.
    pub fn build(params: &IndexParams, reconstruction: &Reconstruction, features: &[&ImageFeatures]) -> Self {
        let points: Vec<(PointId, &ReconstructionPoint)> =
            (0..).map(PointId).zip(&reconstruction.points).collect();
        let parts: Vec<Gathered> = points
            .par_chunks(GATHERED_AT_ONCE)
            .with_max_len(1)
            .map(|points| gathered(reconstruction, features, points))
            .collect();
        let rows: Vec<(Row, u32)> = parts.iter().flat_map(|part| &part.rows).copied().collect();
        let descriptor = |row: usize| {
            let (Row { image, .. }, feature) = rows[row];
            features[image.index()].descriptor(feature as usize)
        };
        let mut index = Self {
            positions: reconstruction.points.iter().map(|point| point.position).collect(),
            covariances: parts.iter().flat_map(|part| &part.covariances).copied().collect(),
            centers: reconstruction
                .images
                .iter()
                .map(|i| i.world_from_camera.map(|pose| pose.translation))
                .collect(),
            descriptors: descriptors_of(rows.len(), descriptor),
            rows: rows.into_iter().map(|(row, _)| row).collect(),
            ..Self::default()
        };
        index.prepare_search(params);
        index.group_rows_by_point();
        index
    }

    /// The index of a scene that has grown: further images, points and observations behind those that it has.
    ///
    /// Points that it has stay where they are. Observations of points that neither has are left out.
    #[must_use]
    pub fn extended(&self, params: &IndexParams, growth: &IndexGrowth<'_>) -> Self {
        let positions: Vec<Vector3<f64>> = self
            .positions
            .iter()
            .copied()
            .chain(growth.points.iter().map(|(position, _)| *position))
            .collect();
        let known = |(row, descriptor): &&(Row, &[u8])| {
            row.point.index() < positions.len() && descriptor.len() == DESCRIPTOR_LEN
        };
        let new: Vec<&(Row, &[u8])> = growth.rows.iter().filter(known).collect();
        let new_descriptors: Vec<&[u8]> = new.iter().map(|(_, descriptor)| *descriptor).collect();
        let mut index = Self {
            covariances: [&self.covariances[..], &growth.points.iter().map(|(_, c)| *c).collect::<Vec<_>>()]
                .concat(),
            centers: [&self.centers[..], growth.centers].concat(),
            rows: self.rows.iter().copied().chain(new.iter().map(|(row, _)| *row)).collect(),
            descriptors: [&self.descriptors[..], &new_descriptors.concat()].concat(),
            positions,
            ..Self::default()
        };
        index.prepare_search(params);
        index.group_rows_by_point();
        index
    }

    fn prepare_search(&mut self, params: &IndexParams) {
        let backend = match params.backend {
            Backend::Auto if self.rows.len() < params.exact_below => Backend::Exact,
            Backend::Auto => Backend::Inverted,
            named => named,
        };
        match backend {
            Backend::Inverted => {
                let (lists, order) = InvertedLists::train(&self.descriptors, params.seed);
                self.rows = order.iter().map(|&row| self.rows[row as usize]).collect();
                self.descriptors = descriptors_of(order.len(), |row| self.descriptor(order[row]));
                self.search = Search::Inverted(lists);
            }
            Backend::Kiddo => self.search = Search::Kiddo(PrincipalTree::train(&self.descriptors)),
            Backend::Auto | Backend::Exact => self.search = Search::Exact,
        }
        self.tune(params);
    }

    /// Raises the effort of an approximate search until it finds what `params.target_recall` asks for.
    ///
    /// The queries are descriptors of the scene, each searched for among all others.
    fn tune(&mut self, params: &IndexParams) {
        if matches!(self.search, Search::Exact) || self.rows.len() < 2 {
            return;
        }
        let mut rng = ChaCha8Rng::seed_from_u64(params.seed ^ 0x7ec0);
        let amount = params.recall_queries.clamp(1, self.rows.len());
        let queries: Vec<u32> =
            index::sample(&mut rng, self.rows.len(), amount).iter().map(|row| row as u32).collect();
        let truth: Vec<NearestPoints> = queries
            .par_iter()
            .with_max_len(1)
            .map(|&row| self.nearest_among(row, 0..self.rows.len() as u32))
            .collect();
        loop {
            let found: Vec<NearestPoints> = queries
                .par_iter()
                .with_max_len(QUERIES_PER_TASK)
                .map(|&row| match &self.search {
                    Search::Exact => self.nearest_among(row, 0..self.rows.len() as u32),
                    Search::Inverted(lists) => {
                        let rows = lists.candidates(self.descriptor(row));
                        self.nearest_among(row, rows.map(|row| row as u32))
                    }
                    Search::Kiddo(tree) => {
                        self.nearest_among(row, tree.candidates(self.descriptor(row)).into_iter())
                    }
                })
                .collect();
            let recall = recall(&truth, &found);
            self.recall = Some(recall);
            let rows = self.rows.len();
            let exhausted = match &mut self.search {
                Search::Exact => true,
                _ if recall >= params.target_recall => true,
                Search::Inverted(lists) => {
                    let next = (lists.probes + lists.probes.div_ceil(2)).min(lists.lists());
                    std::mem::replace(&mut lists.probes, next) == next
                }
                Search::Kiddo(tree) => {
                    let next = (tree.candidates * 2).min(params.max_candidates.max(1)).min(rows);
                    std::mem::replace(&mut tree.candidates, next) >= next
                }
            };
            if exhausted {
                return;
            }
        }
    }

    /// The two nearest points of a row among the given rows, itself left out.
    fn nearest_among(&self, query: u32, rows: impl Iterator<Item = u32>) -> NearestPoints {
        let mut nearest = NearestPoints::default();
        for row in rows.filter(|&row| row != query) {
            nearest.offer(
                self.rows[row as usize].point,
                squared_distance(self.descriptor(query), self.descriptor(row)),
            );
        }
        nearest
    }

    fn group_rows_by_point(&mut self) {
        let mut starts = vec![0_u32; self.positions.len() + 1];
        for row in &self.rows {
            starts[row.point.index() + 1] += 1;
        }
        for point in 1..starts.len() {
            starts[point] += starts[point - 1];
        }
        let mut order: Vec<u32> = (0..self.rows.len() as u32).collect();
        order.par_sort_by_key(|&row| (self.rows[row as usize].point, self.rows[row as usize].image));
        self.point_starts = starts;
        self.point_rows = order;
    }

    /// Number of points, ids are below it.
    pub fn point_count(&self) -> usize {
        self.positions.len()
    }

    /// Number of descriptors.
    pub fn descriptor_count(&self) -> usize {
        self.rows.len()
    }

    /// Share of the exact two nearest points that the search finds, measured at build; `None` when it is exact.
    pub fn recall(&self) -> Option<f64> {
        self.recall
    }

    /// The search in use, by its name in [`IndexParams::backend`].
    pub fn backend(&self) -> Backend {
        match self.search {
            Search::Exact => Backend::Exact,
            Search::Inverted(_) => Backend::Inverted,
            Search::Kiddo(_) => Backend::Kiddo,
        }
    }

    /// Position of a point in the scene's frame.
    pub fn position(&self, point: PointId) -> Vector3<f64> {
        self.positions[point.index()]
    }

    /// Covariance of a position as the scene's own rays determine it, poses taken as exact; in squared scene units.
    ///
    /// Directions that no ray determines (the depth along parallel rays) get a hundred times the lateral deviation.
    pub fn position_covariance(&self, point: PointId) -> Matrix3<f64> {
        self.covariances[point.index()].cast()
    }

    /// Angle that a position's uncertainty spans, per tangent axis, for a camera beside the first that observes it.
    ///
    /// In radians; 0 for points without observations.
    pub fn angular_sigma(&self, point: PointId) -> f64 {
        let center = self.rows_of(point).first().and_then(|&row| self.center(self.row(row).image));
        let Some(offset) = center.map(|center| self.position(point) - center) else { return 0.0 };
        let (covariance, distance2) = (self.position_covariance(point), offset.norm_squared());
        let lateral = (covariance.trace() - offset.dot(&(covariance * offset)) / distance2) / 2.0;
        if distance2 > 0.0 { (lateral.max(0.0) / distance2).sqrt() } else { 0.0 }
    }

    /// Camera centre of a scene image in the scene's frame, when it is part of the model.
    pub fn center(&self, image: ImageId) -> Option<Vector3<f64>> {
        self.centers.get(image.index()).copied().flatten()
    }

    /// Rows of all observations of a point, ordered by image.
    pub fn rows_of(&self, point: PointId) -> &[u32] {
        let point = point.index();
        &self.point_rows[self.point_starts[point] as usize..self.point_starts[point + 1] as usize]
    }

    /// One observation.
    pub fn row(&self, row: u32) -> &Row {
        &self.rows[row as usize]
    }

    /// The descriptor of one observation.
    pub fn descriptor(&self, row: u32) -> &[u8] {
        let start = row as usize * DESCRIPTOR_LEN;
        &self.descriptors[start..start + DESCRIPTOR_LEN]
    }

    /// The two nearest scene points of each row-major query descriptor.
    pub fn nearest_points(&self, queries: &[u8]) -> Vec<NearestPoints> {
        let owner = |row: usize| self.rows[row].point;
        match &self.search {
            Search::Exact => nearest_exact(queries, &self.descriptors, owner),
            Search::Inverted(lists) => lists.nearest(queries, &self.descriptors, owner),
            Search::Kiddo(tree) => queries
                .par_chunks_exact(DESCRIPTOR_LEN)
                .map(|query| {
                    let mut nearest = NearestPoints::default();
                    for row in tree.candidates(query) {
                        nearest.offer(owner(row as usize), squared_distance(query, self.descriptor(row)));
                    }
                    nearest
                })
                .collect(),
        }
    }
}

/// What an index holds of some consecutive points.
struct Gathered {
    covariances: Vec<Matrix3<f32>>,
    /// Each with the keypoint in its image.
    rows: Vec<(Row, u32)>,
}

fn gathered(
    reconstruction: &Reconstruction,
    features: &[&ImageFeatures],
    points: &[(PointId, &ReconstructionPoint)],
) -> Gathered {
    let mut gathered = Gathered { covariances: Vec::with_capacity(points.len()), rows: Vec::new() };
    for &(id, point) in points {
        let mut information = Matrix3::zeros();
        for &Observation { image, feature } in &point.track {
            let found = features.get(image.index()).filter(|features| (feature as usize) < features.len());
            let Some(image_features) = found else { continue };
            let Some(pose) = reconstruction.images.get(image.index()).and_then(|i| i.world_from_camera)
            else {
                continue;
            };
            let keypoint = &image_features.keypoints[feature as usize];
            let angle = reconstruction.camera_of(image).pixel_angle(&keypoint.pixel()).unwrap_or(0.0);
            let offset = point.position - pose.translation;
            let distance = offset.norm();
            let sigma = angle * f64::from(keypoint.noise_px) * distance;
            if sigma > 0.0 && sigma.is_finite() {
                let direction = offset / distance;
                information += (Matrix3::identity() - direction * direction.transpose()) / (sigma * sigma);
            }
            let extent = (f64::from(keypoint.size) * angle * distance) as f32;
            gathered.rows.push((Row { point: id, image, extent }, feature));
        }
        gathered.covariances.push(point.covariance.unwrap_or_else(|| position_covariance(&information)));
    }
    gathered
}

/// Row-major descriptors.
fn descriptors_of<'d>(rows: usize, descriptor: impl Fn(usize) -> &'d [u8] + Sync) -> Vec<u8> {
    let mut all = vec![0; rows * DESCRIPTOR_LEN];
    all.par_chunks_mut(GATHERED_AT_ONCE * DESCRIPTOR_LEN).enumerate().for_each(|(part, to)| {
        for (row, to) in to.chunks_exact_mut(DESCRIPTOR_LEN).enumerate() {
            to.copy_from_slice(descriptor(part * GATHERED_AT_ONCE + row));
        }
    });
    all
}

/// Inverse of a position's information, regularized where rays are (nearly) parallel.
///
/// The depth along parallel rays is not determined; a hundred times the lateral uncertainty stands for it, so that
/// matching still finds the point and estimation hardly trusts it.
fn position_covariance(information: &Matrix3<f64>) -> Matrix3<f32> {
    let largest = information.symmetric_eigenvalues().max();
    if !(largest > 0.0) {
        return Matrix3::zeros();
    }
    let regularized = information + Matrix3::identity() * (largest * 1e-4);
    regularized.try_inverse().unwrap_or_else(Matrix3::zeros).cast()
}

/// Share of the true neighbours' distances that were found.
fn recall(truth: &[NearestPoints], found: &[NearestPoints]) -> f64 {
    let (mut wanted, mut hit) = (0_usize, 0_usize);
    for (truth, found) in truth.iter().zip(found) {
        for (truth, found) in [(truth.first, found.first), (truth.second, found.second)] {
            if let Some(truth) = truth {
                wanted += 1;
                hit += usize::from(found.is_some_and(|found| found.distance2 <= truth.distance2));
            }
        }
    }
    if wanted == 0 { 1.0 } else { hit as f64 / wanted as f64 }
}
