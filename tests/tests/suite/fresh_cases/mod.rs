//! Rounding against decisions, on fresh cases of every golden scene: a float32 kernel may lose digits, or decide otherwise than the oracle whether an alpha
//! reaches 1/255 or a pixel has stopped. The oracle knows how near every decision is and how large rounding errors can be, so the two are told apart per pixel.
//! What rounding alone does is what the reference's own formulas lose in float32.

mod draw;
mod scenes;

use crate::raster_fixtures::{largest_difference, narrow, relative_l2, widen};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::rasterizers::reference::blend::margins;
use cc4dgs_backends::rasterizers::reference::gaussian::TileRange;
use cc4dgs_backends::rasterizers::reference::{Precision, ReferenceOutput, backward_in, forward_in};
use cc4dgs_backends::rasterizers::tile::TileRasterizer;
use cc4dgs_core::{Camera, ParameterSpace, Rasterizer, RenderSettings, SplatColors, Splats};
use cc4dgs_tests::devices;
use draw::Case;
use scenes::Kind;

/// Distance in roundings at which a decision cannot fall the other way.
const CERTAIN: f64 = 4.0;
/// Least noise: that of a few roundings. What is summed in another order than in the reference may differ by so much.
const FLOOR: f64 = 1e-6;
/// At most one pixel of so many may be left out.
const LEFT_OUT: usize = 50;
/// Gaussians of at least this weight somewhere must come in the same order in float32, and reach the same tiles.
const WEIGHTY: f64 = 0.01;

/// What is compared: the largest difference of colours and alpha, and of depth over the largest depth; then the relative L2 error of each gradient.
const QUANTITIES: [&str; 11] = [
    "image",
    "depth",
    "gradient of means",
    "gradient of scales",
    "gradient of quaternions",
    "gradient of opacities",
    "gradient of colours",
    "gradient of harmonics",
    "gradient of background",
    "gradient of screen centres",
    "gradient of camera",
];

/// A render: planes `[5,H,W]`, and gradients in the order of [`QUANTITIES`].
struct Found {
    planes: Vec<f64>,
    gradients: [Vec<f64>; 9],
}

impl Found {
    fn reference(case: &Case, precision: Precision, out: &ReferenceOutput, upstream: &[f64]) -> Self {
        let g = backward_in(precision, &case.input(), &case.settings, &out.items, upstream);
        let gradients = [g.means, g.scales, g.quaternions, g.opacities, g.colors, g.sh_rest, g.background, g.screen, g.camera];
        Self { planes: out.planes.clone(), gradients }
    }
    fn tiles(case: &Case, device: &Device, upstream: &[f64]) -> Self {
        let device = device.clone().autodiff();
        let (n, s) = (case.opacities.len(), &case.settings);
        let rows = |values: &[f32], width: usize| Tensor::<2>::from_data(TensorData::new(values.to_vec(), [n, width]), &device).require_grad();
        let list = |values: &[f32]| Tensor::<1>::from_data(TensorData::new(values.to_vec(), [values.len()]), &device).require_grad();
        let (means, scales, quaternions, dc) = (rows(&case.means, 3), rows(&case.scales, 3), rows(&case.quaternions, 4), rows(&case.colors, 3));
        let (opacities, background) = (list(&case.opacities), list(&case.background));
        let rest = Tensor::<3>::from_data(TensorData::new(case.sh_rest.clone(), [n, case.sh_rest.len() / n / 3, 3]), &device).require_grad();
        let screen_probe = Tensor::<2>::zeros([n, 2], &device).require_grad();
        let camera_probe = Tensor::<2>::zeros([4, 4], &device).require_grad();
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
        let (width, height) = (s.width as u32, s.height as u32);
        let camera = Camera { name: "fresh".into(), width, height, fx: s.fx, fy: s.fy, cx: s.cx, cy: s.cy, world_to_camera: s.world_to_camera };
        let render = RenderSettings { rules: s.rules, antialiased: s.antialiased, blur: s.blur, background: Some(background.clone()), ..Default::default() };
        let planes = TileRasterizer.render(&splats, &camera, &render).unwrap().planes;
        let weights = Tensor::<3>::from_data(TensorData::new(narrow(upstream), [5, s.height, s.width]), &device);
        let grads = (planes.clone() * weights).sum().backward();
        let wide = |data: TensorData| widen(&data.try_to_vec::<f32>().unwrap());
        let of_list = |tensor: &Tensor<1>| wide(tensor.grad(&grads).unwrap().into_data());
        let of_rows = |tensor: &Tensor<2>| wide(tensor.grad(&grads).unwrap().into_data());
        let gradients = [
            of_rows(&means),
            of_rows(&scales),
            of_rows(&quaternions),
            of_list(&opacities),
            of_rows(&dc),
            wide(rest.grad(&grads).unwrap().into_data()),
            of_list(&background),
            of_rows(&screen_probe),
            of_rows(&camera_probe),
        ];
        Self { planes: wide(planes.into_data()), gradients }
    }
    /// Errors against `exact` in the order of [`QUANTITIES`]; those of planes at the pixels `kept`.
    fn errors(&self, exact: &Self, kept: &[bool]) -> Vec<f64> {
        let pixels = kept.len();
        let pick = |planes: &[f64]| -> Vec<f64> { planes.iter().enumerate().filter(|(k, _)| kept[k % pixels]).map(|(_, v)| *v).collect() };
        let difference = |from: usize, to: usize| {
            let range = from * pixels..to * pixels;
            largest_difference(&pick(&self.planes[range.clone()]), &pick(&exact.planes[range]))
        };
        let deepest = exact.planes[4 * pixels..].iter().fold(1.0f64, |a, b| a.max(*b));
        let mut errors = vec![difference(0, 4), difference(4, 5) / deepest];
        errors.extend(self.gradients.iter().zip(&exact.gradients).map(|(found, exact)| relative_l2(found, exact)));
        errors
    }
}

/// The Gaussians of weight front to back, with the tiles they are restricted to: what no rounding may decide.
fn order(out: &ReferenceOutput, weights: &[f64]) -> Vec<(usize, Option<TileRange>)> {
    out.items.iter().filter(|item| weights[item.index] >= WEIGHTY).map(|item| (item.index, item.tiles)).collect()
}

/// One quantity of one case on one device.
struct Row {
    case: String,
    /// Which of the devices.
    device: usize,
    /// Which of [`QUANTITIES`].
    quantity: usize,
    error: f64,
    noise: f64,
    bar: f64,
}

/// The largest of values; NaN is larger than all.
fn largest(values: impl Iterator<Item = f64>) -> f64 {
    values.fold(0.0, |a, b| if b.is_nan() { f64::INFINITY } else { a.max(b) })
}

/// Compares all cases of a kind; returns errors over their bounds, and cases that cannot be compared, with the reason.
fn check(kind: &Kind) {
    let devices = devices();
    let (mut findings, mut rows) = (Vec::new(), Vec::new());
    for seed in 0..kind.cases() {
        let made = kind.case(seed);
        let case = format!("{} seed {seed} ({:?})", kind.name, made.settings.rules);
        let out = forward_in(Precision::Float64, &made.input(), &made.settings);
        let rounded_out = forward_in(Precision::Float32, &made.input(), &made.settings);
        let margins = margins(&out.items, &made.settings);
        let kept: Vec<bool> = margins.iter().map(|m| m.relative > kind.robust && m.roundings > CERTAIN).collect();
        let left_out = kept.iter().filter(|kept| !**kept).count();
        if left_out * LEFT_OUT >= kept.len() {
            let near = margins.iter().filter(|m| m.relative <= kind.robust).count();
            findings.push(format!("{case}: {left_out} of {} pixels are left out ({near} within {:.0e})", kept.len(), kind.robust));
        }
        if order(&out, &out.max_weights) != order(&rounded_out, &out.max_weights) {
            findings.push(format!("{case}: the reference in float32 has another order or other tiles, so its errors are not digits"));
        }
        let upstream: Vec<f64> = made.upstream.iter().enumerate().map(|(k, v)| if kept[k % kept.len()] { *v } else { 0.0 }).collect();
        let exact = Found::reference(&made, Precision::Float64, &out, &upstream);
        assert!(out.pairs > 0 && exact.gradients[0].iter().any(|v| *v != 0.0), "{case}: nothing is drawn");
        let noises = Found::reference(&made, Precision::Float32, &rounded_out, &upstream).errors(&exact, &kept);
        for (at, (_, device)) in devices.iter().enumerate() {
            let errors = Found::tiles(&made, device, &upstream).errors(&exact, &kept);
            for (quantity, (error, &noise)) in errors.into_iter().zip(&noises).enumerate() {
                rows.push(Row { case: case.clone(), device: at, quantity, error, noise, bar: 10.0 * noise.max(FLOOR) });
            }
        }
    }
    for (quantity, name) in QUANTITIES.into_iter().enumerate() {
        let here = || rows.iter().filter(move |row| row.quantity == quantity);
        let noisiest = largest(here().map(|row| row.noise));
        for (at, (device, _)) in devices.iter().enumerate() {
            let error = largest(here().filter(|row| row.device == at).map(|row| row.error));
            eprintln!("{} on {device}, {name}: largest error {error:.1e}, largest of the reference in float32 {noisiest:.1e}", kind.name);
        }
        // NaN is out of every tolerance.
        for row in here().filter(|row| row.error.is_nan() || row.error > row.bar) {
            let (Row { case, error, noise, bar, .. }, device) = (row, devices[row.device].0);
            findings.push(format!(
                "{case}, {device}, {name}: error {error:.2e}, reference in float32 {noise:.2e} (at most {noisiest:.1e} over the seeds), bar {bar:.1e}"
            ));
        }
    }
    assert!(findings.is_empty(), "{}", findings.join("\n"));
}

/// A test per kind, and the list of all of them.
macro_rules! kinds {
    ($($test:ident: $kind:expr;)*) => {
        const KINDS: &[Kind] = &[$($kind),*];
        $(
            #[test]
            fn $test() {
                check(&$kind);
            }
        )*
    };
}

kinds! {
    few_gaussians: scenes::FEW;
    ordinary_scenes: scenes::ORDINARY;
    antialiased_off_center: scenes::ANTIALIASED;
    harmonics_of_degree_4: scenes::DEGREE_4;
    crowded_scenes: scenes::CROWDED;
    peaks_near_the_least_alpha: scenes::FAINT;
    capped_alphas_in_a_row: scenes::CAPPED;
    equal_depths: scenes::EQUAL_DEPTHS;
    inside_a_cloud: scenes::INSIDE;
    needles_and_discs: scenes::NEEDLE;
    opaque_stacks: scenes::OPAQUE;
}

#[test]
fn every_golden_scene_has_fresh_cases() {
    // Another folder may have other scenes.
    if std::env::var_os("CC4DGS_GOLDEN").is_some() {
        return;
    }
    for scene in crate::raster_fixtures::scenes() {
        let found = KINDS.iter().any(|kind| scene.name.starts_with(&format!("raster_{}.", kind.name)) && kind.rules.contains(&scene.settings.rules));
        assert!(found, "{} has no fresh cases", scene.name);
    }
}
