//! Weights of a deformation field as one stream of float32.

use super::{ByteReader, WeightPrecision};
use crate::{Error, Limits, Result};
use std::collections::BTreeSet;

/// The most dimensions a weight array may have.
const MAX_RANK: usize = 8;

/// A named array of weights.
#[derive(Clone, Debug, PartialEq)]
pub struct WeightArray {
    /// Unique within the field ([`crate::Parameter::name`]).
    pub name: String,
    /// Logical shape.
    pub shape: Vec<usize>,
    /// Row-major values, as many as the product of the shape.
    pub values: Vec<f32>,
}

/// Encodes weights: u32 count; per array u16 + name, u8 rank, u64 dimensions; then all values, little-endian, as `precision` says.
pub fn encode_weights(arrays: &[WeightArray], precision: WeightPrecision) -> Result<Vec<u8>> {
    let mut out = (arrays.len() as u32).to_le_bytes().to_vec();
    let mut names = BTreeSet::new();
    for array in arrays {
        let refuse = |problem: String| Err(Error::parameter(format!("weights '{}'", array.name), problem, "Correct the field's parameters()"));
        if array.name.is_empty() || array.name.len() > usize::from(u16::MAX) || array.name.chars().any(char::is_control) || !names.insert(array.name.as_str()) {
            return refuse("the name is empty, too long, not printable or taken".into());
        }
        if array.shape.len() > MAX_RANK || product(&array.shape) != Some(array.values.len()) {
            return refuse(format!("shape {:?} does not hold {} values", array.shape, array.values.len()));
        }
        if let Some(i) = array.values.iter().position(|v| !v.is_finite()) {
            return Err(Error::backend(
                format!("weights '{}'", array.name),
                format!("value {i} is {}", array.values[i]),
                "Training diverged; lower the learning rate",
            ));
        }
        out.extend((array.name.len() as u16).to_le_bytes());
        out.extend(array.name.as_bytes());
        out.push(array.shape.len() as u8);
        array.shape.iter().for_each(|&d| out.extend((d as u64).to_le_bytes()));
    }
    arrays.iter().try_for_each(|a| precision.write(&a.name, &a.values, &mut out))?;
    Ok(out)
}

/// Decodes what [`encode_weights`] wrote; `object` names the stream. Shapes must account for every byte, values must be finite.
pub fn decode_weights(object: &str, bytes: &[u8], precision: WeightPrecision, limits: &Limits) -> Result<Vec<WeightArray>> {
    limits.check_bytes(object, bytes.len() as u64)?;
    let mut reader = ByteReader::new(object, bytes);
    let count = reader.u32()?;
    let (mut arrays, mut names) = (Vec::new(), BTreeSet::new());
    for _ in 0..count {
        let name_len = usize::from(reader.u16()?);
        let name = reader.name(name_len)?;
        let rank = usize::from(reader.u8()?);
        if rank > MAX_RANK {
            return Err(reader.error(format!("weights '{name}' claim {rank} dimensions, over {MAX_RANK}")));
        }
        let shape = (0..rank).map(|_| reader.u64().map(|d| usize::try_from(d).unwrap_or(usize::MAX))).collect::<Result<Vec<_>>>()?;
        if !names.insert(name.clone()) {
            return Err(reader.error(format!("two arrays are called '{name}'")));
        }
        arrays.push(WeightArray { name, shape, values: Vec::new() });
    }
    for array in &mut arrays {
        let Some(length) = product(&array.shape).filter(|&n| n <= reader.remaining() && precision.bytes(n) <= reader.remaining()) else {
            return Err(reader.error(format!("weights '{}' of shape {:?} do not fit the {} bytes left", array.name, array.shape, reader.remaining())));
        };
        array.values = precision.read(&mut reader, length)?;
    }
    reader.finish()?;
    Ok(arrays)
}

fn product(shape: &[usize]) -> Option<usize> {
    shape.iter().try_fold(1usize, |a, &d| a.checked_mul(d))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arrays() -> Vec<WeightArray> {
        vec![
            WeightArray { name: "trunk.0.weight".into(), shape: vec![2, 3], values: vec![1.0, -2.5, 0.0, 3.0e-9, 7.0, -0.0] },
            WeightArray { name: "scalar".into(), shape: vec![], values: vec![4.0] },
            WeightArray { name: "empty".into(), shape: vec![0, 5], values: vec![] },
        ]
    }

    #[test]
    fn weights_round_trip() {
        let bytes = encode_weights(&arrays(), WeightPrecision::Fp32).unwrap();
        assert_eq!(decode_weights("t", &bytes, WeightPrecision::Fp32, &Limits::default()).unwrap(), arrays());
    }

    #[test]
    fn bad_weights_are_refused_on_both_sides() {
        let mut twice = arrays();
        twice[1].name = twice[0].name.clone();
        assert!(encode_weights(&twice, WeightPrecision::Fp32).is_err());
        let mut short = arrays();
        short[0].values.pop();
        assert!(encode_weights(&short, WeightPrecision::Fp32).is_err());
        let mut nan = arrays();
        nan[0].values[0] = f32::NAN;
        assert!(encode_weights(&nan, WeightPrecision::Fp32).is_err());
        let bytes = encode_weights(&arrays(), WeightPrecision::Fp32).unwrap();
        for n in 0..bytes.len() {
            assert!(decode_weights("t", &bytes[..n], WeightPrecision::Fp32, &Limits::default()).is_err(), "cut at {n}");
        }
        let mut lying = bytes;
        // The first dimension of the first array.
        lying[4 + 2 + 14 + 1 + 7] = 0xff;
        assert!(decode_weights("t", &lying, WeightPrecision::Fp32, &Limits::default()).is_err());
    }
}
