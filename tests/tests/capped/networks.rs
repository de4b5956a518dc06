//! Networks of every shape compared with layers in burn's primitives, forward and backward, on every device: trunks, heads, outputs wider than a tile,
//! layers too wide for a tile, and rows that are processed in parts.

use burn::tensor::activation::relu;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::field::{ReluShape, mlp_relu};
use cc4dgs_backends::{cap_bindings, cap_shared_memory};
use cc4dgs_tests::{devices, poison};
use std::sync::Arc;

fn numbers(n: usize, step: f32) -> Vec<f32> {
    (0..n).map(|i| (i as f32 * step).sin() * 0.4).collect()
}

fn tensor<const D: usize>(values: Vec<f32>, dims: [usize; D], device: &Device) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values, dims), device)
}

fn values<const D: usize>(t: &Tensor<D>) -> Vec<f32> {
    t.clone().into_data().try_to_vec::<f32>().expect("float32")
}

/// The same network, layer by layer.
fn plain(x: &Tensor<2>, weights: &Tensor<1>, shape: &ReluShape) -> Vec<Tensor<2>> {
    let mut at = 0;
    let mut linear = |x: Tensor<2>, output: usize| {
        let input = x.dims()[1];
        let w = weights.clone().narrow(0, at, input * output).reshape([input, output]);
        let b = weights.clone().narrow(0, at + input * output, output).reshape([1, output]);
        at += (input + 1) * output;
        x.matmul(w) + b
    };
    let trunk = shape.trunk.iter().fold(x.clone(), |x, &width| relu(linear(x, width)));
    if shape.heads.is_empty() {
        return vec![trunk];
    }
    let head = |widths: &Vec<usize>| {
        let last = widths.len() - 1;
        widths.iter().enumerate().fold(trunk.clone(), |x, (i, &width)| if i < last { relu(linear(x, width)) } else { linear(x, width) })
    };
    shape.heads.iter().map(head).collect()
}

fn distance(got: &[f32], want: &[f32]) -> f64 {
    assert_eq!(got.len(), want.len());
    let difference: f64 = got.iter().zip(want).map(|(g, w)| f64::from(g - w).powi(2)).sum();
    (difference / want.iter().map(|w| f64::from(*w).powi(2)).sum::<f64>().max(1e-30)).sqrt()
}

/// Outputs and the gradients of input (if wanted) and weights, for a loss that weighs every output differently.
fn run(rows: usize, shape: &ReluShape, wants_input: bool, device: &Device, fused: bool) -> Vec<Vec<f32>> {
    let device = device.clone().autodiff();
    let x = tensor(numbers(rows * shape.input, 0.37), [rows, shape.input], &device);
    let x = if wants_input { x.require_grad() } else { x };
    let count = shape.parameter_count();
    let weights = tensor(numbers(count, 0.91), [count], &device).require_grad();
    let outputs = if fused { mlp_relu(x.clone(), weights.clone(), &Arc::new(shape.clone())).expect("outputs") } else { plain(&x, &weights, shape) };
    let weighed = outputs.iter().map(|o| (o.clone() * tensor(numbers(o.dims().iter().product(), 0.53), o.dims(), &device)).sum());
    let loss = weighed.reduce(|a, b| a + b).expect("an output");
    let mut grads = loss.backward();
    let mut all: Vec<Vec<f32>> = outputs.iter().map(values).collect();
    all.push(values(&weights.grad_remove(&mut grads).expect("a gradient of the weights")));
    if wants_input {
        all.push(values(&x.grad_remove(&mut grads).expect("a gradient of the input")));
    }
    all
}

#[test]
fn networks_of_every_shape_are_those_of_their_layers() {
    let _held = crate::alone();
    let shape =
        |input: usize, trunk: &[usize], heads: &[&[usize]]| ReluShape { input, trunk: trunk.to_vec(), heads: heads.iter().map(|h| h.to_vec()).collect() };
    let shapes = [
        shape(1, &[], &[&[1]]),
        shape(5, &[7], &[]),
        shape(9, &[16, 12, 20], &[]),
        shape(17, &[], &[&[24, 3], &[11]]),
        shape(20, &[33, 24], &[&[24, 3], &[24, 16, 5], &[48]]),
        // Outputs wider than the shared memory, behind a hidden layer and directly behind the trunk.
        shape(12, &[16], &[&[16, 150], &[90]]),
        // The same without a trunk, behind two hidden layers.
        shape(12, &[], &[&[16, 16, 150], &[90]]),
        shape(130, &[130], &[&[130, 4]]),
        // Too wide for the shared memory of any device.
        shape(3, &[1100], &[&[2]]),
    ];
    for (name, device) in devices() {
        for shape in &shapes {
            for rows in [1, 70, 1100] {
                // Wide layers are tested with few rows.
                if rows > 70 && shape.parameter_count() > 20_000 {
                    continue;
                }
                for wants_input in [false, true] {
                    poison(&device);
                    let got = run(rows, shape, wants_input, &device, true);
                    let want = run(rows, shape, wants_input, &Device::flex(), false);
                    for (i, (got, want)) in got.iter().zip(&want).enumerate() {
                        let d = distance(got, want);
                        assert!(d < 2e-5, "{name}: {shape:?} on {rows} rows (input gradient {wants_input}), result {i} differs by {d:.2e}");
                    }
                }
            }
        }
    }
    // With smaller bindings, which still hold all outputs, rows are processed in parts.
    let shape = &shapes[4];
    let whole: Vec<_> = devices().into_iter().map(|(name, device)| (name, run(1100, shape, true, &device, true), device)).collect();
    // With less shared memory, tiles are smaller or not used.
    type Cap = (&'static str, fn(u64), u64);
    let caps: [Cap; 3] = [("bindings", cap_bindings, 1 << 18), ("shared memory", cap_shared_memory, 16 << 10), ("shared memory", cap_shared_memory, 2 << 10)];
    for (what, cap, bytes) in caps {
        cap(bytes);
        for (name, whole, device) in &whole {
            for (whole, capped) in whole.iter().zip(run(1100, shape, true, device, true)) {
                let d = distance(&capped, whole);
                assert!(d < 2e-6, "{name}: with {bytes} bytes of {what}, results differ by {d:.2e}");
            }
        }
        cap(u64::MAX);
    }
}

#[test]
fn arrays_of_networks_beyond_a_binding_are_errors() {
    let _held = crate::alone();
    let shape = Arc::new(ReluShape { input: 4, trunk: vec![40], heads: vec![vec![2]] });
    for (name, device) in devices().into_iter().filter(|(name, _)| *name == "wgpu") {
        let run = |rows: usize| {
            let (x, weights) = (Tensor::zeros([rows, 4], &device), Tensor::zeros([shape.parameter_count()], &device));
            mlp_relu(x, weights, &shape).map(|_| ()).map_err(|error| error.to_string())
        };
        cap_bindings(1 << 16);
        let (fits, inputs) = (run(1100), run(5000));
        // Layer by layer, the hidden layer is an array too.
        cap_shared_memory(2 << 10);
        let hidden = run(1100);
        cap_shared_memory(u64::MAX);
        cap_bindings(u64::MAX);
        assert!(fits.is_ok(), "{name}: {fits:?}");
        for (refused, rows) in [(inputs, "5000"), (hidden, "1100")] {
            let message = refused.expect_err("it needs larger bindings");
            assert!(message.contains("network") && message.contains(rows) && message.contains("points"), "{name}: {message}");
        }
    }
}

/// A NaN in the input must reach the outputs of its row through every ReLU, and all gradients of weights: a training that hides it goes on with weights that
/// are no numbers. Other rows are what they are without it.
#[test]
fn a_nan_comes_through_every_network() {
    let _held = crate::alone();
    let shape = Arc::new(ReluShape { input: 6, trunk: vec![20, 16], heads: vec![vec![12, 3], vec![5]] });
    const ROWS: usize = 40;
    const BROKEN: usize = 17;
    let widths = shape.output_widths();
    // Outputs, then gradients of weights and input.
    let run = |value: Option<f32>, device: &Device| {
        poison(device);
        let device = device.clone().autodiff();
        let mut given = numbers(ROWS * shape.input, 0.37);
        if let Some(value) = value {
            given[BROKEN * shape.input + 2] = value;
        }
        let x = tensor(given, [ROWS, shape.input], &device).require_grad();
        let count = shape.parameter_count();
        let weights = tensor(numbers(count, 0.91), [count], &device).require_grad();
        let outputs = mlp_relu(x.clone(), weights.clone(), &shape).expect("outputs");
        let mut grads = outputs.iter().map(|o| o.clone().sum()).reduce(|a, b| a + b).expect("an output").backward();
        let gradients = [values(&weights.grad_remove(&mut grads).expect("of the weights")), values(&x.grad_remove(&mut grads).expect("of the input"))];
        (outputs.iter().map(values).collect::<Vec<_>>(), gradients)
    };
    let mut first: Option<Vec<f32>> = None;
    // With less shared memory, networks run layer by layer.
    for shared_bytes in [u64::MAX, 2 << 10] {
        for (name, device) in devices() {
            cap_shared_memory(shared_bytes);
            let (whole, broken) = (run(None, &device), run(Some(f32::NAN), &device));
            cap_shared_memory(u64::MAX);
            for ((whole, broken), &width) in whole.0.iter().zip(&broken.0).zip(&widths) {
                for (row, (whole, broken)) in whole.chunks(width).zip(broken.chunks(width)).enumerate() {
                    let right = if row == BROKEN { broken.iter().all(|v| v.is_nan()) } else { broken == whole };
                    assert!(right, "{name}: row {row} is {broken:?}, and {whole:?} without the NaN");
                }
            }
            let [of_weights, of_input] = broken.1;
            assert!(of_weights.iter().any(|g| g.is_nan()) && whole.1[0].iter().all(|g| g.is_finite()), "{name}: gradient of the weights");
            // The gradient of an input is a product of weights where every ReLU passes it.
            let own = of_input[BROKEN * shape.input..][..shape.input].to_vec();
            let d = distance(&own, first.get_or_insert_with(|| own.clone()));
            assert!(d < 2e-5 && own.iter().all(|g| *g != 0.0), "{name}: gradient of the input {own:?} differs by {d:.2e}");
        }
    }
}
