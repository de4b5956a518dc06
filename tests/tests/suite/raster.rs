//! The rasterizers compared with each other and with finite differences, and edge cases.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::bench::{STANDARD_CASES, StepCase, random_gaussians, step_camera};
use cc4dgs_backends::cpu::raster::{self, Gradients, SplatArrays};
use cc4dgs_backends::ops::rasterize::{GradientRequest, RasterSettings};
use cc4dgs_backends::rasterizers::reference::{self, ReferenceInput, ReferenceRasterizer};
use cc4dgs_backends::rasterizers::tile::TileRasterizer;
use cc4dgs_core::{BLUR, Camera, Error, Gaussians, HostGaussians, ParameterSpace, Rasterizer, Registry, RenderSettings, Rules, Seed, SplatColors, Splats};
use cc4dgs_tests::larger;

pub const EVERYTHING: GradientRequest = GradientRequest {
    means: true,
    scales: true,
    quaternions: true,
    opacities: true,
    colors: true,
    sh_rest: true,
    background: true,
    screen: true,
    absolute_screen: true,
    camera: true,
};

pub fn arrays<'a>(g: &'a HostGaussians, background: [f32; 3]) -> SplatArrays<'a> {
    SplatArrays {
        means: &g.means,
        scales: &g.log_scales,
        quaternions: &g.quaternions,
        opacities: &g.opacity_logits,
        colors: &g.sh_dc,
        sh_rest: &g.sh_rest,
        background,
    }
}

pub fn settings(camera: &Camera, rules: Rules, antialiased: bool, blur: f64, degree: usize) -> RasterSettings {
    RasterSettings {
        width: camera.width as usize,
        height: camera.height as usize,
        fx: camera.fx,
        fy: camera.fy,
        cx: camera.cx,
        cy: camera.cy,
        world_to_camera: camera.world_to_camera,
        rules,
        near: None,
        antialiased,
        blur,
        space: ParameterSpace::Raw,
        sh_degree: Some(degree),
        max_weights: true,
        absolute_centers: false,
        pair_capacity: None,
        shortcuts: Default::default(),
    }
}

/// Random numbers in -1..1 from `seed`.
pub fn noise(seed: Seed, len: usize) -> Vec<f32> {
    (0..len as u64).map(|k| (seed.index(k).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0).collect()
}

/// A random scene with some opaque Gaussians, so that blending of pixels ends early.
pub fn scene(count: usize, seed: Seed) -> HostGaussians {
    let mut g = random_gaussians(count, seed);
    let strength = noise(seed.child("opacity"), count);
    g.opacity_logits.iter_mut().zip(strength).for_each(|(o, s)| *o = 5.0 * s);
    // Round Gaussians have no gradient with respect to their rotation.
    let stretch = noise(seed.child("stretch"), 3 * count);
    g.log_scales.iter_mut().zip(stretch).for_each(|(l, s)| *l += 0.7 * s);
    g
}

pub fn relative(a: &[f32], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    let norm = b.iter().map(|v| v * v).sum::<f64>().sqrt();
    a.iter().zip(b).map(|(a, b)| (f64::from(*a) - b).powi(2)).sum::<f64>().sqrt() / norm.max(1e-12)
}

/// The names of [`columns`].
pub const NAMES: [&str; 10] = ["means", "scales", "quaternions", "opacities", "colors", "sh_rest", "background", "screen", "absolute screen", "camera"];

pub fn columns(g: &Gradients) -> [&Vec<f32>; 10] {
    [&g.means, &g.scales, &g.quaternions, &g.opacities, &g.colors, &g.sh_rest, &g.background, &g.screen, &g.absolute_screen, &g.camera]
}

#[test]
fn tile_agrees_with_the_reference() {
    let seed = Seed::root(11);
    for (k, (rules, antialiased, blur, degree)) in
        [(Rules::Gsplat099, false, 0.1, 3), (Rules::Gsplat0999, true, BLUR, 2), (Rules::Inria, false, BLUR, 1), (Rules::Inria, true, 0.8, 0)]
            .into_iter()
            .enumerate()
    {
        // Sizes with partial tiles on both axes.
        let camera = step_camera(&StepCase { width: 53, height: 37, gaussians: 400 });
        let g = scene(400, seed.index(k as u64));
        let settings = settings(&camera, rules, antialiased, blur, degree);
        let background = [0.2, 0.5, 0.9];
        let splats = arrays(&g, background);
        let mut tile = raster::forward(&splats, &settings).unwrap();
        let wide = ReferenceInput::widen(&splats);
        let exact = reference::forward(&wide, &settings);
        let pixels = settings.width * settings.height;
        // A float32 threshold may be decided differently at a few pixels; those get no upstream gradient.
        let mut upstream = noise(seed.child("upstream"), 5 * pixels);
        let mut flipped = 0;
        for i in 0..pixels {
            let worst = (0..4).map(|c| (f64::from(tile.planes[c * pixels + i]) - exact.planes[c * pixels + i]).abs()).fold(0.0, larger);
            if worst > 1e-5 || worst.is_nan() {
                assert!(worst < 2.0 / 255.0, "{rules:?}: pixel {i} differs by {worst}");
                flipped += 1;
                (0..5).for_each(|c| upstream[c * pixels + i] = 0.0);
            }
        }
        assert!(flipped * 50 < pixels, "{rules:?}: {flipped} of {pixels} pixels differ");
        let weights: Vec<f64> = exact.max_weights.clone();
        assert!(relative(&tile.max_weights, &weights) < 1e-2, "{rules:?}: largest weights");
        let got = raster::backward(&splats, &settings, &mut tile.workspace, &upstream, &EVERYTHING);
        let upstream: Vec<f64> = upstream.iter().map(|&v| f64::from(v)).collect();
        let want = reference::backward(&wide, &settings, &exact.items, &upstream);
        let wanted = [
            &want.means,
            &want.scales,
            &want.quaternions,
            &want.opacities,
            &want.colors,
            &want.sh_rest,
            &want.background,
            &want.screen,
            &want.absolute_screen,
            &want.camera,
        ];
        for ((name, got), want) in NAMES.into_iter().zip(columns(&got)).zip(wanted) {
            let error = relative(got, want);
            assert!(error < 2e-4, "{rules:?} {name}: {error:.2e}");
        }
    }
}

#[test]
fn reference_gradients_match_finite_differences() {
    let camera = step_camera(&StepCase { width: 20, height: 14, gaussians: 12 });
    let mut g = random_gaussians(12, Seed::root(3));
    g.log_scales.iter_mut().for_each(|s| *s = -0.8);
    let s = settings(&camera, Rules::Gsplat099, true, 0.1, 3);
    let base = ReferenceInput::widen(&arrays(&g, [0.1, 0.4, 0.7]));
    let upstream: Vec<f64> = noise(Seed::root(4), 5 * 20 * 14).into_iter().map(f64::from).collect();
    let loss = |input: &ReferenceInput, s: &RasterSettings| -> f64 { reference::forward(input, s).planes.iter().zip(&upstream).map(|(a, b)| a * b).sum() };
    let out = reference::forward(&base, &s);
    let g = reference::backward(&base, &s, &out.items, &upstream);
    // The loss jumps where a pixel crosses a threshold, so single entries may be wrong, but not the median.
    let median = |mut errors: Vec<f64>| {
        errors.sort_by(f64::total_cmp);
        errors[errors.len() / 2]
    };
    let step = 1e-6;
    type Column = (&'static str, fn(&mut ReferenceInput) -> &mut Vec<f64>);
    let names: [Column; 6] = [
        ("means", |i| &mut i.means),
        ("scales", |i| &mut i.scales),
        ("quaternions", |i| &mut i.quaternions),
        ("opacities", |i| &mut i.opacities),
        ("colors", |i| &mut i.colors),
        ("sh_rest", |i| &mut i.sh_rest),
    ];
    for ((name, column), analytic) in names.into_iter().zip([&g.means, &g.scales, &g.quaternions, &g.opacities, &g.colors, &g.sh_rest]) {
        let errors = (0..analytic.len().min(36))
            .map(|k| {
                let at = |delta: f64| {
                    let mut moved = base.clone();
                    column(&mut moved)[k] += delta;
                    loss(&moved, &s)
                };
                let numeric = (at(step) - at(-step)) / (2.0 * step);
                (numeric - analytic[k]).abs() / (analytic[k].abs() + 1e-3)
            })
            .collect();
        let error = median(errors);
        assert!(error < 1e-5, "{name}: {error:.2e}");
    }
    let errors = (0..12)
        .map(|k| {
            let at = |delta: f64| {
                let mut moved = s.clone();
                moved.world_to_camera[k / 4][k % 4] += delta;
                loss(&base, &moved)
            };
            let numeric = (at(step) - at(-step)) / (2.0 * step);
            (numeric - g.camera[k]).abs() / (g.camera[k].abs() + 1e-3)
        })
        .collect();
    let error = median(errors);
    assert!(error < 1e-5, "camera: {error:.2e}");
}

#[test]
fn operation_gradients_match_finite_differences() {
    for (_, device) in cc4dgs_tests::devices() {
        let tracked = device.clone().autodiff();
        let camera = step_camera(&StepCase { width: 33, height: 17, gaussians: 30 });
        let mut host = random_gaussians(30, Seed::root(5));
        host.log_scales.iter_mut().for_each(|s| *s = -0.7);
        let planes = |host: &HostGaussians| {
            let g = Gaussians::from_host(host, &device);
            TileRasterizer.render(&Splats::from_gaussians(&g, 3), &camera, &RenderSettings::default()).unwrap().planes.into_data().try_to_vec::<f32>().unwrap()
        };
        let weights = noise(Seed::root(6), 5 * 33 * 17);
        let loss = |host: &HostGaussians| -> f64 { planes(host).iter().zip(&weights).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum() };
        let g = Gaussians::from_host(&host, &tracked);
        let mut splats = Splats::from_gaussians(&g, 3);
        splats.means = splats.means.require_grad();
        splats.opacities = splats.opacities.require_grad();
        let out = TileRasterizer.render(&splats, &camera, &RenderSettings::default()).unwrap();
        let weighted = out.planes * Tensor::<3>::from_data(TensorData::new(weights.clone(), [5, 17, 33]), &tracked);
        let grads = weighted.sum().backward();
        let d_means = splats.means.grad(&grads).unwrap().into_data().try_to_vec::<f32>().unwrap();
        let d_opacities = splats.opacities.grad(&grads).unwrap().into_data().try_to_vec::<f32>().unwrap();
        let mut errors = Vec::new();
        for k in 0..30 {
            let step = 2e-3;
            for (analytic, column) in [(d_means[3 * k], 0), (d_opacities[k], 1)] {
                let at = |delta: f32| {
                    let mut moved = host.clone();
                    if column == 0 {
                        moved.means[3 * k] += delta
                    } else {
                        moved.opacity_logits[k] += delta
                    }
                    loss(&moved)
                };
                let numeric = (at(step) - at(-step)) / f64::from(2.0 * step);
                errors.push((numeric - f64::from(analytic)).abs() / (f64::from(analytic).abs() + 0.05));
            }
        }
        errors.sort_by(f64::total_cmp);
        assert!(errors[30] < 1e-2, "median error {:.2e}", errors[30]);
    }
}

#[test]
fn bytes_do_not_depend_on_threads() {
    let camera = step_camera(&STANDARD_CASES[0]);
    let g = scene(3000, Seed::root(8));
    let s = settings(&camera, Rules::Gsplat099, false, BLUR, 3);
    let upstream = noise(Seed::root(9), 5 * s.width * s.height);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let splats = arrays(&g, [0.0; 3]);
            let mut out = raster::forward(&splats, &s).unwrap();
            let gradients = raster::backward(&splats, &s, &mut out.workspace, &upstream, &EVERYTHING);
            let mut all = out.planes.clone();
            all.extend(&out.max_weights);
            columns(&gradients).into_iter().for_each(|c| all.extend(c));
            (all.into_iter().map(f32::to_bits).collect::<Vec<_>>(), out.radii.clone(), out.work)
        })
    };
    let one = run(1);
    for threads in [2, 3, 7] {
        assert!(run(threads) == one, "{threads} threads give other bytes than one");
    }
}

#[test]
fn hostile_gaussians_never_reach_the_image() {
    let camera = step_camera(&StepCase { width: 40, height: 24, gaussians: 64 });
    let clean = scene(64, Seed::root(21));
    let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e30, -1e30, 3e38, 1e-40, 100.0];
    let s = settings(&camera, Rules::Gsplat099, true, BLUR, 3);
    for (rules, blur) in [(Rules::Gsplat099, BLUR), (Rules::Inria, 0.01)] {
        let s = RasterSettings { rules, blur, ..s.clone() };
        for (k, value) in bad.into_iter().enumerate() {
            for column in 0..6 {
                let mut g = clean.clone();
                let (_, width, values) = g.columns_mut().into_iter().nth(column).unwrap();
                (0..16).for_each(|i| values[i * 4 * width + (i + k) % width] = value);
                let splats = arrays(&g, [1.0; 3]);
                let mut out = raster::forward(&splats, &s).unwrap();
                assert!(out.planes.iter().all(|v| v.is_finite()), "{value} in column {column}");
                let upstream = vec![1e-3; out.planes.len()];
                let gradients = raster::backward(&splats, &s, &mut out.workspace, &upstream, &EVERYTHING);
                for (name, values) in NAMES.iter().zip(columns(&gradients)) {
                    assert!(values.iter().all(|v| !v.is_nan()), "{value} in column {column}: gradient of {name}");
                }
                if value.is_nan() {
                    assert!((0..16).all(|i| out.radii[4 * i] == 0), "a NaN was drawn");
                }
            }
        }
    }
}

pub fn empty_splats(device: &Device) -> Splats {
    let host = HostGaussians { sh_degree: 0, ..Default::default() };
    Splats::from_gaussians(&Gaussians::from_host(&host, device), 0)
}

#[test]
fn no_gaussians_show_the_background() {
    let camera = step_camera(&StepCase { width: 5, height: 3, gaussians: 0 });
    for (name, device) in cc4dgs_tests::devices() {
        // The reference computes in float64 on the host and refuses other devices.
        let on_host = name != "wgpu";
        for rasterizer in [&TileRasterizer as &dyn Rasterizer, &ReferenceRasterizer::default()].into_iter().take(if on_host { 2 } else { 1 }) {
            let background = Tensor::<1>::from_floats([0.25, 0.5, 1.0], &device);
            let render = RenderSettings { background: Some(background), max_weights: true, ..Default::default() };
            let out = rasterizer.render(&empty_splats(&device), &camera, &render).unwrap();
            let planes = out.planes.into_data().try_to_vec::<f32>().unwrap();
            for (plane, expected) in [0.25, 0.5, 1.0, 0.0, 0.0].into_iter().enumerate() {
                assert!(planes[plane * 15..(plane + 1) * 15].iter().all(|&v| v == expected), "plane {plane}: {planes:?}");
            }
            assert_eq!(out.stats.work.visible, 0);
        }
    }
}

#[test]
fn one_pixel_and_a_camera_inside_the_cloud() {
    let g = scene(500, Seed::root(31));
    for (width, height, eye) in [(1, 1, [0.0, 0.0, -7.0]), (1, 1, [0.0; 3]), (70, 9, [0.1, 0.2, 0.3])] {
        let camera = Camera::look_at("inside", (width, height), 1.2, eye, [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]);
        let s = settings(&camera, Rules::Gsplat099, false, BLUR, 3);
        let splats = arrays(&g, [0.0; 3]);
        let out = raster::forward(&splats, &s).unwrap();
        let exact = reference::forward(&ReferenceInput::widen(&splats), &s);
        let off = out.planes[..3 * s.width * s.height].iter().zip(&exact.planes).filter(|(a, b)| (f64::from(**a) - **b).abs() > 1e-4).count();
        assert!(off * 50 <= s.width * s.height, "{width}x{height}: {off} values differ");
    }
}

#[test]
fn direct_colours_are_blended_as_they_are() {
    let camera = step_camera(&StepCase { width: 32, height: 32, gaussians: 50 });
    let host = scene(50, Seed::root(41));
    let device = Device::flex().autodiff();
    let g = Gaussians::from_host(&host, &device);
    // Negative spherical-harmonics colours would be clamped; direct colours are not.
    let colors = Tensor::<2>::from_data(TensorData::new(noise(Seed::root(42), 150), [50, 3]), &device).require_grad();
    let mut splats = Splats::from_gaussians(&g, 3);
    splats.colors = SplatColors::Direct(colors.clone());
    let mut images = Vec::new();
    let mut gradients = Vec::new();
    for rasterizer in [&TileRasterizer as &dyn Rasterizer, &ReferenceRasterizer::default()] {
        let out = rasterizer.render(&splats, &camera, &RenderSettings::default()).unwrap();
        let grads = out.planes.clone().sum().backward();
        images.push(out.planes.into_data().try_to_vec::<f32>().unwrap());
        gradients.push(colors.grad(&grads).unwrap().into_data().try_to_vec::<f32>().unwrap());
    }
    assert!(images[0].iter().any(|&v| v < -1e-3), "nothing negative was drawn");
    for both in [images, gradients] {
        let wide: Vec<f64> = both[1].iter().map(|&v| f64::from(v)).collect();
        assert!(relative(&both[0], &wide) < 1e-4);
    }
}

#[test]
fn mistakes_are_named() {
    let device = Device::flex();
    let camera = step_camera(&StepCase { width: 8, height: 8, gaussians: 4 });
    let g = Gaussians::from_host(&random_gaussians(4, Seed::root(51)), &device);
    let mut splats = Splats::from_gaussians(&g, 3);
    splats.opacities = Tensor::zeros([3], &device);
    let error = TileRasterizer.render(&splats, &camera, &RenderSettings::default()).unwrap_err();
    assert!(matches!(error, Error::Parameter { .. }) && error.to_string().contains("opacities"), "{error}");
    let mut splats = Splats::from_gaussians(&g, 3);
    if let SplatColors::Sh { degree, .. } = &mut splats.colors {
        *degree = 4;
    }
    let error = TileRasterizer.render(&splats, &camera, &RenderSettings::default()).unwrap_err();
    assert!(error.to_string().contains("degree 4"), "{error}");
    let registry = Registry::collect().unwrap();
    for kind in ["tile", "reference"] {
        let section: toml::Table = format!("kind = \"{kind}\"\ntile_size = 8").parse().unwrap();
        let error = registry.build_rasterizer(&section).err().expect("an unknown key").to_string();
        assert!(error.contains("tile_size"), "{error}");
    }
}

#[test]
fn too_many_pairs_are_an_error() {
    // Every Gaussian covers the whole large image.
    let camera = step_camera(&StepCase { width: 8192, height: 8192, gaussians: 600 });
    let mut g = random_gaussians(600, Seed::root(61));
    g.log_scales.iter_mut().for_each(|s| *s = 4.0);
    g.opacity_logits.iter_mut().for_each(|o| *o = 4.0);
    let splats = Splats::from_gaussians(&Gaussians::from_host(&g, &Device::flex()), 3);
    let error = TileRasterizer.render(&splats, &camera, &RenderSettings::default()).unwrap_err();
    assert!(matches!(error, Error::Limit { .. }), "{error}");
}
