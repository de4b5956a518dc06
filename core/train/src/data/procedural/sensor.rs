//! What a camera makes of the light: lens, exposure, white balance and noise.

use super::trace::{PixelRays, Ray, Tracer, quantised};
use cc4dgs_core::{Camera, DepthImage, Distortion, Image8, Seed, Split};
use glam::DVec3;
use rand::Rng;
use rand::seq::SliceRandom;
use std::f64::consts::TAU;

/// Noise of a sensor, in units of the largest value of an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// Electrons at the largest value: the variance of shot noise is the value over this.
    pub electrons: f64,
    /// Standard deviation of read noise.
    pub read: f64,
}

impl Noise {
    /// Standard deviation where the value is `value`, 0..1.
    pub fn deviation(&self, value: f64) -> f64 {
        (value.max(0.0) / self.electrons + self.read * self.read).sqrt()
    }
}

/// One camera's lens and sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct Sensor {
    /// The lens.
    pub distortion: Distortion,
    /// Red, green and blue are multiplied by these and cut off at 1.
    pub gain: [f64; 3],
    /// Noise, if it has any.
    pub noise: Option<Noise>,
}

impl Sensor {
    /// No lens, no noise, values as they are.
    pub const IDEAL: Self = Self { distortion: Distortion::None, gain: [1.0; 3], noise: None };

    /// The image of `camera` with this lens and sensor. `seed` is for the noise of this image.
    pub fn image(&self, tracer: &Tracer, camera: &Camera, supersampling: u32, seed: Seed) -> Image8 {
        let mut colors = self.with_rays(camera, |ray| tracer.trace([camera.width, camera.height], supersampling, ray));
        if self.gain != [1.0; 3] {
            colors.iter_mut().for_each(|c| *c = std::array::from_fn(|k| (c[k] * self.gain[k]).min(1.0)));
        }
        if let Some(noise) = self.noise {
            let mut rng = seed.rng();
            for value in colors.iter_mut().flatten() {
                // Box and Muller 1958; 1 - u is never 0.
                let (u, v) = (rng.random::<f64>(), rng.random::<f64>());
                *value += noise.deviation(*value) * (-2.0 * (1.0 - u).ln()).sqrt() * (TAU * v).cos();
            }
        }
        quantised(camera.width, camera.height, &colors)
    }
    /// The depth at the centres of the pixels of [`Sensor::image`], in the unit of the cameras; 0 where no object is.
    pub fn depth(&self, tracer: &Tracer, camera: &Camera) -> DepthImage {
        let values = self.with_rays(camera, |ray| tracer.depths([camera.width, camera.height], DVec3::from(camera.forward_world()), ray));
        DepthImage { width: camera.width, height: camera.height, values }
    }
    /// Calls `work` with the rays of `camera` behind this lens, by pixel coordinates.
    fn with_rays<T>(&self, camera: &Camera, work: impl FnOnce(&Ray) -> T) -> T {
        let rays = PixelRays::new(camera);
        let ideal = |u: f64, v: f64| rays.through(u, v);
        let bent = |u: f64, v: f64| {
            let (x, y) = ((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy);
            let (x, y) = self.distortion.undistort(x, y).unwrap_or((x, y));
            ideal(x * camera.fx + camera.cx, y * camera.fy + camera.cy)
        };
        if self.distortion.is_identity() { work(&ideal) } else { work(&bent) }
    }
}

/// Lenses and sensors of all cameras of a scene. Held-out cameras have the exposure and nothing else.
#[derive(Clone, Debug, PartialEq)]
pub struct Sensors {
    /// Exposure of all cameras.
    pub exposure: f64,
    /// The lens of the training cameras.
    pub distortion: Distortion,
    /// The smallest and the largest gain of a training camera. Gains are spread evenly on a logarithmic scale, in random order.
    pub gains: [f64; 2],
    /// The largest change of red against green and of blue against green.
    pub tint: f64,
    /// Noise of the training cameras.
    pub noise: Option<Noise>,
}

impl Sensors {
    /// No lens, no noise, values as they are.
    pub const IDEAL: Self = Self { exposure: 1.0, distortion: Distortion::None, gains: [1.0; 2], tint: 0.0, noise: None };

    /// The sensors of cameras with these splits.
    pub fn of(&self, splits: &[Split], seed: Seed) -> Vec<Sensor> {
        let mut rng = seed.rng();
        let count = splits.iter().filter(|split| **split == Split::Train).count();
        let mut order: Vec<usize> = (0..count).collect();
        order.shuffle(&mut rng);
        let mut order = order.into_iter();
        let mut sensor = |split: &Split| {
            let held_out = Sensor { gain: [self.exposure; 3], ..Sensor::IDEAL };
            if *split == Split::Test {
                return held_out;
            }
            let rank = order.next().unwrap_or(0) as f64 / count.saturating_sub(1).max(1) as f64;
            let gain = self.exposure * self.gains[0] * (self.gains[1] / self.gains[0]).powf(rank);
            let [red, blue] = [0; 2].map(|_| 1.0 + self.tint * (2.0 * rng.random::<f64>() - 1.0));
            Sensor { distortion: self.distortion.clone(), gain: [gain * red, gain, gain * blue], noise: self.noise }
        };
        splits.iter().map(&mut sensor).collect()
    }
}
