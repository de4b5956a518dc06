//! Rows in blocks that are coded independently of each other, so that they can be coded in parallel. Blocks of a stream share its distributions.

use super::entropy::{Decoder, Encoder, Tables};
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::{Result, Stream};
use rayon::prelude::*;
use std::ops::Range;

/// Rows of a block. Predictions start anew in each.
pub const ROWS: usize = 1 << 14;

/// The rows of each block.
pub fn ranges(count: usize) -> impl Iterator<Item = Range<usize>> {
    (0..count.div_ceil(ROWS)).map(move |i| i * ROWS..count.min((i + 1) * ROWS))
}

/// A stream of one block per range, each coded by `code` in `contexts` contexts: the u32 length of the distributions, those, the u32 lengths of all blocks but
/// the last, then the blocks.
pub fn encode(name: impl Into<String>, contexts: usize, count: usize, code: impl Fn(&mut Encoder, Range<usize>) -> Result<()> + Sync) -> Result<Stream> {
    let note = |range: Range<usize>| {
        let mut encoder = Encoder::default();
        code(&mut encoder, range)?;
        Ok(encoder)
    };
    let ranges: Vec<Range<usize>> = ranges(count).collect();
    let encoders = ranges.into_par_iter().map(note).collect::<Result<Vec<Encoder>>>()?;
    let (tables, stored) = Tables::fit(contexts, &encoders);
    let blocks = encoders.into_par_iter().map(|encoder| encoder.finish(&tables)).collect::<Result<Vec<Vec<u8>>>>()?;
    let mut bytes = (stored.len() as u32).to_le_bytes().to_vec();
    bytes.extend(stored);
    bytes.extend(blocks.iter().rev().skip(1).rev().flat_map(|b| (b.len() as u32).to_le_bytes()));
    blocks.into_iter().for_each(|b| bytes.extend(b));
    Ok(Stream { name: name.into(), bytes })
}

/// A stream of [`encode`], taken apart.
pub struct Blocks<'a> {
    object: String,
    tables: Tables,
    blocks: Vec<&'a [u8]>,
}

impl<'a> Blocks<'a> {
    /// Takes the stream `object` of `count` rows apart.
    pub fn read(object: impl Into<String>, mut stream: ByteReader<'a>, contexts: usize, count: usize) -> Result<Self> {
        let object = object.into();
        let length = stream.u32()? as usize;
        let tables = Tables::read(&object, contexts, stream.take(length)?)?;
        let number = count.div_ceil(ROWS);
        let mut lengths = (1..number).map(|_| Ok(stream.u32()? as usize)).collect::<Result<Vec<usize>>>()?;
        if number > 0 {
            let rest = lengths.iter().try_fold(stream.remaining(), |left, &length| left.checked_sub(length));
            lengths.push(rest.ok_or_else(|| stream.error("its blocks are longer than the stream"))?);
        }
        let blocks = lengths.into_iter().map(|length| stream.take(length)).collect::<Result<Vec<&[u8]>>>()?;
        stream.finish()?;
        Ok(Self { object, tables, blocks })
    }
    /// Reads the block `index` with `code`, which must leave nothing over.
    pub fn decode<T>(&self, index: usize, code: impl FnOnce(&mut Decoder) -> Result<T>) -> Result<T> {
        let mut decoder = Decoder::new(&self.object, &self.tables, self.blocks.get(index).copied().unwrap_or_default())?;
        let value = code(&mut decoder)?;
        decoder.finish()?;
        Ok(value)
    }
    /// Reads all blocks in parallel into `values` `[N,width]`.
    pub fn decode_into<T: Send>(&self, values: &mut [T], width: usize, code: impl Fn(&mut Decoder, Range<usize>, &mut [T]) -> Result<()> + Sync) -> Result<()> {
        let block = |(index, values): (usize, &mut [T])| {
            let start = index * ROWS;
            self.decode(index, |decoder| code(decoder, start..start + values.len() / width, values))
        };
        values.par_chunks_mut(ROWS * width).enumerate().try_for_each(block)
    }
}
