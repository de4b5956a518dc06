//! Which Gaussians move, on the device.

use burn::tensor::{Device, Int, Tensor, TensorData};
/// The Gaussians that the deformer is asked about, on the device: indices `[M]`, or all where they are `None`.
#[derive(Clone, Debug)]
pub struct MovingRows {
    indices: Option<Tensor<1, Int>>,
    count: usize,
}

impl MovingRows {
    /// The rows `rows` of `total` Gaussians; `None` is all of them.
    pub fn new(rows: Option<Vec<usize>>, total: usize, device: &Device) -> Self {
        let count = rows.as_ref().map_or(total, Vec::len);
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
            None => values,
            Some(rows) => values.select(0, rows.clone()),
        }
    }
    /// The index tensor, `None` for all.
    pub fn indices(&self) -> Option<&Tensor<1, Int>> {
        self.indices.as_ref()
    }
}
