//! The pose of a photo that shows the ground with the photo before it.

use nalgebra::{Matrix2, Matrix6, SMatrix, SVector, UnitQuaternion, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use setloc_features::PatchFrame;

use super::{
    MIN_FIRST,
    floor::{Floor, Ground},
    sight::{DENSE, Piece, View},
};
use crate::{
    Rigid, StepPose,
    mapper::ln_false_alarms,
    robust::least_squares::{LeastSquares, Normal, cauchy, minimize},
};

/// Pose and ground, each parameter in standard deviations of what is known of it.
const UNKNOWNS: usize = 9;
type State = SVector<f64, UNKNOWNS>;

/// Largest standard deviation of the rotation. Where the wall leaves two poses open, 5° apart, a search over all between
/// found paving that agreed at one that was 1.4° and 0.9 m off.
const MAX_TURN_RAD: f64 = 0.03;
/// How far patches are sought, in standard deviations, and at most, as a share of the image's width.
const SEARCH_SIGMAS: f64 = 3.0;
const MAX_SEARCH: f64 = 0.25;
/// Most patches.
const MAX_PIECES: usize = 600;
/// Farthest ground, in heights.
const MAX_DISTANCE: f64 = 15.0;
/// Stride of the search, in a patch's steps in the second photo.
const STRIDE: f64 = 0.8;
/// Most looks for a patch; where more would be needed, next to nothing is known of its place.
const MAX_LOOKS: f64 = 20_000.0;
/// Most places of a patch.
const MAX_PLACES: usize = 8;
/// How far from where it is expected a place may be, in a patch's steps in the second photo.
const TOLERANCE: f64 = 1.0;
/// Two poses that see a patch farther apart than this, in the same unit, have it in different places.
const APART: f64 = 1.5;
/// Pairs of places that are tried, and their seed.
const SAMPLES: usize = 6000;
const SEED: u64 = 1;
/// Steps from what was known to the pose of a pair of places.
const SAMPLE_STEPS: usize = 6;
/// Fewest patches that must agree, and the logarithm of the largest number of poses at which chance finds as many.
const MIN_PATCHES: usize = 12;
const MAX_LN_FALSE_ALARMS: f64 = -7.0;
/// Correlation of patches that show different ground; and what share of the best pose's correlation beyond it makes
/// another that has most patches elsewhere its rival. Paving repeats: on rendered corners poses a row of stones farther
/// on reach 0.8–0.99, those that are off by a degree 0.5–0.73.
const UNLIKE: f64 = 0.4;
const RIVAL: f64 = 0.75;
/// Least correlation beyond it of all patches that tells a pose from another far from it. On rendered corners right ones
/// have 24–50, of eleven wrong ones ten have none and one 12.
const DECIDING: f64 = 18.0;
/// Most poses that are compared.
const MAX_STATES: usize = 12;
/// Squared norm beyond which a state contradicts what was known: 99.9 % of χ² of nine.
const MAX_SQUARED: f64 = 27.9;
/// Standard deviation of a place, in a patch's steps there; neighbouring patches overlap, so that as many count as one.
const PLACE_SIGMA: f64 = 0.2;
const ALIKE: f64 = 4.0;
/// Inverse square of the scale of the loss.
const INVERSE_SCALE_SQUARED: f64 = 0.25;
const STEPS: usize = 30;
/// How often patches are sought anew at the pose that they gave.
const ROUNDS: usize = 3;
/// Steps of the differences for derivatives: over what is sought, and in an adjustment.
const COARSE: f64 = 0.3;
const FINE: f64 = 0.01;
/// Groups of neighbouring patches of which each is left out once.
const GROUPS: usize = 8;

/// A pose by the ground.
pub(super) struct Sharpened {
    pub pose: StepPose,
    /// Patches that agree.
    pub patches: usize,
    /// How well all patches correlate, beyond what unlike ones do.
    pub likeness: f64,
}

impl Sharpened {
    /// Whether the ground at this pose outweighs what it shows at another that it may be taken for.
    pub fn decides_against(&self, other: Option<&Self>) -> bool {
        let of_other = other.map_or(0.0, |other| other.likeness);
        self.likeness >= DECIDING && of_other < RIVAL * self.likeness
    }
}

/// Whether enough is known of a pose to seek the ground.
pub(super) fn is_known(pose: &StepPose) -> bool {
    pose.covariance.fixed_view::<3, 3>(0, 0).symmetric_eigenvalues().max() <= MAX_TURN_RAD.powi(2)
}

/// The pose, within what is known of it (rotation about the second's axes, then centre in the first's), at which the
/// second photo shows most patches of the ground where they are expected; the mean of all such poses that look as well.
/// `None` where none stands out from chance.
pub(super) fn find([from, to]: [&View<'_>; 2], known: &StepPose, floor: &Floor) -> Option<Sharpened> {
    if !is_known(known) {
        return None;
    }
    let root = known.covariance.cholesky()?.l();
    Search { from, to, first_from_second: &known.first_from_second, root: &root, floor }.find()
}

struct Search<'a> {
    from: &'a View<'a>,
    to: &'a View<'a>,
    first_from_second: &'a Rigid,
    root: &'a Matrix6<f64>,
    floor: &'a Floor,
}

/// A patch, where it is expected, and places of the second photo that look like it.
struct Sought {
    piece: Piece,
    places: Vec<Vector2<f64>>,
    /// Pixels of the patch's step there.
    spacing: f64,
    /// Area in which it was sought.
    area: f64,
}

impl Sought {
    /// How many of its places chance puts where they are expected.
    fn by_chance(&self) -> f64 {
        let area = std::f64::consts::PI * (TOLERANCE * self.spacing).powi(2);
        self.places.len() as f64 * area / self.area
    }

    /// That it is seen there, by a patch of which one step spans so many pixels.
    fn at(&self, in_second: Vector2<f64>, spacing: f64) -> Place {
        let Piece { pixel, bearing, .. } = self.piece;
        Place { column: pixel.x, bearing, in_second, sigma: PLACE_SIGMA * spacing }
    }
}

/// A state with the patches that it was fitted to.
struct Fitted {
    state: State,
    places: Vec<Place>,
    /// How well all patches correlate as they are, beyond what unlike ones do.
    likeness: f64,
}

/// A patch with the place where the second photo shows it.
#[derive(Clone, Copy)]
struct Place {
    /// Of its pixel in the first.
    column: f64,
    bearing: Vector3<f64>,
    in_second: Vector2<f64>,
    sigma: f64,
}

impl Search<'_> {
    fn second_from_first(&self, state: &State) -> Rigid {
        let step = self.root * state.fixed_rows::<6>(0);
        let rotation = self.first_from_second.rotation
            * UnitQuaternion::from_scaled_axis(step.fixed_rows::<3>(0).into_owned());
        Rigid::new(rotation, self.first_from_second.translation + step.fixed_rows::<3>(3)).inverse()
    }

    fn ground(&self, state: &State) -> Ground {
        self.floor.ground(&state.fixed_rows::<3>(6).into_owned())
    }

    fn seen(&self, state: &State, bearing: &Vector3<f64>) -> Option<Vector2<f64>> {
        self.to.shows(&self.second_from_first(state), &self.ground(state), bearing)
    }

    fn frame(&self, state: &State, piece: &Piece) -> Option<PatchFrame> {
        self.to.frame_of(&self.second_from_first(state), &self.ground(state), &piece.stencil)
    }

    /// The place and its derivatives, each by a step to either side.
    fn linear(
        &self,
        state: &State,
        bearing: &Vector3<f64>,
        step: f64,
    ) -> Option<(Vector2<f64>, SMatrix<f64, 2, UNKNOWNS>)> {
        let mut rows = SMatrix::<f64, 2, UNKNOWNS>::zeros();
        for axis in 0..UNKNOWNS {
            let moved = |by: f64| {
                let mut state = *state;
                state[axis] += by;
                self.seen(&state, bearing)
            };
            rows.set_column(axis, &((moved(step)? - moved(-step)?) / (2.0 * step)));
        }
        Some((self.seen(state, bearing)?, rows))
    }

    fn find(&self) -> Option<Sharpened> {
        let ground = self.ground(&State::zeros());
        let near = |met: Vector3<f64>| met.norm() <= MAX_DISTANCE * ground.distance;
        let pieces = self.from.pieces(DENSE, |bearing, _| {
            ground.meets(bearing).is_some_and(near) && self.uncertainty(bearing).is_some()
        });
        let stride = pieces.len().div_ceil(MAX_PIECES).max(1);
        let pieces: Vec<Piece> = pieces.into_iter().step_by(stride).collect();
        let sought: Vec<Sought> =
            pieces.into_par_iter().with_max_len(1).filter_map(|piece| self.seek(piece)).collect();
        let fitted: Vec<Fitted> =
            self.agree(&sought).iter().map(|state| self.fitted(state, &sought)).collect();
        let fitted = fitted.into_iter().filter(|fitted| fitted.places.len() >= MIN_PATCHES);
        let fitted: Vec<Fitted> =
            fitted.filter(|fitted| fitted.state.norm_squared() <= MAX_SQUARED).collect();
        let best = fitted.iter().reduce(|a, b| if b.likeness > a.likeness { b } else { a })?;
        let rivals: Vec<&Fitted> =
            fitted.iter().filter(|rival| rival.likeness >= RIVAL * best.likeness).collect();
        // With more, further ones may be right that were not compared.
        if rivals.len() == MAX_STATES {
            return None;
        }
        self.of_rivals(&rivals, best)
    }

    /// The mean of states of which any may be right, with what each leaves open and how far they lie apart.
    fn of_rivals(&self, rivals: &[&Fitted], best: &Fitted) -> Option<Sharpened> {
        let weight = 1.0 / rivals.len() as f64;
        let mean = rivals.iter().map(|rival| rival.state * weight).sum::<State>();
        let mut covariance = Matrix6::zeros();
        for rival in rivals {
            let apart = (rival.state - mean).fixed_rows::<6>(0).into_owned();
            covariance += (self.open(&rival.state, &rival.places)? + apart * apart.transpose()) * weight;
        }
        Some(Sharpened {
            pose: StepPose {
                first_from_second: self.second_from_first(&mean).inverse(),
                covariance: self.root * covariance * self.root.transpose(),
            },
            patches: best.places.len(),
            likeness: best.likeness,
        })
    }

    /// The state at the patches that are found near where it has them.
    fn fitted(&self, state: &State, sought: &[Sought]) -> Fitted {
        let (mut state, mut places) = (*state, Vec::new());
        for _ in 0..ROUNDS {
            places = self.places(&state, sought);
            state = minimize::<UNKNOWNS, _>(&Fit { search: self, places: &places }, state, STEPS);
        }
        let correlation = |sought: &Sought| {
            let frame = self.frame(&state, &sought.piece)?;
            sought.piece.template.correlation(&self.to.pyramid, &frame)
        };
        let likeness =
            sought.iter().filter_map(correlation).map(|correlation| (correlation - UNLIKE).max(0.0)).sum();
        Fitted { state, places, likeness }
    }

    /// Where a bearing's ground is expected, and the covariance of that; `None` where it cannot be seen.
    fn uncertainty(&self, bearing: &Vector3<f64>) -> Option<(Vector2<f64>, Matrix2<f64>)> {
        let (place, rows) = self.linear(&State::zeros(), bearing, COARSE)?;
        let covariance = rows * rows.transpose();
        let reach = covariance.diagonal().map(|variance| SEARCH_SIGMAS * variance.sqrt());
        let inside = place.x > -reach.x
            && place.y > -reach.y
            && place.x < f64::from(self.to.camera.width) + reach.x
            && place.y < f64::from(self.to.camera.height) + reach.y;
        (inside && reach.max() <= MAX_SEARCH * f64::from(self.to.camera.width)).then_some((place, covariance))
    }

    /// The places of a patch in the second photo; `None` where that shows it smaller than the first does, or nowhere.
    fn seek(&self, piece: Piece) -> Option<Sought> {
        let (place, covariance) = self.uncertainty(&piece.bearing)?;
        let frame = self.frame(&State::zeros(), &piece)?;
        let spacing = frame.spacing();
        let covariance = covariance + Matrix2::identity() * spacing.powi(2);
        let inverse = covariance.try_inverse()?;
        let stride = STRIDE * spacing;
        let area = std::f64::consts::PI * SEARCH_SIGMAS.powi(2) * covariance.determinant().sqrt();
        if spacing < self.to.step_px() || area > MAX_LOOKS * stride * stride {
            return None;
        }
        let reach = covariance.diagonal().map(|variance| (SEARCH_SIGMAS * variance.sqrt() / stride) as i32);
        let mut found: Vec<(f64, Vector2<f64>)> = Vec::new();
        for down in -reach.y..=reach.y {
            for across in -reach.x..=reach.x {
                let shift = Vector2::new(f64::from(across), f64::from(down)) * stride;
                let center = place + shift;
                if shift.dot(&(inverse * shift)) > SEARCH_SIGMAS.powi(2) || !self.to.camera.contains(&center)
                {
                    continue;
                }
                let frame = PatchFrame { center, ..frame };
                let Some(aligned) = piece.template.align(&self.to.pyramid, &frame, MIN_FIRST) else {
                    continue;
                };
                if (aligned.pixel - center).norm() <= 2.0 * spacing {
                    found.push((aligned.correlation, aligned.pixel));
                }
            }
        }
        found.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut places: Vec<Vector2<f64>> = Vec::new();
        for (_, place) in found {
            if places.len() < MAX_PLACES && places.iter().all(|other| (other - place).norm() > 0.5 * spacing)
            {
                places.push(place);
            }
        }
        (!places.is_empty()).then_some(Sought { piece, places, spacing, area })
    }

    /// How well the second photo shows a patch where it is expected, from 0 to 1.
    fn agreement(&self, pose: &Rigid, ground: &Ground, sought: &Sought) -> Option<f64> {
        let place = self.to.shows(pose, ground, &sought.piece.bearing)?;
        let errors = sought.places.iter().map(|found| (found - place).norm());
        let error = errors.fold(f64::INFINITY, f64::min) / (TOLERANCE * sought.spacing);
        (error < 1.0).then_some(1.0 - error * error)
    }

    /// Patches that agree on a state.
    fn agreeing<'s>(&self, state: &State, sought: &'s [Sought]) -> Vec<(f64, &'s Sought)> {
        let (pose, ground) = (self.second_from_first(state), self.ground(state));
        sought.iter().filter_map(|sought| Some((self.agreement(&pose, &ground, sought)?, sought))).collect()
    }

    /// States on which many patches agree, of those that two places and what was known give: each puts most of its
    /// patches elsewhere than those before it, on which more agree.
    fn agree(&self, sought: &[Sought]) -> Vec<State> {
        if sought.len() < MIN_PATCHES {
            return Vec::new();
        }
        let mut rng = ChaCha8Rng::seed_from_u64(SEED);
        let mut sample = || {
            let first = rng.random_range(0..sought.len());
            let second = (first + rng.random_range(1..sought.len())) % sought.len();
            [first, second].map(|at| {
                let sought = &sought[at];
                sought.at(sought.places[rng.random_range(0..sought.places.len())], sought.spacing)
            })
        };
        let samples: Vec<[Place; 2]> = (0..SAMPLES).map(|_| sample()).collect();
        let estimate = |places: &[Place; 2]| {
            let state = minimize::<UNKNOWNS, _>(&Fit { search: self, places }, State::zeros(), SAMPLE_STEPS);
            let score = self.agreeing(&state, sought).iter().map(|(score, _)| score).sum::<f64>();
            (state.norm_squared() <= MAX_SQUARED).then_some((score, state))
        };
        let mut scored: Vec<(f64, State)> = samples.par_iter().filter_map(estimate).collect();
        scored.sort_by(|a, b| b.0.total_cmp(&a.0));
        let by_chance: f64 = sought.iter().map(Sought::by_chance).sum();
        let mut taken: Vec<(State, Vec<&Sought>)> = Vec::new();
        for (_, state) in scored {
            if taken.len() == MAX_STATES || taken.iter().any(|(other, at)| !self.are_apart(other, &state, at))
            {
                continue;
            }
            let agreeing: Vec<&Sought> =
                self.agreeing(&state, sought).into_iter().map(|(_, sought)| sought).collect();
            let alarms = ln_false_alarms(SAMPLES, agreeing.len(), by_chance.max(1.0));
            if agreeing.len() < MIN_PATCHES || alarms > MAX_LN_FALSE_ALARMS {
                break;
            }
            taken.push((state, agreeing));
        }
        taken.into_iter().map(|(state, _)| state).collect()
    }

    /// Whether another state puts most patches that agree on this one elsewhere.
    fn are_apart(&self, state: &State, other: &State, agreeing: &[&Sought]) -> bool {
        let known = [state, other].map(|state| (self.second_from_first(state), self.ground(state)));
        let apart = |sought: &&&Sought| {
            let bearing = &sought.piece.bearing;
            let places = [0, 1].map(|at| self.to.shows(&known[at].0, &known[at].1, bearing));
            let [Some(a), Some(b)] = places else { return true };
            (a - b).norm() > APART * sought.spacing
        };
        2 * agreeing.iter().filter(apart).count() > agreeing.len()
    }

    /// Where the second photo shows the patches near where a state has them.
    fn places(&self, state: &State, sought: &[Sought]) -> Vec<Place> {
        let place = |sought: &Sought| {
            let frame = self.frame(state, &sought.piece)?;
            let spacing = frame.spacing();
            let found = sought.piece.template.align(&self.to.pyramid, &frame, MIN_FIRST)?;
            let near = (found.pixel - frame.center).norm() <= TOLERANCE * spacing;
            near.then(|| sought.at(found.pixel, spacing))
        };
        sought.par_iter().with_max_len(4).filter_map(place).collect()
    }

    /// What the patches leave open of the pose, in what was known: by their noise, and by the scatter among estimates
    /// without a part of them.
    fn open(&self, state: &State, places: &[Place]) -> Option<Matrix6<f64>> {
        let fit = Fit { search: self, places };
        let mut normal = Normal::<UNKNOWNS> { matrix: SMatrix::zeros(), gradient: SVector::zeros() };
        fit.accumulate(state, &mut normal);
        normal.matrix.fill_upper_triangle_with_lower_triangle();
        let inverse = normal.matrix.cholesky()?.inverse();
        let mut covariance = inverse.fixed_view::<6, 6>(0, 0).into_owned();
        // Patches are in rows: neighbours are so across.
        let mut order: Vec<usize> = (0..places.len()).collect();
        order.sort_by(|&a, &b| places[a].column.total_cmp(&places[b].column).then(a.cmp(&b)));
        let without = |group: usize| {
            let kept = order.iter().enumerate().filter(|(at, _)| at * GROUPS / order.len() != group);
            let places: Vec<Place> = kept.map(|(_, &at)| places[at]).collect();
            let other = minimize::<UNKNOWNS, _>(&Fit { search: self, places: &places }, *state, STEPS);
            (other - state).fixed_rows::<6>(0).into_owned()
        };
        let shifts: Vec<SVector<f64, 6>> = (0..GROUPS).map(without).collect();
        let mean = shifts.iter().sum::<SVector<f64, 6>>() / GROUPS as f64;
        let scatter: Matrix6<f64> =
            shifts.iter().map(|shift| (shift - mean) * (shift - mean).transpose()).sum();
        covariance += scatter * ((GROUPS - 1) as f64 / GROUPS as f64);
        Some(covariance)
    }
}

/// Places and what was known before.
struct Fit<'a> {
    search: &'a Search<'a>,
    places: &'a [Place],
}

impl Place {
    /// Inverse variance of each coordinate.
    fn information(&self) -> f64 {
        1.0 / (ALIKE * self.sigma * self.sigma)
    }

    /// Loss and weight where the patch is expected to be seen there.
    fn loss(&self, seen: &Vector2<f64>) -> (f64, f64) {
        cauchy((seen - self.in_second).norm_squared() * self.information(), INVERSE_SCALE_SQUARED)
    }
}

impl LeastSquares<UNKNOWNS> for Fit<'_> {
    type Model = State;

    fn accumulate(&self, state: &State, normal: &mut Normal<UNKNOWNS>) -> f64 {
        let mut cost = state.norm_squared();
        for (axis, value) in state.iter().enumerate() {
            normal.add(*value, &SVector::ith(axis, 1.0), 1.0);
        }
        for place in self.places {
            let Some((seen, rows)) = self.search.linear(state, &place.bearing, FINE) else { continue };
            let (loss, weight) = place.loss(&seen);
            cost += loss;
            let weight = weight * place.information();
            let error = seen - place.in_second;
            for axis in 0..2 {
                normal.add(error[axis], &rows.row(axis).transpose(), weight);
            }
        }
        cost
    }

    fn cost(&self, state: &State) -> f64 {
        let of_places = self.places.iter().map(|place| {
            self.search.seen(state, &place.bearing).map_or(f64::INFINITY, |seen| place.loss(&seen).0)
        });
        state.norm_squared() + of_places.sum::<f64>()
    }

    fn step(&self, state: &State, delta: &State) -> State {
        state + delta
    }
}
