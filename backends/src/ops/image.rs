//! Images from 8-bit files to the planes a loss reads, and back. Devices with memory of their own get the bytes, a quarter of the floats.

use super::limits::unread;
use crate::cpu::image as kernel;
use crate::cpu::tensor::CpuBackend;
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Backend, Dispatch, TensorMetadata, backend_extension};
use burn::tensor::{Device, Int, Tensor};
use cc4dgs_core::{Error, Image8, Result};
use std::sync::Arc;

/// The operation per device; `like` only says which.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"))]
pub trait ImageOps: Backend {
    /// Planes `[3,H,W]` of an image, alpha composited over a background.
    fn planes(like: FloatTensor<Self>, image: Arc<Image8>, background: [f32; 3]) -> FloatTensor<Self>;
    /// Red, green and blue of planes `[C,H,W]` (C > 2) as words `[H W]` of four bytes, red lowest, the highest 255.
    fn words(planes: FloatTensor<Self>) -> IntTensor<Self>;
}

impl<B: CpuBackend> ImageOps for B {
    fn planes(_like: FloatTensor<Self>, image: Arc<Image8>, background: [f32; 3]) -> FloatTensor<Self> {
        B::from_floats(kernel::planes(&image, background), [3, image.height as usize, image.width as usize])
    }
    fn words(planes: FloatTensor<Self>) -> IntTensor<Self> {
        let [height, width] = [1, 2].map(|d| planes.shape()[d]);
        let image = Image8::from_planes(&B::floats(&planes), width as u32, height as u32);
        let words = image.data.as_chunks::<3>().0.iter().map(|&[r, g, b]| i64::from(i32::from_le_bytes([r, g, b, 255]))).collect();
        B::from_ints(words, [width * height])
    }
}

/// Planes `[3,H,W]` in 0..1 of `image` on `device`, alpha composited over `background` (RGB in 0..1); the same numbers as [`Image8::to_planes`].
pub fn image_planes(image: &Arc<Image8>, background: [f32; 3], device: &Device) -> Tensor<3> {
    let like = Tensor::<1>::empty([1], &device.clone().without_autodiff());
    Tensor::from_dispatch(<Dispatch as ImageOps>::planes(like.into_dispatch(), image.clone(), background))
}

/// The 8-bit RGB image of planes `[C,H,W]` (red, green and blue first). Values are rounded on the device, so that a quarter of the bytes is read back; the same
/// rule as [`Image8::from_planes`].
pub fn read_image(planes: Tensor<3>) -> Result<Image8> {
    let [channels, height, width] = planes.dims();
    if channels < 3 || height == 0 || width == 0 {
        return Err(Error::parameter("image", format!("planes have shape [{channels},{height},{width}]"), "Give red, green and blue of at least one pixel"));
    }
    let words = Tensor::<1, Int>::from_dispatch(<Dispatch as ImageOps>::words(planes.inner().into_dispatch()));
    let data = words
        .try_into_data()
        .map_err(|error| unread("image", error))?
        .iter::<i64>()
        .flat_map(|word| {
            let [r, g, b, _] = (word as u32).to_le_bytes();
            [r, g, b]
        })
        .collect();
    Ok(Image8 { width: width as u32, height: height as u32, channels: 3, data })
}
