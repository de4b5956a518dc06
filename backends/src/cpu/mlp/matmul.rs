//! Row-major matrix products on one thread.

use gemm::{Parallelism, gemm};

/// `out` `[rows, n]` = `x` `[rows, k]` * `w` `[k, n]`, added to what `out` holds if `accumulate`.
pub fn matmul(out: &mut [f32], x: &[f32], w: &[f32], (rows, k, n): (usize, usize, usize), accumulate: bool) {
    assert!(out.len() >= rows * n && x.len() >= rows * k && w.len() >= k * n, "matmul: slices shorter than {rows}x{k}x{n}");
    if rows == 0 || n == 0 {
        return;
    }
    // SAFETY: the assertion above bounds every address that the strides below reach; `out` is borrowed mutably, so it overlaps neither input.
    // Seen column-major, out^T [n, rows] = w^T [n, k] * x^T [k, rows]: unit row stride everywhere, nothing to pack.
    unsafe {
        gemm(
            n,
            rows,
            k,
            out.as_mut_ptr(),
            n as isize,
            1,
            accumulate,
            w.as_ptr(),
            n as isize,
            1,
            x.as_ptr(),
            k as isize,
            1,
            1.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

/// `out` `[k, n]` += `x`^T * `g` for `x` `[rows, k]` and `g` `[rows, n]`: the gradient of a weight matrix.
pub fn add_transposed_matmul(out: &mut [f32], x: &[f32], g: &[f32], (rows, k, n): (usize, usize, usize)) {
    assert!(out.len() >= k * n && x.len() >= rows * k && g.len() >= rows * n, "add_transposed_matmul: slices shorter than {rows}x{k}x{n}");
    if rows == 0 || n == 0 || k == 0 {
        return;
    }
    // SAFETY: as in `matmul`; out^T [n, k] += g^T [n, rows] * x [rows, k].
    unsafe {
        gemm(
            n,
            k,
            rows,
            out.as_mut_ptr(),
            n as isize,
            1,
            true,
            g.as_ptr(),
            n as isize,
            1,
            x.as_ptr(),
            1,
            k as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

/// The transpose `[n, k]` of `w` `[k, n]`.
pub fn transposed(w: &[f32], (k, n): (usize, usize)) -> Vec<f32> {
    let mut out = vec![0.0; k * n];
    for (i, row) in w.chunks_exact(n.max(1)).enumerate() {
        for (j, v) in row.iter().enumerate() {
            out[j * k + i] = *v;
        }
    }
    out
}

/// Every row of `out` `[rows, n]` = `bias` `[n]`.
#[inline(always)]
pub fn fill_rows(out: &mut [f32], bias: &[f32]) {
    for row in out.chunks_exact_mut(bias.len().max(1)) {
        row.copy_from_slice(bias);
    }
}

/// `out` `[n]` += the sum of the rows of `g` `[rows, n]`.
#[inline(always)]
pub fn add_column_sums(out: &mut [f32], g: &[f32]) {
    for row in g.chunks_exact(out.len().max(1)) {
        for (o, v) in out.iter_mut().zip(row) {
            *o += v;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(n: usize, step: f32) -> Vec<f32> {
        (0..n).map(|i| ((i as f32 * step).sin() * 8.0).round() / 8.0).collect()
    }

    #[test]
    fn products_match_the_definition() {
        for (rows, k, n) in [(1, 3, 5), (7, 11, 16), (33, 128, 1), (130, 17, 128)] {
            let (x, w, g) = (numbers(rows * k, 0.7), numbers(k * n, 1.3), numbers(rows * n, 2.1));
            let mut out = numbers(rows * n, 0.1);
            let before = out.clone();
            matmul(&mut out, &x, &w, (rows, k, n), true);
            let mut grad = vec![0.0; k * n];
            add_transposed_matmul(&mut grad, &x, &g, (rows, k, n));
            let back = transposed(&w, (k, n));
            for i in 0..rows {
                for j in 0..n {
                    let want: f32 = before[i * n + j] + (0..k).map(|p| x[i * k + p] * w[p * n + j]).sum::<f32>();
                    assert!((out[i * n + j] - want).abs() < 1e-4, "{rows}x{k}x{n}");
                }
            }
            for p in 0..k {
                for j in 0..n {
                    let want: f32 = (0..rows).map(|i| x[i * k + p] * g[i * n + j]).sum();
                    assert!((grad[p * n + j] - want).abs() < 1e-4);
                    assert_eq!(back[j * k + p], w[p * n + j]);
                }
            }
        }
    }
}
