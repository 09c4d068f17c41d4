//! What is said of the models of a scene when it is built.

use setloc_index::SceneIndex;
use setloc_sfm::{
    ImageId, MOST_NAMED, ModelErrors, OutvotedPair, Reconstruction, SuspiciousNeighbours, UnconfirmedPair,
    doubtful_images, listed,
};

/// Which component a note is of, unless it is the largest.
fn of_component(component: usize) -> String {
    if component == 0 { String::new() } else { format!(" in component {}", component + 1) }
}

/// Says by how much panoramas of a component are stretched, if any are.
pub(super) fn stretch_note((component, model): (usize, &Reconstruction)) -> Option<String> {
    let used = model.registered().map(|image| model.camera_of(image).largest_stretch());
    let percent = 100.0 * used.fold(0.0, f64::max);
    (percent > 0.0).then(|| {
        format!(
            "the panoramas{} stretch or twist directions by up to {percent:.2} % (stitching, lenses), which is taken out \
             (sfm.calibrate_panoramas)",
            of_component(component)
        )
    })
}

/// Says which distances between images of a component no point tells, where there are any.
pub(super) fn lengths_note((component, model): (usize, &Reconstruction)) -> Option<String> {
    let percents = || model.lengths.iter().map(|length| 100.0 * length.deviation);
    let (least, most) = (percents().reduce(f64::min)?, percents().reduce(f64::max)?);
    let name = |image: ImageId| model.images[image.index()].name.as_str();
    let steps: Vec<String> = (model.lengths.iter())
        .map(|length| format!("{} from {}", name(length.to), name(length.from)))
        .collect();
    Some(format!(
        "distances{} rest on what lies beside the points of one pair and on the floor, not on points that a third \
         image sees (± {least:.0} to {most:.0} %): {}",
        of_component(component),
        listed(&steps, MAX_STEPS_NAMED)
    ))
}

/// Steps that are named where a note is of many.
const MAX_STEPS_NAMED: usize = 5;

/// Says what errors the images of a component share, where any are told.
pub(super) fn shared_errors_note((component, errors): (usize, &Option<ModelErrors>)) -> Option<String> {
    let degrees = errors.as_ref()?.shared_sigma_rad().to_degrees();
    let of_component = of_component(component);
    (degrees > 0.0).then(|| {
        format!(
            "neighbouring bearings of an image{of_component} are off together by {degrees:.3}° (stitching, lenses), which \
             covariances of photos have in them"
        )
    })
}

/// Why a model may be wrong, and where.
pub(super) enum Doubt {
    /// About these images it may be folded; none where nothing says so.
    Folded(Vec<ImageId>),
    /// Nothing but these two images tells it.
    Unconfirmed(UnconfirmedPair),
}

impl Doubt {
    /// Of a component with the pairs that outvote it and those that stand together and share nothing.
    pub fn of(
        component: &Reconstruction,
        outvoted: &[OutvotedPair],
        suspicious: &[SuspiciousNeighbours],
    ) -> Self {
        match UnconfirmedPair::of(component) {
            Some(pair) => Self::Unconfirmed(pair),
            None => Self::Folded(doubtful_images(component, outvoted, suspicious)),
        }
    }

    /// The images about which it may be wrong; ascending.
    pub fn images(&self) -> Vec<ImageId> {
        match self {
            Self::Folded(images) => images.clone(),
            Self::Unconfirmed(pair) => vec![pair.first, pair.second],
        }
    }

    /// Says what that means for photos.
    pub fn warning(&self, component: &Reconstruction) -> Option<String> {
        let name = |image: ImageId| component.images[image.index()].name.as_str();
        match self {
            Self::Folded(images) => (!images.is_empty()).then(|| {
                let names: Vec<&str> = images.iter().map(|image| name(*image)).collect();
                let names = listed(&names, MOST_NAMED);
                format!("photos of what {names} show will be uncertain: the model may be folded there")
            }),
            Self::Unconfirmed(UnconfirmedPair { first, second, points }) => Some(format!(
                "photos of what {} and {} show will be uncertain: {points} points in few directions hold these two images \
                 together, and no third confirms it (a poster may hang twice, floors may look alike)",
                name(*first),
                name(*second)
            )),
        }
    }
}

/// Share of the nearest scene points below which an index is said to miss too many.
const MIN_RECALL: f64 = 0.95;

/// The share of the nearest scene points that an index finds.
pub(super) struct Recall {
    share: f64,
    /// What it is of, in words.
    index: String,
}

/// The poorest recall of some components' indices; `None` where all are exact.
pub(super) fn worst_recall(indices: &[SceneIndex]) -> Option<Recall> {
    let measured = indices.iter().enumerate().filter_map(|(at, index)| Some((at, index.recall()?)));
    let (at, share) = measured.min_by(|(_, a), (_, b)| a.total_cmp(b))?;
    let index = match indices.len() {
        1 => "the index".to_owned(),
        count => format!("the index of component {}, the poorest of {count},", at + 1),
    };
    Some(Recall { share, index })
}

impl Recall {
    /// What it finds.
    pub fn note(&self) -> String {
        format!(
            "{} finds {:.1} % of the nearest scene points (asked for the scene's own descriptors)",
            self.index,
            100.0 * self.share
        )
    }

    /// What is wrong with it, if it misses too many.
    pub fn warning(&self) -> Option<String> {
        let text = format!(
            "{} misses {:.1} % of the nearest scene points: raise `index.max_candidates` or choose another \
             `index.backend`",
            self.index,
            100.0 * (1.0 - self.share)
        );
        (self.share < MIN_RECALL).then_some(text)
    }
}
