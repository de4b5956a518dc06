//! The Gaussians under optimisation: every attribute is a column [N, width] with its Adam moments, so that growing, pruning,
//! checkpoints and plug-ins' own attributes need no list of names.

use crate::config::GaussianRates;
use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_backends::ops::adam::{AdamSettings, adam_step};
use cc4dgs_core::gaussians::{sh_rest_len, to_vec};
use cc4dgs_core::{AttributeSpec, ExtraAttribute, Gaussians, HostGaussians, Result, Seed};

/// Names of the attributes every Gaussian has, in order.
pub const CORE_COLUMNS: [&str; 7] = ["means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest", "dynamic_scores"];

/// One attribute of all Gaussians with its Adam moments; plain tensors, never tracked.
#[derive(Clone, Debug)]
pub struct Column {
    /// The attribute.
    pub name: String,
    /// Values [N, width].
    pub value: Tensor<2>,
    /// First moment [N, width].
    pub first_moment: Tensor<2>,
    /// Second moment [N, width].
    pub second_moment: Tensor<2>,
}

/// The same on the host, for densification and checkpoints.
#[derive(Clone, Debug, PartialEq)]
pub struct HostColumn {
    /// The attribute.
    pub name: String,
    /// Floats per Gaussian.
    pub width: usize,
    /// Values, first and second moments, each [N, width] row-major.
    pub arrays: [Vec<f32>; 3],
}

/// All Gaussians under optimisation.
#[derive(Clone, Debug)]
pub struct GaussianSet {
    /// Spherical-harmonics degree stored.
    pub sh_degree: usize,
    /// The attributes, the core ones first.
    pub columns: Vec<Column>,
    /// Adam steps since the moments were zeroed (bias correction).
    pub step: u64,
}

impl GaussianSet {
    /// A set with zero moments.
    pub fn new(host: &HostGaussians, device: &Device) -> Self {
        let core = host.columns().into_iter().map(|(name, width, values)| (name.to_string(), width, values.clone()));
        let extra = host.extra.iter().map(|(name, a)| (name.clone(), a.width, a.values.clone()));
        let columns = core
            .chain(extra)
            .map(|(name, width, values)| {
                let zeros = vec![0.0; values.len()];
                HostColumn { name, width, arrays: [values, zeros.clone(), zeros] }
            })
            .collect();
        Self::from_host(columns, host.len(), host.sh_degree, 0, device)
    }
    /// Uploads host columns of `n` Gaussians.
    pub fn from_host(columns: Vec<HostColumn>, n: usize, sh_degree: usize, step: u64, device: &Device) -> Self {
        let columns = columns
            .into_iter()
            .map(|c| {
                let [value, first_moment, second_moment] = c.arrays.map(|a| Tensor::<2>::from_data(TensorData::new(a, [n, c.width]), device));
                Column { name: c.name, value, first_moment, second_moment }
            })
            .collect();
        Self { sh_degree, columns, step }
    }
    /// Reads everything back.
    pub fn to_host(&self) -> Result<Vec<HostColumn>> {
        self.columns
            .iter()
            .map(|c| {
                let read = |t: &Tensor<2>| to_vec(t.clone(), &c.name);
                Ok(HostColumn { name: c.name.clone(), width: c.value.dims()[1], arrays: [read(&c.value)?, read(&c.first_moment)?, read(&c.second_moment)?] })
            })
            .collect()
    }
    /// The number of Gaussians N.
    pub fn len(&self) -> usize {
        self.columns[0].value.dims()[0]
    }
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// The column called `name`, if there is one.
    pub fn column(&self, name: &str) -> Option<&Column> {
        self.columns.iter().find(|c| c.name == name)
    }
    /// The values as host Gaussians.
    pub fn host_gaussians(&self) -> Result<HostGaussians> {
        host_gaussians(self.sh_degree, self.columns.iter().map(|c| Ok((c.name.clone(), c.value.dims()[1], to_vec(c.value.clone(), &c.name)?))))
    }
    /// Leaves for one step: tracked tensors whose gradient [`GaussianSet::update`] takes; only columns in `learn` are tracked.
    pub fn leaves(&self, learn: &[&str]) -> Vec<Tensor<2>> {
        self.columns
            .iter()
            .map(|c| {
                let leaf = Tensor::<2>::from_inner(c.value.clone());
                if learn.contains(&c.name.as_str()) || (learn.contains(&"extra") && !CORE_COLUMNS.contains(&c.name.as_str())) {
                    leaf.require_grad()
                } else {
                    leaf
                }
            })
            .collect()
    }
    /// The leaf of the column called `name`, out of `leaves` in the order of the columns; zero columns wide if there is none.
    pub fn leaf(&self, leaves: &[Tensor<2>], name: &str) -> Tensor<2> {
        let found = self.columns.iter().zip(leaves).find(|(c, _)| c.name == name).map(|(_, leaf)| leaf.clone());
        found.unwrap_or_else(|| Tensor::zeros([self.len(), 0], &leaves[0].device()))
    }
    /// Adds the attributes of `wanted` that there are not, with their start values and zero moments.
    pub fn add_attributes(&mut self, wanted: &[AttributeSpec], seed: Seed) {
        for spec in wanted.iter().filter(|spec| self.column(&spec.name).is_none()).collect::<Vec<_>>() {
            let (count, own) = ((self.len() * spec.width) as u64, seed.child(&spec.name));
            // 24 bits of the seed, in -1..1.
            let noise = |k: u64| (own.index(k).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0;
            let values: Vec<f32> = (0..count).map(|k| if spec.spread == 0.0 { spec.start } else { spec.start + spec.spread * noise(k) }).collect();
            let value = Tensor::<2>::from_data(TensorData::new(values, [self.len(), spec.width]), &self.columns[0].value.device());
            self.columns.push(Column { name: spec.name.clone(), first_moment: value.zeros_like(), second_moment: value.zeros_like(), value });
        }
    }
    /// The Gaussians made of `leaves`.
    pub fn gaussians(&self, leaves: &[Tensor<2>]) -> Gaussians {
        let n = self.len();
        Gaussians {
            sh_degree: self.sh_degree,
            means: leaves[0].clone(),
            log_scales: leaves[1].clone(),
            quaternions: leaves[2].clone(),
            opacity_logits: leaves[3].clone().reshape([n]),
            sh_dc: leaves[4].clone(),
            sh_rest: leaves[5].clone().reshape([n, sh_rest_len(self.sh_degree), 3]),
            dynamic_scores: leaves[6].clone().reshape([n]),
            extra: self.columns.iter().zip(leaves).skip(7).map(|(c, t)| (c.name.clone(), t.clone())).collect(),
        }
    }
    /// One Adam step with the gradients in `gradients` (one per column, `None` is skipped) at the rates of `rate`.
    /// Rows of `visible` that are zero keep values and moments.
    pub fn update(&mut self, gradients: Vec<Option<Tensor<2>>>, rate: impl Fn(&str) -> f64, visible: Option<&Tensor<1, Int>>) -> Result<()> {
        self.step += 1;
        for (column, gradient) in self.columns.iter_mut().zip(gradients) {
            let Some(gradient) = gradient else { continue };
            let settings = AdamSettings { visible: visible.cloned(), ..AdamSettings::new(rate(&column.name), self.step) };
            let device = column.value.device();
            let empty = || Tensor::<2>::empty([0, 0], &device);
            // Moving the tensors out keeps them uniquely held, so that the step happens in place.
            let value = std::mem::replace(&mut column.value, empty());
            let first = std::mem::replace(&mut column.first_moment, empty());
            let second = std::mem::replace(&mut column.second_moment, empty());
            let stepped = adam_step(value, first, second, gradient, &settings)?;
            (column.value, column.first_moment, column.second_moment) = (stepped.param, stepped.m, stepped.v);
        }
        Ok(())
    }
}

/// Assembles host Gaussians from named columns.
pub fn host_gaussians(sh_degree: usize, columns: impl Iterator<Item = Result<(String, usize, Vec<f32>)>>) -> Result<HostGaussians> {
    let mut host = HostGaussians { sh_degree, ..Default::default() };
    for column in columns {
        let (name, width, values) = column?;
        if CORE_COLUMNS.contains(&name.as_str()) {
            for (known, _, slot) in host.columns_mut() {
                if known == name {
                    *slot = values;
                    break;
                }
            }
        } else {
            host.extra.insert(name, ExtraAttribute::exact(width, values));
        }
    }
    Ok(host)
}

/// The learning rate of a column at `progress` in 0..1 of its stage; positions move with the camera `extent`.
pub fn gaussian_rate(rates: &GaussianRates, name: &str, progress: f64, extent: f64) -> f64 {
    match name {
        "means" => log_linear(rates.means, rates.means_end, progress) * extent,
        "log_scales" => rates.log_scales,
        "quaternions" => rates.quaternions,
        "opacity_logits" => rates.opacity,
        "sh_dc" => rates.sh_dc,
        "sh_rest" => rates.sh_rest,
        "dynamic_scores" => rates.score,
        _ => rates.extra,
    }
}

/// Interpolates the logarithm from `start` to `end`.
pub fn log_linear(start: f64, end: f64, progress: f64) -> f64 {
    if start <= 0.0 || end <= 0.0 { start + (end - start) * progress } else { (start.ln() + (end.ln() - start.ln()) * progress.clamp(0.0, 1.0)).exp() }
}
