//! What a model is trained further on: the images of its scene, or its own.
//!
//! Models do not keep the colours per camera that they were trained with (`appearance`). Without them, training on the images would fit the colours of single
//! cameras, so such a model is trained on images that it drew itself before anything was rounded or removed.

use super::tune::TuneJob;
use crate::config::RunConfig;
use crate::sample::spread_views;
use cc4dgs_core::{Error, Event, FrameSource, Image8, Result, Scene, Split, config};
use cc4dgs_play::Player;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// The most images that are drawn, and the bytes that they may take. Fine-tuning sees about twice as many.
const MOST: u64 = 1000;
const MOST_BYTES: u64 = 2_000_000_000;

/// Images to train on.
#[derive(Clone)]
pub(super) struct Targets {
    /// The scene with these images; views have the numbers that they have in the scene of the model.
    pub scene: Arc<Scene>,
    /// The views that are trained on.
    pub views: Vec<usize>,
}

impl Targets {
    /// The images of the training views, drawn by the model itself where it was trained with colours per camera.
    pub fn of(job: &TuneJob) -> Result<Self> {
        let (scene, views) = (&job.scene, job.scene.split(Split::Train));
        let config: RunConfig = config::parse_section("configuration of the model", &job.model.provenance.config)?;
        if config.appearance.get("kind").and_then(|kind| kind.as_str()).unwrap_or("none") == "none" {
            return Ok(Self { scene: scene.clone(), views });
        }
        let bytes = |view: usize| 3 * u64::from(scene.camera(view).width) * u64::from(scene.camera(view).height);
        let largest = views.iter().map(|&view| bytes(view)).max().unwrap_or(1).max(1);
        let views = spread_views(scene, &views, MOST.min(MOST_BYTES / largest).max(1) as usize);
        let message = format!("trained with colours per camera, which models do not keep: training goes on towards {} images of its own", views.len());
        job.events.emit(&Event::Note { object: "model".into(), message });
        let mut player = Player::new(job.model, job.registry, job.device)?.on(scene.background);
        let mut images = BTreeMap::new();
        for &view in &views {
            if job.stop.load(Ordering::Relaxed) {
                return Err(Error::Interrupted("before further training; nothing was written".into()));
            }
            images.insert(view, player.frame(scene.camera(view), scene.views[view].time_norm)?);
            job.events.emit(&Event::Progress { task: "drawing the model's own images".into(), done: images.len() as u64, total: views.len() as u64 });
        }
        let drawn = Scene::new(scene.name.clone(), scene.cameras.clone(), scene.views.clone(), Arc::new(Drawn(images)), 0)?;
        Ok(Self { scene: Arc::new(drawn), views })
    }
}

/// Images by view.
struct Drawn(BTreeMap<usize, Image8>);

impl FrameSource for Drawn {
    fn load(&self, view: usize) -> Result<Image8> {
        self.0.get(&view).cloned().ok_or_else(|| Error::parameter("view", format!("image {view} was not drawn"), "Train on the views of these targets"))
    }
}
