//! The step factor that uses up an allowed size, loss or difference of images, found by attempts.

use super::images::{Images, Recorded};
use super::job::{Attempt, Job};
use super::search::file_bytes;
use cc4dgs_format::{CodecContext, Error, Result, Stream};

/// Upper bound on the attempts of a search; as many more follow if no file was small enough, which happens where an octave of the steps saves fewer bytes
/// than expected.
const ATTEMPTS: usize = 8;
/// Parameters of a Gaussian that are not rounded to zero, for the estimate of the error.
pub const PARAMETERS: f64 = 20.0;
/// Shares of an allowance that are good enough: before the steps of the columns are corrected, and at the end. A search that ends with less than the first is
/// warned of.
pub const ROUGH: f64 = 0.8;
pub const GOOD: f64 = 0.97;
/// The share that attempts aim at.
const AIM: f64 = 0.985;
/// Octaves of the step factor by which attempts differ, at most, and the share of a known interval that they stay away from its ends.
const FARTHEST: f64 = 2.0;
const MARGIN: f64 = 0.08;
/// Octaves of the largest leap to coarser steps. With those before, most values of any model become zero.
const LARGEST_LEAP: f64 = 8.0;
/// Least share from which a loss is extrapolated: smaller ones are noise.
const LEAST: f64 = 0.05;

/// What attempts use up.
pub enum Allowance<'a> {
    /// Bytes of the file ([`file_bytes`]). Larger steps use fewer.
    Bytes { limit: f64, context: &'a CodecContext<'a> },
    /// PSNR on the views that judge, in dB below `before`. Larger steps lose more.
    Drop { before: f64, limit: f64, recorded: Recorded<'a> },
    /// The mean squared difference between images before and after, of views of this kind. Larger steps differ more.
    Difference { limit: f64, images: Images<'a>, kind: &'static str },
}

impl Allowance<'_> {
    /// An attempt with what it uses, as a share of what is allowed. It is coded only where bytes are allowed.
    fn tried(&self, job: &Job, quality: f64) -> Result<Tried> {
        match self {
            Self::Bytes { limit, context } => {
                let (attempt, streams) = job.coded(&job.planner, quality, &job.factors)?;
                Ok(Tried { attempt, share: file_bytes(context, &streams, None)? / limit, streams: Some(streams), ended: None })
            }
            Self::Drop { before, limit, recorded } => {
                let (attempt, rounded) = job.attempt(quality)?;
                let share = (before - recorded.psnr(rounded)?) / limit;
                Ok(Tried { attempt, share, streams: None, ended: None })
            }
            Self::Difference { limit, images, .. } => {
                let (attempt, rounded) = job.attempt(quality)?;
                Ok(Tried { attempt, share: images.mean_squared_error(rounded)? / limit, streams: None, ended: None })
            }
        }
    }
    /// Octaves from the step factor of an attempt with so many Gaussians to the one that is expected to use [`AIM`].
    fn octaves(&self, gaussians: usize, share: f64) -> f64 {
        match self {
            // An octave of all steps is a bit of every value that is not zero.
            Self::Bytes { limit, .. } => (share - AIM) * limit / (PARAMETERS / 8.0 * gaussians.max(1) as f64),
            // Squared errors of images, small beside what a model leaves, add to the loss in proportion.
            Self::Drop { .. } | Self::Difference { .. } => 0.5 * libm::log2(AIM / share.max(LEAST)),
        }
    }
    /// 1 where larger steps use more, else -1.
    fn direction(&self) -> f64 {
        if self.is_of_bytes() { -1.0 } else { 1.0 }
    }
    pub fn is_of_bytes(&self) -> bool {
        matches!(self, Self::Bytes { .. })
    }
}

/// An attempt and the share of the allowance that it uses.
pub struct Tried {
    pub attempt: Attempt,
    pub share: f64,
    /// Where it was coded.
    pub streams: Option<Vec<Stream>>,
    /// After how many attempts it was chosen where none was left, none was good enough, and another might be better: a size may be more than the finest steps
    /// fill.
    pub ended: Option<usize>,
}

impl Tried {
    pub fn allowed(&self) -> bool {
        self.share <= 1.0
    }
    pub fn coded(&mut self, job: &Job) -> Result<Vec<Stream>> {
        self.streams.take().map_or_else(|| job.streams(job.planner.gaussians, &self.attempt.plan), Ok)
    }
}

/// What attempts have found. Their octaves are those of the step factor over the one at the start, in the direction in which more is used.
struct Found {
    /// The attempt that uses most of what is allowed, after its octaves.
    best: Option<(f64, Tried)>,
    /// Of those that use too much, the one that uses least, and the fewest octaves of any.
    least: Option<Tried>,
    refused: f64,
}

impl Found {
    fn add(&mut self, at: f64, tried: Tried) {
        if !tried.allowed() {
            self.refused = self.refused.min(at);
            self.least = self.least.take().filter(|known| known.share <= tried.share).or(Some(tried));
        } else if self.best.as_ref().is_none_or(|(known, _)| at > *known) {
            self.best = Some((at, tried));
        }
    }
}

/// The attempt that uses most of what is allowed, from the step factor `start`; the one that uses least if none is allowed. A share of `good` ends the search.
/// `first` is the attempt at `start`, where it has been made before.
pub fn seek(job: &Job, start: f64, mut first: Option<Tried>, allowance: &Allowance, good: f64) -> Result<Tried> {
    let direction = allowance.direction();
    let tried_at = |at: f64| allowance.tried(job, start * libm::exp2(direction * at));
    let (mut at, mut attempts) = (0.0, ATTEMPTS);
    let mut found = Found { best: None, least: None, refused: f64::INFINITY };
    for _ in 0..ATTEMPTS {
        let tried = first.take().map_or_else(|| tried_at(at), Ok)?;
        if tried.allowed() && tried.share >= good {
            return Ok(tried);
        }
        let step = direction * allowance.octaves(job.planner.gaussians.len(), tried.share);
        found.add(at, tried);
        let next = at + step.clamp(-FARTHEST, FARTHEST);
        at = match &found.best {
            Some((known, _)) if found.refused > *known && found.refused.is_finite() => {
                let margin = MARGIN * (found.refused - known);
                next.clamp(known + margin, found.refused - margin)
            }
            Some((known, _)) => next.max(known + MARGIN),
            None => next.min(found.refused - MARGIN),
        };
    }
    if found.best.is_none() && allowance.is_of_bytes() {
        let mut leap = FARTHEST;
        for _ in 0..ATTEMPTS {
            let at = match &found.best {
                Some((known, _)) => 0.5 * (known + found.refused),
                None if leap > LARGEST_LEAP => break,
                None => found.refused - leap,
            };
            leap *= 2.0;
            attempts += 1;
            let tried = tried_at(at)?;
            if tried.allowed() && tried.share >= good {
                return Ok(tried);
            }
            found.add(at, tried);
        }
    }
    let ended = Some(attempts).filter(|_| found.refused.is_finite() || !allowance.is_of_bytes());
    match found.best.map(|(_, tried)| tried).or(found.least) {
        Some(tried) => Ok(Tried { ended, ..tried }),
        None => Err(Error::backend("codec compact", "no step factor was tried", "Report this")),
    }
}
