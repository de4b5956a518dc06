//! The CPU backends' tensors as plain slices, so that one kernel serves Flex and NdArray alike.

#[cfg(feature = "ndarray")]
use burn::backend::NdArray;
use burn::backend::flex::FlexTensor;
#[cfg(feature = "ndarray")]
use burn::backend::ndarray::NdArrayTensor;
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Backend, Flex};
use burn::tensor::{DType, Shape, TensorData};
use rayon::prelude::*;
use std::borrow::Cow;

/// A backend whose tensors live in host memory.
pub trait CpuBackend: Backend {
    /// The elements, row-major; borrowed when the tensor is contiguous.
    fn floats(tensor: &FloatTensor<Self>) -> Cow<'_, [f32]>;
    /// The elements of a matrix column by column, if they are stored that way (as in the transposed view of a row-major matrix).
    fn columns(tensor: &FloatTensor<Self>) -> Option<&[f32]>;
    /// The integer elements, row-major; borrowed when the tensor is contiguous and stores 64 bits.
    fn ints(tensor: &IntTensor<Self>) -> Cow<'_, [i64]>;
    /// Changes the elements in place if the tensor has no other owner, in a copy otherwise.
    fn update_floats(tensor: FloatTensor<Self>, change: impl FnOnce(&mut [f32])) -> FloatTensor<Self>;
    /// A tensor that owns `values`, row-major; no copy.
    fn from_floats(values: Vec<f32>, shape: impl Into<Shape>) -> FloatTensor<Self>;
    /// An integer tensor that owns `values`, row-major; no copy.
    fn from_ints(values: Vec<i64>, shape: impl Into<Shape>) -> IntTensor<Self>;
}

/// Rows per task of [`row_major`].
const ROWS: usize = 64;

/// The matrix of `rows` rows that is stored as `columns`, row by row.
fn row_major(columns: &[f32], rows: usize) -> Vec<f32> {
    let mut out = vec![0.0f32; columns.len()];
    if columns.is_empty() {
        return out;
    }
    let width = columns.len() / rows;
    out.par_chunks_mut(ROWS * width).enumerate().for_each(|(block, out)| {
        for (c, column) in columns.chunks_exact(rows).enumerate() {
            for (row, value) in out.chunks_exact_mut(width).zip(&column[block * ROWS..]) {
                row[c] = *value;
            }
        }
    });
    out
}

impl CpuBackend for Flex {
    fn floats(tensor: &FloatTensor<Self>) -> Cow<'_, [f32]> {
        match tensor.as_slice::<f32>() {
            Some(slice) => Cow::Borrowed(slice),
            None => match Self::columns(tensor) {
                Some(columns) => Cow::Owned(row_major(columns, tensor.layout().shape()[0])),
                None => Cow::Owned(tensor.to_contiguous().storage::<f32>().to_vec()),
            },
        }
    }
    fn columns(tensor: &FloatTensor<Self>) -> Option<&[f32]> {
        let layout = tensor.layout();
        let (&[rows, columns], &[1, apart]) = (&layout.shape()[..], layout.strides()) else { return None };
        let from = layout.start_offset();
        (apart == rows as isize).then(|| tensor.storage::<f32>().get(from..from + rows * columns)).flatten()
    }
    fn ints(tensor: &IntTensor<Self>) -> Cow<'_, [i64]> {
        if let Some(slice) = tensor.as_slice::<i64>() {
            return Cow::Borrowed(slice);
        }
        let tensor = tensor.to_contiguous();
        Cow::Owned(match tensor.dtype() {
            DType::I32 => tensor.storage::<i32>().iter().map(|&v| i64::from(v)).collect(),
            _ => tensor.storage::<i64>().to_vec(),
        })
    }
    fn update_floats(mut tensor: FloatTensor<Self>, change: impl FnOnce(&mut [f32])) -> FloatTensor<Self> {
        let len = tensor.layout().shape().num_elements();
        let whole = tensor.is_contiguous() && tensor.layout().start_offset() == 0 && tensor.bytes().len() == 4 * len;
        if !whole {
            tensor = tensor.to_contiguous();
        }
        change(&mut tensor.storage_mut::<f32>()[..len]);
        tensor
    }
    fn from_floats(values: Vec<f32>, shape: impl Into<Shape>) -> FloatTensor<Self> {
        FlexTensor::from_data(TensorData::new(values, shape.into()))
    }
    fn from_ints(values: Vec<i64>, shape: impl Into<Shape>) -> IntTensor<Self> {
        FlexTensor::from_data(TensorData::new(values, shape.into()))
    }
}

#[cfg(feature = "ndarray")]
impl CpuBackend for NdArray {
    fn floats(tensor: &FloatTensor<Self>) -> Cow<'_, [f32]> {
        let NdArrayTensor::F32(storage) = tensor else { panic!("ndarray: expected float32, got {:?}", burn::backend::TensorMetadata::dtype(tensor)) };
        let view = storage.view();
        match view.to_slice() {
            Some(slice) => Cow::Borrowed(slice),
            None => Cow::Owned(view.iter().copied().collect()),
        }
    }
    fn columns(tensor: &FloatTensor<Self>) -> Option<&[f32]> {
        let NdArrayTensor::F32(storage) = tensor else { return None };
        let view = storage.view();
        (view.ndim() == 2).then(|| view.reversed_axes().to_slice()).flatten()
    }
    fn ints(tensor: &IntTensor<Self>) -> Cow<'_, [i64]> {
        match tensor {
            NdArrayTensor::I64(storage) => {
                let view = storage.view();
                view.to_slice().map_or_else(|| Cow::Owned(view.iter().copied().collect()), Cow::Borrowed)
            }
            NdArrayTensor::I32(storage) => Cow::Owned(storage.view().iter().map(|&v| i64::from(v)).collect()),
            other => panic!("ndarray: expected integers, got {:?}", burn::backend::TensorMetadata::dtype(other)),
        }
    }
    fn update_floats(tensor: FloatTensor<Self>, change: impl FnOnce(&mut [f32])) -> FloatTensor<Self> {
        let NdArrayTensor::F32(storage) = tensor else { panic!("ndarray: expected float32") };
        let mut array = storage.into_owned();
        if !array.is_standard_layout() {
            array = array.as_standard_layout().to_shared();
        }
        if let Some(slice) = array.as_slice_mut() {
            change(slice);
        }
        NdArrayTensor::from(array)
    }
    fn from_floats(values: Vec<f32>, shape: impl Into<Shape>) -> FloatTensor<Self> {
        NdArrayTensor::from_data(TensorData::new(values, shape.into()))
    }
    fn from_ints(values: Vec<i64>, shape: impl Into<Shape>) -> IntTensor<Self> {
        NdArrayTensor::from_data(TensorData::new(values, shape.into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_become_rows() {
        for (rows, width) in [(1, 1), (3, 5), (200, 7), (65, 1)] {
            let columns: Vec<f32> = (0..rows * width).map(|i| i as f32).collect();
            let expected: Vec<f32> = (0..rows * width).map(|i| columns[i % width * rows + i / width]).collect();
            assert_eq!(row_major(&columns, rows), expected, "{rows}x{width}");
        }
        assert!(row_major(&[], 0).is_empty());
    }
}
