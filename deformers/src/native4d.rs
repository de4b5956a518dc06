//! Gaussians of space and time (4D-GS, Yang et al. 2024), conditioned on a time.
//!
//! A Gaussian over (x, y, z, t) with covariance S, conditioned on a time s, is a Gaussian over space: its centre moves by S_xt / S_tt (s - t), its covariance
//! is the Schur complement S_xx - S_xt S_tx / S_tt at all times, and its weight is exp(-(s - t)^2 / 2 S_tt). The map from S to (Schur complement, S_xt / S_tt,
//! S_tt) is one to one, so nothing is lost by learning those three: an ordinary Gaussian, a velocity and a duration. The published code learns a rotation and
//! scales in four dimensions instead. Both represent the same Gaussians, but the optimizer takes other steps.

use crate::parts::centres::check_time;
use crate::parts::settings::{not_negative, within};
use burn::tensor::{Device, Tensor};
use cc4dgs_core::{
    AttributeSpec, Deformer, DeformerContext, DeformerPlugin, DeformerWork, Error, Offsets, Parameter, ParameterGroup, Plugin, Result, SPACE_TIME_ATTRIBUTES,
    SpatialFeatures, SpatialInput, config, inventory,
};
use serde::Deserialize;
use std::f32::consts::TAU;

const SCHEMA: &str = "\
duration = 0.1414        # standard deviation in time of a new Gaussian, as a share of the sequence (published: sqrt(2) of 10 s on N3DV; sqrt(s / 5) of s seconds)
hidden_below = 0.05      # a Gaussian whose opacity factor is below this is hidden
harmonics = 2            # number of cosines of time by which colours change (4D spherical harmonics); 0 for constant colours
period = 1.0             # that of the first cosine, in sequences
harmonics_every = 0.0    # cosines are used one after the other at this share of the main stage, after the degrees of colours; 0: all from the start
time_lr = 1.6e-5         # Adam on the centre in time, times the extent of the cameras in the normalised frame (published: 1.6e-4 of seconds; 10 s on N3DV)
duration_lr = 5e-3       # Adam on the logarithm of the duration
velocity_lr = 1e-3       # Adam on the velocity in world units per sequence, times the extent of the cameras in the normalised frame
velocity_extent = true   # false: not times the extent. Published: two quaternions at 1e-3, which is a velocity at 2e-3 of world units per unit of time
color_lr = 1.25e-4       # Adam on the cosines' coefficients
";

/// Name of the cosines' coefficients, the last attribute after [`SPACE_TIME_ATTRIBUTES`].
const COLORS: &str = "sh_time";
/// Logarithm of the opacity factor of a hidden Gaussian.
const HIDDEN: f32 = -30.0;
/// Largest absolute logarithm of a duration: beyond it, quotients and their derivatives are not finite.
const MOST_LOG: f32 = 30.0;

#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    duration: f32,
    hidden_below: f32,
    harmonics: usize,
    period: f32,
    harmonics_every: f32,
    time_lr: f64,
    duration_lr: f64,
    velocity_lr: f64,
    velocity_extent: bool,
    color_lr: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            duration: 0.1414,
            hidden_below: 0.05,
            harmonics: 2,
            period: 1.0,
            harmonics_every: 0.0,
            time_lr: 1.6e-5,
            duration_lr: 5e-3,
            velocity_lr: 1e-3,
            velocity_extent: true,
            color_lr: 1.25e-4,
        }
    }
}

/// It has no weights: everything learned is an attribute of Gaussians.
struct Native4d {
    settings: Settings,
    /// Degree of the spherical harmonics, and their coefficients per channel.
    degree: usize,
    basis: usize,
    /// How many cosines are used yet.
    open: usize,
}

impl Native4d {
    fn new(settings: Settings, context: &DeformerContext) -> Result<Self> {
        within("harmonics", settings.harmonics, 0, 8)?;
        let s = &settings;
        not_negative(&[("time_lr", s.time_lr), ("duration_lr", s.duration_lr), ("velocity_lr", s.velocity_lr), ("color_lr", s.color_lr)])?;
        let bad = |name: &str, value: f32, remedy: &str| Err(Error::parameter(format!("deformer.{name}"), format!("{value} cannot be used"), remedy));
        if !(settings.duration > 1e-4 && settings.duration < 1e4) {
            return bad("duration", settings.duration, "Give a share of the sequence, such as 0.14");
        }
        if !(0.0..1.0).contains(&settings.hidden_below) {
            return bad("hidden_below", settings.hidden_below, "Give a factor from 0 to below 1");
        }
        if !(settings.period > 1e-4 && settings.period < 1e4) {
            return bad("period", settings.period, "Give a multiple of the sequence; 1 is usual");
        }
        if !(0.0..=1.0).contains(&settings.harmonics_every) {
            return bad("harmonics_every", settings.harmonics_every, "Give a share of the main stage, such as 0.033, or 0 for all cosines from the start");
        }
        let degree = context.sh_degree;
        Ok(Self { open: settings.harmonics, settings, degree, basis: (degree + 1).pow(2) })
    }
    /// Columns of the features that belong to each attribute.
    fn widths(&self) -> [usize; 4] {
        [1, 1, 3, 3 * self.basis * self.settings.harmonics]
    }
}

impl Deformer for Native4d {
    fn attributes(&self) -> Vec<AttributeSpec> {
        let s = &self.settings;
        // Initial centres in time reach a tenth of the sequence beyond either end, as in the published code.
        let starts = [(0.5, 0.6), (s.duration.ln(), 0.0), (0.0, 0.0), (0.0, 0.0)];
        let rates = [(s.time_lr, true), (s.duration_lr, false), (s.velocity_lr, s.velocity_extent), (s.color_lr, false)];
        let names = SPACE_TIME_ATTRIBUTES.map(|(name, _)| name).into_iter().chain([COLORS]);
        let all = names.zip(self.widths()).zip(starts).zip(rates);
        all.filter(|(((_, width), _), _)| *width > 0)
            .map(|(((name, width), (start, spread)), (lr, times_extent))| AttributeSpec { spread, times_extent, ..AttributeSpec::new(name, width, start, lr) })
            .collect()
    }
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        input.check("native-4d", &self.attributes())?;
        let work = DeformerWork { gaussians: input.len() as u64, ..DeformerWork::default() };
        Ok(SpatialFeatures { values: Tensor::cat(input.attributes.clone(), 1), work })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        check_time(time_norm)?;
        let [m, _] = features.dims();
        let part = |at: usize, width: usize| features.clone().narrow(1, at, width);
        let since = part(0, 1).neg().add_scalar(time_norm);
        let in_durations = since.clone() / part(1, 1).clamp(-MOST_LOG, MOST_LOG).exp();
        let factor = in_durations.powi_scalar(2).mul_scalar(-0.5).reshape([m]);
        let hidden = factor.clone().lower_elem(self.settings.hidden_below.max(f32::MIN_POSITIVE).ln());
        let sh = (self.settings.harmonics > 0).then(|| {
            let width = 3 * self.basis;
            let wave = |n: usize| part(5 + (n - 1) * width, width) * since.clone().mul_scalar(TAU / self.settings.period * n as f32).cos();
            let sum = (1..=self.open).map(wave).reduce(|sum, next| sum + next);
            sum.unwrap_or_else(|| Tensor::zeros([m, width], &features.device())).reshape([m, self.basis, 3])
        });
        Ok(Offsets { means: Some(part(2, 3) * since.clone()), opacity_log_factor: Some(factor.mask_fill(hidden, HIDDEN)), sh, ..Offsets::default() })
    }
    fn parameters(&self) -> Vec<&Parameter> {
        Vec::new()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        Vec::new()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        Vec::new()
    }
    fn set_progress(&mut self, progress: f32) {
        let (every, all) = (self.settings.harmonics_every, self.settings.harmonics);
        // Those of the first degrees of colours are counted, too. All are used at the end, however long the interval.
        let steps = if every > 0.0 && progress < 1.0 { (progress / every) as usize } else { usize::MAX };
        self.open = steps.saturating_sub(self.degree).min(all);
    }
}

fn build(section: &toml::Table, context: &DeformerContext, _device: &Device) -> Result<Box<dyn Deformer>> {
    Ok(Box::new(Native4d::new(config::parse_section("deformer native-4d", section)?, context)?))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "native-4d",
            version: "1",
            summary: "Gaussians of space and time, conditioned on time: a velocity, a duration and changing colours per Gaussian",
            paper: "4D-GS (Yang et al. 2024)",
            schema: SCHEMA,
            capabilities: &["differentiable", "per-gaussian-attributes"],
        },
        build,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::TensorData;
    use cc4dgs_core::Seed;
    use cc4dgs_core::gaussians::to_vec;

    #[test]
    fn cosines_follow_the_degrees_of_colours() {
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 20, sh_degree: 1, seed: Seed::root(2) };
        let mut field = Native4d::new(Settings { harmonics_every: 0.1, ..Settings::default() }, &context).unwrap();
        let features = Tensor::<2>::ones([1, field.widths().iter().sum()], &Device::flex());
        let mut color = |progress: Option<f32>| {
            progress.iter().for_each(|&progress| field.set_progress(progress));
            field.deform(features.clone(), 1.0).unwrap().sh.map_or(0.0, |sh| to_vec(sh, "colours").unwrap()[0])
        };
        // At its own time every cosine is 1. A model that is only played has all of them.
        assert_eq!([None, Some(0.01), Some(0.15), Some(0.25), Some(0.35), Some(1.0), Some(0.15)].map(&mut color), [2.0, 0.0, 0.0, 1.0, 2.0, 2.0, 0.0]);
        assert!(Native4d::new(Settings { harmonics_every: f32::NAN, ..Settings::default() }, &context).is_err());
        // A quarter of a sequence from its own time: half of a short period, and hardly anything of a long one.
        for (period, wanted) in [(0.5, -1.0 + 1.0), (1.0, 0.0 - 1.0), (50.0, 2.0)] {
            let field = Native4d::new(Settings { period, ..Settings::default() }, &context).unwrap();
            let color = to_vec(field.deform(features.clone(), 0.75).unwrap().sh.unwrap(), "colours").unwrap()[0];
            assert!((color - wanted).abs() < 5e-3, "period {period}: {color}");
        }
        assert!(Native4d::new(Settings { period: 0.0, ..Settings::default() }, &context).is_err());
    }

    #[test]
    fn extreme_durations_have_finite_factors_and_gradients() {
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 20, sh_degree: 0, seed: Seed::root(2) };
        let field = Native4d::new(Settings { harmonics: 0, ..Settings::default() }, &context).unwrap();
        // Centre in time, logarithm of the duration, velocity: at its moment, apart from it, and there at all times.
        let rows: [[f32; 5]; 3] = [[0.5, -120.0, 1.0, 0.0, 0.0], [0.2, -120.0, 1.0, 0.0, 0.0], [0.2, 120.0, 1.0, 0.0, 0.0]];
        let features = Tensor::<2>::from_data(TensorData::new(rows.concat(), [3, 5]), &Device::flex().autodiff()).require_grad();
        let factors = field.deform(features.clone(), 0.5).unwrap().opacity_log_factor.unwrap();
        let values = to_vec(factors.clone().inner(), "factors").unwrap();
        assert!(values[0] == 0.0 && values[1] == HIDDEN && values[2].abs() < 1e-6, "{values:?}");
        let gradients = factors.sum().backward();
        let gradient = to_vec(features.grad(&gradients).unwrap(), "gradient").unwrap();
        assert!(gradient.iter().all(|v| v.is_finite()), "{gradient:?}");
    }
}
