//! Field weights in fewer bytes: 16-bit floats, or 8-bit integers with a scale per row.

use super::ByteReader;
use crate::{Error, Result};
use burn::tensor::f16;
use serde::{Deserialize, Serialize};

/// Values that share a scale.
const ROW: usize = 64;
/// Largest 8-bit code.
const PEAK: f32 = 127.0;

/// How the weights of a field are stored; any field can have any.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WeightPrecision {
    /// float32, bit-exact.
    #[default]
    Fp32,
    /// 16-bit floats.
    Fp16,
    /// 8-bit integers, a float32 scale per 64 values.
    Int8,
}

impl WeightPrecision {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Fp32, Self::Fp16, Self::Int8];
    /// Its name in options and reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Fp32 => "fp32",
            Self::Fp16 => "fp16",
            Self::Int8 => "int8",
        }
    }
    /// Name of the archive's stream.
    pub fn stream(self) -> &'static str {
        match self {
            Self::Fp32 => "field.weights",
            Self::Fp16 => "field.weights.fp16",
            Self::Int8 => "field.weights.int8",
        }
    }
    /// Bytes that `count` values take.
    pub(super) fn bytes(self, count: usize) -> usize {
        match self {
            Self::Fp32 => 4 * count,
            Self::Fp16 => 2 * count,
            Self::Int8 => count + 4 * count.div_ceil(ROW),
        }
    }
    pub(super) fn write(self, name: &str, values: &[f32], out: &mut Vec<u8>) -> Result<()> {
        match self {
            Self::Fp32 => out.extend(values.iter().flat_map(|v| v.to_le_bytes())),
            Self::Fp16 => {
                if let Some(v) = values.iter().find(|v| !f16::from_f32(**v).is_finite()) {
                    return Err(Error::parameter(format!("weights '{name}'"), format!("{v} is beyond what fp16 holds (65,504)"), "Store the field as fp32"));
                }
                out.extend(values.iter().flat_map(|v| f16::from_f32(*v).to_le_bytes()));
            }
            Self::Int8 => {
                for row in values.chunks(ROW) {
                    let scale = row.iter().fold(0.0f32, |m, v| m.max(v.abs())) / PEAK;
                    out.extend(scale.to_le_bytes());
                    // A scale that underflows to 0 stands for zeros.
                    out.extend(row.iter().map(|v| if scale > 0.0 { (v / scale).round().clamp(-PEAK, PEAK) as i8 as u8 } else { 0 }));
                }
            }
        }
        Ok(())
    }
    pub(super) fn read(self, reader: &mut ByteReader, count: usize) -> Result<Vec<f32>> {
        match self {
            Self::Fp32 => reader.f32s(count),
            Self::Fp16 => {
                let bytes = reader.take(2 * count)?;
                let values: Vec<f32> = bytes.as_chunks::<2>().0.iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect();
                match values.iter().find(|v| !v.is_finite()) {
                    Some(v) => Err(reader.error(format!("a weight is {v}"))),
                    None => Ok(values),
                }
            }
            Self::Int8 => {
                let mut values = Vec::with_capacity(count);
                while values.len() < count {
                    let scale = reader.f32()?;
                    let row = reader.take(ROW.min(count - values.len()))?;
                    if !(0.0..=f32::MAX / 128.0).contains(&scale) {
                        return Err(reader.error(format!("a row of weights has scale {scale}")));
                    }
                    values.extend(row.iter().map(|&b| f32::from(b as i8) * scale));
                }
                Ok(values)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_loses_what_its_bits_say() {
        let values: Vec<f32> = (0..1000).map(|i| (i as f32 * 0.7).sin() * 0.1).collect();
        for (precision, allowed) in [(WeightPrecision::Fp32, 0.0), (WeightPrecision::Fp16, 5e-5), (WeightPrecision::Int8, 0.1 / 254.0 + 1e-7)] {
            let mut bytes = Vec::new();
            precision.write("w", &values, &mut bytes).unwrap();
            assert_eq!(bytes.len(), precision.bytes(values.len()));
            let found = precision.read(&mut ByteReader::new("w", &bytes), values.len()).unwrap();
            let worst = values.iter().zip(&found).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst <= allowed, "{}: {worst}", precision.name());
        }
        assert!(WeightPrecision::Fp16.write("w", &[1e6], &mut Vec::new()).is_err());
        assert!(WeightPrecision::Int8.read(&mut ByteReader::new("w", &[0, 0, 192, 127, 5]), 1).is_err(), "a scale that is no number");
    }
}
