//! A Karhunen-Loève transform with an 8-bit basis.

use crate::jacobi;
use rayon::prelude::*;

/// Steps of a basis vector's component.
const UNIT: f64 = 127.0;

/// Rows are basis vectors, by falling variance: [dims, dims], in steps of 1/127.
pub type Basis = Vec<i8>;

/// Weighted second moments of rows that are added block by block.
pub struct Moments {
    dims: usize,
    /// Their upper triangle `[dims,dims]`.
    sums: Vec<f64>,
}

impl Moments {
    pub fn new(dims: usize) -> Self {
        Self { dims, sums: vec![0.0; dims * dims] }
    }
    /// Adds `rows` `[M,dims]` with the first M `weights`.
    pub fn add(&mut self, rows: &[f64], weights: &[f64]) {
        let dims = self.dims;
        self.sums.par_chunks_exact_mut(dims).enumerate().for_each(|(i, sums)| {
            for (row, weight) in rows.chunks_exact(dims).zip(weights) {
                let scaled = weight * row[i];
                sums[i..].iter_mut().zip(&row[i..]).for_each(|(sum, value)| *sum += scaled * value);
            }
        });
    }
    /// Their basis.
    pub fn basis(self) -> Basis {
        let Self { dims, sums: mut moments } = self;
        for i in 0..dims {
            for j in 0..i {
                moments[i * dims + j] = moments[j * dims + i];
            }
        }
        let vectors = eigenvectors(&mut moments, dims);
        let mut order: Vec<usize> = (0..dims).collect();
        order.sort_by(|&a, &b| moments[b * dims + b].total_cmp(&moments[a * dims + a]).then(a.cmp(&b)));
        order.into_iter().flat_map(|v| (0..dims).map(move |i| (i, v))).map(|(i, v)| libm::round(UNIT * vectors[v * dims + i]) as i8).collect()
    }
}

/// Turns vectors into coordinates: `[dims,dims]` (row-major), the inverse of the transposed basis.
pub fn analysis(basis: &[i8], dims: usize) -> Option<Vec<f64>> {
    let mut left: Vec<f64> = (0..dims * dims).map(|k| f64::from(basis[k % dims * dims + k / dims]) / UNIT).collect();
    let mut right: Vec<f64> = (0..dims * dims).map(|k| f64::from(u8::from(k % dims == k / dims))).collect();
    for column in 0..dims {
        let pivot = (column..dims).max_by(|&a, &b| left[a * dims + column].abs().total_cmp(&left[b * dims + column].abs()))?;
        if left[pivot * dims + column].abs() < 0.1 {
            return None;
        }
        for k in 0..dims {
            left.swap(pivot * dims + k, column * dims + k);
            right.swap(pivot * dims + k, column * dims + k);
        }
        let scale = 1.0 / left[column * dims + column];
        for k in 0..dims {
            left[column * dims + k] *= scale;
            right[column * dims + k] *= scale;
        }
        for row in (0..dims).filter(|&row| row != column) {
            let factor = left[row * dims + column];
            for k in 0..dims {
                left[row * dims + k] -= factor * left[column * dims + k];
                right[row * dims + k] -= factor * right[column * dims + k];
            }
        }
    }
    Some(right)
}

/// The components of a basis as numbers.
pub fn scaled(basis: &[i8]) -> Vec<f32> {
    basis.iter().map(|&b| f32::from(b) * (1.0 / UNIT as f32)).collect()
}

/// The identity as a basis.
pub fn identity(dims: usize) -> Basis {
    (0..dims * dims).map(|k| if k % dims == k / dims { 127 } else { 0 }).collect()
}

/// Makes `matrix` diagonal; returns the eigenvectors as rows.
fn eigenvectors(matrix: &mut [f64], n: usize) -> Vec<f64> {
    const SWEEPS: usize = 30;
    let mut vectors = jacobi::identity(n);
    let total: f64 = matrix.iter().map(|v| v * v).sum();
    for _ in 0..SWEEPS {
        let off: f64 = (0..n * n).filter(|k| k % n != k / n).map(|k| matrix[k] * matrix[k]).sum();
        // NaN ends the loop too.
        if off.is_nan() || off <= 1e-24 * total {
            break;
        }
        for p in 0..n {
            for q in p + 1..n {
                if matrix[p * n + q] != 0.0 {
                    jacobi::rotate(matrix, &mut vectors, n, p, q);
                }
            }
        }
    }
    vectors
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vectors_come_back_and_energy_comes_first() {
        let (dims, n) = (9, 500);
        let rows: Vec<f64> = (0..n * dims).map(|k| ((k * k) as f64 * 0.37).sin() + 3.0 * ((k / dims) as f64).cos() * (k % dims) as f64).collect();
        let (mut moments, mut blocks) = (Moments::new(dims), Moments::new(dims));
        moments.add(&rows, &vec![1.0; n]);
        // The same in blocks.
        rows.chunks(dims * 64).for_each(|block| blocks.add(block, &[1.0; 64]));
        let basis = moments.basis();
        assert_eq!(blocks.basis(), basis);
        let (analysis, scaled) = (analysis(&basis, dims).unwrap(), scaled(&basis));
        let mut energy = vec![0.0; dims];
        for row in rows.chunks_exact(dims) {
            let mut back = vec![0.0; dims];
            for c in 0..dims {
                let coordinate: f64 = (0..dims).map(|k| analysis[c * dims + k] * row[k]).sum();
                energy[c] += coordinate * coordinate;
                back.iter_mut().zip(&scaled[c * dims..]).for_each(|(b, s)| *b += coordinate * f64::from(*s));
            }
            assert!(row.iter().zip(&back).all(|(a, b)| (a - b).abs() < 1e-5), "{row:?} became {back:?}");
        }
        assert!(energy[0] > 0.9 * energy.iter().sum::<f64>(), "{energy:?}");
    }
}
