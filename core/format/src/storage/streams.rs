//! The common structure of codecs: the set of streams, and the `meta` stream that every decoder reads and checks first.

use super::extra::{self, Attributes, extra_streams};
use crate::archive::ByteReader;
use crate::gaussians::sh_rest_len;
use crate::{Error, HostGaussians, Limits, Result, Stream, StreamStage};
use std::collections::BTreeMap;

/// The stream that describes the others.
pub const META: &str = "meta";

/// The stream with the values outside the range of their quantiser.
pub const ESCAPES: &str = "escapes";

/// The column of colour coefficients of degree 1 and up.
pub const HARMONICS: &str = "sh_rest";

/// [`crate::AttributeCodec::stage`] of codecs that store this column in a stream of its name, and in others whose names begin with it and a dot.
pub fn stage_of_column(name: &str) -> StreamStage {
    let harmonics = name.strip_prefix(HARMONICS).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
    if harmonics { StreamStage::WHOLE } else { StreamStage::Layer(0) }
}

/// The streams of a decoder, by name.
pub struct StreamSet<'a> {
    codec: &'static str,
    streams: BTreeMap<&'a str, &'a [u8]>,
}

impl<'a> StreamSet<'a> {
    /// The streams of a decoder; `codec` is the name in errors.
    pub fn new(codec: &'static str, streams: &'a [Stream]) -> Self {
        Self { codec, streams: streams.iter().map(|stream| (stream.name.as_str(), stream.bytes.as_slice())).collect() }
    }
    /// Whether there is a stream `name`.
    pub fn has(&self, name: &str) -> bool {
        self.streams.contains_key(name)
    }
    /// A reader over the stream `name`.
    ///
    /// # Errors
    /// [`Error::Data`] if there is no such stream.
    pub fn reader(&self, name: &str) -> Result<ByteReader<'a>> {
        match self.streams.get(name) {
            Some(bytes) => Ok(ByteReader::new(format!("{} stream '{name}'", self.codec), bytes)),
            None => Err(Error::data(format!("{} stream '{name}'", self.codec), "it is missing", "The file is damaged or another codec wrote it")),
        }
    }
}

/// The first step of every decoder: returns the streams by name, the meta stream after version and shape, and the shape.
///
/// # Errors
/// [`Error::Unsupported`] for another version, [`Error::Data`] for invalid streams, [`Error::Limit`].
pub fn open<'a>(codec: &'static str, streams: &'a [Stream], version: u8, limits: &Limits) -> Result<(StreamSet<'a>, ByteReader<'a>, Shape)> {
    let set = StreamSet::new(codec, streams);
    let mut meta = set.reader(META)?;
    let found = meta.u8()?;
    if found != version {
        return Err(Error::unsupported(format!("{codec} streams"), format!("version {found} is not {version}"), "Use a release of cc4dgs that knows it"));
    }
    let shape = Shape::read(&mut meta, limits)?;
    Ok((set, meta, shape))
}

/// All streams of a lossy encoder: `meta`, the `columns` by name, the extra attributes of `gaussians` ([`Attributes::AsAllowed`]), and `escapes`.
pub fn assemble(gaussians: &HostGaussians, meta: Vec<u8>, escapes: Vec<u8>, columns: Vec<Stream>) -> Vec<Stream> {
    let mut streams = vec![Stream { name: META.into(), bytes: meta }];
    streams.extend(columns);
    streams.extend(extra_streams(gaussians, Attributes::AsAllowed));
    streams.push(Stream { name: ESCAPES.into(), bytes: escapes });
    streams
}

/// The last step of a decoder of [`assemble`]: checks that `read` (meta and escapes) has no bytes left, reads the extra attributes, and validates the result.
pub fn close(set: &StreamSet, shape: &Shape, read: [ByteReader; 2], mut out: HostGaussians, limits: &Limits) -> Result<HostGaussians> {
    for reader in read {
        reader.finish()?;
    }
    shape.read_extra(set, &mut out)?;
    out.validate_read("decoded Gaussians", limits)?;
    Ok(out)
}

/// Number of Gaussians, degree and extra attributes: what every meta stream holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Number of Gaussians.
    pub count: usize,
    /// Spherical-harmonics degree, 0 to 4.
    pub sh_degree: usize,
    /// Name and floats per Gaussian of each extra attribute.
    pub extra: Vec<(String, usize)>,
}

impl Shape {
    /// The shape of `gaussians`.
    pub fn of(gaussians: &HostGaussians) -> Self {
        Self { count: gaussians.len(), sh_degree: gaussians.sh_degree, extra: gaussians.extra.iter().map(|(n, a)| (n.clone(), a.width)).collect() }
    }
    /// Appends the shape to a meta stream. Refuses names and widths that cannot be stored, and more Gaussians than streams can number.
    pub fn write(&self, out: &mut Vec<u8>) -> Result<()> {
        if self.count as u64 > MAX_COUNT {
            return Err(Error::limit("number of Gaussians to encode", self.count as u64, MAX_COUNT, "Remove Gaussians, or split the model into several"));
        }
        out.extend((self.count as u64).to_le_bytes());
        out.push(self.sh_degree as u8);
        out.extend((self.extra.len() as u16).to_le_bytes());
        for (name, width) in &self.extra {
            // The stream of an attribute has its name, and stream names have at most 255 bytes.
            if name.is_empty()
                || name.len() > 240
                || name.chars().any(char::is_control)
                || *width == 0
                || *width > MAX_EXTRA_WIDTH
                || self.extra.len() > MAX_EXTRA
            {
                return Err(Error::parameter(
                    format!("attribute '{name}'"),
                    format!("a name of {} bytes, a width of {width} or {} attributes cannot be stored", name.len(), self.extra.len()),
                    format!("Use printable names up to 240 bytes, widths from 1 to {MAX_EXTRA_WIDTH} and at most {MAX_EXTRA} attributes"),
                ));
            }
            out.push(name.len() as u8);
            out.extend(name.as_bytes());
            out.extend((*width as u32).to_le_bytes());
        }
        Ok(())
    }
    /// Reads a shape and checks it against `limits`, before memory is allocated for it.
    pub fn read(reader: &mut ByteReader, limits: &Limits) -> Result<Self> {
        let count = reader.u64()?;
        limits.check_gaussians("encoded Gaussians", count)?;
        let sh_degree = usize::from(reader.u8()?);
        if sh_degree > 4 {
            return Err(reader.error(format!("spherical-harmonics degree {sh_degree} is over 4")));
        }
        let attributes = usize::from(reader.u16()?);
        if attributes > MAX_EXTRA {
            return Err(reader.error(format!("{attributes} extra attributes, over the limit of {MAX_EXTRA}")));
        }
        let mut extra = Vec::new();
        let mut floats = 15 + 3 * sh_rest_len(sh_degree) as u64;
        for _ in 0..attributes {
            let name_len = usize::from(reader.u8()?);
            let name = reader.name(name_len)?;
            let width = reader.u32()? as usize;
            if width == 0 || width > MAX_EXTRA_WIDTH || extra.iter().any(|(n, _)| *n == name) {
                return Err(reader.error(format!("attribute '{name}' of width {width}: the width is invalid or the name is not unique")));
            }
            floats += width as u64;
            extra.push((name, width));
        }
        limits.check_bytes("decoded Gaussians", count.saturating_mul(4 * floats))?;
        Ok(Self { count: count as usize, sh_degree, extra })
    }
    /// Whether the streams of all extra attributes are there.
    pub fn has_extra(&self, set: &StreamSet) -> bool {
        self.extra.iter().all(|(name, _)| set.has(&extra::stream_name(name)))
    }
    /// Reads the extra attributes back into `gaussians`.
    pub fn read_extra(&self, set: &StreamSet, gaussians: &mut HostGaussians) -> Result<()> {
        for (name, width) in &self.extra {
            gaussians.extra.insert(name.clone(), extra::decode(set, name, *width, self.count)?);
        }
        Ok(())
    }
}

/// Streams number rows with 32 bits.
const MAX_COUNT: u64 = u32::MAX as u64;
const MAX_EXTRA: usize = 256;
const MAX_EXTRA_WIDTH: usize = 4096;

/// Rows `[N, width]` as float32 columns, one after the other, so that neighbouring values in a stream are similar.
pub fn to_planes(rows: &[f32], width: usize) -> Vec<u8> {
    (0..width).flat_map(|c| rows.iter().skip(c).step_by(width)).flat_map(|v| v.to_le_bytes()).collect()
}

/// Undoes [`to_planes`]; the stream must hold `count * width` finite floats and nothing else.
pub fn from_planes(mut reader: ByteReader, count: usize, width: usize) -> Result<Vec<f32>> {
    let planes = reader.f32s(count.saturating_mul(width))?;
    reader.finish()?;
    let mut rows = vec![0.0; planes.len()];
    for (c, plane) in planes.chunks_exact(count.max(1)).enumerate() {
        plane.iter().enumerate().for_each(|(i, &v)| rows[i * width + c] = v);
    }
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_gaussians_than_streams_can_number_are_refused() {
        let write = |count: usize| Shape { count, sh_degree: 0, extra: Vec::new() }.write(&mut Vec::new());
        assert!(write(u32::MAX as usize).is_ok());
        let error = write(u32::MAX as usize + 1).unwrap_err();
        assert!(matches!(error, Error::Limit { value: 4_294_967_296, limit: 4_294_967_295, .. }), "{error}");
    }
}
