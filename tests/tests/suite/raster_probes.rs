//! Gradients of projected centres, signed and absolute per pixel, and of each input alone.

use super::raster::{EVERYTHING, NAMES, arrays, columns, noise, relative, scene, settings};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::bench::{StepCase, step_camera};
use cc4dgs_backends::cpu::raster;
use cc4dgs_backends::ops::rasterize::{GradientRequest, RasterSettings};
use cc4dgs_backends::rasterizers::reference::ReferenceRasterizer;
use cc4dgs_backends::rasterizers::tile::TileRasterizer;
use cc4dgs_core::{BLUR, Camera, Gaussians, HostGaussians, Rasterizer, RenderSettings, Rules, Seed, Splats};

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

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

#[test]
fn gradients_alone_are_those_of_all_together() {
    let camera = step_camera(&StepCase { width: 53, height: 37, gaussians: 120 });
    let host = scene(120, Seed::root(74));
    let upstream = noise(Seed::root(75), 5 * 53 * 37);
    let splats = arrays(&host, [0.2, 0.5, 0.9]);
    for (antialiased, sh_degree) in [(false, Some(3)), (true, Some(3)), (false, None), (true, None)] {
        let settings = RasterSettings { sh_degree, ..settings(&camera, Rules::Gsplat099, antialiased, BLUR, 3) };
        let mut drawn = raster::forward(&splats, &settings).unwrap();
        let mut gradients = |request: &GradientRequest| raster::backward(&splats, &settings, &mut drawn.workspace, &upstream, request);
        let all = gradients(&EVERYTHING);
        assert!(all.colors.iter().any(|g| *g != 0.0) && all.opacities.iter().any(|g| *g != 0.0), "nothing was drawn");
        for (k, name) in NAMES.into_iter().enumerate() {
            let request = GradientRequest {
                means: k == 0,
                scales: k == 1,
                quaternions: k == 2,
                opacities: k == 3,
                colors: k == 4,
                sh_rest: k == 5,
                background: k == 6,
                screen: k == 7,
                absolute_screen: k == 8,
                camera: k == 9,
            };
            let alone = gradients(&request);
            for (other, (found, wanted)) in columns(&alone).into_iter().zip(columns(&all)).enumerate() {
                let wanted = if other == k { bits(wanted) } else { Vec::new() };
                assert!(bits(found) == wanted, "{name} alone, antialiased {antialiased}, degree {sh_degree:?}: gradient of {}", NAMES[other]);
            }
        }
    }
}

#[test]
fn absolute_gradients_do_not_depend_on_the_kernel_for_depth() {
    let mut host = scene(6, Seed::root(76));
    host.means.iter_mut().for_each(|m| *m *= 0.05);
    host.log_scales.fill(-1.5);
    // One tile, whole and cut off, with pixels that no Gaussian reaches.
    for (width, height) in [(16, 16), (13, 16)] {
        let camera = Camera::look_at("tile", (width, height), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, -1.0, 0.0]);
        let settings = settings(&camera, Rules::Gsplat099, false, BLUR, 3);
        let splats = arrays(&host, [0.2, 0.5, 0.9]);
        let mut drawn = raster::forward(&splats, &settings).unwrap();
        let pixels = settings.width * settings.height;
        let mut upstream = noise(Seed::root(77), 5 * pixels);
        upstream[4 * pixels..].fill(0.0);
        let without = raster::backward(&splats, &settings, &mut drawn.workspace, &upstream, &EVERYTHING);
        // A gradient of depth where nothing is drawn adds zeros, and its tile is done by the kernel with depth.
        let empty: Vec<usize> = (0..pixels).filter(|i| drawn.planes[3 * pixels + i] == 0.0).collect();
        assert!(!empty.is_empty() && empty.len() < pixels, "{} of {pixels} pixels are empty", empty.len());
        empty.into_iter().for_each(|i| upstream[4 * pixels + i] = 1.0);
        let with = raster::backward(&splats, &settings, &mut drawn.workspace, &upstream, &EVERYTHING);
        assert!(without.absolute_screen.iter().any(|a| *a > 0.0), "no absolute gradients");
        for ((name, a), b) in NAMES.into_iter().zip(columns(&without)).zip(columns(&with)) {
            assert!(bits(a) == bits(b), "{width}x{height}: gradient of {name}");
        }
        // Where something is drawn, the gradient of depth counts.
        upstream[4 * pixels..].fill(1.0);
        let deep = raster::backward(&splats, &settings, &mut drawn.workspace, &upstream, &EVERYTHING);
        assert!(bits(&deep.absolute_screen) != bits(&with.absolute_screen), "{width}x{height}: depth has no effect");
    }
}
