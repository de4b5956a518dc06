//! LPIPS, the learned perceptual distance of Zhang, Isola, Efros, Shechtman and Wang, "The Unreasonable Effectiveness of Deep Features as a Perceptual
//! Metric" (2018): version 0.1 on the features of AlexNet. 0 is equal; lower is better.
//!
//! The weights are not part of this crate. [`installed_lpips`] looks for them.

mod find;
mod network;
mod weights;

pub use find::{InstalledLpips, LPIPS_FILE, LPIPS_VARIABLE, installed_lpips, lpips_paths};
pub use weights::WeightsId;

use super::Planes;
use crate::{Error, Result};
use network::{Conv, Map, max_pool};

/// The smallest side of an image in pixels: the third layer sees nothing of smaller ones.
pub const LPIPS_SMALLEST_SIDE: usize = 31;

/// Mean and deviation of the inputs of the network, for colours in -1..1.
const SHIFT: [f64; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f64; 3] = [0.458, 0.448, 0.450];
/// Keeps the division of a feature vector by its length finite.
const EPSILON: f64 = 1e-10;
/// Convolutions that are followed by max pooling.
const POOLED: [bool; 5] = [true, true, false, false, false];
/// Channels of the five layers, and so of their linear weights.
const LINEAR: [usize; 5] = [64, 192, 384, 256, 256];

/// AlexNet's convolutions and the linear weights of LPIPS.
#[derive(Clone, Debug)]
pub struct Lpips {
    conv: Vec<Conv>,
    linear: Vec<Vec<f32>>,
    id: WeightsId,
}

impl Lpips {
    /// Which weights these are.
    pub fn id(&self) -> &WeightsId {
        &self.id
    }
    /// The distance of two images of three channels in 0..1. Features are float32, sums are float64.
    ///
    /// # Errors
    /// [`Error::Parameter`] for different shapes, other than three channels, or a side below [`LPIPS_SMALLEST_SIDE`].
    pub fn distance(&self, a: &Planes, b: &Planes) -> Result<f64> {
        a.check_pair(b, None)?;
        if a.channels() != 3 {
            return Err(Error::parameter("LPIPS", format!("images of {} channels", a.channels()), "Pass red, green and blue"));
        }
        if a.width().min(a.height()) < LPIPS_SMALLEST_SIDE {
            let problem = format!("the image is {}x{}; each side needs at least {LPIPS_SMALLEST_SIDE} pixels", a.width(), a.height());
            return Err(Error::parameter("LPIPS", problem, "Compare larger images"));
        }
        let (mut a, mut b) = (input(a), input(b));
        let mut distance = 0.0;
        for (layer, (conv, weights)) in self.conv.iter().zip(&self.linear).enumerate() {
            (a, b) = (conv.relu(&a), conv.relu(&b));
            distance += layer_distance(&a, &b, weights);
            if POOLED[layer] {
                (a, b) = (max_pool(&a), max_pool(&b));
            }
        }
        Ok(distance)
    }
}

fn input(image: &Planes) -> Map {
    let values = (0..3).flat_map(|c| image.plane(c).iter().map(move |v| ((2.0 * v - 1.0 - SHIFT[c]) / SCALE[c]) as f32)).collect();
    Map { channels: 3, height: image.height(), width: image.width(), values }
}

/// The mean over pixels of the weighted squared difference of feature vectors of length 1.
fn layer_distance(a: &Map, b: &Map, weights: &[f32]) -> f64 {
    let pixels = a.height * a.width;
    let lengths = |map: &Map| {
        let mut squares = vec![0.0f64; pixels];
        for plane in map.values.chunks_exact(pixels) {
            squares.iter_mut().zip(plane).for_each(|(s, v)| *s += f64::from(*v) * f64::from(*v));
        }
        squares.iter().map(|s| 1.0 / (s.sqrt() + EPSILON)).collect::<Vec<f64>>()
    };
    let (of_a, of_b) = (lengths(a), lengths(b));
    let mut sum = 0.0;
    for (channel, weight) in weights.iter().enumerate() {
        let planes = a.values[channel * pixels..][..pixels].iter().zip(&b.values[channel * pixels..][..pixels]);
        let squares: f64 = planes.zip(of_a.iter().zip(&of_b)).map(|((x, y), (p, q))| (f64::from(*x) * p - f64::from(*y) * q).powi(2)).sum();
        sum += f64::from(*weight) * squares;
    }
    sum / pixels as f64
}

#[cfg(test)]
mod tests;
