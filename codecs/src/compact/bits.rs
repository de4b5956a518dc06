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
    /// Bits that were taken.
    at: usize,
}

impl<'a> BitReader<'a> {
    pub fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }
    /// The next `count` (at most 56) bits; `None` if there are fewer.
    #[inline(always)]
    pub fn take(&mut self, count: u32) -> Option<u64> {
        let (first, end) = (self.at / 8, self.at + count as usize);
        let word = match self.bytes.get(first..).and_then(|rest| rest.first_chunk::<8>()) {
            Some(word) => u64::from_le_bytes(*word),
            None => self.last_word(first, end)?,
        };
        let value = word >> (self.at % 8) & ((1 << count) - 1);
        self.at = end;
        Some(value)
    }
    /// The last bytes, from `first`; `None` if bits before `end` are missing.
    #[cold]
    fn last_word(&self, first: usize, end: usize) -> Option<u64> {
        let mut word = [0; 8];
        word.iter_mut().zip(self.bytes.get(first..)?).for_each(|(to, from)| *to = *from);
        (end <= 8 * self.bytes.len()).then_some(u64::from_le_bytes(word))
    }
    /// Whether nothing but the zeros that fill the last byte is left.
    pub fn is_done(&self) -> bool {
        let left = (8 * self.bytes.len()).saturating_sub(self.at);
        left < 8 && self.bytes.last().is_none_or(|last| u32::from(*last) >> (8 - left) == 0)
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
