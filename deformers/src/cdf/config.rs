//! Settings of the computational deformation field and the sizes that follow from them.

use cc4dgs_backends::ops::field::{MAX_RESOLUTION, MishShape, ReluShape};
use cc4dgs_core::{Error, FieldContext, Result};
use serde::Deserialize;

/// Settings with their defaults, as shown to users.
pub const SCHEMA: &str = r#"capacity = "default"    # small | mid | default: the sizes below unless given
# levels = 5             # grid levels (small: 4)
# resolutions = [16, 32, 64, 128, 256]   # cells per axis; default doubles from 16
# hidden = [128, 128]    # decoder layers, each Linear-LayerNorm-Mish (small: 64, 64; mid: 96, 96)
# features = 32          # features per level (small: 16)
# width = 128            # width of the deformation network (small: 64; mid: 96)
hashes = 128             # hash functions per vertex
modulus = 1000000        # m of the hash functions
time_encoding = "frequency"   # frequency | raw
time_bands = 0           # frequency bands; 0 chooses by the number of frames
time_layers = 3          # hidden layers of the time network
fusion = "film"          # film | concat
heads = ["means", "log_scales", "quaternions", "opacity", "sh"]
vertex_reuse = true      # decode a vertex once, however many Gaussians share it
cache = true             # playback keeps the time-invariant features
lr_start = 1e-3          # Adam, log-linear to lr_end over the main stage
lr_end = 1e-5
warmup = 0.025           # linear warm-up, as a share of the stage
clip_norm = 1.0          # gradient-norm clip per group; 0 is off
"#;

/// Named sizes of the rate-distortion curve.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Capacity {
    /// 4 levels, decoders 128-64-64-16, network 64 wide.
    Small,
    /// 5 levels, decoders 128-96-96-32, network 96 wide.
    Mid,
    /// 5 levels, decoders 128-128-128-32, network 128 wide (the paper's).
    #[default]
    Default,
}

/// How time meets space.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Fusion {
    /// Feature-wise linear modulation.
    #[default]
    Film,
    /// Concatenation before the spatial layer (the paper's ablation).
    Concat,
}

/// How time enters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TimeEncoding {
    /// t and its sines and cosines at doubling frequencies.
    #[default]
    Frequency,
    /// t alone (the paper's ablation).
    Raw,
}

/// An output of the field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Head {
    /// Centres, world units.
    Means,
    /// Log-scales.
    LogScales,
    /// Raw quaternions.
    Quaternions,
    /// Opacity logits.
    Opacity,
    /// Spherical-harmonics coefficients.
    Sh,
}

impl Head {
    /// Its name in settings and weights.
    pub fn name(self) -> &'static str {
        match self {
            Self::Means => "means",
            Self::LogScales => "log_scales",
            Self::Quaternions => "quaternions",
            Self::Opacity => "opacity",
            Self::Sh => "sh",
        }
    }
    /// Its width for Gaussians of `sh_degree`.
    pub fn width(self, sh_degree: usize) -> usize {
        match self {
            Self::Means | Self::LogScales => 3,
            Self::Quaternions => 4,
            Self::Opacity => 1,
            Self::Sh => 3 * (sh_degree + 1) * (sh_degree + 1),
        }
    }
}

/// The `[deformer]` section of `cdf`.
#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CdfConfig {
    /// The sizes that are not given one by one.
    pub capacity: Capacity,
    /// Grid levels.
    pub levels: Option<usize>,
    /// Cells per axis of each level.
    pub resolutions: Option<Vec<u32>>,
    /// Widths of the decoders' hidden layers.
    pub hidden: Option<Vec<usize>>,
    /// Features per level.
    pub features: Option<usize>,
    /// Width of the deformation network.
    pub width: Option<usize>,
    /// Hash functions per vertex.
    pub hashes: usize,
    /// m of the hash functions.
    pub modulus: u32,
    /// How time enters.
    pub time_encoding: TimeEncoding,
    /// Frequency bands; 0 chooses by the number of frames.
    pub time_bands: usize,
    /// Hidden layers of the time network.
    pub time_layers: usize,
    /// How time meets space.
    pub fusion: Fusion,
    /// What the field moves.
    pub heads: Vec<Head>,
    /// Whether equal vertices are decoded once.
    pub vertex_reuse: bool,
    /// Whether playback keeps spatial features.
    pub cache: bool,
    /// First learning rate.
    pub lr_start: f64,
    /// Last learning rate.
    pub lr_end: f64,
    /// Share of the stage spent warming up.
    pub warmup: f64,
    /// Gradient-norm clip per group.
    pub clip_norm: f64,
}

impl Default for CdfConfig {
    fn default() -> Self {
        Self {
            capacity: Capacity::Default,
            levels: None,
            resolutions: None,
            hidden: None,
            features: None,
            width: None,
            hashes: 128,
            modulus: 1_000_000,
            time_encoding: TimeEncoding::Frequency,
            time_bands: 0,
            time_layers: 3,
            fusion: Fusion::Film,
            heads: vec![Head::Means, Head::LogScales, Head::Quaternions, Head::Opacity, Head::Sh],
            vertex_reuse: true,
            cache: true,
            lr_start: 1e-3,
            lr_end: 1e-5,
            warmup: 500.0 / 20_000.0,
            clip_norm: 1.0,
        }
    }
}

/// The sizes of one field, all settled.
#[derive(Clone, Debug, PartialEq)]
pub struct Sizes {
    /// Cells per axis of each level.
    pub resolutions: Vec<u32>,
    /// The decoder of every level.
    pub decoder: MishShape,
    /// Width of spatial hidden state, time features and trunk.
    pub width: usize,
    /// Frequency bands of the time encoding; 0 is raw time.
    pub time_bands: usize,
    /// Time encoding to time features.
    pub time: ReluShape,
    /// Time features to scale and shift; `None` with concatenation.
    pub film: Option<ReluShape>,
    /// Spatial hidden state to all heads.
    pub network: ReluShape,
}

/// Trunk layers (paper Section IV-B).
const TRUNK_LAYERS: usize = 4;

impl Sizes {
    /// The features of all levels side by side.
    pub fn voxel_features(&self) -> usize {
        self.resolutions.len() * self.decoder.output
    }
    /// Rows of the spatial layer's matrix: with concatenation it reads the time features too.
    pub fn spatial_inputs(&self) -> usize {
        self.voxel_features() + if self.film.is_some() { 0 } else { self.width }
    }
}

impl CdfConfig {
    /// Settles all sizes for the scene in `context`, refusing what cannot work.
    pub fn sizes(&self, context: &FieldContext) -> Result<Sizes> {
        let (levels, hidden, features, width) = match self.capacity {
            Capacity::Small => (4, vec![64, 64], 16, 64),
            Capacity::Mid => (5, vec![96, 96], 32, 96),
            Capacity::Default => (5, vec![128, 128], 32, 128),
        };
        let levels = self.levels.or(self.resolutions.as_ref().map(Vec::len)).unwrap_or(levels);
        within("levels", levels, 1, 16)?;
        let doubling = || (0..levels).map(|l| 16u32.checked_shl(l as u32).unwrap_or(u32::MAX)).collect();
        let resolutions: Vec<u32> = self.resolutions.clone().unwrap_or_else(doubling);
        if resolutions.len() != levels {
            return Err(Error::parameter("deformer.resolutions", format!("{} entries for {levels} levels", resolutions.len()), "Give one per level"));
        }
        for &r in &resolutions {
            within("resolutions", r as usize, 1, MAX_RESOLUTION as usize)?;
        }
        let hidden = self.hidden.clone().unwrap_or(hidden);
        within("hidden (layers)", hidden.len(), 0, 8)?;
        let (features, width) = (self.features.unwrap_or(features), self.width.unwrap_or(width));
        for (name, value) in hidden.iter().map(|&h| ("hidden", h)).chain([("features", features), ("width", width), ("hashes", self.hashes)]) {
            within(name, value, 1, 4096)?;
        }
        within("modulus", self.modulus as usize, 2, 1 << 24)?;
        within("time_layers", self.time_layers, 1, 16)?;
        within("time_bands", self.time_bands, 0, 24)?;
        if self.heads.is_empty() {
            return Err(Error::parameter("deformer.heads", "the list is empty", "Name at least one head, or use deformer kind = \"none\""));
        }
        if let Some((i, head)) = self.heads.iter().enumerate().find(|(i, h)| self.heads[..*i].contains(h)) {
            return Err(Error::parameter("deformer.heads", format!("'{}' appears again at place {}", head.name(), i + 1), "Name each head once"));
        }
        let rates = [self.lr_start, self.lr_end, self.clip_norm];
        if rates.iter().any(|r| !r.is_finite() || *r < 0.0) || !(0.0..=1.0).contains(&self.warmup) {
            return Err(Error::parameter(
                "deformer",
                format!("lr_start, lr_end, clip_norm = {rates:?}, warmup = {}", self.warmup),
                "Use finite rates of 0 or more and a warm-up in 0..1",
            ));
        }
        if context.box_min.iter().chain(&context.box_max).any(|v| !v.is_finite()) {
            return Err(Error::parameter("deformer box", format!("{:?} to {:?}", context.box_min, context.box_max), "Give finite corners"));
        }
        within("spherical-harmonics degree", context.sh_degree, 0, 4)?;
        let time_bands = match (self.time_encoding, self.time_bands) {
            (TimeEncoding::Raw, _) => 0,
            (TimeEncoding::Frequency, 0) => super::time::bands_for(context.frame_count),
            (TimeEncoding::Frequency, given) => given,
        };
        let chain = |input: usize, hidden: usize, output: usize| {
            let widths: Vec<usize> = std::iter::once(input).chain(std::iter::repeat_n(width, hidden)).chain([output]).collect();
            ReluShape::chain(&widths)
        };
        Ok(Sizes {
            resolutions,
            decoder: MishShape { input: self.hashes, hidden, output: features },
            width,
            time_bands,
            time: chain(1 + 2 * time_bands, self.time_layers, width),
            film: (self.fusion == Fusion::Film).then(|| chain(width, 1, 2 * width)),
            network: ReluShape {
                input: width,
                trunk: vec![width; TRUNK_LAYERS],
                heads: self.heads.iter().map(|h| vec![width, h.width(context.sh_degree)]).collect(),
            },
        })
    }
}

fn within(name: &str, value: usize, low: usize, high: usize) -> Result<()> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(Error::parameter(format!("deformer.{name}"), format!("{value} is outside {low}..={high}"), "Choose a value in that range"))
}
