//! NumPy arrays of floats from bytes that may be hostile.

use cc4dgs_core::{Error, Limits, Result};
use npyz::{DType, NpyFile, Order};

/// A float array as stored in a `.npy` file, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct NpyArray {
    /// Extent of each axis.
    pub shape: Vec<usize>,
    /// Values in row-major order.
    pub values: Vec<f64>,
}

/// The longest header text accepted; NumPy's own are under 200 bytes.
const MAX_HEADER_BYTES: usize = 4096;

/// Reads an array of `<f4`, `<f8` (or big-endian) values in C order; `object` names the source in errors.
///
/// Errors: [`Error::Data`] for anything malformed, [`Error::Limit`] for arrays over `limits.max_bytes`. Nothing is allocated for a claim the bytes do not
/// cover.
pub fn read_npy(object: &str, bytes: &[u8], limits: &Limits) -> Result<NpyArray> {
    let bad = |problem: String| Error::data(object, problem, "Save it again with numpy.save, as float32 or float64 in C order");
    check_header(bytes).map_err(bad)?;
    let file = NpyFile::new(bytes).map_err(|e| bad(format!("not an npy file: {e}")))?;
    if file.order() != Order::C {
        return Err(bad("the array is in Fortran order".into()));
    }
    let DType::Plain(kind) = file.dtype() else { return Err(bad("it holds records".into())) };
    let width = kind.num_bytes().unwrap_or(0);
    let name = kind.to_string();
    let mut count = 1u64;
    for &extent in file.shape() {
        count = count.checked_mul(extent).ok_or_else(|| bad(format!("shape {:?} overflows", file.shape())))?;
    }
    limits.check_bytes(object, count.saturating_mul(8))?;
    if count.saturating_mul(width as u64) > bytes.len() as u64 {
        return Err(bad(format!("shape {:?} needs {} bytes, the file has {}", file.shape(), count.saturating_mul(width as u64), bytes.len())));
    }
    let shape = file.shape().iter().map(|&v| v as usize).collect();
    let short = |e: std::io::Error| bad(format!("the data ends early: {e}"));
    let values: Vec<f64> = match name.get(1..) {
        Some("f8") => file.into_vec::<f64>().map_err(short)?,
        Some("f4") => file.into_vec::<f32>().map_err(short)?.into_iter().map(f64::from).collect(),
        _ => return Err(bad(format!("its type is {name}"))),
    };
    Ok(NpyArray { shape, values })
}

/// Refuses headers the parser behind could overflow on: long text, deep nesting, numbers whose product leaves 64 bits.
fn check_header(bytes: &[u8]) -> Result<(), String> {
    if bytes.len() < 10 || &bytes[..6] != b"\x93NUMPY" {
        return Err("the npy magic is missing".into());
    }
    let (start, length) = match bytes[6] {
        1 => (10, usize::from(u16::from_le_bytes([bytes[8], bytes[9]]))),
        _ if bytes.len() >= 12 => (12, u32::from_le_bytes([bytes[8], bytes[9], bytes[10], bytes[11]]) as usize),
        _ => return Err("the header is cut off".into()),
    };
    if length > MAX_HEADER_BYTES {
        return Err(format!("the header claims {length} bytes, more than {MAX_HEADER_BYTES}"));
    }
    let Some(text) = bytes.get(start..start + length) else { return Err(format!("the header claims {length} bytes, the file has {}", bytes.len())) };
    let digits = text.iter().filter(|b| b.is_ascii_digit()).count();
    let brackets = text.iter().filter(|b| b"([{".contains(b)).count();
    let radix = text.windows(2).any(|w| w[0] == b'0' && b"xXoObB".contains(&w[1]));
    if digits > 18 || brackets > 6 || radix || !text.is_ascii() {
        return Err("the header is not one numpy.save writes".into());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn npy(header: &str, data: &[u8]) -> Vec<u8> {
        let mut out = b"\x93NUMPY\x01\x00".to_vec();
        out.extend((header.len() as u16).to_le_bytes());
        out.extend(header.as_bytes());
        out.extend(data);
        out
    }

    #[test]
    fn both_float_widths_are_read() {
        let data: Vec<u8> = [1.5f32, -2.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        let array = read_npy("t", &npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1, 2), }\n", &data), &Limits::default()).unwrap();
        assert_eq!((array.shape, array.values), (vec![1, 2], vec![1.5, -2.0]));
    }

    #[test]
    fn lies_are_errors() {
        let limits = Limits::default();
        for header in [
            "{'descr': '<f8', 'fortran_order': False, 'shape': (999999999, 99999999), }",
            "{'descr': '<f8', 'fortran_order': False, 'shape': (4294967296, 4294967296, 16), }",
            "{'descr': '<f8', 'fortran_order': True, 'shape': (1, 1), }",
            "{'descr': '<i8', 'fortran_order': False, 'shape': (1,), }",
            "{'descr': '<f8', 'fortran_order': False, 'shape': (0xFFFFFFFFFFFFFFFF, 2), }",
            "((((((((((((((((((((((((((((((((((((((((((((((((((((((((",
            "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,), }",
        ] {
            assert!(read_npy("t", &npy(header, &[0; 8]), &limits).is_err(), "{header}");
        }
        assert!(read_npy("t", b"\x93NUMPY\x02\x00\xff\xff\xff\xff", &limits).is_err());
    }
}
