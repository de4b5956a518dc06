//! What a codec may use of a model and its scene while it encodes: training views, a renderer, the field.

use crate::model::Model;
use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{
    Camera, EvaluateDeformer, Gaussians, HostGaussians, Image8, Rasterizer, Registry, RenderModel, RenderSettings, RenderedPlanes, Result, Scene, SpatialInput,
    Splats, Split, TrainingViews,
};

/// The training views of a scene.
pub struct SceneViews<'a> {
    scene: &'a Scene,
    views: Vec<usize>,
}

impl<'a> SceneViews<'a> {
    /// The training views of `scene`, in its order.
    pub fn new(scene: &'a Scene) -> Self {
        Self { scene, views: scene.split(Split::Train) }
    }
}

impl TrainingViews for SceneViews<'_> {
    fn len(&self) -> usize {
        self.views.len()
    }
    fn view(&self, index: usize) -> (&Camera, f32) {
        let view = self.views[index];
        (self.scene.camera(view), self.scene.views[view].time_norm)
    }
    fn image(&self, index: usize) -> Result<Image8> {
        Ok(self.scene.frame(self.views[index])?.as_ref().clone())
    }
}

/// Moves and draws Gaussians as a model does.
pub struct ModelServices<'a> {
    model: &'a Model,
    device: Device,
    rasterizer: Box<dyn Rasterizer>,
    settings: RenderSettings,
}

impl<'a> ModelServices<'a> {
    /// Services of `model` on `device`, which its field must be on.
    pub fn new(model: &'a Model, registry: &Registry, device: &Device) -> Result<Self> {
        let background = Tensor::<1>::from_data(TensorData::new(model.background_on(None).to_vec(), [3]), device);
        let rasterizer = registry.build_rasterizer(&model.rasterizer)?;
        Ok(Self { model, device: device.clone(), rasterizer, settings: model.render.settings(Some(background)) })
    }
    fn moved(&self, host: &HostGaussians, time_norm: f32) -> Result<Gaussians> {
        let canonical = Gaussians::from_host(host, &self.device);
        let rows = self.model.moving.rows(&host.dynamic_scores);
        let nothing_moves = host.is_empty() || rows.as_ref().is_some_and(Vec::is_empty);
        let Some(field) = self.model.field.as_ref().filter(|f| !nothing_moves && !f.field.is_static()) else { return Ok(canonical) };
        let rows = rows.map(|rows| {
            let indices: Vec<i64> = rows.iter().map(|&row| row as i64).collect();
            Tensor::<1, Int>::from_data(TensorData::new(indices, [rows.len()]), &self.device)
        });
        let select = |values: &Tensor<2>| rows.as_ref().map_or_else(|| values.clone(), |rows| values.clone().select(0, rows.clone()));
        let attributes: Vec<Tensor<2>> = field.field.attributes().iter().filter_map(|spec| canonical.extra.get(&spec.name)).map(select).collect();
        let features = field.field.spatial(&SpatialInput { means_world: select(&canonical.means), attributes })?.values;
        field.field.deform(features, time_norm)?.apply(field.name(), &canonical, rows.as_ref())
    }
}

impl EvaluateDeformer for ModelServices<'_> {
    fn deform(&self, gaussians: &HostGaussians, time_norm: f32) -> Result<HostGaussians> {
        self.moved(gaussians, time_norm)?.to_host()
    }
}

impl RenderModel for ModelServices<'_> {
    fn render(&self, gaussians: &HostGaussians, camera: &Camera, time_norm: f32) -> Result<RenderedPlanes> {
        let moved = self.moved(gaussians, time_norm)?;
        let output = self.rasterizer.render(&Splats::from_gaussians(&moved, moved.sh_degree), camera, &self.settings)?;
        Ok(RenderedPlanes { width: camera.width, height: camera.height, planes: to_vec(output.planes, "rendered planes")? })
    }
}
