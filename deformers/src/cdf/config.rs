//! Settings of the computational deformation field and the sizes that follow from them.

use crate::parts::heads::{self, Head};
use crate::parts::settings::{Rates, bounded, refuse_unknown, take, within};
use crate::parts::voxels::{VoxelSettings, VoxelSizes};
use cc4dgs_backends::ops::field::ReluShape;
use cc4dgs_core::{DeformerContext, Error, Result, config};
use cc4dgs_fields::time::bands_for;
use serde::{Deserialize, Deserializer};

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
cycles = 1.0             # cycles of the lowest band over the sequence; with whole cycles, only t tells the last frame from the first
falloff = 0.0            # amplitude of a band over the next lower one is 2^-falloff: fast motion is learned later; 0 treats all alike (the paper)
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

/// How time features and spatial features are combined.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Fusion {
    /// Feature-wise linear modulation.
    #[default]
    Film,
    /// Concatenation before the spatial layer (the paper's ablation).
    Concat,
}

/// Encoding of time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TimeEncoding {
    /// t and its sines and cosines at doubling frequencies.
    #[default]
    Frequency,
    /// t alone (the paper's ablation).
    Raw,
}

/// The `[deformer]` section of `cdf`.
#[derive(Clone, Debug)]
pub struct CdfConfig {
    /// Grid and decoders.
    pub voxels: VoxelSettings,
    /// How the weights are optimised.
    pub rates: Rates,
    /// All other settings.
    pub network: NetworkSettings,
}

impl<'de> Deserialize<'de> for CdfConfig {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        let mut section = toml::Table::deserialize(deserializer)?;
        let parse = |section: &mut toml::Table| -> Result<Self> {
            refuse_unknown(section.keys(), &[&VoxelSettings::KEYS, &NetworkSettings::KEYS, &Rates::KEYS])?;
            let (voxels, rates) = (take(section, &VoxelSettings::KEYS)?, take(section, &Rates::KEYS)?);
            Ok(Self { voxels, rates, network: config::parse_section("deformer cdf", section)? })
        };
        parse(&mut section).map_err(serde::de::Error::custom)
    }
}

/// Settings of everything after the voxel features.
#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NetworkSettings {
    /// Width of the deformation network.
    pub width: Option<usize>,
    /// Encoding of time.
    pub time_encoding: TimeEncoding,
    /// Frequency bands; 0 chooses by the number of frames.
    pub time_bands: usize,
    /// Cycles of the lowest band over the sequence.
    pub cycles: f32,
    /// The amplitude of each band is 2^-falloff times that of the next lower one.
    pub falloff: f32,
    /// Hidden layers of the time network.
    pub time_layers: usize,
    /// How time features and spatial features are combined.
    pub fusion: Fusion,
    /// The outputs, in order.
    pub heads: Vec<Head>,
    /// Whether playback keeps spatial features.
    pub cache: bool,
}

impl NetworkSettings {
    /// The keys of these settings in a `[deformer]` section.
    pub const KEYS: [&'static str; 9] = ["width", "time_encoding", "time_bands", "cycles", "falloff", "time_layers", "fusion", "heads", "cache"];
}

impl Default for NetworkSettings {
    fn default() -> Self {
        Self {
            width: None,
            time_encoding: TimeEncoding::Frequency,
            time_bands: 0,
            cycles: 1.0,
            falloff: 0.0,
            time_layers: 3,
            fusion: Fusion::Film,
            heads: vec![Head::Means, Head::LogScales, Head::Quaternions, Head::Opacity, Head::Sh],
            cache: true,
        }
    }
}

/// All sizes of one deformer.
#[derive(Clone, Debug, PartialEq)]
pub struct Sizes {
    /// Grid and decoders.
    pub voxels: VoxelSizes,
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
    /// Rows of the spatial layer's matrix: with concatenation it reads the time features too.
    pub fn spatial_inputs(&self) -> usize {
        self.voxels.width() + if self.film.is_some() { 0 } else { self.width }
    }
}

impl CdfConfig {
    /// Computes all sizes for the scene in `context`.
    ///
    /// # Errors
    /// [`cc4dgs_core::Error::Parameter`] for sizes out of range.
    pub fn sizes(&self, context: &DeformerContext) -> Result<Sizes> {
        let voxels = self.voxels.sizes()?;
        let network = &self.network;
        let width = network.width.unwrap_or(self.voxels.capacity.width());
        within("width", width, 1, 4096)?;
        within("time_layers", network.time_layers, 1, 16)?;
        within("time_bands", network.time_bands, 0, 24)?;
        if !(0.1..=16.0).contains(&network.cycles) {
            return Err(Error::parameter("deformer.cycles", format!("{} cannot be used", network.cycles), "Give 0.1 to 16; 0.5 and 1 are usual"));
        }
        if !(0.0..=4.0).contains(&network.falloff) {
            return Err(Error::parameter("deformer.falloff", format!("{} cannot be used", network.falloff), "Give 0 (none) to 4"));
        }
        within("spherical-harmonics degree", context.sh_degree, 0, 4)?;
        heads::check(&network.heads)?;
        self.rates.check()?;
        let time_bands = match (network.time_encoding, network.time_bands) {
            (TimeEncoding::Raw, _) => 0,
            (TimeEncoding::Frequency, 0) => bands_for(context.frame_count),
            (TimeEncoding::Frequency, given) => given,
        };
        let chain = |input: usize, hidden: usize, output: usize| {
            let widths: Vec<usize> = std::iter::once(input).chain(std::iter::repeat_n(width, hidden)).chain([output]).collect();
            ReluShape::chain(&widths)
        };
        let time = chain(1 + 2 * time_bands, network.time_layers, width);
        let film = (network.fusion == Fusion::Film).then(|| chain(width, 1, 2 * width));
        let heads = network.heads.iter().map(|h| vec![width, h.width(context.sh_degree)]).collect();
        let network = ReluShape { input: width, trunk: vec![width; TRUNK_LAYERS], heads };
        let of_film = film.as_ref().map_or(0, ReluShape::parameter_count);
        let sizes = Sizes { voxels, width, time_bands, time, film, network };
        let of_spatial = (sizes.spatial_inputs() + 1).saturating_mul(width);
        bounded([sizes.voxels.parameter_count(), of_spatial, sizes.time.parameter_count(), of_film, sizes.network.parameter_count()])?;
        Ok(sizes)
    }
}
