//! That a training starts its deformer on the first Gaussians that may move, and a stored model is opened without them.

use burn::tensor::{Device, Tensor};
use cc4dgs::Session;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{
    Deformer, DeformerContext, DeformerPlugin, DeformerWork, Error, HostGaussians, Offsets, Parameter, ParameterGroup, Part, Plugin, Result, SpatialFeatures,
    SpatialInput, config, inventory, toml,
};
use std::sync::Mutex;

/// What deformers were started from.
static FIRST: Mutex<Vec<HostGaussians>> = Mutex::new(Vec::new());

/// Other tests run every registered deformer: they record nothing.
#[derive(Default, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Settings {
    record: bool,
}

/// Moves everything a little along the upper corner of the first Gaussians.
struct Corner {
    record: bool,
    parameters: Vec<Parameter>,
}

/// The largest coordinates of `gaussians`, at least 0.
fn corner(gaussians: &HostGaussians) -> Vec<f32> {
    (0..3).map(|k| gaussians.means.iter().skip(k).step_by(3).copied().fold(0.0, f32::max)).collect()
}

impl Deformer for Corner {
    fn start_from(&mut self, first: &HostGaussians) -> Result<()> {
        let value = &mut self.parameters[0].value;
        *value = Tensor::from_floats(corner(first).as_slice(), &value.device());
        if self.record {
            FIRST.lock().unwrap().push(first.clone());
        }
        Ok(())
    }
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        Ok(SpatialFeatures { values: input.means_world.zeros_like(), work: DeformerWork::default() })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        if !time_norm.is_finite() {
            return Err(Error::parameter("deformer first-corner", format!("the time {time_norm} is not a number"), "Use a time in 0..1"));
        }
        let along = self.parameters[0].value.clone().reshape([1, 3]);
        Ok(Offsets { means: Some(features + along.mul_scalar(0.01 * time_norm)), ..Offsets::default() })
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        vec![ParameterGroup::plain("corner", 1e-6, 1e-6)]
    }
}

fn build_corner(settings: &toml::Table, _: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
    let Settings { record } = config::parse_section("deformer first-corner", settings)?;
    let corner = Parameter { name: "corner".into(), part: Part::Net, shape: vec![3], value: Tensor::zeros([3], device), group: 0 };
    Ok(Box::new(Corner { record, parameters: vec![corner] }))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "first-corner",
            version: "1",
            summary: "motion along the corner of the first Gaussians",
            paper: "a test",
            schema: "record = false\n",
            capabilities: &["differentiable"],
        },
        build: build_corner,
    }
}

#[test]
fn a_training_starts_its_deformer_on_what_may_move() {
    let session = Session::builder().device("flex").build().unwrap();
    let small = ["scene.width=48", "scene.height=48", "train.iterations=160", "train.batch=2", "init.count=400", "train.checks=false"];
    let own = ["train.zeta=0.3", "deformer={kind='first-corner', record=true}", "density={kind='none'}"];
    let config = session.config("demo", &[small.as_slice(), own.as_slice()].concat()).unwrap();
    let scene = session.read_scene("procedural", &config.scene).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    let model = session.train(&config, scene, Some(&run)).unwrap();
    let first = std::mem::take(&mut *FIRST.lock().unwrap());
    assert_eq!(first.len(), 1, "a training starts one deformer");
    let (some, all) = (first[0].len(), model.gaussians.len());
    assert!(some > 0 && some < all && first[0].dynamic_scores.iter().all(|&score| score > 0.3), "{some} of {all}");
    let weights = |model: &cc4dgs::Model| to_vec(model.field.as_ref().unwrap().field.parameters()[0].value.clone(), "corner").unwrap();
    let (learned, started) = (weights(&model), corner(&first[0]));
    assert!(started.iter().any(|&v| v > 0.01) && learned.iter().zip(&started).all(|(a, b)| (a - b).abs() < 1e-3), "{learned:?}, {started:?}");
    assert_eq!(weights(&session.open(&run).unwrap()), learned, "a stored model is opened without the first Gaussians");
}
