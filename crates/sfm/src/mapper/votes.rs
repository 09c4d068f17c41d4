//! The length that votes agree on.
//!
//! Each vote is a length with its noise; many are wrong, and those scatter. A length is as likely as the mixture of right
//! and wrong votes that suits it best, and it has to be more likely than any other by a factor ([`LEAD`]) in the logarithm.

/// How many times more the logarithm of the likelihood of a length must be than that of any other.
pub(super) const LEAD: f64 = 3.0;
/// Range of the logarithm of lengths among which votes for nothing scatter.
const RANGE: f64 = 6.0;
/// Lengths whose logarithms differ by less are one.
const SAME_LENGTH: f64 = 0.15;
/// Most lengths that are compared.
const MAX_CANDIDATES: usize = 160;
/// Most steps from the best vote to the mean of those round it.
const REFINEMENTS: usize = 20;
/// Steps of expectation maximization for the share of right votes.
const MIXTURE_STEPS: usize = 12;
/// How many standard deviations a vote that agrees may be off.
const AGREEING_SIGMAS: f64 = 3.0;

/// A vote for a length.
#[derive(Debug, Clone, Copy)]
pub(super) struct Opinion {
    /// Logarithm of the length.
    pub length: f64,
    /// Standard deviation of that.
    pub sigma: f64,
}

impl Opinion {
    fn error(&self, length: f64) -> f64 {
        (self.length - length) / self.sigma
    }

    /// Whether it may be a noisy vote for this length (a logarithm).
    pub fn agrees(&self, length: f64) -> bool {
        self.error(length).abs() <= AGREEING_SIGMAS
    }
}

/// A length that votes agree on.
#[derive(Debug, Clone, Copy)]
pub(super) struct Peak {
    /// Logarithm of the length.
    pub length: f64,
    /// Logarithm of its likelihood, relative to votes that scatter over the whole range.
    pub log_likelihood: f64,
    /// Votes that agree, each by its probability.
    pub votes: f64,
}

/// The best supported length, and the likelihood of the best that differs from it.
pub(super) fn peaks(opinions: &[Opinion]) -> Option<(Peak, f64)> {
    let mut lengths: Vec<f64> = opinions.iter().map(|opinion| opinion.length).collect();
    lengths.sort_by(f64::total_cmp);
    let stride = lengths.len().div_ceil(MAX_CANDIDATES).max(1);
    let candidates: Vec<Peak> =
        lengths.iter().step_by(stride).map(|&length| support(opinions, length)).collect();
    let mut best =
        *candidates.iter().reduce(|a, b| if b.log_likelihood > a.log_likelihood { b } else { a })?;
    for _ in 0..REFINEMENTS {
        let refined = support(opinions, mean_near(opinions, best.length)?);
        if refined.log_likelihood <= best.log_likelihood {
            break;
        }
        best = refined;
    }
    let others = candidates.iter().filter(|other| (other.length - best.length).abs() > SAME_LENGTH);
    Some((best, others.map(|other| other.log_likelihood).fold(0.0, f64::max)))
}

/// A mixture of votes that are right within their noise and of others, in the proportion that suits a length best.
fn support(opinions: &[Opinion], length: f64) -> Peak {
    let densities: Vec<f64> = opinions
        .iter()
        .map(|opinion| {
            RANGE * (-0.5 * opinion.error(length).powi(2)).exp()
                / (opinion.sigma * std::f64::consts::TAU.sqrt())
        })
        .collect();
    let (mut share, mut votes) = (0.5, 0.0);
    for _ in 0..MIXTURE_STEPS {
        votes = densities.iter().map(|right| share * right / (share * right + 1.0 - share)).sum();
        share = (votes / opinions.len() as f64).clamp(1e-3, 1.0 - 1e-3);
    }
    let log_likelihood = densities.iter().map(|right| (share * right + 1.0 - share).ln()).sum();
    Peak { length, log_likelihood, votes }
}

/// Mean of the votes near a length, weighted by their noise and by how near they are.
fn mean_near(opinions: &[Opinion], length: f64) -> Option<f64> {
    let (mut sum, mut weights) = (0.0, 0.0);
    for opinion in opinions {
        let weight = (-0.5 * opinion.error(length).powi(2)).exp() / opinion.sigma.powi(2);
        sum += weight * (opinion.length - length);
        weights += weight;
    }
    (weights > 0.0).then(|| length + sum / weights)
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::synthetic::seeded;

    #[test]
    fn the_length_that_a_third_agree_on_stands_out_and_scattered_votes_give_none() {
        let mut rng = seeded("votes");
        let mut scattered =
            |count: usize| (0..count).map(|_| rng.random_range(-3.0..3.0)).collect::<Vec<f64>>();
        let noise = scattered(30).into_iter().map(|at| 0.01 * at);
        let lengths = noise.map(|noise| 0.7 + noise).chain(scattered(60));
        let opinions: Vec<Opinion> = lengths.map(|length| Opinion { length, sigma: 0.02 }).collect();
        let (best, second) = peaks(&opinions).expect("there are votes");
        assert!((best.length - 0.7).abs() < 0.01, "{best:?}");
        assert!(best.votes > 25.0 && best.log_likelihood > LEAD * second, "{best:?} {second}");
        let (best, second) = peaks(&opinions[30..]).expect("there are votes");
        assert!(best.log_likelihood < LEAD * second.max(3.0), "{best:?} {second}");
        assert!(peaks(&[]).is_none());
    }
}
