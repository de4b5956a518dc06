//! The conformance suite of optimizers.

use super::{guarded, matrix, settings_are_defaults};
use crate::gaussians::to_vec;
use crate::{Error, Optimizer, OptimizerPlugin, Result, Seed, StepSettings};
use burn::tensor::{Device, Int, Tensor};

/// Rows and width of the suite's array.
const SHAPE: [usize; 2] = [12, 3];
/// Number of steps in which a quadratic function must fall to a tenth or less.
const STEPS: usize = 400;
/// Steps after which fresh rows are compared with their parents, and upper bound on the ratio of the distances that they have moved.
const FRESH_STEPS: usize = 20;
const FRESH_MOVES: f64 = 2.0;

/// Tests an optimizer on `device`. Each finding is a line; an empty list means that it passed.
///
/// - Its schema is TOML and states the defaults; unknown settings are refused; nothing panics.
/// - It minimises a quadratic function.
/// - Rows that are not visible keep values and state.
/// - Selected rows take over the state of their parents; fresh rows have no momentum, and move about as fast as their parents.
/// - After a restart it takes the same steps as a new optimizer, and arrays that are not named keep their state, also where their names begin alike; after
///   storing and restoring state, it takes the same steps as without.
/// - Invalid state is an error.
pub fn optimizer(plugin: &OptimizerPlugin, settings: &toml::Table, device: &Device) -> Vec<String> {
    let suite = Suite { plugin, settings, device };
    guarded(
        &format!("{} on {device:?}", plugin.info.name),
        vec![
            ("settings", Box::new(|| suite.settings_are_read())),
            ("descent", Box::new(|| suite.lowers_a_quadratic())),
            ("visible rows", Box::new(|| suite.leaves_hidden_rows())),
            ("rows", Box::new(|| suite.rows_follow_their_parents())),
            ("fresh rows", Box::new(|| suite.fresh_rows_keep_pace())),
            ("momentum", Box::new(|| suite.fresh_rows_have_no_momentum())),
            ("state", Box::new(|| suite.state_continues())),
            ("restart", Box::new(|| suite.restarts_what_is_named())),
        ],
    )
}

struct Suite<'a> {
    plugin: &'a OptimizerPlugin,
    settings: &'a toml::Table,
    device: &'a Device,
}

const NAME: &str = "gaussians/means";

impl Suite<'_> {
    fn build(&self) -> Result<Box<dyn Optimizer>> {
        (self.plugin.build)(self.settings)
    }
    fn settings_are_read(&self) -> Result<Option<String>> {
        let steps = |settings: &toml::Table| to_vec(self.descend((self.plugin.build)(settings)?.as_mut(), self.start(), 5)?, "values");
        settings_are_defaults("optimizer", &self.plugin.info, self.settings, steps)
    }
    fn start(&self) -> Tensor<2> {
        matrix(Seed::root(71), SHAPE[0], SHAPE[1], self.device)
    }
    /// `steps` steps on a quadratic function with its minimum at zero.
    fn descend(&self, optimizer: &mut dyn Optimizer, mut value: Tensor<2>, steps: usize) -> Result<Tensor<2>> {
        for _ in 0..steps {
            let gradient = value.clone().mul_scalar(2.0);
            value = optimizer.step(NAME, value, gradient, &StepSettings::new(0.02))?;
        }
        Ok(value)
    }
    fn lowers_a_quadratic(&self) -> Result<Option<String>> {
        let squares = |t: Tensor<2>| -> Result<f64> { Ok(to_vec(t, "values")?.iter().map(|v| f64::from(*v).powi(2)).sum()) };
        let before = squares(self.start())?;
        let after = squares(self.descend(self.build()?.as_mut(), self.start(), STEPS)?)?;
        Ok((after.is_nan() || after > 0.1 * before).then(|| format!("a sum of squares of {before:.3} is {after:.3} after {STEPS} steps")))
    }
    fn leaves_hidden_rows(&self) -> Result<Option<String>> {
        let (mut masked, mut whole) = (self.build()?, self.build()?);
        let visible: Vec<i64> = (0..SHAPE[0] as i64).map(|i| i % 2).collect();
        let visible = Tensor::<1, Int>::from_data(burn::tensor::TensorData::new(visible, [SHAPE[0]]), self.device);
        let gradient = self.start().mul_scalar(2.0);
        let settings = StepSettings { visible: Some(&visible), ..StepSettings::new(0.02) };
        let a = to_vec(masked.step(NAME, self.start(), gradient.clone(), &settings)?, "values")?;
        let b = to_vec(whole.step(NAME, self.start(), gradient, &StepSettings::new(0.02))?, "values")?;
        let start = to_vec(self.start(), "values")?;
        for row in 0..SHAPE[0] {
            let span = row * SHAPE[1]..(row + 1) * SHAPE[1];
            let wanted = if row % 2 == 1 { &b[span.clone()] } else { &start[span.clone()] };
            if a[span.clone()] != *wanted {
                return Ok(Some(format!("row {row} with visibility {} is {:?}, expected {wanted:?}", row % 2, &a[span])));
            }
        }
        Ok(None)
    }
    fn rows_follow_their_parents(&self) -> Result<Option<String>> {
        let mut optimizer = self.build()?;
        let value = self.descend(optimizer.as_mut(), self.start(), 5)?;
        // Reversed, and the last row is a fresh copy of the first.
        let parents: Vec<usize> = (0..SHAPE[0]).rev().chain([0]).collect();
        let fresh: Vec<bool> = (0..SHAPE[0]).map(|_| false).chain([true]).collect();
        let rows: Vec<i64> = parents.iter().map(|&p| p as i64).collect();
        let rows = Tensor::<1, Int>::from_data(burn::tensor::TensorData::new(rows, [parents.len()]), self.device);
        let gradient = self.start().mul_scalar(0.5);
        let (moved, moved_gradient) = (value.clone().select(0, rows.clone()), gradient.clone().select(0, rows));
        let mut reordered = self.build()?;
        reordered.restore(optimizer.state())?;
        reordered.select_rows("gaussians/", &parents, &fresh)?;
        let plain = to_vec(optimizer.step(NAME, value.clone(), gradient, &StepSettings::new(0.02))?, "values")?;
        let after = to_vec(reordered.step(NAME, moved, moved_gradient, &StepSettings::new(0.02))?, "values")?;
        for (row, &parent) in parents.iter().enumerate().take(SHAPE[0]) {
            if after[row * SHAPE[1]..(row + 1) * SHAPE[1]] != plain[parent * SHAPE[1]..(parent + 1) * SHAPE[1]] {
                return Ok(Some(format!("row {row}, a copy of row {parent}, takes another step")));
            }
        }
        if reordered.select_rows("gaussians/", &[SHAPE[0] + 5], &[false]).is_ok() {
            return Ok(Some("a row that does not exist was selected".into()));
        }
        Ok(None)
    }
    fn fresh_rows_keep_pace(&self) -> Result<Option<String>> {
        let mut optimizer = self.build()?;
        let gradient = self.start();
        let walk = |optimizer: &mut dyn Optimizer, steps: usize| {
            let mut value = self.start();
            for _ in 0..steps {
                value = optimizer.step(NAME, value, gradient.clone(), &StepSettings::new(0.001))?;
            }
            let moved = to_vec(value - self.start(), "values")?;
            Ok::<_, Error>(moved.iter().map(|v| f64::from(v.abs())).sum::<f64>())
        };
        walk(optimizer.as_mut(), STEPS)?;
        let mut renewed = self.build()?;
        renewed.restore(optimizer.state())?;
        renewed.select_rows("gaussians/", &(0..SHAPE[0]).collect::<Vec<_>>(), &[true; SHAPE[0]])?;
        let (old, fresh) = (walk(optimizer.as_mut(), FRESH_STEPS)?, walk(renewed.as_mut(), FRESH_STEPS)?);
        let found = || format!("with equal gradients, fresh rows move {:.1} times as far as their parents in {FRESH_STEPS} steps", fresh / old);
        Ok((fresh > FRESH_MOVES * old).then(found))
    }
    fn fresh_rows_have_no_momentum(&self) -> Result<Option<String>> {
        let mut optimizer = self.build()?;
        self.descend(optimizer.as_mut(), self.start(), 5)?;
        optimizer.select_rows("gaussians/", &(0..SHAPE[0]).collect::<Vec<_>>(), &[true; SHAPE[0]])?;
        // Without a gradient nothing but momentum can move values of 0: they are not decayed.
        let moved = to_vec(optimizer.step(NAME, self.start().zeros_like(), self.start().zeros_like(), &StepSettings::new(0.02))?, "values")?;
        let farthest = moved.iter().fold(0.0f64, |most, v| most.max(f64::from(v.abs())));
        Ok((moved.len() != SHAPE[0] * SHAPE[1] || farthest > 0.0 || moved.iter().any(|v| v.is_nan()))
            .then(|| format!("without a gradient, fresh rows move by up to {farthest}")))
    }
    fn state_continues(&self) -> Result<Option<String>> {
        let mut whole = self.build()?;
        let middle = self.descend(whole.as_mut(), self.start(), 7)?;
        let (mut copy, mut forgetful) = (self.build()?, self.build()?);
        copy.restore(whole.state())?;
        forgetful.restore(whole.state())?;
        forgetful.restart("gaussians/");
        let step = |o: &mut dyn Optimizer| to_vec(self.descend(o, middle.clone(), 3)?, "values");
        if step(whole.as_mut())? != step(copy.as_mut())? {
            return Ok(Some("after restoring its state it takes other steps".into()));
        }
        if step(forgetful.as_mut())? != step(self.build()?.as_mut())? {
            return Ok(Some("after a restart it takes other steps than a new optimizer".into()));
        }
        let mut state = whole.state();
        let Some(name) = state.arrays.keys().next().cloned() else { return Ok(None) };
        if !name.starts_with(NAME) {
            return Ok(Some(format!("the state array '{name}' does not begin with the name of its array")));
        }
        state.arrays.remove(&name);
        Ok(self.build()?.restore(state).is_ok().then(|| format!("state without '{name}' was accepted")))
    }
    fn restarts_what_is_named(&self) -> Result<Option<String>> {
        let (named, other) = ("gaussians/life", "gaussians/life_gate");
        let mut whole = self.build()?;
        for name in [named, other, named, other] {
            whole.step(name, self.start(), self.start(), &StepSettings::new(0.02))?;
        }
        let mut restarted = self.build()?;
        restarted.restore(whole.state())?;
        restarted.restart(named);
        let step = |optimizer: &mut dyn Optimizer, name: &str| {
            // The gradient is another one than before, so that the step depends on the state.
            let stepped = optimizer.step(name, self.start(), self.start().mul_scalar(0.5), &StepSettings::new(0.02))?;
            to_vec(stepped, "values")
        };
        if step(restarted.as_mut(), named)? != step(self.build()?.as_mut(), named)? {
            return Ok(Some(format!("after a restart of '{named}' it takes other steps than a new optimizer")));
        }
        let kept = step(restarted.as_mut(), other)? == step(whole.as_mut(), other)?;
        Ok((!kept).then(|| format!("a restart of '{named}' changes the steps of '{other}'")))
    }
}
