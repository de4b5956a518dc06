//! The Gaussians under optimisation: every attribute is an array `[N, width]` by name, so that growing, pruning, checkpoints and attributes of plug-ins need no
//! list of names.

use crate::config::GaussianRates;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::gaussians::CORE_ATTRIBUTES;
use cc4dgs_core::{AttributeSpec, Error, Gaussians, HostGaussians, Result, Schedule, Seed, Stage};

/// All Gaussians under optimisation; plain tensors, never tracked.
#[derive(Clone, Debug)]
pub struct GaussianSet {
    /// Spherical-harmonics degree stored.
    pub sh_degree: usize,
    /// Attributes by name `[N, width]`, the core ones first.
    attributes: Vec<(String, Tensor<2>)>,
}

impl GaussianSet {
    /// Uploads `host`.
    pub fn new(host: &HostGaussians, device: &Device) -> Self {
        Self::from_gaussians(&Gaussians::from_host(host, device))
    }
    /// The attributes of `gaussians`.
    pub fn from_gaussians(gaussians: &Gaussians) -> Self {
        let attributes = gaussians.attribute_names().into_iter().filter_map(|name| Some((gaussians.attribute(&name)?, name))).map(|(t, name)| (name, t));
        Self { sh_degree: gaussians.sh_degree, attributes: attributes.collect() }
    }
    /// The number of Gaussians N.
    pub fn len(&self) -> usize {
        self.attributes.first().map_or(0, |(_, values)| values.dims()[0])
    }
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// The attribute called `name` `[N, width]`.
    pub fn get(&self, name: &str) -> Result<&Tensor<2>> {
        let found = self.attributes.iter().find(|(known, _)| known == name);
        found.map(|(_, values)| values).ok_or_else(|| Error::backend(format!("attribute {name}"), "the Gaussians do not have it", "Report this as a defect"))
    }
    /// Replaces the values of the attribute called `name`, rows unchanged.
    pub fn set(&mut self, name: &str, values: Tensor<2>) -> Result<()> {
        let dims = self.get(name)?.dims();
        if dims != values.dims() {
            return Err(Error::backend(
                format!("attribute {name}"),
                format!("new values have shape {:?}, expected {dims:?}", values.dims()),
                "Report this as a defect",
            ));
        }
        self.slots().filter(|(known, _)| *known == name).for_each(|(_, slot)| *slot = values.clone());
        Ok(())
    }
    /// All attributes by name, to be replaced.
    pub fn slots(&mut self) -> impl Iterator<Item = (&str, &mut Tensor<2>)> {
        self.attributes.iter_mut().map(|(name, values)| (name.as_str(), values))
    }
    /// All attributes by name.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Tensor<2>)> {
        self.attributes.iter().map(|(name, values)| (name.as_str(), values))
    }
    /// The values as Gaussians.
    pub fn gaussians(&self) -> Result<Gaussians> {
        Gaussians::from_attributes(self.sh_degree, self.attributes.iter().cloned())
    }
    /// The values on the host.
    pub fn host_gaussians(&self) -> Result<HostGaussians> {
        self.gaussians()?.to_host()
    }
    /// Leaves for one step; those for whose name `learn` is true are tracked.
    pub fn leaves(&self, learn: impl Fn(&str) -> bool) -> Leaves {
        let leaf = |(name, values): &(String, Tensor<2>)| {
            let leaf = Tensor::<2>::from_inner(values.clone());
            (name.clone(), if learn(name) { leaf.require_grad() } else { leaf })
        };
        Leaves { sh_degree: self.sh_degree, tensors: self.attributes.iter().map(leaf).collect() }
    }
    /// Adds the attributes of `wanted` that there are not, with their start values.
    pub fn add_attributes(&mut self, wanted: &[AttributeSpec], seed: Seed) -> Result<()> {
        let device = self.get(CORE_ATTRIBUTES[0])?.device();
        for spec in wanted {
            if let Ok(found) = self.get(&spec.name) {
                if found.dims()[1] != spec.width {
                    let problem = format!("the Gaussians have it with width {}, the deformer wants {}", found.dims()[1], spec.width);
                    return Err(Error::parameter(format!("attribute {}", spec.name), problem, "Rename the deformer's attribute"));
                }
                continue;
            }
            let (count, own) = ((self.len() * spec.width) as u64, seed.child(&spec.name));
            // 24 bits of the seed, in -1..1.
            let noise = |k: u64| (own.index(k).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0;
            let values: Vec<f32> = (0..count).map(|k| if spec.spread == 0.0 { spec.start } else { spec.start + spec.spread * noise(k) }).collect();
            self.attributes.push((spec.name.clone(), Tensor::from_data(TensorData::new(values, [self.len(), spec.width]), &device)));
        }
        // The order of a checkpoint that is read back.
        self.attributes[CORE_ATTRIBUTES.len()..].sort_by(|a, b| a.0.cmp(&b.0));
        Ok(())
    }
}

/// The attributes as leaves of one step's gradient, by name.
pub struct Leaves {
    sh_degree: usize,
    tensors: Vec<(String, Tensor<2>)>,
}

impl Leaves {
    /// The leaf called `name` `[N, width]`.
    pub fn get(&self, name: &str) -> Result<&Tensor<2>> {
        let found = self.tensors.iter().find(|(known, _)| known == name).map(|(_, leaf)| leaf);
        found.ok_or_else(|| Error::backend(format!("attribute {name}"), "the Gaussians do not have it", "Report this as a defect"))
    }
    /// The Gaussians made of the leaves.
    pub fn gaussians(&self) -> Result<Gaussians> {
        Gaussians::from_attributes(self.sh_degree, self.tensors.iter().cloned())
    }
    /// The gradient of every leaf that has one, by name.
    pub fn gradients(&self, gradients: &burn::tensor::Gradients) -> Vec<(String, Tensor<2>)> {
        self.tensors.iter().filter_map(|(name, leaf)| Some((name.clone(), leaf.grad(gradients)?))).collect()
    }
}

/// The learning rate of a core attribute at `schedule`; that of positions is multiplied by the extent of the cameras in the normalised frame.
pub fn gaussian_rate(rates: &GaussianRates, name: &str, schedule: &Schedule) -> f64 {
    match name {
        "means" => {
            let progress = schedule.progress();
            let way = match schedule.stage {
                Stage::Coarse => rates.coarse_decay * progress,
                _ => rates.main_decay + (1.0 - rates.main_decay) * (progress / rates.main_until).min(1.0),
            };
            log_linear(rates.means, rates.means_end, way) * f64::from(schedule.extent)
        }
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
