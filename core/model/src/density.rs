//! Density control: which Gaussians are added, moved and removed during training.
//!
//! A control observes statistics of rendered views and returns a [`DensityPlan`]. The trainer executes the plan, so that the trainer alone handles attributes
//! of plug-ins, optimizer state and checkpoints.

use crate::Plugin;
use crate::gaussians::to_vec;
use crate::{Camera, Error, Gaussians, Result, Schedule, Seed, View};
use burn::tensor::{Device, Int, Tensor, TensorData};

/// A statistic that the rasterizer collects only on request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Statistic {
    /// Gradient of the loss with respect to the projected centres.
    ScreenGradient,
    /// Sum over pixels of the absolute values of that gradient (AbsGS).
    AbsoluteScreenGradient,
    /// The largest blending weight of every Gaussian.
    MaxWeight,
}

/// Statistics of N Gaussians in one rendered view. Fields that were not requested are `None`. More may be added to it, so programs make one with
/// [`ViewStatistics::new`].
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct ViewStatistics {
    /// The camera of the view, at the size of the image. Its name is that of the dataset.
    pub camera: Camera,
    /// The view: the index of its camera, its frame among those that the scene has, counted from 0, and its time. With `train.time_noise` the Gaussians were
    /// drawn at a time nearby.
    pub view: View,
    /// Screen radius in pixels `[N]`; 0 where the Gaussian was culled.
    pub radii: Tensor<1, Int>,
    /// [`Statistic::ScreenGradient`] per pixel of x and y `[N,2]`.
    pub screen_gradient: Option<Tensor<2>>,
    /// [`Statistic::AbsoluteScreenGradient`] per pixel of x and y `[N,2]`.
    pub absolute_screen_gradient: Option<Tensor<2>>,
    /// [`Statistic::MaxWeight`] in 0..1 `[N]`.
    pub max_weights: Option<Tensor<1>>,
    /// Image size in pixels.
    pub size: (u32, u32),
    /// Number of views of this iteration. The loss of the gradients was divided by it.
    pub views: usize,
}

impl ViewStatistics {
    /// The only view of an iteration, without what is collected on request: set those fields, and [`ViewStatistics::views`], where there is more.
    pub fn new(camera: Camera, view: View, radii: Tensor<1, Int>) -> Self {
        let size = (camera.width, camera.height);
        Self { camera, view, radii, screen_gradient: None, absolute_screen_gradient: None, max_weights: None, size, views: 1 }
    }
}

/// Counts of a plan's actions, for events.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DensityReport {
    /// Copies added.
    pub cloned: usize,
    /// Gaussians replaced by two smaller ones.
    pub split: usize,
    /// Gaussians relocated.
    pub moved: usize,
    /// Gaussians removed.
    pub removed: usize,
}

/// New values of one attribute in some rows.
#[derive(Clone, Debug, PartialEq)]
pub struct RowValues {
    /// Name of the attribute, as in [`Gaussians::attribute`].
    pub attribute: String,
    /// Rows of the new Gaussians, each at most once.
    pub rows: Vec<usize>,
    /// Floats of each row, row-major.
    pub values: Vec<f32>,
}

/// The next set of Gaussians: every new row has a parent among the old rows, whose attributes it inherits. Old rows without a new row are removed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DensityPlan {
    parents: Vec<usize>,
    fresh: Vec<bool>,
    values: Vec<RowValues>,
    restarted: Vec<String>,
    /// Counts for events.
    pub report: DensityReport,
}

impl DensityPlan {
    /// A plan without rows; add them with [`DensityPlan::keep`] and [`DensityPlan::copy`].
    pub fn new() -> Self {
        Self::default()
    }
    /// A plan that keeps all of `count` rows in their order.
    pub fn unchanged(count: usize) -> Self {
        Self { parents: (0..count).collect(), fresh: vec![false; count], ..Self::default() }
    }
    /// Keeps the old row `row` with its optimizer state; returns its new row. Keep a row once, and add others like it with [`DensityPlan::copy`].
    pub fn keep(&mut self, row: usize) -> usize {
        self.add(row, false)
    }
    /// Adds a Gaussian with the attributes of the old row `parent` and no momentum in the optimizer; returns its new row. A split is two copies with new
    /// values, without [`DensityPlan::keep`] of the parent. A relocation is a copy instead of keeping a dead row.
    pub fn copy(&mut self, parent: usize) -> usize {
        self.add(parent, true)
    }
    fn add(&mut self, parent: usize, fresh: bool) -> usize {
        self.parents.push(parent);
        self.fresh.push(fresh);
        self.parents.len() - 1
    }
    /// Sets `attribute` of the new row `row` to `values` `[width]`.
    pub fn set(&mut self, row: usize, attribute: &str, values: &[f32]) {
        match self.values.iter_mut().find(|v| v.attribute == attribute) {
            Some(found) => {
                found.rows.push(row);
                found.values.extend_from_slice(values);
            }
            None => self.values.push(RowValues { attribute: attribute.into(), rows: vec![row], values: values.to_vec() }),
        }
    }
    /// The old rows of `count` that have no new row, ascending.
    pub fn removed(&self, count: usize) -> Vec<usize> {
        let mut kept = vec![false; count];
        self.parents.iter().filter(|&&row| row < count).for_each(|&row| kept[row] = true);
        (0..count).filter(|&row| !kept[row]).collect()
    }
    /// Keeps `rows` that the plan removes; they become its last rows.
    pub fn restore(&mut self, rows: &[usize]) {
        rows.iter().for_each(|&row| {
            self.keep(row);
        });
        self.report.removed = self.report.removed.saturating_sub(rows.len());
    }
    /// Puts the new rows into another order: row `order[k]` becomes row k. `order` holds every row once.
    ///
    /// # Panics
    /// Where `order` names a row that the plan does not have.
    pub fn reorder(&mut self, order: &[usize]) {
        let mut moved_to = vec![0; order.len()];
        order.iter().enumerate().for_each(|(new, &row)| moved_to[row] = new);
        self.parents = order.iter().map(|&row| self.parents[row]).collect();
        self.fresh = order.iter().map(|&row| self.fresh[row]).collect();
        self.values.iter_mut().flat_map(|set| &mut set.rows).for_each(|row| *row = moved_to[*row]);
    }
    /// Starts the optimizer state of `attribute` anew in all rows. A plan that restarts `opacity_logits` is an opacity reset: the trainer leaves the reset out
    /// where too little time is left or the last one is not back, and undoes one from which training views do not recover, unless `train.guard` is off.
    pub fn restart(&mut self, attribute: &str) {
        self.restarted.push(attribute.into());
    }
    /// Number of new rows.
    pub fn len(&self) -> usize {
        self.parents.len()
    }
    /// Whether there are no new rows.
    pub fn is_empty(&self) -> bool {
        self.parents.is_empty()
    }
    /// The parent (old row) of every new row.
    pub fn parents(&self) -> &[usize] {
        &self.parents
    }
    /// Whether a new row starts without momentum in the optimizer.
    pub fn fresh(&self) -> &[bool] {
        &self.fresh
    }
    /// Values that are set after the rows are copied.
    pub fn values(&self) -> &[RowValues] {
        &self.values
    }
    /// Attributes whose optimizer state starts anew in all rows.
    pub fn restarted(&self) -> &[String] {
        &self.restarted
    }
    /// Whether all `count` rows are kept in their order.
    pub fn keeps_all(&self, count: usize) -> bool {
        self.parents.len() == count && self.parents.iter().enumerate().all(|(i, &p)| i == p) && !self.fresh.contains(&true)
    }
    /// The Gaussians after the plan, on the same device. Call [`DensityPlan::check`] first.
    pub fn apply(&self, gaussians: &Gaussians) -> Result<Gaussians> {
        let device = gaussians.means.device();
        let rows = (!self.keeps_all(gaussians.len())).then(|| index_tensor(&self.parents, &device));
        let changed = gaussians.attribute_names().into_iter().filter_map(|name| Some((gaussians.attribute(&name)?, name))).map(|(values, name)| {
            let mut values = match &rows {
                Some(rows) => values.select(0, rows.clone()),
                None => values,
            };
            if let Some(set) = self.values.iter().find(|set| set.attribute == name) {
                let [count, width] = values.dims();
                let mut host = to_vec(values, &name)?;
                for (&row, new) in set.rows.iter().zip(set.values.chunks_exact(width.max(1))) {
                    host[row * width..(row + 1) * width].copy_from_slice(new);
                }
                values = Tensor::from_data(TensorData::new(host, [count, width]), &device);
            }
            Ok((name, values))
        });
        let attributes = changed.collect::<Result<Vec<_>>>()?;
        Gaussians::from_attributes(gaussians.sh_degree, attributes)
    }
    /// Refuses plans that refer to rows or attributes that `gaussians` do not have, remove all Gaussians, or set values that are not finite. `control` is the
    /// name in errors.
    ///
    /// # Errors
    /// [`Error::Backend`].
    pub fn check(&self, control: &str, gaussians: &Gaussians) -> Result<()> {
        let bad =
            |problem: String| Err(Error::backend(format!("density control {control}"), problem, "Correct the plan it returns, or choose another control"));
        let count = gaussians.len();
        if self.is_empty() && count > 0 {
            return bad(format!("its plan removes all {count} Gaussians"));
        }
        if let Some(row) = self.parents.iter().find(|&&row| row >= count) {
            return bad(format!("its plan refers to row {row} of {count}"));
        }
        if let Some(name) = self.restarted.iter().find(|name| gaussians.attribute(name).is_none()) {
            return bad(format!("its plan restarts the attribute '{name}', which the Gaussians do not have"));
        }
        for set in &self.values {
            let Some(width) = gaussians.attribute(&set.attribute).map(|a| a.dims()[1]) else {
                return bad(format!("its plan sets the attribute '{}', which the Gaussians do not have", set.attribute));
            };
            if set.values.len() != width * set.rows.len() {
                return bad(format!("its plan sets {} values of '{}' for {} rows of width {width}", set.values.len(), set.attribute, set.rows.len()));
            }
            if let Some(row) = set.rows.iter().find(|&&row| row >= self.len()) {
                return bad(format!("its plan sets '{}' of row {row} of {}", set.attribute, self.len()));
            }
            if let Some(value) = set.values.iter().find(|v| !v.is_finite()) {
                return bad(format!("its plan sets '{}' to {value}", set.attribute));
            }
        }
        Ok(())
    }
}

/// Row indices on a device.
fn index_tensor(rows: &[usize], device: &Device) -> Tensor<1, Int> {
    let rows: Vec<i64> = rows.iter().map(|&row| row as i64).collect();
    let count = rows.len();
    Tensor::from_data(TensorData::new(rows, [count]), device)
}

/// Adds, moves and removes Gaussians during the coarse and the main stage. It owns its settings, its statistics, and its state in checkpoints.
///
/// A stage begins with [`begin_stage`](Self::begin_stage). The calls of an iteration are, in this order: [`statistics`](Self::statistics),
/// [`observe`](Self::observe) for every view, the step of the optimizer, [`after_step`](Self::after_step), [`hold`](Self::hold), [`plan`](Self::plan), and, if
/// there is a plan, [`executed`](Self::executed). Between iterations, and before the first one, `executed` is also called for plans of the trainer, which
/// [`plan`](Self::plan) did not return. Where a run is resumed, a new control gets [`restore`](Self::restore) in place of `begin_stage`.
pub trait DensityControl: Send {
    /// A stage begins with `count` Gaussians: statistics start from zero. Also called before [`DensityControl::restore`] where the trainer goes back to an
    /// earlier state of the stage.
    fn begin_stage(&mut self, count: usize, device: &Device);
    /// The optional statistics that it needs from the views of this iteration.
    fn statistics(&self, schedule: &Schedule) -> Vec<Statistic>;
    /// Receives the statistics of one view, after the backward pass.
    fn observe(&mut self, view: &ViewStatistics) -> Result<()>;
    /// Called before every [`DensityControl::plan`]: growth must stay `count` Gaussians below its upper bound. That many were removed, and training views do
    /// not have their earlier PSNR yet. Default: ignored, for controls that replace what they remove in the same plan.
    fn hold(&mut self, _count: usize) {}
    /// The plan after the optimizer step of an iteration; `None` for no change. The trainer may keep rows that the plan removes (see [`DensityPlan::restore`])
    /// and puts those that move first, executes it, and calls [`DensityControl::executed`]. All randomness comes from `seed`, which differs in every iteration.
    fn plan(&mut self, gaussians: &Gaussians, schedule: &Schedule, seed: Seed) -> Result<Option<DensityPlan>>;
    /// The Gaussians are now those of `plan`: statistics per Gaussian must follow its rows ([`DensityPlan::parents`] are the old ones, in any order). It may be
    /// another plan than [`DensityControl::plan`] returned last. Default: nothing, for controls that keep none.
    fn executed(&mut self, _plan: &DensityPlan, _device: &Device) -> Result<()> {
        Ok(())
    }
    /// Called after every optimizer step, before [`DensityControl::plan`]. Returns attributes with new values for all rows `[N,width]`; their optimizer state
    /// is kept (for the noise of 3DGS-MCMC).
    fn after_step(&mut self, _gaussians: &Gaussians, _schedule: &Schedule, _seed: Seed) -> Result<Vec<(String, Tensor<2>)>> {
        Ok(Vec::new())
    }
    /// State for checkpoints, by name. Default: none.
    fn state(&self) -> Vec<(String, Tensor<1>)> {
        Vec::new()
    }
    /// Restores what [`DensityControl::state`] returned, for `count` Gaussians. Arrays are untrusted: an error, never a panic. Default:
    /// every array is refused.
    fn restore(&mut self, state: Vec<(String, Tensor<1>)>, _count: usize) -> Result<()> {
        match state.first() {
            None => Ok(()),
            Some((name, _)) => Err(Error::data(format!("density state '{name}'"), "this control has no state", "Resume with the run's own config.toml")),
        }
    }
}

/// A density control in the registry.
pub struct DensityPlugin {
    /// Name, version and other facts.
    pub info: Plugin,
    /// Builds the control from the `[density]` section without `kind`; unknown keys are errors.
    pub build: fn(&toml::Table) -> Result<Box<dyn DensityControl>>,
}
cc4dgs_format::plugin_kind!(DensityPlugin, "density");

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;
    use crate::HostGaussians;

    fn three() -> Gaussians {
        let host = HostGaussians {
            means: vec![0.0; 9],
            log_scales: vec![0.0; 9],
            quaternions: vec![1.0; 12],
            opacity_logits: vec![0.0; 3],
            sh_dc: vec![0.0; 9],
            dynamic_scores: vec![0.0; 3],
            ..Default::default()
        };
        Gaussians::from_host(&host, &Device::flex())
    }

    #[test]
    fn plans_are_carried_out() {
        let mut g = three();
        g.opacity_logits = Tensor::from_floats([0.0, 1.0, 2.0], &Device::flex());
        g.extra.insert("label".into(), Tensor::from_floats([[10.0], [11.0], [12.0]], &Device::flex()));
        let mut plan = DensityPlan::new();
        plan.keep(2);
        let copy = plan.copy(1);
        plan.set(copy, "opacity_logits", &[7.0]);
        let after = plan.apply(&g).unwrap().to_host().unwrap();
        assert_eq!((after.opacity_logits, after.extra["label"].values.clone()), (vec![2.0, 7.0], vec![12.0, 11.0]));
        assert_eq!((plan.fresh(), plan.keeps_all(3)), (&[false, true][..], false));
        assert_eq!(plan.removed(3), [0]);
        plan.restore(&[0]);
        assert!(plan.removed(3).is_empty() && plan.parents() == [2, 1, 0]);
        plan.reorder(&[1, 2, 0]);
        let after = plan.apply(&g).unwrap().to_host().unwrap();
        assert_eq!((after.opacity_logits, after.extra["label"].values.clone()), (vec![7.0, 0.0, 2.0], vec![11.0, 10.0, 12.0]));
        assert_eq!(plan.fresh(), [true, false, false]);
    }

    #[test]
    fn plans_are_checked() {
        let g = three();
        assert!(DensityPlan::unchanged(3).check("t", &g).is_ok() && DensityPlan::unchanged(3).keeps_all(3));
        assert!(DensityPlan::new().check("t", &g).is_err(), "no Gaussian is left");
        assert!(DensityPlan::unchanged(4).check("t", &g).is_err(), "there is no fourth row");
        let with = |attribute: &str, values: &[f32]| {
            let mut plan = DensityPlan::new();
            let row = plan.copy(2);
            plan.set(row, attribute, values);
            plan.check("t", &g)
        };
        assert!(with("means", &[1.0, 2.0, 3.0]).is_ok());
        for (attribute, values) in [("means", &[1.0][..]), ("means", &[1.0, f32::NAN, 0.0]), ("colour", &[1.0])] {
            assert!(with(attribute, values).unwrap_err().to_string().contains(attribute), "{attribute}");
        }
        let restarting = |attribute: &str| {
            let mut plan = DensityPlan::unchanged(3);
            plan.restart(attribute);
            plan.check("t", &g)
        };
        assert!(restarting("opacity_logits").is_ok());
        assert!(restarting("opacities").unwrap_err().to_string().contains("restarts the attribute 'opacities'"));
    }
}
