//! Sums over views, on every device, against plain arithmetic.

use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_backends::ops::view_sums::{add_gradients, add_weights, fade};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_tests::devices;

/// More rows than a task of the CPU kernel has.
const ROWS: usize = 9001;

fn numbers(count: usize, seed: usize) -> Vec<f32> {
    (0..count).map(|i| ((i * 7919 + seed * 104_729) % 1000) as f32 / 500.0 - 1.0).collect()
}

/// Every third Gaussian is not shown.
fn radii(rows: usize) -> Vec<i64> {
    (0..rows).map(|row| (row % 3 * 5) as i64).collect()
}

fn on<const D: usize>(values: &[f32], shape: [usize; D], device: &Device) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values.to_vec(), shape), device)
}

fn ints(values: &[i64], device: &Device) -> Tensor<1, Int> {
    Tensor::from_data(TensorData::new(values.to_vec(), [values.len()]), device)
}

fn assert_near(found: Tensor<2>, expected: &[f32], name: &str) {
    let found = to_vec(found, "sums").unwrap();
    assert_eq!(found.len(), expected.len(), "{name}");
    for (i, (found, expected)) in found.iter().zip(expected).enumerate() {
        assert!((found - expected).abs() <= 2e-6 * expected.abs().max(1.0), "{name}, number {i}: {found}, expected {expected}");
    }
}

#[test]
fn gradients_are_added_where_a_gaussian_is_shown() {
    for (name, device) in devices() {
        for rows in [0, 1, ROWS] {
            let (sums, mut gradient, radii) = (numbers(2 * rows, 1), numbers(2 * rows, 2), radii(rows));
            // Gaussians 1, 2 and the last but one are shown; such gradients of theirs are left out.
            for (index, value) in [(2, f32::NAN), (5, f32::NEG_INFINITY), (2 * ROWS - 3, f32::INFINITY)] {
                if let Some(number) = gradient.get_mut(index) {
                    *number = value;
                }
            }
            let expected: Vec<f32> = (0..rows)
                .flat_map(|row| {
                    let norm = (2.0 * gradient[2 * row]).hypot(3.0 * gradient[2 * row + 1]);
                    let shown = radii[row] > 0 && norm.is_finite();
                    [sums[2 * row] + if shown { norm } else { 0.0 }, sums[2 * row + 1] + if shown { 1.0 } else { 0.0 }]
                })
                .collect();
            // With a second reference to the sums they are not changed in place.
            let before = on(&sums, [rows, 2], &device);
            let after = add_gradients(before.clone(), ints(&radii, &device), on(&gradient, [rows, 2], &device), [2.0, 3.0]).unwrap();
            assert_near(after, &expected, name);
            assert_near(before, &sums, name);
        }
    }
}

#[test]
fn weights_are_added_with_their_squares() {
    for (name, device) in devices() {
        let (sums, weights, radii) = (numbers(3 * ROWS, 3), numbers(ROWS, 4), radii(ROWS));
        let added = |row: usize| [weights[row], weights[row] * weights[row], if radii[row] > 0 { 1.0 } else { 0.0 }];
        let expected: Vec<f32> = (0..ROWS).flat_map(|row| (0..3).map(move |k| (row, k))).map(|(row, k)| sums[3 * row + k] + added(row)[k]).collect();
        let after = add_weights(on(&sums, [ROWS, 3], &device), ints(&radii, &device), on(&weights, [ROWS], &device)).unwrap();
        assert_near(after, &expected, name);
    }
}

#[test]
fn what_is_shown_fades_by_its_share_alone() {
    let logits = [0.0, 3.0, -4.0, 1e30, -1e30, 2.0, f32::NAN];
    for (name, device) in devices() {
        let after = to_vec(fade(on(&logits, [7], &device), ints(&[1, 2, 3, 4, 5, 0, 0], &device), 0.1).unwrap(), "logits").unwrap();
        for (logit, after) in logits.iter().zip(&after).take(5) {
            let opacity = |logit: f32| 1.0 / (1.0 + (-logit.clamp(-30.0, 30.0)).exp());
            assert!((opacity(*after) - 0.9 * opacity(*logit)).abs() < 1e-6, "{name}, {logit}: {after}");
        }
        assert!(after[5] == 2.0 && after[6].is_nan(), "{name}: {after:?}");
    }
}

#[test]
fn other_shapes_are_refused() {
    let device = Device::flex();
    let (two, three) = (ints(&[1, 1], &device), ints(&[1, 1, 1], &device));
    let sums = |width: usize| Tensor::<2>::zeros([2, width], &device);
    let error = add_gradients(sums(2), three.clone(), sums(2), [1.0; 2]).unwrap_err().to_string();
    assert!(error.contains("[[2, 2], [2, 2]] for 3 Gaussians"), "{error}");
    assert!(add_weights(sums(2), two, Tensor::zeros([2], &device)).is_err());
    assert!(fade(Tensor::zeros([2], &device), three, 0.1).is_err());
}
