//! Jacobi's method for eigenvectors.

/// Turns the symmetric `matrix` `[n,n]` in the plane of the axes `p` and `q` so that its entry there becomes zero, and `vectors`, one per row, with it. The
/// entry must not be zero.
pub fn rotate(matrix: &mut [f64], vectors: &mut [f64], n: usize, p: usize, q: usize) {
    let theta = (matrix[q * n + q] - matrix[p * n + p]) / (2.0 * matrix[p * n + q]);
    let t = libm::copysign(1.0, theta) / (theta.abs() + (theta * theta + 1.0).sqrt());
    let c = 1.0 / (t * t + 1.0).sqrt();
    let s = t * c;
    let turn = |values: &mut [f64], i: usize, j: usize| {
        let (a, b) = (values[i], values[j]);
        (values[i], values[j]) = (c * a - s * b, s * a + c * b);
    };
    (0..n).for_each(|k| turn(matrix, k * n + p, k * n + q));
    for k in 0..n {
        turn(matrix, p * n + k, q * n + k);
        turn(vectors, p * n + k, q * n + k);
    }
}

/// The identity `[n,n]`.
pub fn identity(n: usize) -> Vec<f64> {
    (0..n * n).map(|k| f64::from(u8::from(k % n == k / n))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rotation_clears_an_entry_and_keeps_the_product() {
        let n = 3;
        let given = [2.0, -1.0, 0.5, -1.0, 3.0, 0.25, 0.5, 0.25, -1.0];
        let (mut matrix, mut vectors) = (given, identity(n));
        rotate(&mut matrix, &mut vectors, n, 0, 1);
        assert!(matrix[1].abs() < 1e-15 && matrix[3].abs() < 1e-15, "{matrix:?}");
        for i in 0..n * n {
            let sum = |k: usize| (0..n).map(|l| vectors[k * n + i / n] * matrix[k * n + l] * vectors[l * n + i % n]).sum::<f64>();
            let rebuilt = (0..n).map(sum).sum::<f64>();
            assert!((rebuilt - given[i]).abs() < 1e-14, "{rebuilt} against {}", given[i]);
        }
    }
}
