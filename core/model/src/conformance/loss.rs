//! The conformance suite of loss terms.

use super::{guarded, settings_are_defaults, uniform, within};
use crate::gaussians::to_vec;
use crate::{AttributeSpec, Camera, ExtraAttribute, Gaussians, HostGaussians, LossInput, LossPlugin, LossTerm, Registry, Result, Schedule, Seed, Split, View};
use burn::tensor::{Device, Gradients, Int, Tensor, TensorData};

/// Image size of the suite.
const SIZE: [usize; 2] = [17, 23];
/// The depth of every n-th pixel is unknown, for this n.
const UNKNOWN: usize = 5;
/// Gaussians of the suite.
const COUNT: usize = 6;
/// Largest difference between a value as drawn and the canonical one.
const OFFSET: f32 = 0.3;
/// What findings write before the name of a canonical column.
const CANONICAL: &str = "canonical ";
/// Largest relative difference between a finite difference along the gradient and the gradient's norm.
const SLOPE_TOLERANCE: f64 = 0.05;
/// Change of values that have no gradient, and the largest relative change of the loss that is allowed for it.
const MOVE: f32 = 0.01;
const UNMOVED: f64 = 1e-5;
/// Largest factor by which a value may grow where there are four times as many pixels or Gaussians of the same kind. That of a sum is 4.
const MOST_GROWTH: f64 = 2.0;
/// Largest relative difference between a fused term and the sum of its parts.
const FUSED_TOLERANCE: f64 = 1e-4;

/// Tests a loss term on `device`. Each finding is a line; an empty list means that it passed.
///
/// - Its schema is TOML and states the defaults; unknown settings are refused; nothing panics.
/// - The value is one finite number and repeats bit for bit.
/// - It is no sum over pixels or Gaussians: four times as many, with the same values, do not give more than twice the value.
/// - Gradients of the planes, of the Gaussians as drawn and of the canonical ones agree with finite differences.
/// - Images of one pixel, sets without Gaussians, views without recorded depth and depth that is unknown everywhere give a value or `None`.
/// - Where the Gaussians stand still, as in the coarse stage, value and gradients are finite.
/// - A fused term is the weighted sum of the terms it replaces, which are looked up in `registry`.
pub fn loss(plugin: &LossPlugin, settings: &toml::Table, registry: &Registry, device: &Device) -> Vec<String> {
    loss_of_attributes(plugin, settings, &[], registry, device)
}

/// As [`loss`], for a term that reads attributes of a deformer in [`Gaussians::extra`]: the Gaussians have `attributes`, too, and gradients of these agree with
/// finite differences. Gaussians without them, as in the coarse stage, give a value or `None`.
pub fn loss_of_attributes(plugin: &LossPlugin, settings: &toml::Table, attributes: &[AttributeSpec], registry: &Registry, device: &Device) -> Vec<String> {
    let suite = Suite { plugin, settings, attributes, registry, device };
    guarded(
        &format!("{} on {device:?}", plugin.info.name),
        vec![
            ("settings", Box::new(|| suite.settings_are_read())),
            ("value", Box::new(|| suite.value_is_a_number())),
            ("normalisation", Box::new(|| suite.value_does_not_grow_with_counts())),
            ("gradients", Box::new(|| suite.gradients_are_slopes())),
            ("odd inputs", Box::new(|| suite.odd_inputs_are_answered())),
            ("standing still", Box::new(|| suite.what_stands_still_has_a_gradient())),
            ("fusion", Box::new(|| suite.fused_is_the_sum())),
        ],
    )
}

struct Suite<'a> {
    plugin: &'a LossPlugin,
    settings: &'a toml::Table,
    attributes: &'a [AttributeSpec],
    registry: &'a Registry,
    device: &'a Device,
}

/// Values of one input, row-major.
#[derive(Clone)]
struct Inputs {
    /// `[5,H,W]`.
    planes: Vec<f32>,
    /// `[3,H,W]`.
    target: Vec<f32>,
    /// Recorded depth `[1,H,W]`, of some pixels; for terms that want it.
    depth: Option<Vec<f32>>,
    /// As drawn.
    gaussians: HostGaussians,
    canonical: HostGaussians,
    size: [usize; 2],
}

/// What tracks gradients in one input.
struct Leaves {
    planes: Tensor<3>,
    gaussians: Gaussians,
    canonical: Gaussians,
}

impl Leaves {
    /// Gradients by name, the planes' first; `None` where none arrives.
    fn gradients(&self, gradients: &Gradients) -> Result<Vec<(String, Option<Vec<f32>>)>> {
        fn flat<const D: usize>(values: &Tensor<D>, gradients: &Gradients) -> Result<Option<Vec<f32>>> {
            values.grad(gradients).map(|gradient| to_vec(gradient, "gradient")).transpose()
        }
        let mut found = vec![("planes".to_string(), flat(&self.planes, gradients)?)];
        for (prefix, g) in [("", &self.gaussians), (CANONICAL, &self.canonical)] {
            let columns = [
                ("means", flat(&g.means, gradients)?),
                ("log_scales", flat(&g.log_scales, gradients)?),
                ("quaternions", flat(&g.quaternions, gradients)?),
                ("opacity_logits", flat(&g.opacity_logits, gradients)?),
                ("sh_dc", flat(&g.sh_dc, gradients)?),
                ("sh_rest", flat(&g.sh_rest, gradients)?),
            ];
            found.extend(columns.map(|(name, gradient)| (format!("{prefix}{name}"), gradient)));
            for (name, values) in &g.extra {
                found.push((format!("{prefix}{name}"), flat(values, gradients)?));
            }
        }
        Ok(found)
    }
}

/// The Gaussians as leaves.
fn tracked(g: Gaussians) -> Gaussians {
    Gaussians {
        means: g.means.require_grad(),
        log_scales: g.log_scales.require_grad(),
        quaternions: g.quaternions.require_grad(),
        opacity_logits: g.opacity_logits.require_grad(),
        sh_dc: g.sh_dc.require_grad(),
        sh_rest: g.sh_rest.require_grad(),
        extra: g.extra.into_iter().map(|(name, values)| (name, values.require_grad())).collect(),
        ..g
    }
}

/// The input of a view of `size` with `count` Gaussians, which have `attributes` and were moved.
fn inputs(size: [usize; 2], count: usize, attributes: &[AttributeSpec]) -> Inputs {
    let (seed, pixels) = (Seed::root(51), size[0] * size[1]);
    let draw = |shift: usize, k: usize| 0.5 + 0.45 * uniform(seed, 1_000_000 * shift + k);
    let columns = |width: usize, shift: usize, centre: f32| (0..count * width).map(|k| centre + uniform(seed, 2_000_000 * shift + k)).collect::<Vec<f32>>();
    let gaussians = HostGaussians {
        sh_degree: 1,
        means: columns(3, 3, 0.0),
        log_scales: columns(3, 4, -2.0),
        quaternions: columns(4, 5, 1.5),
        opacity_logits: columns(1, 6, 0.0),
        sh_dc: columns(3, 7, 0.0),
        sh_rest: columns(9, 8, 0.0),
        dynamic_scores: columns(1, 9, 0.0),
        extra: attributes
            .iter()
            .enumerate()
            .map(|(index, spec)| (spec.name.clone(), ExtraAttribute::exact(spec.width, columns(spec.width, 10 + index, spec.start))))
            .collect(),
    };
    let mut canonical = gaussians.clone();
    for (index, (.., values)) in canonical.columns_mut().into_iter().filter(|(name, ..)| *name != "dynamic_scores").enumerate() {
        let seed = Seed::root(53).index(index as u64);
        values.iter_mut().enumerate().for_each(|(k, value)| *value += OFFSET * uniform(seed, k));
    }
    let planes = (0..5 * pixels).map(|k| draw(1, k)).collect();
    let depth = (0..pixels).map(|k| if k % UNKNOWN == UNKNOWN - 1 { 0.0 } else { draw(5, k) }).collect();
    Inputs { planes, target: (0..3 * pixels).map(|k| draw(2, k)).collect(), depth: Some(depth), gaussians, canonical, size }
}

/// The same images twice in each direction.
fn tiled(inputs: &Inputs) -> Inputs {
    let [height, width] = inputs.size;
    let twice = |planes: &Vec<f32>| -> Vec<f32> {
        let wide = |plane: &[f32]| plane.chunks_exact(width).flat_map(|row| [row, row].concat()).collect::<Vec<f32>>();
        planes.chunks_exact(height * width).flat_map(|plane| wide(plane).repeat(2)).collect()
    };
    let (planes, target, depth) = (twice(&inputs.planes), twice(&inputs.target), inputs.depth.as_ref().map(twice));
    Inputs { planes, target, depth, size: [2 * height, 2 * width], ..inputs.clone() }
}

/// The same Gaussians four times.
fn repeated(inputs: &Inputs) -> Inputs {
    let rows = (0..inputs.gaussians.len()).collect::<Vec<usize>>().repeat(4);
    Inputs { gaussians: inputs.gaussians.select(&rows), canonical: inputs.canonical.select(&rows), ..inputs.clone() }
}

/// The planes, or a column or attribute of the Gaussians by name.
fn values_of<'a>(inputs: &'a mut Inputs, name: &str) -> Option<&'a mut Vec<f32>> {
    if name == "planes" {
        return Some(&mut inputs.planes);
    }
    let (set, name) = match name.strip_prefix(CANONICAL) {
        Some(name) => (&mut inputs.canonical, name),
        None => (&mut inputs.gaussians, name),
    };
    if set.extra.contains_key(name) {
        return set.extra.get_mut(name).map(|attribute| &mut attribute.values);
    }
    set.columns_mut().into_iter().find(|(column, ..)| *column == name).map(|(.., values)| values)
}

impl Suite<'_> {
    fn settings_are_read(&self) -> Result<Option<String>> {
        let value = |settings: &toml::Table| self.number((self.plugin.build)(settings)?.as_ref(), &self.inputs(SIZE, COUNT));
        settings_are_defaults("loss", &self.plugin.info, self.settings, value)
    }
    fn inputs(&self, size: [usize; 2], count: usize) -> Inputs {
        inputs(size, count, self.attributes)
    }
    fn term(&self) -> Result<Box<dyn LossTerm>> {
        (self.plugin.build)(self.settings)
    }
    /// The value and its inputs; they track gradients if `track` is set.
    fn value(&self, term: &dyn LossTerm, inputs: &Inputs, track: bool) -> Result<(Option<Tensor<1>>, Leaves)> {
        let device = self.device.clone().autodiff();
        let [h, w] = inputs.size;
        let leaf = |values: &[f32], shape: [usize; 3]| Tensor::<3>::from_data(TensorData::new(values.to_vec(), shape), &device);
        let constant = |values: &[f32], planes: usize| Tensor::<3>::from_inner(leaf(values, [planes, h, w]).inner());
        let (planes, target) = (leaf(&inputs.planes, [5, h, w]), constant(&inputs.target, 3));
        let depth = inputs.depth.as_ref().filter(|_| term.wants_depth()).map(|depth| constant(depth, 1));
        let [gaussians, canonical] = [&inputs.gaussians, &inputs.canonical].map(|host| Gaussians::from_host(host, &device));
        let mut leaves = Leaves { planes, gaussians, canonical };
        if track {
            leaves = Leaves { planes: leaves.planes.require_grad(), gaussians: tracked(leaves.gaussians), canonical: tracked(leaves.canonical) };
        }
        let radii = Tensor::<1, Int>::ones([inputs.gaussians.len()], self.device);
        // One focal length whatever the size: values may depend on it.
        let fov = 2.0 * (w as f64 / SIZE[1] as f64 * 0.5f64.tan()).atan();
        let camera = Camera::look_at("conformance", (w as u32, h as u32), fov, [1.0, -2.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let (view, schedule) = (View { camera: 0, frame: 4, time_norm: 0.4, split: Split::Train }, Schedule::main(100));
        let Leaves { planes, gaussians, canonical } = &leaves;
        let input = LossInput::new(&camera, &view, planes, &target, gaussians, &radii, &schedule).moved_from(canonical);
        Ok((term.value(&input.with_depth(depth.as_ref()))?, leaves))
    }
    fn number(&self, term: &dyn LossTerm, inputs: &Inputs) -> Result<f64> {
        let value = self.value(term, inputs, false)?.0;
        Ok(value.map_or(Ok(vec![0.0]), |v| to_vec(v, "value"))?.first().map_or(f64::NAN, |v| f64::from(*v)))
    }
    fn value_is_a_number(&self) -> Result<Option<String>> {
        let (term, inputs) = (self.term()?, self.inputs(SIZE, COUNT));
        let Some(value) = self.value(term.as_ref(), &inputs, true)?.0 else { return Ok(Some("it returns no value for an ordinary view".into())) };
        if value.dims() != [1] {
            return Ok(Some(format!("its value has shape {:?}, expected [1]", value.dims())));
        }
        let (first, second) = (self.number(term.as_ref(), &inputs)?, self.number(term.as_ref(), &inputs)?);
        Ok((!first.is_finite() || first != second).then(|| format!("two values of one input are {first} and {second}")))
    }
    /// Weights of terms mean the same at every image size, and however many Gaussians density control leaves.
    fn value_does_not_grow_with_counts(&self) -> Result<Option<String>> {
        let (term, inputs) = (self.term()?, self.inputs(SIZE, COUNT));
        let once = self.number(term.as_ref(), &inputs)?;
        for (what, more) in [("pixels", tiled(&inputs)), ("Gaussians", repeated(&inputs))] {
            let found = self.number(term.as_ref(), &more)?;
            if !within(found, MOST_GROWTH * once.abs()) {
                return Ok(Some(format!("four times as many {what} take the value from {once:.4e} to {found:.4e}: divide it by their number")));
            }
        }
        Ok(None)
    }
    fn gradients_are_slopes(&self) -> Result<Option<String>> {
        let (term, inputs) = (self.term()?, self.inputs(SIZE, COUNT));
        let (value, leaves) = self.value(term.as_ref(), &inputs, true)?;
        let Some(value) = value else { return Ok(None) };
        let changed = |name: &str, change: &dyn Fn(usize, &mut f32)| {
            let mut changed = inputs.clone();
            values_of(&mut changed, name).into_iter().flatten().enumerate().for_each(|(k, value)| change(k, value));
            changed
        };
        let mut reached = 0;
        for (name, gradient) in leaves.gradients(&value.backward())? {
            // Terms may leave the graph on purpose, but not for the planes.
            let Some(gradient) = gradient.or_else(|| (name == "planes").then(Vec::new)) else { continue };
            let norm = gradient.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
            if !norm.is_finite() {
                return Ok(Some(format!("the gradient of {name} has norm {norm}")));
            }
            if norm == 0.0 {
                let moved = changed(&name, &|k: usize, value: &mut f32| *value += MOVE * uniform(Seed::root(57), k));
                let (before, after) = (self.number(term.as_ref(), &inputs)?, self.number(term.as_ref(), &moved)?);
                if !within(before - after, UNMOVED * before.abs().max(1.0)) {
                    return Ok(Some(format!("no gradient reaches {name}, but a change of it takes the loss from {before:.6e} to {after:.6e}")));
                }
                continue;
            }
            reached += 1;
            // The first steps may be below the rounding error, the last may cross kinks.
            let mut slopes = Vec::new();
            for step in [3e-3, 1e-2, 3e-2] {
                let mut ends = [0.0; 2];
                for (end, sign) in ends.iter_mut().zip([1.0, -1.0]) {
                    let moved = changed(&name, &|k: usize, value: &mut f32| *value += (sign * step * f64::from(gradient[k]) / norm) as f32);
                    *end = self.number(term.as_ref(), &moved)?;
                }
                slopes.push((ends[0] - ends[1]) / (2.0 * step));
            }
            if !slopes.iter().any(|slope| (slope / norm - 1.0).abs() <= SLOPE_TOLERANCE) {
                return Ok(Some(format!("{name}: the loss rises by {slopes:.6?} per unit along its gradient of norm {norm:.6}")));
            }
        }
        Ok((reached == 0).then(|| "no gradient reaches the planes or the Gaussians".into()))
    }
    fn odd_inputs_are_answered(&self) -> Result<Option<String>> {
        let term = self.term()?;
        for (what, inputs) in [
            ("one pixel", self.inputs([1, 1], COUNT)),
            ("no Gaussians", self.inputs(SIZE, 0)),
            ("one row", self.inputs([1, 30], 1)),
            ("Gaussians without attributes", inputs(SIZE, COUNT, &[])),
            ("no depth", Inputs { depth: None, ..self.inputs(SIZE, COUNT) }),
            ("depth that is unknown everywhere", Inputs { depth: Some(vec![0.0; SIZE[0] * SIZE[1]]), ..self.inputs(SIZE, COUNT) }),
        ] {
            let value = self.number(term.as_ref(), &inputs)?;
            if !value.is_finite() {
                return Ok(Some(format!("with {what} the value is {value}")));
            }
        }
        Ok(None)
    }
    fn what_stands_still_has_a_gradient(&self) -> Result<Option<String>> {
        let (term, inputs) = (self.term()?, self.inputs(SIZE, COUNT));
        let still = Inputs { canonical: inputs.gaussians.clone(), ..inputs };
        let (Some(value), leaves) = self.value(term.as_ref(), &still, true)? else { return Ok(None) };
        let number = to_vec(value.clone(), "value")?.first().copied().unwrap_or(f32::NAN);
        if !number.is_finite() {
            return Ok(Some(format!("its value is {number}")));
        }
        let broken = |gradient: &Option<Vec<f32>>| gradient.iter().flatten().any(|v| !v.is_finite());
        let found = leaves.gradients(&value.backward())?;
        Ok(found.iter().find(|(_, gradient)| broken(gradient)).map(|(name, _)| format!("the gradient of {name} is not finite")))
    }
    fn fused_is_the_sum(&self) -> Result<Option<String>> {
        let Some(fusion) = &self.plugin.fuses else { return Ok(None) };
        let inputs = self.inputs(SIZE, COUNT);
        let weights: Vec<f64> = (0..fusion.kinds.len()).map(|k| 0.3 + 0.9 * k as f64).collect();
        let fused = self.number((fusion.build)(&weights)?.as_ref(), &inputs)?;
        let mut sum = 0.0;
        for (kind, weight) in fusion.kinds.iter().zip(&weights) {
            sum += weight * self.number((self.registry.loss(kind)?.build)(&toml::Table::new())?.as_ref(), &inputs)?;
        }
        Ok((!within(fused - sum, FUSED_TOLERANCE * sum.abs())).then(|| format!("with weights {weights:?} it is {fused}, the sum of its terms is {sum}")))
    }
}

#[cfg(test)]
#[cfg(feature = "cpu")]
mod tests;
