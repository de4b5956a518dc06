//! Combinations of shared functions: against sums in float64, forwards and backwards, on every device.

use burn::tensor::{Tensor, TensorData};
use cc4dgs_backends::ops::basis::{BasisShape, combine};
use cc4dgs_core::Seed;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_tests::{devices, poison};
use std::sync::Arc;

fn noise(seed: u64, len: usize) -> Vec<f32> {
    (0..len as u64).map(|k| (Seed::root(seed).index(k).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0).collect()
}

#[test]
fn values_and_gradients_are_those_of_the_sums() {
    let shapes = [vec![(1, 1)], vec![(3, 30), (3, 30), (4, 30)], vec![(3, 41), (1, 8), (48, 2)], vec![(2, 16), (5, 33)]];
    for (k, groups) in shapes.into_iter().enumerate() {
        let shape = Arc::new(BasisShape { groups });
        // One function more than any output reads.
        let (width, columns, count) = (shape.outputs(), shape.coefficients(), shape.functions() + 1);
        for rows in [1, 7, 300, 1000] {
            let (coefficients, functions, upstream) = (noise(1 + k as u64, rows * columns), noise(20, count), noise(30, rows * width));
            let mut starts = Vec::new();
            let mut at = 0;
            for &(outputs, functions) in &shape.groups {
                for _ in 0..outputs {
                    starts.push((at, functions));
                    at += functions;
                }
            }
            let mut values = vec![0.0f64; rows * width];
            let mut of_coefficients = vec![0.0f64; rows * columns];
            let mut of_functions = vec![0.0f64; count];
            for row in 0..rows {
                for (o, &(start, n)) in starts.iter().enumerate() {
                    let d = f64::from(upstream[row * width + o]);
                    for f in 0..n {
                        let place = row * columns + start + f;
                        let (c, phi) = (f64::from(coefficients[place]), f64::from(functions[f]));
                        values[row * width + o] += c * phi;
                        of_coefficients[place] = d * phi;
                        of_functions[f] += d * c;
                    }
                }
            }
            for (name, device) in devices() {
                poison(&device);
                let device = device.autodiff();
                let c = Tensor::<2>::from_data(TensorData::new(coefficients.clone(), [rows, columns]), &device).require_grad();
                let f = Tensor::<1>::from_data(TensorData::new(functions.clone(), [count]), &device).require_grad();
                let u = Tensor::<2>::from_data(TensorData::new(upstream.clone(), [rows, width]), &device);
                let out = combine(c.clone(), f.clone(), &shape).unwrap();
                let gradients = (out.clone() * u).sum().backward();
                let close = |what: &str, found: Vec<f32>, wanted: &[f64]| {
                    let size = wanted.iter().fold(1.0f64, |a, v| a.max(v.abs()));
                    let worst = found.iter().zip(wanted).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max);
                    assert!(found.len() == wanted.len() && worst <= 2e-5 * size, "{name}, {shape:?}, {rows} rows, {what}: {worst} of {size}");
                };
                close("values", to_vec(out.inner(), "values").unwrap(), &values);
                close("coefficients", to_vec(c.grad(&gradients).unwrap(), "gradient").unwrap(), &of_coefficients);
                close("functions", to_vec(f.grad(&gradients).unwrap(), "gradient").unwrap(), &of_functions);
            }
        }
    }
}

#[test]
fn what_does_not_fit_is_an_error() {
    let shape = Arc::new(BasisShape { groups: vec![(3, 4)] });
    for (_, device) in devices() {
        let tensor = |rows: usize, columns: usize| Tensor::<2>::zeros([rows, columns], &device);
        for (rows, columns, functions) in [(0, 12, 4), (2, 11, 4), (2, 12, 3)] {
            let error = combine(tensor(rows, columns), Tensor::<1>::zeros([functions], &device), &shape).expect_err("it does not fit");
            assert!(error.to_string().contains("functions"), "{error}");
        }
    }
}
