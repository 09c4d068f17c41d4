//! Pose of one photo, or of a whole image set as one generalized camera, in a scene.
//!
//! A photo alone needs matches of its own ([`locate_single`]). A set ([`locate_set`]) needs them only somewhere: its
//! local model ties all photos together, the scene ties the model down, and a joint refinement lets the photos move
//! against each other, because a local model drifts. Whatever comes out is an answer with its evidence, never an
//! error: a verdict, a covariance, what the data leave undetermined, and the weakest link on the way from the scene.
//!
//! The one decision that shapes this crate: *verdicts are separate from poses*. A pose is the best explanation
//! found; whether it may be used is decided afterwards from evidence that the estimation did not create (matches
//! before guided matching, the runner-up hypothesis, the covariance, the chain of links).
//!
//! A scene may have several components, each in a frame of its own. Photos are sought in one ([`locate_single`],
//! [`locate_set`]) or in all of them ([`locate_single_anywhere`], [`locate_set_anywhere`]).
//!
//! It knows no files and no features beyond those handed in, and it builds no local models.

mod advice;
mod anywhere;
mod common;
mod common_turn;
mod evidence;
mod grow;
mod guided;
mod jackknife;
mod misfit;
mod observability;
mod params;
mod pictures;
mod refine;
mod scene_errors;
mod set;
mod single;
mod stretch;
pub mod synthetic;
mod types;
mod underfoot;
mod verdict;
mod views;

pub use advice::{Link, PathToScene};
pub use anywhere::{locate_single_anywhere, nearest_anywhere};
pub use grow::{GrownScene, Growth, GrowthParams, GrowthPhoto, GrowthPoint, grow};
pub use params::{CamsetMethod, CamsetParams, GuidedParams, SingleParams, VerdictParams};
pub use pictures::{Picture, Pictures};
pub use set::{locate_set, locate_set_anywhere};
pub use single::locate_single;
pub use types::{
    AnywhereLocalization, GrownImage, LocalModels, NearestAnywhere, PhotoEvidence, PhotoLocalization,
    PlacedModel, QueryPhoto, Scene, SceneMatch, SetLocalization, SingleAnswer, SingleLocalization, Verdict,
};
pub use views::{ViewGeometry, ViewMatch, ViewParams, Views, likely_images, match_views};

/// Version of the answers; bumped whenever equal inputs give another answer.
///
/// 1: single photos, rigid sets, joint refinement. 2: moving scene points, baselines, stricter verdicts. 3: exact scene
/// points hold still, standpoints move together, no pose without scale. 4: noise as the residuals show it. 5: sets by the
/// places of their pixels. 6: covariances that the points bear out. 7: models mapped and aligned on all cores. 8: each
/// covariance is asked of its own pose's points. 9: sets take over what is known of their photos alone. 10: lengths that
/// planes tell hold the set's baselines. 11: matches far astray are no noise. 13: photos of one standpoint are judged by
/// what any of them sees. 14: photos stand where their pair by planes has them, as well as that tells.
/// 15: only matches hundreds of deviations off are no noise. 16: what points do not localize is matched with the scene's
/// images. 17, 18: by fewer matches a pair, all photos alike. 19: contradictions are named, advice goes with the answers.
/// 20: all components of a scene are searched. 21: matches that tell no distance are named. 22: intrinsics that are not
/// known are free under what holds for usual photos. 23: what lies on the ground alone localizes nothing.
/// 24: what several photos alone contradict is not trusted. 25: unknown cameras may be fisheyes.
/// 26: far walls are no ground, and one standpoint contradicts a local model once.
/// 27: what too little tells the focal length of is uncertain. 28: the ground counts for less, and what stronger pairs
/// contradict is uncertain. 29: what guided matching shows beside the ground counts,
/// and where hardly any match agrees, it chooses the pose. 30: photos localized alone far from where stronger ones put
/// them, and what is seen where a scene may be folded, are uncertain. 31: where a set's photos have many cameras, those
/// that share one have focal lengths of their own. 32: a set's scale by the walls that its photos show. 33: errors that
/// directions of the scene's images share. 34: and how these change the stretch of panoramas. 35: focal lengths that a
/// set's photos contradict; walls by what is more alike. 36: what matches err alike. 37: wrong matches do not stand for the
/// noise of right ones. 38: photos that are stretched. 39: pictures of walls by the luma that JPEGs store.
/// 40: what the scene's poses may be off. 41: an adjustment's steps are stretched by its curvature. 42: scene points of uncertain
/// depth are held by parallax. 43: points of a grown scene shift to where moved rays meet. 44: stretched photos go on from where they
/// are refined to. 45: and are twisted. 46: as the scene's panoramas are. 47: scales that few matches give.
/// 48: photos among stitched panoramas err as these do; photos that the
/// joint refinement leaves behind are where they are alone. 49: sets whose photos look otherwise than the scene are uncertain.
/// 50: photos among stitched panoramas are stretched as windows of these are. 51: photos that their set leaves with fewer of their
/// scene points stand as they do alone. 52: unknown focal lengths by P4Pf, too. 53: told focal lengths are asked for by the joint refinement.
/// 54: and by photos alone; what residuals have in common makes poses uncertain.
/// 55: photos alone that were cut from the side of a larger picture are found as such. 56: those that may be stay doubtful at another
/// focal length; far points end no adjustment.
/// 58: sets of photos that were cut apart are in doubt.
pub const VERSION: u32 = 59;

/// Version of what localized photos add to a scene; bumped whenever equal inputs give another growth.
/// 2: points shift to where moved rays meet.
pub const GROWTH_VERSION: u32 = 2;
