use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use setloc_features::ImageFeatures;
use setloc_sfm::PointId;

use crate::search::nearest_exact;
use crate::{NearestPoints, SceneIndex};

/// A feature of a photo and the scene point it shows.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Correspondence {
    /// Keypoint index in the photo.
    pub feature: u32,
    /// The scene point.
    pub point: PointId,
    /// Descriptor distance to the point.
    pub distance: f32,
    /// That distance over the distance to the second-nearest point, in 0 ..= 1.
    pub ratio: f32,
}

/// A local 3D point and the scene point it is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PointCorrespondence {
    /// Index of the local point.
    pub local: u32,
    /// The scene point.
    pub scene: PointId,
    /// Descriptor distance between the two points.
    pub distance: f32,
    /// Distance ratio of the two nearest scene points, in 0 ..= 1.
    pub ratio: f32,
    /// Distance ratio of the two local points nearest to the scene point, in 0 ..= 1.
    pub reverse_ratio: f32,
}

/// Descriptors of local 3D points: row `i` shows point `owners[i]`.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct LocalDescriptors {
    /// Row-major descriptors.
    pub descriptors: Vec<u8>,
    /// The local point of each row.
    pub owners: Vec<u32>,
}

impl LocalDescriptors {
    /// Adds one descriptor of a local point.
    pub fn push(&mut self, owner: u32, descriptor: &[u8]) {
        self.owners.push(owner);
        self.descriptors.extend_from_slice(descriptor);
    }
}

impl SceneIndex {
    /// Features that show a scene point: ratio test, each scene point used once, by its nearest feature.
    ///
    /// `ratio` bounds the *distance* (not squared distance) ratio. Sorted by feature.
    pub fn match_2d_3d(&self, features: &ImageFeatures, ratio: f64) -> Vec<Correspondence> {
        self.correspondences(&self.nearest_points(&features.descriptors), ratio)
    }

    /// [`Self::match_2d_3d`] on nearest points that are already known, one entry a feature.
    pub fn correspondences(&self, nearest: &[NearestPoints], ratio: f64) -> Vec<Correspondence> {
        let mut best: BTreeMap<PointId, Correspondence> = BTreeMap::new();
        for (feature, nearest) in nearest.iter().enumerate() {
            let Some(first) = nearest.first.filter(|_| nearest.ratio() < ratio) else { continue };
            let found = Correspondence {
                feature: feature as u32,
                point: first.point,
                distance: (first.distance2 as f32).sqrt(),
                ratio: nearest.ratio() as f32,
            };
            let kept = best.entry(first.point).or_insert(found);
            if found.distance < kept.distance {
                *kept = found;
            }
        }
        let mut correspondences: Vec<_> = best.into_values().collect();
        correspondences.sort_by_key(|c| c.feature);
        correspondences
    }

    /// Local points that are scene points: the paper's 3D-to-3D matching.
    ///
    /// The two nearest scene points of a local point pass the ratio test, then the two local points nearest to that
    /// scene point pass it too and lead back. Sorted by local point; each scene point is used once.
    pub fn match_3d_3d(
        &self,
        local: &LocalDescriptors,
        ratio: f64,
        reverse_ratio: f64,
    ) -> Vec<PointCorrespondence> {
        self.point_correspondences(local, &self.nearest_points(&local.descriptors), ratio, reverse_ratio)
    }

    /// [`Self::match_3d_3d`] on nearest points that are already known, one entry a row of `local`.
    pub fn point_correspondences(
        &self,
        local: &LocalDescriptors,
        nearest: &[NearestPoints],
        ratio: f64,
        reverse_ratio: f64,
    ) -> Vec<PointCorrespondence> {
        let mut by_local: BTreeMap<u32, NearestPoints> = BTreeMap::new();
        for (&owner, nearest) in local.owners.iter().zip(nearest) {
            by_local.entry(owner).or_default().merge(nearest);
        }
        let forward: Vec<(u32, PointId, NearestPoints)> = by_local
            .into_iter()
            .filter(|(_, nearest)| nearest.ratio() < ratio)
            .filter_map(|(owner, nearest)| Some((owner, nearest.first?.point, nearest)))
            .collect();
        let mut scene_points: Vec<PointId> = forward.iter().map(|&(_, point, _)| point).collect();
        scene_points.sort_unstable();
        scene_points.dedup();
        let reverse = self.nearest_local(&scene_points, local);
        forward
            .into_iter()
            .filter_map(|(owner, scene, nearest)| {
                let back = &reverse[scene_points.binary_search(&scene).ok()?];
                let leads_back = back.first.is_some_and(|first| first.point.0 == owner);
                (leads_back && back.ratio() < reverse_ratio).then(|| PointCorrespondence {
                    local: owner,
                    scene,
                    distance: nearest.first.map_or(0.0, |first| (first.distance2 as f32).sqrt()),
                    ratio: nearest.ratio() as f32,
                    reverse_ratio: back.ratio() as f32,
                })
            })
            .collect()
    }

    /// The two local points nearest to each scene point, over all its observations; ids are local points.
    fn nearest_local(&self, points: &[PointId], local: &LocalDescriptors) -> Vec<NearestPoints> {
        let rows = points.iter().flat_map(|&point| self.rows_of(point));
        let queries = rows.map(|&row| self.descriptor(row)).collect::<Vec<_>>().concat();
        let nearest = nearest_exact(&queries, &local.descriptors, |row| PointId(local.owners[row]));
        let mut rest = nearest.as_slice();
        points
            .iter()
            .map(|&point| {
                let (mine, others) = rest.split_at(self.rows_of(point).len());
                rest = others;
                let mut merged = NearestPoints::default();
                for nearest in mine {
                    merged.merge(nearest);
                }
                merged
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use setloc_features::{Camera, DESCRIPTOR_LEN, Keypoint, squared_distance};
    use setloc_sfm::{
        CameraId, ImageId, Observation, Reconstruction, ReconstructionImage, ReconstructionPoint, Rigid,
    };

    use super::*;
    use crate::{Backend, IndexGrowth, IndexParams, Neighbour, Row};

    /// Descriptors in clusters, as real ones are, with `noise` between observations of one point.
    fn descriptor(rng: &mut ChaCha8Rng, center: &[u8], noise: i16) -> Vec<u8> {
        center
            .iter()
            .map(|&c| (i16::from(c) + rng.random_range(-noise..=noise)).clamp(0, 255) as u8)
            .collect()
    }

    fn scene(points: usize, views: u32, seed: u64) -> (Reconstruction, Vec<ImageFeatures>, Vec<Vec<u8>>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let clusters: Vec<Vec<u8>> =
            (0..40).map(|_| (0..DESCRIPTOR_LEN).map(|_| rng.random_range(0..120)).collect()).collect();
        let mut features =
            vec![ImageFeatures { width: 1000, height: 500, ..Default::default() }; views as usize];
        let mut reconstruction = Reconstruction {
            cameras: vec![Camera::equirectangular(1000, 500)],
            images: (0..views)
                .map(|i| ReconstructionImage {
                    name: i.to_string(),
                    camera: CameraId(0),
                    world_from_camera: Some(Rigid::identity()),
                })
                .collect(),
            points: Vec::new(),
            lengths: Vec::new(),
        };
        let mut truth = Vec::new();
        for _ in 0..points {
            let cluster = &clusters[rng.random_range(0..clusters.len())];
            let center = descriptor(&mut rng, cluster, 40);
            let mut track = Vec::new();
            for image in 0..views {
                let image_features = &mut features[image as usize];
                track.push(Observation { image: ImageId(image), feature: image_features.len() as u32 });
                let keypoint = Keypoint { x: 500.0, y: 250.0, size: 8.0, orientation: 0.0, noise_px: 1.0 };
                image_features.keypoints.push(keypoint);
                image_features.colors.push([0; 3]);
                image_features.descriptors.extend(descriptor(&mut rng, &center, 8));
            }
            let position = Vector3::new(0.0, 0.0, 10.0);
            reconstruction.points.push(ReconstructionPoint {
                position,
                color: [0; 3],
                error_sigma: 1.0,
                covariance: None,
                aligned: None,
                track,
            });
            truth.push(center);
        }
        (reconstruction, features, truth)
    }

    fn build(backend: Backend, reconstruction: &Reconstruction, features: &[ImageFeatures]) -> SceneIndex {
        let features: Vec<&ImageFeatures> = features.iter().collect();
        SceneIndex::build(&IndexParams { backend, ..Default::default() }, reconstruction, &features)
    }

    fn brute_force(
        reconstruction: &Reconstruction,
        features: &[ImageFeatures],
        query: &[u8],
    ) -> NearestPoints {
        let mut all: Vec<(u32, u32)> = reconstruction
            .points
            .iter()
            .enumerate()
            .map(|(id, point)| {
                let distances = point.track.iter().map(|o| {
                    squared_distance(query, features[o.image.index()].descriptor(o.feature as usize))
                });
                (distances.min().unwrap(), id as u32)
            })
            .collect();
        all.sort_unstable();
        let neighbour = |i: usize| Some(Neighbour { point: PointId(all[i].1), distance2: all[i].0 });
        NearestPoints { first: neighbour(0), second: neighbour(1) }
    }

    #[test]
    fn an_extended_index_finds_what_one_of_everything_does() {
        let (whole, features, truth) = scene(300, 3, 8);
        let first = ImageId(2);
        let mut part = whole.clone();
        part.images.truncate(first.index());
        part.points.truncate(200);
        part.points.iter_mut().for_each(|point| point.track.retain(|seen| seen.image < first));
        let extent = 0.5;
        let mut rows = Vec::new();
        for (id, point) in (0..).map(PointId).zip(&whole.points) {
            let new = point.track.iter().filter(|seen| id.index() >= 200 || seen.image >= first);
            rows.extend(new.map(|&Observation { image, feature }| {
                let descriptor = features[image.index()].descriptor(feature as usize);
                (Row { point: id, image, extent }, descriptor)
            }));
        }
        let points: Vec<_> = whole.points[200..].iter().map(|p| (p.position, Matrix3::identity())).collect();
        let growth = IndexGrowth { centers: &[Some(Vector3::x())], points: &points, rows: &rows };
        for backend in [Backend::Exact, Backend::Inverted] {
            let params = IndexParams { backend, ..Default::default() };
            let extended = build(backend, &part, &features[..2]).extended(&params, &growth);
            let full = build(Backend::Exact, &whole, &features);
            assert_eq!((extended.backend(), extended.point_count()), (backend, 300));
            assert_eq!(extended.descriptor_count(), full.descriptor_count());
            assert_eq!(extended.center(first), Some(Vector3::x()));
            assert_eq!(extended.position_covariance(PointId(299)), Matrix3::identity());
            let queries = truth.concat();
            let pairs = extended.nearest_points(&queries).into_iter().zip(full.nearest_points(&queries));
            let equal = pairs.filter(|(found, wanted)| found.first == wanted.first).count();
            assert!(equal >= 290, "{backend:?}: {equal}");
        }
        let unknown = [(Row { point: PointId(300), image: first, extent }, features[0].descriptor(0))];
        let nothing = IndexGrowth { rows: &unknown, ..IndexGrowth::default() };
        let index = build(Backend::Exact, &part, &features[..2]);
        assert_eq!(index.extended(&IndexParams::default(), &nothing), index);
    }

    #[test]
    fn backends_agree_with_brute_force() {
        let (reconstruction, features, truth) = scene(1500, 3, 3);
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let queries: Vec<Vec<u8>> =
            truth.iter().take(300).map(|center| descriptor(&mut rng, center, 12)).collect();
        let expected: Vec<NearestPoints> =
            queries.iter().map(|q| brute_force(&reconstruction, &features, q)).collect();
        for backend in [Backend::Exact, Backend::Inverted, Backend::Kiddo] {
            let index = build(backend, &reconstruction, &features);
            let found = index.nearest_points(&queries.concat());
            assert_eq!(found.len(), queries.len());
            let second_distance = |n: &NearestPoints| n.second.map(|s| s.distance2);
            let firsts = found.iter().zip(&expected).filter(|(f, e)| f.first == e.first).count();
            let seconds =
                found.iter().zip(&expected).filter(|(f, e)| second_distance(f) == second_distance(e)).count();
            if backend == Backend::Exact {
                assert_eq!((firsts, seconds, index.recall()), (300, 300, None));
            } else {
                assert!(index.recall().unwrap() >= 0.95, "{backend:?} reports {:?}", index.recall());
                assert!(firsts + seconds >= 570, "{backend:?} found {firsts} + {seconds} of 300 + 300");
            }
        }
    }

    #[test]
    fn an_index_survives_its_serialization() {
        let (reconstruction, features, _) = scene(200, 2, 5);
        for backend in [Backend::Exact, Backend::Inverted, Backend::Kiddo] {
            let index = build(backend, &reconstruction, &features);
            let copy: SceneIndex = serde_json::from_str(&serde_json::to_string(&index).unwrap()).unwrap();
            assert_eq!(copy, index);
            assert_eq!(
                copy.nearest_points(&features[0].descriptors),
                index.nearest_points(&features[0].descriptors)
            );
        }
    }

    #[test]
    fn matches_each_scene_point_once_and_by_its_best_feature() {
        let (reconstruction, features, truth) = scene(300, 3, 6);
        let index = build(Backend::Exact, &reconstruction, &features);
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let mut photo = ImageFeatures::default();
        for (center, noise) in [(&truth[10], 3), (&truth[10], 14), (&truth[20], 8)] {
            photo.keypoints.push(Keypoint { x: 0.0, y: 0.0, size: 8.0, orientation: 0.0, noise_px: 1.0 });
            photo.descriptors.extend(descriptor(&mut rng, center, noise));
        }
        let matches = index.match_2d_3d(&photo, 0.8);
        let pairs: Vec<(u32, u32)> = matches.iter().map(|m| (m.feature, m.point.0)).collect();
        assert_eq!(pairs, [(0, 10), (2, 20)]);
    }

    #[test]
    fn points_match_points_and_foreign_points_do_not() {
        let (reconstruction, features, truth) = scene(400, 3, 8);
        let index = build(Backend::Exact, &reconstruction, &features);
        let (_, _, foreign) = scene(400, 1, 99);
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let mut local = LocalDescriptors::default();
        for id in 0..100 {
            for _ in 0..2 {
                local.push(id, &descriptor(&mut rng, &truth[id as usize], 10));
                local.push(id + 1000, &descriptor(&mut rng, &foreign[id as usize], 10));
            }
        }
        let matches = index.match_3d_3d(&local, 0.6, 0.6);
        let right = matches.iter().filter(|m| m.local == m.scene.0).count();
        assert!(right >= 95, "{right} of 100");
        assert_eq!(right, matches.len());
        assert!(matches.iter().all(|m| m.ratio < 0.6 && m.reverse_ratio < 0.6));
    }

    #[test]
    fn an_empty_scene_matches_nothing() {
        for backend in [Backend::Exact, Backend::Inverted, Backend::Kiddo] {
            let index = build(backend, &Reconstruction::default(), &[]);
            assert_eq!(index.nearest_points(&[7; DESCRIPTOR_LEN]), [NearestPoints::default()]);
            assert!(index.match_3d_3d(&LocalDescriptors::default(), 0.6, 0.6).is_empty());
        }
    }
}
