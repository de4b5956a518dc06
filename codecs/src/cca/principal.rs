//! Principal components, and networks initialised with them.
//!
//! gelu(a) - gelu(-a) = a, so a layer that holds a value and its negative passes the value on exactly. An autoencoder that is initialised with the best
//! linear one is useful after any number of training steps, even none.

use super::network::{HALF, Layer};
use crate::jacobi;
use cc4dgs_format::Seed;
use rand::Rng;

/// Eigenvalues, largest first, and eigenvectors (one per row) of the symmetric matrix `a` `[n,n]`, by cyclic Jacobi rotations.
pub(super) fn eigen(mut a: Vec<f64>, n: usize) -> (Vec<f64>, Vec<f64>) {
    let mut v = jacobi::identity(n);
    let scale = a.iter().fold(0.0f64, |m, x| m.max(x.abs()));
    for _ in 0..60 {
        let mut off = 0.0f64;
        for p in 0..n {
            for q in p + 1..n {
                let apq = a[p * n + q].abs();
                off = off.max(apq);
                if apq > 1e-15 * scale {
                    jacobi::rotate(&mut a, &mut v, n, p, q);
                }
            }
        }
        if off <= 1e-14 * scale {
            break;
        }
    }
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&i, &j| a[j * n + j].total_cmp(&a[i * n + i]).then(i.cmp(&j)));
    let values = order.iter().map(|&i| a[i * n + i]).collect();
    let vectors = order.iter().flat_map(|&i| v[i * n..(i + 1) * n].to_vec()).collect();
    (values, vectors)
}

/// Fills one half of the autoencoder so that it maps its first inputs linearly: latent j = sum over i of `into[i * pairs + j]` x input i
/// (encoder), or output i = sum over j of latent j x `out[j * outputs + i]` (decoder). Hidden units that the linear map does not need get
/// random input weights and zero output weights.
pub(super) fn linear_half(parameters: &mut [f32], layers: &[Layer; HALF], pairs: usize, into: &[f32], out: &[f32], seed: Seed) {
    let mut rng = seed.rng();
    for layer in &layers[..HALF - 1] {
        // He's uniform initialisation for the remaining hidden units.
        let bound = (6.0 / layer.inputs as f32).sqrt();
        parameters[layer.at..layer.bias_at()].iter_mut().for_each(|w| *w = rng.random_range(-bound..bound));
    }
    let rows = into.len() / pairs;
    let [first, second, last] = layers;
    for j in 0..pairs {
        for (unit, sign) in [(j, 1.0), (pairs + j, -1.0)] {
            for i in 0..first.inputs {
                parameters[first.at + i * first.outputs + unit] = if i < rows { sign * into[i * pairs + j] } else { 0.0 };
            }
            for i in 0..second.inputs {
                let pass = if i == j {
                    sign
                } else if i == pairs + j {
                    -sign
                } else {
                    0.0
                };
                parameters[second.at + i * second.outputs + unit] = pass;
            }
            for o in 0..last.outputs {
                parameters[last.at + unit * last.outputs + o] = sign * out[j * last.outputs + o];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eigenvectors_rebuild_the_matrix() {
        let n = 9;
        let half: Vec<f64> = (0..n * n).map(|i| ((i * 37 % 101) as f64) / 50.0 - 1.0).collect();
        let a: Vec<f64> = (0..n * n).map(|i| (0..n).map(|k| half[i / n * n + k] * half[i % n * n + k]).sum()).collect();
        let (values, vectors) = eigen(a.clone(), n);
        assert!(values.windows(2).all(|w| w[0] >= w[1]));
        for i in 0..n * n {
            let rebuilt: f64 = (0..n).map(|k| values[k] * vectors[k * n + i / n] * vectors[k * n + i % n]).sum();
            assert!((rebuilt - a[i]).abs() < 1e-10, "{rebuilt} against {}", a[i]);
        }
    }
}
