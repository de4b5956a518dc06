//! Whether the poses can be right: neighbouring cameras must see common content where their poses say.
//!
//! The measure calibrates itself: corners are looked for on their epipolar line and on four parallel lines (`matching`). With wrong poses, a fifth of the best
//! matches lie on the true line. Measured on a PanopticSports scene (27 cameras), a D-NeRF scene, 50 casual photos, an N3DV scene (5 cameras) and two rings of
//! the built-in scene (12 and 24 cameras, a chequered floor):
//!
//! | poses | matches on the true line | pairs that do not fit |
//! | --- | --- | --- |
//! | correct | 47 to 87 % | 0 to 8 % |
//! | every other camera scaled by 2 about the origin | 23 to 60 % | 33 to 73 % |
//! | the first half of the cameras scaled by 2 | 45 to 80 % | 10 to 36 % |
//! | shuffled | 21 to 34 % | 58 to 73 % |
//! | facing away | 20 to 30 % | 67 to 100 % |
//!
//! Focal lengths off by 30 % cost 5 to 24 points; where an object fills a small part of a turning camera's images, nothing.

mod matching;
mod neighbours;

use super::{Finding, Severity, Subject, listed};
use crate::sample::spread;
use cc4dgs_core::{Result, Scene, Split, plural};
use glam::DVec3;
use matching::{Look, Tally};
use neighbours::{Stand, neighbours};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

/// The most images that are compared with their neighbours.
const ANCHORS: usize = 24;
/// Neighbours of each that suit best in pose and time, and those that suit best in pose alone.
const NEIGHBOURS: [usize; 2] = [2, 1];
/// Fewer training cameras at one instant are too few to do without other instants.
const SHARED_TIME: usize = 3;
/// Distance of the median camera from what it looks at, in the normalised frame.
const DISTANCE: f64 = 4.0;
/// Nearest depth that is looked at, as a share of the depth a camera looks at.
const NEAR: f64 = 0.15;
/// Images with fewer corners say nothing.
const LEAST_CORNERS: u32 = 10;
/// Pairs with fewer matches say nothing, and neither does a scene with fewer.
const LEAST_MATCHES: u32 = 6;
const LEAST_PAIRS: usize = 4;
const LEAST_ALL_MATCHES: u32 = 60;
/// Share of the matches on the true line from which a pair fits, and from which a scene cannot be all wrong.
const FITS: f64 = 0.3;
const ALL_WRONG: f64 = 0.36;
/// Share of a pair's corners whose line must cross the other image.
const SEEN: f64 = 0.4;
/// Share of misfitting pairs from which poses are in doubt, from which a part of them is refused, and from which all are.
const DOUBT: f64 = 0.12;
const REFUSE_PART: f64 = 0.3;
const REFUSE_ALL: f64 = 0.5;
/// Pairs that are needed to refuse a part.
const LEAST_PAIRS_OF_PART: usize = 20;
/// Other focal lengths that are tried, as factors, and the most pairs they are tried on.
const FOCALS: [f64; 2] = [0.75, 1.33];
const FOCAL_PAIRS: usize = 36;
/// Mean gain of a pair's share from which another focal length is right, and that gain over its standard error. Measured: gains of 0.10 to 0.29 and ratios of
/// 2.4 to 10 for focal lengths that are off by 30 %, at most 0.01 and 1.1 for correct ones.
const BETTER: f64 = 0.05;
const BETTER_ERRORS: f64 = 3.0;

/// Two images and how well they fit, by index into the compared views.
struct Pair {
    from: usize,
    to: usize,
    tally: Tally,
}

impl Pair {
    /// Whether the pair fits; `None` without texture.
    fn fits(&self) -> Option<bool> {
        if self.tally.corners < LEAST_CORNERS {
            return None;
        }
        // Images that do not overlap at any depth do not fit either: neighbours are chosen to overlap.
        let overlap = f64::from(self.tally.seen) >= SEEN * f64::from(self.tally.corners);
        match (overlap, self.tally.matches() >= LEAST_MATCHES) {
            (false, _) => Some(false),
            (true, true) => Some(self.tally.share() >= FITS),
            (true, false) => None,
        }
    }
}

/// The comparison of the neighbours of a scene.
struct Comparison {
    /// Views of the scene.
    views: Vec<usize>,
    stands: Vec<Stand>,
    looks: BTreeMap<usize, Look>,
    pairs: Vec<Pair>,
}

/// The finding about poses and focal lengths.
pub(super) fn check(scene: &Scene, background: [f32; 3]) -> Result<Vec<Finding>> {
    let compared = Comparison::new(scene, background)?;
    Ok(compared.misfit(scene).into_iter().collect())
}

impl Comparison {
    fn new(scene: &Scene, background: [f32; 3]) -> Result<Self> {
        let views = comparable_views(scene);
        let stands: Vec<Stand> = views
            .iter()
            .map(|&view| {
                let camera = scene.camera(view);
                let time = f64::from(scene.views[view].time_norm);
                Stand::new(DVec3::from(camera.center_world()), DVec3::from(camera.forward_world()), time, DISTANCE)
            })
            .collect();
        let timeless: Vec<Stand> = stands.iter().map(|stand| Stand { time: 0.0, ..*stand }).collect();
        let anchors = spread(&(0..views.len()).collect::<Vec<_>>(), ANCHORS);
        let mut pairs: Vec<(usize, usize)> = Vec::new();
        for &from in &anchors {
            let [timely, other] = NEIGHBOURS;
            let mut chosen = neighbours(&stands, from, timely);
            let extra = neighbours(&timeless, from, timely + other).into_iter().find(|to| !chosen.contains(to));
            chosen.extend(extra);
            pairs.extend(chosen.into_iter().map(|to| (from, to)));
        }
        let used: BTreeSet<usize> = pairs.iter().flat_map(|&(from, to)| [from, to]).collect();
        let used: Vec<usize> = used.into_iter().collect();
        let looks: BTreeMap<usize, Look> = used
            .par_iter()
            .map(|&index| Ok((index, Look::new(&*scene.frame(views[index])?, scene.camera(views[index]), background))))
            .collect::<Result<_>>()?;
        let mut compared = Self { views, stands, looks, pairs: Vec::new() };
        compared.pairs = pairs.par_iter().map(|&(from, to)| Pair { from, to, tally: compared.tally(from, to, 1.0) }).collect();
        Ok(compared)
    }
    fn tally(&self, from: usize, to: usize, focal_factor: f64) -> Tally {
        match (self.looks.get(&from), self.looks.get(&to)) {
            (Some(a), Some(b)) => a.compare(b, NEAR * self.stands[from].depth, focal_factor),
            _ => Tally::default(),
        }
    }
    /// Poses that do not fit, all or some.
    fn misfit(&self, scene: &Scene) -> Option<Finding> {
        let judged: Vec<(&Pair, bool)> = self.pairs.iter().filter_map(|pair| Some((pair, pair.fits()?))).collect();
        if judged.len() < LEAST_PAIRS {
            return None;
        }
        let mut all = Tally::default();
        judged.iter().for_each(|(pair, _)| all.add(&pair.tally));
        let misfits = judged.iter().filter(|(_, fits)| !fits).count();
        let share = misfits as f64 / judged.len() as f64;
        // Without matches there must at least be many pairs that do not overlap.
        if all.matches() < LEAST_ALL_MATCHES && share < REFUSE_ALL {
            return None;
        }
        let found = format!(
            "{misfits} of {} pairs of neighbouring cameras {} common content where their poses say ({:.0} % of the matches lie on epipolar lines, chance is 20 %)",
            judged.len(),
            plural(misfits, "does not see", "do not see"),
            100.0 * all.share()
        );
        if share >= REFUSE_ALL && all.share() < ALL_WRONG {
            let problem = format!("{found}: the poses are shuffled, wrong, or of another convention of axes");
            let remedy = "Check that each pose belongs to its image, the axes (OpenGL or OpenCV), and camera-to-world or world-to-camera";
            return Some(Finding::refuse(Subject::Poses, problem, remedy));
        }
        if let Some(finding) = self.focal_length() {
            return Some(finding);
        }
        let outliers = self.outliers(&judged);
        let rest: Vec<bool> = judged.iter().filter(|(pair, _)| !outliers.contains(&pair.from) && !outliers.contains(&pair.to)).map(|j| j.1).collect();
        let rest_fits = rest.iter().filter(|fits| !**fits).count() as f64 <= DOUBT * rest.len() as f64;
        if !outliers.is_empty() && outliers.len() * 3 <= self.looks.len() && rest_fits {
            let names: Vec<String> = outliers.iter().map(|&index| scene.camera(self.views[index]).name.clone()).collect();
            let problem = match names.as_slice() {
                [name] => format!("the pose of the camera {name} does not fit those of its neighbours"),
                _ => format!("the poses of {} cameras do not fit those of their neighbours: {}", names.len(), listed(&names)),
            };
            let remedy = plural(names.len(), "Correct this pose or leave the image out", "Correct these poses or leave the images out");
            return Some(Finding::doubt(Subject::Poses, problem, remedy));
        }
        let severity = if share >= REFUSE_PART && judged.len() >= LEAST_PAIRS_OF_PART { Severity::Refuse } else { Severity::Doubt };
        let problem = format!("{found}: a part of the cameras has other units, another origin or wrong poses");
        (share >= DOUBT).then(|| Finding::new(severity, Subject::Poses, problem, "Check that all poses come from one reconstruction, in one unit"))
    }
    /// Images of which at least two pairs do not fit, and at most a quarter does: two wrong poses fit by chance at times.
    fn outliers(&self, judged: &[(&Pair, bool)]) -> Vec<usize> {
        let mut votes: BTreeMap<usize, [u32; 2]> = BTreeMap::new();
        for (pair, fits) in judged {
            for index in [pair.from, pair.to] {
                votes.entry(index).or_default()[usize::from(*fits)] += 1;
            }
        }
        votes.into_iter().filter(|(_, [against, in_favour])| *against >= 2 && *against >= 3 * *in_favour).map(|(index, _)| index).collect()
    }
    /// A focal length that fits clearly better, pair by pair.
    fn focal_length(&self) -> Option<Finding> {
        let chosen: Vec<&Pair> = spread(&(0..self.pairs.len()).collect::<Vec<_>>(), FOCAL_PAIRS).into_iter().map(|index| &self.pairs[index]).collect();
        let n = chosen.len() as f64;
        let gains = |factor: f64| -> (f64, f64) {
            let gains: Vec<f64> = chosen.par_iter().map(|pair| self.tally(pair.from, pair.to, factor).share() - pair.tally.share()).collect();
            let mean = gains.iter().sum::<f64>() / n;
            let variance = gains.iter().map(|gain| (gain - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
            (mean, (variance / n).sqrt())
        };
        let (factor, gain, error) =
            FOCALS.into_iter().map(|factor| (factor, gains(factor))).map(|(f, (gain, error))| (f, gain, error)).max_by(|a, b| a.1.total_cmp(&b.1))?;
        if chosen.len() < LEAST_PAIRS || gain < BETTER.max(BETTER_ERRORS * error) {
            return None;
        }
        let problem =
            format!("focal lengths times about {factor} fit better: {:.0} % more of the matches of neighbouring cameras lie on epipolar lines", 100.0 * gain);
        Some(Finding::refuse(Subject::Poses, problem, "Check the focal lengths, and that they belong to the size of these images"))
    }
}

/// Training views of one instant where some instant has several, else all of them.
fn comparable_views(scene: &Scene) -> Vec<usize> {
    let train = scene.split(Split::Train);
    let mut of_frame: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for &view in &train {
        of_frame.entry(scene.views[view].frame).or_default().push(view);
    }
    let most = of_frame.values().map(Vec::len).max().unwrap_or(0);
    match of_frame.into_values().find(|views| views.len() == most && most >= SHARED_TIME) {
        Some(views) => views,
        None => train,
    }
}
