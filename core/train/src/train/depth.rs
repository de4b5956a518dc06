//! Depth on which training views agree, as a term of the loss: what explains one camera's image alone stands away from it.
//!
//! The term is the difference of the drawn depth from that of the views, as a share of it, beyond a tolerance: matched depth is not exact. Things that move are left out
//! but at the time whose images were matched.

use crate::data::init::agreed_depths;
use crate::masks::DynamicMask;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::{Result, Scene, Split};
use std::collections::BTreeMap;
use std::sync::Mutex;

/// Difference, as a share of the depth, that costs nothing.
const TOLERANCE: f32 = 0.01;

/// One depth map.
struct Map {
    /// The frame whose images were matched.
    frame: usize,
    size: [usize; 2],
    /// Inverse depth, 0 where it is not known.
    inverse: Vec<f32>,
    /// The same without what moves.
    still: Vec<f32>,
}

/// Of inverse depth and where it is known `[1,H,W]`: the map, whether what moves is in it, and the size.
type Key = (usize, bool, usize, usize);

/// The depth maps of all cameras that have one.
#[derive(Default)]
pub(crate) struct Depths {
    /// By camera where cameras stand still, else by view.
    maps: BTreeMap<usize, Map>,
    by_view: bool,
    uploaded: Mutex<BTreeMap<Key, [Tensor<3>; 2]>>,
}

impl Depths {
    /// Matches the training views of `scene`; `masks` say what moves.
    pub(crate) fn find(scene: &Scene, masks: &[DynamicMask]) -> Result<Self> {
        let mut cameras: Vec<usize> = scene.split(Split::Train).into_iter().map(|view| scene.views[view].camera).collect();
        let views = cameras.len();
        cameras.sort_unstable();
        cameras.dedup();
        let by_view = cameras.len() == views;
        let mut maps = BTreeMap::new();
        for depth in agreed_depths(scene)? {
            let (view, size) = (&scene.views[depth.view], [depth.width, depth.height]);
            let mask = masks.iter().find(|mask| scene.views[mask.view].camera == view.camera);
            let camera = &scene.cameras[view.camera];
            let moves = |p: usize| {
                let at = |i: usize, n: usize, to: u32| (2 * i + 1) * to as usize / (2 * n);
                let (x, y) = (at(p % size[0], size[0], camera.width), at(p / size[0], size[1], camera.height));
                mask.is_some_and(|mask| mask.mask[y * camera.width as usize + x] > 0.5)
            };
            let still = depth.inverse.iter().enumerate().map(|(p, &v)| if moves(p) { 0.0 } else { v }).collect();
            maps.insert(if by_view { depth.view } else { view.camera }, Map { frame: view.frame, size, inverse: depth.inverse, still });
        }
        Ok(Self { maps, by_view, uploaded: Mutex::default() })
    }

    /// The term `[1]` of drawn planes `[5,H,W]` (colours, alpha, depth) of a view; `None` where its depth is not known.
    pub(crate) fn term(&self, scene: &Scene, view: usize, planes: &Tensor<3>, device: &Device) -> Option<Tensor<1>> {
        let key = if self.by_view { view } else { scene.views[view].camera };
        let map = self.maps.get(&key)?;
        let [_, height, width] = planes.dims();
        let matched = self.by_view || scene.views[view].frame == map.frame;
        let mut uploaded = self.uploaded.lock().unwrap_or_else(|e| e.into_inner());
        let [inverse, known] = uploaded.entry((key, matched, width, height)).or_insert_with(|| {
            let values = map.at(if matched { &map.inverse } else { &map.still }, width, height);
            let known = values.iter().map(|v| f32::from(u8::from(*v > 0.0))).collect();
            [values, known].map(|values: Vec<f32>| Tensor::from_data(TensorData::new(values, [1, height, width]), device))
        });
        let [alpha, depth] = [3, 4].map(|k| planes.clone().narrow(0, k, 1));
        let difference = (depth * Tensor::from_inner(inverse.clone()) - alpha * Tensor::from_inner(known.clone())).abs();
        Some((difference - TOLERANCE).clamp_min(0.0).mean())
    }
}

impl Map {
    /// `values` at another size, those of the nearest pixels.
    fn at(&self, values: &[f32], width: usize, height: usize) -> Vec<f32> {
        let nearest = |i: usize, n: usize, own: usize| (2 * i + 1) * own / (2 * n);
        (0..width * height).map(|p| values[nearest(p / width, height, self.size[1]) * self.size[0] + nearest(p % width, width, self.size[0])]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::gaussians::to_vec;
    use cc4dgs_core::{Camera, Error, FrameSource, Image8, View};
    use std::sync::Arc;

    struct NoImages;
    impl FrameSource for NoImages {
        fn load(&self, view: usize) -> Result<Image8> {
            Err(Error::unsupported(format!("view {view}"), "no images here", "None"))
        }
    }

    /// Two cameras that see two frames each; the views of a frame come one after another.
    fn scene() -> Scene {
        let camera = |k: usize| Camera::look_at(&format!("c{k}"), (2, 2), 1.0, [k as f64, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let view = |i: usize| View { camera: i % 2, frame: i / 2, time_norm: (i / 2) as f32, split: Split::Train };
        Scene::new("s", (0..2).map(camera).collect(), (0..4).map(view).collect(), Arc::new(NoImages), 0).unwrap()
    }

    #[test]
    fn what_stands_away_from_the_agreed_depth_costs() {
        let (scene, device) = (scene(), Device::default());
        let map = Map { frame: 0, size: [2, 1], inverse: vec![0.5, 0.25], still: vec![0.5, 0.0] };
        let depths = Depths { maps: BTreeMap::from([(0, map)]), ..Default::default() };
        // Depths of 2 and 4 are agreed; the image has twice as many rows as the map.
        let term = |view: usize, alpha: f32, depth: [f32; 2]| {
            let values = [vec![0.3; 12], vec![alpha; 4], [depth, depth].concat()].concat();
            let planes = Tensor::<3>::from_inner(Tensor::from_data(TensorData::new(values, [5, 2, 2]), &device));
            depths.term(&scene, view, &planes, &device).map(|term| to_vec(term, "term").unwrap()[0])
        };
        let near = |a: Option<f32>, b: f32| (a.unwrap() - b).abs() < 1e-6;
        assert!(near(term(0, 1.0, [2.0, 4.0]), 0.0));
        assert!(near(term(0, 1.0, [2.0, 5.0]), 0.5 * (0.25 - TOLERANCE)), "a quarter too far in half of the pixels");
        assert!(near(term(0, 0.5, [1.0, 2.5]), 0.5 * (0.125 - TOLERANCE)), "half of that where half of the light is kept");
        assert!(near(term(2, 1.0, [2.0, 5.0]), 0.0), "what moves is elsewhere at the other frame");
        assert!(near(term(2, 1.0, [3.0, 5.0]), 0.5 * (0.5 - TOLERANCE)));
        assert!(term(1, 1.0, [2.0, 2.0]).is_none(), "the other camera has no map");
    }
}
