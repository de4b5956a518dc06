//! When exact images are shown, how large they are drawn, and how they compare with the player's.

use crate::View;
use cc4dgs_format::Image8;

/// How long an image may take while something moves, in milliseconds; it is made smaller for that.
const QUICK_MS: f64 = 150.0;
/// Sides of the first quick image, when it is not known yet how long one takes, and of the smallest, as shares of full ones.
const FIRST: f64 = 0.5;
const LEAST: f64 = 0.25;

/// Whether exact images are shown; never of a model that has none.
pub(crate) struct Choice {
    on: bool,
    /// Why there are none; empty where there are.
    lacks: String,
}

impl Choice {
    /// They are not shown yet. `lacks` says why there are none, and is empty where there are.
    pub(crate) fn new(lacks: String) -> Self {
        Self { on: false, lacks }
    }
    /// Why there are none.
    pub(crate) fn lacks(&self) -> Option<&str> {
        if self.lacks.is_empty() { None } else { Some(&self.lacks) }
    }
    pub(crate) fn is_on(&self) -> bool {
        self.on
    }
    /// Shows them, where there are any, or ends that.
    pub(crate) fn set(&mut self, on: bool) {
        self.on = on && self.lacks.is_empty();
    }
}

/// Pixels of an image of `view`.
pub(crate) fn pixels(view: &View) -> f64 {
    f64::from(view.camera.width) * f64::from(view.camera.height)
}

/// `view` with as many pixels as can be drawn quickly, by milliseconds and pixels of an image before.
pub(crate) fn reduced(view: &View, pace: Option<(f64, f64)>) -> View {
    let share = match pace {
        Some((ms, of_pixels)) => (QUICK_MS * of_pixels / (ms.max(1e-3) * pixels(view))).sqrt().clamp(LEAST, 1.0),
        None => FIRST,
    };
    let side = |pixels: u32| ((f64::from(pixels) * share).round() as u32).max(1);
    let (width, height) = (side(view.camera.width), side(view.camera.height));
    View { camera: view.camera.resized(width, height), ..view.clone() }
}

/// PSNR in dB of two RGB images, infinite if they are equal; `None` if their sizes differ.
pub(crate) fn psnr_db(a: &Image8, b: &Image8) -> Option<f64> {
    if (a.width, a.height, a.channels) != (b.width, b.height, b.channels) || a.data.is_empty() || a.data.len() != b.data.len() {
        return None;
    }
    let squares: u64 = a.data.iter().zip(&b.data).map(|(x, y)| u64::from(x.abs_diff(*y)).pow(2)).sum();
    Some(10.0 * (255.0f64.powi(2) * a.data.len() as f64 / squares as f64).log10())
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_format::Camera;

    #[test]
    fn quick_images_are_as_large_as_time_allows() {
        let view = View::new(Camera::look_at("t", (1000, 500), 0.8, [3.0, 0.0, 0.0], [0.0; 3], [0.0, 0.0, 1.0]), 0.5);
        let size = |pace| {
            let camera = reduced(&view, pace).camera;
            camera.validate().unwrap();
            (camera.width, camera.height)
        };
        assert_eq!(size(None), (500, 250));
        assert_eq!(size(Some((QUICK_MS, 500_000.0))), (1000, 500));
        assert_eq!(size(Some((4.0 * QUICK_MS, 500_000.0))), (500, 250));
        assert_eq!(size(Some((4.0 * QUICK_MS, 125_000.0))), (250, 125));
        assert_eq!(size(Some((1e9, 1.0))), (250, 125));
        assert_eq!(size(Some((0.0, 500_000.0))), (1000, 500));
    }

    #[test]
    fn psnr_is_that_of_all_values() {
        let image = |data: Vec<u8>| Image8 { width: 2, height: 1, channels: 3, data };
        let (a, b) = (image(vec![10; 6]), image(vec![10, 10, 10, 10, 10, 13]));
        assert!((psnr_db(&a, &b).unwrap() - 10.0 * (255.0f64.powi(2) / 1.5).log10()).abs() < 1e-9);
        assert_eq!(psnr_db(&a, &a), Some(f64::INFINITY));
        assert_eq!(psnr_db(&a, &Image8 { width: 1, ..b }), None);
    }

    #[test]
    fn a_model_without_exact_images_cannot_be_switched() {
        let mut choice = Choice::new("no deformer".to_string());
        choice.set(true);
        assert_eq!((choice.is_on(), choice.lacks()), (false, Some("no deformer")));
        let mut choice = Choice::new(String::new());
        choice.set(true);
        assert_eq!((choice.is_on(), choice.lacks()), (true, None));
    }
}
