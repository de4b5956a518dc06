//! Built-in scenes: analytic objects, some of them moving, ray-traced from an arrangement of cameras.
//!
//! Nothing here is made of Gaussians, and everything is known: positions, motion and surfaces are functions of time, so that a reconstruction can be
//! compared with the truth and not only with images. `procedural:captures/NAME` are scenes that look like what people bring ([`captures`]).

pub mod captures;
mod figure;
mod objects;
mod reader;
mod rig;
mod sensor;
mod shapes;
mod textures;
mod trace;

pub use figure::{Arms, Figure, Part, Path, Side};
pub use objects::{ALWAYS, Material, Motion, Object, Pose};
pub use reader::{name_of, whole_scene};
pub use rig::{Rig, Viewpoint};
pub use sensor::{Noise, Sensor, Sensors};
pub use shapes::Shape;
pub use textures::{Rgb, Texture};
pub use trace::{Hit, Tracer};

use cc4dgs_core::{Camera, Image8, InitBox, PointCloud, Result, Seed, Similarity, Split, unknown_name};
use glam::DVec3;
use rand::Rng;
use std::ops::Range;

/// Objects that are scored together when their motion is compared with the truth.
#[derive(Clone, Debug, PartialEq)]
pub struct Body {
    /// What it is.
    pub name: String,
    /// Indices of its objects.
    pub objects: Range<usize>,
    /// Cycles of its motion over the sequence, if it repeats.
    pub cycles: Option<f64>,
}

/// What a built-in scene consists of. Objects and rig are in metres; everything its methods take and return is in the dataset's coordinates, see
/// [`ProceduralScene::unit`].
#[derive(Clone, Debug, PartialEq)]
pub struct ProceduralScene {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// The cameras.
    pub rig: Rig,
    /// Their lenses and sensors.
    pub sensors: Sensors,
    /// Frames; the times are spread evenly over 0..1, both ends included.
    pub frames: usize,
    /// Rays per pixel and axis.
    pub supersampling: u32,
    /// Surface samples handed out as initial points; 0 for a dataset without points.
    pub points: usize,
    /// Standard deviation of the noise on those points, in dataset units (the first scenes are 4 wide).
    pub point_noise: f64,
    /// Node of the seed tree for points, irregular cameras and noise.
    pub seed: Seed,
    /// The objects.
    pub objects: Vec<Object>,
    /// The objects that are scored together.
    pub bodies: Vec<Body>,
    /// Colour where no object is.
    pub background: [f32; 3],
    /// Whether the dataset says what its background is.
    pub background_is_stated: bool,
    /// Where the dataset says it is.
    pub init_box: Option<InitBox>,
    /// From metres to the dataset's coordinates.
    pub unit: Similarity,
}

/// Names of the built-in scenes: `procedural:NAME`. Captures take a seed: `procedural:captures/dome:7`.
pub const NAMES: [&str; 17] = [
    "default",
    "static",
    "tiny",
    "frequencies",
    "captures/dome",
    "captures/rig",
    "captures/handheld",
    "captures/photos",
    "captures/turntable",
    "captures/sparse",
    "captures/long",
    "captures/exposure",
    "captures/lens",
    "captures/units",
    "captures/units-km",
    "captures/dark",
    "captures/appear",
];

impl ProceduralScene {
    /// The built-in scene called `name` (one of [`NAMES`], captures with `:SEED` if it is not 0).
    pub fn named(name: &str) -> Result<Self> {
        if let Some(capture) = name.strip_prefix("captures/") {
            return captures::named(capture);
        }
        // The dataset is fixed, like a dataset on disk: its points come from their own root and not from the run's.
        let seed = Seed::root(0).child("procedural").child(name);
        let full = Self {
            width: 128,
            height: 128,
            rig: Rig::Rings { train: 12, test: 2 },
            sensors: Sensors::IDEAL,
            frames: 10,
            supersampling: 3,
            points: 4000,
            point_noise: 0.01,
            seed,
            objects: objects::playground(),
            bodies: Vec::new(),
            background: [0.55, 0.62, 0.70],
            background_is_stated: true,
            init_box: Some(InitBox::Corners { low: [-2.0, -2.0, -0.1], high: [2.0, 2.0, 2.2] }),
            unit: Similarity::IDENTITY,
        };
        match name {
            "default" => Ok(full),
            "static" => Ok(Self { frames: 1, ..full }),
            "tiny" => Ok(Self { width: 40, height: 32, rig: Rig::Rings { train: 6, test: 1 }, frames: 4, supersampling: 2, points: 600, ..full }),
            // Four samples per cycle of the fastest ball.
            "frequencies" => {
                let objects = objects::frequencies();
                let ball = |(index, object): (usize, &Object)| match object.motion {
                    Motion::Sway { cycles, .. } => Some(Body { name: format!("ball {index}"), objects: index..index + 1, cycles: Some(cycles) }),
                    _ => None,
                };
                let bodies = objects.iter().enumerate().filter_map(ball).collect();
                Ok(Self { width: 96, height: 96, frames: 65, supersampling: 2, objects, bodies, ..full })
            }
            other => Err(unknown_scene(other)),
        }
    }
    /// Time of a frame, 0..1.
    pub fn time(&self, frame: usize) -> f64 {
        if self.frames > 1 { frame as f64 / (self.frames - 1) as f64 } else { 0.0 }
    }
    /// The tracer for single rays, with the true surfaces at `time_norm`.
    pub fn tracer(&self, time_norm: f64) -> Tracer {
        Tracer::new(&self.objects, self.background, self.unit, time_norm)
    }
    /// Whether the ray through the centre of each pixel, row by row, meets an object that moves during the sequence.
    pub fn moving_pixels(&self, camera: &Camera, time_norm: f64) -> Vec<bool> {
        let moves = |object: usize| !self.objects[object].motion.is_still();
        self.tracer(time_norm).objects_seen(camera).into_iter().map(|seen| seen.is_some_and(moves)).collect()
    }
    /// Where the material point of object `object` that is at `point_world` at time `from` is at time `to` (both 0..1).
    pub fn advect(&self, object: usize, point_world: DVec3, from: f64, to: f64) -> DVec3 {
        let motion = &self.objects[object].motion;
        DVec3::from(self.unit.apply(motion.pose(to).apply(motion.pose(from).inverse_apply(self.metres(point_world))).to_array()))
    }
    /// How deep a point lies in object `object` at `time_norm`: 0 at the deepest point of a ball or a rod, 1 on the surface, more outside.
    pub fn depth_share(&self, object: usize, point_world: DVec3, time_norm: f64) -> f64 {
        let o = &self.objects[object];
        1.0 + o.shape.distance(o.motion.pose(time_norm).inverse_apply(self.metres(point_world))) / o.shape.inner_radius()
    }
    fn metres(&self, p: DVec3) -> DVec3 {
        DVec3::from(self.unit.inverse().apply(p.to_array()))
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
            let (origin, direction) = trace::PixelRays::new(camera).through(u, v);
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
    /// All positions of cameras, and what is taken there. World axes: z up, the floor at 0.
    pub fn viewpoints(&self) -> Vec<Viewpoint> {
        let mut viewpoints = self.rig.viewpoints((self.width, self.height), self.frames, self.seed.child("rig"));
        // The identity would still round.
        if self.unit != Similarity::IDENTITY {
            viewpoints.iter_mut().for_each(|v| v.camera = self.unit.apply_camera(&v.camera));
        }
        viewpoints
    }
    /// The lens and sensor of each viewpoint.
    pub fn sensors_of(&self, viewpoints: &[Viewpoint]) -> Vec<Sensor> {
        self.sensors.of(&viewpoints.iter().map(|v| v.split).collect::<Vec<_>>(), self.seed.child("sensors"))
    }
    /// The camera of each viewpoint with its side of the split.
    pub fn cameras(&self) -> Vec<(Camera, Split)> {
        self.viewpoints().into_iter().map(|v| (v.camera, v.split)).collect()
    }
    /// Renders one image of an ideal camera with the scene's exposure; `time_norm` in 0..1. Held-out images are such images.
    pub fn render(&self, camera: &Camera, time_norm: f64) -> Image8 {
        let sensor = Sensor { gain: [self.sensors.exposure; 3], ..Sensor::IDEAL };
        sensor.image(&self.tracer(time_norm), camera, self.supersampling, self.seed)
    }
}

/// The error for a scene that does not exist.
fn unknown_scene(name: &str) -> cc4dgs_core::Error {
    unknown_name("procedural scene", name, NAMES.into_iter())
}
