//! Exposure of made-up cameras.

use super::*;
use cc4dgs_core::{Camera, FrameSource, View};
use std::sync::Arc;

const SIZE: (u32, u32) = (80, 60);

/// The image of each camera.
struct Images(Vec<Image8>);

impl FrameSource for Images {
    fn load(&self, view: usize) -> Result<Image8> {
        Ok(self.0[view].clone())
    }
}

/// What [`exposure`] says of four neighbouring cameras that look at one point. Images show a grey `level` in the upper `share` of their rows; the rest is
/// transparent where they have four channels, else black.
fn measured(channels: u32, images: [(f32, u8); 4]) -> Option<f32> {
    let camera = |k: usize| {
        let (sin, cos) = (0.1 * k as f64).sin_cos();
        Camera::look_at(&format!("c{k}"), SIZE, 1.0, [4.0 * cos, 0.0, 4.0 * sin], [0.0; 3], [0.0, 1.0, 0.0])
    };
    let image = |(share, level): (f32, u8)| {
        let shown = (share * SIZE.1 as f32) as u32 * SIZE.0;
        let pixel = |p: u32| if p < shown { [level, level, level, 255] } else { [0; 4] };
        let data = (0..SIZE.0 * SIZE.1).flat_map(|p| pixel(p).into_iter().take(channels as usize)).collect();
        Image8 { width: SIZE.0, height: SIZE.1, channels, data }
    };
    let views: Vec<View> = (0..4).map(|camera| View { camera, frame: 0, time_norm: 0.0, split: Split::Train }).collect();
    let source = Arc::new(Images(Vec::from(images.map(image))));
    let scene = Scene::new("s", (0..4).map(camera).collect(), views, source, 1_000_000).unwrap();
    exposure(&scene, &scene.split(Split::Train)).unwrap()
}

#[test]
fn how_much_of_an_image_is_opaque_is_no_exposure() {
    let same = measured(4, [(0.2, 120), (0.8, 120), (0.2, 120), (0.8, 120)]).unwrap();
    assert!(same < 1e-4, "{same}");
    let differs = measured(4, [(0.2, 100), (0.8, 150), (0.2, 100), (0.8, 150)]).unwrap();
    assert!((differs - 1.5f32.ln()).abs() < 1e-4, "{differs}");
    let opaque = measured(3, [(1.0, 100), (1.0, 150), (1.0, 100), (1.0, 150)]).unwrap();
    assert!((opaque - 1.5f32.ln()).abs() < 1e-4, "{opaque}");
}

#[test]
fn cameras_that_see_no_foreground_have_no_exposure() {
    assert_eq!(measured(4, [(0.0, 0); 4]), None);
    // One camera has none to be compared with.
    assert_eq!(measured(4, [(0.5, 120), (0.0, 0), (0.0, 0), (0.0, 0)]), None);
    assert!(measured(4, [(0.5, 120), (0.0, 0), (0.5, 120), (0.5, 120)]).is_some_and(|ratio| ratio < 1e-4));
}
