//! The conformance suite of deformers.

mod gradients;
mod rows;

use super::{guarded, uniform, within};
use crate::gaussians::to_vec;
use crate::{
    Deformer, DeformerContext, DeformerPlugin, Error, HostGaussians, Offsets, Result, Seed, SpatialInput, check_attributes, check_parameters, config,
    start_deformer,
};
use burn::tensor::{Device, Tensor, TensorData};

/// Largest difference of offsets from packed features or at several times at once, as a share of the largest offset: sums may run in another order.
const PACKED_TOLERANCE: f32 = 1e-5;
/// Largest root-mean-square difference of a simplified deformer's offsets, over the root-mean-square of the offsets.
const SIMPLIFIED_TOLERANCE: f64 = 0.5;
/// Size of the random changes of weights, so that no head is zero.
const SHAKE: f32 = 0.1;
/// Centres of the suite.
const CENTRES: usize = 48;

/// Tests a deformer on `device`:
/// - its schema is TOML and states the defaults; unknown settings are refused; nothing panics;
/// - equal seeds give equal weights; weights, parameters and attributes have unique names, matching shapes and existing groups;
/// - every head has its shape; offsets have the same heads at every time and at every progress of training, are finite, and repeat bit for bit;
/// - a deformer that declares `starts-as-identity` moves nothing initially, a static one never does;
/// - gradients of all weights and of all attributes agree with finite differences, through the offsets and through the regularizer; a regularizer has a
///   gradient for every array that it depends on;
/// - offsets depend on features, weights, progress and time alone, whatever was asked in between, and those of a Gaussian not on which others are asked about
///   with it;
/// - several times at once give the offsets of each; packed features give the same offsets; weights can be copied to a new deformer, bit for bit;
/// - `start_from` changes nothing but values of weights, whatever the number of Gaussians, and stored models are opened without it;
/// - what `simplified` returns can be built again from its settings, and moves Gaussians in nearly the same way;
/// - no centres, one centre and centres that are not finite give offsets or errors; missing attributes and times that are not numbers are refused.
///
/// `settings` is the `[deformer]` section without `kind`; small sizes make the suite fast. Each finding is a line; an empty list means that it passed.
pub fn deformer(plugin: &DeformerPlugin, settings: &toml::Table, device: &Device) -> Vec<String> {
    let suite = Suite { plugin, settings, device };
    guarded(
        &format!("{} on {device:?}", plugin.info.name),
        vec![
            ("settings", Box::new(|| suite.refuses_unknown_settings())),
            ("schema", Box::new(|| suite.schema_states_the_defaults())),
            ("attributes", Box::new(|| suite.attributes_are_sound())),
            ("seeds", Box::new(|| suite.equal_seeds_equal_weights())),
            ("start", Box::new(|| suite.starts_as_declared())),
            ("shapes", Box::new(|| suite.offsets_are_sound())),
            ("gradients", Box::new(|| suite.gradients_are_slopes())),
            ("regularizer", Box::new(|| suite.regularizer_is_sound())),
            ("progress", Box::new(|| suite.progress_is_followed())),
            ("weights", Box::new(|| suite.weights_carry_everything())),
            ("features", Box::new(|| suite.features_carry_everything())),
            ("rows", Box::new(|| suite.rows_do_not_depend_on_others())),
            ("several times", Box::new(|| suite.several_times_are_each())),
            ("packed", Box::new(|| suite.packing_changes_nothing())),
            ("simplified", Box::new(|| suite.simplified_does_the_same())),
            ("odd inputs", Box::new(|| suite.odd_inputs_are_answered())),
        ],
    )
}

struct Suite<'a> {
    plugin: &'a DeformerPlugin,
    settings: &'a toml::Table,
    device: &'a Device,
}

type Built = Box<dyn Deformer>;

impl Suite<'_> {
    fn context(&self) -> DeformerContext {
        DeformerContext { box_min: [-1.0, -0.5, 0.0], box_max: [1.0, 0.5, 2.0], frame_count: 20, sh_degree: 2, seed: Seed::root(11).child("conformance") }
    }
    /// A deformer as it is built for a stored model, before its weights are replaced.
    fn opened(&self, device: &Device) -> Result<Built> {
        (self.plugin.build)(self.settings, &self.context(), device)
    }
    /// A deformer at the start of a training, from `count` Gaussians.
    fn started(&self, count: usize, device: &Device) -> Result<Built> {
        let mut built = self.opened(device)?;
        start_deformer(self.plugin.info.name, built.as_mut(), &self.first(count))?;
        Ok(built)
    }
    fn fresh(&self, device: &Device) -> Result<Built> {
        self.started(CENTRES, device)
    }
    /// The first Gaussians of a training.
    fn first(&self, count: usize) -> HostGaussians {
        let mut first = HostGaussians { sh_degree: self.context().sh_degree, ..Default::default() };
        for (index, (_, width, values)) in first.columns_mut().into_iter().enumerate() {
            *values = (0..count * width).map(|k| uniform(Seed::root(19).index(index as u64), k)).collect();
        }
        first.means = Self::centre_values(count);
        first
    }
    /// A deformer with random changes of all weights.
    fn shaken(&self, device: &Device) -> Result<Built> {
        let mut built = self.fresh(device)?;
        for (index, parameter) in built.parameters_mut().into_iter().enumerate() {
            let seed = Seed::root(5).index(index as u64);
            let moved: Vec<f32> = to_vec(parameter.value.clone(), "weights")?.iter().enumerate().map(|(k, v)| v + SHAKE * uniform(seed, k)).collect();
            let n = moved.len();
            let value = Tensor::<1>::from_data(TensorData::new(moved, [n]), device);
            parameter.value = if value.is_autodiff() { value.require_grad() } else { value };
        }
        Ok(built)
    }
    /// Centres inside the box and a few outside, row-major.
    fn centre_values(n: usize) -> Vec<f32> {
        let (scale, shift) = ([1.1, 0.55, 1.1], [0.0, 0.0, 1.0]);
        (0..3 * n).map(|k| uniform(Seed::root(3), k) * scale[k % 3] + shift[k % 3]).collect()
    }
    fn centres(&self, n: usize, device: &Device) -> Tensor<2> {
        Tensor::from_data(TensorData::new(Self::centre_values(n), [n, 3]), device)
    }
    /// Random values of the attributes of `n` Gaussians, row-major.
    fn attribute_values(&self, built: &dyn Deformer, n: usize) -> Vec<Vec<f32>> {
        let specs = built.attributes().into_iter().enumerate();
        specs.map(|(a, spec)| (0..n * spec.width).map(|k| spec.start + (spec.spread + SHAKE) * uniform(Seed::root(9).index(a as u64), k)).collect()).collect()
    }
    /// `n` Gaussians with random attributes.
    fn input(&self, built: &dyn Deformer, n: usize, device: &Device) -> SpatialInput {
        let upload = |values: Vec<f32>, width: usize| Tensor::<2>::from_data(TensorData::new(values, [n, width]), device);
        let attributes = self.attribute_values(built, n).into_iter().zip(built.attributes()).map(|(values, spec)| upload(values, spec.width)).collect();
        SpatialInput { means_world: self.centres(n, device), attributes }
    }
    fn offsets(&self, built: &dyn Deformer, input: &SpatialInput, time_norm: f32) -> Result<Offsets> {
        let offsets = built.deform(built.spatial(input)?.values, time_norm)?;
        offsets.check(self.plugin.info.name, input.len())?;
        Ok(offsets)
    }
    fn values(&self, built: &dyn Deformer, n: usize, time_norm: f32, device: &Device) -> Result<Vec<f32>> {
        flat(self.offsets(built, &self.input(built, n, device), time_norm)?)
    }

    fn refuses_unknown_settings(&self) -> Result<Option<String>> {
        let mut settings = self.settings.clone();
        settings.insert("no_such_setting".into(), 1.into());
        Ok(match (self.plugin.build)(&settings, &self.context(), self.device) {
            Ok(_) => Some("an unknown setting was accepted".into()),
            Err(e) if !e.to_string().contains("no_such_setting") => Some(format!("the error does not name the unknown setting: {e}")),
            Err(_) => None,
        })
    }
    /// `config.toml` is written in full from the schema, so the schema's settings must build the same deformer as no settings.
    fn schema_states_the_defaults(&self) -> Result<Option<String>> {
        let stated = config::parse_table(&format!("schema of deformer {}", self.plugin.info.name), self.plugin.info.schema)?;
        let build = |settings: &toml::Table| (self.plugin.build)(settings, &self.context(), self.device);
        let (a, b) = (build(&toml::Table::new())?, build(&stated)?);
        let shapes = |d: &dyn Deformer| d.parameters().iter().map(|p| (p.name.clone(), p.shape.clone())).collect::<Vec<_>>();
        if shapes(a.as_ref()) != shapes(b.as_ref()) || a.attributes() != b.attributes() || a.groups() != b.groups() {
            return Ok(Some("its settings build another deformer than no settings".into()));
        }
        for (p, q) in a.parameters().into_iter().zip(b.parameters()) {
            if to_vec(p.value.clone(), &p.name)? != to_vec(q.value.clone(), &q.name)? {
                return Ok(Some(format!("its settings give other initial values of {} than no settings", p.name)));
            }
        }
        Ok(None)
    }
    fn attributes_are_sound(&self) -> Result<Option<String>> {
        let built = self.fresh(self.device)?;
        let specs = built.attributes();
        check_attributes(self.plugin.info.name, &specs)?;
        if built.attributes() != specs {
            return Ok(Some("two calls list other attributes".into()));
        }
        if specs.is_empty() {
            return Ok(None);
        }
        // Gaussians without the attributes belong to another model, which must be an error.
        let missing = SpatialInput::new(self.centres(CENTRES, self.device));
        Ok(built.spatial(&missing).is_ok().then(|| "Gaussians without its attributes were accepted".into()))
    }
    fn equal_seeds_equal_weights(&self) -> Result<Option<String>> {
        let (a, b) = (self.fresh(self.device)?, self.fresh(self.device)?);
        check_parameters(self.plugin.info.name, &a.parameters(), &a.groups())?;
        for (p, q) in a.parameters().into_iter().zip(b.parameters()) {
            if to_vec(p.value.clone(), &p.name)? != to_vec(q.value.clone(), &q.name)? {
                return Ok(Some(format!("{}: two deformers with one seed differ", p.name)));
            }
        }
        Ok(None)
    }
    fn starts_as_declared(&self) -> Result<Option<String>> {
        let built = self.fresh(self.device)?;
        let declared = self.plugin.info.capabilities.contains(&"starts-as-identity") || built.is_static();
        let input = SpatialInput::at_start(self.centres(CENTRES, self.device), built.as_ref());
        let moved = flat(self.offsets(built.as_ref(), &input, 0.37)?)?.into_iter().any(|v| v != 0.0);
        Ok((declared && moved).then(|| "a new deformer moves Gaussians".into()))
    }
    fn offsets_are_sound(&self) -> Result<Option<String>> {
        let built = self.shaken(self.device)?;
        let (first, second) = (self.values(built.as_ref(), CENTRES, 0.37, self.device)?, self.values(built.as_ref(), CENTRES, 0.37, self.device)?);
        if first != second {
            return Ok(Some("two calls with one input differ".into()));
        }
        if built.is_static() {
            return Ok(first.iter().any(|v| *v != 0.0).then(|| "a static deformer moves Gaussians".into()));
        }
        let later = self.values(built.as_ref(), CENTRES, 0.81, self.device)?;
        if later.len() != first.len() {
            return Ok(Some("the heads differ between times".into()));
        }
        Ok(match (first.iter().chain(&later).all(|v| v.is_finite()), first == later) {
            (false, _) => Some("offsets are not finite".into()),
            (true, true) => Some("offsets do not depend on time".into()),
            (true, false) => None,
        })
    }
    fn progress_is_followed(&self) -> Result<Option<String>> {
        let mut built = self.shaken(self.device)?;
        let trained = self.values(built.as_ref(), CENTRES, 0.37, self.device)?;
        for progress in [0.0, 0.01, 0.3, 0.7] {
            built.set_progress(progress);
            let found = self.values(built.as_ref(), CENTRES, 0.37, self.device)?;
            if found.len() != trained.len() || !found.iter().all(|v| v.is_finite()) {
                return Ok(Some(format!("at progress {progress} heads are missing or offsets are not finite")));
            }
        }
        built.set_progress(1.0);
        let found = self.values(built.as_ref(), CENTRES, 0.37, self.device)?;
        Ok((found != trained).then(|| "at progress 1 it gives other offsets than before any progress was set".into()))
    }
    fn several_times_are_each(&self) -> Result<Option<String>> {
        let built = self.shaken(self.device)?;
        let features = built.spatial(&self.input(built.as_ref(), CENTRES, self.device))?.values;
        let times = [0.37, 0.0, 0.92];
        let together = built.deform_all(features.clone(), &times)?;
        if together.len() != times.len() || !built.deform_all(features.clone(), &[])?.is_empty() {
            return Ok(Some(format!("deform_all gives offsets at {} times for {}, or some for none", together.len(), times.len())));
        }
        for (time_norm, offsets) in times.into_iter().zip(together) {
            let (found, wanted) = (flat(offsets)?, flat(built.deform(features.clone(), time_norm)?)?);
            let size = wanted.iter().fold(0.0f32, |most, v| most.max(v.abs()));
            if !all_near(&found, &wanted, PACKED_TOLERANCE * size) {
                return Ok(Some(format!("at time {time_norm}, deform_all and deform differ, for offsets of up to {size}")));
            }
        }
        Ok(None)
    }
    fn packing_changes_nothing(&self) -> Result<Option<String>> {
        let built = self.shaken(self.device)?;
        let features = built.spatial(&self.input(built.as_ref(), CENTRES, self.device))?.values;
        let packed = built.packed(features.clone());
        if packed.dims() != features.dims() {
            return Ok(Some(format!("packed features have shape {:?}, expected {:?}", packed.dims(), features.dims())));
        }
        let (plain, packed) = (flat(built.deform(features, 0.37)?)?, flat(built.deform(packed, 0.37)?)?);
        let size = plain.iter().fold(0.0f32, |most, v| most.max(v.abs()));
        Ok((!all_near(&packed, &plain, PACKED_TOLERANCE * size)).then(|| format!("packed features change offsets of up to {size}")))
    }
    fn simplified_does_the_same(&self) -> Result<Option<String>> {
        let built = self.shaken(self.device)?;
        let input = self.input(built.as_ref(), CENTRES, self.device);
        let times: Vec<f32> = (0..20).map(|f| f as f32 / 19.0).collect();
        let Some(simple) = built.simplified(built.spatial(&input)?.values, &times)? else { return Ok(None) };
        let again = (self.plugin.build)(&simple.settings, &self.context(), self.device)?;
        let shapes = |d: &dyn Deformer| d.parameters().iter().map(|p| (p.name.clone(), p.shape.clone())).collect::<Vec<_>>();
        if shapes(again.as_ref()) != shapes(simple.field.as_ref()) || again.attributes() != simple.field.attributes() {
            return Ok(Some("the settings it returns build another deformer".into()));
        }
        let bytes = |d: &dyn Deformer| d.size_bytes().0 + d.size_bytes().1;
        if bytes(simple.field.as_ref()) > bytes(built.as_ref()) {
            return Ok(Some("the simplified deformer has more weights".into()));
        }
        for time in [0.1, 0.6] {
            let means = |d: &dyn Deformer| self.offsets(d, &input, time)?.means.map_or(Ok(Vec::new()), |t| to_vec(t, "means"));
            let (before, after) = (means(built.as_ref())?, means(simple.field.as_ref())?);
            let squares = |values: &mut dyn Iterator<Item = f32>| values.map(|v| f64::from(v).powi(2)).sum::<f64>();
            let size = squares(&mut before.iter().copied());
            let error = if after.is_empty() { size } else { squares(&mut before.iter().zip(&after).map(|(a, b)| a - b)) };
            if !within(error, SIMPLIFIED_TOLERANCE.powi(2) * size) {
                return Ok(Some(format!("the simplified deformer's motion at time {time} differs by {:.0} % of it", 100.0 * (error / size).sqrt())));
            }
        }
        Ok(None)
    }
    fn weights_carry_everything(&self) -> Result<Option<String>> {
        let (built, mut copy) = (self.shaken(self.device)?, self.opened(self.device)?);
        for (to, from) in copy.parameters_mut().into_iter().zip(built.parameters()) {
            if to.name != from.name || to.shape != from.shape {
                return Ok(Some(format!("a new deformer has {} {:?}, this one has {} {:?}", to.name, to.shape, from.name, from.shape)));
            }
            let values = to_vec(from.value.clone(), &from.name)?;
            let n = values.len();
            to.value = Tensor::from_data(TensorData::new(values, [n]), self.device);
        }
        let same = self.values(built.as_ref(), CENTRES, 0.6, self.device)? == self.values(copy.as_ref(), CENTRES, 0.6, self.device)?;
        Ok((!same).then(|| "a deformer with the same weights gives other offsets".into()))
    }
    fn odd_inputs_are_answered(&self) -> Result<Option<String>> {
        let built = self.shaken(self.device)?;
        for n in [0, 1] {
            self.offsets(built.as_ref(), &self.input(built.as_ref(), n, self.device), 0.5)?;
            let few = self.started(n, self.device)?;
            if !self.values(few.as_ref(), CENTRES, 0.5, self.device)?.iter().all(|v| v.is_finite()) {
                return Ok(Some(format!("offsets are not finite where start_from had {n} Gaussians")));
            }
        }
        if built.is_static() {
            return Ok(None);
        }
        let odd = Tensor::<2>::from_data(TensorData::new(vec![f32::NAN, f32::INFINITY, 0.0, 1e30, -1e30, 0.5], [2, 3]), self.device);
        let input = SpatialInput { means_world: odd, ..self.input(built.as_ref(), 2, self.device) };
        let answered = match self.offsets(built.as_ref(), &input, 0.5) {
            // An error is allowed too.
            Err(_) => true,
            Ok(offsets) => flat(offsets)?.iter().all(|v| v.is_finite()),
        };
        if !answered {
            return Ok(Some("centres that are not numbers give offsets that are not numbers".into()));
        }
        let features = built.spatial(&self.input(built.as_ref(), 2, self.device))?.values;
        Ok(built.deform(features, f32::NAN).is_ok().then(|| "a time that is not a number was accepted".into()))
    }
}

/// All offsets as one list.
fn flat(offsets: Offsets) -> Result<Vec<f32>> {
    offsets.concatenated().map_or(Ok(Vec::new()), |t| to_vec(t, "offsets"))
}

/// Whether lists have equal lengths, and values that differ by at most `most`. What is not a number differs.
fn all_near(a: &[f32], b: &[f32], most: f32) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() <= most)
}

/// The error of a deformer without heads.
fn no_heads() -> Error {
    Error::backend("conformance", "the deformer returned no offsets", "Return at least one head")
}
