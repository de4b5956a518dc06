//! Basis combinations compared with sums in float64, forward and backward, on every device.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::basis::{BasisShape, by_columns, combine, combine_all};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Deformer, DeformerContext, Gaussians, HostGaussians, Offsets, Registry, Seed, SpatialInput, config};
use cc4dgs_deformers as _;
use cc4dgs_tests::{devices, larger, poison};
use std::sync::Arc;

fn noise(seed: u64, len: usize) -> Vec<f32> {
    (0..len as u64).map(|k| (Seed::root(seed).index(k).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0).collect()
}

#[test]
fn values_and_gradients_are_those_of_the_sums() {
    let shapes = [vec![(1, 1)], vec![(3, 30), (3, 30), (4, 30)], vec![(3, 41), (1, 8), (48, 2)], vec![(2, 16), (5, 33)]];
    for (k, groups) in shapes.into_iter().enumerate() {
        let shape = Arc::new(BasisShape { groups });
        let (width, columns, count) = (shape.outputs(), shape.coefficients(), shape.functions());
        for rows in [1, 7, 300, 1000] {
            let (coefficients, functions, upstream) = (noise(1 + k as u64, rows * columns), noise(20, count), noise(30, rows * width));
            let mut values = vec![0.0f64; rows * width];
            let mut of_coefficients = vec![0.0f64; rows * columns];
            let mut of_functions = vec![0.0f64; count];
            // Head after head: outputs [rows, outputs] and coefficients [rows, outputs, functions] in memory order.
            let (mut output, mut index, mut function) = (0, 0, 0);
            for &(outputs, functions_of_head) in &shape.groups {
                for _ in 0..rows * outputs {
                    let d = f64::from(upstream[output]);
                    for f in function..function + functions_of_head {
                        let (c, phi) = (f64::from(coefficients[index]), f64::from(functions[f]));
                        values[output] += c * phi;
                        of_coefficients[index] = d * phi;
                        of_functions[f] += d * c;
                        index += 1;
                    }
                    output += 1;
                }
                function += functions_of_head;
            }
            for (name, device) in devices() {
                poison(&device);
                let device = device.autodiff();
                let c = Tensor::<2>::from_data(TensorData::new(coefficients.clone(), [rows, columns]), &device).require_grad();
                let f = Tensor::<1>::from_data(TensorData::new(functions.clone(), [count]), &device).require_grad();
                let u = Tensor::<1>::from_data(TensorData::new(upstream.clone(), [rows * width]), &device);
                let flat = |heads: Vec<Tensor<2>>| Tensor::cat(heads.into_iter().map(|h| h.flatten::<1>(0, 1)).collect(), 0);
                let out = flat(combine(c.clone(), f.clone(), &shape).unwrap());
                let packed = flat(combine(by_columns(c.clone(), &shape), f.clone(), &shape).unwrap());
                let gradients = (out.clone() * u).sum().backward();
                let close = |what: &str, found: Vec<f32>, wanted: &[f64]| {
                    let size = wanted.iter().fold(1.0f64, |a, v| a.max(v.abs()));
                    let worst = found.iter().zip(wanted).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, larger);
                    assert!(found.len() == wanted.len() && worst <= 2e-5 * size, "{name}, {shape:?}, {rows} rows, {what}: {worst} of {size}");
                };
                close("values by columns", to_vec(packed.inner(), "values").unwrap(), &values);
                close("values", to_vec(out.inner(), "values").unwrap(), &values);
                close("coefficients", to_vec(c.grad(&gradients).unwrap(), "gradient").unwrap(), &of_coefficients);
                close("functions", to_vec(f.grad(&gradients).unwrap(), "gradient").unwrap(), &of_functions);
            }
        }
    }
}

#[test]
fn gradients_of_several_moments_are_the_sums_of_each() {
    let shape = Arc::new(BasisShape { groups: vec![(3, 9), (3, 2), (4, 9)] });
    let (columns, count, width) = (shape.coefficients(), shape.functions(), shape.outputs());
    let rows = 290;
    for (name, device) in devices() {
        poison(&device);
        let device = device.autodiff();
        let upload = |seed: u64, len: usize| Tensor::<1>::from_data(TensorData::new(noise(seed, len), [len]), &device);
        let moments: Vec<Tensor<1>> = (0..3).map(|k| upload(40 + k, count).require_grad()).collect();
        // The loss does not depend on the second moment, nor on one head of the third.
        let loss = |outputs: &[Vec<Tensor<2>>]| {
            let weighted = |k: usize, heads: &[usize]| {
                let all: Vec<Tensor<1>> = heads.iter().map(|&h| outputs[k][h].clone().flatten(0, 1)).collect();
                let flat = Tensor::cat(all, 0);
                let len = flat.dims()[0];
                (flat * upload(60 + k as u64, len)).sum()
            };
            weighted(0, &[0, 1, 2]) + weighted(2, &[0, 2])
        };
        let coefficients = || upload(70, rows * columns).reshape([rows, columns]).inner();
        let tracked = [0, 1].map(|_| Tensor::<2>::from_inner(coefficients()).require_grad());
        let together = combine_all(tracked[0].clone(), moments.clone(), &shape).unwrap();
        let apart: Vec<Vec<Tensor<2>>> = moments.iter().map(|m| combine(tracked[1].clone(), m.clone(), &shape).unwrap()).collect();
        assert!(together.iter().flatten().map(|t| t.dims()[1]).sum::<usize>() == 3 * width);
        let list = |t: Tensor<2>| to_vec(t, "gradient").unwrap();
        let (a, b) = (loss(&together).backward(), loss(&apart).backward());
        let (found, wanted) = (list(tracked[0].grad(&a).unwrap()), list(tracked[1].grad(&b).unwrap()));
        let worst = found.iter().zip(&wanted).map(|(x, y)| (x - y).abs()).fold(0.0, larger);
        assert!(found.len() == rows * columns && worst < 1e-5 && wanted.iter().any(|v| v.abs() > 0.1), "{name}: {worst}");
        for (k, moment) in moments.iter().enumerate() {
            let (x, y) = (moment.grad(&a).map(|t| to_vec(t, "f").unwrap()), moment.grad(&b).map(|t| to_vec(t, "f").unwrap()));
            let worst = x.iter().flatten().zip(y.iter().flatten()).map(|(x, y)| (x - y).abs()).fold(0.0, larger);
            assert!(x.is_some() == (k != 1) && y.is_some() == (k != 1) && worst < 1e-3, "{name}, moment {k}: {worst}");
        }
    }
}

#[test]
fn what_does_not_fit_is_an_error() {
    let shape = Arc::new(BasisShape { groups: vec![(3, 4)] });
    for (_, device) in devices() {
        let tensor = |rows: usize, columns: usize| Tensor::<2>::zeros([rows, columns], &device);
        for (rows, columns, functions) in [(0, 12, 4), (2, 11, 4), (2, 12, 3), (2, 12, 5)] {
            let error = combine(tensor(rows, columns), Tensor::<1>::zeros([functions], &device), &shape).expect_err("it does not fit");
            assert!(error.to_string().contains("functions"), "{error}");
        }
    }
}

/// A deformer with functions that have almost no effect in one head and none in another.
#[test]
fn what_a_scene_does_not_use_is_left_out() {
    [1, 0, 2].into_iter().for_each(unused_functions_are_left_out);
}

/// See [`what_a_scene_does_not_use_is_left_out`]; with so many hidden layers in heads.
fn unused_functions_are_left_out(layers: usize) {
    let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 12, sh_degree: 1, seed: Seed::root(3) };
    let registry = Registry::collect().unwrap();
    let text =
        format!("levels = 2\nresolutions = [3, 6]\nhashes = 16\nhidden = [12]\nfeatures = 5\nwidth = 16\nlearned = 3\ntime_bands = 2\nhead_layers = {layers}");
    let section = config::parse_table("test", &text).unwrap();
    let plugin = registry.deformer("cdf-basis").unwrap();
    let mut field = (plugin.build)(&section, &context, &Device::flex()).unwrap();
    // Functions: 1, t, two bands of two, three learned.
    let functions = 9;
    for parameter in field.parameters_mut() {
        let [head, outputs] = match parameter.name.as_str() {
            "net.head.means" => [1, 3],
            "net.head.quaternions" => [2, 4],
            _ => continue,
        };
        let mut values = to_vec(parameter.value.clone(), "weights").unwrap();
        let columns = outputs * functions;
        let last = values.len() - 17 * columns;
        let random = noise(50 + head as u64, values.len());
        for (k, value) in values[last..].iter_mut().enumerate() {
            // Centres use the constant, t and the first band; rotations everything; scales stay at zero.
            let used = head == 2 || k % functions < 4;
            *value = random[k] * if used { 0.3 } else { 1e-6 };
        }
        let len = values.len();
        parameter.value = Tensor::from_data(TensorData::new(values, [len]), &Device::flex());
    }
    let points = Tensor::<2>::from_data(TensorData::new(noise(60, 300), [100, 3]), &Device::flex());
    let times = [0.0, 0.2, 0.45, 0.7, 1.0];
    let features = field.spatial(&SpatialInput::new(points.clone())).unwrap().values;
    let simple = field.simplified(features, &times).unwrap().expect("something is unused");
    assert!(simple.message.contains("means keeps 4 of 9") && simple.message.contains("log_scales has no effect"), "{}", simple.message);
    let bytes = |f: &dyn Deformer| f.size_bytes().0 + f.size_bytes().1;
    assert!(bytes(simple.field.as_ref()) < bytes(field.as_ref()));

    // The deformer built from the settings accepts the weights and gives the same offsets.
    let mut again = (plugin.build)(&simple.settings, &context, &Device::flex()).unwrap();
    for (to, from) in again.parameters_mut().into_iter().zip(simple.field.parameters()) {
        assert_eq!((&to.name, &to.shape), (&from.name, &from.shape));
        to.value = from.value.clone();
    }
    let offsets = |f: &dyn Deformer, time: f32| {
        let found = f.deform(f.spatial(&SpatialInput::new(points.clone())).unwrap().values, time).unwrap();
        let read = |t: Option<Tensor<2>>| t.map(|t| to_vec(t, "offsets").unwrap());
        (read(found.means), read(found.log_scales), read(found.quaternions))
    };
    for time in times {
        let (before, after, rebuilt) = (offsets(field.as_ref(), time), offsets(simple.field.as_ref(), time), offsets(again.as_ref(), time));
        assert_eq!(after, rebuilt);
        assert!(after.1.is_none() && before.1.unwrap().iter().all(|v| *v == 0.0));
        for (a, b) in [(before.0, after.0), (before.2, after.2)] {
            let worst = a.unwrap().iter().zip(b.unwrap()).map(|(a, b)| (a - b).abs()).fold(0.0, larger);
            assert!(worst < 1e-4, "at {time}: {worst}");
        }
    }
    for broken in ["means = [3, 1]", "means = []", "means = [9]", "opacity = [0]"] {
        let section = config::parse_table("test", &format!("{text}\n[kept]\n{broken}")).unwrap();
        let error = (plugin.build)(&section, &context, &Device::flex()).map(|_| ()).expect_err(broken).to_string();
        assert!(error.contains("deformer.kept"), "{error}");
    }
}

/// What is dropped from a deformer with these coefficients, head after head, row by row, per output those of the functions 1, t, and two bands of two.
fn dropped(heads: &str, rows: usize, coefficients: Vec<f32>, times: &[f32]) -> String {
    let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 12, sh_degree: 1, seed: Seed::root(3) };
    let text = format!(
        "levels = 1\nresolutions = [3]\nhashes = 8\nhidden = [8]\nfeatures = 4\nwidth = 6\nlearned = 0\ntime_bands = 2\nunused = 0.01\nheads = {heads}"
    );
    let plugin = Registry::collect().unwrap().deformer("cdf-basis").unwrap();
    let field = (plugin.build)(&config::parse_table("test", &text).unwrap(), &context, &Device::flex()).unwrap();
    let columns = coefficients.len() / rows;
    let features = Tensor::<2>::from_data(TensorData::new(coefficients, [rows, columns]), &Device::flex());
    field.simplified(features, times).unwrap().map(|simple| simple.message).unwrap_or_default()
}

#[test]
fn a_head_that_one_gaussian_uses_is_kept() {
    let (rows, own) = (3000, 6);
    // Centres use the constant; the scales of a single Gaussian use everything.
    let mut coefficients: Vec<f32> = (0..2 * 3 * own * rows).map(|k| if k < 3 * own * rows && k % own == 0 { 0.3 } else { 0.0 }).collect();
    let moving = 3 * own * (rows + 1000);
    coefficients[moving..moving + 3 * own].fill(0.5);
    let message = dropped("['means', 'log_scales']", rows, coefficients.clone(), &[0.1, 0.35, 0.8]);
    assert!(message.contains("means keeps 1 of 6") && !message.contains("log_scales"), "{message}");
    coefficients[moving..moving + 3 * own].fill(1e-4);
    let message = dropped("['means', 'log_scales']", rows, coefficients, &[0.1, 0.35, 0.8]);
    assert!(message.contains("log_scales has no effect"), "{message}");
}

#[test]
fn what_is_dropped_together_is_below_the_share_together() {
    let (rows, share) = (10, 0.0068);
    // At the end of the sequence, the constant, t and the first cosine are 1. Two shares as squares are below 0.01², their sum is not.
    let message = dropped("['means']", rows, [share, share, 0.0, 1.0, 0.0, 0.0].repeat(3 * rows), &[1.0]);
    assert!(message.contains("means keeps 2 of 6"), "{message}");
    // Where they take from each other, they go together.
    let message = dropped("['means']", rows, [share, -share, 0.0, 1.0, 0.0, 0.0].repeat(3 * rows), &[1.0]);
    assert!(message.contains("means keeps 1 of 6"), "{message}");
    let broken = dropped("['means']", rows, [f32::NAN, 0.0, 0.0, 1.0, 0.0, 0.0].repeat(3 * rows), &[1.0]);
    assert!(broken.is_empty(), "{broken}");
}

#[test]
fn a_moment_alone_is_that_moment_among_others() {
    let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 12, sh_degree: 1, seed: Seed::root(3) };
    let text = "levels = 1\nresolutions = [3]\nhashes = 8\nhidden = [8]\nfeatures = 4\nwidth = 6\nlearned = 5\ntime_bands = 3\nheads = ['means']";
    let section = config::parse_table("test", text).unwrap();
    let plugin = Registry::collect().unwrap().deformer("cdf-basis").unwrap();
    for (name, device) in devices() {
        let mut field = (plugin.build)(&section, &context, &device).unwrap();
        for (k, parameter) in field.parameters_mut().into_iter().enumerate() {
            let len = parameter.value.dims()[0];
            parameter.value = Tensor::from_data(TensorData::new(noise(80 + k as u64, len), [len]), &device);
        }
        let points = Tensor::<2>::from_data(TensorData::new(noise(60, 300), [100, 3]), &device);
        let features = field.spatial(&SpatialInput::new(points)).unwrap().values;
        let bits = |offsets: Offsets| to_vec(offsets.means.unwrap(), "means").unwrap().into_iter().map(f32::to_bits).collect::<Vec<u32>>();
        let times = [0.0, 0.137, 0.5, 0.731, 1.0];
        let together = field.deform_all(features.clone(), &times).unwrap();
        for (time, among) in times.into_iter().zip(together) {
            assert!(bits(field.deform(features.clone(), time).unwrap()) == bits(among), "{name}: other bits at {time}");
        }
    }
}

/// The group lasso compared with its definition (penalties times norms) and its gradient with finite differences, on every device.
#[test]
fn the_lasso_pulls_every_function_by_its_price() {
    let context = DeformerContext { box_min: [-1.0, -2.0, 0.0], box_max: [1.0, 2.0, 4.0], frame_count: 12, sh_degree: 1, seed: Seed::root(3) };
    let text = "levels = 1\nresolutions = [3]\nhashes = 8\nhidden = [8]\nfeatures = 4\nwidth = 6\nlearned = 2\ntime_bands = 3\nsparsity = 0.01\nfalloff = 0.0\nheads = [\"means\", \"quaternions\"]";
    let section = |layers: usize| config::parse_table("test", &format!("{text}\nhead_layers = {layers}")).unwrap();
    let registry = Registry::collect().unwrap();
    let prices = [1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 4.0, 4.0, 1.0, 1.0];
    for ((name, device), layers) in devices().into_iter().flat_map(|device| [1, 0, 2].map(|layers| (device.clone(), layers))) {
        let device = device.autodiff();
        let mut field = (registry.deformer("cdf-basis").unwrap().build)(&section(layers), &context, &device).unwrap();
        for (k, parameter) in field.parameters_mut().into_iter().enumerate() {
            let len = parameter.value.dims()[0];
            parameter.value = Tensor::from_data(TensorData::new(noise(70 + k as u64, len), [len]), &device).require_grad();
        }
        let centres = Tensor::<2>::zeros([1, 3], &device);
        let term = field.regularizer(&SpatialInput::new(centres), 0.5, 0.5).unwrap().expect("a term");
        let gradients = term.clone().backward();
        let mut wanted = 0.0;
        for (head, outputs, unit) in [("net.head.means", 3, 3.0), ("net.head.quaternions", 4, 1.0)] {
            let parameter = field.parameters().into_iter().find(|p| p.name == head).unwrap();
            let (values, gradient) = (to_vec(parameter.value.clone(), "w").unwrap(), to_vec(parameter.value.grad(&gradients).unwrap(), "g").unwrap());
            let first = layers * 6 * 7;
            assert!(gradient[..first].iter().all(|g| *g == 0.0), "{name}: {head}: hidden layers are not pulled");
            for (f, price) in prices.iter().enumerate() {
                let group = |values: &[f32]| -> Vec<f64> {
                    values[first..].chunks_exact(outputs * prices.len()).flat_map(|row| (0..outputs).map(|o| f64::from(row[o * prices.len() + f]))).collect()
                };
                let (weights, slopes) = (group(&values), group(&gradient));
                let norm = weights.iter().map(|w| w * w).sum::<f64>().sqrt();
                wanted += 0.01 / unit * price * norm;
                for (w, slope) in weights.iter().zip(slopes) {
                    assert!((slope - 0.01 / unit * price * w / norm).abs() < 1e-7, "{name}: {head} function {f}");
                }
            }
        }
        assert!((f64::from(to_vec(term, "term").unwrap()[0]) - wanted).abs() < 1e-5 * wanted, "{name}");
    }
}

#[test]
fn rotation_vectors_turn_what_is_there() {
    for (name, device) in devices() {
        let mut host = HostGaussians { means: vec![0.0; 6], log_scales: vec![0.0; 6], sh_dc: vec![0.0; 6], ..Default::default() };
        (host.opacity_logits, host.dynamic_scores) = (vec![0.0; 2], vec![0.0; 2]);
        // A quarter turn around x with norm 2, and one without rotation.
        let half = std::f32::consts::FRAC_1_SQRT_2;
        host.quaternions = vec![2.0 * half, 2.0 * half, 0.0, 0.0, 0.5, 0.5, 0.5, 0.5];
        let vectors = vec![0.0, 0.0, std::f32::consts::FRAC_PI_2, 0.0, 0.0, 0.0];
        let offsets = Offsets { rotation_vectors: Some(Tensor::from_data(TensorData::new(vectors, [2, 3]), &device)), ..Default::default() };
        let moved = offsets.apply("test", &Gaussians::from_host(&host, &device), None).unwrap().to_host().unwrap();
        // z quarter after x quarter: (1, 1, 1, 1) / 2.
        let wanted = [1.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.5];
        assert!(moved.quaternions.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-6), "{name}: {:?}", moved.quaternions);
    }
}
