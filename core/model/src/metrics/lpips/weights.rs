//! The weights of LPIPS as a safetensors file of float16 arrays, such as `benches/lpips_weights.py` writes.

use super::network::Conv;
use super::{LINEAR, Lpips};
use crate::{Error, Result};
use safetensors::{Dtype, SafeTensors};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Shape and step of the five convolutions of AlexNet: inputs, outputs, kernel, stride, padding.
pub(super) const LAYERS: [(usize, usize, usize, usize, usize); 5] =
    [(3, 64, 11, 4, 2), (64, 192, 5, 1, 2), (192, 384, 3, 1, 1), (384, 256, 3, 1, 1), (256, 256, 3, 1, 1)];

/// The file is 4.9 MB; a larger one is something else.
const MAX_BYTES: u64 = 32 << 20;

const REMEDY: &str = "Make the file with benches/lpips_weights.py";

/// Which weights a score was computed with.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WeightsId {
    /// The network.
    pub network: String,
    /// The version of the linear layers.
    pub version: String,
    /// XXH3-64 of the file, in hexadecimal digits.
    pub xxh3: String,
}

impl Lpips {
    /// Reads weights from a file.
    ///
    /// # Errors
    /// [`Error::Io`] if the file cannot be read, [`Error::Limit`] over 32 MiB, otherwise as [`Lpips::from_bytes`].
    pub fn read(path: &Path) -> Result<Self> {
        let bytes = std::fs::metadata(path).map_err(|e| Error::io(path, e))?.len();
        if bytes > MAX_BYTES {
            return Err(Error::limit(path.display().to_string(), bytes, MAX_BYTES, REMEDY));
        }
        Self::from_bytes(&std::fs::read(path).map_err(|e| Error::io(path, e))?)
    }
    /// Weights of the arrays `conv0.weight` `[64,3,11,11]`, `conv0.bias` `[64]`, `linear0.weight` `[64]`, and so on up to 4, in float16.
    ///
    /// # Errors
    /// [`Error::Data`] if the bytes are no safetensors file, or an array is missing, of another shape or type, or not finite.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self> {
        let file = SafeTensors::deserialize(bytes).map_err(|e| Error::data("LPIPS weights", format!("not a safetensors file: {e}"), REMEDY))?;
        let mut conv = Vec::with_capacity(LAYERS.len());
        let mut linear = Vec::with_capacity(LINEAR.len());
        for (layer, (inputs, outputs, kernel, stride, padding)) in LAYERS.into_iter().enumerate() {
            let weight = array(&file, &format!("conv{layer}.weight"), &[outputs, inputs, kernel, kernel])?;
            let bias = array(&file, &format!("conv{layer}.bias"), &[outputs])?;
            conv.push(Conv { weight, bias, inputs, outputs, kernel, stride, padding });
            linear.push(array(&file, &format!("linear{layer}.weight"), &[outputs])?);
        }
        let xxh3 = format!("{:016x}", xxhash_rust::xxh3::xxh3_64(bytes));
        Ok(Self { conv, linear, id: WeightsId { network: "alexnet".into(), version: "0.1".into(), xxh3 } })
    }
}

fn array(file: &SafeTensors, name: &str, shape: &[usize]) -> Result<Vec<f32>> {
    let object = || format!("LPIPS weights, {name}");
    let view = file.tensor(name).map_err(|_| Error::data(object(), "the array is missing", REMEDY))?;
    if view.shape() != shape || view.dtype() != Dtype::F16 {
        let problem = format!("{:?} of {:?} instead of F16 of {shape:?}", view.dtype(), view.shape());
        return Err(Error::data(object(), problem, REMEDY));
    }
    let values: Vec<f32> = view.data().chunks_exact(2).map(|b| half::f16::from_le_bytes([b[0], b[1]]).to_f32()).collect();
    if values.iter().any(|v| !v.is_finite()) {
        return Err(Error::data(object(), "a value is not finite", REMEDY));
    }
    Ok(values)
}
