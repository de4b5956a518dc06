//! The colour coefficients above degree 0: conditional autoencoder and residual codebook, or plain quantisation if that is smaller or more accurate.

use super::geometry::{CONDITIONS, Normalisation};
use super::network::{Decoder, Scratch, decoder_len, latents};
use super::profile::{Profile, Settings};
use super::shard::Data;
use super::train;
use crate::kmeans;
use cc4dgs_format::archive::{ByteReader, estimate_stored_len};
use cc4dgs_format::gaussians::sh_rest_len;
use cc4dgs_format::storage::{
    StreamSet,
    column::{self, Column, Target},
    interleave, load, relative_rms, split, store,
};
use cc4dgs_format::{CodecContext, Event, HostGaussians, Result, Stream};
use half::f16;
use rayon::prelude::*;

/// Stored forms of the coefficients.
const DIRECT: u8 = 0;
const AUTOENCODER: u8 = 1;

const DIRECT_CODES: &str = "sh_rest";
const LATENTS: &str = "sh_rest.latents";
const DECODER: &str = "sh_rest.decoder";
const CODEBOOK: &str = "sh_rest.codebook";
const RESIDUALS: &str = "sh_rest.residuals";

/// Share of a latent's values at either end outside its quantiser's range.
const LATENT_TAIL: f64 = 1e-4;
/// Samples and iterations of the residual codebook.
const CODEBOOK_SAMPLES: usize = 50_000;
const CODEBOOK_ITERATIONS: usize = 25;
/// Smallest and largest training weight of a Gaussian, relative to the average.
const ROW_WEIGHTS: (f64, f64) = (0.2, 5.0);

/// Encodes the coefficients of `gaussians`; `known` holds the attributes that the decoder has already decoded.
pub(super) fn encode(
    gaussians: &HostGaussians,
    known: &HostGaussians,
    profile: &Profile,
    settings: &Settings,
    context: &CodecContext,
    meta: &mut Vec<u8>,
    escapes: &mut Vec<u8>,
) -> Result<Vec<Stream>> {
    let width = 3 * sh_rest_len(gaussians.sh_degree);
    if width == 0 {
        return Ok(Vec::new());
    }
    let (quantised, exact) = (direct(&gaussians.sh_rest, width, Some(profile.appearance_loss))?, direct(&gaussians.sh_rest, width, None)?);
    // Colours that were quantised before may compress better unchanged.
    let (direct_len, mut best) = if exact.0 < quantised.0 { exact } else { quantised };
    // For few or very similar coefficients, decoder and codebook alone may be larger than direct storage.
    let fixed = 2 * decoder_len(width) + 4 * width * profile.codebook.min(gaussians.len());
    if direct_len > fixed as u64
        && let Some((coded, loss)) = autoencode(gaussians, known, profile, settings, context)?
        && coded.stored_len()? < direct_len
    {
        // NaN fails this comparison, so a diverged autoencoder is not used.
        if loss <= profile.appearance_loss {
            best = coded;
        } else {
            context.events.emit(&Event::Warning {
                object: "codec cca".into(),
                message: format!("the autoencoder's relative error {loss:.2} is over the limit of {}; colours are stored without it", profile.appearance_loss),
            });
        }
    }
    meta.extend(best.meta);
    escapes.extend(best.escapes);
    Ok(best.streams)
}

/// The columns at 16 bits (within `loss`, if given) or exact, and their approximate stored size in bytes.
fn direct(rows: &[f32], width: usize, loss: Option<f64>) -> Result<(u64, Form)> {
    let encode = |c: &Vec<f32>| match loss {
        Some(loss) => column::encode(c, Target { bits: 16, mu_law: false, loss, tail: 5e-4 }),
        None => column::encode_exact(c),
    };
    let columns: Vec<Column> = split(rows, width).par_iter().map(encode).collect();
    let mut form = Form::new(DIRECT);
    let codes = store(&columns, &mut form.meta, &mut form.escapes);
    form.streams.push(Stream { name: DIRECT_CODES.into(), bytes: codes });
    Ok((form.stored_len()?, form))
}

/// One way to store the coefficients.
struct Form {
    meta: Vec<u8>,
    escapes: Vec<u8>,
    streams: Vec<Stream>,
}

impl Form {
    fn new(kind: u8) -> Self {
        Self { meta: vec![kind], escapes: Vec::new(), streams: Vec::new() }
    }
    fn stored_len(&self) -> Result<u64> {
        let streams = self.streams.par_iter().map(|s| estimate_stored_len(&s.bytes)).sum::<Result<u64>>()?;
        Ok(streams + (self.meta.len() + self.escapes.len()) as u64)
    }
}

/// Mean and scale of each coefficient. Encoder and decoder both undo the normalisation with [`Statistics::value`].
struct Statistics {
    mean: Vec<f32>,
    scale: Vec<f32>,
}

impl Statistics {
    fn of(rows: &[f32], width: usize) -> Self {
        let (mut mean, mut scale) = (Vec::with_capacity(width), Vec::with_capacity(width));
        for column in split(rows, width) {
            let n = column.len().max(1) as f64;
            let m = column.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
            mean.push(m as f32);
            scale.push((column.iter().map(|&v| (f64::from(v) - m).powi(2)).sum::<f64>() / n).sqrt() as f32);
        }
        Self { mean, scale }
    }
    #[inline(always)]
    fn value(&self, c: usize, normalised: f32) -> f32 {
        self.mean[c] + self.scale[c] * normalised
    }
}

/// The coefficients encoded by the autoencoder, and their relative root-mean-square error. `None` if it cannot be trained.
fn autoencode(gaussians: &HostGaussians, known: &HostGaussians, profile: &Profile, settings: &Settings, context: &CodecContext) -> Result<Option<(Form, f64)>> {
    let rows = &gaussians.sh_rest;
    let width = rows.len() / gaussians.len().max(1);
    let statistics = Statistics::of(rows, width);
    let pooled = statistics.scale.iter().map(|&s| f64::from(s).powi(2)).sum::<f64>() / width as f64;
    if !(pooled > 0.0 && pooled.is_finite() && statistics.scale.iter().all(|s| s.is_finite())) {
        return Ok(None);
    }
    let normalisation = Normalisation::of(known);
    let conditions: Vec<[f32; CONDITIONS]> = (0..known.len()).into_par_iter().map(|i| normalisation.conditions(known, i)).collect();
    let mut targets = rows.clone();
    targets.par_chunks_exact_mut(width).for_each(|row| {
        for (c, v) in row.iter_mut().enumerate() {
            let scale = statistics.scale[c];
            *v = if scale > 0.0 { ((f64::from(*v) - f64::from(statistics.mean[c])) / f64::from(scale)) as f32 } else { 0.0 };
        }
    });
    // Errors are weighted in units of colour, not of each coefficient's own deviation.
    let column_weights: Vec<f32> = statistics.scale.iter().map(|&s| (f64::from(s).powi(2) / pooled) as f32).collect();
    let data = Data { width, targets: &targets, conditions: &conditions, row_weights: &row_weights(gaussians), column_weights: &column_weights };
    let (encoder, decoder) = train::train(&data, profile.latent_bits, settings, context.seed.child("autoencoder"), context.events);
    let decoder: Vec<f16> = decoder.into_iter().map(f16::from_f32).collect();
    if encoder.iter().any(|w| !w.is_finite()) || decoder.iter().any(|w| !w.is_finite()) {
        return Ok(None);
    }
    let latent = latents(width);
    let target = Target { bits: profile.latent_bits, mu_law: false, loss: f64::INFINITY, tail: LATENT_TAIL };
    let columns: Vec<Column> = split(&train::encode_all(&data, &encoder), latent).par_iter().map(|c| column::encode(c, target)).collect();

    // From here on only values that the decoder has, too: half-precision weights, dequantised latents, conditions.
    let network = Decoder::new(width, &decoder.iter().map(|w| w.to_f32()).collect::<Vec<_>>());
    let z = interleave(&columns.iter().map(|c| column::dequantise(c, known.len())).collect::<Vec<_>>(), known.len());
    let base = reconstruct(&network, &statistics, &normalisation, known, &z, None);
    let residuals: Vec<f32> = rows.iter().zip(&base).map(|(a, b)| a - b).collect();
    if residuals.iter().any(|v| !v.is_finite()) {
        return Ok(None);
    }
    let stride = known.len().div_ceil(CODEBOOK_SAMPLES);
    let samples: Vec<f32> = residuals.chunks_exact(width).step_by(stride).flatten().copied().collect();
    let codebook = kmeans::cluster(&samples, width, profile.codebook, CODEBOOK_ITERATIONS, context.seed.child("codebook"));
    let labels: Vec<u8> = kmeans::assign(&residuals, width, &codebook).labels.into_iter().map(|l| l as u8).collect();
    let coded = reconstruct(&network, &statistics, &normalisation, known, &z, Some((&labels, &codebook)));
    let loss = relative_rms(rows, &coded);

    let mut form = Form::new(AUTOENCODER);
    normalisation.write(&mut form.meta);
    statistics.mean.iter().chain(&statistics.scale).for_each(|v| form.meta.extend(v.to_le_bytes()));
    form.meta.extend(((codebook.len() / width) as u16).to_le_bytes());
    let codes = store(&columns, &mut form.meta, &mut form.escapes);
    form.streams = vec![
        Stream { name: LATENTS.into(), bytes: codes },
        Stream { name: RESIDUALS.into(), bytes: labels },
        Stream { name: DECODER.into(), bytes: decoder.iter().flat_map(|w| w.to_le_bytes()).collect() },
        Stream { name: CODEBOOK.into(), bytes: codebook.iter().flat_map(|v| v.to_le_bytes()).collect() },
    ];
    Ok(Some((form, loss)))
}

/// Visibility of each Gaussian's colour: opacity times the mean area of its three faces, relative to the average and clipped.
fn row_weights(gaussians: &HostGaussians) -> Vec<f32> {
    let seen = |(logit, s): (&f32, &[f32])| {
        let side = |a: usize, b: usize| libm::exp((f64::from(s[a]) + f64::from(s[b])).clamp(-60.0, 60.0));
        (side(0, 1) + side(1, 2) + side(0, 2)) / (3.0 * (1.0 + libm::exp(-f64::from(*logit).clamp(-60.0, 60.0))))
    };
    let raw: Vec<f64> = gaussians.opacity_logits.iter().zip(gaussians.log_scales.chunks_exact(3)).map(seen).collect();
    let mean = raw.iter().sum::<f64>() / raw.len().max(1) as f64;
    raw.iter().map(|w| (w / mean.max(f64::MIN_POSITIVE)).clamp(ROW_WEIGHTS.0, ROW_WEIGHTS.1) as f32).collect()
}

/// Coefficients `[N,width]` from latents `z` `[N,latents]`, the conditions and, if given, the codebook. Encoder and decoder both call this, so that they
/// compute the same bits.
fn reconstruct(
    network: &Decoder,
    statistics: &Statistics,
    normalisation: &Normalisation,
    known: &HostGaussians,
    z: &[f32],
    residual: Option<(&[u8], &[f32])>,
) -> Vec<f32> {
    let width = statistics.mean.len();
    let latent = latents(width);
    let mut out = vec![0.0; known.len() * width];
    out.par_chunks_exact_mut(width).with_min_len(256).enumerate().for_each_init(
        || (Scratch::default(), Vec::new()),
        |(scratch, input), (i, row)| {
            input.clear();
            input.extend_from_slice(&z[i * latent..(i + 1) * latent]);
            input.extend(normalisation.conditions(known, i));
            network.run(input, scratch, row);
            row.iter_mut().enumerate().for_each(|(c, v)| *v = statistics.value(c, *v));
            if let Some((labels, codebook)) = residual {
                let at = usize::from(labels[i]) * width;
                row.iter_mut().zip(&codebook[at..at + width]).for_each(|(v, r)| *v += r);
            }
        },
    );
    out
}

/// Decodes the coefficients of `count` Gaussians; `known` holds all other attributes.
pub(super) fn decode(set: &StreamSet, known: &HostGaussians, count: usize, meta: &mut ByteReader, escapes: &mut ByteReader) -> Result<Vec<f32>> {
    let width = 3 * sh_rest_len(known.sh_degree);
    if width == 0 {
        return Ok(Vec::new());
    }
    match meta.u8()? {
        DIRECT => Ok(interleave(&load(set.reader(DIRECT_CODES)?, count, width, meta, escapes)?, count)),
        AUTOENCODER => {
            let normalisation = Normalisation::read(meta)?;
            let statistics = Statistics { mean: meta.f32s(width)?, scale: meta.f32s(width)? };
            let entries = usize::from(meta.u16()?);
            let z = interleave(&load(set.reader(LATENTS)?, count, latents(width), meta, escapes)?, count);
            let mut reader = set.reader(RESIDUALS)?;
            let labels = reader.take(count)?;
            if let Some(label) = labels.iter().find(|&&l| usize::from(l) >= entries) {
                return Err(reader.error(format!("a residual refers to codebook entry {label} of {entries}")));
            }
            reader.finish()?;
            let mut reader = set.reader(DECODER)?;
            let weights: Vec<f32> = reader.take(2 * decoder_len(width))?.chunks_exact(2).map(|c| f16::from_le_bytes([c[0], c[1]]).to_f32()).collect();
            if weights.iter().any(|w| !w.is_finite()) {
                return Err(reader.error("a decoder weight is not finite"));
            }
            reader.finish()?;
            let mut reader = set.reader(CODEBOOK)?;
            let codebook = reader.f32s(entries * width)?;
            reader.finish()?;
            Ok(reconstruct(&Decoder::new(width, &weights), &statistics, &normalisation, known, &z, Some((labels, &codebook))))
        }
        other => Err(meta.error(format!("unknown storage form {other} of colours"))),
    }
}
