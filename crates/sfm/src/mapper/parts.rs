//! The parts that a place is mapped in: made one after the other, joined, grown again and handed over.

use std::{cmp::Reverse, collections::BTreeSet};

use nalgebra::UnitQuaternion;

use super::{
    Mapper, MapperInput, MapperOutput, MapperParams, MapperReport, input::PairsByImage,
    latecomers::may_be_left, merge::PartState, model::Model, projection, witnesses::Witnesses,
};
use crate::{ImageId, Reconstruction, ReconstructionImage};

/// The image that each image was turned from, and the turn, where it entered so.
pub(super) type Anchors = Vec<Option<(ImageId, UnitQuaternion<f64>)>>;

/// Fewest points that hold an image: three give a pose, a fourth contradicts a wrong one.
const MIN_HELD_POINTS: usize = 4;

/// A finished component with what its images are held by.
#[derive(Clone)]
pub(super) struct Part {
    pub component: Reconstruction,
    pub anchors: Anchors,
}

impl Part {
    pub fn size(&self) -> usize {
        self.component.registered().count()
    }

    /// The component without the poses of images that fewer than [`MIN_HELD_POINTS`] points hold, and these images.
    ///
    /// Points that later disagreed are gone then, and the pose is where it was when they did not; photos matched with
    /// such an image were localized at wrong places. Images that were turned from another one are held by it.
    fn without_unheld(mut self) -> (Reconstruction, Vec<ImageId>) {
        let mut points_of = vec![0_usize; self.component.images.len()];
        for seen in self.component.points.iter().flat_map(|point| &point.track) {
            points_of[seen.image.index()] += 1;
        }
        let is_turned = |image: ImageId| (self.anchors.iter().flatten()).any(|(from, _)| *from == image);
        let held = |image: ImageId| {
            points_of[image.index()] >= MIN_HELD_POINTS
                || self.anchors[image.index()].is_some()
                || is_turned(image)
                || self.component.lengths.iter().any(|length| length.involves(image))
        };
        let unheld: Vec<ImageId> = self.component.registered().filter(|image| !held(*image)).collect();
        self.component.leave_out(&unheld);
        (self.component, unheld)
    }

    /// The part with further observations of its points, where images have few.
    ///
    /// Not before parts are joined: what they ought to share is measured by what the ratio test finds within each.
    fn seen_again(self, params: &MapperParams, input: &MapperInput<'_>, seed: u64) -> Self {
        if !projection::has_images_with_few_points(&self.component) {
            return self;
        }
        let mut mapper = self.mapper(params, input, seed);
        mapper.leave_out_strays();
        if mapper.see_again() { mapper.into_part() } else { self }
    }

    /// The part adjusted without what pairs of images far apart tie that disagree with it; as it is where none do.
    fn without_strays(self, params: &MapperParams, input: &MapperInput<'_>, seed: u64) -> Self {
        let mut mapper = self.mapper(params, input, seed);
        if mapper.leave_out_strays() == 0 {
            return self;
        }
        mapper.refine(1, 20);
        mapper.adjust_all(30);
        mapper.filter_all(params.limits());
        mapper.into_part()
    }

    /// A mapper at work on its images alone.
    fn mapper<'a>(&self, params: &'a MapperParams, input: &'a MapperInput<'a>, seed: u64) -> Mapper<'a> {
        let model = Model::of_component(input, &self.component);
        let taken = self.component.images.iter().map(|image| image.world_from_camera.is_none()).collect();
        let mut mapper = Mapper::over(params, model, taken, seed);
        mapper.anchors.clone_from(&self.anchors);
        mapper
    }
}

/// The parts of a place, and what happened to them.
pub(super) struct Parts<'a> {
    pub params: &'a MapperParams,
    pub input: &'a MapperInput<'a>,
    pub seed: u64,
    /// Largest first, but for the one at work on.
    pub all: Vec<Part>,
    pub report: MapperReport,
}

impl<'a> Parts<'a> {
    /// All components of an input, and those that something supports a similarity between as one.
    pub fn map(params: &'a MapperParams, input: &'a MapperInput<'a>, seed: u64) -> Self {
        let mut parts = Self { params, input, seed, all: Vec::new(), report: MapperReport::default() };
        let mut taken = vec![false; input.images.len()];
        let mut barren = vec![false; input.images.len()];
        while let Some(mut mapper) = Mapper::new(params, input, taken.clone(), seed) {
            let found = mapper.initialize(&mut barren);
            if found {
                mapper.grow();
                mapper.finish();
            }
            parts.report.registrations.append(&mut mapper.records);
            if !found || mapper.model.registered_count() < 2 {
                break;
            }
            for image in mapper.model.registered() {
                taken[image.index()] = true;
            }
            parts.all.push(mapper.into_part());
        }
        parts.join_supported();
        parts.admit_latecomers();
        // What is split off one part may come together again.
        let mut known = BTreeSet::new();
        while params.join_by_depths && parts.join_hung() && known.insert(parts.states()) {
            parts.admit_latecomers();
        }
        parts
    }

    /// The same parts with other pairs.
    pub fn over<'b>(self, input: &'b MapperInput<'b>) -> Parts<'b>
    where
        'a: 'b,
    {
        Parts { params: self.params, input, seed: self.seed, all: self.all, report: self.report }
    }

    fn states(&self) -> Vec<PartState> {
        self.all.iter().map(Part::state).collect()
    }

    pub fn sort(&mut self) {
        self.all.sort_by_key(|part| Reverse(part.size()));
    }

    /// The images of all parts but these.
    pub fn taken_by_all_but(&self, these: &[usize]) -> Vec<bool> {
        let mut taken = vec![false; self.input.images.len()];
        for (_, other) in self.all.iter().enumerate().filter(|(at, _)| !these.contains(at)) {
            for image in other.component.registered() {
                taken[image.index()] = true;
            }
        }
        taken
    }

    /// Takes images that only their pairs and what they share with neighbours speak for.
    ///
    /// Images may leave parts of hardly any images, or that their pairs speak against, for a larger one. Only of panoramas is it
    /// known what neighbours share, so nothing changes without any.
    fn admit_latecomers(&mut self) {
        if !(0..self.input.images.len() as u32).any(|image| self.input.is_panoramic(ImageId(image))) {
            return;
        }
        let pairs = PairsByImage::of(self.input);
        let mut at = 0;
        while at < self.all.len() {
            let is_open = |other: &usize| *other == at || may_be_left(&pairs, &self.all[*other]);
            let open: Vec<usize> = (0..self.all.len()).filter(is_open).collect();
            let taken = self.taken_by_all_but(&open);
            let part = &self.all[at];
            let waits =
                |(image, taken): (&ReconstructionImage, &bool)| image.world_from_camera.is_none() && !taken;
            if may_be_left(&pairs, part) || !part.component.images.iter().zip(&taken).any(waits) {
                at += 1;
                continue;
            }
            let mut mapper = self.reopened(at, taken);
            mapper.admit_latecomers();
            mapper.grow();
            let has_grown = mapper.model.registered_count() > part.size();
            if has_grown {
                mapper.finish();
            }
            self.report.registrations.append(&mut mapper.records);
            if has_grown {
                self.all[at] = mapper.into_part();
                let admitted: Vec<ImageId> = self.all[at].component.registered().collect();
                for (_, other) in self.all.iter_mut().enumerate().filter(|(other, _)| *other != at) {
                    other.component.leave_out(&admitted);
                }
                self.all.retain(|part| part.size() >= 2);
            }
            at += 1;
        }
        self.sort();
    }

    /// Adds what pairs give that the parts were not made of; witnesses judge who joins.
    pub fn grow_again(&mut self, witnesses: &'a Witnesses) {
        for at in 0..self.all.len() {
            self.rework(at, |mapper| {
                mapper.witnesses = Some(witnesses);
                mapper.refine(2, 20);
                mapper.grow();
                mapper.finish();
            });
        }
        self.sort();
    }

    /// Opens one of the parts to images that no other has, and puts what work makes of it in its place.
    pub fn rework(&mut self, at: usize, work: impl FnOnce(&mut Mapper<'a>)) {
        let mut mapper = self.reopened(at, self.taken_by_all_but(&[at]));
        work(&mut mapper);
        self.report.registrations.append(&mut mapper.records);
        self.all[at] = mapper.into_part();
    }

    /// A mapper at work on one of the parts again, and on images that are not taken.
    fn reopened(&self, at: usize, taken: Vec<bool>) -> Mapper<'a> {
        let part = &self.all[at];
        let model = Model::open(self.input, &part.component, &taken);
        let mut mapper = Mapper::over(self.params, model, taken, self.seed);
        mapper.anchors.clone_from(&part.anchors);
        mapper
    }

    /// The parts as they are handed over.
    pub fn finished(self) -> MapperOutput {
        let mut report = self.report;
        let mut components = Vec::new();
        for part in self.all {
            let part = part.without_strays(self.params, self.input, self.seed);
            let (component, unheld) = part.seen_again(self.params, self.input, self.seed).without_unheld();
            for image in unheld {
                let name = &component.images[image.index()].name;
                report.warnings.push(format!("{name} is left out: next to no point of the model holds it"));
            }
            components.push(component);
        }
        // Images that were left out may change which is the largest.
        Reconstruction::largest_first(&mut components);
        MapperOutput { components, report, ..MapperOutput::default() }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use setloc_features::Camera;

    use super::*;
    use crate::{CameraId, Observation, ReconstructionPoint, Rigid};

    #[test]
    fn images_that_next_to_no_point_holds_lose_their_pose_and_others_keep_theirs() {
        let image = |number: u32| ReconstructionImage {
            name: number.to_string(),
            camera: CameraId(0),
            world_from_camera: Some(Rigid::new(UnitQuaternion::identity(), Vector3::x() * f64::from(number))),
        };
        let point = |feature: u32, images: &[u32]| ReconstructionPoint {
            position: Vector3::z(),
            color: [0; 3],
            error_sigma: 1.0,
            covariance: None,
            track: images.iter().map(|&image| Observation { image: ImageId(image), feature }).collect(),
            aligned: None,
        };
        // Three points hold the third image, none the fourth, which was turned from the first.
        let points = (0..6).map(|feature| point(feature, if feature < 2 { &[0, 1, 2] } else { &[0, 1] }));
        let points: Vec<_> = points.chain([point(6, &[1, 2])]).collect();
        let component = Reconstruction {
            cameras: vec![Camera::equirectangular(200, 100)],
            images: (0..4).map(image).collect(),
            points,
            lengths: Vec::new(),
        };
        let mut anchors = vec![None; 4];
        anchors[3] = Some((ImageId(0), UnitQuaternion::identity()));
        let (component, unheld) = Part { component, anchors }.without_unheld();
        assert_eq!(unheld, [ImageId(2)]);
        assert_eq!(component.registered().collect::<Vec<_>>(), [0, 1, 3].map(ImageId));
        assert_eq!(component.points.len(), 6);
        assert!(component.points.iter().all(|point| point.track.len() == 2));
    }
}
