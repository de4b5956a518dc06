//! Lives of Gaussians, for content that appears, vanishes or crosses a scene faster than smooth functions follow: settings, attributes, and the formula of
//! [`cc4dgs_backends::ops::life`].

use crate::parts::centres::check_time;
use crate::parts::settings::not_negative;
use burn::tensor::Tensor;
use burn::tensor::activation::sigmoid;
use cc4dgs_backends::ops::columns::beside;
use cc4dgs_backends::ops::life::{LEAST_FALLOFF, LifeAt, LifeRules, lives};
use cc4dgs_core::{AttributeSpec, Error, LIFE_ATTRIBUTES, LIFE_GATE_STEEPNESS, Result, gate_value, ordered_sum};
use serde::{Deserialize, Serialize};

/// Where lives start and how they are learned.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LifeSettings {
    /// Start of r, as a share of the sequence.
    pub half_width: f32,
    /// Start of s, as a share of the sequence.
    pub falloff: f32,
    /// Start of the gate, 0..1; near 1 a Gaussian is visible at all times.
    pub gate: f32,
    /// Centres of life start up to this far from the middle of the sequence, as a share of it.
    pub spread: f32,
    /// Weight of the mean of 1 - gate; 0 is off.
    pub gate_weight: f32,
    /// A Gaussian whose opacity factor is below this is hidden.
    pub hidden_below: f32,
    /// Adam on T, as a share of the sequence.
    pub center_lr: f64,
    /// Adam on the logarithms of r and s.
    pub width_lr: f64,
    /// Adam on the gate's logit over 20.
    pub gate_lr: f64,
    /// Adam on the velocity in world units per sequence, times the extent of the cameras in the normalised frame.
    pub velocity_lr: f64,
    /// The same at the end of the main stage, reached log-linearly (FreeTimeGS: a hundredth of it); `None` is no fall.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub velocity_lr_end: Option<f64>,
}

impl Default for LifeSettings {
    /// Defaults of the layer `life`: Gaussians are visible at all times, unless they are added with a life of their own.
    fn default() -> Self {
        Self {
            half_width: 0.05,
            falloff: 0.1,
            gate: 1.0,
            spread: 0.0,
            gate_weight: 0.0,
            hidden_below: 0.01,
            center_lr: 1.6e-4,
            width_lr: 5e-3,
            gate_lr: 0.0,
            velocity_lr: 1.6e-3,
            velocity_lr_end: None,
        }
    }
}

/// Lives with these settings, for Gaussians that carry [`LIFE_ATTRIBUTES`].
pub struct Life {
    settings: LifeSettings,
}

impl Life {
    /// Refuses settings out of their range.
    ///
    /// # Errors
    /// [`Error::Parameter`] that names the setting.
    pub fn new(settings: LifeSettings) -> Result<Self> {
        let s = &settings;
        not_negative(&[
            ("center_lr of lives", s.center_lr),
            ("width_lr of lives", s.width_lr),
            ("gate_lr of lives", s.gate_lr),
            ("velocity_lr of lives", s.velocity_lr),
            ("velocity_lr_end of lives", s.velocity_lr_end.unwrap_or(0.0)),
        ])?;
        let limits = [
            ("half_width", settings.half_width, 1e-4, 10.0),
            ("falloff", settings.falloff, LEAST_FALLOFF, 10.0),
            ("gate", settings.gate, 0.0, 1.0),
            ("spread", settings.spread, 0.0, 10.0),
            ("gate_weight", settings.gate_weight, 0.0, 1.0),
            ("hidden_below", settings.hidden_below, 0.0, 0.999),
        ];
        match limits.into_iter().find(|(_, value, least, most)| !(*least..=*most).contains(value)) {
            Some((name, value, least, most)) => {
                Err(Error::parameter(format!("deformer: {name} of lives"), format!("{value} is not in {least}..{most}"), "Choose a value in this range"))
            }
            None => Ok(Self { settings }),
        }
    }
    /// The attributes, in the order of [`LIFE_ATTRIBUTES`].
    pub fn attributes(&self) -> Vec<AttributeSpec> {
        let s = &self.settings;
        let starts = [(0.5, s.spread), (s.half_width.ln(), 0.0), (s.falloff.ln(), 0.0), (gate_value(s.gate), 0.0), (0.0, 0.0)];
        let rates = [s.center_lr, s.width_lr, s.width_lr, s.gate_lr, s.velocity_lr];
        let spec = |(((name, width), (start, spread)), lr)| {
            let moves = name == "velocity";
            let lr_end = s.velocity_lr_end.filter(|_| moves);
            AttributeSpec { spread, lr_end, times_extent: moves, ..AttributeSpec::new(name, width, start, lr) }
        };
        LIFE_ATTRIBUTES.into_iter().zip(starts).zip(rates).map(spec).collect()
    }
    /// The settings.
    pub fn settings(&self) -> &LifeSettings {
        &self.settings
    }
    /// The changes at `times_norm`, for attributes side by side `[M,7]`. With `gated_velocity`, velocities are multiplied by 1 - g.
    ///
    /// # Errors
    /// [`Error::Parameter`] for times that are not finite.
    pub fn at(&self, attributes: Tensor<2>, times_norm: &[f32], gated_velocity: bool) -> Result<Vec<LifeAt>> {
        times_norm.iter().try_for_each(|&time_norm| check_time(time_norm))?;
        if attributes.dims()[0] == 0 {
            let device = attributes.device();
            let none = |_: &f32| LifeAt { shift: Tensor::zeros([0, 3], &device), log_factor: Tensor::zeros([0], &device) };
            return Ok(times_norm.iter().map(none).collect());
        }
        lives(attributes, LifeRules { times_norm: times_norm.to_vec(), hidden_below: self.settings.hidden_below, gated_velocity })
    }
    /// The mean of 1 - gate with its weight, from the values of `life_gate` `[M,1]`.
    pub fn regularizer(&self, gates: Tensor<2>) -> Option<Tensor<1>> {
        let [count, _] = gates.dims();
        let open = || ordered_sum(sigmoid(gates.mul_scalar(LIFE_GATE_STEEPNESS))).div_scalar(count as f32);
        Some((self.settings.gate_weight > 0.0 && count > 0).then(open)?.neg().add_scalar(1.0).mul_scalar(self.settings.gate_weight))
    }
}

/// The attributes of lives, in their order, side by side `[M,7]`.
pub fn side_by_side(attributes: Vec<Tensor<2>>) -> Tensor<2> {
    attributes.try_into().map_or_else(|attributes| Tensor::cat(attributes, 1), beside)
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;
    use cc4dgs_backends::ops::life::WIDTH;

    #[test]
    fn times_that_are_no_numbers_are_refused_without_gaussians_too() {
        let life = Life::new(LifeSettings::default()).unwrap();
        let at = |time_norm: f32| life.at(Tensor::zeros([0, WIDTH], &Device::flex()), &[0.5, time_norm], true);
        assert!(at(f32::NAN).is_err() && at(f32::INFINITY).is_err());
        assert_eq!(at(0.2).unwrap().len(), 2);
    }

    #[test]
    fn the_rate_of_velocities_alone_falls_and_only_where_it_is_stated() {
        let ends = |settings: &str| {
            let life = Life::new(toml::from_str(settings).unwrap()).unwrap();
            life.attributes().into_iter().map(|a| (a.lr, a.lr_end)).collect::<Vec<_>>()
        };
        assert_eq!(ends("velocity_lr_end = 1.6e-5"), [(1.6e-4, None), (5e-3, None), (5e-3, None), (0.0, None), (1.6e-3, Some(1.6e-5))]);
        assert!(ends("velocity_lr = 0.1").iter().all(|(_, end)| end.is_none()));
        // What is not stated is not stored either.
        assert!(!toml::Table::try_from(LifeSettings::default()).unwrap().contains_key("velocity_lr_end"));
    }
}
