//! Rounds, restores and codes Gaussians for a quality, as often as the search for the quality needs it.

use super::LOSSES;
use super::columns::Columns;
use super::encode::{Integers, Parts};
use super::joint::Directions;
use super::plan::{Bounds, Factors, Plan, Planner};
use super::restore::{losses, restored};
use super::write::{self, Motion};
use cc4dgs_format::{Error, HostGaussians, Result, Stream};
use rayon::prelude::*;
use std::cell::Cell;

/// Reductions of a column's largest step until its loss is allowed; then the whole column is stored exactly.
const REDUCTIONS: usize = 12;
/// The share of the declared loss that a smaller step aims at, and by how much steps become smaller at a time: errors grow in proportion to steps where these
/// are small.
const LOSS_AIM: f64 = 0.9;
const SMALLER: std::ops::RangeInclusive<f64> = 0.02..=0.5;

/// What does not change from one attempt to the next.
pub struct Job<'a> {
    /// Of the Gaussians to encode.
    pub planner: Planner<'a>,
    pub free: Vec<bool>,
    /// The directions from which Gaussians are seen, if colours are rounded together.
    pub directions: Option<&'a Directions>,
    /// The layer of each Gaussian, and how many each layer has.
    pub layers: (Vec<u8>, Vec<usize>),
    pub motion: Motion,
    /// Of the columns, to start with.
    pub factors: Factors,
    /// Whether colours are rounded together. False for all later attempts once this has exceeded the declared loss, so that attempts can be compared.
    pub joint: Cell<bool>,
}

#[cfg(test)]
thread_local! {
    /// How often this thread has quantised the Gaussians of a [`Job`], and how often it has coded them.
    pub static QUANTISED: Cell<usize> = const { Cell::new(0) };
    pub static CODED: Cell<usize> = const { Cell::new(0) };
}

/// How Gaussians are rounded in the steps of a quality.
pub struct Attempt {
    pub quality: f64,
    /// Of the columns.
    factors: Factors,
    /// Value of [`Job::joint`] when the attempt began.
    joint: bool,
    pub plan: Plan,
}

impl Job<'_> {
    /// Rounds the Gaussians to encode; with what they will be decoded to ([`Job::restored`]).
    pub fn attempt(&self, quality: f64) -> Result<(Attempt, HostGaussians)> {
        let gaussians = self.planner.gaussians;
        self.attempt_with(&self.planner, quality, &self.factors, |of| Ok(restored(&of, gaussians, Some(&self.order(&of)))))
    }
    /// Rounds the Gaussians of `planner` and codes them.
    pub fn coded(&self, planner: &Planner, quality: f64, factors: &Factors) -> Result<(Attempt, Vec<Stream>)> {
        self.attempt_with(planner, quality, factors, |of| {
            let order = self.order(&of);
            self.write(planner.gaussians, of, &order)
        })
    }
    /// Rounds the Gaussians to encode and codes them; with what they will be decoded to.
    pub fn coded_and_restored(&self, quality: f64, factors: &Factors) -> Result<(Vec<Stream>, HostGaussians)> {
        let gaussians = self.planner.gaussians;
        Ok(self.attempt_with(&self.planner, quality, factors, |of| self.written_and_restored(gaussians, of))?.1)
    }
    /// Rounds the Gaussians of `planner` in steps that keep the declared loss; `work` gets their integers.
    fn attempt_with<T>(&self, planner: &Planner, quality: f64, factors: &Factors, work: impl FnOnce(Integers) -> Result<T>) -> Result<(Attempt, T)> {
        let joint = self.joint.get();
        let (mut bounds, mut before, mut lost) = (Bounds { joint, ..Bounds::NONE }, None::<(Plan, Parts)>, Vec::<f64>::new());
        // Besides the reductions: colours may change to independent rounding, and each column may end up stored exactly.
        for reductions in 0..REDUCTIONS + 2 + factors.len() {
            let plan = planner.plan(quality, factors, &bounds);
            // Columns that keep their codes keep their losses.
            let keeps = before.as_ref().map(|(before, _)| (plan.keeps_shapes(before), plan.keeps_colors(before, self.directions)));
            let (shapes, colors) = keeps.unwrap_or_default();
            let known = |column: usize| match column {
                4 => colors.first() == Some(&true),
                5 => colors.len() > 1 && !colors[1..].contains(&false),
                _ => shapes[column],
            };
            let known = std::array::from_fn(|column| lost.get(column).copied().filter(|_| known(column)));
            let of = self.quantise(planner.gaussians, &plan, before.take());
            let (together, mut kept) = (bounds.joint && self.directions.is_some(), true);
            lost = losses(&of, planner.gaussians, &planner.losses, known);
            for ((&(name, allowed), &lost), factor) in LOSSES.iter().zip(&lost).zip(&mut bounds.largest) {
                // A small part of it is left for what rounding adds.
                if lost.is_nan() || lost > 0.999 * allowed {
                    kept = false;
                    if together && name.starts_with("sh_") {
                        bounds.joint = false;
                        self.joint.set(false);
                        continue;
                    }
                    let smaller = (LOSS_AIM * allowed / lost).clamp(*SMALLER.start(), *SMALLER.end());
                    *factor *= if reductions < REDUCTIONS && lost.is_finite() { smaller } else { 0.0 };
                }
            }
            if kept {
                let found = work(of)?;
                return Ok((Attempt { quality, factors: *factors, joint, plan }, found));
            }
            // Most columns keep their steps.
            let parts = of.into_parts();
            before = Some((plan, parts));
        }
        Err(Error::backend("codec compact", "no step keeps the declared loss", "Report this"))
    }
    /// Whether another attempt with this quality and these factors would give the same as `attempt`, which is one of the Gaussians to encode.
    pub fn repeats(&self, attempt: &Attempt, quality: f64, factors: &Factors) -> bool {
        attempt.quality == quality && attempt.factors == *factors && attempt.joint == self.joint.get()
    }
    /// The integers of canonical Gaussians; `before` are those with another plan of the same planner.
    pub fn quantise<'a>(&'a self, gaussians: Columns, plan: &'a Plan, mut before: Option<(Plan, Parts)>) -> Integers<'a> {
        #[cfg(test)]
        QUANTISED.set(QUANTISED.get() + 1);
        let known = before.as_mut().map(|(other, parts)| (&*other, std::mem::take(&mut parts.colors)));
        let colors = plan.color_codes(gaussians, self.planner.classes, self.directions, known);
        plan.quantise_after(gaussians, &self.free, self.planner.classes, colors, before)
    }
    /// The streams of canonical Gaussians as `plan` rounds them.
    pub fn streams(&self, gaussians: Columns, plan: &Plan) -> Result<Vec<Stream>> {
        let of = self.quantise(gaussians, plan, None);
        let order = self.order(&of);
        self.write(gaussians, of, &order)
    }
    /// What they will be decoded to, in the order in which they are stored, which decides images where depths are equal. Dynamic scores, and attributes that
    /// are stored as their plug-ins allow, are the originals.
    pub fn restored(&self, gaussians: Columns, plan: &Plan) -> HostGaussians {
        let of = self.quantise(gaussians, plan, None);
        restored(&of, gaussians, Some(&self.order(&of)))
    }
    /// [`Job::streams`] and [`Job::restored`].
    pub fn stored(&self, gaussians: Columns, plan: &Plan) -> Result<(Vec<Stream>, HostGaussians)> {
        self.written_and_restored(gaussians, self.quantise(gaussians, plan, None))
    }
    fn written_and_restored(&self, gaussians: Columns, of: Integers) -> Result<(Vec<Stream>, HostGaussians)> {
        let order = self.order(&of);
        let rounded = restored(&of, gaussians, Some(&order));
        Ok((self.write(gaussians, of, &order)?, rounded))
    }
    /// The streams of `gaussians`, whose integers are `of`, in their [`Job::order`].
    fn write(&self, gaussians: Columns, of: Integers, order: &[usize]) -> Result<Vec<Stream>> {
        #[cfg(test)]
        CODED.set(CODED.get() + 1);
        write::write(gaussians, of, &self.motion, order, &self.layers.1)
    }
    /// The order in which rows are stored.
    pub fn order(&self, of: &Integers) -> Vec<usize> {
        // Layer, key and row in one number, which is compared without branches.
        let number = |(row, (&layer, &key)): (usize, (&u8, &u64))| u128::from(layer) << 96 | u128::from(key) << 32 | row as u128;
        let mut rows: Vec<u128> = self.layers.0.par_iter().zip(&of.keys).enumerate().map(number).collect();
        rows.par_sort_unstable();
        rows.into_par_iter().map(|number| number as u32 as usize).collect()
    }
}
