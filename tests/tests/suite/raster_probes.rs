//! Gradients of projected centres: signed, and absolute per pixel.

use super::raster::{noise, relative, scene};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::bench::{StepCase, step_camera};
use cc4dgs_backends::rasterizers::reference::ReferenceRasterizer;
use cc4dgs_backends::rasterizers::tile::TileRasterizer;
use cc4dgs_core::{Camera, Gaussians, HostGaussians, Rasterizer, RenderSettings, Seed, Splats};

/// Signed and absolute gradients of the projected centres `[N,2]`, and all other gradients, for random weights of the planes.
fn screen_gradients(rasterizer: &dyn Rasterizer, device: &Device, host: &HostGaussians, camera: &Camera, absolute: bool) -> [Vec<f32>; 3] {
    let tracked = device.clone().autodiff();
    let n = host.opacity_logits.len();
    let probe = || Tensor::<2>::zeros([n, 2], &tracked).require_grad();
    let (signed, asked) = (probe(), probe());
    let mut splats = Splats::from_gaussians(&Gaussians::from_host(host, &tracked), 3);
    splats.means = splats.means.require_grad();
    splats.screen_probe = Some(signed.clone());
    splats.absolute_screen_probe = absolute.then(|| asked.clone());
    let out = rasterizer.render(&splats, camera, &RenderSettings::default()).unwrap();
    let shape = out.planes.dims();
    let weights = Tensor::<3>::from_data(TensorData::new(noise(Seed::root(72), shape.iter().product()), shape), &tracked);
    let grads = (out.planes * weights).sum().backward();
    let list = |t: Option<Tensor<2>>| t.map_or(Vec::new(), |t| t.into_data().try_to_vec::<f32>().unwrap());
    [list(signed.grad(&grads)), list(if absolute { asked.grad(&grads) } else { None }), list(splats.means.grad(&grads))]
}

#[test]
fn absolute_screen_gradients_agree_with_the_reference() {
    let camera = step_camera(&StepCase { width: 53, height: 37, gaussians: 120 });
    let host = scene(120, Seed::root(71));
    let [signed, truth, _] = screen_gradients(&ReferenceRasterizer::default(), &Device::flex(), &host, &camera, true);
    let wide: Vec<f64> = truth.iter().map(|&v| f64::from(v)).collect();
    let total = |values: &[f32]| values.iter().map(|v| f64::from(v.abs())).sum::<f64>();
    assert!(total(&truth) > 2.0 * total(&signed), "the pixels of a Gaussian pull in different directions");
    for (name, device) in cc4dgs_tests::devices() {
        let [signed, absolute, means] = screen_gradients(&TileRasterizer, &device, &host, &camera, true);
        let error = relative(&absolute, &wide);
        assert!(error < 1e-3, "{name}: {error:.2e}");
        for (s, a) in signed.iter().zip(&absolute) {
            assert!(s.abs() <= a * (1.0 + 1e-4) + 1e-6, "{name}: absolute gradient {a} below the signed {s}");
        }
        // A probe does not change other gradients.
        let [same_signed, none, same_means] = screen_gradients(&TileRasterizer, &device, &host, &camera, false);
        assert!(same_signed == signed && same_means == means && none.is_empty(), "{name}: asking for absolute gradients changes others");
    }
}

#[test]
fn a_gaussian_of_one_pixel_has_equal_signed_and_absolute_gradients() {
    let camera = Camera::look_at("pixel", (1, 1), 0.2, [0.0, 0.0, -4.0], [0.0; 3], [0.0, -1.0, 0.0]);
    let mut host = scene(6, Seed::root(73));
    host.means.iter_mut().for_each(|m| *m *= 0.05);
    host.log_scales.fill(-1.5);
    host.opacity_logits.fill(-1.0);
    let all = cc4dgs_tests::devices().into_iter().map(|(name, device)| (name, device, &TileRasterizer as &dyn Rasterizer));
    for (name, device, rasterizer) in all.chain([("reference", Device::flex(), &ReferenceRasterizer::default() as &dyn Rasterizer)]) {
        let [signed, absolute, _] = screen_gradients(rasterizer, &device, &host, &camera, true);
        assert!(absolute.iter().any(|a| *a > 1e-4), "{name}: nothing was drawn");
        for (s, a) in signed.iter().zip(&absolute) {
            assert!((s.abs() - a).abs() <= 1e-4 * a + 1e-7, "{name}: {a} where |{s}| is expected");
        }
    }
}
