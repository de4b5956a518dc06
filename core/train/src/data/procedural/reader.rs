//! The built-in scenes as a dataset: `procedural`, `procedural:NAME`.

use super::{NAMES, ProceduralScene, Sensor, Viewpoint};
use cc4dgs_core::{
    DepthImage, Distortion, Error, FrameSource, Image8, ImageSource, Limits, Plugin, RawCamera, RawPoints, RawScene, RawView, ReaderPlugin, Result,
    SceneOptions, inventory,
};
use std::path::Path;
use std::sync::Arc;

inventory::submit! {
    ReaderPlugin {
        info: Plugin {
            name: "procedural",
            version: "1",
            summary: "built-in ray-traced scenes, whose motion is known",
            paper: "this project",
            schema: "",
            capabilities: &[],
        },
        looks_for: "the word procedural or procedural:NAME (default, static, tiny, frequencies, captures/dome, captures/handheld, …; captures/NAME:SEED)",
        order: 0,
        probe,
        open,
    }
}

/// The name of a built-in scene if `path` is `procedural` or `procedural:NAME`.
pub fn name_of(path: &Path) -> Option<&str> {
    let text = path.to_str()?;
    match text.strip_prefix("procedural")? {
        "" => Some("default"),
        rest => rest.strip_prefix(':'),
    }
}

fn probe(path: &Path) -> bool {
    name_of(path).is_some()
}

/// `scene.frames = [0, COUNT, 1]` with more frames than the scene has samples its motion more finely.
fn open(path: &Path, options: &SceneOptions, limits: &Limits) -> Result<RawScene> {
    let Some(name) = name_of(path) else {
        return Err(Error::parameter(
            format!("scene {}", path.display()),
            "it is not a procedural scene",
            format!("Write procedural:NAME, one of {}", NAMES.join(", ")),
        ));
    };
    Ok(with_options(name, options, limits)?.into_raw(format!("procedural:{name}")))
}

/// The built-in scene that `path` names, as `options` want it. `None` where `path` names no built-in scene, and where `options` choose some of its frames.
///
/// # Errors
/// As for reading it.
pub fn whole_scene(path: &Path, options: &SceneOptions, limits: &Limits) -> Result<Option<ProceduralScene>> {
    let whole = options.frames.is_none_or(|[first, _, step]| (first, step) == (0, 1));
    name_of(path).filter(|_| whole).map(|name| with_options(name, options, limits)).transpose()
}

fn with_options(name: &str, options: &SceneOptions, limits: &Limits) -> Result<ProceduralScene> {
    let mut scene = ProceduralScene::named(name)?;
    (scene.width, scene.height) = options.target_size((scene.width, scene.height));
    limits.check_pixels(&format!("procedural scene {name}"), u64::from(scene.width), u64::from(scene.height))?;
    if let Some(background) = &options.background {
        scene.background = background.rgb()?;
    }
    if let Some([0, count, 1]) = options.frames.filter(|f| f[1] > 0) {
        // As many images as bytes may be read is a generous cap, and one all the same.
        limits.check_bytes(&format!("procedural scene {name}: frames"), (count as u64).saturating_mul(1 << 16))?;
        scene.frames = count;
    }
    Ok(scene)
}

/// Images traced when they are asked for.
struct TracedFrames {
    scene: ProceduralScene,
    viewpoints: Vec<Viewpoint>,
    sensors: Vec<Sensor>,
    /// Viewpoint and frame of each image.
    images: Vec<(usize, usize)>,
}

impl TracedFrames {
    /// Viewpoint and frame of an image.
    fn taken(&self, index: usize) -> Result<(usize, usize)> {
        let problem = || format!("the procedural scene has {}", self.images.len());
        self.images.get(index).copied().ok_or_else(|| Error::parameter(format!("image {index}"), problem(), "Ask for an image that exists"))
    }
}

impl FrameSource for TracedFrames {
    fn load(&self, index: usize) -> Result<Image8> {
        let (viewpoint, frame) = self.taken(index)?;
        let noise = self.scene.seed.child("noise").index(viewpoint as u64).index(frame as u64);
        let tracer = self.scene.tracer(self.scene.time(frame));
        Ok(self.sensors[viewpoint].image(&tracer, &self.viewpoints[viewpoint].camera, self.scene.supersampling, noise))
    }
    /// Through a lens, which no held-out camera has, the mask is not traced.
    fn motion_mask(&self, index: usize) -> Result<Option<Image8>> {
        let (viewpoint, frame) = self.taken(index)?;
        let camera = &self.viewpoints[viewpoint].camera;
        let white = |moves: bool| [if moves { 255 } else { 0 }; 3];
        let mask = || {
            let data = self.scene.moving_pixels(camera, self.scene.time(frame)).into_iter().flat_map(white).collect();
            Image8 { width: camera.width, height: camera.height, channels: 3, data }
        };
        Ok(self.sensors[viewpoint].distortion.is_identity().then(mask))
    }
    fn depth(&self, index: usize) -> Result<Option<DepthImage>> {
        let (viewpoint, frame) = self.taken(index)?;
        Ok(Some(self.sensors[viewpoint].depth(&self.scene.tracer(self.scene.time(frame)), &self.viewpoints[viewpoint].camera)))
    }
}

impl ProceduralScene {
    /// The scene as a reader hands it over; [`crate::data::assemble`] makes a [`cc4dgs_core::Scene`] of it. Its images already have their final size.
    pub fn into_raw(self, name: String) -> RawScene {
        let viewpoints = self.viewpoints();
        let sensors = self.sensors_of(&viewpoints);
        let camera = |(Viewpoint { camera, .. }, sensor): (&Viewpoint, &Sensor)| RawCamera {
            name: camera.name.clone(),
            size: [camera.width, camera.height],
            focal: [camera.fx, camera.fy],
            principal: [camera.cx, camera.cy],
            distortion: if sensor.distortion.is_identity() { Distortion::None } else { sensor.distortion.clone() },
            world_to_camera: camera.world_to_camera,
        };
        let cameras = viewpoints.iter().zip(&sensors).map(camera).collect();
        let points = (self.points > 0).then(|| self.surface_samples(self.points).0);
        let times: Vec<f64> = (0..self.frames).map(|frame| self.time(frame)).collect();
        let takes = |frame: usize| viewpoints.iter().enumerate().filter(move |(_, v)| v.frame.is_none_or(|own| own == frame)).map(move |(v, _)| (v, frame));
        let images: Vec<(usize, usize)> = (0..self.frames).flat_map(takes).collect();
        let splits: Vec<_> = viewpoints.iter().map(|v| v.split).collect();
        let (background, init_box) = (self.background_is_stated.then_some(self.background), self.init_box);
        let source: Arc<dyn FrameSource> = Arc::new(TracedFrames { scene: self, viewpoints, sensors, images: images.clone() });
        let view = |(index, &(camera, frame)): (usize, &(usize, usize))| {
            let image = ImageSource::Frames { source: source.clone(), index };
            RawView { camera, frame, time: Some(times[frame]), split: splits[camera], image }
        };
        RawScene {
            name,
            cameras,
            views: images.iter().enumerate().map(view).collect(),
            points: points.map(|p| RawPoints { positions: p.positions.iter().map(|p| p.map(f64::from)).collect(), colors: p.colors }),
            init_box,
            background,
            resized: true,
            warnings: Vec::new(),
        }
    }
}
