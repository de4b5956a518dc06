//! The computational deformation field: sizes, initial state, options, and outputs and gradients compared with the paper's formulas in
//! burn's primitives.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::{Deformer, DeformerContext, Offsets, Registry, Seed, SpatialInput};
use cc4dgs_deformers::cdf::{Cdf, CdfConfig, Formulas};
use cc4dgs_tests::devices;
use rand::{Rng, SeedableRng};

fn context(frames: usize) -> DeformerContext {
    DeformerContext { box_min: [-1.0, -0.5, 0.0], box_max: [1.0, 0.5, 2.0], frame_count: frames, sh_degree: 3, seed: Seed::root(11).child("field") }
}

fn config(text: &str) -> CdfConfig {
    cc4dgs_core::config::parse_section("deformer cdf", &cc4dgs_core::config::parse_table("test", text).expect("TOML")).expect("settings")
}

/// Small sizes for exact comparison, with every part present.
const TINY: &str = "levels = 3\nresolutions = [3, 8, 40]\nhashes = 24\nhidden = [20, 12]\nfeatures = 6\nwidth = 16\n";

fn field(text: &str, device: &Device) -> Cdf {
    Cdf::new(config(text), &context(300), device).expect("a field")
}

fn values<const D: usize>(t: Tensor<D>) -> Vec<f32> {
    t.into_data().try_to_vec::<f32>().expect("float32")
}

fn matrix(data: Vec<f32>, width: usize, device: &Device) -> Tensor<2> {
    let rows = data.len() / width;
    Tensor::from_data(TensorData::new(data, [rows, width]), device)
}

/// Centres clustered so that vertices are shared, a few of them outside the box.
fn centres(n: usize) -> Vec<f32> {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(3);
    (0..3 * n).map(|i| if i % 3 == 2 { random.random_range(-0.1..2.1) } else { random.random_range(-1.1f32..1.1) }).collect()
}

/// Replaces every weight by a random one of the same order of magnitude, so that no head is zero.
fn shake(field: &mut dyn Deformer, device: &Device) {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(9);
    for p in field.parameters_mut() {
        let moved: Vec<f32> = values(p.value.clone()).iter().map(|v| v + random.random_range(-0.15f32..0.15)).collect();
        let n = moved.len();
        let value = Tensor::<1>::from_data(TensorData::new(moved, [n]), device);
        p.value = if value.is_autodiff() { value.require_grad() } else { value };
    }
}

fn evaluate(field: &dyn Deformer, points: &[f32], time: f32, device: &Device) -> (Vec<f32>, Offsets) {
    let spatial = field.spatial(&SpatialInput::new(matrix(points.to_vec(), 3, device))).expect("features").values;
    let offsets = field.deform(spatial.clone(), time).expect("offsets");
    (values(spatial), offsets)
}

fn distance(got: &[f32], want: &[f32]) -> f64 {
    assert_eq!(got.len(), want.len());
    let difference: f64 = got.iter().zip(want).map(|(g, w)| f64::from(g - w).powi(2)).sum();
    (difference / want.iter().map(|w| f64::from(*w).powi(2)).sum::<f64>().max(1e-30)).sqrt()
}

#[test]
fn sizes_are_those_of_the_paper() {
    let device = Device::flex();
    let count = |text: &str| {
        let (grid, net) = field(text, &device).size_bytes();
        (grid / 4, net / 4)
    };
    assert_eq!(count(""), (188_320, 278_203));
    assert_eq!(count("fusion = \"concat\""), (188_320, 245_051));
    assert_eq!(count("capacity = \"mid\""), (125_920, 162_587));
    assert_eq!(count("capacity = \"small\""), (54_848, 71_547));
    assert_eq!(count("levels = 4").0, 4 * 37_664);
    // Every head adds a hidden layer of its own and an output layer.
    assert_eq!(count("heads = [\"means\"]").1, 278_203 - 4 * 16_512 - (3 + 4 + 1 + 48) * 129);
    // Raw time drops 16 inputs of the time network.
    assert_eq!(count("time_encoding = \"raw\"").1, 278_203 - 16 * 128);
    let (grid, net) = field("", &device).size_bytes();
    assert_eq!((format!("{:.3}", grid as f64 / 1e6), format!("{:.3}", net as f64 / 1e6)), ("0.753".into(), "1.113".into()));
}

#[test]
fn a_fresh_field_moves_nothing() {
    for (name, device) in devices() {
        for text in ["capacity = \"small\"", "capacity = \"small\"\nfusion = \"concat\""] {
            let (spatial, offsets) = evaluate(&field(text, &device), &centres(40), 0.37, &device);
            assert!(spatial.iter().any(|v| v.abs() > 1e-3), "{name}: features are dead");
            assert_eq!(offsets.means.as_ref().map(|t| t.dims()), Some([40, 3]));
            assert_eq!(offsets.opacity_logits.as_ref().map(|t| t.dims()), Some([40]));
            assert_eq!(offsets.sh.as_ref().map(|t| t.dims()), Some([40, 16, 3]));
            assert!(values(offsets.concatenated().expect("heads")).iter().all(|v| *v == 0.0), "{name} {text}");
        }
    }
}

#[test]
fn vertex_reuse_changes_the_work_and_not_one_bit() {
    for (name, device) in devices() {
        let (mut with, mut without) = (field(TINY, &device), field(&format!("{TINY}vertex_reuse = false\ncache = false"), &device));
        shake(&mut with, &device);
        shake(&mut without, &device);
        let points = centres(777);
        let work = |f: &Cdf| f.spatial(&SpatialInput::new(matrix(points.clone(), 3, &device))).expect("features").work;
        let (less, more) = (work(&with), work(&without));
        assert_eq!((more.gaussians, more.vertices_queried, more.vertices_decoded), (777, 3 * 8 * 777, 3 * 8 * 777));
        assert_eq!(less.vertices_queried, more.vertices_queried);
        assert!(less.vertices_decoded < more.vertices_decoded / 2, "{less:?}");
        assert!(with.caches_spatial() && !without.caches_spatial());
        for time in [0.0, 0.61] {
            let ((a, x), (b, y)) = (evaluate(&with, &points, time, &device), evaluate(&without, &points, time, &device));
            assert_eq!(a, b, "{name}: features differ");
            assert_eq!(values(x.concatenated().expect("heads")), values(y.concatenated().expect("heads")), "{name}: offsets differ");
        }
    }
}

#[test]
fn outputs_and_all_gradients_match_the_formulas() {
    for (name, device) in devices() {
        for fusion in ["fusion = \"film\"", "fusion = \"concat\"", "cycles = 0.5\nfalloff = 1.0"] {
            let device = device.clone().autodiff();
            let mut field = field(&format!("{TINY}{fusion}"), &device);
            shake(&mut field, &device);
            let points = centres(300);
            let (_, offsets) = evaluate(&field, &points, 0.43, &device);
            let fast = offsets.concatenated().expect("heads");
            let plain = Formulas(&field).offsets(matrix(points.clone(), 3, &device), 0.43).expect("offsets");
            let d = distance(&values(fast.clone()), &values(plain.clone()));
            assert!(d < 1e-5, "{name} {fusion}: outputs differ by {d:.2e}");
            let wave: Vec<f32> = (0..300 * 59).map(|i| (i as f32 * 0.7).sin()).collect();
            let wave = matrix(wave, 59, &device);
            let (got, want) = ((fast * wave.clone()).sum().backward(), (plain * wave).sum().backward());
            for p in field.parameters() {
                let gradient = |g| values(p.value.grad(g).unwrap_or_else(|| panic!("{name} {fusion}: no gradient at {}", p.name)));
                let (got, want) = (gradient(&got), gradient(&want));
                assert!(want.iter().any(|v| v.abs() > 1e-6), "{} has no gradient to compare", p.name);
                let d = distance(&got, &want);
                assert!(d < 1e-4, "{name} {fusion}: gradient of {} differs by {d:.2e}", p.name);
            }
        }
    }
}

#[test]
fn the_encoding_of_time_follows_cycles_and_falloff() {
    let device = Device::flex();
    let motion = |text: &str, time: f32| {
        let mut field = field(&format!("{TINY}{text}"), &device);
        shake(&mut field, &device);
        values(evaluate(&field, &centres(50), time, &device).1.means.expect("a head"))
    };
    assert_eq!(motion("time_bands = 1\nfalloff = 4.0", 0.3), motion("time_bands = 1", 0.3), "the lowest band has its whole size");
    assert_ne!(motion("time_bands = 2\nfalloff = 4.0", 0.3), motion("time_bands = 2", 0.3));
    assert_ne!(motion("time_bands = 2\ncycles = 0.5", 1.0), motion("time_bands = 2", 1.0));
    // At 0 all cycles begin.
    assert_eq!(motion("time_bands = 2\ncycles = 0.5", 0.0), motion("time_bands = 2", 0.0));
}

#[test]
fn gradients_match_finite_differences() {
    for (name, device) in devices() {
        let device = device.clone().autodiff();
        let mut field = field(TINY, &device);
        shake(&mut field, &device);
        let points = centres(60);
        let wave: Vec<f32> = (0..60 * 59).map(|i| 1.0 + 0.5 * (i as f32 * 0.7).sin()).collect();
        let loss = |field: &Cdf| {
            let out = values(evaluate(field, &points, 0.43, &device).1.concatenated().expect("heads"));
            out.iter().zip(&wave).map(|(o, w)| f64::from(*o) * f64::from(*w)).sum::<f64>()
        };
        let out = evaluate(&field, &points, 0.43, &device).1.concatenated().expect("heads");
        let grads = (out * matrix(wave.clone(), 59, &device)).sum().backward();
        // Along its gradient the loss changes most, so the change is above the rounding error; the short step crosses few ReLU kinks.
        for index in 0..field.parameters().len() {
            let (gradient, start) = {
                let p = field.parameters()[index];
                (values(p.value.grad(&grads).expect("a gradient")), values(p.value.clone()))
            };
            let norm = gradient.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
            let mut ends = [0.0; 2];
            for (end, step) in ends.iter_mut().zip([5e-4, -5e-4]) {
                let moved: Vec<f32> = start.iter().zip(&gradient).map(|(s, g)| s + (step * f64::from(*g) / norm) as f32).collect();
                let n = moved.len();
                field.parameters_mut()[index].value = Tensor::<1>::from_data(TensorData::new(moved, [n]), &device);
                *end = loss(&field);
            }
            let n = start.len();
            field.parameters_mut()[index].value = Tensor::<1>::from_data(TensorData::new(start, [n]), &device);
            let slope = (ends[0] - ends[1]) / 1e-3;
            assert!((slope / norm - 1.0).abs() < 0.03, "{name} {}: slope {slope}, gradient norm {norm}", field.parameters()[index].name);
        }
    }
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| {
            let device = Device::flex().autodiff();
            let mut field = field(TINY, &device);
            shake(&mut field, &device);
            let out = evaluate(&field, &centres(5000), 0.2, &device).1.concatenated().expect("heads");
            let grads = out.clone().powi_scalar(2).sum().backward();
            let gradients: Vec<Vec<f32>> = field.parameters().iter().map(|p| values(p.value.grad(&grads).expect("a gradient"))).collect();
            (values(out), gradients)
        })
    };
    assert!(run(1) == run(3), "one and three threads disagree");
}

#[test]
fn points_outside_the_box_take_the_face() {
    let device = Device::flex();
    let mut field = field(TINY, &device);
    shake(&mut field, &device);
    let outside = [5.0, 0.1, 1.0, -9.0, -9.0, -9.0, 0.3, 0.2, 2.5];
    let face = [1.0, 0.1, 1.0, -1.0, -0.5, 0.0, 0.3, 0.2, 2.0];
    assert_eq!(evaluate(&field, &outside, 0.0, &device).0, evaluate(&field, &face, 0.0, &device).0);
}

#[test]
fn seeds_decide_the_weights() {
    let device = Device::flex();
    let all = |seed: u64| {
        let field = Cdf::new(config(TINY), &DeformerContext { seed: Seed::root(seed), ..context(300) }, &device).expect("a field");
        field.parameters().iter().map(|p| values(p.value.clone())).collect::<Vec<_>>()
    };
    assert_eq!(all(1), all(1));
    assert!(all(1) != all(2));
}

#[test]
fn odd_requests_get_answers() {
    let device = Device::flex();
    let small = field(TINY, &device);
    let none = small.spatial(&SpatialInput::new(Tensor::zeros([0, 3], &device))).expect("no points are fine");
    assert_eq!(none.values.dims(), [0, 16]);
    assert_eq!(small.deform(none.values, 0.5).expect("no rows are fine").means.map(|t| t.dims()), Some([0, 3]));
    let one = small.spatial(&SpatialInput::new(Tensor::from_floats([[f32::NAN, f32::INFINITY, 0.0]], &device))).expect("a defined result").values;
    assert!(values(one.clone()).iter().all(|v| v.is_finite()));
    assert!(small.deform(one.clone(), f32::NAN).is_err());
    assert!(small.deform(one.repeat_dim(1, 2), 0.5).is_err(), "features of another width");
    for text in [
        "levels = 0",
        "levels = 99",
        "resolutions = [0]",
        "resolutions = [99999]",
        "levels = 2\nresolutions = [4]",
        "heads = []",
        "width = 0",
        "modulus = 1",
        "heads = [\"sh\", \"sh\"]",
        "hidden = [0]",
        "lr_start = nan",
        "hashes = 100000",
        "cycles = 0.0",
        "falloff = -1.0",
        "falloff = nan",
    ] {
        let e = Cdf::new(config(text), &context(300), &device).err().unwrap_or_else(|| panic!("'{text}' was accepted"));
        assert!(e.to_string().contains("deformer"), "{e}");
    }
    let registry = Registry::collect().expect("a registry");
    let section = |kind: &str, settings: &str| {
        let table = cc4dgs_core::config::parse_table("test", &format!("kind = \"{kind}\"\n{settings}")).expect("TOML");
        registry.build_deformer(&table, &context(10), &device)
    };
    let message = section("cdf", "levls = 3").err().expect("unknown keys are refused").to_string();
    assert!(message.contains("levls"), "{message}");
    assert!(section("none", "levls = 3").is_err());
    assert!(section("none", "").expect("none").is_static());
    assert_eq!(section("cdf", "").expect("cdf").size_bytes().0, 753_280);
    // The schema shown to users is the default configuration.
    let schema = registry.deformer("cdf").expect("cdf").info.schema;
    let shown = Cdf::new(config(schema), &context(300), &device).expect("the schema's settings");
    assert_eq!(shown.sizes(), field("", &device).sizes());
    let commented: String = schema.lines().map(|l| l.strip_prefix("# ").unwrap_or(l)).collect::<Vec<_>>().join("\n");
    assert_eq!(Cdf::new(config(&commented), &context(300), &device).expect("the schema's settings").sizes(), shown.sizes());
}

#[test]
fn completed_sections_state_every_default() {
    let registry = Registry::collect().unwrap();
    let section = |text: &str| cc4dgs_core::config::parse_table("test", text).unwrap();
    let device = cc4dgs_core::parse_device("flex").unwrap();
    let decoded = ["capacity", "hashes", "modulus", "vertex_reuse"];
    let stored = ["levels", "base", "features", "log2_rows", "grid_rate", "width", "layers"];
    for (kind, setting, keys) in
        [("cdf", "capacity = 'small'", &decoded[..]), ("cdf-basis", "capacity = 'small'", &decoded[..]), ("hash-basis", "width = 32", &stored[..])]
    {
        let given = section(&format!("kind = '{kind}'\n{setting}\nlife = true"));
        let full = registry.complete_deformer(&given).unwrap();
        for key in keys.iter().chain(&["time_bands", "heads", "lr_start"]) {
            assert!(full.contains_key(*key), "{kind}: no {key} in {full}");
        }
        assert!(full["life"].as_table().unwrap().len() >= 10, "{full}");
        assert_eq!(registry.complete_deformer(&full).unwrap(), full);
        let shapes = |section: &toml::Table| {
            let deformer = registry.build_deformer(section, &context(8), &device).unwrap();
            deformer.parameters().iter().map(|p| (p.name.clone(), p.shape.clone())).collect::<Vec<_>>()
        };
        assert_eq!(shapes(&given), shapes(&full), "{kind}");
    }
    let unknown = section("kind = 'cdf-basis'\nresolution = 16");
    let message = registry.build_deformer(&unknown, &context(8), &device).err().unwrap().to_string();
    assert!(message.contains("Did you mean resolutions") && message.contains("lr_start") && !message.contains("kept"), "{message}");
}
