//! How images are drawn, in training and afterwards.

use burn::tensor::Tensor;
use cc4dgs_core::archive::RasterizerEntry;
use cc4dgs_core::{BLUR, RenderSettings, Rules};
use serde::{Deserialize, Serialize};

/// The `[rasterizer]` section of a model whose file names none.
pub fn default_rasterizer() -> toml::Table {
    toml::Table::from_iter([("kind".into(), "tile".into())])
}

/// How images are drawn, in training and afterwards.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RenderConfig {
    /// Corner-case rules of projection and blending.
    pub rules: Rules,
    /// Mip-Splatting's 2D filter.
    pub antialiased: bool,
    /// What a pixel adds to both diagonal entries of the projected covariance, square pixels, 0.01 to 100: 0.3 in 3D Gaussian splatting, less is sharper.
    pub blur: f64,
    /// Longest focal length in pixels of the images that the model is trained on. Images with longer ones, which magnify it, blur in proportion. Absent in
    /// a configuration: as found in the scene; in a model: all blur alike.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub focal: Option<f64>,
    /// Smallest camera depth drawn, units of the normalised frame; absent, the rules' own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub near: Option<f32>,
    /// Colour behind everything, RGB in 0..1; absent, the dataset's own, else white (Swift4D's choice).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub background: Option<[f32; 3]>,
}

impl Default for RenderConfig {
    fn default() -> Self {
        Self { rules: Rules::Gsplat099, antialiased: false, blur: BLUR, focal: None, near: None, background: None }
    }
}

impl RenderConfig {
    /// The entry of an archive's manifest, with the rasterizer's name and its settings; the manifest has the background apart.
    pub fn entry(&self, name: String, settings: toml::Table) -> RasterizerEntry {
        let Self { rules, antialiased, blur, focal, near, background: _ } = *self;
        RasterizerEntry { name, rules, antialiased, blur, focal, near, settings }
    }
    /// What a rasterizer is told; the colour behind everything comes as a tensor, `None` is black.
    pub fn settings(&self, background: Option<Tensor<1>>) -> RenderSettings {
        let Self { rules, antialiased, blur, focal, near, background: _ } = *self;
        RenderSettings { rules, antialiased, blur, focal, near, background, ..RenderSettings::default() }
    }
}
