//! Storage of the extra attributes of plug-ins as streams.
//!
//! A stream begins with a byte of flags. 1: only some rows are stored; the start value (f32) and a bitmask with a bit per Gaussian, lowest first, follow.
//! 2: values are quantised; u32 bytes of column forms, u32 bytes of escapes, both, and then the codes follow. Without 2, float32 columns follow.

use super::column::{Column, encode_within};
use super::streams::{StreamSet, from_planes, to_planes};
use super::{interleave, load, split, store};
use crate::archive::ByteReader;
use crate::{ExtraAttribute, HostGaussians, Result, Stream};

const SOME_ROWS: u8 = 1;
const QUANTISED: u8 = 2;

/// How an encoder stores extra attributes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Attributes {
    /// Every value bit for bit.
    Exact,
    /// In as few bytes as [`ExtraAttribute::tolerance`] and [`ExtraAttribute::needed`] allow.
    AsAllowed,
}

/// One stream per extra attribute, called `extra.NAME`. [`super::Shape::read_extra`] reads them back.
pub fn extra_streams(gaussians: &HostGaussians, how: Attributes) -> impl Iterator<Item = Stream> {
    gaussians.extra.iter().map(move |(name, attribute)| Stream { name: stream_name(name), bytes: encode(attribute, how) })
}

/// Name of the stream of the attribute `name`.
pub(super) fn stream_name(name: &str) -> String {
    format!("extra.{name}")
}

fn encode(attribute: &ExtraAttribute, how: Attributes) -> Vec<u8> {
    let width = attribute.width;
    let allowed = how == Attributes::AsAllowed;
    let needed = attribute.needed.as_ref().filter(|needed| allowed && needed.rows.contains(&false));
    let tolerance = attribute.tolerance.filter(|tolerance| allowed && *tolerance > 0.0);
    let mut out = vec![if needed.is_some() { SOME_ROWS } else { 0 } | if tolerance.is_some() { QUANTISED } else { 0 }];
    let values = match needed {
        None => attribute.values.clone(),
        Some(needed) => {
            out.extend(needed.start.to_le_bytes());
            out.extend(needed.rows.chunks(8).map(|rows| rows.iter().enumerate().fold(0u8, |byte, (bit, &row)| byte | u8::from(row) << bit)));
            let rows = attribute.values.chunks_exact(width.max(1)).zip(&needed.rows);
            rows.filter(|(_, needed)| **needed).flat_map(|(row, _)| row).copied().collect()
        }
    };
    match tolerance {
        None => out.extend(to_planes(&values, width)),
        Some(tolerance) => {
            let columns: Vec<Column> = split(&values, width).iter().map(|column| encode_within(column, tolerance)).collect();
            let (mut forms, mut escapes) = (Vec::new(), Vec::new());
            let codes = store(&columns, &mut forms, &mut escapes);
            for part in [&forms, &escapes] {
                out.extend((part.len() as u32).to_le_bytes());
            }
            out.extend([forms, escapes, codes].concat());
        }
    }
    out
}

/// Reads the attribute `name` of `width` floats for `count` Gaussians.
pub(super) fn decode(set: &StreamSet, name: &str, width: usize, count: usize) -> Result<ExtraAttribute> {
    let mut reader = set.reader(&stream_name(name))?;
    let flags = reader.u8()?;
    if flags & !(SOME_ROWS | QUANTISED) != 0 {
        return Err(reader.error(format!("unknown storage flags {flags} of attribute '{name}'")));
    }
    let needed = if flags & SOME_ROWS == 0 { None } else { Some((reader.f32()?, read_mask(&mut reader, count)?)) };
    let stored = needed.as_ref().map_or(count, |(_, rows)| rows.iter().filter(|row| **row).count());
    let values = if flags & QUANTISED == 0 {
        from_planes(reader, stored, width)?
    } else {
        let (forms_len, escapes_len) = (reader.u32()? as usize, reader.u32()? as usize);
        let object = format!("attribute '{name}'");
        let mut forms = ByteReader::new(format!("forms of {object}"), reader.take(forms_len)?);
        let mut escapes = ByteReader::new(format!("escapes of {object}"), reader.take(escapes_len)?);
        let columns = load(reader, stored, width, &mut forms, &mut escapes)?;
        forms.finish()?;
        escapes.finish()?;
        interleave(&columns, stored)
    };
    let Some((start, rows)) = needed else { return Ok(ExtraAttribute::exact(width, values)) };
    let mut all = vec![start; count * width];
    let needed_rows = all.chunks_exact_mut(width).zip(rows).filter(|(_, needed)| *needed);
    needed_rows.zip(values.chunks_exact(width)).for_each(|((row, _), stored)| row.copy_from_slice(stored));
    Ok(ExtraAttribute::exact(width, all))
}

fn read_mask(reader: &mut ByteReader, count: usize) -> Result<Vec<bool>> {
    let mask = reader.take(count.div_ceil(8))?;
    if !count.is_multiple_of(8) && mask.last().is_some_and(|last| last >> (count % 8) != 0) {
        return Err(reader.error(format!("the mask of stored rows has bits beyond {count} Gaussians")));
    }
    Ok((0..count).map(|i| mask[i / 8] >> (i % 8) & 1 == 1).collect())
}

#[cfg(test)]
mod tests {
    use super::super::Shape;
    use super::*;
    use crate::Limits;

    fn model(count: usize, attribute: ExtraAttribute) -> HostGaussians {
        let mut out = HostGaussians { opacity_logits: vec![0.0; count], ..Default::default() };
        out.extra.insert("a".into(), attribute);
        out
    }

    fn wave(count: usize, width: usize) -> ExtraAttribute {
        ExtraAttribute::exact(width, (0..count * width).map(|i| (i as f32 * 0.37).sin()).collect())
    }

    /// Bytes of the stream, and the decoded attribute.
    fn round_trip(attribute: &ExtraAttribute, count: usize, how: Attributes) -> (usize, ExtraAttribute) {
        let gaussians = model(count, attribute.clone());
        let streams: Vec<Stream> = extra_streams(&gaussians, how).collect();
        let mut out = HostGaussians::default();
        Shape::of(&gaussians).read_extra(&StreamSet::new("test", &streams), &mut out).unwrap();
        (streams[0].bytes.len(), out.extra.remove("a").unwrap())
    }

    #[test]
    fn nothing_is_lost_that_may_not_be() {
        let sparse = wave(101, 3).within(0.01).needed_in((0..101).map(|i| i % 4 == 1).collect(), 0.5);
        for attribute in [wave(101, 3), wave(0, 2), wave(1, 5)] {
            let count = attribute.values.len() / attribute.width;
            assert_eq!(round_trip(&attribute, count, Attributes::AsAllowed).1, attribute);
        }
        let (_, found) = round_trip(&sparse, 101, Attributes::Exact);
        assert_eq!(found.values, sparse.values, "all rows are stored in exact mode");
    }

    #[test]
    fn a_tolerance_and_unneeded_rows_save_bytes_and_are_kept_to() {
        let (exact, _) = round_trip(&wave(2000, 4), 2000, Attributes::AsAllowed);
        let attribute = wave(2000, 4).within(0.01);
        let (quantised, found) = round_trip(&attribute, 2000, Attributes::AsAllowed);
        assert!(found.values.iter().zip(&attribute.values).all(|(a, b)| (a - b).abs() <= 0.01));
        assert!(4 * quantised < exact + 1000, "{quantised} bytes of {exact}");

        let attribute = attribute.needed_in((0..2000).map(|i| i % 4 == 1).collect(), 0.5);
        let (sparse, found) = round_trip(&attribute, 2000, Attributes::AsAllowed);
        assert!(3 * sparse < quantised + 1000, "{sparse} bytes of {quantised}");
        for (i, (before, after)) in attribute.values.chunks_exact(4).zip(found.values.chunks_exact(4)).enumerate() {
            let expected = if i % 4 == 1 { before.to_vec() } else { vec![0.5; 4] };
            assert!(expected.iter().zip(after).all(|(a, b)| (a - b).abs() <= 0.01), "row {i}: {after:?}");
        }
    }

    #[test]
    fn a_tolerance_that_steps_cannot_keep_costs_exact_values() {
        let mut attribute = wave(500, 1).within(1e-9);
        attribute.values[7] = 1e6;
        assert_eq!(round_trip(&attribute, 500, Attributes::AsAllowed).1.values, attribute.values);
    }

    #[test]
    fn damaged_attributes_are_errors() {
        let attribute = wave(20, 2).within(0.01).needed_in((0..20).map(|i| i > 4).collect(), 0.0);
        let gaussians = model(20, attribute);
        let sound: Vec<Stream> = extra_streams(&gaussians, Attributes::AsAllowed).collect();
        let read = |bytes: Vec<u8>| {
            let streams = [Stream { name: stream_name("a"), bytes }];
            let mut out = HostGaussians { opacity_logits: vec![0.0; 20], ..Default::default() };
            Shape::of(&gaussians).read_extra(&StreamSet::new("test", &streams), &mut out).map(|()| out)
        };
        for cut in 0..sound[0].bytes.len() {
            assert!(read(sound[0].bytes[..cut].to_vec()).is_err(), "cut at {cut}");
            for bit in 0..8 {
                let mut flipped = sound[0].bytes.clone();
                flipped[cut] ^= 1 << bit;
                if let Ok(out) = read(flipped) {
                    assert!(out.extra["a"].values.len() == 40 && out.extra["a"].values.iter().all(|v| v.is_finite()));
                }
            }
        }
        let limits = Limits::default();
        let bad = model(20, wave(20, 2).needed_in(vec![true; 19], 0.0));
        assert!(bad.validate("t", &limits).is_err() && model(20, wave(20, 2).within(f32::NAN)).validate("t", &limits).is_err());
    }
}
