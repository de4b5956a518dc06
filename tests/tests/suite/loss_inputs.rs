//! What loss terms receive in training: the camera and the view, and the canonical Gaussians, which learn from them.

use burn::tensor::Tensor;
use cc4dgs::Session;
use cc4dgs_core::{Camera, LossInput, LossPlugin, LossTerm, Plugin, Result, Stage, View, config, inventory, ordered_sum, toml};
use std::sync::{Arc, Mutex};

/// What the term received, in the order of its calls.
static SEEN: Mutex<Vec<Seen>> = Mutex::new(Vec::new());

struct Seen {
    stage: Stage,
    camera: Camera,
    view: View,
    /// The largest distance of a coordinate as drawn from the canonical one.
    moved: f32,
}

/// The mean opacity logit of the canonical Gaussians times `direction`, in the main stage alone. With `record`, calls are kept in [`SEEN`].
#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Opacities {
    direction: f32,
    record: bool,
}

impl Default for Opacities {
    fn default() -> Self {
        Self { direction: 1.0, record: false }
    }
}

impl LossTerm for Opacities {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        let (drawn, canonical) = (input.gaussians, input.canonical);
        if self.record {
            let moved = (drawn.means.clone().inner() - canonical.means.clone().inner()).abs().max().into_scalar::<f32>();
            let seen = Seen { stage: input.schedule.stage, camera: input.camera.clone(), view: input.view.clone(), moved };
            SEEN.lock().unwrap().push(seen);
        }
        let applies = input.schedule.stage == Stage::Main && !canonical.is_empty();
        Ok(applies.then(|| ordered_sum(canonical.opacity_logits.clone()).mul_scalar(self.direction / canonical.len() as f32)))
    }
}

fn build(settings: &toml::Table) -> Result<Box<dyn LossTerm>> {
    Ok(Box::new(config::parse_section::<Opacities>("loss canonical-opacities", settings)?))
}

inventory::submit! {
    LossPlugin {
        info: Plugin {
            name: "canonical-opacities",
            version: "1",
            summary: "the mean opacity logit before the deformer",
            paper: "a test",
            schema: "direction = 1.0\nrecord = false\n",
            capabilities: &[],
        },
        build,
        fuses: None,
    }
}

#[test]
fn terms_know_the_view_and_canonical_gaussians_learn_from_them() {
    let session = Session::builder().device("flex").build().unwrap();
    let [down, up] = [1.0f32, -1.0].map(|direction| {
        let term = format!("{{kind='canonical-opacities', weight=1000.0, direction={direction:?}, record=true}}");
        let loss = format!("loss=[{{kind='l1', weight=1.0}}, {term}]");
        let short = ["train.iterations=30", "train.shares=[1.0, 0.0, 2.0]", "train.dynamic=all", "train.checks=false", "init.count=300"];
        let sets: Vec<&str> = [loss.as_str(), "density={kind='none'}"].into_iter().chain(short).collect();
        let config = session.config("demo", &sets).unwrap();
        let scene = Arc::new(session.read_scene("procedural:tiny", &config.scene).unwrap());
        let logits = session.train(&config, scene.clone(), None).unwrap().gaussians.opacity_logits.clone();
        let seen = std::mem::take(&mut *SEEN.lock().unwrap());
        assert!(seen.iter().all(|seen| scene.views.contains(&seen.view) && scene.cameras[seen.view.camera] == seen.camera));
        let most = |stage: Stage| seen.iter().filter(|seen| seen.stage == stage).map(|seen| seen.moved).reduce(f32::max).unwrap();
        assert!(most(Stage::Coarse) == 0.0 && most(Stage::Main) > 0.0, "the deformer moves in the main stage alone");
        logits.iter().sum::<f32>() / logits.len() as f32
    });
    assert!(down + 0.3 < up, "mean logits {down} and {up}");
}
