//! Sums in a fixed order.

use burn::tensor::Tensor;

/// Number of floats from which burn's CPU back end adds in parallel (`sum_f32_parallel` of burn-flex 0.22): the order, and with it the last bits, depend on threads.
const LONG: usize = 4 << 20;
/// Floats per row of longer sums.
const ROW: usize = 1 << 12;

/// Sum of all `values`, the same bits whatever the number of threads.
pub fn ordered_sum<const D: usize>(values: Tensor<D>) -> Tensor<1> {
    let count = values.dims().iter().product::<usize>();
    if count < LONG {
        return values.sum();
    }
    let flat = values.reshape([count]);
    let whole = count / ROW * ROW;
    // Each row has one thread, and so has the sum of rows.
    let sum = flat.clone().narrow(0, 0, whole).reshape([whole / ROW, ROW]).sum_dim(1).sum();
    if whole == count { sum } else { sum + flat.narrow(0, whole, count - whole).sum() }
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;
    use crate::gaussians::to_vec;
    use burn::tensor::{Device, TensorData};

    #[test]
    fn sums_do_not_depend_on_threads() {
        for count in [LONG - 1, LONG, LONG + ROW / 2] {
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
        let count = LONG + 7;
        let values = Tensor::<1>::zeros([count], &Device::flex().autodiff()).require_grad();
        let gradients = ordered_sum(values.clone()).mul_scalar(3.0).backward();
        let gradient = to_vec(values.grad(&gradients).unwrap(), "gradient").unwrap();
        assert!(gradient.len() == count && gradient.iter().all(|g| *g == 3.0));
    }
}
