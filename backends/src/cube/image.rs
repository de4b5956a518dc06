//! 8-bit images to planes and back.

use super::kept_images::KeptImages;
use super::tensor::{THREADS, constant, empty, floats, signed, workgroups_for};
use crate::ops::image::ImageOps;
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::tensor::DType;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use burn_cubecl::{CubeBackend, CubeDevice};
use cc4dgs_core::Image8;
use cubecl::prelude::*;
use std::sync::{Arc, LazyLock, Mutex, PoisonError};
use std::thread::ThreadId;

/// Upper bound on the bytes of images that are cached on devices.
const MOST_KEPT: usize = 512 << 20;

/// Cached images by thread (each has its own stream of launches) and device.
static KEPT: LazyLock<Mutex<KeptImages<(ThreadId, CubeDevice), CubeTensor>>> = LazyLock::new(|| Mutex::new(KeptImages::new(MOST_KEPT)));

/// Byte `at` of words that hold four each, lowest first, as 0..1.
#[cube]
fn byte(words: &[u32], at: usize) -> f32 {
    ((words[at / 4] >> ((at % 4) as u32 * 8)) & 255u32) as f32 / 255.0
}

/// planes `[3,H,W]` of interleaved bytes.
#[cube(launch)]
fn unpack(words: &[u32], background: &[f32], planes: &mut [f32], pixels: u32, #[comptime] channels: usize) {
    let (pixel, plane) = (ABSOLUTE_POS % pixels as usize, ABSOLUTE_POS / pixels as usize);
    if plane < 3usize {
        let mut alpha = 1.0f32;
        if comptime!(channels == 4) {
            alpha = byte(words, pixel * channels + 3);
        }
        planes[ABSOLUTE_POS] = alpha * byte(words, pixel * channels + plane) + (1.0 - alpha) * background[plane];
    }
}

/// 0..1 as a byte, rounded half up; NaN is black.
#[cube]
fn rounded(value: f32) -> u32 {
    let low = select(value > 0.0, value, 0.0f32);
    (select(low < 1.0, low, 1.0f32) * 255.0 + 0.5) as u32
}

/// words `[H W]` of planes `[C,H,W]`.
#[cube(launch)]
fn pack(planes: &[f32], words: &mut [u32]) {
    let pixels = words.len();
    if ABSOLUTE_POS < pixels {
        let (red, green) = (rounded(planes[ABSOLUTE_POS]), rounded(planes[pixels + ABSOLUTE_POS]));
        words[ABSOLUTE_POS] = red | (green << 8) | (rounded(planes[2 * pixels + ABSOLUTE_POS]) << 16) | 0xff00_0000u32;
    }
}

impl ImageOps for CubeBackend {
    fn words(planes: FloatTensor<Self>) -> IntTensor<Self> {
        let planes = into_contiguous(planes);
        let pixels = planes.meta.shape()[1] * planes.meta.shape()[2];
        let words = empty(&planes, [pixels], DType::U32);
        let client = planes.client.clone();
        let arguments = (planes.into_buffer_arg(), words.clone().into_buffer_arg());
        pack::launch(&client, workgroups_for(pixels), CubeDim::new_1d(THREADS), arguments.0, arguments.1);
        signed(words)
    }
    fn planes(like: FloatTensor<Self>, image: Arc<Image8>, background: [f32; 3]) -> FloatTensor<Self> {
        let (width, height) = (image.width as usize, image.height as usize);
        let planes = floats(&like, [3, height, width]);
        let send = || {
            let count = image.data.len().div_ceil(4);
            let mut padded = Vec::new();
            if !image.data.len().is_multiple_of(4) {
                padded = image.data.clone();
                padded.resize(4 * count, 0);
            }
            let words = like.client.create_from_slice(if padded.is_empty() { &image.data } else { &padded });
            CubeTensor::new_contiguous(like.client.clone(), like.device.clone(), [count].into(), words, DType::U32)
        };
        let owner = (std::thread::current().id(), like.device.clone());
        let words = KEPT.lock().unwrap_or_else(PoisonError::into_inner).of(owner, &image, send);
        let client = like.client.clone();
        let (w, b) = (words.into_buffer_arg(), constant(&like, &background, DType::F32).into_buffer_arg());
        let pixels = width * height;
        unpack::launch(
            &client,
            workgroups_for(3 * pixels),
            CubeDim::new_1d(THREADS),
            w,
            b,
            planes.clone().into_buffer_arg(),
            pixels as u32,
            if image.channels == 4 { 4 } else { 3 },
        );
        planes
    }
}
