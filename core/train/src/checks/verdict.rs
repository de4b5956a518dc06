//! How a training went, in words.

use super::{Baselines, Finding};
use serde::{Deserialize, Serialize};

/// A training score this much over that of the validation views is over-fitting, dB.
const GAP_DB: f64 = 4.0;
/// Training views that gain more than this over the last 15 % of the main stage are not done, dB.
const STILL_RISING_DB: f64 = 0.4;
/// Share of the truth's detail (mean slope) below which a model at its cap of Gaussians has too few.
const DETAIL: f64 = 0.7;
/// Share of the cap from which a model counts as being at it.
const AT_CAP: f64 = 0.95;

/// The outcome of a training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Judgement {
    /// Nothing speaks against the model.
    Good,
    /// The score was still rising at the end.
    UnderTrained,
    /// Training views are drawn much better than validation views.
    OverFitted,
    /// At the cap of Gaussians, and detail is missing.
    TooFewGaussians,
    /// Better than the baselines, but the scene looked wrong before training: poses, times or images.
    Doubtful,
}

/// What a training reached. PSNR in dB, means over views, images not rounded.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Verdict {
    /// In a word.
    pub judgement: Judgement,
    /// In a sentence, with the numbers.
    pub sentence: String,
    /// PSNR of at most 24 training views.
    pub train_psnr_db: f64,
    /// PSNR of at most as many views as `train.validation` states, of those that it kept out of training; where it is 0, of at most 24 views that the reader
    /// has for validation.
    pub validation_psnr_db: Option<f64>,
    /// PSNR of the moving pixels of training views of fixed cameras.
    pub moving_psnr_db: Option<f64>,
    /// What can be had without a model on the same views.
    pub baselines: Baselines,
}

/// What a verdict is made of.
pub(super) struct Evidence<'a> {
    pub train_psnr_db: f64,
    /// The same at 85 % of the main stage, where it was measured.
    pub late_psnr_db: Option<f64>,
    pub validation_psnr_db: Option<f64>,
    pub moving_psnr_db: Option<f64>,
    /// Mean slope of the drawn views over that of the true ones.
    pub detail: f64,
    pub gaussians: usize,
    /// The most Gaussians that density control allows, if it says.
    pub cap: Option<usize>,
    pub baselines: Baselines,
    pub doubts: &'a [Finding],
    /// What the reader said of data that was ignored.
    pub warnings: &'a [String],
}

impl Evidence<'_> {
    /// The verdict of a run that did not fail.
    pub fn verdict(&self) -> Verdict {
        let (judgement, words) = self.judge();
        let mut numbers = format!("training views {:.1} dB", self.train_psnr_db);
        if let Some(validation) = self.validation_psnr_db {
            numbers += &format!(", validation views {validation:.1} dB");
        }
        let reader = match self.warnings.first() {
            Some(warning) if judgement != Judgement::Good => format!(". The reader warned: {warning}"),
            _ => String::new(),
        };
        let b = &self.baselines;
        numbers += &format!(" (the mean colour of each image: {:.1} dB, images blurred 16 times: {:.1} dB", b.mean_colour_db, b.blur_db);
        if let (Some(moving), Some(mean_image)) = (self.moving_psnr_db, b.mean_image_db) {
            numbers += &format!("; moving pixels {moving:.1} dB, of the mean image {mean_image:.1} dB");
        }
        Verdict {
            judgement,
            sentence: format!("{words}: {numbers}){reader}"),
            train_psnr_db: self.train_psnr_db,
            validation_psnr_db: self.validation_psnr_db,
            moving_psnr_db: self.moving_psnr_db,
            baselines: self.baselines,
        }
    }
    fn judge(&self) -> (Judgement, String) {
        if let Some(doubt) = self.doubts.first() {
            return (Judgement::Doubtful, format!("doubtful, because {}", doubt.problem));
        }
        if let Some(validation) = self.validation_psnr_db.filter(|v| self.train_psnr_db - v > GAP_DB) {
            let gap = self.train_psnr_db - validation;
            return (Judgement::OverFitted, format!("over-fitted by {gap:.1} dB; fewer Gaussians or iterations, or more images, help"));
        }
        if let Some(gain) = self.late_psnr_db.map(|late| self.train_psnr_db - late).filter(|gain| *gain > STILL_RISING_DB) {
            return (Judgement::UnderTrained, format!("under-trained, the last 15 % of the main stage still gained {gain:.1} dB; more iterations help"));
        }
        match self.cap {
            Some(cap) if self.gaussians as f64 >= AT_CAP * cap as f64 && self.detail < DETAIL => {
                let words = format!("too few Gaussians, {} of at most {cap} and {:.0} % of the detail; raise the cap", self.gaussians, 100.0 * self.detail);
                (Judgement::TooFewGaussians, words)
            }
            _ => (Judgement::Good, "good".into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Subject;
    use super::*;

    #[test]
    fn each_judgement_has_its_evidence() {
        let baselines = Baselines { mean_colour_db: 12.0, blur_db: 20.0, mean_image_db: Some(18.0) };
        let good = || Evidence {
            train_psnr_db: 30.0,
            late_psnr_db: Some(29.9),
            validation_psnr_db: Some(28.0),
            moving_psnr_db: Some(24.0),
            detail: 0.9,
            gaussians: 1000,
            cap: Some(1000),
            baselines,
            doubts: &[],
            warnings: &[],
        };
        let doubts = [Finding::doubt(Subject::Poses, "the poses of a, b do not fit", "x")];
        let cases = [
            (good(), Judgement::Good, "good: training views 30.0 dB, validation views 28.0 dB"),
            (Evidence { late_psnr_db: Some(29.0), ..good() }, Judgement::UnderTrained, "1.0 dB; more iterations"),
            (Evidence { validation_psnr_db: Some(25.0), ..good() }, Judgement::OverFitted, "over-fitted by 5.0 dB"),
            (Evidence { detail: 0.5, ..good() }, Judgement::TooFewGaussians, "1000 of at most 1000 and 50 %"),
            (Evidence { doubts: &doubts, ..good() }, Judgement::Doubtful, "the poses of a, b do not fit"),
        ];
        for (evidence, judgement, words) in cases {
            let verdict = evidence.verdict();
            assert!(verdict.judgement == judgement && verdict.sentence.contains(words), "{verdict:?}");
        }
    }
}
