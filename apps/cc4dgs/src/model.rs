//! A trained model with the session it belongs to.

use crate::Session;
use cc4dgs_core::{Event, Result, Scene};
use cc4dgs_play::{ArchiveOptions, OrbitViews, ViewSource};
use cc4dgs_train::train::{TuneJob, Tuner};
use std::ops::{Deref, DerefMut};
use std::path::Path;
use std::sync::Arc;

/// The weight codec of [`Model::save`]: exact.
const FIELD_WEIGHTS: &str = "fp32";

/// A model: its Gaussians, the deformer that moves them, and how they want to be drawn. Everything of [`cc4dgs_play::model::Model`] is there as well.
pub struct Model {
    inner: cc4dgs_play::model::Model,
    session: Session,
}

impl Model {
    /// `inner` as a model of `session`.
    pub fn new(inner: cc4dgs_play::model::Model, session: Session) -> Self {
        Self { inner, session }
    }
    /// The session it belongs to.
    pub fn session(&self) -> &Session {
        &self.session
    }
    /// Writes a `.cc4d` archive with the codec `name` or `name:profile` and returns its size in bytes. The file appears complete or not at all.
    ///
    /// # Errors
    /// [`Error::Parameter`](crate::Error::Parameter) for unknown codecs and profiles, and what codec and disk report.
    pub fn save(&self, path: impl AsRef<Path>, codec: &str) -> Result<u64> {
        self.save_with(path, &ArchiveOptions { codec, settings: &toml::Table::new(), field_weights: FIELD_WEIGHTS, views: None, tuner: None })
    }
    /// As [`Model::save`], with settings of the codec, a weight codec for the deformer, and the views for codecs that make use of them.
    ///
    /// # Errors
    /// As [`Model::save`], and for settings the codec does not have.
    pub fn save_with(&self, path: impl AsRef<Path>, options: &ArchiveOptions) -> Result<u64> {
        let (path, session) = (path.as_ref(), &self.session);
        let bytes = self.inner.save_archive(path, options, session.registry(), session.limits(), session.events())?;
        session.events().emit(&Event::Saved { path: path.display().to_string(), bytes });
        Ok(bytes)
    }
    /// As [`Model::save_with`], with the scene that the model was trained on, for codecs that make use of it: `compact` looks at how much each value matters to
    /// training views, and trains the model further while its values are rounded. `field_weights` is the weight codec of the deformer.
    ///
    /// # Errors
    /// As [`Model::save_with`], and [`Error::Interrupted`](crate::Error::Interrupted) where [`Session::stop`] is called meanwhile; nothing is written then.
    pub fn save_tuned(&self, path: impl AsRef<Path>, codec: &str, settings: &toml::Table, field_weights: &str, scene: &Arc<Scene>) -> Result<u64> {
        let session = &self.session;
        let tuner = Tuner::new(TuneJob {
            model: &self.inner,
            scene: scene.clone(),
            field_weights,
            registry: session.registry(),
            device: session.device(),
            limits: session.limits(),
            events: session.events(),
            stop: session.stop_flag(),
        });
        let views = Some((ViewSource::Scene(scene), session.device()));
        self.save_with(path, &ArchiveOptions { codec, settings, field_weights, views, tuner: Some(&tuner) })
    }
    /// As [`Model::save_with`], with `count` views all round the model for codecs that make use of them, where its scene is not there: `compact` looks at how
    /// much each value matters there, and compares renders before and after. The cameras are outside, so this is for objects: not for rooms that are seen from
    /// within.
    ///
    /// # Errors
    /// As [`Model::save_with`] and [`OrbitViews::around`], and [`Error::Parameter`](crate::Error::Parameter) for settings that need the images of a scene.
    pub fn save_on_orbit(&self, path: impl AsRef<Path>, codec: &str, settings: &toml::Table, field_weights: &str, count: usize) -> Result<u64> {
        let orbit = OrbitViews::around(&self.inner.gaussians, OrbitViews::SIZE, count)?;
        let views = Some((ViewSource::Orbit(&orbit), self.session.device()));
        self.save_with(path, &ArchiveOptions { codec, settings, field_weights, views, tuner: None })
    }
}

impl Deref for Model {
    type Target = cc4dgs_play::model::Model;
    fn deref(&self) -> &Self::Target {
        &self.inner
    }
}

impl DerefMut for Model {
    fn deref_mut(&mut self) -> &mut Self::Target {
        &mut self.inner
    }
}
