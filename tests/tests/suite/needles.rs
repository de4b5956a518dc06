//! Rounding against decisions, on needles: a float32 kernel may lose digits, or decide otherwise than the oracle whether an alpha reaches 1/255 or a pixel has
//! stopped. The oracle knows how near every decision is and how large rounding errors can be, so the two are told apart per pixel. What rounding alone does is
//! what the reference's own formulas lose in float32.

use crate::raster_fixtures::{relative_l2, widen};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::rasterize::RasterSettings;
use cc4dgs_backends::rasterizers::reference::blend::margins;
use cc4dgs_backends::rasterizers::reference::{Precision, ReferenceGradients, ReferenceInput, backward_in, forward_in};
use cc4dgs_backends::rasterizers::tile::TileRasterizer;
use cc4dgs_core::{BLUR, Camera, ParameterSpace, Rasterizer, RenderSettings, Rules, Seed, SplatColors, Splats};
use cc4dgs_tests::devices;

const SIZE: [usize; 2] = [64, 48];
const COUNT: usize = 60;
/// Relative distance of a decision from its threshold at which the golden files leave a pixel out.
const ROBUST: f64 = 1e-4;
/// Distance in roundings at which a decision cannot fall the other way.
const CERTAIN: f64 = 4.0;
/// Fresh cases.
const SEEDS: u64 = 8;

/// Needles and discs of a ratio of 1e4 like those of the golden scene `d_needles`.
struct Needles {
    means: Vec<f32>,
    scales: Vec<f32>,
    quaternions: Vec<f32>,
    opacities: Vec<f32>,
    colors: Vec<f32>,
    sh_rest: Vec<f32>,
    settings: RasterSettings,
    upstream: Vec<f64>,
}

fn needles(seed: Seed, blur: f64) -> Needles {
    let numbers = |name: &str, len: usize| -> Vec<f64> {
        let child = seed.child(name);
        (0..len as u64).map(|k| (child.index(k).value() >> 11) as f64 / (1u64 << 53) as f64).collect()
    };
    let narrow = |values: Vec<f64>| values.into_iter().map(|v| v as f32).collect::<Vec<f32>>();
    // The sum of twelve uniform numbers, minus six, is nearly standard normal.
    let normal = |name: &str, len: usize| -> Vec<f64> { numbers(name, 12 * len).chunks(12).map(|c| c.iter().sum::<f64>() - 6.0).collect() };
    let kinds = numbers("kinds", 2 * COUNT);
    let scales = (0..COUNT).flat_map(|i| {
        let (long, disc) = (0.3 + 1.2 * kinds[2 * i], i % 2 == 0);
        (0..3).map(move |axis| if (axis == i / 2 % 3) == disc { 1e-4 * long } else { long })
    });
    let turn = normal("camera", 4);
    let norm = turn.iter().map(|v| v * v).sum::<f64>().sqrt();
    let [w, x, y, z] = std::array::from_fn(|k| (if k == 0 { 4.0 } else { 0.5 } * turn[k].abs().max(0.2)) / norm.max(1.0));
    let unit = (w * w + x * x + y * y + z * z).sqrt();
    let [w, x, y, z] = [w, x, y, z].map(|v| v / unit);
    let world_to_camera = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y), 0.0],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x), 0.0],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y), 4.0],
        [0.0, 0.0, 0.0, 1.0],
    ];
    let settings = RasterSettings {
        width: SIZE[0],
        height: SIZE[1],
        fx: 60.0,
        fy: 60.0,
        cx: SIZE[0] as f64 / 2.0,
        cy: SIZE[1] as f64 / 2.0,
        world_to_camera: world_to_camera.map(|row| row.map(|v| f64::from(v as f32))),
        rules: Rules::Gsplat099,
        near: None,
        antialiased: false,
        blur,
        space: ParameterSpace::Activated,
        sh_degree: Some(1),
        max_weights: false,
        absolute_centers: false,
        pair_capacity: None,
        shortcuts: Default::default(),
    };
    let pixels = SIZE[0] * SIZE[1];
    let mut upstream = normal("upstream", 4 * pixels);
    upstream.extend(vec![0.0; pixels]);
    Needles {
        means: narrow(numbers("means", 3 * COUNT).into_iter().map(|v| 2.0 * v - 1.0).collect()),
        scales: narrow(scales.collect()),
        quaternions: narrow(numbers("quaternions", 4 * COUNT).into_iter().map(|v| 2.0 * v - 1.0).collect()),
        opacities: narrow(numbers("opacities", COUNT).into_iter().map(|v| 0.3 + 0.68 * v).collect()),
        colors: narrow(normal("colors", 3 * COUNT)),
        sh_rest: narrow(normal("harmonics", 9 * COUNT).into_iter().map(|v| 0.4 * v).collect()),
        settings,
        upstream: upstream.into_iter().map(|v| f64::from(v as f32)).collect(),
    }
}

impl Needles {
    fn input(&self) -> ReferenceInput {
        let [means, scales, quaternions, opacities, colors, sh_rest] =
            [&self.means, &self.scales, &self.quaternions, &self.opacities, &self.colors, &self.sh_rest].map(|v| widen(v));
        ReferenceInput { means, scales, quaternions, opacities, colors, sh_rest, background: [0.0; 3] }
    }
    /// The upstream gradient without the pixels that `keeps` refuses.
    fn masked(&self, keeps: impl Fn(usize) -> bool) -> Vec<f64> {
        let pixels = SIZE[0] * SIZE[1];
        self.upstream.iter().enumerate().map(|(k, v)| if keeps(k % pixels) { *v } else { 0.0 }).collect()
    }
    /// Gradients of centres, scales, quaternions and opacities.
    fn reference(&self, precision: Precision, upstream: &[f64]) -> [Vec<f64>; 4] {
        let input = self.input();
        let out = forward_in(precision, &input, &self.settings);
        let ReferenceGradients { means, scales, quaternions, opacities, .. } = backward_in(precision, &input, &self.settings, &out.items, upstream);
        [means, scales, quaternions, opacities]
    }
    /// The same of the tile rasterizer.
    fn tiles(&self, device: &Device, upstream: &[f64]) -> [Vec<f64>; 4] {
        let device = device.clone().autodiff();
        let two = |values: &[f32], width: usize| Tensor::<2>::from_data(TensorData::new(values.to_vec(), [COUNT, width]), &device).require_grad();
        let (means, scales, quaternions) = (two(&self.means, 3), two(&self.scales, 3), two(&self.quaternions, 4));
        let opacities = Tensor::<1>::from_data(TensorData::new(self.opacities.clone(), [COUNT]), &device).require_grad();
        let rest = Tensor::<3>::from_data(TensorData::new(self.sh_rest.clone(), [COUNT, 3, 3]), &device);
        let splats = Splats {
            means: means.clone(),
            scales: scales.clone(),
            quaternions: quaternions.clone(),
            opacities: opacities.clone(),
            colors: SplatColors::Sh { dc: two(&self.colors, 3), rest, degree: 1 },
            space: ParameterSpace::Activated,
            screen_probe: None,
            absolute_screen_probe: None,
            camera_probe: None,
        };
        let s = &self.settings;
        let (width, height) = (s.width as u32, s.height as u32);
        let camera = Camera { name: "needles".into(), width, height, fx: s.fx, fy: s.fy, cx: s.cx, cy: s.cy, world_to_camera: s.world_to_camera };
        let render = RenderSettings { rules: s.rules, blur: s.blur, ..Default::default() };
        let planes = TileRasterizer.render(&splats, &camera, &render).unwrap().planes;
        let upstream: Vec<f32> = upstream.iter().map(|v| *v as f32).collect();
        let grads = (planes * Tensor::<3>::from_data(TensorData::new(upstream, [5, s.height, s.width]), &device)).sum().backward();
        let list = |data: TensorData| widen(&data.try_to_vec::<f32>().unwrap());
        [
            list(means.grad(&grads).unwrap().into_data()),
            list(scales.grad(&grads).unwrap().into_data()),
            list(quaternions.grad(&grads).unwrap().into_data()),
            list(opacities.grad(&grads).unwrap().into_data()),
        ]
    }
}

#[test]
fn fresh_needles_lose_no_more_digits_than_the_reference_in_float32() {
    let devices = devices();
    let mut findings = Vec::new();
    for seed in 0..SEEDS {
        // Both the blur of 3D Gaussian splatting and the one that plans choose.
        let case = needles(Seed::root(41).child("needles").index(seed), if seed % 2 == 0 { BLUR } else { 0.1 });
        let out = forward_in(Precision::Float64, &case.input(), &case.settings);
        let margins = margins(&out.items, &case.settings);
        let uncertain = margins.iter().filter(|m| m.relative <= ROBUST || m.roundings <= CERTAIN).count();
        assert!(uncertain * 50 < margins.len(), "seed {seed}: {uncertain} pixels are left out");
        let upstream = case.masked(|pixel| margins[pixel].relative > ROBUST && margins[pixel].roundings > CERTAIN);
        let exact = case.reference(Precision::Float64, &upstream);
        let rounded = case.reference(Precision::Float32, &upstream);
        for (name, device) in &devices {
            let found = case.tiles(device, &upstream);
            for (k, attribute) in ["means", "scales", "quaternions", "opacities"].into_iter().enumerate() {
                let (error, noise) = (relative_l2(&found[k], &exact[k]), relative_l2(&rounded[k], &exact[k]));
                // NaN is out of every tolerance.
                if error.is_nan() || error > 10.0 * noise.max(1e-6) {
                    findings.push(format!("seed {seed}, {name}, {attribute}: {error:.1e}, the reference in float32 {noise:.1e}"));
                }
            }
        }
    }
    assert!(findings.is_empty(), "{}", findings.join("\n"));
}
