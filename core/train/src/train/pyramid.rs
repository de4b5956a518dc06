//! The scene with smaller images, for the first part of a run: coarse structure is found faster where images have few pixels (DashGaussian).

use crate::config::RunConfig;
use crate::data::resize;
use crate::schedule::IMAGE_SCALES;
use cc4dgs_core::{DepthImage, FrameSource, Image8, Result, Scene};
use std::sync::Arc;

/// The scene at every size of images that a run uses.
pub(crate) struct Pyramid {
    /// Scale per axis and the scene, ascending; the last is the scene itself.
    levels: Vec<(f32, Arc<Scene>)>,
}

impl Pyramid {
    /// The scene of `config` at every scale its schedule has. Images are shrunk when they are asked for.
    pub(crate) fn new(scene: &Arc<Scene>, config: &RunConfig) -> Result<Self> {
        let mut levels = Vec::new();
        if config.train.image_growth > 0.0 {
            for scale in IMAGE_SCALES {
                levels.push((scale, Arc::new(shrunk(scene, scale)?)));
            }
        }
        levels.push((1.0, scene.clone()));
        Ok(Self { levels })
    }
    /// The scene with images of `scale`, or the next larger ones there are.
    pub(crate) fn at(&self, scale: f32) -> &Arc<Scene> {
        let level = self.levels.partition_point(|(known, _)| *known < scale);
        &self.levels[level.min(self.levels.len() - 1)].1
    }
}

/// `scene` with images of `scale` per axis. They are cached within the bound of `scene`.
fn shrunk(scene: &Arc<Scene>, scale: f32) -> Result<Scene> {
    let cameras = scene.cameras.iter().map(|camera| camera.resized(side(camera.width, scale), side(camera.height, scale))).collect();
    scene.derived(cameras, Arc::new(Shrunk { scene: scene.clone(), scale }))
}

/// `pixels` at a scale.
fn side(pixels: u32, scale: f32) -> u32 {
    ((pixels as f32 * scale).round() as u32).max(1)
}

/// The images of a scene and their depth, smaller.
struct Shrunk {
    scene: Arc<Scene>,
    scale: f32,
}

impl FrameSource for Shrunk {
    fn load(&self, view: usize) -> Result<Image8> {
        let image = self.scene.frame(view)?;
        Ok(resize(&image, side(image.width, self.scale), side(image.height, self.scale)))
    }
    fn depth(&self, view: usize) -> Result<Option<DepthImage>> {
        Ok(self.scene.depth(view)?.map(|depth| depth.resized(side(depth.width, self.scale), side(depth.height, self.scale))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{Camera, Split, View};
    use std::sync::atomic::{AtomicUsize, Ordering};

    /// How many images were loaded.
    #[derive(Default)]
    struct Flat(AtomicUsize);
    impl FrameSource for Flat {
        fn load(&self, _: usize) -> Result<Image8> {
            self.0.fetch_add(1, Ordering::Relaxed);
            Ok(Image8 { width: 40, height: 20, channels: 3, data: vec![9; 2400] })
        }
        fn depth(&self, _: usize) -> Result<Option<DepthImage>> {
            Ok(Some(DepthImage { width: 40, height: 20, values: (0..800).map(|pixel| if pixel % 2 == 0 { 0.0 } else { 3.0 }).collect() }))
        }
    }

    /// A view of 2,400 bytes, and its source.
    fn flat(cache_bytes: u64) -> (Arc<Scene>, Arc<Flat>) {
        let camera = Camera::look_at("a", (40, 20), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let views = vec![View { camera: 0, frame: 0, time_norm: 0.0, split: Split::Train }];
        let source = Arc::new(Flat::default());
        (Arc::new(Scene::new("flat", vec![camera], views, source.clone(), cache_bytes).unwrap()), source)
    }

    fn growing() -> RunConfig {
        let mut config = RunConfig::resolve(Some("demo"), None, &[]).unwrap();
        config.train.image_growth = 0.5;
        config
    }

    #[test]
    fn images_of_all_sizes_share_the_cache() {
        // Loads for a full image, a small one of it and the full one again.
        let loads = |cache_bytes: u64| {
            let (scene, source) = flat(cache_bytes);
            let pyramid = Pyramid::new(&scene, &growing()).unwrap();
            for scale in [1.0, IMAGE_SCALES[0], 1.0] {
                pyramid.at(scale).frame(0).unwrap();
            }
            source.0.load(Ordering::Relaxed)
        };
        assert_eq!((loads(2549), loads(2550)), (2, 1), "2,400 and 150 bytes");
    }

    #[test]
    fn images_and_cameras_shrink_alike() {
        let (scene, _) = flat(1 << 20);
        let mut config = growing();
        let pyramid = Pyramid::new(&scene, &config).unwrap();
        for scale in IMAGE_SCALES.into_iter().chain([1.0]) {
            let level = pyramid.at(scale);
            let image = level.frame(0).unwrap();
            assert_eq!((image.width, image.height), (level.cameras[0].width, level.cameras[0].height));
            assert_eq!(image.width, (40.0 * scale).round() as u32);
            let depth = level.depth(0).unwrap().unwrap();
            assert_eq!((depth.width, depth.height), (image.width, image.height));
            assert!(depth.values.iter().all(|z| [0.0, 3.0].contains(z)), "known and unknown pixels are not mixed: {:?}", depth.values);
        }
        config.train.image_growth = 0.0;
        assert_eq!(Pyramid::new(&scene, &config).unwrap().at(0.25).cameras[0].width, 40);
    }
}
