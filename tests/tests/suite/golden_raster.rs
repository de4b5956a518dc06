//! The rasterizers compared with golden renders: images and gradients of every input, for both rule sets and both CPU devices.

use crate::raster_fixtures::{Scene, narrow, relative_l2, scenes, widen};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::cpu::raster::{self, SplatArrays};
use cc4dgs_backends::rasterizers::reference::{self, ReferenceInput};
use cc4dgs_backends::rasterizers::tile::TileRasterizer;
use cc4dgs_core::{Camera, ParameterSpace, Rasterizer, RenderSettings, SplatColors, Splats};

/// Collects values out of tolerance, so that one run reports all of them.
#[derive(Default)]
struct Findings(Vec<String>);

impl Findings {
    fn check(&mut self, what: String, error: f64, tolerance: f64) {
        // NaN is out of every tolerance.
        if error.is_nan() || error > tolerance {
            self.0.push(format!("{what}: error {error:.3e} over {tolerance:.1e}"));
        }
    }
    fn finish(self) {
        assert!(self.0.is_empty(), "{}", self.0.join("\n"));
    }
}

/// Ten times the error of the reference's own float32 run, by the key of an array.
fn tolerance(scene: &Scene, key: &str) -> f64 {
    let key = if key == "quats_wxyz" { "quats" } else { key };
    scene.results.tolerance(&format!("grad.{key}"), 0.0)
}

/// The same for the largest error of colours and alpha, and of depth over the largest depth.
fn image_tolerances(scene: &Scene) -> (f64, f64) {
    let noise = |key: &str, measure: &str| 10.0 * scene.results.number(&["noise_f32", key, measure]);
    (noise("image_robust", "max_abs").max(noise("alpha", "max_abs")), noise("depth_acc", "max_abs_over_maxmag"))
}

fn reference_input(scene: &Scene) -> ReferenceInput {
    let (colors, sh_rest) = scene.coefficients();
    let background = scene.inputs.get("in.background");
    ReferenceInput {
        means: scene.inputs.get("in.means"),
        scales: scene.inputs.get("in.scales"),
        quaternions: scene.inputs.get("in.quats_wxyz"),
        opacities: scene.inputs.get("in.opacities"),
        colors,
        sh_rest,
        background: std::array::from_fn(|k| background[k]),
    }
}

/// Gradients of the coefficients concatenated, as in the fixtures.
fn join_coefficients(dc: &[f64], rest: &[f64], n: usize) -> Vec<f64> {
    let width = rest.len() / n;
    (0..n).flat_map(|i| dc[3 * i..3 * i + 3].iter().chain(&rest[i * width..(i + 1) * width]).copied().collect::<Vec<_>>()).collect()
}

#[test]
fn golden_scenes_are_all_there() {
    let names: Vec<String> = scenes().into_iter().map(|scene| scene.name).collect();
    // Another folder may have other scenes.
    let committed = std::env::var_os("CC4DGS_GOLDEN").is_none();
    assert!(names.len() >= 20 && (!committed || names.len() == 21), "{} scenes: {names:?}", names.len());
    for needed in ["raster_a.inria", "raster_b2.gsplat099", "raster_b4.gsplat099", "raster_c.gsplat099", "raster_d_clamp_tie.gsplat0999"] {
        assert!(names.iter().any(|name| name == needed), "{needed} is missing");
    }
}

#[test]
fn golden_reference_in_float64() {
    let mut findings = Findings::default();
    for scene in scenes() {
        let input = reference_input(&scene);
        let out = reference::forward(&input, &scene.settings);
        let (image, depth, rest) = scene.image_errors(&out.planes);
        findings.check(format!("{} image", scene.name), image, 1e-10);
        findings.check(format!("{} depth", scene.name), depth, 1e-10);
        findings.check(format!("{} other pixels", scene.name), rest, 1.0 / 255.0);
        let radii = scene.results.get("out.radii");
        for (i, &radius) in out.radii.iter().enumerate() {
            let golden = radii[2 * i].max(radii[2 * i + 1]);
            // A Gaussian that is fainter than 1/255 is not drawn, and so has no radius here.
            let faint = radius == 0 && scene.results.get("out.opacities_eff")[i] < 1.0 / 255.0;
            findings.check(format!("{} radius {i}", scene.name), if faint { 0.0 } else { (radius as f64 - golden).abs() }, 0.0);
        }
        let g = reference::backward(&input, &scene.settings, &out.items, &scene.upstream());
        let n = input.opacities.len();
        let sh = join_coefficients(&g.colors, &g.sh_rest, n);
        let mut screen = [vec![0.0; 3 * n], vec![0.0; n], vec![0.0; 3 * n]];
        for (item, d) in out.items.iter().zip(&g.items) {
            let i = item.index;
            screen[0][3 * i..3 * i + 3].copy_from_slice(&d[2..5]);
            screen[1][i] = d[5];
            screen[2][3 * i..3 * i + 3].copy_from_slice(&d[6..9]);
        }
        for (key, values) in [
            ("means", &g.means),
            ("scales", &g.scales),
            ("quats_wxyz", &g.quaternions),
            ("opacities", &g.opacities),
            ("sh", &sh),
            ("means2d", &g.screen),
            ("viewmat", &g.camera),
            ("background", &g.background),
            ("conics", &screen[0]),
            ("opacities_eff", &screen[1]),
            ("colors", &screen[2]),
        ] {
            findings.check(format!("{} grad {key}", scene.name), relative_l2(values, &scene.results.get(&format!("grad.{key}"))), 1e-8);
        }
    }
    findings.finish();
}

#[test]
fn golden_tile_screen_gradients() {
    let mut findings = Findings::default();
    for scene in scenes() {
        let input = reference_input(&scene);
        let [means, scales, quaternions, opacities, colors, sh_rest] =
            [&input.means, &input.scales, &input.quaternions, &input.opacities, &input.colors, &input.sh_rest].map(|v| narrow(v));
        let splats = SplatArrays {
            means: &means,
            scales: &scales,
            quaternions: &quaternions,
            opacities: &opacities,
            colors: &colors,
            sh_rest: &sh_rest,
            background: input.background.map(|v| v as f32),
        };
        let mut out = raster::forward(&splats, &scene.settings).unwrap();
        let n = opacities.len();
        let mut seen = [vec![0.0; 2 * n], vec![0.0; 3 * n], vec![0.0; n], vec![0.0; 3 * n]];
        for (index, d) in raster::screen_gradients(splats.background, &scene.settings, &mut out.workspace, &narrow(&scene.upstream())) {
            let i = index as usize;
            let d = widen(&d);
            seen[0][2 * i..2 * i + 2].copy_from_slice(&d[0..2]);
            seen[1][3 * i..3 * i + 3].copy_from_slice(&d[2..5]);
            seen[2][i] = d[5];
            seen[3][3 * i..3 * i + 3].copy_from_slice(&d[6..9]);
        }
        for (key, values) in ["means2d", "conics", "opacities_eff", "colors"].into_iter().zip(&seen) {
            findings.check(format!("{} grad {key}", scene.name), relative_l2(values, &scene.results.get(&format!("grad.{key}"))), tolerance(&scene, key));
        }
    }
    findings.finish();
}

/// The golden loss through the plug-in on `device`: planes and all gradients.
fn check_operation(scene: &Scene, device: &Device, findings: &mut Findings) {
    let device = device.clone().autodiff();
    let input = reference_input(scene);
    let n = input.opacities.len();
    let tensor = |values: &[f64], shape: Vec<usize>| TensorData::new(narrow(values), shape);
    let two = |values: &[f64], width: usize| Tensor::<2>::from_data(tensor(values, vec![n, width]), &device).require_grad();
    let rest_len = input.sh_rest.len() / n / 3;
    let means = two(&input.means, 3);
    let scales = two(&input.scales, 3);
    let quaternions = two(&input.quaternions, 4);
    let opacities = Tensor::<1>::from_data(tensor(&input.opacities, vec![n]), &device).require_grad();
    let dc = two(&input.colors, 3);
    let rest = Tensor::<3>::from_data(tensor(&input.sh_rest, vec![n, rest_len, 3]), &device).require_grad();
    let screen_probe = Tensor::<2>::zeros([n, 2], &device).require_grad();
    let camera_probe = Tensor::<2>::zeros([4, 4], &device).require_grad();
    let background = Tensor::<1>::from_data(tensor(&input.background, vec![3]), &device).require_grad();
    let s = &scene.settings;
    let splats = Splats {
        means: means.clone(),
        scales: scales.clone(),
        quaternions: quaternions.clone(),
        opacities: opacities.clone(),
        colors: SplatColors::Sh { dc: dc.clone(), rest: rest.clone(), degree: s.sh_degree.unwrap() },
        space: ParameterSpace::Activated,
        screen_probe: Some(screen_probe.clone()),
        absolute_screen_probe: None,
        camera_probe: Some(camera_probe.clone()),
    };
    let camera = Camera {
        name: scene.name.clone(),
        width: s.width as u32,
        height: s.height as u32,
        fx: s.fx,
        fy: s.fy,
        cx: s.cx,
        cy: s.cy,
        world_to_camera: s.world_to_camera,
    };
    let render = RenderSettings {
        rules: s.rules,
        antialiased: s.antialiased,
        blur: s.blur,
        focal: None,
        near: None,
        background: Some(background.clone()),
        max_weights: true,
        pair_capacity: None,
    };
    let out = TileRasterizer.render(&splats, &camera, &render).unwrap();
    let weights = Tensor::<3>::from_data(tensor(&scene.upstream(), vec![5, s.height, s.width]), &device);
    let grads = (out.planes.clone() * weights).sum().backward();
    let planes = out.planes.into_data().try_to_vec::<f32>().unwrap();
    let (image, depth, rest_of_pixels) = scene.image_errors(&widen(&planes));
    let (image_tolerance, depth_tolerance) = image_tolerances(scene);
    findings.check(format!("{} image", scene.name), image, image_tolerance);
    findings.check(format!("{} depth", scene.name), depth, depth_tolerance);
    findings.check(format!("{} other pixels", scene.name), rest_of_pixels, 1.0 / 255.0);
    let list = |values: TensorData| widen(&values.try_to_vec::<f32>().unwrap());
    let sh = join_coefficients(&list(dc.grad(&grads).unwrap().into_data()), &list(rest.grad(&grads).unwrap().into_data()), n);
    for (key, values) in [
        ("means", list(means.grad(&grads).unwrap().into_data())),
        ("scales", list(scales.grad(&grads).unwrap().into_data())),
        ("quats_wxyz", list(quaternions.grad(&grads).unwrap().into_data())),
        ("opacities", list(opacities.grad(&grads).unwrap().into_data())),
        ("sh", sh),
        ("means2d", list(screen_probe.grad(&grads).unwrap().into_data())),
        ("viewmat", list(camera_probe.grad(&grads).unwrap().into_data())),
        ("background", list(background.grad(&grads).unwrap().into_data())),
    ] {
        findings.check(format!("{} grad {key}", scene.name), relative_l2(&values, &scene.results.get(&format!("grad.{key}"))), tolerance(scene, key));
    }
    // Radii may differ if the value before rounding up is close to an integer, and if the Gaussian's alpha stays below 1/255.
    let golden = scene.results.get("out.radii");
    let radii = out.stats.radii.into_data().convert::<i64>().try_to_vec::<i64>().unwrap();
    let drawn = out.stats.max_weights.unwrap().into_data().try_to_vec::<f32>().unwrap();
    for i in 0..n {
        let expected = golden[2 * i].max(golden[2 * i + 1]);
        let error = if radii[i] == 0 && drawn[i] == 0.0 { 0.0 } else { (radii[i] as f64 - expected).abs() };
        findings.check(format!("{} radius {i} ({} for {expected})", scene.name, radii[i]), error, if scene.ill_conditioned { 2.0 } else { 1.0 });
    }
}

#[test]
fn golden_tile_on_every_device() {
    for (name, device) in cc4dgs_tests::devices() {
        let mut findings = Findings::default();
        scenes().iter().for_each(|scene| check_operation(scene, &device, &mut findings));
        assert!(findings.0.is_empty(), "{name}:\n{}", findings.0.join("\n"));
    }
}
