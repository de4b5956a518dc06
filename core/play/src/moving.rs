//! Which Gaussians move, on the device.

use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_core::gaussians::first_rows;

/// The Gaussians that the deformer is asked about, on the device: indices `[M]`, or the first M where they are `None`.
#[derive(Clone, Debug)]
pub struct MovingRows {
    indices: Option<Tensor<1, Int>>,
    count: usize,
}

impl MovingRows {
    /// The rows `rows` of `total` Gaussians; `None` is all of them. Rows from the first on need no indices: they are one piece of every array.
    pub fn new(rows: Option<Vec<usize>>, total: usize, device: &Device) -> Self {
        let count = rows.as_ref().map_or(total, Vec::len);
        let rows = rows.filter(|rows| rows.is_empty() || rows.iter().enumerate().any(|(k, &row)| k != row));
        let upload = |rows: Vec<usize>| Tensor::from_data(TensorData::new(rows.into_iter().map(|i| i as i64).collect::<Vec<_>>(), [count]), device);
        Self { indices: rows.map(upload), count }
    }
    /// How many there are.
    pub fn count(&self) -> usize {
        self.count
    }
    /// These rows of `values` `[N,C]`.
    pub fn select(&self, values: Tensor<2>) -> Tensor<2> {
        match &self.indices {
            None => first_rows(values, self.count),
            Some(rows) => values.select(0, rows.clone()),
        }
    }
    /// The index tensor, `None` for the first [`MovingRows::count`].
    pub fn indices(&self) -> Option<&Tensor<1, Int>> {
        self.indices.as_ref()
    }
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;
    use cc4dgs_core::gaussians::to_vec;

    #[test]
    fn rows_from_the_first_on_need_no_indices() {
        let device = Device::flex();
        let values = Tensor::<2>::from_floats([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]], &device);
        for (rows, indexed, expected) in [
            (None, false, vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0]),
            (Some(vec![0, 1]), false, vec![0.0, 1.0, 2.0, 3.0]),
            (Some(vec![0, 2]), true, vec![0.0, 1.0, 4.0, 5.0]),
            (Some(vec![1]), true, vec![2.0, 3.0]),
            (Some(Vec::new()), true, Vec::new()),
        ] {
            let moving = MovingRows::new(rows, 3, &device);
            assert_eq!((moving.indices().is_some(), 2 * moving.count()), (indexed, expected.len()));
            assert_eq!(to_vec(moving.select(values.clone()), "rows").unwrap(), expected);
        }
    }
}
