//! Things that the model does not draw at all: a ball that crosses the scene is nowhere long enough for a static reconstruction, and once it is missing, no
//! gradient brings it back.
//!
//! During the main stage, training views are rendered and compared. Compact regions that differ much are looked for in views of neighbouring times; where
//! enough of them agree on a straight track, Gaussians are added along it, each with a velocity and a life of its own ([`cc4dgs_core::LIFE_ATTRIBUTES`]).

mod blobs;
mod seeds;
mod tracks;

use super::{Context, TrainState};
use crate::masks::blur;
use crate::sample::spread_views;
use blobs::blobs;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Camera, Event, LIFE_ATTRIBUTES, Result, Schedule, Split, Stage, plural};
use cc4dgs_play::Moving;
use cc4dgs_play::model::ModelDeformer;
use glam::DVec3;
use std::collections::BTreeSet;
use tracks::{Sighting, Track, best_track};

/// When it is looked for: shares of the main stage.
const SHARES: [f64; 2] = [0.15, 0.35];
/// The most training views that are compared.
const VIEWS: usize = 400;
/// The most regions of a view, the largest ones.
const BLOBS: usize = 6;
/// Mean absolute difference over the channels from which a pixel is not drawn, of values in 0..1, and the blur in pixels before.
const LOST: f32 = 0.12;
const BLUR: f32 = 1.0;
/// Images that a window of time has at least, and its least length in frames.
const IMAGES: usize = 8;
const LEAST_FRAMES: usize = 3;
/// The most things at a time.
const TRACKS: usize = 3;
/// Share of the regions that tracks must explain before Gaussians are given lives, which cost time: else the regions are what the deformer has not learned yet,
/// and some agree by chance.
const LEAST_EXPLAINED: f64 = 0.35;

/// What a view shows and the model does not. Images are not kept: they are loaded once more for the colours of what is added.
struct Lost {
    view: usize,
    /// Where the run believes it to be.
    camera: Camera,
    sightings: Vec<Sighting>,
}

impl Context<'_> {
    /// Adds Gaussians for what the model does not draw, when the iteration is due and `train.recover` is on.
    pub(crate) fn recover(&self, state: &mut TrainState, schedule: &Schedule) -> Result<()> {
        let due = SHARES.iter().any(|&share| schedule.iteration == schedule.iteration_at(share).round() as usize);
        if !(self.job.config.train.recover && schedule.stage == Stage::Main && due && state.moving != Moving::Nothing && self.can_live(state)) {
            return Ok(());
        }
        let lost = self.lost(state, schedule)?;
        let sightings: Vec<Sighting> = lost.iter().flat_map(|l| l.sightings.iter().copied()).collect();
        let frames = self.job.scene.frame_count.max(2);
        let window = (IMAGES * frames).div_ceil(lost.len().max(1)).max(LEAST_FRAMES);
        let stride = window.div_ceil(2);
        let interval = 1.0 / (frames - 1) as f64;
        let mut tracks: Vec<Track> = Vec::new();
        for (index, frame) in (0..frames).step_by(stride).enumerate() {
            let time = frame as f64 * interval;
            let near = 0.5 * window as f64 * interval + 1e-9;
            let mut among: Vec<usize> = (0..sightings.len()).filter(|&i| (sightings[i].time - time).abs() <= near).collect();
            for k in 0..TRACKS {
                let seed = self.seed.child("recover").index(schedule.iteration as u64).index(index as u64).index(k as u64);
                let Some(track) = best_track(&sightings, &among, time, seed) else { break };
                let used: BTreeSet<usize> = track.sightings.iter().copied().collect();
                among.retain(|i| !used.contains(i));
                tracks.push(track);
            }
        }
        let explained: BTreeSet<usize> = tracks.iter().flat_map(|track| track.sightings.iter().copied()).collect();
        let lives = state.deformer.as_ref().is_some_and(|deformer| own_lives(deformer) > 0);
        let too_few = !lives && (explained.len() as f64) < LEAST_EXPLAINED * sightings.len() as f64;
        let message = format!(
            "{} compact {} of {} training {} {} not drawn; {} {} through {} of them{}",
            sightings.len(),
            plural(sightings.len(), "region", "regions"),
            lost.len(),
            plural(lost.len(), "view", "views"),
            plural(sightings.len(), "is", "are"),
            tracks.len(),
            plural(tracks.len(), "track of things that move goes", "tracks of things that move go"),
            explained.len(),
            if too_few { ": too few, nothing is added" } else { "" }
        );
        self.job.events.emit(&Event::Note { object: "recover".into(), message });
        if tracks.is_empty() || too_few {
            return Ok(());
        }
        let most = self.most_added(state.set.len()).map_or(usize::MAX, |most| (most / seeds::PER_TRACK).max(1));
        let found = tracks.len();
        let tracks = most_seen(&tracks, most);
        if tracks.len() < found {
            let message =
                format!("tracks with fewer regions are left out, {} of {found}: density.max_gaussians allows no more Gaussians", found - tracks.len());
            self.job.events.emit(&Event::Note { object: "recover".into(), message });
        }
        self.give_lives(state)?;
        let half_width = 0.5 * stride as f64 * interval;
        let mut plan = seeds::plan(self, state, &lost, &sightings, &tracks, half_width)?;
        plan.check("recover", &state.set.gaussians()?)?;
        self.guard_plan(&mut plan, state, schedule)?;
        self.carry_out(&plan, state, schedule)?;
        state.density.executed(&plan, &self.device)
    }

    /// Training views and what the model does not draw of them.
    fn lost(&self, state: &mut TrainState, schedule: &Schedule) -> Result<Vec<Lost>> {
        let scene = &self.job.scene;
        let views = spread_views(scene, &scene.split(Split::Train), VIEWS);
        let background = self.job.config.background()?;
        let requests: Vec<(usize, f32)> = views.iter().map(|&view| (view, scene.views[view].time_norm)).collect();
        let gaussians = state.set.gaussians()?;
        let cameras: Vec<Camera> = views.iter().map(|&view| self.camera_of(scene, state, view)).collect::<Result<_>>()?;
        let mut lost = Vec::with_capacity(views.len());
        self.draw(state, &gaussians, &requests, schedule.sh_degree, |index, drawn| {
            let drawn = to_vec(drawn, "drawn view")?;
            let view = views[index];
            let camera = &cameras[index];
            let (w, h) = (camera.width as usize, camera.height as usize);
            let image = scene.frame(view)?.to_planes(background);
            let difference = |p: usize| (0..3).map(|k| (image[k * w * h + p] - drawn[k * w * h + p]).abs()).sum::<f32>() / 3.0;
            let residual = blur(&(0..w * h).map(difference).collect::<Vec<f32>>(), w, h, BLUR);
            let mask: Vec<bool> = residual.iter().map(|&v| v > LOST).collect();
            let (rotation, _) = camera.rotation_translation();
            let origin = DVec3::from(camera.center_world());
            let focal = (camera.fx * camera.fy).sqrt();
            let sighting = |blob: blobs::Blob| {
                let [x, y] = blob.center_px;
                let ray = DVec3::new((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0).normalize();
                let time = f64::from(scene.views[view].time_norm);
                Sighting { image: index, time, origin, direction: rotation.transpose() * ray, size: blob.radius_px / focal, pixel: 1.0 / focal }
            };
            let sightings = blobs(&mask, w, BLOBS).into_iter().map(sighting).collect();
            lost.push(Lost { view, camera: camera.clone(), sightings });
            Ok(())
        })?;
        Ok(lost)
    }

    /// Whether Gaussians have lives or can be given some: not those of a deformer with velocities of its own.
    fn can_live(&self, state: &TrainState) -> bool {
        let Some(deformer) = &state.deformer else { return false };
        let own = own_lives(deformer);
        let able = own == 0 || own == LIFE_ATTRIBUTES.len();
        if !able {
            let message = format!("{} has velocities of its own: nothing is added", deformer.name());
            self.job.events.emit(&Event::Note { object: "lives".into(), message });
        }
        able
    }

    /// Gives the Gaussians lives, unless the deformer has them: those that are there last for ever.
    fn give_lives(&self, state: &mut TrainState) -> Result<()> {
        let Some(old) = state.deformer.as_ref().filter(|old| own_lives(old) == 0) else { return Ok(()) };
        let mut section = old.section.clone();
        section.insert("life".into(), true.into());
        let section = self.job.registry.complete_deformer(&section)?;
        let mut field = self.job.registry.build_deformer(&section, &old.context, &self.device)?;
        for (to, from) in field.parameters_mut().into_iter().zip(old.field.parameters()) {
            to.value = from.value.clone();
        }
        let context = old.context.clone();
        state.set.add_attributes(&field.attributes(), self.seed.child("attributes"))?;
        state.deformer = Some(ModelDeformer { field, section, context });
        Ok(())
    }
}

/// The `most` of `tracks` that go through most regions, in their order.
fn most_seen(tracks: &[Track], most: usize) -> Vec<Track> {
    let mut kept: Vec<usize> = (0..tracks.len()).collect();
    kept.sort_by_key(|&track| std::cmp::Reverse(tracks[track].sightings.len()));
    kept.truncate(most);
    kept.sort_unstable();
    kept.into_iter().map(|track| tracks[track].clone()).collect()
}

/// How many of the attributes of lives a deformer has itself.
pub(super) fn own_lives(deformer: &ModelDeformer) -> usize {
    LIFE_ATTRIBUTES.iter().filter(|(name, _)| deformer.field.attributes().iter().any(|a| a.name == *name)).count()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tracks_with_most_regions_are_kept_in_their_order() {
        let track = |regions: usize| Track { time: 0.5, position: DVec3::ZERO, velocity: DVec3::ZERO, radius: 1.0, sightings: vec![0; regions] };
        let tracks = [4, 9, 5, 9].map(track);
        let kept = |most: usize| most_seen(&tracks, most).iter().map(|track| track.sightings.len()).collect::<Vec<_>>();
        assert_eq!((kept(3), kept(1), kept(usize::MAX)), (vec![9, 5, 9], vec![9], vec![4, 9, 5, 9]));
    }
}
