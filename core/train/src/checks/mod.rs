//! Checks that make a run which cannot work, or did not work, say so.
//!
//! Before training, [`check_scene`] looks at images, cameras, times and poses: what cannot be reconstructed is refused, what looks wrong is a doubt. During
//! the main stage a `Watch` compares the model with baselines that cost nothing; a run that stays below them fails, and stops at 85 % of the stage. At the
//! end a run fails that is far below its own earlier scores, and a [`Verdict`] says in words how the others went.

mod baselines;
mod cameras;
mod images;
mod poses;
mod rules;
mod times;
mod verdict;
mod watch;

pub use baselines::Baselines;
pub use verdict::{Judgement, Verdict};
pub(crate) use watch::Watch;

use crate::data::resample::resize;
use cc4dgs_core::{Error, Event, EventSink, Image8, Result, Scene};

/// How bad a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Severity {
    /// Training may give a bad model: a warning, remembered for the verdict.
    Doubt,
    /// Training cannot give a model.
    Refuse,
}

/// What a finding is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Subject {
    /// What the images show.
    Images,
    /// The number and the positions of the cameras.
    Cameras,
    /// The times of the images.
    Times,
    /// Positions, directions and focal lengths.
    Poses,
}

/// Something wrong with a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Finding {
    /// How bad it is.
    pub severity: Severity,
    /// What it is about.
    pub subject: Subject,
    /// What was measured, and what it probably means.
    pub problem: String,
    /// What to try.
    pub remedy: String,
}

impl Finding {
    fn new(severity: Severity, subject: Subject, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { severity, subject, problem: problem.into(), remedy: remedy.into() }
    }
    fn doubt(subject: Subject, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::new(Severity::Doubt, subject, problem, remedy)
    }
    fn refuse(subject: Subject, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::new(Severity::Refuse, subject, problem, remedy)
    }
}

/// All findings about the training views of `scene`, those about images first. `background` is the colour behind transparent images, RGB in 0..1.
///
/// Takes a few seconds at most: it looks at samples of the images, at small sizes. Deterministic.
///
/// # Errors
/// What reading the images reports.
pub fn check_scene(scene: &Scene, background: [f32; 3]) -> Result<Vec<Finding>> {
    let mut findings = images::check(scene, background)?;
    findings.extend(cameras::check(scene));
    findings.extend(times::check(scene, background)?);
    // Without content or parallax there is nothing to compare.
    if findings.iter().all(|f| f.severity == Severity::Doubt) {
        findings.extend(poses::check(scene, background)?);
    }
    Ok(findings)
}

/// Checks `scene` before training: emits doubts as warnings and returns them.
///
/// # Errors
/// [`Error::Data`] for a scene that cannot be reconstructed, and what reading the images reports.
pub(crate) fn examine(scene: &Scene, background: [f32; 3], events: &dyn EventSink) -> Result<Vec<Finding>> {
    let findings = check_scene(scene, background)?;
    for Finding { problem, remedy, .. } in findings.iter().filter(|f| f.severity == Severity::Doubt) {
        events.emit(&Event::Warning { object: scene.name.clone(), message: format!("{problem}. {remedy}") });
    }
    match findings.iter().find(|f| f.severity == Severity::Refuse) {
        Some(Finding { problem, remedy, .. }) => {
            Err(Error::data(format!("scene {}", scene.name), problem.clone(), format!("{remedy}; train.checks = false trains all the same")))
        }
        None => Ok(findings),
    }
}

/// Width, height and grey values in 0..1 of `image` at about `pixels` pixels, row by row; alpha is composited over `background`.
fn small_gray(image: &Image8, pixels: f64, background: [f32; 3]) -> (u32, u32, Vec<f32>) {
    let scale = (pixels / (f64::from(image.width) * f64::from(image.height))).sqrt().min(1.0);
    let size = |n: u32| ((f64::from(n) * scale).round() as u32).max(1);
    let small = resize(image, size(image.width), size(image.height));
    let planes = small.to_planes(background);
    let n = planes.len() / 3;
    (small.width, small.height, (0..n).map(|p| (planes[p] + planes[n + p] + planes[2 * n + p]) / 3.0).collect())
}

/// Up to four names, and how many more there are.
fn listed(names: &[String]) -> String {
    let more = if names.len() > 4 { format!(" and {} more", names.len() - 4) } else { String::new() };
    format!("{}{more}", names[..names.len().min(4)].join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_are_short() {
        let names: Vec<String> = (0..6).map(|i| i.to_string()).collect();
        assert_eq!((listed(&names), listed(&names[..2])), ("0, 1, 2, 3 and 2 more".into(), "0, 1".into()));
    }
}
