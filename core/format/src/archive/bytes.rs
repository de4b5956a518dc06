//! Reading of little-endian values from untrusted bytes.

use crate::{Error, Result};

/// A cursor over untrusted bytes. Reading past the end is an error that names the object and the byte offset.
#[derive(Clone, Debug)]
pub struct ByteReader<'a> {
    object: String,
    bytes: &'a [u8],
    at: usize,
}

impl<'a> ByteReader<'a> {
    /// A cursor at the start of `bytes`; `object` names them in errors.
    pub fn new(object: impl Into<String>, bytes: &'a [u8]) -> Self {
        Self { object: object.into(), bytes, at: 0 }
    }
    /// The bytes not read yet.
    pub fn remaining(&self) -> usize {
        self.bytes.len() - self.at
    }
    /// An error about what is being read.
    pub fn error(&self, problem: impl Into<String>) -> Error {
        Error::data(self.object.clone(), problem, "The file is damaged; fetch or write it again")
    }
    /// The next `count` bytes.
    pub fn take(&mut self, count: usize) -> Result<&'a [u8]> {
        if count > self.remaining() {
            return Err(self.error(format!("{count} bytes expected at byte {}, {} are left", self.at, self.remaining())));
        }
        let out = &self.bytes[self.at..self.at + count];
        self.at += count;
        Ok(out)
    }
    fn array<const N: usize>(&mut self) -> Result<[u8; N]> {
        let mut out = [0u8; N];
        out.copy_from_slice(self.take(N)?);
        Ok(out)
    }
    /// The next byte.
    pub fn u8(&mut self) -> Result<u8> {
        Ok(self.array::<1>()?[0])
    }
    /// The next 16-bit number.
    pub fn u16(&mut self) -> Result<u16> {
        Ok(u16::from_le_bytes(self.array()?))
    }
    /// The next 32-bit number.
    pub fn u32(&mut self) -> Result<u32> {
        Ok(u32::from_le_bytes(self.array()?))
    }
    /// The next 64-bit number.
    pub fn u64(&mut self) -> Result<u64> {
        Ok(u64::from_le_bytes(self.array()?))
    }
    /// The next float, which must be finite.
    pub fn f32(&mut self) -> Result<f32> {
        let value = f32::from_le_bytes(self.array()?);
        if value.is_finite() { Ok(value) } else { Err(self.error(format!("the number at byte {} is {value}", self.at - 4))) }
    }
    /// The next `count` floats, all finite.
    pub fn f32s(&mut self, count: usize) -> Result<Vec<f32>> {
        let Some(bytes) = count.checked_mul(4) else {
            return Err(self.error(format!("{count} floats do not fit into memory")));
        };
        let start = self.at;
        let values: Vec<f32> = self.take(bytes)?.chunks_exact(4).map(|c| f32::from_le_bytes([c[0], c[1], c[2], c[3]])).collect();
        match values.iter().position(|v| !v.is_finite()) {
            Some(i) => Err(self.error(format!("the number at byte {} is {}", start + 4 * i, values[i]))),
            None => Ok(values),
        }
    }
    /// The next `length` bytes as a name: UTF-8 without control characters, not empty.
    pub fn name(&mut self, length: usize) -> Result<String> {
        let bytes = self.take(length)?;
        match std::str::from_utf8(bytes) {
            Ok(name) if !name.is_empty() && !name.chars().any(char::is_control) => Ok(name.to_string()),
            _ => Err(self.error(format!("the name at byte {} is not printable text", self.at - length))),
        }
    }
    /// All remaining bytes.
    pub fn rest(self) -> &'a [u8] {
        &self.bytes[self.at..]
    }
    /// Refuses remaining bytes.
    ///
    /// # Errors
    /// [`Error::Data`].
    pub fn finish(self) -> Result<()> {
        if self.remaining() == 0 { Ok(()) } else { Err(self.error(format!("{} bytes follow the end", self.remaining()))) }
    }
}
