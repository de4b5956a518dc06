//! Rows in blocks that are coded independently of each other, so that they can be coded in parallel. Blocks of a stream share its distributions; each layer has
//! a stream of its own.

use super::entropy::{Decoder, Encoder, Tables};
use super::layers;
use cc4dgs_format::storage::StreamSet;
use cc4dgs_format::{Error, Result, Stream};
use rayon::prelude::*;
use std::ops::Range;

/// Rows of a block. Predictions start anew in each.
pub const ROWS: usize = 1 << 14;

/// The rows of each block of a layer.
fn ranges(layer: &Range<usize>) -> impl Iterator<Item = Range<usize>> + use<> {
    let layer = layer.clone();
    (0..layer.len().div_ceil(ROWS)).map(move |i| layer.start + i * ROWS..layer.end.min(layer.start + (i + 1) * ROWS))
}

/// The streams `name` of all `layers` (ranges of rows), whose blocks of up to [`ROWS`] rows `code` codes in `contexts` contexts: the u32 length of the
/// distributions, those, the u32 lengths of all blocks but the last, then the blocks.
pub fn encode(name: &str, contexts: usize, layers: &[Range<usize>], code: impl Fn(&mut Encoder, Range<usize>) -> Result<()> + Sync) -> Result<Vec<Stream>> {
    let note = |range: Range<usize>| {
        let mut encoder = Encoder::default();
        code(&mut encoder, range)?;
        Ok(encoder)
    };
    let stream = |(index, layer): (usize, &Range<usize>)| {
        let ranges: Vec<Range<usize>> = ranges(layer).collect();
        let encoders = ranges.into_par_iter().map(note).collect::<Result<Vec<Encoder>>>()?;
        let (tables, stored) = Tables::fit(contexts, &encoders);
        let blocks = encoders.into_par_iter().map(|encoder| encoder.finish(&tables)).collect::<Result<Vec<Vec<u8>>>>()?;
        let mut bytes = (stored.len() as u32).to_le_bytes().to_vec();
        bytes.extend(stored);
        bytes.extend(blocks.iter().rev().skip(1).rev().flat_map(|b| (b.len() as u32).to_le_bytes()));
        blocks.into_iter().for_each(|b| bytes.extend(b));
        Ok(Stream { name: layers::stream(name, index), bytes })
    };
    layers.iter().enumerate().map(stream).collect()
}

/// A block of a layer's stream.
struct Block<'a> {
    rows: Range<usize>,
    /// Index of the layer's distributions.
    tables: usize,
    bytes: &'a [u8],
}

/// Streams of [`encode`], taken apart.
pub struct Blocks<'a> {
    object: String,
    tables: Vec<Tables>,
    blocks: Vec<Block<'a>>,
}

impl<'a> Blocks<'a> {
    /// Takes the streams `name` of `layers` apart.
    pub fn read(set: &StreamSet<'a>, name: &str, contexts: usize, layers: &[Range<usize>]) -> Result<Self> {
        let mut out = Self { object: name.into(), tables: Vec::with_capacity(layers.len()), blocks: Vec::new() };
        for (index, layer) in layers.iter().enumerate() {
            let object = layers::stream(name, index);
            let mut stream = set.reader(&object)?;
            let length = stream.u32()? as usize;
            out.tables.push(Tables::read(&object, contexts, stream.take(length)?)?);
            let number = layer.len().div_ceil(ROWS);
            let mut lengths = (1..number).map(|_| Ok(stream.u32()? as usize)).collect::<Result<Vec<usize>>>()?;
            if number > 0 {
                let rest = lengths.iter().try_fold(stream.remaining(), |left, &length| left.checked_sub(length));
                lengths.push(rest.ok_or_else(|| stream.error("its blocks are longer than the stream"))?);
            }
            for (rows, length) in ranges(layer).zip(lengths) {
                out.blocks.push(Block { rows, tables: index, bytes: stream.take(length)? });
            }
            stream.finish()?;
        }
        Ok(out)
    }
    /// Reads the block `index` with `code`, which must leave nothing over.
    pub fn decode<T>(&self, index: usize, code: impl FnOnce(&mut Decoder) -> Result<T>) -> Result<T> {
        let found = self.blocks.get(index).and_then(|block| Some((self.tables.get(block.tables)?, block.bytes)));
        let (tables, bytes) =
            found.ok_or_else(|| Error::data(&self.object, format!("block {index} is missing"), "The file is damaged; fetch or write it again"))?;
        let mut decoder = Decoder::new(&self.object, tables, bytes)?;
        let value = code(&mut decoder)?;
        decoder.finish()?;
        Ok(value)
    }
    /// Reads all blocks in parallel into `values` `[N,width]`.
    pub fn decode_into<T: Send>(&self, values: &mut [T], width: usize, code: impl Fn(&mut Decoder, Range<usize>, &mut [T]) -> Result<()> + Sync) -> Result<()> {
        let mut left = values;
        let mut parts = Vec::with_capacity(self.blocks.len());
        for block in &self.blocks {
            let (part, rest) = left.split_at_mut(width * block.rows.len());
            parts.push(part);
            left = rest;
        }
        parts.into_par_iter().enumerate().try_for_each(|(index, part)| self.decode(index, |decoder| code(decoder, self.blocks[index].rows.clone(), part)))
    }
}
