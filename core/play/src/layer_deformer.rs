//! A playback layer as a deformer: how archives move whose deformer was left out.

use crate::model::ModelDeformer;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::playback::{Head, PlaybackLayer};
use cc4dgs_core::{
    AttributeSpec, Deformer, DeformerContext, Error, ExtraAttribute, HostGaussians, Offsets, Parameter, ParameterGroup, Result, SpatialFeatures, SpatialInput,
};

/// The name in place of that of a deformer. No plug-in has it, because such a deformer has no weights to store.
pub(crate) const PLAYBACK_LAYER: &str = "playback-layer";
/// The attribute that says which row of the layer a Gaussian has.
const ROW: &str = "playback.row";
/// Indices are stored as float32.
const MOST_ROWS: usize = 1 << f32::MANTISSA_DIGITS;

struct LayerDeformer {
    /// The layer, whose rows are those of `still`.
    layer: PlaybackLayer,
    /// The moving Gaussians without motion.
    still: HostGaussians,
    heads: Vec<Head>,
    device: Device,
}

/// The deformer that moves `gaussians` as `layer` does. Moving Gaussians get an attribute, the index of their row; `moving` are the indices of those that the
/// archive says may move. `object` names the archive in errors.
///
/// # Errors
/// [`Error::Data`] for a layer of other Gaussians, [`Error::Unsupported`] for more than 2^24 of them.
pub(crate) fn of_layer(
    object: &str,
    mut layer: PlaybackLayer,
    gaussians: &mut HostGaussians,
    moving: &[usize],
    context: &DeformerContext,
    device: &Device,
) -> Result<ModelDeformer> {
    let rows: Vec<usize> = layer.rows.iter().map(|&row| row as usize).collect();
    if rows != moving {
        let problem = format!("its playback layer moves {} Gaussians, the manifest says that {} may move, and they are not the same", rows.len(), moving.len());
        return Err(Error::data(object, problem, "Bake it again from the model that it was made of"));
    }
    if rows.len() > MOST_ROWS {
        let remedy = "Use the archive with its deformer, or prune the model";
        return Err(Error::unsupported(object, format!("{} Gaussians move, at most {MOST_ROWS} can without a deformer", rows.len()), remedy));
    }
    let still = gaussians.select(&rows);
    let mut indices = vec![0.0; gaussians.len()];
    rows.iter().enumerate().for_each(|(k, &row)| indices[row] = k as f32);
    gaussians.extra.insert(ROW.into(), ExtraAttribute::exact(1, indices));
    layer.rows = (0..rows.len() as u32).collect();
    let heads = Head::ALL.into_iter().filter(|head| layer.segments.iter().flat_map(|s| &s.tracks).any(|t| t.head == *head)).collect();
    let section = toml::Table::from_iter([("kind".to_string(), PLAYBACK_LAYER.into())]);
    let field = LayerDeformer { layer, still, heads, device: device.clone() };
    Ok(ModelDeformer { field: Box::new(field), section, context: context.clone() })
}

impl LayerDeformer {
    /// Changes of a column of `width` numbers, for the rows `indices`.
    fn change(&self, indices: &[usize], width: usize, before: &[f32], after: &[f32]) -> TensorData {
        let row = |&k: &usize| after[k * width..(k + 1) * width].iter().zip(&before[k * width..(k + 1) * width]).map(|(a, b)| a - b);
        TensorData::new(indices.iter().flat_map(row).collect::<Vec<f32>>(), [indices.len(), width])
    }
}

impl Deformer for LayerDeformer {
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        input.check(PLAYBACK_LAYER, &self.attributes())?;
        Ok(SpatialFeatures { values: input.attributes[0].clone(), work: Default::default() })
    }
    fn attributes(&self) -> Vec<AttributeSpec> {
        vec![AttributeSpec::new(ROW, 1, 0.0, 0.0)]
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        let indices: Vec<usize> = to_vec(features, "rows of the playback layer")?.into_iter().map(|v| v as usize).collect();
        if let Some(row) = indices.iter().find(|row| **row >= self.still.len()) {
            return Err(Error::data("playback layer", format!("row {row} of {}", self.still.len()), "Open the archive again"));
        }
        let moved = self.layer.apply(&self.still, time_norm);
        let mut out = Offsets::default();
        let tensor = |data: TensorData| Tensor::<2>::from_data(data, &self.device);
        for head in &self.heads {
            match head {
                Head::Means => out.means = Some(tensor(self.change(&indices, 3, &self.still.means, &moved.means))),
                Head::LogScales => out.log_scales = Some(tensor(self.change(&indices, 3, &self.still.log_scales, &moved.log_scales))),
                Head::Rotations => out.quaternions = Some(tensor(self.change(&indices, 4, &self.still.quaternions, &moved.quaternions))),
                Head::Opacities => {
                    let logits = tensor(self.change(&indices, 1, &self.still.opacity_logits, &moved.opacity_logits));
                    out.opacity_logits = Some(logits.reshape([indices.len()]));
                }
                Head::Colors => {
                    let rest = self.still.sh_rest.len() / self.still.len().max(1);
                    let dc = tensor(self.change(&indices, 3, &self.still.sh_dc, &moved.sh_dc));
                    let rest = tensor(self.change(&indices, rest, &self.still.sh_rest, &moved.sh_rest));
                    let width = 3 + rest.dims()[1];
                    out.sh = Some(Tensor::cat(vec![dc, rest], 1).reshape([indices.len(), width / 3, 3]));
                }
            }
        }
        Ok(out)
    }
    fn parameters(&self) -> Vec<&Parameter> {
        Vec::new()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        Vec::new()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        Vec::new()
    }
}
