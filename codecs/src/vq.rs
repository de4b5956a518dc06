//! `vq`: codebooks for scales, rotations and higher colour coefficients, uniform quantisation for the rest (after CompGS, Navaneet et al. 2024).
//!
//! A codebook saves bytes only if rows are similar. If the best codebook loses more than is declared, the attribute is quantised uniformly instead.

use crate::{kmeans, morton};
use cc4dgs_format::storage::{
    ESCAPES, HARMONICS, Shape, assemble, close,
    column::{self, Target},
    from_planes, interleave, load, open, relative_rms, skip, split, stage_of_column, store, to_planes,
};
use cc4dgs_format::{
    AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, Error, HostGaussians, Plugin, Result, Seed, Stream, StreamStage, config, inventory, unknown_name,
};
use rand::seq::index::sample;
use serde::Deserialize;

/// Version of the stored form.
const VERSION: u8 = 2;
/// The attributes that get codebooks.
const BOOKS: [&str; 3] = ["log_scales", "quaternions", "sh_rest"];
/// The other attributes: name, bits, largest root-mean-square error over the standard deviation.
const STEPS: [(&str, u8, f64); 4] = [("means", 16, 2e-4), ("opacity_logits", 8, 0.03), ("sh_dc", 8, 0.03), ("dynamic_scores", 8, 0.03)];
/// Largest root-mean-square error of a codebook, over the attribute's standard deviation.
const BOOK_LOSS: f64 = 0.5;
/// Bits of the uniform quantiser that replaces a codebook, and the share of values that may be stored as outliers.
const REPLACEMENT_BITS: u8 = 8;
const TAIL: f64 = 1e-3;
/// Most rows of the sample: settings are read where numbers of memory have 32 bits, too.
const MOST_SAMPLE: usize = 1_000_000_000;

const SCHEMA: &str = "\
codebook = 4096          # rows of a codebook, at most 65536
iterations = 8           # k-means iterations
sample = 32768           # rows that k-means is trained on
";

#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    codebook: usize,
    iterations: usize,
    sample: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self { codebook: 4096, iterations: 8, sample: 32_768 }
    }
}

struct Vq(Settings);

impl Vq {
    /// A codebook for `rows` `[N,width]` and the codebook index of each row; `None` if its error is over the limit.
    fn book(&self, rows: &[f32], width: usize, seed: Seed) -> Option<(Vec<f32>, Vec<u32>)> {
        let n = rows.len().checked_div(width).unwrap_or(0);
        if n == 0 {
            return None;
        }
        let seen: Vec<f32> = if n > self.0.sample {
            let mut picked: Vec<usize> = sample(&mut seed.child("sample").rng(), n, self.0.sample).into_vec();
            picked.sort_unstable();
            picked.into_iter().flat_map(|i| rows[i * width..(i + 1) * width].to_vec()).collect()
        } else {
            rows.to_vec()
        };
        let book = kmeans::cluster(&seen, width, self.0.codebook.min(n), self.0.iterations, seed);
        if book.is_empty() || book.iter().any(|v| !v.is_finite()) {
            return None;
        }
        let labels = kmeans::assign(rows, width, &book).labels;
        let decoded: Vec<f32> = labels.iter().flat_map(|&l| book[l as usize * width..(l as usize + 1) * width].to_vec()).collect();
        (relative_rms(rows, &decoded) <= BOOK_LOSS).then_some((book, labels))
    }
}

fn steps(values: &[f32], width: usize, bits: u8, loss: f64, meta: &mut Vec<u8>, escapes: &mut Vec<u8>) -> Vec<u8> {
    let columns: Vec<_> = split(values, width).iter().map(|c| column::encode(c, Target { bits, mu_law: false, loss, tail: TAIL })).collect();
    store(&columns, meta, escapes)
}

impl AttributeCodec for Vq {
    fn encode(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>> {
        crate::require_encoders()?;
        gaussians.validate("Gaussians to encode", &context.limits)?;
        let sorted = gaussians.select(&morton::order(&gaussians.means));
        let (mut meta, mut escapes, mut streams) = (vec![VERSION], Vec::new(), Vec::new());
        Shape::of(&sorted).write(&mut meta)?;
        for (name, width, values) in sorted.columns() {
            let mut put = |name: String, bytes| streams.push(Stream { name, bytes });
            if let Some((_, bits, loss)) = STEPS.into_iter().find(|s| s.0 == name) {
                put(name.into(), steps(values, width, bits, loss, &mut meta, &mut escapes));
                continue;
            }
            match self.book(values, width, context.seed.child(name)) {
                Some((book, labels)) => {
                    meta.extend((book.len() as u32 / width as u32).to_le_bytes());
                    put(format!("{name}.book"), to_planes(&book, width));
                    put(name.into(), labels.into_iter().flat_map(|l| (l as u16).to_le_bytes()).collect());
                }
                None => {
                    meta.extend(0u32.to_le_bytes());
                    put(name.into(), steps(values, width, REPLACEMENT_BITS, BOOK_LOSS, &mut meta, &mut escapes));
                }
            }
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
        let books = BOOKS.map(|name| (name, BOOK_LOSS));
        STEPS
            .map(|(name, _, loss)| (name, loss))
            .into_iter()
            .chain(books)
            .map(|(name, loss)| DeclaredLoss { attribute: name.into(), relative_rms: loss })
            .collect()
    }
}

/// Without `harmonics`, their streams are not read, and the column is zeros.
fn decode(streams: &[Stream], context: &CodecContext, harmonics: bool) -> Result<HostGaussians> {
    let (set, mut meta, shape) = open("vq", streams, VERSION, &context.limits)?;
    let mut escapes = set.reader(ESCAPES)?;
    let mut out = HostGaussians { sh_degree: shape.sh_degree, ..Default::default() };
    for (name, width, values) in out.columns_mut() {
        let book_rows = if BOOKS.contains(&name) { meta.u32()? as usize } else { 0 };
        if name == HARMONICS && !harmonics {
            *values = if book_rows == 0 { skip(shape.count, width, &mut meta, &mut escapes)? } else { vec![0.0; shape.count * width] };
            continue;
        }
        if book_rows == 0 {
            *values = interleave(&load(set.reader(name)?, shape.count, width, &mut meta, &mut escapes)?, shape.count);
            continue;
        }
        if book_rows > 1 << 16 || book_rows > shape.count {
            return Err(meta.error(format!("a codebook of {book_rows} rows for {} Gaussians is impossible", shape.count)));
        }
        let book = from_planes(set.reader(&format!("{name}.book"))?, book_rows, width)?;
        let mut labels = set.reader(name)?;
        let bytes = labels.take(shape.count.saturating_mul(2))?;
        values.reserve(shape.count * width);
        for code in bytes.as_chunks::<2>().0 {
            let row = usize::from(u16::from_le_bytes(*code));
            let Some(found) = book.get(row * width..(row + 1) * width) else {
                return Err(labels.error(format!("label {row} is beyond the {book_rows} rows of the codebook")));
            };
            values.extend_from_slice(found);
        }
        labels.finish()?;
    }
    close(&set, &shape, [meta, escapes], out, &context.limits)
}

pub(crate) fn build(profile: &str, settings: &toml::Table) -> Result<Box<dyn AttributeCodec>> {
    if !matches!(profile, "" | "default") {
        return Err(unknown_name("profile of codec vq", profile, ["default"].into_iter()));
    }
    let settings: Settings = config::parse_section("codec vq", settings)?;
    if !(1..=1 << 16).contains(&settings.codebook) || !(1..=1000).contains(&settings.iterations) || !(1..=MOST_SAMPLE).contains(&settings.sample) {
        return Err(Error::parameter(
            "codec vq",
            format!("{settings:?}"),
            "Use a codebook of 1 to 65536 rows, 1 to 1000 iterations and a sample of 1 to 1000000000 rows",
        ));
    }
    Ok(Box::new(Vq(settings)))
}

inventory::submit! {
    CodecPlugin {
        info: Plugin {
            name: "vq",
            version: "2",
            summary: "codebooks for scales, rotations and colours, uniform quantisation for the rest",
            paper: "CompGS (Navaneet et al. 2024)",
            schema: SCHEMA,
            capabilities: &["lossy", "reorders", "profiles=default"],
        },
        build,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_that_32_bits_do_not_hold_are_refused() {
        let sample = |rows: i64| build("", &toml::Table::from_iter([("sample".into(), rows.into())]));
        assert!(sample(1).is_ok() && sample(1_000_000_000).is_ok());
        for rows in [0, 1_000_000_001, 1 << 32] {
            let message = sample(rows).err().unwrap().to_string();
            assert!(message.contains("a sample of 1 to 1000000000 rows"), "{message}");
        }
    }
}
