//! How the weights of a field are stored: `name`, `name:setting=value`, or `name:max-drop=0.01dB`, which searches the fewest bits of each array that keep the
//! PSNR.

use crate::archive::{load_weights, weights_of};
use crate::codec_services::{ModelServices, SceneViews};
use crate::model::{Model, ModelDeformer};
use crate::weight_importance::weight_importance;
use burn::tensor::Device;
use cc4dgs_core::archive::{CodecEntry, DeformerEntry};
use cc4dgs_core::{
    CodecContext, DeformerContext, EncodedWeights, Error, Event, EventSink, FIELD_STREAMS, Limits, Plugin, Registry, Result, Scene, Stream, TrainingViews,
    WeightArray, config, plural, psnr_on_views, split_kind, weight_seed,
};
use std::ops::RangeInclusive;

/// Views on which the loss is measured.
const VIEWS: usize = 16;
/// The setting that a search changes: the bits of each array in turn. The capability `bits=3..16` states their range.
const ARRAY_BITS: &str = "array_bits";
/// Attempts after every array was probed, at most.
const ATTEMPTS: usize = 6;
/// Where in the range an array is probed, and the least loss in dB that it counts with.
const PROBED: f64 = 0.3;
const SMALLEST: f64 = 1e-4;

/// A weight codec with its settings.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldWeights {
    /// Name of the weight codec.
    pub name: String,
    /// Its settings.
    pub settings: toml::Table,
    /// Largest loss of PSNR in dB on the views that judge ([`Scene::judging_split`]), for a search.
    pub max_drop_db: Option<f64>,
}

impl FieldWeights {
    /// Reads `name[:setting=value]` or `name:max-drop=0.01dB`; the name must be in the registry.
    ///
    /// # Errors
    /// [`Error::Parameter`] for names, settings and numbers that do not exist.
    pub fn parse(spec: &str, registry: &Registry) -> Result<Self> {
        let (name, profile) = spec.split_once(':').unwrap_or((spec, ""));
        let mut out = Self { name: name.into(), settings: toml::Table::new(), max_drop_db: None };
        let searchable = searched_bits(&registry.weight_codec(name)?.info).is_some();
        let Some(limit) = profile.strip_prefix("max-drop=") else {
            if !profile.is_empty() {
                config::set_all(&mut out.settings, &[profile.to_string()])?;
            }
            registry.build_weight_codec(name, &out.settings)?;
            return Ok(out);
        };
        let object = format!("weight codec '{spec}'");
        if !searchable {
            return Err(Error::parameter(object, format!("{name} has no bits to search"), "Choose compact:max-drop=0.01dB, or the name alone"));
        }
        let number = limit.strip_suffix("dB").unwrap_or(limit).trim().parse::<f64>().ok().filter(|v| *v > 0.0 && v.is_finite());
        out.max_drop_db = Some(number.ok_or_else(|| Error::parameter(object, format!("'{limit}' is no number of dB"), "Write compact:max-drop=0.01dB"))?);
        Ok(out)
    }
    /// Refuses a search, which needs the images of a scene. Call it where there is none, or an orbit in its place, before any work.
    ///
    /// # Errors
    /// [`Error::Parameter`] that names the weight codec and the remedy.
    pub fn check_without_scene(&self) -> Result<()> {
        self.max_drop_db.map_or(Ok(()), |limit| Err(self.needs_scene(limit)))
    }
    fn needs_scene(&self, limit: f64) -> Error {
        let object = format!("weight codec '{}:max-drop={limit}dB'", self.name);
        let remedy = "Give the dataset to `cc4dgs compress` (--scene), or state the bits: --field-weights compact:bits=6";
        Error::parameter(object, "a loss of PSNR is measured on images of a scene, and there is none", remedy)
    }
    /// How much images depend on each weight of `model`, where the codec makes use of it; measured in `views`, of which the images are not needed.
    ///
    /// # Errors
    /// What the deformer and the device report.
    pub fn importance(
        &self,
        model: &Model,
        views: &dyn TrainingViews,
        registry: &Registry,
        device: &Device,
        events: &dyn EventSink,
    ) -> Result<Option<Vec<Vec<f32>>>> {
        if views.is_empty() || !registry.weight_codec(&self.name)?.info.capabilities.contains(&"importance") {
            return Ok(None);
        }
        weight_importance(model, views, weight_seed(model.provenance.seed).child("importance"), registry, device, events).map(Some)
    }
    /// The weights of `field` as streams, and the settings that were chosen.
    pub(crate) fn encode(
        &self,
        model: &Model,
        weights: &[WeightArray],
        device: Option<&Device>,
        context: &CodecContext,
        registry: &Registry,
    ) -> Result<EncodedWeights> {
        let Some(limit) = self.max_drop_db else {
            return Ok((registry.build_weight_codec(&self.name, &self.settings)?.encode(weights, context)?, self.settings.clone()));
        };
        let judges = context.judging_views().filter(|judges| judges.has_images());
        let Some((device, judges)) = device.zip(judges) else { return Err(self.needs_scene(limit)) };
        let Some(of) = &model.field else { return Err(Error::backend("weight codec", "the model has no deformer", "Report this")) };
        let Some(range) = searched_bits(&registry.weight_codec(&self.name)?.info) else {
            return Err(Error::backend("weight codec", format!("{} has no bits to search", self.name), "Report this"));
        };
        let mut decoded = registry.build_deformer(&of.section, &of.context, device)?;
        let before = psnr_on_views(&model.gaussians, judges, &ModelServices::new(model, registry, device)?, VIEWS)?;
        let mut attempt = |bits: &[f64]| {
            let mut settings = self.settings.clone();
            settings.insert(ARRAY_BITS.into(), bits.to_vec().into());
            let codec = registry.build_weight_codec(&self.name, &settings)?;
            let streams = codec.encode(weights, context)?;
            let found = codec.decode(&streams, &CodecContext::new(context.seed.child("search"), context.limits, context.events))?;
            load_weights("encoded weights", decoded.as_mut(), found, device)?;
            let services = ModelServices::new(model, registry, device)?.with_deformer(decoded.as_ref());
            let drop = before - psnr_on_views(&model.gaussians, judges, &services, VIEWS)?;
            Ok::<_, Error>(Attempt { streams, settings, drop })
        };
        let counts: Vec<usize> = weights.iter().map(|w| w.values.len()).collect();
        let object = format!("weight codec {}", self.name);
        let (bits, found) = search_bits(&object, &counts, range, limit, &mut attempt)?;
        let text: Vec<String> = bits.iter().map(f64::to_string).collect();
        let (bits, number, kind) = (text.join(", "), judges.len().min(VIEWS), judges.kind());
        let views = plural(number, "view", "views");
        let message = format!("{bits} bits, PSNR {:.4} dB lower on {number} {kind} {views} ({limit} dB allowed)", found.drop);
        context.events.emit(&Event::Note { object, message });
        Ok((found.streams, found.settings))
    }
}

/// How an archive describes the weights of its deformer.
pub(crate) struct StoredField<'a> {
    /// The weight codec.
    pub chosen: FieldWeights,
    context: &'a DeformerContext,
    name: String,
    settings: toml::Table,
    versions: [String; 2],
}

impl<'a> StoredField<'a> {
    /// Of `deformer`, whose weights are stored as [`FieldWeights::parse`] reads `spec`.
    pub fn new(deformer: &'a ModelDeformer, spec: &str, registry: &Registry) -> Result<Self> {
        let chosen = FieldWeights::parse(spec, registry)?;
        let (name, settings) = split_kind("deformer", &deformer.section)?;
        let versions = [registry.deformer(&name)?.info.version.to_string(), registry.weight_codec(&chosen.name)?.info.version.to_string()];
        Ok(Self { chosen, context: &deformer.context, name, settings, versions })
    }
    /// The entry of the manifest for weights that were encoded with `settings`.
    pub fn entry(&self, settings: toml::Table) -> DeformerEntry {
        let [version, weight_version] = self.versions.clone();
        let weights = CodecEntry { name: self.chosen.name.clone(), version: weight_version, settings, ..Default::default() };
        DeformerEntry { name: self.name.clone(), version, settings: self.settings.clone(), context: self.context.clone(), weights }
    }
    /// A stream of the weight codec as one of the archive.
    pub fn stream(stream: &Stream) -> Stream {
        Stream { name: format!("{FIELD_STREAMS}{}", stream.name), ..stream.clone() }
    }
}

impl FieldWeights {
    /// The settings of the weight codec for `model`, searched on the views of `scene` that judge where the loss was stated. `importance` is
    /// [`FieldWeights::importance`].
    ///
    /// # Errors
    /// As [`Model::save_archive`].
    pub fn settings_for(
        &self,
        model: &Model,
        (scene, importance): (&Scene, Option<&[Vec<f32>]>),
        registry: &Registry,
        device: &Device,
        limits: &Limits,
        events: &dyn EventSink,
    ) -> Result<toml::Table> {
        let Some(of) = model.field.as_ref().filter(|_| self.max_drop_db.is_some()) else { return Ok(self.settings.clone()) };
        let (views, judges, seed) = (SceneViews::new(scene), SceneViews::judging(scene), weight_seed(model.provenance.seed));
        let context = CodecContext { views: Some(&views), judges: Some(&judges), weight_importance: importance, ..CodecContext::new(seed, *limits, events) };
        Ok(self.encode(model, &weights_of(of.field.as_ref())?, Some(device), &context, registry)?.1)
    }
    /// `settings` with steps `factor` times as large, in quarters of a bit; unchanged where bits were not searched.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a codec that is not in the registry.
    pub fn coarser(&self, settings: &toml::Table, factor: f64, registry: &Registry) -> Result<toml::Table> {
        let mut out = settings.clone();
        if let Some(range) = searched_bits(&registry.weight_codec(&self.name)?.info)
            && let Some(toml::Value::Array(bits)) = out.get_mut(ARRAY_BITS)
        {
            for bits in bits {
                let fewer = bits.as_float().unwrap_or(*range.end() as f64) - factor.log2();
                *bits = ((4.0 * fewer).round() / 4.0).clamp(*range.start() as f64, *range.end() as f64).into();
            }
        }
        Ok(out)
    }
}

/// Encoded weights, the settings that made them, and the PSNR that they cost in dB.
struct Attempt {
    streams: Vec<Stream>,
    settings: toml::Table,
    drop: f64,
}

/// The fewest bits per array, in quarters, that lose at most `limit` dB; arrays have `counts` values. A bit less doubles errors and quadruples the loss. Where
/// the sum of bits is smallest, the loss of each array is in proportion to its values. It is an error of `object` if the most bits lose more.
fn search_bits(
    object: &str,
    counts: &[usize],
    range: RangeInclusive<i64>,
    limit: f64,
    attempt: &mut dyn FnMut(&[f64]) -> Result<Attempt>,
) -> Result<(Vec<f64>, Attempt)> {
    let (least, most) = (*range.start() as f64, *range.end() as f64);
    let finest = vec![most; counts.len()];
    let first = attempt(&finest)?;
    if first.drop > limit {
        let problem = format!("weights of {most} bits, the most there are, lose {:.2e} dB, {limit} dB are allowed", first.drop);
        return Err(Error::parameter(object, problem, "Allow more, or store the weights as fp32"));
    }
    if counts.is_empty() {
        return Ok((finest, first));
    }
    let probe = (least + PROBED * (most - least)).round();
    let mut losses = Vec::with_capacity(counts.len());
    for array in 0..counts.len() {
        let mut bits = finest.clone();
        bits[array] = probe;
        losses.push((attempt(&bits)?.drop - first.drop).max(SMALLEST));
    }
    let total = counts.iter().sum::<usize>().max(1) as f64;
    let even = 0.5 * (total / limit).log2();
    let bits_at = |more: f64| -> Vec<f64> {
        let of = |(&loss, &count): (&f64, &usize)| probe + even + 0.5 * (loss / count.max(1) as f64).log2() + more;
        losses.iter().zip(counts).map(|array| (4.0 * of(array)).round().clamp(4.0 * least, 4.0 * most) / 4.0).collect()
    };
    let (mut best, mut quarters) = ((finest, first), 0i32);
    for _ in 0..ATTEMPTS {
        let bits = bits_at(0.25 * f64::from(quarters));
        let found = attempt(&bits)?;
        let allowed = found.drop <= limit;
        if allowed && bits.iter().sum::<f64>() < best.0.iter().sum::<f64>() {
            best = (bits, found);
        } else if allowed {
            break;
        }
        // Once both sides of the limit are known, the search is over.
        if quarters != 0 && allowed == (quarters > 0) {
            break;
        }
        quarters += if allowed { -1 } else { 1 };
    }
    Ok(best)
}

/// The numbers of bits that a weight codec can be asked for, from its capability `bits=3..12`.
fn searched_bits(info: &Plugin) -> Option<RangeInclusive<i64>> {
    let (least, most) = info.capabilities.iter().find_map(|c| c.strip_prefix("bits="))?.split_once("..")?;
    Some(least.parse().ok()?..=most.parse().ok()?).filter(|range: &RangeInclusive<i64>| !range.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_go_where_they_count() {
        // Array 1 matters 64 times as much per value as array 0: three bits.
        let (counts, matter) = ([1000, 500], [64.0, 2048.0]);
        let tried = std::cell::Cell::new(0);
        let mut attempt = |bits: &[f64]| {
            tried.set(tried.get() + 1);
            let drop = bits.iter().zip(matter).map(|(b, m)| m * 0.25f64.powf(*b)).sum();
            Ok(Attempt { streams: Vec::new(), settings: toml::Table::new(), drop })
        };
        let (bits, found) = search_bits("weights", &counts, 3..=16, 0.064, &mut attempt).unwrap();
        assert!(found.drop <= 0.064 && found.drop > 0.032, "{bits:?} lose {}", found.drop);
        assert_eq!(bits[1] - bits[0], 3.0, "{bits:?}");
        assert!(tried.get() < 10, "{} attempts", tried.get());
        // Nothing is accurate enough.
        let refused = search_bits("weights", &counts, 3..=16, 1e-12, &mut attempt).err().unwrap();
        let expected = "weights of 16 bits, the most there are, lose 4.92e-7 dB, 0.000000000001 dB are allowed";
        assert!(matches!(refused, Error::Parameter { .. }) && refused.to_string().contains(expected), "{refused}");
    }

    #[test]
    fn a_search_is_refused_without_a_scene() {
        let of = |max_drop_db| FieldWeights { name: "compact".into(), settings: toml::Table::new(), max_drop_db };
        of(None).check_without_scene().unwrap();
        let refused = of(Some(0.01)).check_without_scene().unwrap_err().to_string();
        assert!(["compact:max-drop=0.01dB", "--scene", "--field-weights compact:bits=6"].iter().all(|part| refused.contains(part)), "{refused}");
    }

    #[test]
    fn only_codecs_that_state_their_bits_are_searched() {
        let info = |capabilities: &'static [&'static str]| Plugin { name: "w", version: "1", summary: "", paper: "", schema: "bits = 8\n", capabilities };
        assert_eq!(searched_bits(&info(&["lossy", "bits=3..12"])), Some(3..=12));
        assert_eq!(searched_bits(&info(&["lossy"])), None);
        assert_eq!(searched_bits(&info(&["bits=few"])), None);
        assert_eq!(searched_bits(&info(&["bits=12..3"])), None);
    }
}
