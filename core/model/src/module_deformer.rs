//! A deformer made of a burn module and two functions.
//!
//! burn's `Module` is not object safe and owns its weights; a deformer is a trait object whose weights the optimizer replaces. This adapter stores the weights
//! as flat arrays and calls the author's functions with a module that has the current weights. So a new deformer consists of its layers, two functions and a
//! registration.

use crate::{AttributeSpec, Deformer, DeformerWork, Error, HostGaussians, Offsets, Parameter, ParameterGroup, Part, Result, SpatialFeatures, SpatialInput};
use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::Tensor;

/// A loss term of a module: module, input, normalised time, progress.
type Regularizer<M> = Box<dyn Fn(&M, &SpatialInput, f32, f32) -> Result<Option<Tensor<1>>> + Send>;
/// The module with initial weights that depend on the first Gaussians.
type Start<M> = Box<dyn Fn(M, &HostGaussians) -> Result<M> + Send>;
/// Changes a module, except for its weights, as training advances.
type Progress<M> = Box<dyn Fn(&mut M, f32) + Send>;

/// A [`Deformer`] made of a module `M`: `spatial(module, input)` gives features `[M,F]`, `deform(module, features, time_norm)` offsets.
///
/// Both functions receive the weights of the current step; gradients flow through them. Register it like any deformer: `build` returns it in a box.
pub struct ModuleDeformer<M, S, D> {
    module: M,
    spatial: S,
    deform: D,
    parameters: Vec<Parameter>,
    groups: Vec<ParameterGroup>,
    attributes: Vec<AttributeSpec>,
    regularizer: Option<Regularizer<M>>,
    start: Option<Start<M>>,
    progress: Option<Progress<M>>,
    cached: bool,
    /// Prefixes given to `with_grid` and `with_group` that no weight's path has.
    unmatched: Vec<String>,
}

impl<M, S, D> ModuleDeformer<M, S, D>
where
    M: Module,
    S: Fn(&M, &SpatialInput) -> Result<Tensor<2>> + Send,
    D: Fn(&M, Tensor<2>, f32) -> Result<Offsets> + Send,
{
    /// A deformer whose weights are all float weights of `module`, in one optimizer group and counted as network. Names are paths of the module tree
    /// (`trunk.0.weight`). Errors name the deformer by the name of `group`.
    pub fn new(module: M, group: ParameterGroup, spatial: S, deform: D) -> Self {
        let parameters = Collector::of(&module);
        Self {
            module,
            spatial,
            deform,
            parameters,
            groups: vec![group],
            attributes: Vec::new(),
            regularizer: None,
            start: None,
            progress: None,
            cached: true,
            unmatched: Vec::new(),
        }
    }
    /// Adds attributes per Gaussian; `spatial` receives their values in [`SpatialInput::attributes`], in this order.
    pub fn with_attributes(mut self, attributes: Vec<AttributeSpec>) -> Self {
        self.attributes = attributes;
        self
    }
    /// Adds a loss term `[1]`: `term(module, input, time_norm, progress)`.
    pub fn with_regularizer(mut self, term: impl Fn(&M, &SpatialInput, f32, f32) -> Result<Option<Tensor<1>>> + Send + 'static) -> Self {
        self.regularizer = Some(Box::new(term));
        self
    }
    /// Sets initial weights that depend on the first Gaussians: `start(module, first)` returns the module with weights of the same shapes. Nothing else of it
    /// is kept; see [`Deformer::start_from`].
    pub fn with_start(mut self, start: impl Fn(M, &HostGaussians) -> Result<M> + Send + 'static) -> Self {
        self.start = Some(Box::new(start));
        self
    }
    /// Calls `change(module, progress)` before every training step, with progress in 0..1. It may change anything except weights.
    pub fn with_progress(mut self, change: impl Fn(&mut M, f32) + Send + 'static) -> Self {
        self.progress = Some(Box::new(change));
        self
    }
    /// Counts weights whose path starts with `prefix` as grid, and puts them into an optimizer group of their own if `group` is given. A path that no weight
    /// has is an error as for [`ModuleDeformer::with_group`].
    pub fn with_grid(mut self, prefix: &str, group: Option<ParameterGroup>) -> Self {
        self.change(prefix, |parameter| parameter.part = Part::Grid);
        match group {
            Some(group) => self.with_group(prefix, group),
            None => self,
        }
    }
    /// Puts weights whose path starts with `prefix` into an optimizer group of their own, such as a head that learns faster than the trunk. Where no weight has
    /// such a path, every call of [`Deformer::spatial`] is an error that lists the paths.
    pub fn with_group(mut self, prefix: &str, group: ParameterGroup) -> Self {
        let index = self.groups.len();
        self.groups.push(group);
        self.change(prefix, |parameter| parameter.group = index);
        self
    }
    /// Changes the weights whose path starts with `prefix`.
    fn change(&mut self, prefix: &str, change: impl Fn(&mut Parameter)) {
        let mut found = false;
        for parameter in self.parameters.iter_mut().filter(|p| p.name.starts_with(prefix)) {
            change(parameter);
            found = true;
        }
        if !found {
            self.unmatched.push(prefix.into());
        }
    }
    /// Refuses prefixes that no weight's path has.
    fn check_paths(&self) -> Result<()> {
        let Some(prefix) = self.unmatched.first() else { return Ok(()) };
        let paths: Vec<&str> = self.parameters.iter().map(|p| p.name.as_str()).collect();
        let remedy = format!("Give with_grid and with_group the beginning of one of {}", paths.join(", "));
        Err(Error::parameter(format!("deformer {}: weights '{prefix}'", self.groups[0].name), "no weight has a path that starts so", remedy))
    }
    /// Sets whether playback may cache spatial features between frames; default: true.
    pub fn with_cache(mut self, cached: bool) -> Self {
        self.cached = cached;
        self
    }
    /// The module with the weights of this step.
    fn current(&self) -> M {
        self.module.clone().map(&mut Assigner { parameters: self.parameters.iter() })
    }
}

impl<M, S, D> Deformer for ModuleDeformer<M, S, D>
where
    M: Module,
    S: Fn(&M, &SpatialInput) -> Result<Tensor<2>> + Send,
    D: Fn(&M, Tensor<2>, f32) -> Result<Offsets> + Send,
{
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        self.check_paths()?;
        input.check(&self.groups[0].name, &self.attributes)?;
        let work = DeformerWork { gaussians: input.len() as u64, ..DeformerWork::default() };
        Ok(SpatialFeatures { values: (self.spatial)(&self.current(), input)?, work })
    }
    fn attributes(&self) -> Vec<AttributeSpec> {
        self.attributes.clone()
    }
    fn regularizer(&self, input: &SpatialInput, time_norm: f32, progress: f32) -> Result<Option<Tensor<1>>> {
        self.regularizer.as_ref().map_or(Ok(None), |term| term(&self.current(), input, time_norm, progress))
    }
    fn start_from(&mut self, first: &HostGaussians) -> Result<()> {
        let Some(start) = &self.start else { return Ok(()) };
        let started = Collector::of(&start(self.current(), first)?);
        for (to, from) in self.parameters.iter_mut().zip(started) {
            (to.shape, to.value) = (from.shape, from.value);
        }
        Ok(())
    }
    fn set_progress(&mut self, progress: f32) {
        if let Some(change) = &self.progress {
            change(&mut self.module, progress);
        }
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        (self.deform)(&self.current(), features, time_norm)
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        self.groups.clone()
    }
    fn caches_spatial(&self) -> bool {
        self.cached
    }
}

/// Flattens every float weight, in the order of the module tree.
struct Collector {
    path: Vec<String>,
    parameters: Vec<Parameter>,
}

impl Collector {
    fn of(module: &impl Module) -> Vec<Parameter> {
        let mut list = Self { path: Vec::new(), parameters: Vec::new() };
        module.visit(&mut list);
        list.parameters
    }
}

impl ModuleVisitor for Collector {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_string());
    }
    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let value = param.val();
        let shape = value.dims().to_vec();
        let count: usize = shape.iter().product();
        let mut name = self.path.join(".");
        if name.is_empty() || self.parameters.iter().any(|p| p.name == name) {
            // Paths may be equal, but names in files must be unique.
            name = format!("{name}#{}", self.parameters.len());
        }
        self.parameters.push(Parameter { name, part: Part::Net, shape, value: value.reshape([count]), group: 0 });
    }
}

/// Puts flat weights back into a module, in the same order.
struct Assigner<'a> {
    parameters: std::slice::Iter<'a, Parameter>,
}

impl ModuleMapper for Assigner<'_> {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let Some(parameter) = self.parameters.next() else { return param };
        let (id, old, mapper) = param.consume();
        Param::from_mapped_value(id, parameter.value.clone().reshape(old.dims()), mapper)
    }
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;
    use crate::gaussians::to_vec;
    use crate::start_deformer;
    use burn::tensor::Device;

    #[derive(Module, Debug)]
    struct Drift {
        table: Param<Tensor<2>>,
        velocity: Param<Tensor<2>>,
    }

    fn field(device: &Device) -> impl Deformer {
        let param = |rows: usize, value: f32| Param::from_tensor(Tensor::<2>::full([rows, 3], value, device));
        let module = Drift { table: param(3, 0.5), velocity: param(3, 2.0) };
        let group =
            |name: &str| ParameterGroup { name: name.into(), lr_start: 1e-3, lr_end: 1e-3, warmup: 0.0, times_extent: false, epsilon: 1e-15, clip_norm: 0.0 };
        let spatial = |m: &Drift, input: &SpatialInput| Ok(input.means_world.clone().matmul(m.table.val()) + input.attributes[0].clone());
        let deform = |m: &Drift, features: Tensor<2>, t: f32| Ok(Offsets { means: Some(features.matmul(m.velocity.val()) * t), ..Offsets::default() });
        let pull = |_: &Drift, input: &SpatialInput, _: f32, progress: f32| Ok(Some(input.attributes[0].clone().sum().mul_scalar(progress)));
        ModuleDeformer::new(module, group("net"), spatial, deform)
            .with_grid("table", Some(group("grid")))
            .with_attributes(vec![AttributeSpec::new("shift", 3, 0.0, 1e-3)])
            .with_regularizer(pull)
    }

    #[test]
    fn a_module_becomes_a_field_whose_weights_learn() {
        let device = Device::flex();
        let mut field = field(&device);
        let names: Vec<(String, Part, usize)> = field.parameters().iter().map(|p| (p.name.clone(), p.part, p.group)).collect();
        assert_eq!(names, [("table".into(), Part::Grid, 1), ("velocity".into(), Part::Net, 0)]);
        assert_eq!(field.size_bytes(), (36, 36));

        for parameter in field.parameters_mut() {
            parameter.value = Tensor::from_inner(parameter.value.clone()).require_grad();
        }
        let means = Tensor::<2>::from_inner(Tensor::ones([2, 3], &device));
        let shift = Tensor::<2>::from_inner(Tensor::zeros([2, 3], &device)).require_grad();
        assert!(field.spatial(&SpatialInput::new(means.clone())).is_err(), "attributes are missing");
        let input = SpatialInput { means_world: means, attributes: vec![shift.clone()] };
        let features = field.spatial(&input).unwrap().values;
        let moved = field.deform(features, 0.5).unwrap().means.unwrap();
        assert_eq!(to_vec(moved.clone().inner(), "moved").unwrap(), vec![4.5; 6]);
        let term = field.regularizer(&input, 0.5, 0.25).unwrap().unwrap();
        let gradients = (moved.sum() + term).backward();
        // Half of each row sum of the velocity, and the regularizer's weight.
        assert_eq!(to_vec(shift.grad(&gradients).unwrap(), "gradient").unwrap(), vec![3.25; 6]);
        // d/dV = features^T 1 t: two Gaussians, each with feature 1.5, half way through time.
        let gradient = field.parameters()[1].value.grad(&gradients).unwrap();
        assert_eq!(to_vec(gradient, "gradient").unwrap(), vec![1.5; 9]);
    }

    #[test]
    fn weights_start_from_the_first_gaussians() {
        let device = Device::flex();
        let started = |rows: usize| {
            let param = || Param::from_tensor(Tensor::<2>::ones([3, 3], &device));
            let spatial = |m: &Drift, input: &SpatialInput| Ok(input.means_world.clone().matmul(m.table.val()));
            let deform = |m: &Drift, features: Tensor<2>, t: f32| Ok(Offsets { means: Some(features.matmul(m.velocity.val()) * t), ..Offsets::default() });
            let start = move |module: Drift, first: &HostGaussians| {
                let table = Tensor::<2>::full([rows, 3], first.len() as f32, &module.table.val().device());
                Ok(Drift { table: Param::from_tensor(table), ..module })
            };
            let group = ParameterGroup::plain("drift", 1e-3, 1e-4);
            let mut field = ModuleDeformer::new(Drift { table: param(), velocity: param() }, group, spatial, deform).with_start(start);
            let first = HostGaussians { means: vec![0.0; 21], opacity_logits: vec![0.0; 7], ..Default::default() };
            start_deformer("drift", &mut field, &first)?;
            field.parameters().into_iter().map(|p| to_vec(p.value.clone(), &p.name)).collect::<Result<Vec<_>>>()
        };
        assert_eq!(started(3).unwrap(), [vec![7.0; 9], vec![1.0; 9]]);
        let error = started(4).unwrap_err().to_string();
        assert!(error.contains("deformer drift") && error.contains("shapes"), "{error}");
    }

    #[test]
    fn weights_have_groups_of_their_own() {
        let device = Device::flex();
        let field = |prefix: &str| {
            let param = || Param::from_tensor(Tensor::<2>::ones([3, 3], &device));
            let spatial = |m: &Drift, input: &SpatialInput| Ok(input.means_world.clone().matmul(m.table.val()));
            let deform = |m: &Drift, features: Tensor<2>, t: f32| Ok(Offsets { means: Some(features.matmul(m.velocity.val()) * t), ..Offsets::default() });
            ModuleDeformer::new(Drift { table: param(), velocity: param() }, ParameterGroup::plain("drift", 1e-3, 1e-4), spatial, deform)
                .with_group(prefix, ParameterGroup::plain("fast", 1e-2, 1e-3))
                .with_grid("table", None)
        };
        let groups = |prefix: &str| field(prefix).parameters().iter().map(|p| (p.part, p.group)).collect::<Vec<_>>();
        assert_eq!(groups("velocity"), [(Part::Grid, 0), (Part::Net, 1)]);
        assert_eq!(groups("table"), [(Part::Grid, 1), (Part::Net, 0)], "counting as grid changes no group");
        assert_eq!(field("velocity").groups()[1], ParameterGroup::plain("fast", 1e-2, 1e-3));

        let input = SpatialInput::new(Tensor::ones([2, 3], &device));
        assert!(field("velocity").spatial(&input).is_ok());
        let error = field("speed").spatial(&input).unwrap_err().to_string();
        assert!(error.starts_with("deformer drift: weights 'speed'") && error.contains("table, velocity"), "{error}");
    }
}
