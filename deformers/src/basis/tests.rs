//! Compares the evaluation of the field without burn with the deformer.

use super::*;
use burn::tensor::TensorData;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::playback::{ComputedMotion, Head as LayerHead, MotionPlugin, MotionSource, frame_time};
use cc4dgs_core::{DeformerPlugin, Entries, HostGaussians, Seed, WeightArray};

const COUNT: usize = 37;
const LEAST_SAMPLES: usize = 9;

/// The motion plug-in for the version of the deformer that training stores.
fn plugin(kind: SpaceKind) -> &'static MotionPlugin {
    let plugin = Entries::<MotionPlugin>::collect().unwrap().get(kind.name()).unwrap();
    let trained = Entries::<DeformerPlugin>::collect().unwrap().get(kind.name()).unwrap();
    assert_eq!(plugin.info.version, trained.info.version);
    plugin
}

fn draw(column: usize, index: usize) -> f32 {
    (Seed::root(3).index(column as u64).index(index as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0
}

/// The largest difference between offsets of the deformer and those of the layer, over the largest offset, head by head.
fn differences(kind: SpaceKind, section: &str, sh_degree: usize) -> Vec<f32> {
    let device = Device::flex();
    let context = DeformerContext { box_min: [-1.0, -0.5, 0.0], box_max: [1.0, 0.7, 2.0], frame_count: 20, sh_degree, seed: Seed::root(8) };
    let settings: toml::Table = section.parse().unwrap();
    let mut field = Basis::new(kind, &settings, &context, &device).unwrap();
    for (column, parameter) in field.parameters.iter_mut().enumerate() {
        // Heads start at zero, where there is nothing to compare.
        let count = parameter.shape.iter().product::<usize>();
        let noise = Tensor::<1>::from_data(TensorData::new((0..count).map(|i| 0.2 * draw(column, i)).collect::<Vec<f32>>(), [count]), &device);
        parameter.value = parameter.value.clone() + noise;
    }
    let columns = |column: usize, width: usize| (0..COUNT * width).map(|i| draw(100 + column, i)).collect::<Vec<f32>>();
    let gaussians = HostGaussians {
        means: columns(0, 3).into_iter().map(|v| 1.5 * v).collect(),
        log_scales: columns(1, 3),
        quaternions: columns(2, 4),
        opacity_logits: columns(3, 1),
        sh_dc: columns(4, 3),
        sh_rest: columns(5, 3 * ((sh_degree + 1).pow(2) - 1)),
        dynamic_scores: vec![1.0; COUNT],
        sh_degree,
        ..Default::default()
    };
    let weights: Vec<WeightArray> = field
        .parameters
        .iter()
        .map(|p| WeightArray { name: p.name.clone(), shape: p.shape.clone(), values: to_vec(p.value.clone(), &p.name).unwrap() })
        .collect();
    let source = MotionSource {
        object: "the model",
        settings: &settings,
        context: &context,
        weights: &weights,
        gaussians: &gaussians,
        least_samples: LEAST_SAMPLES,
        most_coefficients: usize::MAX,
    };
    let plugin = plugin(kind);
    let count = weights.iter().map(|array| array.values.len() as u64).sum();
    assert_eq!((plugin.weights)(&settings, &context), Some(count), "no archive may hold more");
    let ComputedMotion { samples, tracks } = (plugin.motion)(&source).unwrap().unwrap();
    assert!((plugin.motion)(&MotionSource { most_coefficients: 10, ..source }).unwrap().is_none());

    let means = Tensor::<2>::from_data(TensorData::new(gaussians.means.clone(), [COUNT, 3]), &device);
    let features = field.packed(field.spatial(&SpatialInput { means_world: means, attributes: Vec::new() }).unwrap().values);
    let of_track = |track: &cc4dgs_core::playback::Track| {
        let (width, mut worst, mut largest) = (track.head.width(sh_degree), 0.0f32, 0.0f32);
        for sample in (0..samples).step_by((samples - 1) / 8) {
            let offsets = field.deform(features.clone(), frame_time(sample, samples)).unwrap();
            let exact = match track.head {
                LayerHead::Means => to_vec(offsets.means.unwrap(), "means"),
                LayerHead::LogScales => to_vec(offsets.log_scales.unwrap(), "log-scales"),
                LayerHead::Rotations => to_vec(offsets.quaternions.unwrap(), "quaternions"),
                LayerHead::Opacities => unreachable!("it is not linear"),
                LayerHead::Colors => to_vec(offsets.sh.unwrap(), "colours"),
            };
            let functions: Vec<f32> = track.functions.chunks_exact(samples).map(|f| f[sample]).collect();
            for (row, exact) in exact.unwrap().chunks_exact(width).enumerate() {
                let q = &gaussians.quaternions[4 * row..4 * row + 4];
                let norm = if track.head == LayerHead::Rotations { q.iter().map(|v| v * v).sum::<f32>().sqrt() } else { 1.0 };
                let mut found = vec![0.0; width];
                track.add(row, &functions, &mut found);
                for (found, exact) in found.iter().zip(exact) {
                    (worst, largest) = (worst.max((found - exact / norm).abs()), largest.max((exact / norm).abs()));
                }
            }
        }
        worst / largest
    };
    tracks.iter().map(of_track).collect()
}

#[test]
fn players_compute_what_the_deformer_computes() {
    let small = "capacity = 'small'\nresolutions = [3, 8]\nhashes = 24\nwidth = 16\n";
    let tables = "levels = 3\nbase = 4\nlog2_rows = 7\nfeatures = 3\nwidth = 16\n";
    for (kind, section, sh_degree, heads) in [
        (SpaceKind::Stored, tables.to_string(), 1, 3),
        (SpaceKind::Stored, format!("{tables}layers = 2\nlearned = 4\nheads = ['means', 'quaternions']\ngrid_rate = 3.0"), 0, 2),
        (SpaceKind::Stored, format!("{tables}heads = ['quaternions', 'means']\n[kept]\nmeans = [0, 4]"), 0, 2),
        (SpaceKind::Stored, format!("{tables}head_layers = 0"), 0, 3),
        (SpaceKind::Computed, format!("{small}head_layers = 2\nlearned = 2"), 0, 3),
        (SpaceKind::Computed, small.to_string(), 1, 3),
        (
            SpaceKind::Computed,
            format!("{small}layers = 1\nlearned = 0\nsplines = 6\ncycles = 0.5\nfalloff = 0.0\nheads = ['sh', 'means']\nlr_start = 0.1"),
            2,
            2,
        ),
        (SpaceKind::Computed, format!("{small}learned = 4\ntime_bands = 3\nheads = ['quaternions', 'log_scales']\n[kept]\nquaternions = [1, 5, 9]"), 0, 2),
    ] {
        let found = differences(kind, &section, sh_degree);
        assert_eq!(found.len(), heads);
        assert!(found.iter().all(|d| *d < 2e-5), "{section}: {found:?}");
    }
}

#[test]
fn what_is_not_linear_is_left_to_baking() {
    let context = DeformerContext { box_min: [0.0; 3], box_max: [1.0; 3], frame_count: 3, sh_degree: 0, seed: Seed::root(1) };
    let gaussians = HostGaussians::default();
    let by = |kind: SpaceKind, section: &str, weights: &[WeightArray]| {
        let settings: toml::Table = section.parse().unwrap();
        let (object, settings, context) = ("the model", &settings, &context);
        let source = MotionSource { object, settings, context, weights, gaussians: &gaussians, least_samples: 2, most_coefficients: 1 << 20 };
        (plugin(kind).motion)(&source)
    };
    let of = |section: &str| by(SpaceKind::Computed, section, &[]);
    assert!(of("rotation = 'exponential'").unwrap().is_none() && of("heads = ['opacity']").unwrap().is_none());
    assert!(of("life = true").unwrap().is_none() && of("life = { gate = 0.5 }").unwrap().is_none(), "lives change the motion");
    assert!(of("time_bands = 20").unwrap().is_none(), "too fast for samples");
    assert!(of("heads = ['means']").unwrap_err().to_string().contains("of the model"), "weights are missing");
    assert!(by(SpaceKind::Stored, "learned = 0", &[]).unwrap_err().to_string().contains("grid.table"), "weights are missing");
    let short = WeightArray { name: "grid.table".into(), shape: vec![8], values: vec![0.0; 8] };
    assert!(by(SpaceKind::Stored, "learned = 0", &[short]).is_err(), "it has too few weights");
    // The number of weights does not fit 32 bits.
    let large = "learned = 0\nlevels = 4\nbase = 256\nlog2_rows = 24\nfeatures = 64";
    assert!(by(SpaceKind::Stored, large, &[]).unwrap().is_none(), "baking says what is wrong");
}

/// In training the last layers are combined with the functions of time first, which must change nothing but rounding.
#[test]
fn offsets_in_training_are_those_of_the_coefficients() {
    let times = [0.0, 0.3, 1.0];
    let tables = "levels = 2\nbase = 4\nlog2_rows = 7\nfeatures = 3\nwidth = 16\nlearned = 3\n";
    for section in
        [tables.to_string(), format!("{tables}head_layers = 0"), format!("{tables}head_layers = 2\nheads = ['quaternions', 'means']\n[kept]\nmeans = [0, 4]")]
    {
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 20, sh_degree: 0, seed: Seed::root(5) };
        let settings: toml::Table = section.parse().unwrap();
        let of = |device: &Device| {
            let mut field = Basis::new(SpaceKind::Stored, &settings, &context, device).unwrap();
            for (column, parameter) in field.parameters.iter_mut().enumerate() {
                let count = parameter.shape.iter().product::<usize>();
                let values: Vec<f32> = (0..count).map(|i| 0.4 * draw(column, i)).collect();
                let value = Tensor::<1>::from_data(TensorData::new(values, [count]), device);
                parameter.value = if value.is_autodiff() { value.require_grad() } else { value };
            }
            let means = Tensor::<2>::from_data(TensorData::new((0..3 * COUNT).map(|i| draw(50, i)).collect::<Vec<f32>>(), [COUNT, 3]), device);
            let features = field.spatial(&SpatialInput::new(means)).unwrap().values;
            assert_eq!(features.dims()[1] == field.shape.coefficients(), !field.trains(), "{section}");
            let of_time = |offsets: Offsets| to_vec(offsets.concatenated().unwrap().inner(), "offsets").unwrap();
            let all = field.deform_all(features.clone(), &times).unwrap().into_iter().map(of_time).collect::<Vec<_>>();
            let alone = of_time(field.deform(features.clone(), times[1]).unwrap());
            let simpler = field.simplified(features, &times).unwrap().map(|simple| simple.message);
            (all, alone, simpler)
        };
        let (playback, training) = (of(&Device::flex()), of(&Device::flex().autodiff()));
        assert_eq!(playback.2, training.2, "{section}: what is left out");
        let close = |a: &[f32], b: &[f32]| a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 2e-5) && a.iter().any(|v| v.abs() > 0.1);
        assert!(playback.0.iter().zip(&training.0).all(|(a, b)| close(a, b)), "{section}: {:?} {:?}", playback.0, training.0);
        assert!(close(&training.0[1], &training.1) && playback.0[1] == playback.1, "{section}: one time alone");
    }
}
