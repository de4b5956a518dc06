//! The deformer of E-D3DGS: a learned vector per Gaussian and one per time, instead of coordinates, feed a coarse and a fine network (Bae et al. 2024).
//!
//! The table of times is resized and then read by linear interpolation: the coarse network sees few rows, the fine one all of them. A loss makes
//! vectors of neighbours similar. The published code compares every Gaussian with its 20 nearest, which it finds when the number of Gaussians changes; this one
//! compares random pairs of neighbours of the iteration. Its time offsets per camera are omitted, because a model here has no cameras. So is a term of its
//! loss, the sigmoid of the mean opacity logit (weight 1e-4), because a deformer does not see opacities; the loss term `opacity`, the mean of the sigmoids, is
//! near it. All layers of the published networks start as PyTorch's `nn.Linear` does, as with `random_heads`; without it the last ones start at zero, so that
//! nothing moves at first, and the others have Glorot weights.

use crate::parts::centres::check_time;
use crate::parts::heads::{self, Head};
use crate::parts::neighbours::{PAIRS, PATCH, neighbour_pairs, spread_pairs};
use crate::parts::settings::{bounded, not_negative, within};
use crate::parts::vectors::{differences, spread_differences};
use crate::parts::voxels::parameter;
use crate::parts::weights;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::field::{ReluShape, mlp_relu};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{
    AttributeSpec, Deformer, DeformerContext, DeformerPlugin, DeformerWork, Error, Offsets, Parameter, ParameterGroup, Part, Plugin, Result, Seed,
    SpatialFeatures, SpatialInput, config, inventory,
};
use serde::Deserialize;
use std::sync::Arc;

const SCHEMA: &str = r#"gaussian_features = 32   # width of the learned vector per Gaussian
time_features = 256      # width of the learned vector per time
time_rows = 150          # rows of the table of times (published: 150, Technicolor 25)
coarse_rows = 30         # rows that the coarse network sees (published: 30, Technicolor 5)
rows_grow = 0.125        # share of training over which the fine network's rows grow from the coarse network's number to all (10,000 of 80,000 iterations)
fade_in = 0.0125         # share of training over which offsets are faded in, at most 1/6; opacity, colour and scale start five such shares later (1,000 of 80,000)
width = 128
heads = ["means", "log_scales", "quaternions", "opacity", "sh"]
random_heads = false     # start all layers at random, as published, in place of the last ones at zero: the first offsets displace all Gaussians
zero_times = false       # start the table of times at zero (published for Technicolor and HyperNeRF) in place of small random numbers
smooth_weight = 1.0      # weight of the differences between vectors of neighbours; 0 is off (published: 1, Technicolor 0.1)
smooth_neighbours = 20   # the nearest Gaussians that count as neighbours
smooth_pairs = 2048      # random pairs of neighbours per iteration: up to 2,048 from one region, more from all; 0: one per Gaussian (published: all pairs)
smooth_falloff = 2000.0  # differences count exp(-smooth_falloff d^2 / 2) at distance d (published: 2000, d in units of the dataset; here in world units)
gaussian_lr = 2.5e-3     # Adam on the vectors of Gaussians
lr_start = 1.6e-4        # Adam on everything else, log-linear to lr_end
lr_end = 1.6e-5
times_extent = true      # multiply these two rates by the extent of the cameras in the normalised frame, as published
"#;

/// Shares `fade_in` after which opacity, colour and scale begin to fade in.
const LATER: f32 = 5.0;
/// Largest `fade_in`: all heads are faded in when training ends.
const MOST_FADE_IN: f32 = 1.0 / (LATER + 1.0);

/// Name of the extra attribute.
const ATTRIBUTE: &str = "embedding";

#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    gaussian_features: usize,
    time_features: usize,
    time_rows: usize,
    coarse_rows: usize,
    rows_grow: f32,
    fade_in: f32,
    width: usize,
    heads: Vec<Head>,
    random_heads: bool,
    zero_times: bool,
    smooth_weight: f64,
    smooth_neighbours: usize,
    smooth_pairs: usize,
    smooth_falloff: f64,
    gaussian_lr: f64,
    lr_start: f64,
    lr_end: f64,
    times_extent: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            gaussian_features: 32,
            time_features: 256,
            time_rows: 150,
            coarse_rows: 30,
            rows_grow: 0.125,
            fade_in: 0.0125,
            width: 128,
            heads: vec![Head::Means, Head::LogScales, Head::Quaternions, Head::Opacity, Head::Sh],
            random_heads: false,
            zero_times: false,
            smooth_weight: 1.0,
            smooth_neighbours: 20,
            smooth_pairs: PAIRS,
            smooth_falloff: 2000.0,
            gaussian_lr: 2.5e-3,
            lr_start: 1.6e-4,
            lr_end: 1.6e-5,
            times_extent: true,
        }
    }
}

/// Parameters: table of times, coarse network, fine network.
struct Embedding {
    settings: Settings,
    sh_degree: usize,
    network: Arc<ReluShape>,
    parameters: Vec<Parameter>,
    /// Of the pairs of neighbours.
    seed: Seed,
    /// Progress of the main stage, 0..1.
    progress: f32,
}

impl Embedding {
    fn new(settings: Settings, context: &DeformerContext, device: &Device) -> Result<Self> {
        within("gaussian_features", settings.gaussian_features, 1, 1024)?;
        within("time_features", settings.time_features, 1, 4096)?;
        within("time_rows", settings.time_rows, 2, 100_000)?;
        within("coarse_rows", settings.coarse_rows, 2, settings.time_rows)?;
        within("width", settings.width, 1, 4096)?;
        if !(0.0..=1.0).contains(&settings.rows_grow) {
            return Err(Error::parameter("deformer.rows_grow", format!("{} is not in 0..1", settings.rows_grow), "Give a share from 0 to 1"));
        }
        if !(0.0..=MOST_FADE_IN).contains(&settings.fade_in) {
            let problem = format!("{} is not in 0..1/6: opacity, colour and scale would not be faded in when training ends", settings.fade_in);
            return Err(Error::parameter("deformer.fade_in", problem, "Give a share from 0 to 1/6"));
        }
        within("smooth_neighbours", settings.smooth_neighbours, 1, PATCH - 1)?;
        not_negative(&[("smooth_weight", settings.smooth_weight), ("smooth_falloff", settings.smooth_falloff)])?;
        not_negative(&[("gaussian_lr", settings.gaussian_lr), ("lr_start", settings.lr_start), ("lr_end", settings.lr_end)])?;
        heads::check(&settings.heads)?;
        let (w, input) = (settings.width, settings.gaussian_features + settings.time_features);
        let network = ReluShape { input, trunk: vec![w], heads: settings.heads.iter().map(|h| vec![w, h.width(context.sh_degree)]).collect() };
        bounded([settings.time_rows * settings.time_features, 2 * network.parameter_count()])?;
        let seed = context.seed;
        // Uniform with the standard deviation of the published normal: 0.01 / sqrt(width).
        let bound = 0.01 * 3f32.sqrt() / (settings.time_features as f32).sqrt();
        let count = settings.time_rows * settings.time_features;
        let times = if settings.zero_times { vec![0.0; count] } else { weights::uniform(seed.child("times"), count, bound) };
        let mut parameters = vec![parameter("grid.times".into(), Part::Grid, 0, times, device)];
        for name in ["coarse", "fine"] {
            let own = seed.child(name);
            let layer = if settings.random_heads { weights::torch } else { weights::glorot_with_bias };
            let mut values = layer(own.child("trunk"), input, w);
            for (i, head) in network.heads.iter().enumerate() {
                let own = own.index(i as u64);
                values.extend(layer(own.child("first"), w, w));
                // As in `hexplane`: the published random layer displaces all Gaussians at first.
                values.extend(if settings.random_heads { layer(own.child("last"), w, head[1]) } else { weights::zeros(w, head[1]) });
            }
            parameters.push(parameter(format!("net.{name}"), Part::Net, 0, values, device));
        }
        Ok(Self { sh_degree: context.sh_degree, network: Arc::new(network), parameters, settings, seed: seed.child("neighbours"), progress: 1.0 })
    }
    /// The row `[1, F]` at `time_norm` of the table resized to `rows` rows, corners aligned.
    fn time_row(&self, time_norm: f32, rows: usize) -> Tensor<2> {
        let s = &self.settings;
        let table = self.parameters[0].value.clone().reshape([s.time_rows, s.time_features]);
        let between = |position: f64, last: usize| {
            let low = (position.floor() as usize).min(last.saturating_sub(1));
            (low, (position - low as f64) as f32)
        };
        // Two rows of the resized table, each interpolated from two rows of the stored one: four weights.
        let mut mixture = vec![0.0f32; s.time_rows];
        let (low, part) = between(f64::from(time_norm.clamp(0.0, 1.0)) * (rows - 1) as f64, rows - 1);
        for (row, share) in [(low, 1.0 - part), (low + 1, part)] {
            let (first, rest) = between(row as f64 / (rows - 1) as f64 * (s.time_rows - 1) as f64, s.time_rows - 1);
            mixture[first] += share * (1.0 - rest);
            mixture[first + 1] += share * rest;
        }
        let mixture = Tensor::<2>::from_data(TensorData::new(mixture, [1, s.time_rows]), &table.device());
        mixture.matmul(table)
    }
    /// Rows of the table of times that the fine network sees at the current progress.
    fn fine_rows(&self) -> usize {
        let s = &self.settings;
        if self.progress >= s.rows_grow {
            return s.time_rows;
        }
        let part = self.progress / s.rows_grow;
        (s.coarse_rows + ((s.time_rows - s.coarse_rows) as f32 * part) as usize).clamp(2, s.time_rows)
    }
    /// Fade-in factor of a head at the current progress, 0..1. The published code fades in over 1,000 iterations; opacity, colour and scale over 1,000 after
    /// the first 5,000.
    fn share_of(&self, head: Head) -> f32 {
        let fade = self.settings.fade_in;
        let begun = match head {
            Head::Means | Head::Quaternions => 0.0,
            Head::LogScales | Head::Opacity | Head::Sh => LATER * fade,
        };
        if fade == 0.0 || self.progress >= begun + fade { 1.0 } else { ((self.progress - begun) / fade).max(0.0) }
    }
}

impl Deformer for Embedding {
    fn attributes(&self) -> Vec<AttributeSpec> {
        vec![AttributeSpec::new(ATTRIBUTE, self.settings.gaussian_features, 0.0, self.settings.gaussian_lr)]
    }
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        input.check("embedding", &self.attributes())?;
        let work = DeformerWork { gaussians: input.len() as u64, ..DeformerWork::default() };
        Ok(SpatialFeatures { values: input.attributes[0].clone(), work })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        check_time(time_norm)?;
        let m = features.dims()[0];
        if m == 0 {
            let empty = self.network.output_widths().into_iter().map(|width| Tensor::zeros([0, width], &features.device())).collect();
            return Ok(heads::offsets(&self.settings.heads, empty, self.sh_degree));
        }
        let mut outputs: Option<Vec<Tensor<2>>> = None;
        for (index, rows) in [(1, self.settings.coarse_rows), (2, self.fine_rows())] {
            let input = Tensor::cat(vec![features.clone(), self.time_row(time_norm, rows).repeat_dim(0, m)], 1);
            let own = mlp_relu(input, self.parameters[index].value.clone(), &self.network)?;
            outputs = Some(match outputs {
                None => own,
                Some(coarse) => coarse.into_iter().zip(own).map(|(a, b)| a + b).collect(),
            });
        }
        let faded = self.settings.heads.iter().zip(outputs.unwrap_or_default()).map(|(head, out)| match self.share_of(*head) {
            1.0 => out,
            share => out.mul_scalar(share),
        });
        Ok(heads::offsets(&self.settings.heads, faded.collect(), self.sh_degree))
    }
    /// `smooth_weight` times the mean of sqrt(exp(-smooth_falloff d²) |z_i - z_j|² + 1e-20) over random pairs of neighbours i and j, with the vectors z, at the
    /// distance d: up to `smooth_pairs` of them; see [`neighbour_pairs`] and, for more than 2,048 and for 0, [`spread_pairs`]. It reads the centres back, and
    /// its time is at least linear in their number.
    fn regularizer(&self, input: &SpatialInput, _time_norm: f32, progress: f32) -> Result<Option<Tensor<1>>> {
        let s = &self.settings;
        let Some(vectors) = input.attributes.first().filter(|_| s.smooth_weight > 0.0 && input.len() > 1) else { return Ok(None) };
        let means = to_vec(input.means_world.clone(), "centres")?;
        let points: Vec<[f32; 3]> = means.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
        let seed = self.seed.index(u64::from(progress.to_bits()));
        let spread = |most: usize| spread_differences(vectors, &spread_pairs(&points, most, s.smooth_neighbours, seed), s.smooth_weight, s.smooth_falloff);
        Ok(match s.smooth_pairs {
            0 => spread(points.len()),
            most if most > PAIRS => spread(most),
            most => differences(vectors, &neighbour_pairs(&points, most, s.smooth_neighbours, seed), s.smooth_weight, s.smooth_falloff),
        })
    }
    fn set_progress(&mut self, progress: f32) {
        self.progress = progress;
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        let s = &self.settings;
        vec![ParameterGroup { times_extent: s.times_extent, ..ParameterGroup::plain("embedding", s.lr_start, s.lr_end) }]
    }
}

fn build(section: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
    Ok(Box::new(Embedding::new(config::parse_section("deformer embedding", section)?, context, device)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A field with two floats per Gaussian whose term of neighbours has the weight `smooth_weight`.
    fn smooth(smooth_weight: f64) -> Embedding {
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 20, sh_degree: 0, seed: Seed::root(2) };
        let settings = Settings { gaussian_features: 2, time_features: 4, width: 4, smooth_weight, ..Settings::default() };
        Embedding::new(settings, &context, &Device::flex()).unwrap()
    }

    /// The term of `field` and its gradient by the vectors, for Gaussians on the x axis with two floats each. `None` where there is no term.
    fn term(field: &Embedding, x: &[f32], vectors: &[f32], progress: f32) -> Option<(f32, Vec<f32>)> {
        let device = Device::flex().autodiff();
        let means: Vec<f32> = x.iter().flat_map(|&x| [x, 0.0, 0.0]).collect();
        let means_world = Tensor::<2>::from_data(TensorData::new(means, [x.len(), 3]), &device);
        let vectors = Tensor::<2>::from_data(TensorData::new(vectors.to_vec(), [x.len(), 2]), &device).require_grad();
        let term = field.regularizer(&SpatialInput { means_world, attributes: vec![vectors.clone()] }, 0.5, progress).unwrap()?;
        let gradient = vectors.grad(&term.backward()).unwrap();
        Some((to_vec(term, "term").unwrap()[0], to_vec(gradient, "gradient").unwrap()))
    }

    #[test]
    fn neighbours_with_equal_vectors_cost_nothing() {
        let x: Vec<f32> = (0..30).map(|i| 0.01 * (i / 2) as f32).collect();
        let (value, gradient) = term(&smooth(1.0), &x, &[0.3; 60], 0.5).unwrap();
        assert!(value < 1e-9 && gradient.iter().all(|&g| g == 0.0), "{value}: {gradient:?}");
    }

    #[test]
    fn neighbours_with_different_vectors_cost_what_the_formula_says() {
        // The vectors are 0.5 apart; at 0.01, half of the falloff's exponent is -0.1.
        let (value, gradient) = term(&smooth(0.8), &[0.2, 0.21], &[0.1, 0.0, 0.4, 0.4], 0.5).unwrap();
        let near = (-0.1f32).exp();
        assert!((value - 0.8 * near * 0.5).abs() < 1e-4, "{value}");
        for (found, wanted) in gradient.iter().zip([-0.6, -0.8, 0.6, 0.8]) {
            assert!((found - 0.8 * near * wanted).abs() < 1e-3, "{gradient:?}");
        }
        let (far, _) = term(&smooth(0.8), &[0.0, 9.0], &[0.1, 0.0, 0.4, 0.4], 0.5).unwrap();
        assert!(far < 1e-9, "{far}");
        // Duplicates of the same Gaussian, and one whose centre is NaN.
        let (value, gradient) = term(&smooth(1.0), &[0.2, 0.2, f32::NAN], &[0.0, 0.0, 3.0, 4.0, 7.0, 7.0], 0.5).unwrap();
        assert!((value - 5.0).abs() < 1e-4 && gradient.iter().all(|g| g.is_finite()) && gradient[4..] == [0.0, 0.0], "{value}: {gradient:?}");
    }

    #[test]
    fn pairs_of_neighbours_follow_from_seed_and_progress() {
        let x: Vec<f32> = (0..100).map(|i| 1e-3 * i as f32).collect();
        let vectors: Vec<f32> = (0..200).map(|i| (0.7 * i as f32).sin()).collect();
        let at = |progress: f32| term(&smooth(1.0), &x, &vectors, progress).unwrap();
        assert_eq!(at(0.25), at(0.25));
        assert_ne!(at(0.25).0, at(0.5).0);
        assert!(term(&smooth(0.0), &x, &vectors, 0.5).is_none() && term(&smooth(1.0), &[0.0], &[1.0, 1.0], 0.5).is_none());
    }

    #[test]
    fn every_gaussian_is_compared_where_pairs_are_not_limited() {
        const COUNT: usize = 6000;
        let x: Vec<f32> = (0..COUNT).map(|i| 1e-4 * i as f32).collect();
        let vectors: Vec<f32> = (0..2 * COUNT).map(|i| (0.7 * i as f32).sin()).collect();
        let compared = |smooth_pairs: usize| {
            let mut field = smooth(1.0);
            field.settings.smooth_pairs = smooth_pairs;
            let (value, gradient) = term(&field, &x, &vectors, 0.5).unwrap();
            assert_eq!(term(&field, &x, &vectors, 0.5), Some((value, gradient.clone())));
            gradient.chunks(2).filter(|g| g.iter().any(|v| *v != 0.0)).count()
        };
        let found = [100, PAIRS, 4000, 0].map(compared);
        assert!(found[0] <= 200 && found[1] <= 2 * PAIRS && found[2] > found[1] && found[3] > COUNT - COUNT / 20, "{found:?}");
    }

    #[test]
    fn networks_and_times_start_as_the_settings_say() {
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 20, sh_degree: 0, seed: Seed::root(2) };
        let weights = |random_heads: bool, zero_times: bool| -> [Vec<f32>; 3] {
            let settings = Settings { gaussian_features: 12, time_features: 4, width: 4, random_heads, zero_times, ..Settings::default() };
            let field = Embedding::new(settings, &context, &Device::flex()).unwrap();
            [0, 1, 2].map(|index: usize| to_vec(field.parameters[index].value.clone(), "weights").unwrap())
        };
        let largest = |values: &[f32]| values.iter().fold(0.0f32, |most, v| most.max(v.abs()));
        let ([times, coarse, _], [zeros, random, fine]) = (weights(false, false), weights(true, true));
        assert!(largest(&times) > 0.0 && largest(&zeros) == 0.0 && random != fine);
        // PyTorch's bound of a layer with 16 inputs is 1/4, Glorot's with 4 outputs 0.55.
        let trunk = 17 * 4;
        assert!(largest(&coarse[..trunk]) > 0.3 && (0.2..=0.25).contains(&largest(&random[..trunk])));
        assert!((0.4..=0.5).contains(&largest(&random[trunk..])) && random.len() == coarse.len());
    }

    #[test]
    fn rows_grow_and_changes_come_in_with_progress() {
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 20, sh_degree: 0, seed: Seed::root(2) };
        let settings = Settings { time_rows: 90, coarse_rows: 10, ..Settings::default() };
        let mut field = Embedding::new(settings, &context, &Device::flex()).unwrap();
        assert_eq!((field.fine_rows(), field.share_of(Head::Sh)), (90, 1.0), "the default progress is that of a trained deformer");
        for (progress, rows, means, colors) in
            [(0.0, 10, 0.0, 0.0), (0.00625, 14, 0.5, 0.0), (0.0625, 50, 1.0, 0.0), (0.06875, 54, 1.0, 0.5), (0.5, 90, 1.0, 1.0)]
        {
            field.set_progress(progress);
            assert_eq!(field.fine_rows(), rows, "at {progress}");
            assert!((field.share_of(Head::Means) - means).abs() < 1e-4 && (field.share_of(Head::Sh) - colors).abs() < 1e-4, "at {progress}");
        }
    }

    #[test]
    fn every_head_is_faded_in_when_training_ends() {
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 20, sh_degree: 0, seed: Seed::root(2) };
        let build = |fade_in: f32| Embedding::new(Settings { fade_in, ..Settings::default() }, &context, &Device::flex());
        let mut field = build(MOST_FADE_IN).unwrap();
        field.set_progress(1.0);
        assert!((field.share_of(Head::Sh) - 1.0).abs() < 1e-4);
        for fade_in in [0.17, 0.2, 1.0, -0.01, f32::NAN] {
            let error = build(fade_in).err().unwrap_or_else(|| panic!("{fade_in} was accepted")).to_string();
            assert!(error.contains("fade_in") && error.contains("1/6"), "{error}");
        }
    }
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "embedding",
            version: "1",
            summary: "learned vectors per Gaussian and per time, a coarse and a fine network",
            paper: "E-D3DGS (Bae et al. 2024)",
            schema: SCHEMA,
            capabilities: &["differentiable", "starts-as-identity", "per-gaussian-attributes", "regularized"],
        },
        build,
    }
}
