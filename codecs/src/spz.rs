//! `spz`: Niantic's format as a codec. The file itself is [`cc4dgs_format::spz`]; additional streams hold what SPZ cannot.

use cc4dgs_format::spz::{LARGEST, SpzOptions, from_spz, to_spz};
use cc4dgs_format::storage::{Attributes, META, Shape, column_loss, extra_streams, open};
use cc4dgs_format::{AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, Error, HostGaussians, Plugin, Result, Stream, config, inventory, unknown_name};
use serde::Deserialize;

/// Index of the dynamic scores, the last column.
const SCORES: usize = 6;
/// Version of the streams around the file.
const VERSION: u8 = 2;
/// Version of the SPZ file: its bytes are this codec's stored form.
const FILE_VERSION: u32 = 3;
/// The stream that is an SPZ file.
const FILE: &str = "spz";
/// The stream of columns that SPZ cannot hold: always the dynamic scores, the quaternions of models that move, and any column whose loss in SPZ is larger than
/// declared.
const BESIDE: &str = "beside";

const SCHEMA: &str = "\
sh1_bits = 5             # bits per spherical-harmonics coefficient of degree 1 (Niantic: 5), 1 to 8
sh_rest_bits = 4         # bits per coefficient of higher degrees (Niantic: 4), 1 to 8
";

#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Spz {
    sh1_bits: u8,
    sh_rest_bits: u8,
}

impl AttributeCodec for Spz {
    fn encode(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>> {
        crate::require_encoders()?;
        gaussians.validate("Gaussians to encode", &context.limits)?;
        let mut meta = vec![VERSION];
        Shape::of(gaussians).write(&mut meta)?;
        let mut held = gaussians.clone();
        held.means.iter_mut().for_each(|v| *v = v.clamp(-LARGEST, LARGEST));
        let file = to_spz(&held, &SpzOptions { sh1_bits: self.sh1_bits, sh_rest_bits: self.sh_rest_bits, ..SpzOptions::version(FILE_VERSION) })?;
        let found = from_spz("SPZ just written", &file, &context.limits)?.gaussians;
        let losses = self.losses();
        // Offsets of deformers are added to quaternions as they are, so their sign and length matter where something may move.
        let moves = context.dynamic_threshold.is_none_or(|threshold| gaussians.dynamic_scores.iter().any(|score| *score > threshold));
        let mut beside = Vec::new();
        for (index, ((name, width, before), (_, _, after))) in gaussians.columns().into_iter().zip(found.columns()).enumerate() {
            let allowed = losses.iter().find(|l| l.attribute == name).map_or(0.0, |l| l.relative_rms);
            // NaN is not within the bounds either.
            let within = column_loss(name, before, after, width) <= allowed;
            if allowed == 0.0 || !within || moves && name == "quaternions" {
                beside.push(index as u8);
                beside.extend(before.iter().flat_map(|v| v.to_le_bytes()));
            }
        }
        let mut streams =
            vec![Stream { name: META.into(), bytes: meta }, Stream { name: FILE.into(), bytes: file }, Stream { name: BESIDE.into(), bytes: beside }];
        streams.extend(extra_streams(gaussians, Attributes::AsAllowed));
        Ok(streams)
    }
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        let (set, meta, shape) = open("spz", streams, VERSION, &context.limits)?;
        meta.finish()?;
        let file = set.reader(FILE)?;
        let mut out = from_spz("spz stream", file.rest(), &context.limits)?.gaussians;
        if out.len() != shape.count || out.sh_degree != shape.sh_degree {
            let problem = format!("{} Gaussians of degree {}, {} of degree {} are declared", out.len(), out.sh_degree, shape.count, shape.sh_degree);
            return Err(Error::data("spz stream", problem, "The file is damaged"));
        }
        let mut beside = set.reader(BESIDE)?;
        let mut next = 0;
        while beside.remaining() > 0 {
            let index = usize::from(beside.u8()?);
            let Some((_, width, values)) = out.columns_mut().into_iter().nth(index).filter(|_| index >= next) else {
                return Err(beside.error(format!("column {index} is unknown or appears twice")));
            };
            *values = beside.f32s(shape.count * width)?;
            next = index + 1;
        }
        if next != SCORES + 1 {
            return Err(beside.error("the dynamic scores are missing"));
        }
        shape.read_extra(&set, &mut out)?;
        out.validate_read("decoded Gaussians", &context.limits)?;
        Ok(out)
    }
    fn losses(&self) -> Vec<DeclaredLoss> {
        // Harmonics: half a step over a standard deviation of some hundredths. Quaternions of static models lose length and sign, which do not change
        // rotations.
        let harmonics = 16.0 * f64::from(1u32 << (8 - self.sh_rest_bits.min(self.sh1_bits))) / 256.0;
        [("means", 1e-3), ("log_scales", 0.1), ("quaternions", 2.5), ("opacity_logits", 1.0), ("sh_dc", 0.1), ("sh_rest", harmonics)]
            .map(|(attribute, relative_rms)| DeclaredLoss { attribute: attribute.into(), relative_rms })
            .into()
    }
}

pub(crate) fn build(profile: &str, settings: &toml::Table) -> Result<Box<dyn AttributeCodec>> {
    let bits = match profile {
        "" | "default" => [5, 4],
        "high" => [8, 8],
        _ => return Err(unknown_name("profile of codec spz", profile, ["default", "high"].into_iter())),
    };
    let mut section = toml::Table::new();
    for (name, value) in ["sh1_bits", "sh_rest_bits"].into_iter().zip(bits) {
        section.insert(name.into(), value.into());
    }
    config::merge(&mut section, settings);
    let codec: Spz = config::parse_section("codec spz", &section)?;
    for (name, bits) in [("sh1_bits", codec.sh1_bits), ("sh_rest_bits", codec.sh_rest_bits)] {
        if !(1..=8).contains(&bits) {
            return Err(Error::parameter(format!("codec spz.{name}"), format!("{bits} bits"), "Choose 1 to 8"));
        }
    }
    Ok(Box::new(codec))
}

inventory::submit! {
    CodecPlugin {
        info: Plugin {
            name: "spz",
            version: "2",
            summary: "Niantic's SPZ, which most viewers of static Gaussians read; scores and plug-in attributes in additional streams",
            paper: "Niantic SPZ 3",
            schema: SCHEMA,
            capabilities: &["lossy", "profiles=default,high"],
        },
        build,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_format::{Limits, Seed, Silent};

    /// Streams, and what they decode to.
    fn stored(gaussians: &HostGaussians, threshold: Option<f32>) -> (Vec<Stream>, HostGaussians) {
        let codec = build("", &toml::Table::new()).unwrap();
        let plain = CodecContext::new(Seed::root(1), Limits::default(), &Silent);
        let streams = codec.encode(gaussians, &CodecContext { dynamic_threshold: threshold, ..plain }).unwrap();
        let decoded = codec.decode(&streams, &CodecContext::new(Seed::root(1), Limits::default(), &Silent)).unwrap();
        (streams, decoded)
    }

    /// Gaussians in a box of two units; their quaternions are q, -q, 2q and -2q in turn, and their scores from 0 to below 1.
    fn cloud(count: usize) -> HostGaussians {
        let draw = |i: usize, k: usize| (Seed::root(4).index(i as u64).index(k as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0;
        let mut out = HostGaussians { log_scales: vec![-5.0; 3 * count], ..Default::default() };
        for i in 0..count {
            out.means.extend([draw(i, 0), draw(i, 1), draw(i, 2)]);
            out.quaternions.extend([0.8, 0.6 * draw(i, 3), 0.0, 0.3].map(|v: f32| [1.0, -1.0, 2.0, -2.0][i % 4] * v));
            out.opacity_logits.push(draw(i, 7));
            out.sh_dc.extend([draw(i, 4), draw(i, 5), draw(i, 6)]);
            out.dynamic_scores.push(i as f32 / count as f32);
        }
        out
    }

    #[test]
    fn sign_and_length_of_quaternions_are_kept_where_something_moves() {
        let gaussians = cloud(200);
        let beside = |streams: &[Stream]| streams.iter().find(|s| s.name == BESIDE).map_or(0, |s| s.bytes.len());
        let (streams, resting) = stored(&gaussians, Some(f32::INFINITY));
        assert_ne!(resting.quaternions, gaussians.quaternions);
        assert_eq!(beside(&streams), 1 + 4 * 200, "a static model needs only its scores beside the file");
        assert_eq!(stored(&gaussians, Some(1.0)).1, resting);
        for threshold in [None, Some(f32::NEG_INFINITY), Some(0.99)] {
            let (streams, moving) = stored(&gaussians, threshold);
            assert_eq!(moving.quaternions, gaussians.quaternions, "threshold {threshold:?}");
            assert_eq!(beside(&streams), 2 + 20 * 200);
        }
    }

    #[test]
    fn a_few_gaussians_far_away_do_not_spoil_the_centres_of_the_others() {
        let mut gaussians = cloud(10_000);
        let near = stored(&gaussians, Some(f32::INFINITY)).1;
        assert_ne!(near.means, gaussians.means, "24 bits are enough for a small box");
        (0..100).for_each(|i| gaussians.means[3 * i] = if i % 2 == 0 { 1e5 } else { -1e5 });
        let found = stored(&gaussians, Some(f32::INFINITY)).1;
        let worst = gaussians.means.iter().zip(&found.means).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-5, "{worst}");
    }
}
