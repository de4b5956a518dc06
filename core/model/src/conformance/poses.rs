//! The conformance suite of pose models.

use super::{guarded, settings_are_defaults, uniform, weights, within};
use crate::gaussians::to_vec;
use crate::{Camera, Posed, Poses, PosesContext, PosesPlugin, Result, Seed, check_parameters};
use burn::tensor::{Device, Tensor, TensorData};

/// Training cameras.
const CAMERAS: usize = 4;
/// Extent of the cameras.
const EXTENT: f64 = 2.5;
/// Size of the random changes of the weights.
const SHAKE: f32 = 0.1;
/// Size of the finite differences.
const STEP: f64 = 1e-3;
/// Largest error of a rotation, of an unchanged pose, and of the mean motion of the cameras.
const EXACT: f64 = 1e-5;

/// Tests a pose model on `device`. Each finding is a line; an empty list means that it passed.
///
/// - Its schema is TOML and states the defaults; unknown settings are refused; nothing panics.
/// - A new model leaves all poses as they are.
/// - With any weights poses are rigid, and the camera is otherwise unchanged. A camera that does not exist is an error, unless no pose is ever changed.
/// - The same change of all weights changes no pose: cameras cannot move together. So a single camera keeps its pose, whatever the weights.
/// - Gradients of the weights, through the probe, agree with finite differences of the pose.
/// - Parameters have unique names, matching shapes and existing groups.
pub fn poses(plugin: &PosesPlugin, settings: &toml::Table, device: &Device) -> Vec<String> {
    let suite = Suite { plugin, settings, device };
    guarded(
        &format!("{} on {device:?}", plugin.info.name),
        vec![
            ("settings", Box::new(|| suite.settings_are_read())),
            ("parameters", Box::new(|| suite.parameters_are_sound())),
            ("identity", Box::new(|| suite.new_models_change_nothing())),
            ("rigid", Box::new(|| suite.poses_are_rigid())),
            ("together", Box::new(|| suite.cameras_do_not_move_together())),
            ("single", Box::new(|| suite.a_single_camera_keeps_its_pose())),
            ("gradients", Box::new(|| suite.gradients_are_slopes())),
        ],
    )
}

struct Suite<'a> {
    plugin: &'a PosesPlugin,
    settings: &'a toml::Table,
    device: &'a Device,
}

/// Camera `index` of the suite, turned about the vertical axis.
fn camera(index: usize) -> Camera {
    let (s, c) = (0.3 + 0.9 * index as f64).sin_cos();
    let world_to_camera = [[c, 0.0, -s, 0.2], [0.0, 1.0, 0.0, -0.1 * index as f64], [s, 0.0, c, 3.0], [0.0, 0.0, 0.0, 1.0]];
    Camera { name: format!("camera-{index}"), width: 16, height: 12, fx: 14.0, fy: 15.0, cx: 8.0, cy: 6.0, world_to_camera }
}

fn pose(poses: &dyn Poses, index: usize) -> Result<[[f64; 4]; 4]> {
    Ok(poses.corrected(&camera(index), index)?.map_or(camera(index).world_to_camera, |posed| posed.camera.world_to_camera))
}

fn largest_difference(a: &[[f64; 4]; 4], b: &[[f64; 4]; 4]) -> f64 {
    // NaN is the largest, and stays.
    a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| (a - b).abs()).max_by(f64::total_cmp).unwrap_or(0.0)
}

impl Suite<'_> {
    fn settings_are_read(&self) -> Result<Option<String>> {
        settings_are_defaults("poses", &self.plugin.info, self.settings, |settings| {
            let built = Suite { plugin: self.plugin, settings, device: self.device }.shaken(self.device)?;
            let weights = weights::values(&built.parameters())?;
            let term = built.regularizer()?.map(|term| to_vec(term, "regularizer")).transpose()?;
            Ok((weights, built.groups(), term))
        })
    }
    fn fresh(&self, device: &Device) -> Result<Box<dyn Poses>> {
        (self.plugin.build)(self.settings, &PosesContext { cameras: CAMERAS, extent: EXTENT, seed: Seed::root(71) }, device)
    }
    /// A model whose weights are those of a new one, changed by `change` of the array and the number in it.
    fn changed(&self, device: &Device, change: impl Fn(usize, usize) -> f32) -> Result<Box<dyn Poses>> {
        let mut built = self.fresh(device)?;
        weights::change(built.parameters_mut(), device, change)?;
        Ok(built)
    }
    fn shaken(&self, device: &Device) -> Result<Box<dyn Poses>> {
        self.changed(device, |index, k| SHAKE * uniform(Seed::root(75).index(index as u64), k))
    }
    fn parameters_are_sound(&self) -> Result<Option<String>> {
        let built = self.fresh(self.device)?;
        check_parameters(self.plugin.info.name, &built.parameters(), &built.groups()).map(|()| None)
    }
    fn new_models_change_nothing(&self) -> Result<Option<String>> {
        let fresh = self.fresh(self.device)?;
        for index in 0..CAMERAS {
            if !within(largest_difference(&pose(fresh.as_ref(), index)?, &camera(index).world_to_camera), EXACT) {
                return Ok(Some(format!("a new model moves camera {index}")));
            }
        }
        Ok(None)
    }
    fn poses_are_rigid(&self) -> Result<Option<String>> {
        let shaken = self.shaken(self.device)?;
        for index in 0..CAMERAS {
            let Some(Posed { camera: posed, probe }) = shaken.corrected(&camera(index), index)? else { continue };
            let m = &posed.world_to_camera;
            let dot = |a: usize, b: usize| (0..3).map(|k| m[a][k] * m[b][k]).sum::<f64>();
            let orthonormal = (0..9).all(|k| within(dot(k / 3, k % 3) - f64::from(u8::from(k / 3 == k % 3)), EXACT));
            let determinant: f64 = (0..3).map(|k| m[0][k] * (m[1][(k + 1) % 3] * m[2][(k + 2) % 3] - m[1][(k + 2) % 3] * m[2][(k + 1) % 3])).sum();
            if !orthonormal || !within(determinant - 1.0, EXACT) || m[3] != [0.0, 0.0, 0.0, 1.0] || m.iter().any(|row| !row[3].is_finite()) {
                return Ok(Some(format!("the pose of camera {index} is not rigid: {m:?}")));
            }
            if (Camera { world_to_camera: camera(index).world_to_camera, ..posed.clone() }) != camera(index) {
                return Ok(Some(format!("camera {index} changed in more than its pose")));
            }
            if probe.dims() != [4, 4] {
                return Ok(Some(format!("the probe of camera {index} has the shape {:?}, not [4, 4]", probe.dims())));
            }
        }
        let beyond = shaken.corrected(&camera(0), CAMERAS);
        Ok(matches!(beyond, Ok(Some(_))).then(|| format!("camera {CAMERAS} of {CAMERAS} is no error")))
    }
    fn cameras_do_not_move_together(&self) -> Result<Option<String>> {
        // The same change for all cameras: arrays with a row per camera have equal rows.
        let rows: Vec<usize> = self.fresh(self.device)?.parameters().iter().map(|p| if p.shape.first() == Some(&CAMERAS) { CAMERAS } else { 1 }).collect();
        let widths: Vec<usize> = self.fresh(self.device)?.parameters().iter().zip(&rows).map(|(p, rows)| p.value.dims()[0] / rows).collect();
        let together = self.changed(self.device, |index, k| {
            let column = if rows[index] == CAMERAS { k % widths[index].max(1) } else { 0 };
            SHAKE * uniform(Seed::root(79).index(index as u64), column)
        })?;
        for index in 0..CAMERAS {
            let difference = largest_difference(&pose(together.as_ref(), index)?, &camera(index).world_to_camera);
            if !within(difference, EXACT) {
                return Ok(Some(format!("where all weights change alike, camera {index} moves: its pose changes by {difference}")));
            }
        }
        Ok(None)
    }
    fn a_single_camera_keeps_its_pose(&self) -> Result<Option<String>> {
        let mut single = (self.plugin.build)(self.settings, &PosesContext { cameras: 1, extent: EXTENT, seed: Seed::root(71) }, self.device)?;
        weights::change(single.parameters_mut(), self.device, |index, k| SHAKE * uniform(Seed::root(81).index(index as u64), k))?;
        let difference = largest_difference(&pose(single.as_ref(), 0)?, &camera(0).world_to_camera);
        if !within(difference, EXACT) {
            return Ok(Some(format!("a single camera moves: its pose changes by {difference}")));
        }
        let term = single.regularizer()?.map(|term| to_vec(term, "regularizer")).transpose()?.unwrap_or_default();
        Ok(term.iter().any(|value| !value.is_finite()).then(|| format!("the regularizer of a single camera is {term:?}")))
    }
    fn gradients_are_slopes(&self) -> Result<Option<String>> {
        let device = self.device.clone().autodiff();
        let mut built = self.shaken(&device)?;
        // d loss / d pose of every camera: each may have weights of its own.
        let upstream: Vec<Vec<f32>> = (0..CAMERAS).map(|index| (0..16).map(|k| uniform(Seed::root(77).index(index as u64), k)).collect()).collect();
        let regularizer = |model: &dyn Poses| -> Result<f64> {
            let term = model.regularizer()?.map(|term| to_vec(term, "regularizer")).transpose()?;
            Ok(term.map_or(0.0, |term| term.first().copied().map_or(f64::NAN, f64::from)))
        };
        let measure = |model: &dyn Poses| -> Result<f64> {
            let mut loss = regularizer(model)?;
            for (index, weights) in upstream.iter().enumerate() {
                loss += pose(model, index)?.iter().flatten().zip(weights).map(|(value, weight)| value * f64::from(*weight)).sum::<f64>();
            }
            Ok(loss)
        };
        let mut total: Option<Tensor<1>> = None;
        for (index, weights) in upstream.iter().enumerate() {
            let Some(posed) = built.corrected(&camera(index), index)? else { continue };
            let weights = Tensor::<2>::from_data(TensorData::new(weights.clone(), [4, 4]), &device);
            let term = (posed.probe * weights).sum();
            total = Some(total.map_or(term.clone(), |sum| sum + term));
        }
        let Some(mut total) = total else {
            return Ok((!built.parameters().is_empty()).then(|| "there are weights, but no pose is changed".into()));
        };
        if let Some(term) = built.regularizer()? {
            total = total + term;
        }
        let gradients = total.backward();
        weights::slopes(built.as_mut(), |m| m.parameters(), |m| m.parameters_mut(), (&gradients, STEP), |m| measure(m))
    }
}
