//! The conformance suite of rasterizers.

mod probes;

use super::{guarded, settings_are_defaults, uniform};
use crate::gaussians::to_vec;
use crate::{Camera, Gaussians, HostGaussians, Rasterizer, RasterizerPlugin, RenderOutput, RenderSettings, Result, Seed, Splats};
use burn::tensor::{Device, Tensor, TensorData};

/// Image size of the suite.
const SIZE: (u32, u32) = (37, 25);
/// Gaussians of the suite.
const COUNT: usize = 30;
/// Largest relative difference between a finite difference along the gradient and the gradient's norm.
const SLOPE_TOLERANCE: f64 = 0.05;

/// Tests a rasterizer on `device`. Each finding is a line; an empty list means that it passed.
///
/// - Its schema is TOML and states the defaults; unknown settings are refused by name; nothing panics.
/// - Without Gaussians, the image is the background.
/// - At the centre of a Gaussian in the middle of the image, the image has its colour and opacity.
/// - Gaussians behind the camera, and those that are not finite, are not drawn; their radius is 0.
/// - Planes have their shapes, alpha lies in 0..1, and two renders are equal bit for bit. Largest weights, if requested, lie in 0..1.
/// - Gradients agree with finite differences: of every attribute, of projected centres (signed, and absolute per pixel), and of the camera's pose.
pub fn rasterizer(plugin: &RasterizerPlugin, settings: &toml::Table, device: &Device) -> Vec<String> {
    let name = plugin.info.name;
    let rasterizer = match (plugin.build)(settings) {
        Ok(rasterizer) => rasterizer,
        Err(e) => return vec![format!("{name}: it cannot be built: {e}")],
    };
    let suite = Suite { rasterizer: rasterizer.as_ref(), device };
    let drawn = |settings: &toml::Table| Suite { rasterizer: (plugin.build)(settings)?.as_ref(), device }.planes(&cloud(COUNT));
    guarded(
        &format!("{name} on {device:?}"),
        vec![
            ("settings", Box::new(|| settings_are_defaults("rasterizer", &plugin.info, settings, drawn))),
            ("background", Box::new(|| suite.nothing_is_background())),
            ("one Gaussian", Box::new(|| suite.one_gaussian_is_itself())),
            ("odd Gaussians", Box::new(|| suite.odd_gaussians_are_left_out())),
            ("planes", Box::new(|| suite.planes_are_sound())),
            ("gradients", Box::new(|| suite.gradients_are_slopes())),
            ("screen probes", Box::new(|| suite.screen_probes_are_slopes())),
            ("camera probe", Box::new(|| suite.camera_probe_is_a_slope())),
        ],
    )
}

struct Suite<'a> {
    rasterizer: &'a dyn Rasterizer,
    device: &'a Device,
}

/// Whether one of the finite differences along a gradient agrees with the gradient's norm.
fn agrees(slopes: &[f64], norm: f64) -> bool {
    slopes.iter().any(|slope| (slope / norm - 1.0).abs() <= SLOPE_TOLERANCE)
}

fn camera() -> Camera {
    Camera::look_at("conformance", SIZE, 0.9, [0.0, 0.0, -4.0], [0.0; 3], [0.0, -1.0, 0.0])
}

/// Faint, round Gaussians in view, so that no value is at a threshold.
fn cloud(count: usize) -> HostGaussians {
    let seed = Seed::root(31);
    let mut g = HostGaussians { sh_degree: 1, ..Default::default() };
    for i in 0..count {
        let draw = |k: usize| uniform(seed.index(i as u64), k);
        g.means.extend([1.2 * draw(0), 0.8 * draw(1), draw(2)]);
        g.log_scales.extend([-1.2 + 0.3 * draw(3), -1.2 + 0.3 * draw(4), -1.2 + 0.3 * draw(5)]);
        g.quaternions.extend([1.0 + 0.3 * draw(6), draw(7), draw(8), draw(9)]);
        g.opacity_logits.push(-1.5 + 0.5 * draw(10));
        g.sh_dc.extend([0.5 + draw(11), 0.5 + draw(12), 0.5 + draw(13)]);
        g.sh_rest.extend((0..9).map(|c| 0.1 * draw(14 + c)));
        g.dynamic_scores.push(0.0);
    }
    g
}

impl Suite<'_> {
    fn draw(&self, host: &HostGaussians, camera: &Camera, settings: &RenderSettings) -> Result<RenderOutput> {
        let g = Gaussians::from_host(host, self.device);
        self.rasterizer.render(&Splats::from_gaussians(&g, g.sh_degree), camera, settings)
    }
    fn planes(&self, host: &HostGaussians) -> Result<Vec<f32>> {
        to_vec(self.draw(host, &camera(), &RenderSettings::default())?.planes, "planes")
    }
    fn nothing_is_background(&self) -> Result<Option<String>> {
        let colour = [0.25f32, 0.5, 1.0];
        let background = Some(Tensor::<1>::from_data(TensorData::new(colour.to_vec(), [3]), self.device));
        let empty = HostGaussians { sh_degree: 1, ..Default::default() };
        let planes = to_vec(self.draw(&empty, &camera(), &RenderSettings { background, ..Default::default() })?.planes, "planes")?;
        let pixels = (SIZE.0 * SIZE.1) as usize;
        let wrong = colour.into_iter().chain([0.0, 0.0]).enumerate().find(|(k, v)| planes[k * pixels..(k + 1) * pixels].iter().any(|p| p != v));
        Ok(wrong.map(|(k, v)| format!("plane {k} is not {v} everywhere")))
    }
    fn one_gaussian_is_itself(&self) -> Result<Option<String>> {
        let mut g = cloud(1);
        g.means = vec![0.0; 3];
        g.opacity_logits = vec![0.4];
        g.sh_rest.fill(0.0);
        let planes = self.planes(&g)?;
        // The numbers of rows and columns are odd, so the principal point is the centre of a pixel.
        let (width, height) = (SIZE.0 as usize, SIZE.1 as usize);
        let (middle, pixels) = (height / 2 * width + width / 2, width * height);
        let opacity = 1.0 / (1.0 + (-0.4f32).exp());
        for (k, dc) in g.sh_dc.iter().enumerate() {
            let wanted = opacity * (0.282_094_79 * dc + 0.5).max(0.0);
            let found = planes[k * pixels + middle];
            if (wanted - found).abs() > 2e-3 || !found.is_finite() {
                return Ok(Some(format!("channel {k} in the middle is {found}, expected {wanted}")));
            }
        }
        let (alpha, depth) = (planes[3 * pixels + middle], planes[4 * pixels + middle]);
        let right = (alpha - opacity).abs() < 2e-3 && (depth - 4.0 * opacity).abs() < 1e-2;
        Ok((!right).then(|| format!("alpha {alpha} and depth {depth} in the middle, expected {opacity} and {}", 4.0 * opacity)))
    }
    fn odd_gaussians_are_left_out(&self) -> Result<Option<String>> {
        let clean = cloud(4);
        let truth = self.planes(&clean)?;
        for (what, column, value) in [
            ("behind the camera", 0, -50.0),
            ("at infinity", 0, f32::INFINITY),
            ("not a number", 0, f32::NAN),
            ("of no opacity", 3, f32::NAN),
            ("whose opacity logit is infinite", 3, f32::INFINITY),
            ("whose logarithm of a scale is infinite", 1, f32::NEG_INFINITY),
        ] {
            let mut odd = cloud(5);
            if let Some((_, width, values)) = odd.columns_mut().into_iter().nth(column) {
                values[5 * width - 1] = value;
            }
            let output = self.draw(&odd, &camera(), &RenderSettings::default())?;
            let found = to_vec(output.planes, "planes")?;
            if found != truth {
                return Ok(Some(format!("a Gaussian {what} changes the image")));
            }
            let radii: Vec<i64> = output.stats.radii.into_data().iter::<i64>().collect();
            if radii.len() != 5 || radii[4] != 0 || radii[..4].contains(&0) {
                return Ok(Some(format!("radii are {radii:?} with the last Gaussian {what}")));
            }
        }
        Ok(None)
    }
    fn planes_are_sound(&self) -> Result<Option<String>> {
        let output = self.draw(&cloud(COUNT), &camera(), &RenderSettings { max_weights: true, ..Default::default() })?;
        if output.planes.dims() != [5, SIZE.1 as usize, SIZE.0 as usize] {
            return Ok(Some(format!("planes have shape {:?}", output.planes.dims())));
        }
        let weights = output.stats.max_weights.map(|w| to_vec(w, "weights")).transpose()?.unwrap_or_default();
        if weights.len() != COUNT || weights.iter().any(|w| !(0.0..=1.0).contains(w)) || weights.iter().all(|w| *w == 0.0) {
            return Ok(Some("largest weights are missing or outside 0..1".into()));
        }
        let planes = to_vec(output.planes, "planes")?;
        let pixels = (SIZE.0 * SIZE.1) as usize;
        if !planes.iter().all(|v| v.is_finite()) || planes[3 * pixels..4 * pixels].iter().any(|a| !(0.0..=1.0).contains(a)) {
            return Ok(Some("a plane is not finite, or alpha outside 0..1".into()));
        }
        Ok((self.planes(&cloud(COUNT))? != planes).then(|| "two renders of the same Gaussians differ".into()))
    }
    fn gradients_are_slopes(&self) -> Result<Option<String>> {
        let pixels = (SIZE.0 * SIZE.1) as usize;
        let host = cloud(COUNT);
        let upstream: Vec<f32> = (0..5 * pixels).map(|k| uniform(Seed::root(5), k)).collect();
        let loss = |host: &HostGaussians| -> Result<f64> { Ok(self.planes(host)?.iter().zip(&upstream).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()) };
        let tracked = self.device.clone().autodiff();
        let mut g = Gaussians::from_host(&host, &tracked);
        g.means = g.means.require_grad();
        g.log_scales = g.log_scales.require_grad();
        g.quaternions = g.quaternions.require_grad();
        g.opacity_logits = g.opacity_logits.require_grad();
        g.sh_dc = g.sh_dc.require_grad();
        g.sh_rest = g.sh_rest.require_grad();
        let output = self.rasterizer.render(&Splats::from_gaussians(&g, 1), &camera(), &RenderSettings::default())?;
        let weights = Tensor::<3>::from_data(TensorData::new(upstream.clone(), [5, SIZE.1 as usize, SIZE.0 as usize]), &tracked);
        let gradients = (output.planes * weights).sum().backward();
        let flat = [
            g.means.grad(&gradients).map(|t| to_vec(t, "gradient")),
            g.log_scales.grad(&gradients).map(|t| to_vec(t, "gradient")),
            g.quaternions.grad(&gradients).map(|t| to_vec(t, "gradient")),
            g.opacity_logits.grad(&gradients).map(|t| to_vec(t, "gradient")),
            g.sh_dc.grad(&gradients).map(|t| to_vec(t, "gradient")),
            g.sh_rest.grad(&gradients).map(|t| to_vec(t, "gradient")),
        ];
        for (column, gradient) in flat.into_iter().enumerate() {
            let name = host.columns()[column].0;
            let Some(gradient) = gradient.transpose()? else { return Ok(Some(format!("no gradient reaches {name}"))) };
            let norm = gradient.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
            if !norm.is_finite() || norm == 0.0 {
                return Ok(Some(format!("the gradient of {name} has norm {norm}")));
            }
            let mut slopes = Vec::new();
            // Short steps may be below the rounding error, long ones may cross a threshold.
            for step in [3e-4, 1e-3, 3e-3] {
                let mut ends = [0.0; 2];
                for (end, sign) in ends.iter_mut().zip([1.0, -1.0]) {
                    let mut moved = host.clone();
                    if let Some((_, _, values)) = moved.columns_mut().into_iter().nth(column) {
                        values.iter_mut().zip(&gradient).for_each(|(v, d)| *v += (sign * step * f64::from(*d) / norm) as f32);
                    }
                    *end = loss(&moved)?;
                }
                slopes.push((ends[0] - ends[1]) / (2.0 * step));
            }
            if !agrees(&slopes, norm) {
                return Ok(Some(format!("{name}: the loss rises by {slopes:.5?} per unit along its gradient of norm {norm:.5}")));
            }
        }
        Ok(None)
    }
}
