//! Spherical harmonics, rotations, covariances and projection compared with golden values: the SIMD kernels in float32, the reference in float64.

use crate::raster_fixtures::{Fixture, largest_difference, narrow, relative_l2, settings, widen};
use cc4dgs_backends::cpu::raster::check::{ProjectionUpstream, harmonics, projection, rotations};
use cc4dgs_backends::rasterizers::reference::gaussian::{Gaussian, covariance, project};
use cc4dgs_backends::rasterizers::reference::harmonics::basis;
use cc4dgs_backends::rasterizers::reference::real::{Dual, Real};

/// Degrees of harmonics that a fixture has.
fn degrees(fixture: &Fixture) -> std::ops::Range<usize> {
    0..(0..).find(|degree| !fixture.has(&format!("deg{degree}.in.coeffs"))).unwrap()
}

fn assert_close(what: &str, error: f64, tolerance: f64) {
    assert!(error <= tolerance, "{what}: error {error:.3e} over {tolerance:.0e}");
}

#[test]
fn golden_sh_kernel() {
    let fixture = Fixture::open("sh");
    let (directions, weights) = (fixture.narrow("in.dirs"), fixture.narrow("in.weights"));
    for degree in degrees(&fixture) {
        let key = |name: &str| format!("deg{degree}.{name}");
        let out = harmonics(degree, &directions, &fixture.narrow(&key("in.coeffs")), &weights);
        assert_close(&key("basis"), relative_l2(&widen(&out.basis), &fixture.get(&key("out.basis"))), 1e-6);
        assert_close(&key("value"), relative_l2(&widen(&out.value), &fixture.get(&key("out.value"))), 2e-6);
        assert_close(&key("directions"), relative_l2(&widen(&out.directions), &fixture.get(&key("grad.dirs"))), 2e-6);
        // The value is linear in the coefficients, so their gradient is the basis times the weights.
        let count = (degree + 1) * (degree + 1);
        let product: Vec<f64> = (0..weights.len() * count)
            .map(|k| {
                let (i, j, c) = (k / (3 * count), k / 3 % count, k % 3);
                f64::from(out.basis[i * count + j]) * f64::from(weights[3 * i + c])
            })
            .collect();
        assert_close(&key("coefficients"), relative_l2(&product, &fixture.get(&key("grad.coeffs"))), 1e-6);
    }
}

#[test]
fn golden_sh_reference() {
    let fixture = Fixture::open("sh");
    let (directions, weights) = (fixture.get("in.dirs"), fixture.get("in.weights"));
    for degree in degrees(&fixture) {
        let coefficients = fixture.get(&format!("deg{degree}.in.coeffs"));
        let count = (degree + 1) * (degree + 1);
        let (mut values, mut gradients) = (Vec::new(), Vec::new());
        for (i, d) in directions.chunks_exact(3).enumerate() {
            let d: [Dual<3>; 3] = std::array::from_fn(|k| Dual::variable(d[k], k));
            let length = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
            let mut loss = Dual::constant(0.0);
            for c in 0..3 {
                let terms = basis(degree, d.map(|v| v / length)).into_iter().enumerate();
                let value = terms.fold(Dual::constant(0.0), |sum, (k, b)| sum + b * Dual::constant(coefficients[(i * count + k) * 3 + c]));
                values.push(value.value);
                loss = loss + value * Dual::constant(weights[3 * i + c]);
            }
            gradients.extend(loss.slope);
        }
        assert_close(&format!("degree {degree} value"), largest_difference(&values, &fixture.get(&format!("deg{degree}.out.value"))), 1e-10);
        assert_close(&format!("degree {degree} directions"), relative_l2(&gradients, &fixture.get(&format!("deg{degree}.grad.dirs"))), 1e-10);
    }
}

/// Sigma = R S S R^T per Gaussian from rotation matrices and scales.
fn covariance_of(rotation: &[f64], scales: &[f64]) -> Vec<f64> {
    (0..9).map(|k| (0..3).map(|j| rotation[3 * (k / 3) + j] * rotation[3 * (k % 3) + j] * scales[j] * scales[j]).sum()).collect()
}

#[test]
fn golden_quat_scale_cov_kernel() {
    let fixture = Fixture::open("quat_scale_cov");
    let quaternions = fixture.narrow("in.quats_wxyz");
    let scales = fixture.get("in.scales");
    let n = quaternions.len() / 4;
    let (matrices, _) = rotations(&quaternions, &vec![0.0; 9 * n]);
    let matrices = widen(&matrices);
    assert_close("rotmat", largest_difference(&matrices, &fixture.get("out.rotmat")), 2e-6);
    for (name, power) in [("covar", 1), ("preci", -1)] {
        // The precision is the covariance of the inverse scales.
        let strength: Vec<f64> = scales.iter().map(|s| s.powi(power)).collect();
        let sigma: Vec<f64> = (0..n).flat_map(|i| covariance_of(&matrices[9 * i..9 * i + 9], &strength[3 * i..3 * i + 3])).collect();
        assert_close(name, relative_l2(&sigma, &fixture.get(&format!("out.{name}"))), 2e-6);
        // d Sigma through the rotation: (G + G^T) R S^2; through the scales: 2 s_j r_j^T G r_j.
        let g = fixture.get(&format!("in.weights_{name}"));
        let (mut d_rotation, mut d_scales) = (Vec::new(), Vec::new());
        for i in 0..n {
            let (r, g) = (&matrices[9 * i..9 * i + 9], &g[9 * i..9 * i + 9]);
            let s = &strength[3 * i..3 * i + 3];
            for a in 0..3 {
                for j in 0..3 {
                    d_rotation.push((0..3).map(|b| (g[3 * a + b] + g[3 * b + a]) * r[3 * b + j] * s[j] * s[j]).sum::<f64>());
                }
            }
            for j in 0..3 {
                let along: f64 = (0..9).map(|k| r[3 * (k / 3) + j] * g[k] * r[3 * (k % 3) + j]).sum();
                let inner = 2.0 * s[j] * along;
                d_scales.push(if power == 1 { inner } else { -inner * s[j] * s[j] });
            }
        }
        let (_, d_quaternions) = rotations(&quaternions, &narrow(&d_rotation));
        assert_close(&format!("{name} quats"), relative_l2(&widen(&d_quaternions), &fixture.get(&format!("grad.{name}.quats"))), 1e-5);
        assert_close(&format!("{name} scales"), relative_l2(&d_scales, &fixture.get(&format!("grad.{name}.scales"))), 1e-5);
    }
}

#[test]
fn golden_quat_scale_cov_reference() {
    let fixture = Fixture::open("quat_scale_cov");
    let (quaternions, scales) = (fixture.get("in.quats_wxyz"), fixture.get("in.scales"));
    let n = quaternions.len() / 4;
    for (name, power) in [("covar", 1), ("preci", -1)] {
        let weights = fixture.get(&format!("in.weights_{name}"));
        let (mut values, mut d_quaternions, mut d_scales) = (Vec::new(), Vec::new(), Vec::new());
        for i in 0..n {
            let q: [Dual<7>; 4] = std::array::from_fn(|k| Dual::variable(quaternions[4 * i + k], k));
            let s: [Dual<7>; 3] = std::array::from_fn(|k| Dual::variable(scales[3 * i + k], 4 + k));
            let sigma = covariance(q, s.map(|s| if power == 1 { s } else { Dual::constant(1.0) / s }));
            let mut loss = Dual::constant(0.0);
            for k in 0..9 {
                values.push(sigma[k / 3][k % 3].value);
                loss = loss + sigma[k / 3][k % 3] * Dual::constant(weights[9 * i + k]);
            }
            d_quaternions.extend_from_slice(&loss.slope[..4]);
            d_scales.extend_from_slice(&loss.slope[4..]);
        }
        assert_close(name, relative_l2(&values, &fixture.get(&format!("out.{name}"))), 1e-10);
        assert_close(&format!("{name} quats"), relative_l2(&d_quaternions, &fixture.get(&format!("grad.{name}.quats"))), 1e-10);
        assert_close(&format!("{name} scales"), relative_l2(&d_scales, &fixture.get(&format!("grad.{name}.scales"))), 1e-10);
    }
}

/// The weights of the projection fixture's loss.
#[derive(Clone, Copy, PartialEq)]
enum Loss {
    Centers,
    Conics,
    Compensations,
    All,
}

impl Loss {
    const EACH: [(Self, &'static str); 4] = [(Self::Centers, "means2d"), (Self::Conics, "conics"), (Self::Compensations, "compensations"), (Self::All, "all")];
    fn weighs(self, part: Self) -> bool {
        self == Self::All || self == part
    }
}

/// The projection fixture, with the weights of one camera.
struct Projection {
    fixture: Fixture,
    n: usize,
    cameras: usize,
}

impl Projection {
    fn open() -> Self {
        let fixture = Fixture::open("projection");
        let (n, cameras) = (fixture.shape("in.means")[0], fixture.shape("in.Ks")[0]);
        Self { fixture, n, cameras }
    }
    fn part(&self, key: &str, camera: usize, width: usize) -> Vec<f64> {
        self.fixture.get(key)[camera * self.n * width..(camera + 1) * self.n * width].to_vec()
    }
    fn settings(&self, camera: usize) -> cc4dgs_backends::ops::rasterize::RasterSettings {
        let k = &self.fixture.get("in.Ks")[9 * camera..9 * camera + 9];
        settings(self.fixture.count("W"), self.fixture.count("H"), k, &self.fixture.get("in.viewmats")[16 * camera..16 * camera + 16])
    }
    /// Weights of a loss: centres, conics, depths, compensations.
    fn weights(&self, loss: Loss, camera: usize) -> [Vec<f64>; 4] {
        let valid = self.part("out.valid", camera, 1);
        let get = |name: &str, width: usize, on: bool| {
            let values = self.part(&format!("in.weights.{name}"), camera, width);
            values.iter().enumerate().map(|(k, v)| if on && valid[k / width] > 0.0 { *v } else { 0.0 }).collect::<Vec<f64>>()
        };
        [
            get("means2d", 2, loss.weighs(Loss::Centers)),
            get("conics", 3, loss.weighs(Loss::Conics)),
            get("depths", 1, loss == Loss::All),
            get("compensations", 1, loss.weighs(Loss::Compensations)),
        ]
    }
}

/// Ten times the largest relative L2 error of gradients of a category in the reference's float32 run (projection.json), at least 1e-5.
fn tolerance(noise: &serde_json::Value, loss: &str, array: &str, category: &str) -> Option<f64> {
    let rel = noise[format!("grad.{loss}.{array}[{category}]")]["rel_l2"].as_f64()?;
    // At a relative error above one percent, a float32 comparison is not meaningful.
    (rel < 1e-2).then_some((10.0 * rel).max(1e-5))
}

#[test]
fn golden_projection_kernel() {
    let p = Projection::open();
    let facts = &p.fixture.facts;
    let names: Vec<String> = facts["categories"].as_array().unwrap().iter().map(|v| v.as_str().unwrap().to_string()).collect();
    let category = p.fixture.get("in.category");
    let [means, quaternions, scales] = ["in.means", "in.quats_wxyz", "in.scales"].map(|key| p.fixture.narrow(key));
    let mut compared = 0;
    for (loss, loss_name) in Loss::EACH {
        let mut sums = [vec![0.0; 3 * p.n], vec![0.0; 4 * p.n], vec![0.0; 3 * p.n]];
        for camera in 0..p.cameras {
            let [centers, conics, depths, compensations] = p.weights(loss, camera).map(|w| narrow(&w));
            let upstream = ProjectionUpstream { centers: &centers, conics: &conics, depths: &depths, compensations: &compensations };
            let out = projection(&p.settings(camera), &means, &quaternions, &scales, upstream);
            for (sum, part) in sums.iter_mut().zip([&out.d_means, &out.d_quaternions, &out.d_scales]) {
                sum.iter_mut().zip(part).for_each(|(a, b)| *a += f64::from(*b));
            }
            if loss != Loss::All {
                continue;
            }
            let valid = p.part("out.valid", camera, 1);
            let of = |values: &[f32], width: usize| -> Vec<f64> {
                widen(values).iter().enumerate().map(|(k, v)| if valid[k / width] > 0.0 { *v } else { 0.0 }).collect()
            };
            assert_close("centres", relative_l2(&of(&out.centers, 2), &p.part("out.means2d", camera, 2)), 1e-6);
            assert_close("depths", relative_l2(&of(&out.depths, 1), &p.part("out.depths", camera, 1)), 1e-6);
            // The determinant is computed without cancellation here, so conics and compensations are more accurate than the reference's float32.
            assert_close("conics", relative_l2(&of(&out.conics, 3), &p.part("out.conics", camera, 3)), 1e-4);
            assert_close("compensations", relative_l2(&of(&out.compensations, 1), &p.part("out.compensations", camera, 1)), 1e-3);
            // 3.33 sigma per axis before rounding up.
            let radius: Vec<f64> =
                (0..2 * p.n).map(|k| 3.33 * f64::from(out.covariances[3 * (k / 2) + 2 * (k % 2)]).sqrt() * f64::from(u8::from(valid[k / 2] > 0.0))).collect();
            let golden: Vec<f64> = p.part("out.radius_real", camera, 2).iter().enumerate().map(|(k, v)| if valid[k / 2] > 0.0 { *v } else { 0.0 }).collect();
            assert_close("radii", relative_l2(&radius, &golden), 1e-5);
        }
        for (array, width, sum) in [("means", 3, &sums[0]), ("quats", 4, &sums[1]), ("scales", 3, &sums[2])] {
            let golden = p.fixture.get(&format!("grad.{loss_name}.{array}"));
            for (index, name) in names.iter().enumerate() {
                let Some(limit) = tolerance(&facts["noise_f32"], loss_name, array, name) else { continue };
                let pick =
                    |values: &[f64]| -> Vec<f64> { values.iter().enumerate().filter(|(k, _)| category[k / width] == index as f64).map(|(_, v)| *v).collect() };
                assert_close(&format!("{loss_name}: {array} [{name}]"), relative_l2(&pick(sum), &pick(&golden)), limit);
                compared += 1;
            }
        }
    }
    assert!(compared > 40, "only {compared} gradients compared");
}

#[test]
fn golden_projection_reference() {
    const VARIABLES: usize = 26;
    let p = Projection::open();
    let [means, quaternions, scales] = ["in.means", "in.quats_wxyz", "in.scales"].map(|key| p.fixture.get(key));
    for (loss, loss_name) in Loss::EACH {
        let mut sums = [vec![0.0; 3 * p.n], vec![0.0; 4 * p.n], vec![0.0; 3 * p.n], vec![0.0; 16 * p.cameras]];
        for camera in 0..p.cameras {
            let settings = p.settings(camera);
            let [centers, conics, depths, compensations] = p.weights(loss, camera);
            let valid = p.part("out.valid", camera, 1);
            for i in (0..p.n).filter(|&i| valid[i] > 0.0) {
                let number = Dual::<VARIABLES>::variable;
                let g = Gaussian {
                    mean: std::array::from_fn(|k| number(means[3 * i + k], k)),
                    scales: std::array::from_fn(|k| number(scales[3 * i + k], 3 + k)),
                    quaternion: std::array::from_fn(|k| number(quaternions[4 * i + k], 6 + k)),
                    opacity: Dual::constant(1.0),
                    view: std::array::from_fn(|r| std::array::from_fn(|c| number(settings.world_to_camera[r][c], 10 + 4 * r + c))),
                };
                let out = project(&g, &settings);
                let mut d = [0.0; VARIABLES];
                let parts = [
                    (out.center[0], centers[2 * i]),
                    (out.center[1], centers[2 * i + 1]),
                    (out.conic[0], conics[3 * i]),
                    (out.conic[1], conics[3 * i + 1]),
                    (out.conic[2], conics[3 * i + 2]),
                    (out.depth, depths[i]),
                    (out.compensation, compensations[i]),
                ];
                for (quantity, weight) in parts {
                    (0..VARIABLES).for_each(|v| d[v] += weight * quantity.slope[v]);
                }
                for (array, from, width) in [(0, 0, 3), (2, 3, 3), (1, 6, 4)] {
                    (0..width).for_each(|k| sums[array][width * i + k] += d[from + k]);
                }
                (0..16).for_each(|k| sums[3][16 * camera + k] += d[10 + k]);
            }
        }
        // The compensation of very thin Gaussians loses half of float64's digits to cancellation, in the fixture and here.
        let limit = if loss.weighs(Loss::Compensations) { 1e-6 } else { 1e-8 };
        for (array, sum) in ["means", "quats", "scales", "viewmats"].into_iter().zip(&sums) {
            assert_close(&format!("{loss_name}: {array}"), relative_l2(sum, &p.fixture.get(&format!("grad.{loss_name}.{array}"))), limit);
        }
    }
}
