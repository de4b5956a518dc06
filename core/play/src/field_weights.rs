//! How the weights of a field are stored: `name`, `name:setting=value`, or `name:max-drop=0.01dB`, which searches the fewest bits that keep the PSNR.

use crate::archive::load_weights;
use crate::codec_services::ModelServices;
use crate::model::{Model, ModelDeformer, ModelSize};
use burn::tensor::Device;
use cc4dgs_core::{CodecContext, Error, Event, Registry, RenderModel, Result, Stream, TrainingViews, WeightArray, WeightCodec, config};

/// Views on which the loss is measured.
const VIEWS: usize = 16;
/// The setting that a search changes, and its values from the most accurate.
const BITS: &str = "bits";
const SEARCHED: [i64; 10] = [12, 11, 10, 9, 8, 7, 6, 5, 4, 3];

/// A weight codec with its settings.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldWeights {
    /// Name of the weight codec.
    pub name: String,
    /// Its settings.
    pub settings: toml::Table,
    /// Largest loss of PSNR on training views in dB, for a search.
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
        let searchable = registry.weight_codec(name)?.info.schema.contains(BITS);
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
    /// The weights of `field` as streams, and the settings that were chosen.
    pub(crate) fn encode(
        &self,
        model: &Model,
        weights: &[WeightArray],
        scene: Option<&Device>,
        context: &CodecContext,
        registry: &Registry,
    ) -> Result<(Vec<Stream>, toml::Table)> {
        let Some(limit) = self.max_drop_db else {
            return Ok((registry.build_weight_codec(&self.name, &self.settings)?.encode(weights, context)?, self.settings.clone()));
        };
        let (Some(device), Some(views)) = (scene, context.views.filter(|v| !v.is_empty())) else {
            let problem = "a loss of PSNR is measured on training views, and there are none";
            return Err(Error::parameter("weight codec", problem, "Give the dataset with --scene, or a number of bits such as compact:bits=6"));
        };
        let before = psnr(&ModelServices::new(model, registry, device)?, model, views)?;
        let mut best = None;
        for bits in SEARCHED {
            let mut settings = self.settings.clone();
            settings.insert(BITS.into(), bits.into());
            let codec = registry.build_weight_codec(&self.name, &settings)?;
            let streams = codec.encode(weights, context)?;
            let drop = before - self.decoded(model, codec.as_ref(), &streams, device, context, views, registry)?;
            // The most accurate form is taken even if it loses more; the note says how much.
            if best.is_some() && drop > limit {
                break;
            }
            best = Some((streams, settings, bits, drop));
        }
        let Some((streams, settings, bits, drop)) = best else { return Err(Error::backend("weight codec", "no number of bits was tried", "Report this")) };
        let object = format!("weight codec {}", self.name);
        let message = format!("{bits} bits, PSNR {drop:.4} dB lower on {} training views ({limit} dB allowed)", views.len().min(VIEWS));
        context.events.emit(&if drop > limit { Event::Warning { object, message } } else { Event::Note { object, message } });
        Ok((streams, settings))
    }
    /// PSNR of the model with decoded weights.
    #[expect(clippy::too_many_arguments, reason = "all of one attempt")]
    fn decoded(
        &self,
        model: &Model,
        codec: &dyn WeightCodec,
        streams: &[Stream],
        device: &Device,
        context: &CodecContext,
        views: &dyn TrainingViews,
        registry: &Registry,
    ) -> Result<f64> {
        let Some(of) = &model.field else { return Ok(0.0) };
        let found = codec.decode(streams, &CodecContext::new(context.seed.child("search"), context.limits, context.events))?;
        let mut field = registry.build_deformer(&of.section, &of.context, device)?;
        load_weights("encoded weights", field.as_mut(), found, device)?;
        let other = Model {
            gaussians: model.gaussians.clone(),
            field: Some(ModelDeformer { field, section: of.section.clone(), context: of.context.clone() }),
            moving: model.moving,
            render: model.render.clone(),
            background: model.background,
            rasterizer: model.rasterizer.clone(),
            frame_count: model.frame_count,
            normalisation: model.normalisation,
            provenance: model.provenance.clone(),
            size: ModelSize::default(),
        };
        psnr(&ModelServices::new(&other, registry, device)?, &other, views)
    }
}

/// Mean PSNR of renders against the recorded images.
fn psnr(services: &ModelServices, model: &Model, views: &dyn TrainingViews) -> Result<f64> {
    let chosen = views.len().min(VIEWS);
    let mut sum = 0.0;
    for k in 0..chosen {
        let index = k * views.len() / chosen;
        let (camera, time_norm) = views.view(index);
        let drawn = services.render(&model.gaussians, camera, time_norm)?;
        let truth = views.image(index)?.to_planes(services.background());
        let error: f64 = truth.iter().zip(&drawn.planes).map(|(a, b)| f64::from(a - b.clamp(0.0, 1.0)).powi(2)).sum::<f64>() / truth.len().max(1) as f64;
        sum += -10.0 * error.max(1e-12).log10();
    }
    Ok(sum / chosen.max(1) as f64)
}
