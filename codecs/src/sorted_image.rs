//! `sorted-image`: Gaussians sorted into a square, each component stored as a PNG image of the square (as in gsplat's PNG compression and SOG).
//!
//! The quantisation is that of `quantize`; only the order and the coder differ. So comparing the two codecs measures the gain of image compression.

use crate::grid_sort::{side_of, square_order};
use crate::morton;
use crate::quantize::Bits;
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::storage::{
    ESCAPES, HARMONICS, Shape, assemble, close,
    column::{self, Column},
    interleave, load, open, skip, split, stage_of_column, store,
};
use cc4dgs_format::{AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, Error, HostGaussians, Plugin, Result, Stream, StreamStage, inventory};
use png::{BitDepth, ColorType, Decoder, Encoder, Filter, Limits as PngLimits};
use std::io::Cursor;

/// Version of the stored form.
const VERSION: u8 = 2;

/// The last chunk of every PNG file.
const END: [u8; 12] = [0, 0, 0, 0, b'I', b'E', b'N', b'D', 0xae, 0x42, 0x60, 0x82];

struct SortedImage {
    bits: Bits,
}

/// Codes as byte planes, the low bytes of all codes before the high ones. The high bytes of 16-bit codes form a smooth plane and the low bytes a noisy one;
/// mixed, both would look like noise to an image coder.
fn planes(columns: &[Column], count: usize) -> Vec<u8> {
    let mut out = Vec::new();
    for column in columns {
        let width = column.codes.len() / count.max(1);
        for byte in 0..width {
            out.extend(column.codes.iter().skip(byte).step_by(width));
        }
    }
    out
}

/// Undoes [`planes`] for columns of `widths` bytes per code.
fn codes(planes: &[u8], widths: &[usize], count: usize) -> Vec<u8> {
    let mut out = Vec::with_capacity(planes.len());
    let mut at = 0;
    for &width in widths {
        for i in 0..count {
            out.extend((0..width).map(|byte| planes[at + byte * count + i]));
        }
        at += width * count;
    }
    out
}

fn to_png(planes: &[u8], count: usize) -> Result<Vec<u8>> {
    let side = side_of(count);
    let failed = |e: png::EncodingError| Error::backend("PNG", e.to_string(), "Report this as a defect");
    let mut image = Vec::new();
    for plane in planes.chunks(count.max(1)) {
        image.extend(plane);
        // The last code fills the remaining cells; a run costs almost no bytes.
        image.extend(std::iter::repeat_n(plane[plane.len() - 1], side * side - plane.len()));
    }
    let mut out = Vec::new();
    let mut encoder = Encoder::new(&mut out, side as u32, (image.len() / side) as u32);
    encoder.set_color(ColorType::Grayscale);
    encoder.set_depth(BitDepth::Eight);
    encoder.set_filter(Filter::Adaptive);
    encoder.set_compression(png::Compression::High);
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(&image).map_err(failed)?;
    writer.finish().map_err(failed)?;
    Ok(out)
}

/// The planes of a PNG image, which must hold `wanted` planes of `count` codes.
fn from_png(object: &str, bytes: &[u8], count: usize, wanted: usize) -> Result<Vec<u8>> {
    let damaged = |problem: String| Error::data(object, problem, "The file is damaged");
    let side = side_of(count);
    // PNG decoders accept missing and trailing bytes.
    if !bytes.ends_with(&END) {
        return Err(damaged("the image stream has trailing bytes or ends early".into()));
    }
    let mut decoder = Decoder::new_with_limits(Cursor::new(bytes), PngLimits { bytes: (4 * side * side * wanted).max(1 << 20) });
    decoder.set_transformations(png::Transformations::IDENTITY);
    let mut reader = decoder.read_info().map_err(|e| damaged(e.to_string()))?;
    let info = reader.info();
    let fits =
        (info.width as usize, info.height as usize) == (side, side * wanted) && info.color_type == ColorType::Grayscale && info.bit_depth == BitDepth::Eight;
    if !fits {
        return Err(damaged(format!("the image is {}x{}, expected 8-bit grey of {side}x{}", info.width, info.height, side * wanted)));
    }
    let mut image = vec![0; side * side * wanted];
    reader.next_frame(&mut image).and_then(|_| reader.finish()).map_err(|e| damaged(e.to_string()))?;
    Ok(image.chunks(side * side).flat_map(|plane| &plane[..count]).copied().collect())
}

impl AttributeCodec for SortedImage {
    fn encode(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>> {
        crate::require_encoders()?;
        gaussians.validate("Gaussians to encode", &context.limits)?;
        let order = square_order(gaussians, &morton::order(&gaussians.means), context.seed.child("square"));
        let sorted = gaussians.select(&order);
        let count = sorted.len();
        let (mut meta, mut escapes) = (vec![VERSION], Vec::new());
        Shape::of(&sorted).write(&mut meta)?;
        let mut streams = Vec::new();
        for (name, width, values) in sorted.columns() {
            let columns: Vec<Column> = split(values, width).iter().map(|c| self.bits.encode(name, c)).collect();
            store(&columns, &mut meta, &mut escapes);
            let planes = planes(&columns, count);
            // Constant columns have no codes, and an image needs at least one plane.
            let bytes = if planes.is_empty() { Vec::new() } else { to_png(&planes, count)? };
            streams.push(Stream { name: name.into(), bytes });
        }
        Ok(assemble(&sorted, meta, escapes, streams))
    }

    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        decode(streams, context, true)
    }
    fn stage(&self, name: &str) -> StreamStage {
        stage_of_column(name)
    }
    fn decode_stage(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        decode(streams, context, false)
    }

    fn losses(&self) -> Vec<DeclaredLoss> {
        self.bits.losses()
    }
}

/// Without `harmonics`, their streams are not read, and the column is zeros.
fn decode(streams: &[Stream], context: &CodecContext, harmonics: bool) -> Result<HostGaussians> {
    let (set, mut meta, shape) = open("sorted-image", streams, VERSION, &context.limits)?;
    let mut escapes = set.reader(ESCAPES)?;
    let mut out = HostGaussians { sh_degree: shape.sh_degree, ..Default::default() };
    for (name, width, values) in out.columns_mut() {
        if name == HARMONICS && !harmonics {
            *values = skip(shape.count, width, &mut meta, &mut escapes)?;
            continue;
        }
        let widths = column::widths(meta.clone(), width)?;
        let wanted: usize = widths.iter().sum();
        let image = set.reader(name)?;
        let object = format!("sorted-image stream '{name}'");
        let planes = if wanted * shape.count == 0 {
            image.finish()?;
            Vec::new()
        } else {
            from_png(&object, image.rest(), shape.count, wanted)?
        };
        let codes = codes(&planes, &widths, shape.count);
        *values = interleave(&load(ByteReader::new(object, &codes), shape.count, width, &mut meta, &mut escapes)?, shape.count);
    }
    close(&set, &shape, [meta, escapes], out, &context.limits)
}

pub(crate) fn build(profile: &str, settings: &toml::Table) -> Result<Box<dyn AttributeCodec>> {
    Ok(Box::new(SortedImage { bits: Bits::from_settings("sorted-image", profile, settings)? }))
}

inventory::submit! {
    CodecPlugin {
        info: Plugin {
            name: "sorted-image",
            version: "2",
            summary: "Gaussians sorted into a square, each component stored as a PNG image",
            paper: "Self-Organizing Gaussian Grids (Morgenstern et al. 2024); gsplat's PNG compression",
            schema: crate::quantize::SCHEMA,
            capabilities: &["lossy", "reorders", "profiles=default,high"],
        },
        build,
    }
}
