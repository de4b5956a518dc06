//! The weights of a deformer in fine-tuning, as their codec stores them.

use super::rounded::WeightScale;
use super::tune::TuneJob;
use burn::tensor::{Tensor, TensorData};
use cc4dgs_core::{CodecContext, EncodedWeights, Error, Result, WeightArray, WeightCodec, WeightSteps, weight_seed};
use cc4dgs_play::codec_services::SceneViews;
use cc4dgs_play::field_weights::FieldWeights;

/// How the weights of a model are stored. It is chosen once, for the model without training.
pub(super) struct StoredWeights {
    chosen: FieldWeights,
    /// How much images depend on each weight, where the codec makes use of it.
    importance: Option<Vec<Vec<f32>>>,
    settings: toml::Table,
}

impl StoredWeights {
    /// How the weights of the model of `job` are stored; nothing is measured unless it `moves`.
    pub fn choose(job: &TuneJob, moves: bool) -> Result<Self> {
        let TuneJob { model, scene, registry, device, limits, events, .. } = job;
        let chosen = FieldWeights::parse(job.field_weights, registry)?;
        if !moves {
            return Ok(Self { settings: chosen.settings.clone(), chosen, importance: None });
        }
        let importance = chosen.importance(model, &SceneViews::new(scene), registry, device, *events)?;
        let settings = chosen.settings_for(model, (scene, importance.as_deref()), registry, device, limits, *events)?;
        Ok(Self { chosen, importance, settings })
    }
    /// The codec in steps that are `weight_steps` times the chosen ones, and its settings.
    pub fn codec(&self, job: &TuneJob, weight_steps: f64) -> Result<(Box<dyn WeightCodec>, toml::Table)> {
        let settings = self.chosen.coarser(&self.settings, weight_steps, job.registry)?;
        Ok((job.registry.build_weight_codec(&self.chosen.name, &settings)?, settings))
    }
    fn context<'a>(&'a self, job: &'a TuneJob) -> CodecContext<'a> {
        let context = CodecContext::new(weight_seed(job.model.provenance.seed), *job.limits, job.events);
        CodecContext { weight_importance: self.importance.as_deref(), ..context }
    }
    /// `weights` in such steps, as they are stored.
    pub fn encode(&self, job: &TuneJob, weights: &[WeightArray], weight_steps: f64) -> Result<EncodedWeights> {
        let (codec, settings) = self.codec(job, weight_steps)?;
        Ok((codec.encode(weights, &self.context(job))?, settings))
    }
    /// `weights` as `codec` decodes them.
    pub fn rounded(&self, job: &TuneJob, weights: &[WeightArray], codec: &dyn WeightCodec) -> Result<Vec<WeightArray>> {
        if weights.is_empty() {
            return Ok(Vec::new());
        }
        codec.round(weights, &self.context(job))
    }
    /// The steps of `weights`, where their codec states them and they were searched, and derivatives of the size per step, each bit counted as `per_bit`.
    pub fn scales(&self, job: &TuneJob, weights: &[WeightArray], codec: &dyn WeightCodec, per_bit: f64) -> Result<Option<Vec<Option<WeightScale>>>> {
        if self.chosen.max_drop_db.is_none() {
            // Steps that nothing chose may be so small that no weight gets from one to the next.
            return Ok(None);
        }
        let Some(WeightSteps { steps, bit_slopes }) = codec.steps(weights, &self.context(job))? else { return Ok(None) };
        let lengths = |arrays: &[Vec<f32>]| arrays.iter().map(Vec::len).collect::<Vec<_>>();
        let expected: Vec<usize> = weights.iter().map(|array| array.values.len()).collect();
        if lengths(&steps) != expected || lengths(&bit_slopes) != expected {
            let object = format!("weight codec {}", self.chosen.name);
            return Err(Error::parameter(object, "it states other numbers of steps than there are weights", "Return one step and one slope per weight"));
        }
        let upload = |values: Vec<f32>| {
            let count = values.len();
            Tensor::<1>::from_data(TensorData::new(values, [count]), job.device)
        };
        let scale = |(steps, slopes): (Vec<f32>, Vec<f32>)| {
            let moves = steps.iter().any(|step| *step > 0.0);
            moves.then(|| WeightScale { steps: upload(steps), size: upload(slopes).mul_scalar(per_bit) })
        };
        Ok(Some(steps.into_iter().zip(bit_slopes).map(scale).collect()))
    }
}
