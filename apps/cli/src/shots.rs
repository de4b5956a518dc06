//! The cameras and times that a command renders: an orbit around the model, or the views of a dataset.

use crate::args::Shots;
use crate::commands::Context;
use crate::ignored::{Stated, refuse_ignored, written};
use cc4dgs::Orbit;
use cc4dgs::scenes::open_as_trained;
use cc4dgs_core::sample::spread_views;
use cc4dgs_core::{Camera, Error, Result, Split};
use cc4dgs_play::model::Model;
use std::path::Path;

/// Cameras and normalised times, and the background of the scene they are from.
pub type Chosen = (Vec<(Camera, f32)>, Option<[f32; 3]>);

/// What to render of `model`; `sets` are scene options. A split without views is an error where `images` are wanted.
pub fn choose(context: &Context, args: &Shots, sets: &[String], model: &Model, images: bool) -> Result<Chosen> {
    check_sets(args, sets)?;
    let Some(path) = &args.scene else {
        let standard = Orbit::default();
        let frames = args.frames.map_or(standard.frames, |n| n as usize);
        let orbit = Orbit { size: args.size.unwrap_or(standard.size), frames, turns: args.turns(), up: args.up().into() };
        let cameras = orbit.around(&model.gaussians)?;
        return Ok((cameras.into_iter().enumerate().map(|(i, camera)| (camera, orbit.time(i))).collect(), None));
    };
    let scene = open_as_trained(path, model, sets, &context.registry, &context.limits)?;
    let views = scene.split(args.split().into());
    if views.is_empty() && images {
        return Err(Error::parameter("--split", format!("{} has no such view", scene.name), "Render the other split"));
    }
    let wanted = args.frames.map_or(views.len(), |n| n as usize);
    let shot = |view: usize| {
        let camera = scene.camera(view);
        (args.size.map_or_else(|| camera.clone(), |(w, h)| camera.resized(w, h)), scene.views[view].time_norm)
    };
    Ok((spread_views(&scene, &views, wanted).into_iter().map(shot).collect(), scene.background))
}

/// Refuses scene options where no dataset is named.
pub fn check_sets(args: &Shots, sets: &[String]) -> Result<()> {
    if args.scene.is_some() || sets.is_empty() {
        return Ok(());
    }
    Err(Error::parameter("--set", "scene options without --scene", "Name the dataset whose cameras are wanted"))
}

/// Refuses the upward axis of an orbit beside the cameras of a dataset.
pub fn check_up(args: &Shots) -> Result<()> {
    let (value, remedy) = (args.up.as_ref().map(written), "Leave one of the two out: it is the axis of an orbit".into());
    refuse_ignored("the cameras of --scene", [Stated { option: "--up", value, used: args.scene.is_none(), remedy }])
}

/// The cameras that recorded the dataset at `path`, as `model` was trained on them with scene options `sets` laid over: those of the training views, each once.
pub fn capture_cameras(context: &Context, path: &Path, sets: &[String], model: &Model) -> Result<Vec<Camera>> {
    let scene = open_as_trained(path, model, sets, &context.registry, &context.limits)?;
    let mut indices: Vec<usize> = scene.split(Split::Train).into_iter().map(|view| scene.views[view].camera).collect();
    indices.sort_unstable();
    indices.dedup();
    Ok(indices.into_iter().map(|i| scene.cameras[i].clone()).collect())
}
