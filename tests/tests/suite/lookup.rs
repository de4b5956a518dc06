//! Lookups in stored grids compared with the formulas of their papers, forward and backward, on every device.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::lookup::{GridShape, Outside, PRIMES, lookup};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_tests::{devices, larger, poison};
use rand::{Rng, SeedableRng};
use std::sync::Arc;

/// A joint hash grid as in tiny-cuda-nn: positions offset by half a cell, dense levels if the table is large enough.
fn hash_grid(dims: usize, levels: u32, rows: usize) -> GridShape {
    let mut shape = GridShape { dims, features: 3, levels: Vec::new(), stagger: 0.5, smooth: false, clamps: false, outside: Outside::Zero };
    for l in 0..levels {
        let size = 4u32 << l;
        shape.push(&vec![size; dims], &vec![size as f32 - 1.0; dims], rows);
    }
    shape
}

/// Planes as sampled by 4DGS: dense, corners aligned, border values repeated.
fn planes() -> GridShape {
    let mut shape = GridShape { dims: 2, features: 11, levels: Vec::new(), stagger: 0.0, smooth: false, clamps: true, outside: Outside::Clamp };
    for (w, h) in [(5, 7), (9, 7)] {
        shape.push(&[w, h], &[w as f32 - 1.0, h as f32 - 1.0], usize::MAX);
    }
    shape
}

/// A hash grid of vertices that lie on the faces of the box, where points outside have what the nearest face has, as `hash-basis` has it.
fn box_grid() -> GridShape {
    let mut shape = GridShape { dims: 3, features: 4, levels: Vec::new(), stagger: 0.0, smooth: false, clamps: true, outside: Outside::Clamp };
    for size in [5, 10, 20] {
        shape.push(&[size; 3], &[size as f32 - 1.0; 3], 256);
    }
    shape
}

/// The same lookup in float64, for one point and one level at a time.
fn oracle(shape: &GridShape, table: &[f32], points: &[f32]) -> Vec<f64> {
    let mut out = Vec::new();
    for x in points.chunks(shape.dims) {
        for level in &shape.levels {
            let mut sum = vec![0.0f64; shape.features];
            let outside = x.iter().any(|v| !(0.0..=1.0).contains(v));
            if !(outside && shape.outside == Outside::Zero) {
                for corner in 0..1usize << shape.dims {
                    let (mut weight, mut hash, mut index, mut stride) = (1.0f64, 0u32, 0usize, 1usize);
                    for d in 0..shape.dims {
                        let position = f64::from(x[d].clamp(0.0, 1.0) * level.scale[d] + shape.stagger);
                        let low = if shape.clamps { position.floor().min(f64::from(level.size[d]) - 2.0) } else { position.floor() };
                        let part = position - low;
                        let part = if shape.smooth { part * part * (3.0 - 2.0 * part) } else { part };
                        let upper = corner >> d & 1;
                        weight *= if upper == 1 { part } else { 1.0 - part };
                        let vertex = low as usize + upper;
                        hash ^= (vertex as u32).wrapping_mul(PRIMES[d]);
                        index += vertex * stride;
                        stride *= level.size[d] as usize;
                    }
                    let row = level.first_row + if level.hashed { hash as usize % level.rows } else { index % level.rows };
                    for (s, v) in sum.iter_mut().zip(&table[row * shape.features..]) {
                        *s += weight * f64::from(*v);
                    }
                }
            }
            out.extend(sum);
        }
    }
    out
}

#[test]
fn features_and_gradients_are_those_of_the_formulas() {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(6);
    let smooth = GridShape { stagger: 0.0, smooth: true, ..hash_grid(3, 4, 128) };
    for shape in [hash_grid(4, 3, 512), hash_grid(3, 2, 100_000), smooth, planes(), box_grid()] {
        let m = 300;
        let mut points: Vec<f32> = (0..m * shape.dims).map(|_| random.random_range(-0.05..1.05)).collect();
        points[..shape.dims].fill(1.0);
        points[shape.dims..2 * shape.dims].fill(0.0);
        let table: Vec<f32> = (0..shape.parameter_count()).map(|_| random.random_range(-1.0..1.0)).collect();
        let upstream: Vec<f32> = (0..m * shape.width()).map(|_| random.random_range(-1.0..1.0)).collect();
        let truth = oracle(&shape, &table, &points);
        let shape = Arc::new(shape);
        let mut of_first: Option<Vec<f32>> = None;
        for (name, device) in devices() {
            poison(&device);
            let run = |device: &Device| {
                let matrix = |values: &[f32], width: usize| Tensor::<2>::from_data(TensorData::new(values.to_vec(), [values.len() / width, width]), device);
                let weights = Tensor::<1>::from_data(TensorData::new(table.clone(), [table.len()]), device).require_grad();
                let out = lookup(weights.clone(), matrix(&points, shape.dims), &shape).unwrap();
                let gradients = (out.clone() * matrix(&upstream, shape.width())).sum().backward();
                (to_vec(out.inner(), "features").unwrap(), to_vec(weights.grad(&gradients).unwrap(), "gradient").unwrap())
            };
            let (found, gradient) = run(&device.clone().autodiff());
            let worst = found.iter().zip(&truth).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, larger);
            assert!(worst < 1e-4, "{name}, {} axes: features differ by {worst:.2e}", shape.dims);
            // The lookup is linear in its table, so <gradient, table> = <upstream, features>.
            let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
            assert!((dot(&gradient, &table) - dot(&upstream, &found)).abs() < 1e-3 * dot(&upstream, &upstream).sqrt(), "{name}");
            match &of_first {
                None => of_first = Some(gradient),
                Some(first) => {
                    let worst = first.iter().zip(&gradient).map(|(a, b)| (a - b).abs()).fold(0.0, larger);
                    assert!(worst < 1e-4, "{name}, {} axes: gradients differ by {worst:.2e}", shape.dims);
                }
            }
            let again = run(&device.clone().autodiff());
            assert!(again.0 == found, "{name}: two runs differ");
        }
        // In any direction of the table, the slope of the oracle's loss agrees with the gradient.
        let direction: Vec<f32> = (0..table.len()).map(|_| random.random_range(-1.0..1.0)).collect();
        let loss: f64 = oracle(&shape, &direction, &points).iter().zip(&upstream).map(|(a, b)| a * f64::from(*b)).sum();
        let slope: f64 = of_first.unwrap().iter().zip(&direction).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum();
        assert!((loss - slope).abs() < 1e-3 * loss.abs().max(1.0), "{loss} and {slope}");
    }
}

#[test]
fn what_is_no_number_gets_a_defined_answer() {
    for (name, device) in devices() {
        for shape in [hash_grid(4, 2, 512), planes(), box_grid()] {
            let dims = shape.dims;
            let table = Tensor::<1>::ones([shape.parameter_count()], &device);
            let odd = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e30].repeat(dims);
            let points = Tensor::<2>::from_data(TensorData::new(odd, [4, dims]), &device);
            let found = to_vec(lookup(table.clone(), points, &Arc::new(shape.clone())).unwrap(), "features").unwrap();
            assert!(found.iter().all(|v| v.is_finite()), "{name}");
            assert!(lookup(table, Tensor::zeros([2, dims + 1], &device), &Arc::new(shape)).is_err());
        }
    }
}

/// Rows that no corner meets, one corner, as many as a kernel adds side by side, one more, and many: on the first and the last row of every level.
#[test]
fn gradients_of_rows_with_any_number_of_corners_are_exact() {
    /// Points at each eighth.
    const COUNTS: [[usize; 9]; 4] = [[1, 0, 0, 15, 1, 40, 0, 0, 17], [0, 0, 0, 0, 0, 0, 0, 0, 1], [0, 16, 0, 0, 0, 0, 33, 0, 0], [300, 0, 0, 0, 0, 0, 0, 0, 0]];
    let mut shape = GridShape { dims: 1, features: 3, levels: Vec::new(), stagger: 0.0, smooth: false, clamps: true, outside: Outside::Clamp };
    // Points at eighths are vertices of the first level, and vertices and centres of cells of the second: all weights are 0, 1/2 or 1.
    for size in [9, 5] {
        shape.push(&[size], &[size as f32 - 1.0], usize::MAX);
    }
    let shape = Arc::new(shape);
    for counts in COUNTS {
        let points: Vec<f32> = counts.iter().enumerate().flat_map(|(k, &count)| vec![k as f32 / 8.0; count]).collect();
        // Small integers, whose sums are exact in every order.
        let upstream: Vec<f32> = (0..points.len() * shape.width()).map(|k| (k * 7 % 11) as f32 - 5.0).collect();
        let mut wanted = vec![0.0f32; shape.parameter_count()];
        for (x, upstream) in points.iter().zip(upstream.chunks(shape.width())) {
            for (level, upstream) in shape.levels.iter().zip(upstream.chunks(shape.features)) {
                let position = x * level.scale[0];
                let low = position.floor().min(level.scale[0] - 1.0);
                for (row, weight) in [(low as usize, 1.0 - (position - low)), (low as usize + 1, position - low)] {
                    for (f, d) in upstream.iter().enumerate() {
                        wanted[(level.first_row + row) * shape.features + f] += weight * d;
                    }
                }
            }
        }
        for (name, device) in devices() {
            poison(&device);
            let device = device.autodiff();
            let table = Tensor::<1>::zeros([shape.parameter_count()], &device).require_grad();
            let count = points.len();
            let given = Tensor::<2>::from_data(TensorData::new(points.clone(), [count, 1]), &device);
            let weights = Tensor::<2>::from_data(TensorData::new(upstream.clone(), [count, shape.width()]), &device);
            let gradients = (lookup(table.clone(), given, &shape).unwrap() * weights).sum().backward();
            let found = to_vec(table.grad(&gradients).unwrap(), "gradient").unwrap();
            assert!(found == wanted, "{name}, {counts:?}: {found:?} instead of {wanted:?}");
        }
    }
}

#[test]
fn grids_without_features_are_refused() {
    let device = Device::flex();
    for shape in [GridShape { features: 0, ..planes() }, GridShape { levels: Vec::new(), ..planes() }] {
        let found = lookup(Tensor::zeros([1], &device), Tensor::zeros([2, 2], &device), &Arc::new(shape));
        let error = found.map(|_| ()).expect_err("no features").to_string();
        assert!(error.contains("grid lookup") && error.contains("one level and one feature"), "{error}");
    }
}
