//! What a model is trained further on: the images of its scene, in its own colours.
//!
//! Models do not keep the colours per camera that they were trained with (`appearance`). Without them, training on the images would fit the colours of single
//! cameras. So an affine transform of colours that makes the model's own images most like those of a camera is found, and undone in these. The other way
//! round it would make them as dull as what the model does not draw.

use super::tune::TuneJob;
use crate::config::RunConfig;
use crate::sample::spread;
use cc4dgs_core::{DepthImage, Error, Event, FrameSource, Image8, Result, Scene, Split, config, plural};
use cc4dgs_play::{Model, Player};
use glam::{DMat3, DMat4, DVec3, DVec4};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// Images of a camera that are compared, at most, and pixels from one that is looked at to the next.
const IMAGES: usize = 8;
const PIXELS: usize = 7;
/// Weight of the identity, as a share of that of the pixels: it decides where their colours do not.
const IDENTITY: f64 = 1e-4;
/// Transforms of a smaller determinant are not undone: what they do to colours is noise.
const LEAST_DETERMINANT: f64 = 1e-3;

/// What `model` was trained with per camera that models do not keep.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct PerCamera {
    pub colours: bool,
    pub poses: bool,
}

impl PerCamera {
    /// # Errors
    /// [`Error::Parameter`] for a configuration of another version.
    pub fn of(model: &Model) -> Result<Self> {
        let config: RunConfig = config::parse_section("configuration of the model", &model.provenance.config)?;
        let any = |section: &toml::Table| section.get("kind").and_then(|kind| kind.as_str()).unwrap_or("none") != "none";
        Ok(Self { colours: any(&config.appearance), poses: any(&config.poses) })
    }
}

/// The scene of `job` with the images to train on.
///
/// # Errors
/// [`Error::Interrupted`], and what scene and device report.
pub(super) fn targets(job: &TuneJob) -> Result<Arc<Scene>> {
    let scene = &job.scene;
    let PerCamera { colours, poses } = PerCamera::of(job.model)?;
    if poses {
        let message = "trained with corrected poses of its cameras, which models do not keep: it is trained further with the poses of the dataset";
        job.events.emit(&Event::Warning { object: "model".into(), message: message.into() });
    }
    if !colours {
        return Ok(scene.clone());
    }
    let mut views: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    scene.split(Split::Train).into_iter().for_each(|view| views.entry(scene.views[view].camera).or_default().push(view));
    let mut player = Player::new(job.model, job.registry, job.device)?.on(scene.background);
    let background = job.model.background_on(scene.background);
    let mut maps = BTreeMap::new();
    for (&camera, own) in &views {
        let mut fit = Fit::default();
        for &view in &spread(own, IMAGES) {
            if job.stop.load(Ordering::Relaxed) {
                return Err(Error::Interrupted("before further training; nothing was written".into()));
            }
            let drawn = player.frame(scene.camera(view), scene.views[view].time_norm)?.to_planes(background);
            fit.add(&drawn, &scene.frame(view)?.to_planes(background));
        }
        maps.insert(camera, inverse(fit.map()));
        job.events.emit(&Event::Progress { task: "comparing colours".into(), done: maps.len() as u64, total: views.len() as u64 });
    }
    let cameras = format!("{} {}", maps.len(), plural(maps.len(), "camera", "cameras"));
    let message = format!("trained with colours per camera, which models do not keep: the images of {cameras} are brought to its own colours");
    job.events.emit(&Event::Note { object: "model".into(), message });
    Ok(Arc::new(recoloured(scene, background, maps)?))
}

/// `scene` with the colours of each camera of `maps` mapped, over `background`. Its images are cached within the bound of `scene`.
fn recoloured(scene: &Arc<Scene>, background: [f32; 3], maps: BTreeMap<usize, [DVec4; 3]>) -> Result<Scene> {
    scene.derived(scene.cameras.clone(), Arc::new(Recoloured { scene: scene.clone(), background, maps }))
}

/// The affine transform of colours that is best in the sense of least squares.
struct Fit {
    /// Sums of products of the colours before (and 1), with each other and with the colours after.
    products: DMat4,
    with_after: [DVec4; 3],
    count: usize,
}

impl Default for Fit {
    fn default() -> Self {
        // The default of a matrix is the identity.
        Self { products: DMat4::ZERO, with_after: [DVec4::ZERO; 3], count: 0 }
    }
}

impl Fit {
    /// Adds some pixels of two images, as planes `[3,H,W]`.
    fn add(&mut self, before: &[f32], after: &[f32]) {
        let pixels = before.len() / 3;
        for at in (0..pixels).step_by(PIXELS) {
            let colour = |planes: &[f32]| DVec3::from_array(std::array::from_fn(|k| f64::from(planes[k * pixels + at])));
            let (x, y) = (colour(before).extend(1.0), colour(after));
            self.products += DMat4::from_cols(x * x.x, x * x.y, x * x.z, x);
            (0..3).for_each(|k| self.with_after[k] += x * y[k]);
            self.count += 1;
        }
    }
    /// The colour after as `map[channel]` · (red, green, blue, 1).
    fn map(&self) -> [DVec4; 3] {
        let weight = IDENTITY * self.count.max(1) as f64;
        let inverse = (self.products + DMat4::IDENTITY * weight).inverse();
        std::array::from_fn(|k| inverse * (self.with_after[k] + DVec4::AXES[k] * weight))
    }
}

/// The transform that undoes `map`; the identity where none does.
fn inverse(map: [DVec4; 3]) -> [DVec4; 3] {
    let linear = DMat3::from_cols(map[0].truncate(), map[1].truncate(), map[2].truncate()).transpose();
    if linear.determinant().abs() < LEAST_DETERMINANT {
        return [DVec4::X, DVec4::Y, DVec4::Z];
    }
    let (undone, offset) = (linear.inverse(), DVec3::from_array(map.map(|row| row.w)));
    std::array::from_fn(|k| undone.row(k).extend(-undone.row(k).dot(offset)))
}

/// The images of a scene with the colours of each camera mapped.
struct Recoloured {
    scene: Arc<Scene>,
    background: [f32; 3],
    maps: BTreeMap<usize, [DVec4; 3]>,
}

impl FrameSource for Recoloured {
    fn load(&self, view: usize) -> Result<Image8> {
        let image = self.scene.frame(view)?;
        let Some(map) = self.maps.get(&self.scene.views[view].camera) else { return Ok(image.as_ref().clone()) };
        let mut planes = image.to_planes(self.background);
        let pixels = planes.len() / 3;
        for at in 0..pixels {
            let colour = DVec4::new(f64::from(planes[at]), f64::from(planes[pixels + at]), f64::from(planes[2 * pixels + at]), 1.0);
            (0..3).for_each(|k| planes[k * pixels + at] = map[k].dot(colour) as f32);
        }
        Ok(Image8::from_planes(&planes, image.width, image.height))
    }
    fn depth(&self, view: usize) -> Result<Option<DepthImage>> {
        Ok(self.scene.depth(view)?.map(|depth| depth.as_ref().clone()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{Camera, View};
    use std::sync::atomic::AtomicUsize;

    /// White images of 2,400 bytes, and how many were loaded.
    #[derive(Default)]
    struct White(AtomicUsize);

    impl FrameSource for White {
        fn load(&self, _: usize) -> Result<Image8> {
            self.0.fetch_add(1, Ordering::Relaxed);
            Ok(Image8 { width: 40, height: 20, channels: 3, data: vec![255; 2400] })
        }
    }

    #[test]
    fn images_in_other_colours_share_the_cache() {
        // Loads for an image, the same in other colours, and the image again.
        let loads = |cache_bytes: u64| {
            let camera = Camera::look_at("a", (40, 20), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
            let views = vec![View { camera: 0, frame: 0, time_norm: 0.0, split: Split::Train }];
            let source = Arc::new(White::default());
            let scene = Arc::new(Scene::new("white", vec![camera], views, source.clone(), cache_bytes).unwrap());
            let darker = [DVec4::X, DVec4::Y, DVec4::Z].map(|row| row * 0.2);
            let other = recoloured(&scene, [0.0; 3], BTreeMap::from([(0, darker)])).unwrap();
            let images = [scene.frame(0), other.frame(0), scene.frame(0)].map(|image| image.unwrap().data[0]);
            assert_eq!(images, [255, 51, 255]);
            source.0.load(Ordering::Relaxed)
        };
        assert_eq!((loads(4799), loads(4800)), (2, 1), "two images of 2,400 bytes");
    }

    #[test]
    fn a_transform_of_colours_is_found_and_the_identity_where_colours_say_nothing() {
        let numbers = |seed: usize| (0..2100).map(move |k| ((k * 37 + seed) as f32 * 0.618).fract()).collect::<Vec<f32>>();
        let before = numbers(3);
        let known = [DVec4::new(0.9, 0.1, 0.0, 0.05), DVec4::new(0.0, 0.8, 0.1, 0.02), DVec4::new(0.05, 0.0, 1.1, -0.03)];
        let pixels = before.len() / 3;
        let after: Vec<f32> = (0..2100)
            .map(|i| {
                known[i / pixels].dot(DVec4::from_array(std::array::from_fn(|k| if k < 3 { f64::from(before[k * pixels + i % pixels]) } else { 1.0 }))) as f32
            })
            .collect();
        let mut fit = Fit::default();
        fit.add(&before, &after);
        for (found, known) in fit.map().iter().zip(&known) {
            assert!((*found - *known).abs().max_element() < 0.01, "{found} instead of {known}");
        }
        let colour = DVec3::new(0.3, 0.7, 0.1).extend(1.0);
        let there = DVec3::from_array(known.map(|row| row.dot(colour))).extend(1.0);
        let back = DVec3::from_array(inverse(known).map(|row| row.dot(there)));
        assert!((back - colour.truncate()).length() < 1e-9, "{back}");
        assert_eq!(inverse([DVec4::W; 3]), [DVec4::X, DVec4::Y, DVec4::Z]);
        for found in [Fit::default(), {
            let mut grey = Fit::default();
            grey.add(&[0.5; 2100], &[0.5; 2100]);
            grey
        }]
        .iter()
        .map(Fit::map)
        {
            let shown: Vec<f64> = found.iter().map(|row| row.dot(DVec4::new(0.5, 0.5, 0.5, 1.0))).collect();
            assert!(shown.iter().all(|v| (v - 0.5).abs() < 1e-9), "{shown:?}");
        }
    }
}
