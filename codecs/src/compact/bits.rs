//! Bits in bytes, the lowest first.

/// Writes bits.
#[derive(Default)]
pub struct BitWriter {
    bytes: Vec<u8>,
    pending: u64,
    filled: u32,
}

impl BitWriter {
    /// Appends the low `count` (at most 56) bits of `value`, and returns them.
    #[inline]
    pub fn put(&mut self, count: u32, value: u64) -> u64 {
        let value = value & ((1 << count) - 1);
        self.pending |= value << self.filled;
        self.filled += count;
        while self.filled >= 8 {
            self.bytes.push(self.pending as u8);
            self.pending >>= 8;
            self.filled -= 8;
        }
        value
    }
    /// The bytes; the last is filled with zeros.
    pub fn finish(mut self) -> Vec<u8> {
        if self.filled > 0 {
            self.bytes.push(self.pending as u8);
        }
        self.bytes
    }
}

/// Reads what [`BitWriter`] wrote.
pub struct BitReader<'a> {
    bytes: &'a [u8],
    at: usize,
    /// Bits that were read from `bytes` and not taken; above `filled` there may be some that follow.
    pending: u64,
    filled: u32,
}

impl<'a> BitReader<'a> {
    pub fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0, pending: 0, filled: 0 }
    }
    /// The next `count` (at most 56) bits; `None` if there are fewer.
    #[inline(always)]
    pub fn take(&mut self, count: u32) -> Option<u64> {
        if self.filled < count {
            self.refill();
            if self.filled < count {
                return None;
            }
        }
        let value = self.pending & ((1 << count) - 1);
        self.pending >>= count;
        self.filled -= count;
        Some(value)
    }
    #[inline]
    fn refill(&mut self) {
        if let Some(word) = self.bytes.get(self.at..).and_then(|rest| rest.first_chunk::<8>()) {
            self.pending |= u64::from_le_bytes(*word) << self.filled;
            let taken = (63 - self.filled) / 8;
            self.at += taken as usize;
            self.filled += 8 * taken;
            return;
        }
        while let Some(&byte) = self.bytes.get(self.at).filter(|_| self.filled <= 56) {
            self.pending |= u64::from(byte) << self.filled;
            self.at += 1;
            self.filled += 8;
        }
    }
    /// Whether nothing but the zeros that fill the last byte is left.
    pub fn is_done(&self) -> bool {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        self.filled < 8 && rest.is_empty() && self.pending & ((1 << self.filled) - 1) == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_come_back_and_the_end_is_known() {
        let values: Vec<(u32, u64)> = (0..400u32).map(|i| (i * 7 % 57, u64::from(i) * 0x9e37_79b9_7f4a_7c15)).collect();
        let mut writer = BitWriter::default();
        let written: Vec<u64> = values.iter().map(|&(count, value)| writer.put(count, value)).collect();
        let bytes = writer.finish();
        let mut reader = BitReader::new(&bytes);
        for (&(count, _), value) in values.iter().zip(written) {
            assert!(!reader.is_done() || count == 0);
            assert_eq!(reader.take(count), Some(value));
        }
        assert!(reader.is_done());
        assert_eq!(reader.take(8), None);
    }
}
