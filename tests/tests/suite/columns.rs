//! Matrices side by side, and their gradients, on every device.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::columns::{PARTS, beside};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_tests::devices;

const WIDTHS: [usize; PARTS] = [1, 2, 1, 3, 1];

/// Matrices of `rows` rows; every number says its part, row and column.
fn parts(rows: usize, device: &Device) -> [Tensor<2>; PARTS] {
    std::array::from_fn(|part| {
        let values = (0..rows * WIDTHS[part]).map(|i| (part * 1_000_000 + i) as f32).collect::<Vec<_>>();
        Tensor::from_data(TensorData::new(values, [rows, WIDTHS[part]]), device)
    })
}

#[test]
fn they_are_joined_as_burn_joins_them() {
    for (name, device) in devices() {
        // More rows than a task of the CPU kernel has.
        for rows in [0, 1, 5, 9000] {
            let parts = parts(rows, &device);
            let expected = to_vec(Tensor::cat(parts.to_vec(), 1), "joined").unwrap();
            let found = beside(parts);
            assert_eq!(found.dims(), [rows, 8], "{name}");
            assert_eq!(to_vec(found, "joined").unwrap(), expected, "{name}, {rows} rows");
        }
    }
}

#[test]
fn each_gets_the_gradient_of_its_columns() {
    for (name, device) in devices() {
        let device = device.autodiff();
        for rows in [1, 9000] {
            // Only the second and the fourth want one.
            let parts = parts(rows, &device);
            let tracked: [Tensor<2>; PARTS] = std::array::from_fn(|k| if k % 2 == 1 { parts[k].clone().require_grad() } else { parts[k].clone() });
            let weights: Vec<f32> = (0..rows * 8).map(|i| i as f32).collect();
            let weights = Tensor::<2>::from_data(TensorData::new(weights, [rows, 8]), &device);
            let gradients = (beside(tracked.clone()) * weights).sum().backward();
            for (k, from) in [(1, 1), (3, 4)] {
                let found = to_vec(tracked[k].grad(&gradients).unwrap(), "gradient").unwrap();
                let expected: Vec<f32> = (0..rows).flat_map(|row| (0..WIDTHS[k]).map(move |column| (row * 8 + from + column) as f32)).collect();
                assert_eq!(found, expected, "{name}, part {k}");
            }
        }
    }
}
