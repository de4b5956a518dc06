//! Affine transforms of colours, forwards and backwards, against the same in float64.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::colors::{NUMBERS, affine_colors};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_tests::devices;

const PLANES: usize = 4;

fn numbers(count: usize, seed: usize) -> Vec<f32> {
    (0..count).map(|k| ((k * 37 + seed * 101) as f32 * 0.618).sin()).collect()
}

fn near(found: &[f32], expected: &[f64], what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let size = expected.iter().fold(0.0f64, |most, e| most.max(e.abs()));
    for (k, (found, expected)) in found.iter().zip(expected).enumerate() {
        assert!((f64::from(*found) - expected).abs() < 2e-6 * size, "{what} {k}: {found}, {expected} expected");
    }
}

#[test]
fn colours_are_transformed_and_so_are_their_gradients() {
    // One of more pixels than a task or a workgroup has.
    for [height, width] in [[1, 1], [5, 7], [97, 103]] {
        let pixels = height * width;
        let (planes, transform, upstream) = (numbers(PLANES * pixels, 1), numbers(NUMBERS, 2), numbers(PLANES * pixels, 3));
        let at = |values: &[f32], c: usize, pixel: usize| f64::from(values[c * pixels + pixel]);
        let m = |c: usize, k: usize| f64::from(transform[3 * c + k]);
        let each = |of: &dyn Fn(usize, usize) -> f64| (0..PLANES).flat_map(|c| (0..pixels).map(move |p| (c, p))).map(|(c, p)| of(c, p)).collect::<Vec<f64>>();
        let forward =
            each(&|c, p| if c < 3 { (0..3).map(|k| m(c, k) * at(&planes, k, p)).sum::<f64>() + f64::from(transform[9 + c]) } else { at(&planes, c, p) });
        let of_planes = each(&|c, p| if c < 3 { (0..3).map(|k| m(k, c) * at(&upstream, k, p)).sum() } else { at(&upstream, c, p) });
        let sum = |of: &dyn Fn(usize) -> f64| (0..pixels).map(of).sum::<f64>();
        let mut of_transform: Vec<f64> = (0..9).map(|i| sum(&|p| at(&upstream, i / 3, p) * at(&planes, i % 3, p))).collect();
        of_transform.extend((0..3).map(|c| sum(&|p| at(&upstream, c, p))));
        for (name, device) in devices() {
            let device = device.autodiff();
            let array = |values: &[f32]| Tensor::<3>::from_data(TensorData::new(values.to_vec(), [PLANES, height, width]), &device);
            let image = array(&planes).require_grad();
            let own = Tensor::<1>::from_floats(transform.as_slice(), &device).require_grad();
            let out = affine_colors(image.clone(), own.clone()).unwrap();
            near(&to_vec(out.clone(), "image").unwrap(), &forward, &format!("{name}, image"));
            let gradients = (out * array(&upstream)).sum().backward();
            near(&to_vec(image.grad(&gradients).unwrap(), "planes").unwrap(), &of_planes, &format!("{name}, gradient of the planes"));
            near(&to_vec(own.grad(&gradients).unwrap(), "transform").unwrap(), &of_transform, &format!("{name}, gradient of the transform"));
        }
    }
}

#[test]
fn other_shapes_are_refused() {
    let device = Device::flex();
    for (planes, numbers) in [([2, 4, 4], NUMBERS), ([3, 0, 4], NUMBERS), ([3, 4, 4], 9)] {
        let error = affine_colors(Tensor::zeros(planes, &device), Tensor::zeros([numbers], &device)).unwrap_err().to_string();
        assert!(error.contains("affine colours"), "{error}");
    }
}
