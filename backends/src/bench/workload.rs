//! What is timed: seeded random points, and scenes from fixture files.

use super::StepCase;
use cc4dgs_core::gaussians::sh_rest_len;
use cc4dgs_core::{Camera, Error, HostGaussians, Result, Seed};
use safetensors::{Dtype, SafeTensors};
use std::path::Path;

/// Half the side of the box of points, world units.
const HALF_BOX: f32 = 2.5;
/// Distance of the camera from the centre of the box, world units.
const CAMERA_DISTANCE: f64 = 7.0;
/// Horizontal angle of view in radians (60 degrees).
const ANGLE_OF_VIEW: f64 = std::f64::consts::FRAC_PI_3;
/// Opacity of every point.
const OPACITY: f32 = 0.1;
/// Spherical-harmonics degree of the random points.
const DEGREE: usize = 3;

/// Gaussians in front of a camera.
#[derive(Clone, Debug)]
pub struct Workload {
    /// For tables.
    pub name: String,
    /// The Gaussians.
    pub gaussians: HostGaussians,
    /// The camera.
    pub camera: Camera,
}

impl Workload {
    /// Random points uniform in a +-2.5 box.
    pub fn random(case: &StepCase, seed: Seed) -> Self {
        Self { name: "random box".into(), gaussians: random_gaussians(case.gaussians, seed.child("gaussians")), camera: step_camera(case) }
    }
    /// The inputs of a golden rasterizer scene: `raster_*.inputs.f64.safetensors`, with `in.*` arrays of activated parameters.
    pub fn from_fixture(path: &Path) -> Result<Self> {
        let object = path.display().to_string();
        let bytes = std::fs::read(path).map_err(|e| Error::io(path, e))?;
        let bad = |problem: String| Error::data(object.clone(), problem, "Give a raster_*.inputs.f64.safetensors of the golden files");
        let file = SafeTensors::deserialize(&bytes).map_err(|e| bad(e.to_string()))?;
        let get = |key: &str| -> Result<(Vec<usize>, Vec<f64>)> {
            let view = file.tensor(key).map_err(|e| bad(format!("{key}: {e}")))?;
            if view.dtype() != Dtype::F64 {
                return Err(bad(format!("{key} is {:?} and not F64", view.dtype())));
            }
            let values = view.data().as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
            Ok((view.shape().to_vec(), values))
        };
        let read = |key: &str, width: usize, n: usize| -> Result<Vec<f64>> {
            let (shape, values) = get(key)?;
            if values.len() == width * n { Ok(values) } else { Err(bad(format!("{key} is {shape:?}, expected {n} rows of {width}"))) }
        };
        let n = get("in.opacities")?.1.len();
        let (image_shape, _) = get("in.weights_image")?;
        let (sh_shape, sh) = get("in.sh")?;
        let (&[height, width, _], &[rows, count, 3]) = (&image_shape[..], &sh_shape[..]) else {
            return Err(bad(format!("in.weights_image is {image_shape:?} and in.sh {sh_shape:?}")));
        };
        let degree = count.isqrt().saturating_sub(1);
        if rows != n || (degree + 1) * (degree + 1) != count || degree > 4 {
            return Err(bad(format!("in.sh is {sh_shape:?} for {n} Gaussians")));
        }
        let (k, view) = (read("in.K", 9, 1)?, read("in.viewmat", 16, 1)?);
        let narrow = |values: Vec<f64>| -> Vec<f32> { values.into_iter().map(|v| v as f32).collect() };
        let gaussians = HostGaussians {
            sh_degree: degree,
            means: narrow(read("in.means", 3, n)?),
            log_scales: narrow(read("in.scales", 3, n)?.into_iter().map(f64::ln).collect()),
            quaternions: narrow(read("in.quats_wxyz", 4, n)?),
            opacity_logits: narrow(
                read("in.opacities", 1, n)?
                    .into_iter()
                    .map(|o| {
                        let o = o.clamp(1e-6, 1.0 - 1e-6);
                        (o / (1.0 - o)).ln()
                    })
                    .collect(),
            ),
            sh_dc: narrow(sh.chunks_exact(3 * count).flat_map(|row| row[..3].to_vec()).collect()),
            sh_rest: narrow(sh.chunks_exact(3 * count).flat_map(|row| row[3..].to_vec()).collect()),
            dynamic_scores: vec![0.0; n],
            extra: Default::default(),
        };
        let camera = Camera {
            name: "fixture".into(),
            width: width as u32,
            height: height as u32,
            fx: k[0],
            fy: k[4],
            cx: k[2],
            cy: k[5],
            world_to_camera: std::array::from_fn(|i| std::array::from_fn(|j| view[4 * i + j])),
        };
        camera.validate()?;
        let name = path.file_name().and_then(|f| f.to_str()).and_then(|f| f.split('.').next()).unwrap_or("fixture").to_string();
        Ok(Self { name, gaussians, camera })
    }
}

/// Uniform numbers in -1..1, the `k`-th of a named stream.
pub(super) fn uniform(seed: Seed, k: u64) -> f32 {
    // 24 bits: every value is exact.
    (seed.index(k).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0
}

/// Random Gaussians in the box; standard deviations are the root of the mean squared distance to three neighbours.
pub fn random_gaussians(count: usize, seed: Seed) -> HostGaussians {
    let stream = |name: &str, len: usize, scale: f32| -> Vec<f32> {
        let seed = seed.child(name);
        (0..len as u64).map(|k| scale * uniform(seed, k)).collect()
    };
    let means = stream("means", 3 * count, HALF_BOX);
    let log_scales = neighbour_distances(&means).into_iter().flat_map(|d| [d.max(1e-4).ln(); 3]).collect();
    HostGaussians {
        sh_degree: DEGREE,
        log_scales,
        quaternions: stream("quaternions", 4 * count, 1.0),
        opacity_logits: vec![(OPACITY / (1.0 - OPACITY)).ln(); count],
        sh_dc: stream("sh_dc", 3 * count, 1.5),
        sh_rest: stream("sh_rest", 3 * sh_rest_len(DEGREE) * count, 0.1),
        dynamic_scores: vec![0.0; count],
        means,
        extra: Default::default(),
    }
}

/// Root of the mean squared distance of every point to its three nearest others, by a grid of about one point per cell.
fn neighbour_distances(means: &[f32]) -> Vec<f32> {
    let n = means.len() / 3;
    let side = ((n as f64).cbrt().ceil() as usize).max(1);
    let cell_size = 2.0 * HALF_BOX / side as f32;
    let cell = |v: f32| (((v + HALF_BOX) / cell_size) as usize).min(side - 1);
    let cell_of = |i: usize| [cell(means[3 * i]), cell(means[3 * i + 1]), cell(means[3 * i + 2])];
    let mut members = vec![Vec::new(); side * side * side];
    for i in 0..n {
        let [x, y, z] = cell_of(i);
        members[(x * side + y) * side + z].push(i);
    }
    let nearest = |i: usize| {
        let home = cell_of(i);
        let mut ring = 1;
        loop {
            let range = |k: usize| home[k].saturating_sub(ring)..(home[k] + ring + 1).min(side);
            let cells = range(0).flat_map(|x| range(1).flat_map(move |y| range(2).map(move |z| (x * side + y) * side + z)));
            let mut squared: Vec<f32> =
                cells.flat_map(|c| &members[c]).filter(|&&j| j != i).map(|&j| (0..3).map(|k| (means[3 * i + k] - means[3 * j + k]).powi(2)).sum()).collect();
            squared.sort_by(f32::total_cmp);
            // All points nearer than the width of the ring have been compared.
            let certain = squared.len() >= 3 && squared[2].sqrt() <= ring as f32 * cell_size;
            if certain || ring >= side {
                let found = squared.len().clamp(1, 3);
                return (squared.iter().take(3).sum::<f32>() / found as f32).sqrt();
            }
            ring += 1;
        }
    };
    (0..n).map(nearest).collect()
}

/// The camera of the cases.
pub fn step_camera(case: &StepCase) -> Camera {
    Camera::look_at("bench", (case.width, case.height), ANGLE_OF_VIEW, [0.0, 0.0, -CAMERA_DISTANCE], [0.0; 3], [0.0, -1.0, 0.0])
}
