//! The layer `life`: Gaussians of any deformer get lives, for content that appears, vanishes or is too fast for the deformer.

use crate::parts::lives::{Life, side_by_side};
use burn::tensor::Tensor;
use cc4dgs_backends::ops::life::{LifeAt, WIDTH};
use cc4dgs_backends::ops::split::split;
use cc4dgs_core::{
    AttributeSpec, Deformer, DeformerLayerPlugin, DeformerWork, Error, HostGaussians, LIFE_ATTRIBUTES, Offsets, Parameter, ParameterGroup, Plugin, Result,
    Simplified, SpatialFeatures, SpatialInput, config, inventory,
};

/// The key of a `[deformer]` section.
const NAME: &str = "life";

const SCHEMA: &str = "\
half_width = 0.05        # start of r, as a share of the sequence
falloff = 0.1            # start of s, as a share of the sequence
gate = 1.0               # start of the gate, 0..1: all Gaussians last, and only those that are added with a life of their own have one
spread = 0.0             # centres of life start up to this far from the middle of the sequence, as a share of it
gate_weight = 0.0        # weight of the mean of 1 - gate, which counts where gate_lr is over 0; 0 is off
hidden_below = 0.01      # a Gaussian whose opacity factor is below this is hidden
center_lr = 1.6e-4       # Adam on T, as a share of the sequence
width_lr = 5e-3          # Adam on the logarithms of r and s
gate_lr = 0.0            # Adam on the gate's logit over 20
velocity_lr = 1.6e-3     # Adam on the velocity in world units per sequence, times the extent of the cameras in the normalised frame
# velocity_lr_end = 1.6e-5   # the same at the end of the main stage, reached log-linearly (FreeTimeGS: a hundredth); no fall unless given
";

/// A deformer whose Gaussians have lives too.
///
/// It does not forward [`Deformer::packed`]. Features are one array, lives first, and `deform` has to tell from it alone how the rest is stored: packed by
/// columns, it is logically another matrix, and only its strides say so, which views and copies of a part do not keep on every backend.
struct WithLife {
    inner: Box<dyn Deformer>,
    life: Life,
}

impl WithLife {
    /// Adds lives to `inner`.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a deformer that has an attribute of the same name.
    fn new(inner: Box<dyn Deformer>, life: Life) -> Result<Self> {
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
        Ok((own, side_by_side(lives)))
    }
    /// The attributes of lives `[M,7]`, and the features of the inner deformer, which a static one does not have.
    fn divide_features(features: Tensor<2>) -> (Tensor<2>, Option<Tensor<2>>) {
        let [m, width] = features.dims();
        if width == WIDTH {
            return (features, None);
        }
        if m == 0 {
            let empty = |width| Tensor::zeros([0, width], &features.device());
            return (empty(WIDTH), Some(empty(width - WIDTH)));
        }
        let mut pieces = split(features.reshape([m * width]), vec![m * WIDTH, m * (width - WIDTH)]);
        let inner = pieces.pop().map(|piece| piece.reshape([m, width - WIDTH]));
        (pieces.swap_remove(0).reshape([m, WIDTH]), inner)
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
        let (lives, inner) = Self::divide_features(features);
        let inner = match inner {
            Some(inner) => self.inner.deform_all(inner, times_norm)?,
            None => times_norm.iter().map(|_| Offsets::default()).collect(),
        };
        let with_life = |(mut offsets, LifeAt { shift, log_factor }): (Offsets, LifeAt)| {
            offsets.means = Some(offsets.means.map_or(shift.clone(), |means| means + shift));
            offsets.opacity_log_factor = Some(offsets.opacity_log_factor.map_or(log_factor.clone(), |own| own + log_factor));
            offsets
        };
        // A Gaussian that is visible at all times is moved by the inner deformer alone; its velocity and its life have no gradient.
        Ok(inner.into_iter().zip(self.life.at(lives, times_norm, true)?).map(with_life).collect())
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
        let mut own = input.clone();
        own.attributes.truncate(self.inner.attributes().len());
        let inner = self.inner.regularizer(&own, time_norm, progress)?;
        Ok(match (inner, gates.and_then(|gates| self.life.regularizer(gates))) {
            (Some(a), Some(b)) => Some(a + b),
            (a, b) => a.or(b),
        })
    }
    fn start_from(&mut self, first: &HostGaussians) -> Result<()> {
        self.inner.start_from(first)
    }
    fn set_progress(&mut self, progress: f32) {
        self.inner.set_progress(progress);
    }
    fn simplified(&self, features: Tensor<2>, times: &[f32]) -> Result<Option<Simplified>> {
        let (_, Some(inner)) = Self::divide_features(features) else { return Ok(None) };
        let Some(mut simple) = self.inner.simplified(inner, times)? else { return Ok(None) };
        simple.field = Box::new(Self { inner: simple.field, life: Life::new(self.life.settings().clone())? });
        let table = toml::Table::try_from(self.life.settings());
        let table = table.map_err(|e| Error::backend("deformer.life", e.to_string(), "Report this as a defect"))?;
        simple.settings.insert(NAME.into(), table.into());
        Ok(Some(simple))
    }
    fn size_bytes(&self) -> (u64, u64) {
        self.inner.size_bytes()
    }
}

fn build(settings: &toml::Table, inner: Box<dyn Deformer>) -> Result<Box<dyn Deformer>> {
    Ok(Box::new(WithLife::new(inner, Life::new(config::parse_section("deformer.life", settings)?)?)?))
}

inventory::submit! {
    DeformerLayerPlugin {
        info: Plugin {
            name: NAME,
            version: "1",
            summary: "a velocity and a temporal opacity per Gaussian beside any deformer, for what appears, vanishes or is too fast for it",
            paper: "FreeTimeGS; FreeTimeGS++; SharpTimeGS",
            schema: SCHEMA,
            capabilities: &["differentiable", "per-gaussian-attributes"],
        },
        build,
    }
}
