//! A velocity and a life per Gaussian, for what appears, vanishes or crosses a scene faster than smooth functions follow (FreeTimeGS, with the gate of
//! FreeTimeGS++ and the flat-topped life of SharpTimeGS).
//!
//! A life has a centre T, a half-width r during which the Gaussian is fully there, and a falloff s. The centre of the Gaussian moves by v (t - T), its opacity is
//! multiplied by g + (1 - g) exp(-(max(|t - T| - r, 0) / s)^2). A gate g of 1 keeps it at all times.
//!
//! [`Life`] is the formula; [`WithLife`] adds it to any deformer, for sections with `life = true` or a table of [`LifeSettings`].

use crate::deformer::Simplified;
use crate::{AttributeSpec, Deformer, DeformerWork, Error, Offsets, Parameter, ParameterGroup, Result, SpatialFeatures, SpatialInput, config};
use burn::tensor::Tensor;
use burn::tensor::activation::sigmoid;
use serde::{Deserialize, Serialize};

/// Names of the attributes, in order, and their widths.
pub const LIFE_ATTRIBUTES: [(&str, usize); 5] = [("life_center", 1), ("life_log_half_width", 1), ("life_log_falloff", 1), ("life_gate", 1), ("velocity", 3)];
/// Floats per Gaussian.
const WIDTH: usize = 7;
/// How steep the gate is in its attribute (FreeTimeGS++).
const GATE_STEEPNESS: f32 = 20.0;
/// Least falloff, as a share of the sequence: a smaller one has no gradient.
const LEAST_FALLOFF: f32 = 1e-3;
/// Logarithm of the opacity factor of a hidden Gaussian.
const HIDDEN: f32 = -30.0;
/// The key of a `[deformer]` section that adds lives.
const KEY: &str = "life";

/// Where lives start and how they are learned.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LifeSettings {
    /// Start of r, as a share of the sequence.
    pub half_width: f32,
    /// Start of s, as a share of the sequence.
    pub falloff: f32,
    /// Start of the gate, 0..1: nearly 1 is nearly as without time.
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
    /// Adam on the velocity in world units per sequence, times the extent of the cameras.
    pub velocity_lr: f64,
}

impl Default for LifeSettings {
    /// Beside another deformer: all Gaussians last, and only those that are added with a life of their own have one.
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
        }
    }
}

/// The value of the attribute `life_gate` for a gate `gate` in 0..1. That of 0 and 1 is finite; float32 rounds their gates to 0 and 1.
pub fn gate_value(gate: f32) -> f32 {
    ((gate / (1.0 - gate)).ln() / GATE_STEEPNESS).clamp(-1.0, 1.0)
}

/// What lives change at a time, for M Gaussians.
pub struct LifeAt {
    /// v (t - T), world units `[M,3]`.
    pub shift: Tensor<2>,
    /// Logarithm of the factor of the opacity `[M]`.
    pub log_factor: Tensor<1>,
    /// 1 - g: 0 for Gaussians that are there at all times `[M,1]`.
    pub temporary: Tensor<2>,
}

/// The formula, for Gaussians that carry [`LIFE_ATTRIBUTES`].
pub struct Life {
    settings: LifeSettings,
}

impl Life {
    /// Refuses settings out of their range.
    ///
    /// # Errors
    /// [`Error::Parameter`] that names the setting.
    pub fn new(settings: LifeSettings) -> Result<Self> {
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
        let spec =
            |(((name, width), (start, spread)), lr)| AttributeSpec { spread, times_extent: name == "velocity", ..AttributeSpec::new(name, width, start, lr) };
        LIFE_ATTRIBUTES.into_iter().zip(starts).zip(rates).map(spec).collect()
    }
    /// The changes at `times_norm`, for attributes side by side `[M,7]`.
    pub fn at(&self, attributes: Tensor<2>, times_norm: &[f32]) -> Vec<LifeAt> {
        let [m, _] = attributes.dims();
        let column = |at: usize| attributes.clone().narrow(1, at, 1);
        let (center, half_width, velocity) = (column(0), column(1).exp(), attributes.clone().narrow(1, 4, 3));
        let falloff = column(2).exp().clamp_min(LEAST_FALLOFF);
        let gate = sigmoid(column(3).mul_scalar(GATE_STEEPNESS));
        let temporary = gate.clone().neg().add_scalar(1.0);
        let at = |&time_norm: &f32| {
            let since = center.clone().neg().add_scalar(time_norm);
            let outside = (since.clone().abs() - half_width.clone()).clamp_min(0.0);
            let in_falloffs = outside / falloff.clone();
            let life = (in_falloffs.clone() * in_falloffs).clamp_max(-HIDDEN).neg().exp();
            let factor = (gate.clone() + temporary.clone() * life).clamp(HIDDEN.exp(), 1.0);
            let hidden = factor.clone().lower_elem(self.settings.hidden_below).reshape([m]);
            let log_factor = factor.log().reshape([m]).mask_fill(hidden, HIDDEN);
            LifeAt { shift: velocity.clone() * since, log_factor, temporary: temporary.clone() }
        };
        times_norm.iter().map(at).collect()
    }
    /// The mean of 1 - gate with its weight, from the values of `life_gate` `[M,1]`.
    pub fn regularizer(&self, gates: Tensor<2>) -> Option<Tensor<1>> {
        let open = (self.settings.gate_weight > 0.0 && gates.dims()[0] > 0).then(|| sigmoid(gates.mul_scalar(GATE_STEEPNESS)).mean());
        Some(open?.neg().add_scalar(1.0).mul_scalar(self.settings.gate_weight))
    }
}

/// Takes `life` out of the settings of a deformer; `None` where it is absent or false.
///
/// # Errors
/// [`Error::Parameter`] for anything but a boolean or a table of [`LifeSettings`].
pub(crate) fn take_life(settings: &mut toml::Table) -> Result<Option<Life>> {
    match settings.remove(KEY) {
        None | Some(toml::Value::Boolean(false)) => Ok(None),
        Some(toml::Value::Boolean(true)) => Life::new(LifeSettings::default()).map(Some),
        Some(toml::Value::Table(table)) => Life::new(config::parse_section("deformer.life", &table)?).map(Some),
        Some(other) => Err(Error::parameter("deformer.life", format!("{other} is neither true, false nor a table"), "Give `life = true`")),
    }
}

/// A deformer whose Gaussians have lives too.
pub(crate) struct WithLife {
    inner: Box<dyn Deformer>,
    life: Life,
}

impl WithLife {
    /// Adds lives to `inner`.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a deformer that has an attribute of the same name.
    pub fn new(inner: Box<dyn Deformer>, life: Life) -> Result<Self> {
        match inner.attributes().iter().find(|a| LIFE_ATTRIBUTES.iter().any(|(name, _)| a.name == *name)) {
            Some(own) => Err(Error::parameter("deformer.life", format!("the deformer has an attribute '{}' of its own", own.name), "Remove `life`")),
            None => Ok(Self { inner, life }),
        }
    }
    /// The input of the inner deformer, and the attributes of lives side by side `[M,7]`.
    fn divide(&self, input: &SpatialInput) -> Result<(SpatialInput, Tensor<2>)> {
        input.check("with lives", &self.attributes())?;
        let mut own = input.clone();
        let lives = own.attributes.split_off(own.attributes.len() - LIFE_ATTRIBUTES.len());
        Ok((own, Tensor::cat(lives, 1)))
    }
    /// The attributes of lives `[M,7]`, and the features of the inner deformer, which a static one does not have.
    fn split(features: Tensor<2>) -> (Tensor<2>, Option<Tensor<2>>) {
        let [m, width] = features.dims();
        if width == WIDTH {
            return (features, None);
        }
        if m == 0 {
            let empty = |width| Tensor::zeros([0, width], &features.device());
            return (empty(WIDTH), Some(empty(width - WIDTH)));
        }
        let flat = features.reshape([m * width]);
        let inner = flat.clone().narrow(0, m * WIDTH, m * (width - WIDTH)).reshape([m, width - WIDTH]);
        (flat.narrow(0, 0, m * WIDTH).reshape([m, WIDTH]), Some(inner))
    }
}

impl Deformer for WithLife {
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        let (own, lives) = self.divide(input)?;
        if self.inner.is_static() || input.is_empty() {
            let [m, _] = lives.dims();
            let width = if self.inner.is_static() { 0 } else { self.inner.spatial(&own)?.values.dims()[1] };
            let values = if width == 0 { lives } else { Tensor::zeros([m, WIDTH + width], &lives.device()) };
            return Ok(SpatialFeatures { values, work: DeformerWork { gaussians: m as u64, ..DeformerWork::default() } });
        }
        let inner = self.inner.spatial(&own)?;
        // One after the other in memory, because the layout of the inner features is their own.
        let [m, width] = inner.values.dims();
        let flat = Tensor::cat(vec![lives.reshape([m * WIDTH]), inner.values.reshape([m * width])], 0);
        Ok(SpatialFeatures { values: flat.reshape([m, WIDTH + width]), work: inner.work })
    }
    fn attributes(&self) -> Vec<AttributeSpec> {
        self.inner.attributes().into_iter().chain(self.life.attributes()).collect()
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        Ok(self.deform_all(features, &[time_norm])?.pop().unwrap_or_default())
    }
    fn deform_all(&self, features: Tensor<2>, times_norm: &[f32]) -> Result<Vec<Offsets>> {
        if let Some(time_norm) = times_norm.iter().find(|time_norm| !time_norm.is_finite()) {
            return Err(Error::parameter("deformer time", format!("{time_norm} is not a number"), "Use a time in 0..1"));
        }
        let (lives, inner) = Self::split(features);
        let inner = match inner {
            Some(inner) => self.inner.deform_all(inner, times_norm)?,
            None => times_norm.iter().map(|_| Offsets::default()).collect(),
        };
        let with_life = |(mut offsets, LifeAt { shift, log_factor, temporary }): (Offsets, LifeAt)| {
            // What is there at all times is moved by the inner deformer alone; its velocity and its life have no gradient.
            let shift = shift * temporary;
            offsets.means = Some(offsets.means.map_or(shift.clone(), |means| means + shift));
            offsets.opacity_log_factor = Some(offsets.opacity_log_factor.map_or(log_factor.clone(), |own| own + log_factor));
            offsets
        };
        Ok(inner.into_iter().zip(self.life.at(lives, times_norm)).map(with_life).collect())
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.inner.parameters()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.inner.parameters_mut()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        self.inner.groups()
    }
    fn caches_spatial(&self) -> bool {
        self.inner.caches_spatial()
    }
    fn regularizer(&self, input: &SpatialInput, time_norm: f32, progress: f32) -> Result<Option<Tensor<1>>> {
        let gates = input.attributes.get(input.attributes.len().saturating_sub(2)).cloned();
        let (own, _) = self.divide(input)?;
        let inner = self.inner.regularizer(&own, time_norm, progress)?;
        Ok(match (inner, gates.and_then(|gates| self.life.regularizer(gates))) {
            (Some(a), Some(b)) => Some(a + b),
            (a, b) => a.or(b),
        })
    }
    fn set_progress(&mut self, progress: f32) {
        self.inner.set_progress(progress);
    }
    fn simplified(&self, features: Tensor<2>, times: &[f32]) -> Result<Option<Simplified>> {
        let (_, Some(inner)) = Self::split(features) else { return Ok(None) };
        let Some(mut simple) = self.inner.simplified(inner, times)? else { return Ok(None) };
        simple.field = Box::new(Self { inner: simple.field, life: Life { settings: self.life.settings.clone() } });
        let table = toml::Table::try_from(&self.life.settings);
        let table = table.map_err(|e| Error::backend("deformer.life", e.to_string(), "Report this as a defect"))?;
        simple.settings.insert(KEY.into(), table.into());
        Ok(Some(simple))
    }
    fn size_bytes(&self) -> (u64, u64) {
        self.inner.size_bytes()
    }
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;
    use crate::gaussians::to_vec;
    use burn::tensor::Device;

    #[test]
    fn lives_are_flat_then_fall_off_and_open_gates_last() {
        let device = Device::flex();
        let life = Life::new(LifeSettings::default()).unwrap();
        // Centre 0.5, half-width 0.1, falloff 0.1, velocity 2 along x; the gate is shut, then open.
        let (r, s) = (0.1f32.ln(), 0.1f32.ln());
        let attributes = Tensor::<2>::from_floats([[0.5, r, s, -1.0, 2.0, 0.0, 0.0], [0.5, r, s, 1.0, 2.0, 0.0, 0.0]], &device);
        let at = |time: f32| {
            let LifeAt { shift, log_factor, .. } = life.at(attributes.clone(), &[time]).remove(0);
            (to_vec(log_factor, "f").unwrap(), to_vec(shift, "m").unwrap())
        };
        let (inside, means) = at(0.55);
        assert!(inside[0].abs() < 1e-4 && inside[1].abs() < 1e-4 && (means[0] - 0.1).abs() < 1e-5, "{inside:?} {means:?}");
        let (falling, _) = at(0.7);
        assert!((falling[0] + 1.0).abs() < 1e-3 && falling[1].abs() < 1e-4, "{falling:?}");
        let (gone, _) = at(1.0);
        assert!(gone[0] == HIDDEN && gone[1].abs() < 1e-4, "{gone:?}");
    }

    #[test]
    fn settings_of_lives_are_read_and_refused() {
        let parse = |text: &str| take_life(&mut toml::from_str::<toml::Table>(text).unwrap());
        assert!(parse("").unwrap().is_none() && parse("life = false").unwrap().is_none());
        assert!(parse("life = true").unwrap().is_some());
        assert!(parse("life = { half_width = 0.2 }").unwrap().is_some_and(|life| life.settings.half_width == 0.2));
        for bad in ["life = 3", "life = { half_width = -1.0 }", "life = { width = 1.0 }"] {
            assert!(parse(bad).is_err(), "{bad}");
        }
    }
}
