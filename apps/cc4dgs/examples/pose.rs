//! Refines a camera's pose by gradient descent: the rasterizer's `camera_probe` receives d loss / d world_to_camera.
//!
//! `cargo run --release --example pose -- [MODEL]`. Without a model, one is trained on the smallest built-in scene.
#![allow(clippy::print_stdout, reason = "its output is what it is for")]

use cc4dgs::core::burn::tensor::Tensor;
use cc4dgs::core::gaussians::to_vec;
use cc4dgs::core::{Gaussians, RenderSettings, Splats};
use cc4dgs::{Camera, Error, Orbit, Result, Session};

type Matrix = [[f64; 4]; 4];

/// The rigid motion by the small rotation `twist[..3]` (radians) and the translation `twist[3..]`, applied after `pose`; orthonormal to second order.
fn moved(pose: &Matrix, twist: &[f64; 6]) -> Matrix {
    let angle = twist[..3].iter().map(|v| v * v).sum::<f64>().sqrt().max(1e-12);
    let axis: [f64; 3] = std::array::from_fn(|k| twist[k] / angle);
    let (s, c) = angle.sin_cos();
    // Rodrigues: c I + (1 - c) a a^T + s [a]x.
    let cross = |r: usize, k: usize| if r == k { 0.0 } else { axis[3 - r - k] * if (r + 1) % 3 == k { -1.0 } else { 1.0 } };
    let rotation = |r: usize, k: usize| (1.0 - c) * axis[r] * axis[k] + s * cross(r, k) + if r == k { c } else { 0.0 };
    let mut out = *pose;
    for (r, k) in (0..12).map(|i| (i / 4, i % 4)) {
        out[r][k] = (0..3).map(|j| rotation(r, j) * pose[j][k]).sum::<f64>() + if k == 3 { twist[3 + r] } else { 0.0 };
    }
    out
}

/// d loss / d twist from d loss / d pose: a rotation about axis a moves rows a+1 and a+2 into each other, a translation moves the last column.
fn twist_gradient(pose: &Matrix, gradient: &[f32]) -> [f64; 6] {
    let dot = |a: usize, b: usize| (0..4).map(|k| f64::from(gradient[4 * a + k]) * pose[b][k]).sum::<f64>();
    let rotation = |axis: usize| dot((axis + 2) % 3, (axis + 1) % 3) - dot((axis + 1) % 3, (axis + 2) % 3);
    std::array::from_fn(|i| if i < 3 { rotation(i) } else { f64::from(gradient[4 * (i - 3) + 3]) })
}

fn main() -> Result<()> {
    let session = Session::new()?;
    let model = match std::env::args().nth(1) {
        Some(path) => session.open(path)?,
        None => {
            let config = session.config("demo", &["train.iterations=300"])?;
            session.train(&config, session.read_scene("procedural:tiny", &config.scene)?, None)?
        }
    };
    let device = session.device().clone().autodiff();
    let rasterizer = session.registry().build_rasterizer(&model.rasterizer)?;
    let gaussians = Gaussians::from_host(&model.gaussians, &device);
    let look = |camera: &Camera, probe: Option<Tensor<2>>| -> Result<Tensor<3>> {
        let splats = Splats { camera_probe: probe, ..Splats::from_gaussians(&gaussians, gaussians.sh_degree) };
        Ok(rasterizer.render(&splats, camera, &RenderSettings::default())?.image())
    };

    let truth = Orbit { size: (160, 120), ..Orbit::default() }.around(&model.gaussians)?.remove(0);
    let target = look(&truth, None)?.detach();
    let mut camera = Camera { world_to_camera: moved(&truth.world_to_camera, &[0.02, -0.03, 0.02, 0.05, -0.04, 0.08]), ..truth.clone() };
    let distance = |camera: &Camera| camera.center_world().iter().zip(truth.center_world()).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
    let start = distance(&camera);
    println!("start: the camera is {start:.4} world units from the truth");
    // Adam on the six numbers of the motion.
    let (mut first, mut second) = ([0.0; 6], [0.0; 6]);
    for step in 1..=120 {
        let probe = Tensor::<2>::zeros([4, 4], &device).require_grad();
        let loss = (look(&camera, Some(probe.clone()))? - target.clone()).powi_scalar(2).mean();
        let gradients = loss.clone().backward();
        let Some(gradient) = probe.grad(&gradients) else { break };
        let gradient = twist_gradient(&camera.world_to_camera, &to_vec(gradient, "camera gradient")?);
        let rate = 4e-3 * (1.0 - f64::from(step) / 130.0);
        let twist = std::array::from_fn(|i| {
            first[i] = 0.8 * first[i] + 0.2 * gradient[i];
            second[i] = 0.95 * second[i] + 0.05 * gradient[i] * gradient[i];
            let (m, v): (f64, f64) = (first[i] / (1.0 - 0.8f64.powi(step)), second[i] / (1.0 - 0.95f64.powi(step)));
            -rate * m / (v.sqrt() + 1e-12)
        });
        camera.world_to_camera = moved(&camera.world_to_camera, &twist);
        if step % 40 == 0 {
            println!("step {step}: loss {:.2e}, {:.4} world units", loss.into_scalar::<f32>(), distance(&camera));
        }
    }
    let found = distance(&camera) < 0.3 * start;
    if found { Ok(()) } else { Err(Error::backend("camera pose", "it was not found", "Start nearer to the truth")) }
}
