//! Adam (Kingma and Ba 2015) with the fused kernel. Moments and step counts are stored per array, by its name.

use burn::tensor::{Int, Tensor, TensorData};
use cc4dgs_backends::ops::adam::{AdamSettings, adam_step};
use cc4dgs_core::{Error, Optimizer, OptimizerPlugin, OptimizerState, Plugin, Result, StepSettings, config, inventory, path_holds, state_array};
use serde::Deserialize;
use std::collections::BTreeMap;

const SCHEMA: &str = "\
beta1 = 0.9              # decay of the first moment
beta2 = 0.999            # decay of the second moment
";

#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    beta1: f64,
    beta2: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { beta1: 0.9, beta2: 0.999 }
    }
}

/// The second moment of a new row over that of its parent: two copies share the gradient of one.
const SHARED: f32 = 0.25;

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
        self.moments.retain(|name, _| !path_holds(path, name));
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
            let share = fresh.iter().map(|&f| if f { SHARED } else { 1.0 }).collect::<Vec<_>>();
            let share = Tensor::<2>::from_data(TensorData::new(share, [count, 1]), &device);
            // A mask and no factor: a moment that is not finite becomes 0, too.
            moments.first = moments.first.clone().select(0, rows.clone()).mask_fill(zero.equal_elem(1), 0.0);
            // Without a second moment, steps would be up to six times too large for a hundred iterations: the bias correction counts the steps of the array.
            moments.second = moments.second.clone().select(0, rows) * share;
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
