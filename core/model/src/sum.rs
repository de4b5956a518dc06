//! Sums in a fixed order.

use burn::tensor::Tensor;

/// Floats that every backend of burn adds in one order. Of more, those of graphics cards give a part to each of several workgroups, which add to the sum
/// atomically (`shared_sum` of cubek-reduce 0.3), and that of CPUs gives parts of 4 Mi and more to threads (`sum_f32_parallel` of burn-flex 0.22).
const ONE_ORDER: usize = 1024;
/// Floats per row of longer sums, at least and at most; a row has one thread.
const ROW: [usize; 2] = [64, 512];

/// Sum of all `values`, the same bits whatever the number of threads or workgroups.
pub fn ordered_sum<const D: usize>(values: Tensor<D>) -> Tensor<1> {
    let count = values.dims().iter().product::<usize>();
    if count <= ONE_ORDER {
        return values.sum();
    }
    let rows = |values: Tensor<1>, row: usize| values.clone().reshape([values.dims()[0] / row, row]).sum_dim(1);
    let flat = values.reshape([count]);
    if let Some(row) = (ROW[0]..=ROW[1]).find(|row| count.is_multiple_of(*row)) {
        return ordered_sum(rows(flat, row));
    }
    let whole = count / ROW[1] * ROW[1];
    ordered_sum(rows(flat.clone().narrow(0, 0, whole), ROW[1])) + flat.narrow(0, whole, count - whole).sum()
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;
    use crate::gaussians::to_vec;
    use burn::tensor::{Device, TensorData};

    #[test]
    fn sums_do_not_depend_on_threads() {
        for count in [ONE_ORDER, 1031, 9620, (4 << 20) - 1, 4 << 20, (4 << 20) + 2048] {
            let values: Vec<f32> = (0..count as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 8) as f32 * 1e-7).collect();
            let exact: f64 = values.iter().map(|&v| f64::from(v)).sum();
            let sums = [1, 2, 3, 5].map(|threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| {
                    let values = Tensor::<1>::from_data(TensorData::new(values.clone(), [count]), &Device::flex());
                    to_vec(ordered_sum(values), "sum").unwrap()[0]
                })
            });
            assert!(sums.iter().all(|sum| sum.to_bits() == sums[0].to_bits()), "{count} floats: {sums:?}");
            assert!((f64::from(sums[0]) / exact - 1.0).abs() < 1e-3, "{count} floats: {} and {exact}", sums[0]);
        }
    }

    #[test]
    fn rows_and_rest_have_the_gradient_of_a_sum() {
        for count in [7, 1031, 9620] {
            let values = Tensor::<1>::zeros([count], &Device::flex().autodiff()).require_grad();
            let gradients = ordered_sum(values.clone()).mul_scalar(3.0).backward();
            let gradient = to_vec(values.grad(&gradients).unwrap(), "gradient").unwrap();
            assert!(gradient.len() == count && gradient.iter().all(|g| *g == 3.0));
        }
    }
}
