//! 8-bit images are converted to the same values on every device.

use burn::tensor::{Tensor, TensorData};
use cc4dgs_backends::ops::image::{image_planes, read_image};
use cc4dgs_core::Image8;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_tests::{devices, larger};
use std::sync::Arc;

#[test]
fn planes_are_those_of_the_host() {
    for (width, height, channels) in [(1, 1, 3), (7, 5, 3), (7, 5, 4), (33, 2, 4)] {
        let data: Vec<u8> = (0..width * height * channels).map(|i| (i * 37 % 256) as u8).collect();
        let image = Arc::new(Image8 { width, height, channels, data });
        let truth = image.to_planes([0.2, 0.7, 1.0]);
        for (name, device) in devices() {
            let found = to_vec(image_planes(&image, [0.2, 0.7, 1.0], &device), "planes").unwrap();
            let worst = truth.iter().zip(&found).map(|(a, b)| (a - b).abs()).fold(0.0, larger);
            assert!(found.len() == truth.len() && worst <= 1.5e-7, "{name}: {width}x{height}x{channels} differs by {worst}");
        }
    }
}

#[test]
fn bytes_are_those_of_the_host() {
    let values: Vec<f32> = (0..4 * 35).map(|i| if i == 3 { f32::NAN } else { (i as f32 * 0.61).sin() * 0.7 + 0.5 }).collect();
    let truth = Image8::from_planes(&values, 7, 5);
    for (name, device) in devices() {
        let planes = Tensor::<3>::from_data(TensorData::new(values.clone(), [4, 5, 7]), &device);
        assert_eq!(read_image(planes).unwrap(), truth, "{name}");
        assert!(read_image(Tensor::zeros([2, 5, 7], &device)).is_err());
    }
}
