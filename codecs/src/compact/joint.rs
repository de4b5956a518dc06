//! Colours rounded together, for the directions from which views see Gaussians.
//!
//! Cameras see a Gaussian from some sides only, and functions of direction that are orthogonal over the sphere are not so there: what rounding one coefficient
//! changes, others can undo. With M, the mean over views of y yᵀ times the weight of the Gaussian in the view, where y are the basis functions at the view's
//! direction, errors e of the coefficients of a channel add eᵀ M e to the squared error of images. Degrees are rounded from the highest to the lowest, each to
//! the nearest of what is best given the errors of those before (the nearest-plane algorithm of Babai 1986, a degree at a time). Decoders do not depend on it.

use super::colors::{Choices, Codes, Degree};
use super::columns::{Columns, Rows};
use cc4dgs_format::Camera;
use rayon::prelude::*;
use std::ops::Range;

/// Channels of a colour.
const CHANNELS: usize = 3;
/// Most basis functions: those of degree 0 to 4.
const MOST: usize = 25;
/// Rows that are rounded at a time.
const CHUNK: usize = 2048;
/// All directions count with this share of the mean. Files of mutant with 12,135 Gaussians have 18.6, 18.2, 17.8, 18.1, 18.2 and 18.7 bytes per Gaussian with
/// 0.001, 0.01, 0.03, 0.05, 0.1 and 0.2: with less, coefficients drift where no view sees it, which costs bits.
const UNSEEN: f64 = 0.03;

/// The basis functions of the spherical harmonics of degree 0 to 4 at the unit vector `direction`, signs as in Inria's 3DGS.
fn basis([x, y, z]: [f64; 3]) -> [f64; MOST] {
    let (xx, yy, zz, xy, yz, xz) = (x * x, y * y, z * z, x * y, y * z, x * z);
    [
        0.282_094_791_773_878_14,
        -0.488_602_511_902_919_9 * y,
        0.488_602_511_902_919_9 * z,
        -0.488_602_511_902_919_9 * x,
        1.092_548_430_592_079_2 * xy,
        -1.092_548_430_592_079_2 * yz,
        0.315_391_565_252_520_05 * (2.0 * zz - xx - yy),
        -1.092_548_430_592_079_2 * xz,
        0.546_274_215_296_039_6 * (xx - yy),
        -0.590_043_589_926_643_5 * y * (3.0 * xx - yy),
        2.890_611_442_640_554 * xy * z,
        -0.457_045_799_464_465_8 * y * (4.0 * zz - xx - yy),
        0.373_176_332_590_115_4 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.457_045_799_464_465_8 * x * (4.0 * zz - xx - yy),
        1.445_305_721_320_277 * z * (xx - yy),
        -0.590_043_589_926_643_5 * x * (xx - 3.0 * yy),
        2.503_342_941_796_704_6 * xy * (xx - yy),
        -1.770_130_769_779_930_5 * yz * (3.0 * xx - yy),
        0.946_174_695_757_560_1 * xy * (7.0 * zz - 1.0),
        -0.669_046_543_557_289_2 * yz * (7.0 * zz - 3.0),
        0.105_785_546_915_204_3 * (zz * (35.0 * zz - 30.0) + 3.0),
        -0.669_046_543_557_289_2 * xz * (7.0 * zz - 3.0),
        0.473_087_347_878_780_1 * (xx - yy) * (7.0 * zz - 1.0),
        -1.770_130_769_779_930_5 * xz * (xx - 3.0 * yy),
        0.625_835_735_449_176_1 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)),
    ]
}

/// How errors of the coefficients of each Gaussian compensate for each other.
pub struct Directions {
    /// Basis functions: (degree + 1)².
    functions: usize,
    /// Lower triangles, row by row `[N, functions (functions + 1) / 2]`: of M while views are added, then of L, where M is L D Lᵀ and L has ones on its
    /// diagonal.
    triangles: Vec<f32>,
}

/// The index of the first value of a row of a triangle.
fn start(row: usize) -> usize {
    row * (row + 1) / 2
}

impl Directions {
    /// Of `count` Gaussians with harmonics of `degree`, seen by `views`: each adds itself by [`Directions::add`].
    pub fn new(count: usize, degree: usize) -> Self {
        let functions = ((degree + 1) * (degree + 1)).min(MOST);
        Self { functions, triangles: vec![0.0; count * start(functions)] }
    }
    /// Adds a view: the `means` `[N,3]` of the Gaussians as they are then, and the squares of their weights in it `[N]`.
    pub fn add(&mut self, camera: &Camera, means: &[f32], weights: &[f64]) {
        let (functions, eye) = (self.functions, camera.center_world());
        let rows = self.triangles.par_chunks_exact_mut(start(functions)).zip(means.par_chunks_exact(3)).zip(weights);
        rows.filter(|(_, weight)| **weight > 0.0 && weight.is_finite()).for_each(|((triangle, mean), &weight)| {
            let to: [f64; 3] = std::array::from_fn(|k| f64::from(mean[k]) - eye[k]);
            let length = to.iter().map(|v| v * v).sum::<f64>().sqrt();
            if length > 0.0 && length.is_finite() {
                let y = basis(to.map(|v| v / length));
                for (row, own) in y.iter().enumerate().take(functions) {
                    triangle[start(row)..].iter_mut().zip(&y[..=row]).for_each(|(sum, other)| *sum += (weight * own * other) as f32);
                }
            }
        });
    }
    /// Factors M of every Gaussian. Call it once all views were added.
    pub fn factored(mut self) -> Self {
        let functions = self.functions;
        self.triangles.par_chunks_exact_mut(start(functions)).for_each(|triangle| {
            // Coefficients of Gaussians that no view sees are rounded independently.
            if !factor(triangle, functions) {
                triangle.fill(0.0);
            }
        });
        self
    }
    /// Codes of all `degrees` of `gaussians`, which are as many as views were added for. A degree that `rounds` says is not rounded is stored exactly, as are
    /// rows that are out of range.
    pub fn quantise(&self, degrees: &[Degree], gaussians: Columns, classes: &[u8], rounds: &[bool], choices: &[Choices]) -> Vec<Codes> {
        let mut values: Vec<Vec<i32>> = degrees.iter().map(|plan| vec![0; classes.len() * plan.dims]).collect();
        // The values of each chunk, by degree.
        let mut parts: Vec<Vec<&mut [i32]>> = (0..classes.len().div_ceil(CHUNK)).map(|_| Vec::with_capacity(degrees.len())).collect();
        for (values, plan) in values.iter_mut().zip(degrees) {
            parts.iter_mut().zip(values.chunks_mut(CHUNK * plan.dims)).for_each(|(parts, part)| parts.push(part));
        }
        let chunk = |(k, parts): (usize, Vec<&mut [i32]>)| -> Vec<Vec<usize>> {
            let first = k * CHUNK;
            let found = self.quantise_rows(degrees, gaussians, classes, rounds, choices, first..classes.len().min(first + CHUNK));
            let put = |(part, codes): (&mut [i32], Codes)| -> Vec<usize> {
                part.copy_from_slice(&codes.values);
                codes.missing.into_iter().map(|row| first + row).collect()
            };
            parts.into_iter().zip(found).map(put).collect()
        };
        let missing: Vec<Vec<Vec<usize>>> = parts.into_par_iter().enumerate().map(chunk).collect();
        let of_degree = |degree: usize| missing.iter().flat_map(|chunk| &chunk[degree]).copied().collect();
        values.into_iter().enumerate().map(|(degree, values)| Codes { values, missing: of_degree(degree) }).collect()
    }
    /// [`Directions::quantise`] for some `rows`.
    fn quantise_rows(&self, degrees: &[Degree], gaussians: Columns, classes: &[u8], rounds: &[bool], choices: &[Choices], rows: Range<usize>) -> Vec<Codes> {
        let (triangles, classes) = (&self.triangles[rows.start * start(self.functions)..rows.end * start(self.functions)], &classes[rows.clone()]);
        // Errors so far, by row, channel and function.
        let mut errors = vec![[[0.0f64; MOST]; CHANNELS]; rows.len()];
        let mut out = Vec::with_capacity(degrees.len());
        for (degree, plan) in degrees.iter().enumerate().rev() {
            let (dims, first, given) = (plan.dims, degree * degree, gaussians.coefficients(degree));
            let mut wanted: Vec<f32> = Vec::with_capacity(rows.len() * dims);
            rows.clone().for_each(|row| wanted.extend_from_slice(given.row(row)));
            for ((wanted, errors), triangle) in wanted.chunks_exact_mut(dims).zip(&errors).zip(triangles.chunks_exact(start(self.functions))) {
                for (channel, errors) in errors.iter().enumerate() {
                    let shifts = compensation(triangle, self.functions, first..first + dims / CHANNELS, errors);
                    shifts.iter().take(dims / CHANNELS).enumerate().for_each(|(f, shift)| wanted[CHANNELS * f + channel] += *shift as f32);
                }
            }
            let codes = plan.quantise(Rows::of(&wanted, dims), classes, &choices[degree]);
            let basis = plan.scaled_basis();
            let mut restored = vec![0.0f32; dims];
            // What is stored exactly has no error.
            let mut exact = codes.missing.iter().copied().peekable();
            for (k, (values, errors)) in codes.values.chunks_exact(dims).zip(&mut errors).enumerate().filter(|_| rounds[degree]) {
                if exact.next_if_eq(&k).is_some() {
                    continue;
                }
                plan.restore(&basis, values, classes[k], &mut restored);
                for (at, (restored, value)) in restored.iter().zip(given.row(rows.start + k)).enumerate() {
                    errors[at % CHANNELS][first + at / CHANNELS] = f64::from(*restored) - f64::from(*value);
                }
            }
            out.push(codes);
        }
        out.reverse();
        out
    }
}

/// What the coefficients of the functions `of` should change by, given the `errors` of those above: with L, Σ d_j (e_j + Σ_{i>j} L_ij e_i)² is least where each
/// of these sums is 0.
fn compensation(lower: &[f32], functions: usize, of: Range<usize>, errors: &[f64; MOST]) -> [f64; MOST] {
    let mut shifts = [0.0; MOST];
    let factor = |row: usize, column: usize| f64::from(lower[start(row) + column]);
    for f in of.clone().rev() {
        let above: f64 = (of.end..functions).map(|i| factor(i, f) * errors[i]).sum();
        let beside: f64 = (f + 1..of.end).map(|i| factor(i, f) * shifts[i - of.start]).sum();
        shifts[f - of.start] = -above - beside;
    }
    shifts
}

/// Replaces the triangle of M, to which [`UNSEEN`] is added, by that of L. Returns false where M has no such factor.
fn factor(triangle: &mut [f32], functions: usize) -> bool {
    let mean = (0..functions).map(|k| f64::from(triangle[start(k) + k])).sum::<f64>() / functions as f64;
    if !(mean > 0.0 && mean.is_finite()) {
        return false;
    }
    let mut rows = [[0.0f64; MOST]; MOST];
    let mut diagonal = [0.0; MOST];
    for i in 0..functions {
        for j in 0..=i {
            // Relative to the mean, so that weights of any size are in range.
            let mut sum = f64::from(triangle[start(i) + j]) / mean + if i == j { UNSEEN } else { 0.0 };
            for (m, d) in diagonal.iter().enumerate().take(j) {
                sum -= rows[i][m] * rows[j][m] * d;
            }
            if i == j {
                if sum.is_nan() || sum < 1e-6 {
                    return false;
                }
                (diagonal[i], rows[i][i]) = (sum, 1.0);
            } else {
                rows[i][j] = sum / diagonal[j];
            }
        }
    }
    for (i, row) in rows.iter().enumerate().take(functions) {
        triangle[start(i)..=start(i) + i].iter_mut().zip(row).for_each(|(to, v)| *to = *v as f32);
    }
    true
}

#[cfg(test)]
mod tests {
    use super::super::colors::Transform;
    use super::*;
    use cc4dgs_format::HostGaussians;

    /// Directions of one Gaussian at the origin, which cameras see from one side.
    fn one_sided(degree: usize) -> (Directions, Vec<[f64; MOST]>) {
        let mut directions = Directions::new(1, degree);
        let eyes: Vec<[f64; 3]> = (0..60).map(|k| [4.0, (k as f64 * 0.7).sin(), (k as f64 * 1.3).cos()]).collect();
        for eye in &eyes {
            directions.add(&Camera::look_at("t", (8, 8), 1.0, *eye, [0.0; 3], [0.0, 0.0, 1.0]), &[0.0; 3], &[0.1]);
        }
        let seen = eyes.iter().map(|eye| {
            let length = eye.iter().map(|v| v * v).sum::<f64>().sqrt();
            basis(eye.map(|v| -v / length))
        });
        (directions.factored(), seen.collect())
    }

    #[test]
    fn basis_functions_are_orthonormal_over_the_sphere() {
        let n = 40_000;
        let mut sums = [[0.0; MOST]; MOST];
        for k in 0..n {
            // Points of a Fibonacci lattice cover the sphere evenly.
            let (z, turn) = (1.0 - (2.0 * k as f64 + 1.0) / n as f64, k as f64 * 2.399_963_229_728_653);
            let r = (1.0 - z * z).sqrt();
            let y = basis([r * turn.cos(), r * turn.sin(), z]);
            sums.iter_mut()
                .zip(y)
                .for_each(|(row, own)| row.iter_mut().zip(y).for_each(|(sum, other)| *sum += own * other * 4.0 * std::f64::consts::PI / n as f64));
        }
        for (i, row) in sums.iter().enumerate() {
            assert!(row.iter().enumerate().all(|(j, v)| (v - f64::from(u8::from(i == j))).abs() < 1e-3), "{i}: {row:?}");
        }
    }

    #[test]
    fn lower_degrees_make_up_for_higher_ones_where_it_is_seen() {
        let (directions, seen) = one_sided(2);
        let values: Vec<f32> = (0..27).map(|k| (k as f32 * 1.7).sin()).collect();
        let gaussians = HostGaussians {
            sh_degree: 2,
            means: vec![0.0; 3],
            sh_dc: values[..3].to_vec(),
            sh_rest: values[3..].to_vec(),
            opacity_logits: vec![0.0],
            ..Default::default()
        };
        let choices = [Choices { transform: false, rate_weight: 0.0 }; 3];
        // One row has no mean of its own: planned beside its opposite.
        let degrees: Vec<Degree> = (0..3)
            .map(|d| {
                let row = Columns::from(&gaussians).coefficients(d).row(0);
                let both: Vec<f32> = row.iter().copied().chain(row.iter().map(|v| -v)).collect();
                Degree::plan(&Transform::of(Rows::of(&both, row.len()), &[1.0, 1.0], &choices[0]), [0.02, 0.3, 0.3][d])
            })
            .collect();
        let error = |codes: &[Codes]| {
            let restored: Vec<f32> = degrees
                .iter()
                .zip(codes)
                .flat_map(|(plan, codes)| {
                    let mut out = vec![0.0; plan.dims];
                    plan.restore(&plan.scaled_basis(), &codes.values, 0, &mut out);
                    out
                })
                .collect();
            let of = |y: &[f64; MOST], c: usize| (0..9).map(|f| f64::from(restored[3 * f + c] - values[3 * f + c]) * y[f]).sum::<f64>().powi(2);
            seen.iter().flat_map(|y| (0..3).map(move |c| of(y, c))).sum::<f64>()
        };
        let columns = Columns::from(&gaussians);
        let apart: Vec<Codes> = degrees.iter().enumerate().map(|(d, plan)| plan.quantise(columns.coefficients(d), &[0], &choices[d])).collect();
        let together = directions.quantise(&degrees, columns, &[0], &[true; 3], &choices);
        assert!(error(&together) < 0.1 * error(&apart), "{} and {}", error(&together), error(&apart));
        // Degrees that are stored exactly have no errors to compensate for.
        assert!(directions.quantise(&degrees, columns, &[0], &[true, true, false], &choices)[..2] != together[..2]);
        assert_eq!(directions.quantise(&degrees, columns, &[0], &[false, false, false], &choices), apart);
        // Without a view, coefficients are rounded independently.
        assert_eq!(Directions::new(1, 2).factored().quantise(&degrees, columns, &[0], &[true; 3], &choices), apart);
    }
}
