//! Layers: a player draws the most important Gaussians while the others arrive.

use super::attributes::CODED;
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::{Result, StreamStage};
use rayon::prelude::*;
use std::ops::Range;

/// Layers that a file may have.
pub const MOST: usize = 6;
/// Layers of a large model, and the Gaussians from which it is large: every layer has distributions of its own, and neighbours in space are farther apart in
/// it.
const LAYERS: usize = 3;
const LARGE: usize = 1 << 17;

/// How many layers `count` Gaussians get; `wanted` is the setting, 0 by their number.
pub fn number(wanted: usize, count: usize) -> usize {
    let chosen = match wanted {
        0 if count < LARGE => 1,
        0 => LAYERS,
        wanted => wanted,
    };
    chosen.clamp(1, MOST).min(count.max(1))
}

/// The layer of each Gaussian, and how many each has. The last has the half with the smallest weights, the one before the next quarter, and so on.
pub fn assign(weights: &[f64], number: usize) -> (Vec<u8>, Vec<usize>) {
    let mut order: Vec<usize> = (0..weights.len()).collect();
    order.par_sort_unstable_by(|&a, &b| weights[b].total_cmp(&weights[a]).then(a.cmp(&b)));
    let (mut out, sizes) = (vec![0; weights.len()], sizes_of(weights.len(), number));
    for (layer, rows) in ranges(&sizes).into_iter().enumerate() {
        order[rows].iter().for_each(|&i| out[i] = layer as u8);
    }
    (out, sizes)
}

fn sizes_of(count: usize, number: usize) -> Vec<usize> {
    let mut left = count;
    let mut out: Vec<usize> = Vec::with_capacity(number);
    for after in (0..number).rev() {
        let size = if after == 0 { left } else { left.div_ceil(2) };
        out.push(size);
        left -= size;
    }
    // The first and the second are as large as each other, each of the others as all before it.
    out.reverse();
    out
}

/// The rows of layers of these sizes.
pub fn ranges(sizes: &[usize]) -> Vec<Range<usize>> {
    let mut start = 0;
    let next = |size: &usize| {
        start += size;
        start - size..start
    };
    sizes.iter().map(next).collect()
}

/// The stream `name` of a layer.
pub fn stream(name: &str, layer: usize) -> String {
    if layer == 0 { name.into() } else { format!("{name}.{layer}") }
}

/// Appends the number of layers, and the Gaussians of each but the last.
pub fn write(sizes: &[usize], meta: &mut Vec<u8>) {
    meta.push(sizes.len() as u8);
    sizes.iter().rev().skip(1).rev().for_each(|&size| meta.extend((size as u64).to_le_bytes()));
}

/// Reads the sizes of layers of `count` Gaussians.
pub fn read(meta: &mut ByteReader, count: usize) -> Result<Vec<usize>> {
    let number = usize::from(meta.u8()?);
    if !(1..=MOST).contains(&number) {
        return Err(meta.error(format!("{number} layers are not 1 to {MOST}")));
    }
    let mut left = count;
    let mut out = Vec::with_capacity(number);
    for _ in 1..number {
        let size = meta.u64()?;
        let fits = usize::try_from(size).ok().filter(|size| *size <= left);
        out.push(fits.ok_or_else(|| meta.error(format!("a layer of {size} Gaussians where {left} are left")))?);
        left -= out[out.len() - 1];
    }
    out.push(left);
    Ok(out)
}

/// When a player needs a stream: harmonics last, one degree after the other, extra attributes after all layers, what all layers share first.
pub fn stage(name: &str) -> StreamStage {
    let number = |after: &str| after.parse::<u8>().ok();
    if let Some(degree) = name.strip_prefix("sh.").and_then(number).filter(|degree| *degree > 0) {
        return StreamStage::Harmonics(degree);
    }
    if name.starts_with("extra.") || name.strip_prefix(CODED).is_some_and(|rest| rest.is_empty() || rest.starts_with('.')) {
        return StreamStage::BASE;
    }
    // Not the 0 of `sh.0`.
    StreamStage::Layer(name.rsplit_once('.').and_then(|(_, layer)| number(layer)).unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_important_come_first() {
        assert_eq!((number(0, 1000), number(0, 200_000), number(5, 3), number(9, 1000)), (1, 3, 3, 6));
        let weights: Vec<f64> = (0..100).map(|i| f64::from(i * 37 % 100)).collect();
        let (layers, sizes) = assign(&weights, 3);
        assert_eq!(sizes, [25, 25, 50]);
        let of = |layer: u8| layers.iter().zip(&weights).filter(move |(l, _)| **l == layer).map(|(_, w)| *w);
        assert_eq!((of(0).count(), of(1).count(), of(2).count()), (25, 25, 50));
        assert!(of(0).fold(f64::INFINITY, f64::min) > of(1).fold(0.0, f64::max) && of(1).fold(f64::INFINITY, f64::min) > of(2).fold(0.0, f64::max));
        assert_eq!(assign(&weights, 1), (vec![0; 100], vec![100]));
        assert_eq!(assign(&[], 1), (vec![], vec![0]));
        assert_eq!(ranges(&[2, 0, 3]), [0..2, 2..2, 2..5]);
    }

    #[test]
    fn sizes_come_back_and_impossible_ones_are_refused() {
        let mut bytes = Vec::new();
        write(&[25, 25, 50], &mut bytes);
        assert_eq!(read(&mut ByteReader::new("t", &bytes), 100).unwrap(), [25, 25, 50]);
        assert!(read(&mut ByteReader::new("t", &bytes), 49).is_err(), "more than there are");
        assert!(read(&mut ByteReader::new("t", &bytes[..9]), 100).is_err(), "cut");
        for number in [0, MOST as u8 + 1, 255] {
            assert!(read(&mut ByteReader::new("t", &[number]), 100).is_err(), "{number} layers");
        }
    }

    #[test]
    fn streams_come_in_the_order_of_their_stages() {
        let stages = ["meta", "exact", "means", "sh.0", "means.1", "sh.0.1", "sh.0.5", "extra.a.3", "coded", "coded.a.1", "sh.1", "sh.4"].map(stage);
        let layers = [0, 0, 0, 0, 1, 1, 5].map(StreamStage::Layer);
        assert_eq!(stages[..7], layers);
        assert_eq!(stages[7..], [[StreamStage::BASE; 3].as_slice(), &[1, 4].map(StreamStage::Harmonics)].concat());
        assert!(stages.is_sorted());
    }
}
