//! Adam (Kingma and Ba 2015) with the fused kernel. Moments and step counts are stored per array, by its name. With `new_rows = 0` and `restart_steps = false`
//! new rows and resets are treated as in the published code of 3DGS: the steps that follow are larger than the learning rate.

use burn::tensor::{Int, Tensor, TensorData};
use cc4dgs_backends::ops::adam::{AdamSettings, adam_step};
use cc4dgs_core::{Error, Optimizer, OptimizerPlugin, OptimizerState, Plugin, Result, StepSettings, config, inventory, path_holds, state_array};
use serde::Deserialize;
use std::collections::BTreeMap;

const SCHEMA: &str = "\
beta1 = 0.9              # decay of the first moment
beta2 = 0.999            # decay of the second moment
new_rows = 0.25          # second moment of a new Gaussian over that of its parent, 0 to 1 (PyTorch code of 3DGS: 0)
restart_steps = true     # whether a reset of opacities restarts the count of steps of the bias correction, too (PyTorch code of 3DGS: false)
";

#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    beta1: f64,
    beta2: f64,
    /// By default two copies share the gradient of one.
    new_rows: f32,
    restart_steps: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self { beta1: 0.9, beta2: 0.999, new_rows: 0.25, restart_steps: true }
    }
}

/// State of one array: first and second moment `[N,W]`, and the number of steps.
struct Moments {
    first: Tensor<2>,
    second: Tensor<2>,
    steps: u64,
}

struct Adam {
    settings: Settings,
    moments: BTreeMap<String, Moments>,
}

impl Optimizer for Adam {
    fn step(&mut self, name: &str, value: Tensor<2>, gradient: Tensor<2>, settings: &StepSettings) -> Result<Tensor<2>> {
        // The moments are taken out of the map, so that the kernel holds the only reference and works in place.
        let Moments { first, second, steps } =
            self.moments.remove(name).unwrap_or_else(|| Moments { first: value.zeros_like(), second: value.zeros_like(), steps: 0 });
        let steps = steps + 1;
        let settings = AdamSettings {
            beta1: self.settings.beta1,
            beta2: self.settings.beta2,
            epsilon: settings.epsilon,
            visible: settings.visible.cloned(),
            ..AdamSettings::new(settings.lr, steps)
        };
        let stepped = adam_step(value, first, second, gradient, &settings)?;
        self.moments.insert(name.to_string(), Moments { first: stepped.m, second: stepped.v, steps });
        Ok(stepped.param)
    }
    fn restart(&mut self, path: &str) {
        self.moments.retain(|name, moments| {
            // A reset names one array. Paths of several are those of a stage that begins, or of a deformer with other weights.
            let resets = name == path && !self.settings.restart_steps;
            if resets {
                (moments.first, moments.second) = (moments.first.zeros_like(), moments.second.zeros_like());
            }
            resets || !path_holds(path, name)
        });
    }
    fn select_rows(&mut self, path: &str, parents: &[usize], fresh: &[bool]) -> Result<()> {
        let count = parents.len();
        let rows: Vec<i64> = parents.iter().map(|&row| row as i64).collect();
        for (name, moments) in self.moments.iter_mut().filter(|(name, _)| path_holds(path, name)) {
            let [have, _] = moments.first.dims();
            if fresh.len() != count || parents.iter().any(|&row| row >= have) {
                return Err(Error::backend(format!("optimizer adam: {name}"), format!("{count} rows are selected of {have}"), "Report this as a defect"));
            }
            let device = moments.first.device();
            let rows = Tensor::<1, Int>::from_data(TensorData::new(rows.clone(), [count]), &device);
            // Columns, which are read once per row instead of stored once per value.
            let zero = Tensor::<2, Int>::from_data(TensorData::new(fresh.iter().map(|&f| i64::from(f)).collect::<Vec<_>>(), [count, 1]), &device);
            let zero = zero.equal_elem(1);
            // A mask and no factor: a moment that is not finite becomes 0, too.
            moments.first = moments.first.clone().select(0, rows.clone()).mask_fill(zero.clone(), 0.0);
            let second = moments.second.clone().select(0, rows);
            let new_rows = self.settings.new_rows;
            // Without a second moment, steps would be up to six times too large for a hundred iterations: the bias correction counts the steps of the array.
            moments.second = if new_rows > 0.0 {
                let share = fresh.iter().map(|&f| if f { new_rows } else { 1.0 }).collect::<Vec<_>>();
                second * Tensor::<2>::from_data(TensorData::new(share, [count, 1]), &device)
            } else {
                second.mask_fill(zero, 0.0)
            };
        }
        Ok(())
    }
    fn state(&self) -> OptimizerState {
        let mut state = OptimizerState::default();
        for (name, moments) in &self.moments {
            state.arrays.insert(format!("{name}/first_moment"), moments.first.clone());
            state.arrays.insert(format!("{name}/second_moment"), moments.second.clone());
            state.steps.insert(name.clone(), moments.steps);
        }
        state
    }
    fn restore(&mut self, mut state: OptimizerState) -> Result<()> {
        self.moments.clear();
        for (name, steps) in std::mem::take(&mut state.steps) {
            let first = state_array(&mut state, &format!("{name}/first_moment"))?;
            let second = state_array(&mut state, &format!("{name}/second_moment"))?;
            if first.dims() != second.dims() {
                return Err(Error::data(
                    format!("optimizer state of {name}"),
                    "the shapes of the two moments differ",
                    "The checkpoint is damaged; use another",
                ));
            }
            self.moments.insert(name, Moments { first, second, steps });
        }
        match state.arrays.keys().next() {
            Some(name) => {
                Err(Error::data(format!("optimizer state '{name}'"), "it belongs to no known array", "The checkpoint is damaged or of another optimizer"))
            }
            None => Ok(()),
        }
    }
}

fn build(section: &toml::Table) -> Result<Box<dyn Optimizer>> {
    let settings: Settings = config::parse_section("optimizer adam", section)?;
    if [settings.beta1, settings.beta2].iter().any(|b| !(0.0..1.0).contains(b)) {
        let problem = format!("beta1 {} and beta2 {} must be at least 0 and below 1", settings.beta1, settings.beta2);
        return Err(Error::parameter("optimizer adam", problem, "The usual values are 0.9 and 0.999"));
    }
    if !(0.0..=1.0).contains(&settings.new_rows) {
        let remedy = "It is a share of the second moment of the parent: 0.25 is the default, 0 that of the published code of 3DGS";
        return Err(Error::parameter("optimizer adam, new_rows", format!("{} is not in 0..1", settings.new_rows), remedy));
    }
    Ok(Box::new(Adam { settings, moments: BTreeMap::new() }))
}

inventory::submit! {
    OptimizerPlugin {
        info: Plugin {
            name: "adam",
            version: "1",
            summary: "Adam; optionally skips rows that no view shows",
            paper: "Kingma and Ba 2015; Mallick et al. 2024 (rows in view only)",
            schema: SCHEMA,
            capabilities: &[],
        },
        build,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;
    use cc4dgs_core::gaussians::to_vec;

    const NAME: &str = "gaussians/opacity_logits";

    /// An optimizer with these settings, whose array has two rows and these moments after 999 steps.
    fn trained(settings: &str, first: f32, second: f32) -> Box<dyn Optimizer> {
        let mut adam = build(&settings.parse().unwrap()).unwrap();
        let mut state = OptimizerState::default();
        for (moment, value) in [("first", first), ("second", second)] {
            state.arrays.insert(format!("{NAME}/{moment}_moment"), Tensor::full([2, 1], value, &Device::flex()));
        }
        state.steps.insert(NAME.into(), 999);
        adam.restore(state).unwrap();
        adam
    }

    fn moment(adam: &dyn Optimizer, which: &str) -> Vec<f32> {
        to_vec(adam.state().arrays[&format!("{NAME}/{which}_moment")].clone(), which).unwrap()
    }

    #[test]
    fn new_rows_have_the_stated_share_of_the_second_moment() {
        for (settings, expected) in [("", 0.5), ("new_rows = 0.5", 1.0), ("new_rows = 0", 0.0)] {
            let mut adam = trained(settings, 3.0, 2.0);
            adam.select_rows("gaussians/", &[1, 0], &[false, true]).unwrap();
            assert_eq!((moment(adam.as_ref(), "first"), moment(adam.as_ref(), "second")), (vec![3.0, 0.0], vec![2.0, expected]), "{settings}");
        }
        let mut adam = trained("new_rows = 0", f32::NAN, f32::INFINITY);
        adam.select_rows("gaussians/", &[0], &[true]).unwrap();
        assert_eq!((moment(adam.as_ref(), "first"), moment(adam.as_ref(), "second")), (vec![0.0], vec![0.0]));
        for share in ["-0.1", "1.5", "nan"] {
            let refused = build(&format!("new_rows = {share}").parse().unwrap()).err().unwrap().to_string();
            assert!(refused.contains("new_rows"), "{refused}");
        }
    }

    #[test]
    fn a_reset_may_keep_the_count_of_steps() {
        let lr = 0.01;
        let first_step = |settings: &str, path: &str| {
            let mut adam = trained(settings, 3.0, 2.0);
            adam.restart(path);
            let device = Device::flex();
            let value = adam.step(NAME, Tensor::zeros([2, 1], &device), Tensor::ones([2, 1], &device), &StepSettings::new(lr)).unwrap();
            (f64::from(-to_vec(value, "values").unwrap()[0]), adam.state().steps[NAME])
        };
        // Moments of one gradient of 1, with the bias corrections of 1,000 steps: 2.5 times the learning rate.
        let corrected = lr * 0.1 / (1.0 - 0.9f64.powi(1000)) / (0.001 / (1.0 - 0.999f64.powi(1000))).sqrt();
        assert!((2.5..2.53).contains(&(corrected / lr)), "{corrected}");
        for (settings, path, expected, steps) in [
            ("", NAME, lr, 1),
            ("restart_steps = false", NAME, corrected, 1000),
            // A stage that begins has a new state in any case.
            ("restart_steps = false", "", lr, 1),
            ("restart_steps = false", "gaussians/", lr, 1),
        ] {
            let (moved, counted) = first_step(settings, path);
            assert!((moved / expected - 1.0).abs() < 1e-4, "'{settings}', '{path}': {moved}, expected {expected}");
            assert_eq!(counted, steps, "'{settings}', '{path}'");
        }
        // Another array keeps its state.
        let mut adam = trained("restart_steps = false", 3.0, 2.0);
        adam.restart("gaussians/opacity");
        assert_eq!(moment(adam.as_ref(), "first"), [3.0; 2]);
    }
}
