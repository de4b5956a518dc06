//! Numerical stress: float32 kernels against float64 over conditions that break floating point.
//!
//! Each condition is tried at one or more levels (an offset of 1e2, 1e3, … units). A result *behaves* if every number is finite, or if the call returns an
//! error; it must not panic. Some cases of every part are ordinary (*required*): there an error does not behave, so that a device that fails at everything
//! fails this test. Where a float64 oracle exists, the error is the 95th percentile of the absolute differences over the largest absolute value of the oracle,
//! so that a pixel at which a comparison fell the other way does not hide the digits of the others; the share of values that differ by more than 1 % is stated
//! beside it. The *limit* of a condition is the first level at which the error is over 1 %. An error never fails a case: that float32 cannot hold coordinates
//! of 1e6 (`moved scene …`) is a limit to know, not a defect of the device.

mod exact;
mod raster;
mod scenes;
mod weights;

use burn::tensor::Device;
use cc4dgs_core::{Registry, Result};
use serde::Serialize;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// An error above this counts as the limit of a kernel: 1 % of the largest value.
pub const LIMIT: f64 = 0.01;

/// What to run.
pub struct StressJob<'a> {
    /// The linked plug-ins.
    pub registry: &'a Registry,
    /// The device under test.
    pub device: &'a Device,
    /// The device of the oracle: one for processors.
    pub host: &'a Device,
    /// Whether the two have kernels of their own. If they share kernels, a comparison shows no error, and parts without float64 have no oracle.
    pub other_kernels: bool,
    /// Name of the rasterizer under test.
    pub rasterizer: &'a str,
    /// Name of the rasterizer that computes in float64 on the host.
    pub oracle: &'a str,
    /// Name of the optimizer.
    pub optimizer: &'a str,
    /// Steps of each run of the optimizer: under constant, vanishing and tiny gradients.
    pub steps: usize,
    /// Levels of each condition of a deformer; fewer where every level costs much (kernels of a software adapter).
    pub deformer_levels: usize,
}

/// A condition at one level.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StressCase {
    /// The part under test: rasterizer, gradients, a deformer, the optimizer, a weight codec, a loss term.
    pub part: String,
    /// The condition.
    pub condition: String,
    /// Its level.
    pub level: String,
    /// What it was compared with: `float64`, `float32 on the host` for parts of other devices without an oracle of their own, [`NO_ORACLE`] where there is
    /// none; absent where there were no values.
    pub oracle: Option<String>,
    /// 95th percentile of the error, relative to the oracle's largest value; absent without an oracle or without numbers.
    pub error: Option<f64>,
    /// Share of the values that differ by more than 1 % of the oracle's largest.
    pub outliers: Option<f64>,
    /// Whether the case is ordinary, so that an error does not behave.
    pub required: bool,
    /// Whether every number was finite, or the call of a case that is not required returned an error.
    pub behaves: bool,
    /// `finite`, `infinite as the exact value`, the error's text, or what went wrong.
    pub outcome: String,
}

impl StressCase {
    /// The same as a required case, if it is `ordinary`.
    fn required_if(self, ordinary: bool) -> Self {
        let refused = ordinary && self.outcome.starts_with(ERROR);
        Self { required: ordinary, behaves: self.behaves && !refused, ..self }
    }
}

/// All cases of a run.
#[derive(Clone, Debug, Serialize)]
pub struct StressReport {
    /// In the order in which they ran.
    pub cases: Vec<StressCase>,
}

impl StressReport {
    /// Cases that do not behave.
    pub fn failures(&self) -> impl Iterator<Item = &StressCase> {
        self.cases.iter().filter(|case| !case.behaves)
    }
    /// The first level of each (part, condition) with an oracle at which the error is over [`LIMIT`]; `None` where there is no such level.
    pub fn limits(&self) -> Vec<(&str, &str, Option<&str>)> {
        let mut limits: Vec<(&str, &str, Option<&str>)> = Vec::new();
        for case in &self.cases {
            let Some(error) = case.error else { continue };
            let over = (error.is_nan() || error > LIMIT).then_some(case.level.as_str());
            match limits.iter_mut().find(|(part, condition, _)| *part == case.part && *condition == case.condition) {
                Some((_, _, limit)) => *limit = limit.or(over),
                None => limits.push((&case.part, &case.condition, over)),
            }
        }
        limits
    }
}

/// Runs all conditions. `progress` is told each case as it ends.
///
/// # Errors
/// Names that the registry does not know. What a condition does is a case of the report, never an error.
pub fn stress(job: &StressJob, progress: &mut dyn FnMut(&StressCase)) -> Result<StressReport> {
    let mut report = StressReport { cases: Vec::new() };
    let mut note = |case: StressCase| {
        progress(&case);
        report.cases.push(case);
    };
    raster::run(job, &mut note)?;
    weights::run(job, &mut note)?;
    Ok(report)
}

/// In place of an oracle's name: the values were looked at, not compared.
pub const NO_ORACLE: &str = "no oracle";
/// How the outcome of a call that returned an error begins.
const ERROR: &str = "error";
/// Name of oracles that compute in float64.
const FLOAT64: &str = "float64";

/// Values under test, and those of an oracle if there is one, with its name.
type Compared = (Vec<f32>, Option<(&'static str, Vec<f32>)>);

/// Runs `work` and judges its values.
fn case(part: &str, condition: &str, level: impl Into<String>, work: impl FnOnce() -> Result<Compared>) -> StressCase {
    let empty = StressCase {
        part: part.into(),
        condition: condition.into(),
        level: level.into(),
        oracle: None,
        error: None,
        outliers: None,
        required: false,
        behaves: true,
        outcome: String::new(),
    };
    match catch_unwind(AssertUnwindSafe(work)) {
        Err(_) => StressCase { behaves: false, outcome: "it panics".into(), ..empty },
        Ok(Err(e)) => StressCase { outcome: format!("{ERROR}: {e}"), ..empty },
        Ok(Ok((found, None))) => judge(StressCase { oracle: Some(NO_ORACLE.into()), ..empty }, &found, None),
        Ok(Ok((found, Some((name, exact))))) => judge(StressCase { oracle: Some(name.into()), ..empty }, &found, Some(&exact)),
    }
}

fn judge(case: StressCase, found: &[f32], oracle: Option<&[f32]>) -> StressCase {
    let broken = |value: f32, exact: Option<&f32>| !value.is_finite() && exact.is_none_or(|exact| exact.is_finite());
    if oracle.is_some_and(|oracle| oracle.len() != found.len()) {
        return StressCase { behaves: false, outcome: "it has another number of values than the oracle".into(), ..case };
    }
    let wrong = found.iter().enumerate().filter(|(i, v)| broken(**v, oracle.and_then(|o| o.get(*i)))).count();
    if wrong > 0 {
        return StressCase { behaves: false, outcome: format!("{wrong} of {} values are not finite", found.len()), ..case };
    }
    let Some(oracle) = oracle else {
        return StressCase { outcome: "finite".into(), ..case };
    };
    let largest = oracle.iter().filter(|v| v.is_finite()).fold(0.0f64, |a, v| a.max(f64::from(v.abs())));
    let scale = if largest > 0.0 { largest } else { 1.0 };
    let mut errors: Vec<f64> =
        found.iter().zip(oracle).filter(|(a, b)| a.is_finite() && b.is_finite()).map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs() / scale).collect();
    errors.sort_unstable_by(f64::total_cmp);
    let outcome = if errors.len() == found.len() { "finite" } else { "infinite as the exact value" };
    let (error, outliers) = match errors.len() {
        0 => (None, None),
        n => (Some(errors[(n - 1) * 95 / 100]), Some(errors.iter().filter(|e| **e > LIMIT).count() as f64 / n as f64)),
    };
    StressCase { error, outliers, outcome: outcome.into(), ..case }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::Error;

    #[test]
    fn results_are_judged() {
        let judged = |work: fn() -> Result<Compared>| case("p", "c", "l", work);
        let good = judged(|| Ok((vec![1.0, 2.0, 4.04], Some((FLOAT64, vec![1.0, 2.0, 4.0])))));
        assert!(good.behaves && (good.error.unwrap() - 0.0).abs() < 1e-9, "{good:?}");
        assert!((good.outliers.unwrap() - 1.0 / 3.0).abs() < 1e-9 || good.outliers == Some(0.0), "{good:?}");
        assert!(!judged(|| Ok((vec![f32::NAN], None))).behaves);
        let alone = judged(|| Ok((vec![1.0], None)));
        assert!(alone.behaves && alone.oracle.as_deref() == Some(NO_ORACLE) && alone.error.is_none(), "{alone:?}");
        assert!(!judged(|| Ok((vec![f32::INFINITY], Some((FLOAT64, vec![1.0]))))).behaves);
        assert!(judged(|| Ok((vec![f32::INFINITY], Some((FLOAT64, vec![f32::INFINITY]))))).behaves);
        assert!(judged(|| Err(Error::data("x", "y", "z"))).behaves);
        assert!(!judged(|| panic!("on purpose")).behaves);
        assert!(!judged(|| Ok((vec![1.0], Some((FLOAT64, Vec::new()))))).behaves);
    }

    #[test]
    fn a_device_that_fails_at_everything_does_not_pass() {
        let fails = |condition: &str| case("p", condition, "l", || Err(Error::backend("device", "it is lost", "Restart it")));
        let hard = || fails("hard").required_if(false);
        assert!(hard().behaves && !hard().required);
        let report = StressReport { cases: vec![hard(), fails("ordinary").required_if(true)] };
        let failures: Vec<_> = report.failures().collect();
        assert!(failures.len() == 1 && failures[0].condition == "ordinary" && failures[0].required, "{failures:?}");
        assert!(failures[0].outcome.contains("it is lost"));
        let works = case("p", "ordinary", "l", || Ok((vec![1.0], None))).required_if(true);
        assert!(works.behaves && works.required);
        assert!(!case("p", "ordinary", "l", || Ok((vec![f32::NAN], None))).required_if(true).behaves);
    }

    #[test]
    fn the_first_level_over_the_limit_is_found() {
        let at = |level: &str, error| StressCase { error: Some(error), ..case("p", "c", level, || Ok((vec![0.0], None))) };
        let report = StressReport { cases: vec![at("1e2", 1e-5), at("1e3", 0.02), at("1e4", 0.5)] };
        assert_eq!(report.limits(), [("p", "c", Some("1e3"))]);
    }
}
