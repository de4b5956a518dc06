//! The per-Gaussian kernels over plain arrays, without a render around them: for the checks against reference numbers.

use super::camera::{CameraConstants, CameraSums};
use super::geometry::{ProjectionGradient, Vec3, project, project_backward, rotation, rotation_backward};
use super::project::{Stage, WIDEST};
use super::{RasterSettings, sh};
use crate::cpu::simd::{Lanes, dispatch, each};
use pulp::{Simd, WithSimd};

/// Columns `from` of `width` numbers each, for Gaussians `start..start + here`; lanes beyond repeat the last.
#[inline(always)]
fn columns<S: Simd, const WIDTH: usize>(simd: S, from: &[f32], start: usize, here: usize) -> [Lanes<S>; WIDTH] {
    let mut stage: Stage<WIDTH> = [[0.0; WIDEST]; WIDTH];
    for lane in 0..S::F32_LANES {
        let i = start + lane.min(here - 1);
        for k in 0..WIDTH {
            stage[k][lane] = from[i * WIDTH + k];
        }
    }
    each(
        #[inline(always)]
        |k| Lanes::load(simd, &stage[k]),
    )
}

/// Writes `values` to rows `start..start + here` of `to`.
#[inline(always)]
fn write<S: Simd, const WIDTH: usize>(values: &[Lanes<S>; WIDTH], to: &mut [f32], start: usize, here: usize) {
    let mut row = [0.0f32; WIDEST];
    for k in 0..WIDTH {
        values[k].store(&mut row);
        for lane in 0..here {
            to[(start + lane) * WIDTH + k] = row[lane];
        }
    }
}

/// Value and gradients of spherical harmonics (no offset, no clamp).
pub struct Harmonics {
    /// Basis values `[N,(degree+1)^2]`.
    pub basis: Vec<f32>,
    /// Sum over coefficients `[N,3]`.
    pub value: Vec<f32>,
    /// Gradient of the directions `[N,3]`.
    pub directions: Vec<f32>,
}

/// Spherical harmonics of `degree` at `directions` `[N,3]` (any length) with `coefficients` `[N,(degree+1)^2,3]`; `upstream` `[N,3]` weighs the value.
pub fn harmonics(degree: usize, directions: &[f32], coefficients: &[f32], upstream: &[f32]) -> Harmonics {
    struct Kernel<'a>(usize, &'a [f32], &'a [f32], &'a [f32]);
    impl WithSimd for Kernel<'_> {
        type Output = Harmonics;
        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> Harmonics {
            let Self(degree, directions, coefficients, upstream) = self;
            let n = directions.len() / 3;
            let count = (degree + 1) * (degree + 1);
            let mut out = Harmonics { basis: vec![0.0; n * count], value: vec![0.0; 3 * n], directions: vec![0.0; 3 * n] };
            let zero = Lanes::splat(simd, 0.0);
            for start in (0..n).step_by(S::F32_LANES) {
                let here = S::F32_LANES.min(n - start);
                let raw: Vec3<S> = columns(simd, directions, start, here);
                let weights: Vec3<S> = columns(simd, upstream, start, here);
                let inverse = Lanes::splat(simd, 1.0) / raw[0].fma(raw[0], raw[1].fma(raw[1], raw[2] * raw[2])).sqrt();
                let direction = raw.map(|v| v * inverse);
                let mut basis = [zero; sh::MAX_BASIS];
                sh::basis(degree, direction, &mut basis);
                let mut shown = [zero; sh::MAX_BASIS];
                let mut value = [zero; 3];
                for k in 0..count {
                    for c in 0..3 {
                        let mut column = [0.0f32; WIDEST];
                        for lane in 0..S::F32_LANES {
                            column[lane] = coefficients[((start + lane.min(here - 1)) * count + k) * 3 + c];
                        }
                        let coefficient = Lanes::load(simd, &column);
                        value[c] = basis[k].fma(coefficient, value[c]);
                        shown[k] = coefficient.fma(weights[c], shown[k]);
                    }
                    let mut column = [0.0f32; WIDEST];
                    basis[k].store(&mut column);
                    for lane in 0..here {
                        out.basis[(start + lane) * count + k] = column[lane];
                    }
                }
                write(&value, &mut out.value, start, here);
                let d = sh::normalize_backward(direction, inverse, sh::basis_backward(degree, direction, &shown));
                write(&d, &mut out.directions, start, here);
            }
            out
        }
    }
    dispatch(Kernel(degree, directions, coefficients, upstream))
}

/// Rotation matrices `[N,9]` of raw quaternions `[N,4]`, and the gradient of the quaternions for `upstream` `[N,9]`.
pub fn rotations(quaternions: &[f32], upstream: &[f32]) -> (Vec<f32>, Vec<f32>) {
    struct Kernel<'a>(&'a [f32], &'a [f32]);
    impl WithSimd for Kernel<'_> {
        type Output = (Vec<f32>, Vec<f32>);
        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
            let n = self.0.len() / 4;
            let mut out = (vec![0.0; 9 * n], vec![0.0; 4 * n]);
            for start in (0..n).step_by(S::F32_LANES) {
                let here = S::F32_LANES.min(n - start);
                let raw: [Lanes<S>; 4] = columns(simd, self.0, start, here);
                let inverse = Lanes::splat(simd, 1.0) / raw.iter().fold(Lanes::splat(simd, 0.0), |sum, v| v.fma(*v, sum)).sqrt();
                let unit = raw.map(|v| v * inverse);
                let r = rotation(unit);
                let flat: [Lanes<S>; 9] = each(
                    #[inline(always)]
                    |k| r[k / 3][k % 3],
                );
                write(&flat, &mut out.0, start, here);
                let g: [Lanes<S>; 9] = columns(simd, self.1, start, here);
                let d = rotation_backward(
                    unit,
                    inverse,
                    each(
                        #[inline(always)]
                        |i| {
                            each(
                                #[inline(always)]
                                |j| g[3 * i + j],
                            )
                        },
                    ),
                );
                write(&d, &mut out.1, start, here);
            }
            out
        }
    }
    dispatch(Kernel(quaternions, upstream))
}

/// Projected Gaussians and, for upstream gradients, the gradients of what was projected.
#[derive(Default)]
pub struct Projected {
    /// Centres in pixels `[N,2]`.
    pub centers: Vec<f32>,
    /// (A,B,C) `[N,3]`.
    pub conics: Vec<f32>,
    /// Camera depths `[N]`.
    pub depths: Vec<f32>,
    /// Compensations `[N]`.
    pub compensations: Vec<f32>,
    /// Blurred covariances xx, xy, yy `[N,3]`.
    pub covariances: Vec<f32>,
    /// d loss / d means `[N,3]`.
    pub d_means: Vec<f32>,
    /// d loss / d quaternions `[N,4]`.
    pub d_quaternions: Vec<f32>,
    /// d loss / d scales `[N,3]`.
    pub d_scales: Vec<f32>,
    /// d loss / d world_to_camera, row-major.
    pub d_camera: [f32; 16],
}

/// Upstream gradients of [`projection`]: centres `[N,2]`, conics `[N,3]`, depths `[N]`, compensations `[N]`.
#[derive(Clone, Copy)]
pub struct ProjectionUpstream<'a> {
    /// d loss / d centres `[N,2]`.
    pub centers: &'a [f32],
    /// d loss / d conics `[N,3]`.
    pub conics: &'a [f32],
    /// d loss / d depths `[N]`.
    pub depths: &'a [f32],
    /// d loss / d compensations `[N]`.
    pub compensations: &'a [f32],
}

/// Projects without culling; Gaussians whose upstream gradients are all zero get zero gradients.
pub fn projection(settings: &RasterSettings, means: &[f32], quaternions: &[f32], scales: &[f32], upstream: ProjectionUpstream) -> Projected {
    struct Kernel<'a>(&'a RasterSettings, &'a [f32], &'a [f32], &'a [f32], ProjectionUpstream<'a>);
    impl WithSimd for Kernel<'_> {
        type Output = Projected;
        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> Projected {
            let Self(settings, means, quaternions, scales, upstream) = self;
            let camera = CameraConstants::new(settings);
            let n = means.len() / 3;
            let zeros = |width: usize| vec![0.0f32; n * width];
            let mut out = Projected {
                centers: zeros(2),
                conics: zeros(3),
                depths: zeros(1),
                compensations: zeros(1),
                covariances: zeros(3),
                d_means: zeros(3),
                d_quaternions: zeros(4),
                d_scales: zeros(3),
                d_camera: [0.0; 16],
            };
            let mut sums = CameraSums::default();
            let zero = Lanes::splat(simd, 0.0);
            for start in (0..n).step_by(S::F32_LANES) {
                let here = S::F32_LANES.min(n - start);
                let mean: Vec3<S> = columns(simd, means, start, here);
                let p = project(&camera, mean, columns(simd, quaternions, start, here), columns(simd, scales, start, here));
                write(&p.center, &mut out.centers, start, here);
                let [l1, l2, l3] = p.factors;
                write(&[l1 * l1 * 2.0, l1 * l2 * 2.0, (l2 * l2 + l3 * l3) * 2.0], &mut out.conics, start, here);
                write(&[p.point[2]], &mut out.depths, start, here);
                write(&[p.compensation], &mut out.compensations, start, here);
                write(&p.covariance, &mut out.covariances, start, here);
                let [depth] = columns(simd, upstream.depths, start, here);
                let [compensation] = columns(simd, upstream.compensations, start, here);
                let conic: Vec3<S> = columns(simd, upstream.conics, start, here);
                // Sums of d loss / d sigma times dx^2, dx dy and dy^2 are 2 A, B and 2 C of this gradient.
                let (of_x, of_y) = (conic[0] * 2.0 * l1 + conic[1] * l2, conic[1] * l1 + conic[2] * 2.0 * l2);
                let g = ProjectionGradient {
                    center: columns(simd, upstream.centers, start, here),
                    moments: [l1 * of_x + l2 * of_y, l3 * of_y, conic[2] * 2.0 * l3 * l3],
                    depth,
                    compensation,
                };
                let d = project_backward(&camera, mean, &p, &g);
                let parts = [g.center[0], g.center[1], conic[0], conic[1], conic[2], depth, compensation];
                let idle = parts.iter().fold(zero, |sum, v| v.fma(*v, sum)).equal(zero);
                write(&d.mean.map(|v| idle.select(zero, v)), &mut out.d_means, start, here);
                write(&d.quaternion.map(|v| idle.select(zero, v)), &mut out.d_quaternions, start, here);
                write(&d.scales.map(|v| idle.select(zero, v)), &mut out.d_scales, start, here);
                let lane_sum = |v: Lanes<S>| {
                    let mut row = [0.0f32; WIDEST];
                    idle.select(zero, v).store(&mut row);
                    row[..here].iter().map(|&v| f64::from(v)).sum::<f64>()
                };
                for k in 0..9 {
                    sums.rotation[k] += lane_sum(d.camera_rotation[k / 3][k % 3]);
                }
                for k in 0..3 {
                    sums.translation[k] += lane_sum(d.camera_translation[k]);
                }
            }
            out.d_camera = sums.matrix_gradient(&settings.world_to_camera);
            out
        }
    }
    dispatch(Kernel(settings, means, quaternions, scales, upstream))
}
