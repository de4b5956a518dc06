//! Rows in blocks that are coded independently of each other, so that they can be coded in parallel.

use super::entropy::{Decoder, Encoder};
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::{Result, Stream};
use rayon::prelude::*;
use std::ops::Range;

/// Rows of a block. Models start anew in each.
const ROWS: usize = 1 << 16;

/// The rows of each block.
pub fn ranges(count: usize) -> Vec<Range<usize>> {
    (0..count.div_ceil(ROWS)).map(|i| i * ROWS..count.min((i + 1) * ROWS)).collect()
}

/// A stream of one block per range, each coded by `code`: the u32 lengths of all blocks but the last, then the blocks.
pub fn encode(name: impl Into<String>, count: usize, code: impl Fn(&mut Encoder, Range<usize>) -> Result<()> + Sync) -> Result<Stream> {
    let block = |range: Range<usize>| {
        let mut encoder = Encoder::default();
        code(&mut encoder, range)?;
        Ok(encoder.finish())
    };
    let blocks = ranges(count).into_par_iter().map(block).collect::<Result<Vec<Vec<u8>>>>()?;
    let mut bytes: Vec<u8> = blocks.iter().rev().skip(1).rev().flat_map(|b| (b.len() as u32).to_le_bytes()).collect();
    blocks.into_iter().for_each(|b| bytes.extend(b));
    Ok(Stream { name: name.into(), bytes })
}

/// What `code` reads from each block of the stream `object`, in order of the rows.
pub fn decode<T: Send>(object: &str, mut stream: ByteReader, count: usize, code: impl Fn(&mut Decoder, Range<usize>) -> Result<T> + Sync) -> Result<Vec<T>> {
    let ranges = ranges(count);
    let mut lengths = (1..ranges.len()).map(|_| Ok(stream.u32()? as usize)).collect::<Result<Vec<usize>>>()?;
    if !ranges.is_empty() {
        let rest = lengths.iter().try_fold(stream.remaining(), |left, &length| left.checked_sub(length));
        lengths.push(rest.ok_or_else(|| stream.error("its blocks are longer than the stream"))?);
    }
    let blocks = lengths.into_iter().map(|length| stream.take(length)).collect::<Result<Vec<&[u8]>>>()?;
    stream.finish()?;
    let block = |(bytes, range): (&[u8], Range<usize>)| {
        let mut decoder = Decoder::new(object, bytes)?;
        let value = code(&mut decoder, range)?;
        decoder.finish()?;
        Ok(value)
    };
    blocks.into_par_iter().zip(ranges).map(block).collect()
}
