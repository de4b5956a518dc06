//! L1 + SSIM with its gradient, on the device. The cross-entropy of the score stage is in [`super::cross_entropy`].
//!
//! Four sweeps over the image: horizontal blur of x, y, x^2, y^2, xy; vertical blur, SSIM and its derivatives; the same two blurs of the derivatives.
//! Sums are taken per workgroup and then by one workgroup, in a fixed order, so that every run gives the same bytes.

use super::tensor::{THREADS, compensated_sum, constant, floats, sum_of_threads, upload, workgroups_for};
use crate::ops::photometric::{MOMENTS, PhotometricKernels, PhotometricOps};
use burn::backend::TensorMetadata;
use burn::backend::tensor::FloatTensor;
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Taps of the window, and those on each side of its centre.
const TAPS: u32 = 11;
const RADIUS: u32 = 5;
/// Constants of SSIM for a data range of 1.
const C1: f32 = 1e-4;
const C2: f32 = 9e-4;
/// Blurred derivatives per channel.
const DERIVATIVES: u32 = 3;

/// Gaussian of sigma 1.5, normalised.
fn window() -> [f32; TAPS as usize] {
    let weight = |i: usize| (-(i as f64 - f64::from(RADIUS)).powi(2) / (2.0 * 1.5 * 1.5)).exp();
    let sum: f64 = (0..TAPS as usize).map(weight).sum();
    std::array::from_fn(|i| (weight(i) / sum) as f32)
}

/// moments `[3,5,H,W]`: x, y, x^2, y^2, xy blurred along rows; zero padding.
#[cube(launch)]
fn blur_moments_in_rows(x: &[f32], y: &[f32], taps: &[f32], moments: &mut [f32], width: u32, pixels: u32) {
    let at = ABSOLUTE_POS as u32;
    if at < 3 * pixels {
        let channel = at / pixels;
        let pixel = at % pixels;
        let column = pixel % width;
        let mut sums = Array::<f32>::new(5usize);
        #[unroll]
        for k in 0..5usize {
            sums[k] = 0.0;
        }
        for tap in 0..TAPS {
            let from = column + tap;
            if from >= RADIUS && from - RADIUS < width {
                let source = (at + tap - RADIUS) as usize;
                let (a, b, w) = (x[source], y[source], taps[tap as usize]);
                sums[0] += w * a;
                sums[1] += w * b;
                sums[2] += w * a * a;
                sums[3] += w * b * b;
                sums[4] += w * a * b;
            }
        }
        #[unroll]
        for k in 0..5usize {
            moments[((channel * MOMENTS + k as u32) * pixels + pixel) as usize] = sums[k];
        }
    }
}

/// Vertical blur of the moments; the terms of the loss per workgroup (l1, ssim, mse); d ssim / d (mean x, mean x^2, mean xy) as derivatives `[3,3,H,W]`.
#[cube(launch)]
fn ssim_and_derivatives(
    x: &[f32],
    y: &[f32],
    taps: &[f32],
    moments: &[f32],
    derivatives: &mut [f32],
    partial: &mut [f32],
    width: u32,
    pixels: u32,
    #[comptime] gradient: bool,
) {
    let mut terms = Shared::<[f32]>::new_slice(3 * THREADS as usize);
    let at = ABSOLUTE_POS as u32;
    let thread = UNIT_POS as usize;
    let mut l1 = 0.0f32;
    let mut ssim = 0.0f32;
    let mut mse = 0.0f32;
    if at < 3 * pixels {
        let channel = at / pixels;
        let pixel = at % pixels;
        let row = pixel / width;
        let height = pixels / width;
        let mut sums = Array::<f32>::new(5usize);
        #[unroll]
        for k in 0..5usize {
            sums[k] = 0.0;
        }
        for tap in 0..TAPS {
            let from = row + tap;
            if from >= RADIUS && from - RADIUS < height {
                let source = pixel + tap * width - RADIUS * width;
                let w = taps[tap as usize];
                #[unroll]
                for k in 0..5usize {
                    sums[k] += w * moments[((channel * MOMENTS + k as u32) * pixels + source) as usize];
                }
            }
        }
        let (mx, my) = (sums[0], sums[1]);
        let (vx, vy, vxy) = (sums[2] - mx * mx, sums[3] - my * my, sums[4] - mx * my);
        let a1 = 2.0 * mx * my + C1;
        let a2 = 2.0 * vxy + C2;
        let b1 = mx * mx + my * my + C1;
        let b2 = vx + vy + C2;
        ssim = a1 * a2 / (b1 * b2);
        let difference = x[at as usize] - y[at as usize];
        l1 = difference.abs();
        mse = difference * difference;
        if comptime!(gradient) {
            // By the quotient rule, the first one includes that the variance depends on the mean.
            let d_vx = -ssim / b2;
            let d_vxy = 2.0 * a1 / (b1 * b2);
            let d_mx = 2.0 * my * a2 / (b1 * b2) - 2.0 * mx * ssim / b1 - 2.0 * mx * d_vx - my * d_vxy;
            let base = (channel * DERIVATIVES * pixels + pixel) as usize;
            derivatives[base] = d_mx;
            derivatives[base + pixels as usize] = d_vx;
            derivatives[base + 2 * pixels as usize] = d_vxy;
        }
    }
    terms[thread] = l1;
    terms[thread + THREADS as usize] = ssim;
    terms[thread + 2 * THREADS as usize] = mse;
    sync_cube();
    if UNIT_POS < 3 {
        let mut sum = 0.0f32;
        for k in 0..THREADS {
            sum += terms[(UNIT_POS * THREADS + k) as usize];
        }
        let slot = CUBE_POS * 3 + thread;
        if slot < partial.len() {
            partial[slot] = sum;
        }
    }
}

/// The sum of one term over all workgroups, with compensation for rounding (Kahan), for the first thread.
#[cube]
fn sum_of_term(partial: &[f32], sums: &mut Shared<[f32]>, term: usize, workgroups: u32) -> f32 {
    let mut sum = 0.0f32;
    let mut lost = 0.0f32;
    let mut k = UNIT_POS as usize;
    while k < workgroups as usize {
        let (next, rest) = compensated_sum(sum, lost, partial[k * 3 + term]);
        sum = next;
        lost = rest;
        k += THREADS as usize;
    }
    sum_of_threads(sums, sum)
}

/// Adds up the terms (l1, ssim, mse) of all workgroups, by one workgroup, and combines them into the loss.
#[cube(launch)]
fn finish_terms(partial: &[f32], loss: &mut [f32], terms: &mut [f32], workgroups: u32, scale: f32, lambda_c: f32) {
    let mut sums = Shared::<[f32]>::new_slice(THREADS as usize);
    let l1 = sum_of_term(partial, &mut sums, 0usize, workgroups) * scale;
    let ssim = sum_of_term(partial, &mut sums, 1usize, workgroups) * scale;
    let mse = sum_of_term(partial, &mut sums, 2usize, workgroups) * scale;
    if UNIT_POS == 0 {
        terms[0] = l1;
        terms[1] = ssim;
        terms[2] = mse;
        loss[0] = lambda_c * l1 + (1.0 - lambda_c) * (1.0 - ssim);
    }
}

/// Horizontal blur of the derivatives `[9,H,W]`.
#[cube(launch)]
fn blur_derivatives_in_rows(from: &[f32], taps: &[f32], to: &mut [f32], width: u32) {
    let at = ABSOLUTE_POS as u32;
    if (at as usize) < to.len() {
        let column = at % width;
        let mut sum = 0.0f32;
        for tap in 0..TAPS {
            let source = column + tap;
            if source >= RADIUS && source - RADIUS < width {
                sum += taps[tap as usize] * from[(at + tap - RADIUS) as usize];
            }
        }
        to[at as usize] = sum;
    }
}

/// Vertical blur of the derivatives and the gradient of the loss `[C,H,W]`; planes beyond the third get 0.
#[cube(launch)]
fn gradient_of_planes(x: &[f32], y: &[f32], taps: &[f32], derivatives: &[f32], grad: &mut [f32], width: u32, pixels: u32, l1_scale: f32, ssim_scale: f32) {
    let at = ABSOLUTE_POS as u32;
    if (at as usize) < grad.len() {
        let mut out = 0.0f32;
        if at < 3 * pixels {
            let channel = at / pixels;
            let pixel = at % pixels;
            let row = pixel / width;
            let height = pixels / width;
            let mut d_mean = 0.0f32;
            let mut d_square = 0.0f32;
            let mut d_product = 0.0f32;
            for tap in 0..TAPS {
                let from = row + tap;
                if from >= RADIUS && from - RADIUS < height {
                    let w = taps[tap as usize];
                    let source = (channel * DERIVATIVES * pixels + pixel + tap * width - RADIUS * width) as usize;
                    d_mean += w * derivatives[source];
                    d_square += w * derivatives[source + pixels as usize];
                    d_product += w * derivatives[source + 2 * pixels as usize];
                }
            }
            let (a, b) = (x[at as usize], y[at as usize]);
            // The derivative of |0| is 0.
            let sign = select(a > b, 1.0f32, select(a < b, -1.0f32, 0.0f32));
            out = l1_scale * sign + ssim_scale * (d_mean + 2.0 * a * d_square + b * d_product);
        }
        grad[at as usize] = out;
    }
}

#[cube(launch)]
fn multiply_by(values: &mut [f32], factor: &[f32]) {
    if ABSOLUTE_POS < values.len() {
        values[ABSOLUTE_POS] *= factor[0];
    }
}

impl PhotometricKernels for CubeBackend {
    fn photometric_pass(
        planes: FloatTensor<Self>,
        target: FloatTensor<Self>,
        lambda_c: f32,
        gradient: bool,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>) {
        let (planes, target) = (into_contiguous(planes), into_contiguous(target));
        let shape = planes.shape();
        let (height, width) = (shape[1], shape[2]);
        let pixels = height * width;
        let client = planes.client.clone();
        let none = |like: &CubeTensor| floats(like, [0]);
        if pixels == 0 {
            return (upload(&planes, &[0.0f32], DType::F32), upload(&planes, &[0.0f32; 3], DType::F32), none(&planes));
        }
        let taps = constant(&planes, &window(), DType::F32);
        let dim = CubeDim::new_1d(THREADS);
        let moments = floats(&planes, [3 * MOMENTS as usize * pixels]);
        let args = || (planes.clone().into_buffer_arg(), target.clone().into_buffer_arg(), taps.clone().into_buffer_arg());
        let (x, y, w) = args();
        blur_moments_in_rows::launch(&client, workgroups_for(3 * pixels), dim, x, y, w, moments.clone().into_buffer_arg(), width as u32, pixels as u32);
        let workgroups = (3 * pixels).div_ceil(THREADS as usize);
        let partial = floats(&planes, [3 * workgroups]);
        let derivatives = floats(&planes, [if gradient { 3 * DERIVATIVES as usize * pixels } else { 1 }]);
        let (x, y, w) = args();
        ssim_and_derivatives::launch(
            &client,
            workgroups_for(3 * pixels),
            dim,
            x,
            y,
            w,
            moments.into_buffer_arg(),
            derivatives.clone().into_buffer_arg(),
            partial.clone().into_buffer_arg(),
            width as u32,
            pixels as u32,
            gradient,
        );
        let (loss, terms) = (floats(&planes, [1]), floats(&planes, [3]));
        let scale = 1.0 / (3 * pixels) as f32;
        finish_terms::launch(
            &client,
            CubeCount::Static(1, 1, 1),
            dim,
            partial.into_buffer_arg(),
            loss.clone().into_buffer_arg(),
            terms.clone().into_buffer_arg(),
            workgroups as u32,
            scale,
            lambda_c,
        );
        if !gradient {
            let none = none(&planes);
            return (loss, terms, none);
        }
        let blurred = floats(&planes, [3 * DERIVATIVES as usize * pixels]);
        let nine = 3 * DERIVATIVES as usize * pixels;
        blur_derivatives_in_rows::launch(
            &client,
            workgroups_for(nine),
            dim,
            derivatives.into_buffer_arg(),
            taps.clone().into_buffer_arg(),
            blurred.clone().into_buffer_arg(),
            width as u32,
        );
        let grad = floats(&planes, shape.clone());
        let (x, y, w) = args();
        gradient_of_planes::launch(
            &client,
            workgroups_for(shape.num_elements()),
            dim,
            x,
            y,
            w,
            blurred.into_buffer_arg(),
            grad.clone().into_buffer_arg(),
            width as u32,
            pixels as u32,
            lambda_c * scale,
            -(1.0 - lambda_c) * scale,
        );
        (loss, terms, grad)
    }
    fn bce_pass(planes: FloatTensor<Self>, mask: FloatTensor<Self>, gradient: bool) -> (FloatTensor<Self>, FloatTensor<Self>) {
        super::cross_entropy::bce(planes, mask, gradient)
    }
    fn scale_by(gradient: FloatTensor<Self>, upstream: FloatTensor<Self>) -> FloatTensor<Self> {
        let gradient = super::tensor::owned(gradient);
        let n = gradient.shape().num_elements();
        if n == 0 {
            return gradient;
        }
        let client = gradient.client.clone();
        let factor = into_contiguous(upstream).into_buffer_arg();
        multiply_by::launch(&client, workgroups_for(n), CubeDim::new_1d(THREADS), gradient.clone().into_buffer_arg(), factor);
        gradient
    }
}

impl PhotometricOps for CubeBackend {
    fn photometric(planes: FloatTensor<Self>, target: FloatTensor<Self>, lambda_c: f32) -> (FloatTensor<Self>, FloatTensor<Self>) {
        let (loss, terms, _) = Self::photometric_pass(planes, target, lambda_c, false);
        (loss, terms)
    }
    fn bce_with_logits(planes: FloatTensor<Self>, mask: FloatTensor<Self>) -> FloatTensor<Self> {
        Self::bce_pass(planes, mask, false).0
    }
}
