//! The built-in scene: analytic objects, some of them moving, ray-traced from a ring of cameras.
//!
//! Nothing here is made of Gaussians, and everything is known: positions, motion and surfaces are functions of time, so that a reconstruction can be
//! compared with the truth and not only with images.

mod objects;
mod trace;

pub use objects::{Material, Motion, Object, Pose, Shape, Texture};
pub use trace::{Hit, Tracer};

use cc4dgs_core::{
    Camera, Distortion, Error, FrameSource, Image8, ImageSource, InitBox, Limits, Plugin, PointCloud, RawCamera, RawPoints, RawScene, RawView, ReaderPlugin,
    Result, SceneOptions, Seed, Split, inventory, unknown_name,
};
use glam::DVec3;
use rand::Rng;
use std::path::Path;
use std::sync::Arc;

/// What the built-in scene consists of.
#[derive(Clone, Debug, PartialEq)]
pub struct ProceduralScene {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Training cameras, on two rings around the scene.
    pub train_cameras: usize,
    /// Held-out cameras, between the training cameras.
    pub test_cameras: usize,
    /// Frames; the times are spread evenly over 0..1, both ends included.
    pub frames: usize,
    /// Rays per pixel and axis.
    pub supersampling: u32,
    /// Surface samples handed out as initial points.
    pub points: usize,
    /// Standard deviation of the noise on those points, in world units (the scene is 4 wide).
    pub point_noise: f64,
    /// Node of the seed tree for the points.
    pub seed: Seed,
    /// The objects.
    pub objects: Vec<Object>,
    /// Colour where no object is.
    pub background: [f32; 3],
}

/// Names of the built-in scenes: `procedural:NAME`.
pub const NAMES: [&str; 4] = ["default", "static", "tiny", "frequencies"];

/// The name of a built-in scene if `path` is `procedural` or `procedural:NAME`.
pub fn name_of(path: &Path) -> Option<&str> {
    let text = path.to_str()?;
    match text.strip_prefix("procedural")? {
        "" => Some("default"),
        rest => rest.strip_prefix(':'),
    }
}

impl ProceduralScene {
    /// The built-in scene called `name` (one of [`NAMES`]).
    pub fn named(name: &str) -> Result<Self> {
        // The dataset is fixed, like a dataset on disk: its points come from their own root and not from the run's.
        let seed = Seed::root(0).child("procedural").child(name);
        let full = Self {
            width: 128,
            height: 128,
            train_cameras: 12,
            test_cameras: 2,
            frames: 10,
            supersampling: 3,
            points: 4000,
            point_noise: 0.01,
            seed,
            objects: objects::playground(),
            background: [0.55, 0.62, 0.70],
        };
        match name {
            "default" => Ok(full),
            "static" => Ok(Self { frames: 1, ..full }),
            "tiny" => Ok(Self { width: 40, height: 32, train_cameras: 6, test_cameras: 1, frames: 4, supersampling: 2, points: 600, ..full }),
            // Four samples per cycle of the fastest ball.
            "frequencies" => Ok(Self { width: 96, height: 96, frames: 65, supersampling: 2, objects: objects::frequencies(), ..full }),
            other => Err(unknown_name("procedural scene", other, NAMES.into_iter())),
        }
    }
    /// Time of a frame, 0..1.
    pub fn time(&self, frame: usize) -> f64 {
        if self.frames > 1 { frame as f64 / (self.frames - 1) as f64 } else { 0.0 }
    }
    /// The tracer for single rays, with the true surfaces at `time_norm`.
    pub fn tracer(&self, time_norm: f64) -> Tracer {
        Tracer::new(&self.objects, self.background, time_norm)
    }
    /// Where the material point of object `object` that is at `point_world` at time `from` is at time `to` (both 0..1).
    pub fn advect(&self, object: usize, point_world: DVec3, from: f64, to: f64) -> DVec3 {
        let motion = &self.objects[object].motion;
        motion.pose(to).apply(motion.pose(from).inverse_apply(point_world))
    }
    /// Points on the surfaces at time 0, seen from the training cameras, with noise; the last array names the object of each.
    pub fn surface_samples(&self, count: usize) -> (PointCloud, Vec<usize>) {
        let cameras: Vec<Camera> = self.cameras().into_iter().filter(|(_, split)| *split == Split::Train).map(|(c, _)| c).collect();
        let tracer = self.tracer(0.0);
        let mut rng = self.seed.child("points").rng();
        let (mut cloud, mut owners) = (PointCloud::default(), Vec::new());
        // Most rays hit something; the cap only matters for scenes that are nearly empty.
        for _ in 0..count.saturating_mul(20) {
            if cloud.positions.len() == count || cameras.is_empty() {
                break;
            }
            let camera = &cameras[rng.random_range(0..cameras.len())];
            let (u, v) = (rng.random::<f64>() * f64::from(camera.width), rng.random::<f64>() * f64::from(camera.height));
            let (origin, direction) = trace::pixel_ray(camera, u, v);
            if let Some(hit) = tracer.hit(origin, direction) {
                // A sum of uniforms is close enough to a normal distribution for noise.
                let mut normal = || (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0;
                let noise = DVec3::new(normal(), normal(), normal()) * self.point_noise;
                cloud.positions.push((hit.point + noise).as_vec3().to_array());
                cloud.colors.push(tracer.shade(&hit, direction).map(|c| c.clamp(0.0, 1.0) as f32));
                owners.push(hit.object);
            }
        }
        (cloud, owners)
    }
    /// All cameras with their side of the split. World axes: z up, the floor at 0.
    pub fn cameras(&self) -> Vec<(Camera, Split)> {
        let target = [0.0, 0.0, 0.55];
        let camera = |name: String, turn: f64, height: f64, radius: f64| {
            let (s, c) = (turn * std::f64::consts::TAU).sin_cos();
            Camera::look_at(&name, (self.width, self.height), 0.85, [radius * c, radius * s, height], target, [0.0, 0.0, 1.0])
        };
        let mut cameras = Vec::new();
        for i in 0..self.train_cameras {
            let (height, radius) = if i % 2 == 0 { (1.3, 4.2) } else { (2.5, 3.8) };
            cameras.push((camera(format!("train{i:02}"), i as f64 / self.train_cameras as f64, height, radius), Split::Train));
        }
        for i in 0..self.test_cameras {
            let turn = (i as f64 + 0.5) / self.test_cameras as f64 + 0.5 / self.train_cameras.max(1) as f64;
            cameras.push((camera(format!("test{i:02}"), turn, 1.9, 4.0), Split::Test));
        }
        cameras
    }
    /// Renders one image; `time_norm` in 0..1.
    pub fn render(&self, camera: &Camera, time_norm: f64) -> Image8 {
        self.tracer(time_norm).render(camera, self.supersampling)
    }
}

/// Images traced when they are asked for; the index counts cameras first, then frames.
struct TracedFrames {
    scene: ProceduralScene,
    cameras: Vec<Camera>,
}

impl FrameSource for TracedFrames {
    fn load(&self, index: usize) -> Result<Image8> {
        let count = self.cameras.len() * self.scene.frames;
        if index >= count {
            return Err(Error::parameter(format!("image {index}"), format!("the procedural scene has {count}"), "Ask for an image that exists"));
        }
        Ok(self.scene.render(&self.cameras[index % self.cameras.len()], self.scene.time(index / self.cameras.len())))
    }
}

inventory::submit! {
    ReaderPlugin {
        info: Plugin {
            name: "procedural",
            version: "1",
            summary: "the built-in ray-traced scene, whose motion is known",
            paper: "this project",
            schema: "",
            capabilities: &[],
        },
        looks_for: "the word procedural or procedural:NAME (default, static, tiny, frequencies)",
        order: 0,
        probe,
        open,
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
    Ok(scene.into_raw(format!("procedural:{name}")))
}

impl ProceduralScene {
    /// The scene as a reader hands it over; [`super::assemble`] makes a [`cc4dgs_core::Scene`] of it. Its images already have their final size.
    pub fn into_raw(self, name: String) -> RawScene {
        let rig = self.cameras();
        let camera = |camera: &Camera| RawCamera {
            name: camera.name.clone(),
            size: [camera.width, camera.height],
            focal: [camera.fx, camera.fy],
            principal: [camera.cx, camera.cy],
            distortion: Distortion::None,
            world_to_camera: camera.world_to_camera,
        };
        let cameras = rig.iter().map(|(c, _)| camera(c)).collect();
        let points = self.surface_samples(self.points).0;
        let times: Vec<f64> = (0..self.frames).map(|frame| self.time(frame)).collect();
        let background = self.background;
        let source: Arc<dyn FrameSource> = Arc::new(TracedFrames { scene: self, cameras: rig.iter().map(|(c, _)| c.clone()).collect() });
        let mut views = Vec::with_capacity(times.len() * rig.len());
        for (frame, &time) in times.iter().enumerate() {
            for (camera, (_, split)) in rig.iter().enumerate() {
                let image = ImageSource::Frames { source: source.clone(), index: frame * rig.len() + camera };
                views.push(RawView { camera, frame, time: Some(time), split: *split, image });
            }
        }
        RawScene {
            name,
            cameras,
            views,
            points: Some(RawPoints { positions: points.positions.iter().map(|p| p.map(f64::from)).collect(), colors: points.colors }),
            init_box: Some(InitBox::Corners { low: [-2.0, -2.0, -0.1], high: [2.0, 2.0, 2.2] }),
            background: Some(background),
            resized: true,
            warnings: Vec::new(),
        }
    }
}
