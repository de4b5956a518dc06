//! Names and shapes of a deformer's weights, checked by writers and readers.

use crate::archive::ByteReader;
use crate::{Error, Limits, Result, WeightArray};
use std::collections::BTreeSet;

/// Largest number of dimensions of a weight array.
const MAX_RANK: usize = 8;

/// Most weight arrays.
const MOST_ARRAYS: usize = 4096;

/// Appends u32 count; per array u16 + name, u8 rank, u64 dimensions. Refuses empty and duplicate names, shapes that do not match the values, and values
/// that are not finite.
///
/// # Errors
/// [`Error::Parameter`], and [`Error::Backend`] for values that are not finite.
pub fn write_shapes(arrays: &[WeightArray], out: &mut Vec<u8>) -> Result<()> {
    if arrays.len() > MOST_ARRAYS {
        let problem = format!("{} weight arrays, over the limit of {MOST_ARRAYS}", arrays.len());
        return Err(Error::parameter("Deformer::parameters()", problem, "Join arrays of one kind"));
    }
    out.extend((arrays.len() as u32).to_le_bytes());
    let mut names = BTreeSet::new();
    for array in arrays {
        let refuse = |problem: String| Err(Error::parameter(format!("weights '{}'", array.name), problem, "Correct Deformer::parameters()"));
        if array.name.is_empty() || array.name.len() > usize::from(u16::MAX) || array.name.chars().any(char::is_control) || !names.insert(array.name.as_str()) {
            return refuse("the name is empty, too long, not printable or not unique".into());
        }
        if array.shape.len() > MAX_RANK || value_count(&array.shape) != Some(array.values.len()) {
            return refuse(format!("shape {:?} does not match {} values", array.shape, array.values.len()));
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
    Ok(())
}

/// Reads what [`write_shapes`] wrote; `values` are empty. As float32, the values of all arrays are within `limits`.
///
/// # Errors
/// [`Error::Data`], [`Error::Limit`].
pub fn read_shapes(reader: &mut ByteReader, limits: &Limits) -> Result<Vec<WeightArray>> {
    let count = reader.u32()?;
    if count as usize > MOST_ARRAYS {
        return Err(reader.error(format!("{count} weight arrays, over the limit of {MOST_ARRAYS}")));
    }
    let (mut arrays, mut names) = (Vec::new(), BTreeSet::new());
    for _ in 0..count {
        let name_len = usize::from(reader.u16()?);
        let name = reader.name(name_len)?;
        let rank = usize::from(reader.u8()?);
        if rank > MAX_RANK {
            return Err(reader.error(format!("weights '{name}' have {rank} dimensions, over the limit of {MAX_RANK}")));
        }
        let shape = (0..rank).map(|_| reader.u64().map(|d| usize::try_from(d).unwrap_or(usize::MAX))).collect::<Result<Vec<_>>>()?;
        if !names.insert(name.clone()) {
            return Err(reader.error(format!("two arrays are called '{name}'")));
        }
        arrays.push(WeightArray { name, shape, values: Vec::new() });
    }
    let total = arrays.iter().try_fold(0usize, |sum, array| sum.checked_add(value_count(&array.shape)?));
    let Some(total) = total else { return Err(reader.error("the arrays do not fit into memory")) };
    limits.check_bytes("deformer weights", 4u64.saturating_mul(total as u64))?;
    Ok(arrays)
}

/// The product of `shape`; `None` if the values do not fit into memory.
pub fn value_count(shape: &[usize]) -> Option<usize> {
    shape.iter().try_fold(1usize, |count, &dimension| count.checked_mul(dimension))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_come_back_and_bad_ones_are_refused() {
        let array = |name: &str, shape: &[usize], values: &[f32]| WeightArray { name: name.into(), shape: shape.into(), values: values.into() };
        let sound = [array("trunk.0.weight", &[2, 3], &[1.0; 6]), array("scalar", &[], &[4.0]), array("empty", &[0, 5], &[])];
        let (mut bytes, limits) = (Vec::new(), Limits::default());
        write_shapes(&sound, &mut bytes).unwrap();
        let found = read_shapes(&mut ByteReader::new("t", &bytes), &limits).unwrap();
        assert!(found.iter().zip(&sound).all(|(a, b)| a.name == b.name && a.shape == b.shape));
        for cut in 0..bytes.len() {
            assert!(read_shapes(&mut ByteReader::new("t", &bytes[..cut]), &limits).is_err(), "cut at {cut}");
        }
        // Seven values are 28 bytes.
        for (most, refused) in [(28, false), (27, true)] {
            let limits = Limits { max_bytes: most, ..limits };
            assert_eq!(matches!(read_shapes(&mut ByteReader::new("t", &bytes), &limits), Err(Error::Limit { .. })), refused);
        }
        let many = (MOST_ARRAYS as u32 + 1).to_le_bytes();
        assert!(matches!(read_shapes(&mut ByteReader::new("t", &many), &limits), Err(Error::Data { .. })));
        let bad = [
            [array("a", &[1], &[0.0]), array("a", &[1], &[0.0])],
            [array("a", &[2], &[0.0]), array("b", &[1], &[0.0])],
            [array("a", &[1], &[f32::NAN]), array("b", &[1], &[0.0])],
            [array("", &[1], &[0.0]), array("b", &[1], &[0.0])],
        ];
        assert!(bad.iter().all(|arrays| write_shapes(arrays, &mut Vec::new()).is_err()));
        assert_eq!(value_count(&[usize::MAX, 2]), None);
    }
}
