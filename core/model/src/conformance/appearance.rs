//! The conformance suite of appearance models.

use super::{guarded, settings_are_defaults, uniform, weights, within};
use crate::gaussians::to_vec;
use crate::{Appearance, AppearanceContext, AppearancePlugin, Result, Seed, check_parameters};
use burn::tensor::{Device, Tensor, TensorData};

/// Planes of the suite `[5,H,W]`.
const SHAPE: [usize; 3] = [5, 7, 9];
/// Training cameras.
const CAMERAS: usize = 4;
/// Largest relative difference between a finite difference along the gradient and the gradient's norm.
const SLOPE_TOLERANCE: f64 = 0.02;
/// Size of the random changes of the weights.
const SHAKE: f32 = 0.1;

/// Tests an appearance model on `device`. Each finding is a line; an empty list means that it passed.
///
/// - Its schema is TOML and states the defaults; unknown settings are refused; nothing panics.
/// - A new model is the identity.
/// - For a camera that was not trained on, the planes are unchanged bit for bit, with any weights.
/// - Alpha and depth are unchanged; planes keep their shape and are finite.
/// - Gradients of weights and planes agree with finite differences.
/// - Parameters have unique names, matching shapes and existing groups.
pub fn appearance(plugin: &AppearancePlugin, settings: &toml::Table, device: &Device) -> Vec<String> {
    let suite = Suite { plugin, settings, device };
    guarded(
        &format!("{} on {device:?}", plugin.info.name),
        vec![
            ("settings", Box::new(|| suite.settings_are_read())),
            ("parameters", Box::new(|| suite.parameters_are_sound())),
            ("identity", Box::new(|| suite.identity_where_promised())),
            ("gradients", Box::new(|| suite.gradients_are_slopes())),
        ],
    )
}

struct Suite<'a> {
    plugin: &'a AppearancePlugin,
    settings: &'a toml::Table,
    device: &'a Device,
}

fn context() -> AppearanceContext {
    AppearanceContext { cameras: CAMERAS, seed: Seed::root(61) }
}

fn values(shift: usize) -> Vec<f32> {
    (0..SHAPE.iter().product()).map(|k| 0.5 + 0.4 * uniform(Seed::root(63).index(shift as u64), k)).collect()
}

impl Suite<'_> {
    fn settings_are_read(&self) -> Result<Option<String>> {
        settings_are_defaults("appearance", &self.plugin.info, self.settings, |settings| {
            let built = Suite { plugin: self.plugin, settings, device: self.device }.shaken(self.device)?;
            let weights = weights::values(&built.parameters())?;
            let term = built.regularizer()?.map(|term| to_vec(term, "regularizer")).transpose()?;
            Ok((weights, built.groups(), term))
        })
    }
    fn fresh(&self, device: &Device) -> Result<Box<dyn Appearance>> {
        (self.plugin.build)(self.settings, &context(), device)
    }
    fn shaken(&self, device: &Device) -> Result<Box<dyn Appearance>> {
        let mut built = self.fresh(device)?;
        weights::change(built.parameters_mut(), device, |index, k| SHAKE * uniform(Seed::root(65).index(index as u64), k))?;
        Ok(built)
    }
    fn planes(&self, values: Vec<f32>, device: &Device) -> Tensor<3> {
        Tensor::from_data(TensorData::new(values, SHAPE), device)
    }
    fn parameters_are_sound(&self) -> Result<Option<String>> {
        let built = self.fresh(self.device)?;
        check_parameters(self.plugin.info.name, &built.parameters(), &built.groups()).map(|()| None)
    }
    fn identity_where_promised(&self) -> Result<Option<String>> {
        let rendered = values(0);
        let apply = |model: &dyn Appearance, camera| to_vec(model.apply(self.planes(rendered.clone(), self.device), camera)?, "planes");
        let fresh = self.fresh(self.device)?;
        for camera in 0..CAMERAS {
            if apply(fresh.as_ref(), Some(camera))?.iter().zip(&rendered).any(|(a, b)| !within(f64::from(a - b), 1e-6)) {
                return Ok(Some(format!("a new model changes the image of camera {camera}")));
            }
        }
        let shaken = self.shaken(self.device)?;
        if apply(shaken.as_ref(), None)? != rendered {
            return Ok(Some("the planes of a camera that was not trained on are changed".into()));
        }
        for camera in 0..CAMERAS {
            let recorded = apply(shaken.as_ref(), Some(camera))?;
            let colour = 3 * SHAPE[1] * SHAPE[2];
            if recorded.len() != rendered.len() || recorded[colour..] != rendered[colour..] || !recorded.iter().all(|v| v.is_finite()) {
                return Ok(Some(format!("camera {camera}: alpha or depth changed, or planes have another shape or are not finite")));
            }
        }
        Ok(None)
    }
    fn gradients_are_slopes(&self) -> Result<Option<String>> {
        let device = self.device.clone().autodiff();
        let mut built = self.shaken(&device)?;
        let weights: Vec<Tensor<3>> = (0..CAMERAS).map(|camera| Tensor::from_inner(self.planes(values(1 + camera), self.device))).collect();
        // Every camera takes part: each may have weights of its own.
        let measure = |model: &dyn Appearance, planes: Tensor<3>| -> Result<Tensor<1>> {
            let mut loss = model.regularizer()?.unwrap_or_else(|| Tensor::zeros([1], &device));
            for (camera, weights) in weights.iter().enumerate() {
                loss = loss + (model.apply(planes.clone(), Some(camera))? * weights.clone()).sum();
            }
            Ok(loss)
        };
        let planes = self.planes(values(0), &device).require_grad();
        let gradients = measure(built.as_ref(), planes.clone())?.backward();
        let slope = |ends: [f64; 2], step: f64| (ends[0] - ends[1]) / (2.0 * step);
        let number = |t: Tensor<1>| -> Result<f64> { Ok(to_vec(t, "value")?.first().map_or(f64::NAN, |v| f64::from(*v))) };
        let step = 2e-2;
        let of_weights = |model: &(dyn Appearance + 'static)| number(measure(model, planes.clone())?);
        if let Some(finding) = weights::slopes(built.as_mut(), |m| m.parameters(), |m| m.parameters_mut(), (&gradients, step), of_weights)? {
            return Ok(Some(finding));
        }
        let Some(gradient) = planes.grad(&gradients) else { return Ok(Some("no gradient reaches the planes".into())) };
        let gradient = to_vec(gradient, "gradient")?;
        let norm = gradient.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        let mut ends = [0.0; 2];
        for (end, sign) in ends.iter_mut().zip([1.0, -1.0]) {
            let moved = values(0).iter().zip(&gradient).map(|(s, g)| s + (sign * step * f64::from(*g) / norm) as f32).collect();
            *end = number(measure(built.as_ref(), self.planes(moved, &device))?)?;
        }
        let found = slope(ends, step);
        Ok((norm == 0.0 || !within(found / norm - 1.0, SLOPE_TOLERANCE))
            .then(|| format!("planes: the loss rises by {found:.5} per unit along its gradient of norm {norm:.5}")))
    }
}
