//! The switch from the player's images to exact ones.

use super::image::Image;
use crate::desktop::exact_view::{Choice, pixels, psnr_db, reduced};
use crate::exact::{Exact, ExactImage, ExactImages, ExactWorker};
use crate::{Mode, Renderer, View};
use cc4dgs_format::{Error, Image8, Result};
use eframe::egui;
use eframe::egui_wgpu::RenderState;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

/// A view that has not changed for so long stands still: its image is drawn at full size.
const STILL: Duration = Duration::from_millis(200);
/// How soon the window looks again for what it waits for.
const SOON: Duration = Duration::from_millis(30);

/// Exact images of the model in the window, where it has them.
pub(super) struct Switch {
    choice: Choice,
    /// What draws them, until its thread is started.
    images: Option<Box<dyn ExactImages>>,
    worker: Option<ExactWorker>,
    /// The thread of the model before.
    last: Option<ExactWorker>,
    asked: Option<View>,
    /// The view of the last frame, and since when it is that one.
    seen: Option<View>,
    since: f64,
    texture: Option<Image>,
    shown: Option<Shown>,
    /// Milliseconds of the last full image, and its pixels.
    pace: Option<(f64, f64)>,
}

/// The exact image in the window.
struct Shown {
    image: Arc<Image8>,
    view: View,
    renderer: String,
    ms: f64,
    /// PSNR against the player's image in dB, once it is compared; no number where it could not be.
    psnr_db: Option<Arc<OnceLock<f64>>>,
    /// Whether the window was drawn after that.
    told: bool,
}

impl Switch {
    pub(super) fn new(exact: Exact) -> Self {
        let (images, lacks) = match exact {
            Ok(images) => (Some(images), String::new()),
            Err(lacks) => (None, lacks),
        };
        Self { choice: Choice::new(lacks), images, worker: None, last: None, asked: None, seen: None, since: 0.0, texture: None, shown: None, pace: None }
    }
    /// Takes the place of the switch of another model: stays on where it can.
    pub(super) fn replace(&mut self, exact: Exact) {
        let (on, texture) = (self.is_on(), self.texture.take());
        let last = self.worker.take().or_else(|| self.last.take());
        if let Some(worker) = &last {
            worker.close();
        }
        *self = Self::new(exact);
        (self.last, self.texture) = (last, texture);
        self.set(on);
    }
    /// Why there are no exact images.
    pub(super) fn lacks(&self) -> Option<&str> {
        self.choice.lacks()
    }
    pub(super) fn is_on(&self) -> bool {
        self.choice.is_on()
    }
    pub(super) fn set(&mut self, on: bool) {
        self.choice.set(on);
        (self.asked, self.seen) = (None, None);
        if !self.is_on() {
            self.shown = None;
        }
    }
    /// What shows instead of the player's image of `view`, if there is something yet. Asks for what is missing.
    ///
    /// # Errors
    /// Why an image could not be drawn; the switch is off then.
    pub(super) fn follow(&mut self, ctx: &egui::Context, state: &RenderState, renderer: &mut Renderer, view: &View) -> Result<Option<egui::TextureId>> {
        if !self.is_on() {
            return Ok(None);
        }
        // What exact images do not have is no other view.
        let view = &View { mode: Mode::Color, tint: false, ..view.clone() };
        let followed = self.ask(ctx, view).and_then(|()| self.receive(state, view));
        if let Err(e) = followed {
            self.set(false);
            return Err(e);
        }
        self.compare(ctx, renderer, view);
        Ok(self.texture.as_ref().filter(|_| self.shown.is_some()).map(|texture| texture.id))
    }
    fn ask(&mut self, ctx: &egui::Context, view: &View) -> Result<()> {
        // One model at a time in memory, and one image under way.
        if self.last.as_ref().is_some_and(|worker| !worker.is_finished()) {
            ctx.request_repaint_after(SOON);
            return Ok(());
        }
        self.last = None;
        if let Some(images) = self.images.take() {
            let window = ctx.clone();
            self.worker = Some(ExactWorker::new(images, move || window.request_repaint())?);
        }
        let now = ctx.input(|i| i.time);
        if self.seen.as_ref() != Some(view) {
            (self.seen, self.since) = (Some(view.clone()), now);
        }
        let moves = now - self.since < STILL.as_secs_f64();
        if moves {
            ctx.request_repaint_after(STILL);
        }
        let wanted = if moves { reduced(view, self.pace) } else { view.clone() };
        if self.asked.as_ref() != Some(&wanted)
            && let Some(worker) = &self.worker
        {
            self.asked = Some(wanted.clone());
            worker.ask(wanted);
        }
        Ok(())
    }
    /// Takes what was drawn.
    fn receive(&mut self, state: &RenderState, full: &View) -> Result<()> {
        let Some(ExactImage { view, result, renderer, ms }) = self.worker.as_ref().and_then(ExactWorker::take) else { return Ok(()) };
        let image = result?;
        image.validate("exact image")?;
        let (size, most) = ((image.width, image.height), state.device.limits().max_texture_dimension_2d);
        if size.0.max(size.1) > most {
            return Err(Error::limit("side of an exact image in pixels", size.0.max(size.1).into(), most.into(), "Choose a smaller resolution"));
        }
        Image::sized(&mut self.texture, state, size).write(state, &image);
        if (view.camera.width, view.camera.height) == (full.camera.width, full.camera.height) {
            self.pace = Some((ms, pixels(&view)));
        }
        self.shown = Some(Shown { image: Arc::new(image), view, renderer, ms, psnr_db: None, told: false });
        Ok(())
    }
    /// Has the player draw the same image and compares the two, once per full image.
    fn compare(&mut self, ctx: &egui::Context, renderer: &mut Renderer, full: &View) {
        let Some(shown) = self.shown.as_mut().filter(|shown| shown.view == *full && !shown.told) else { return };
        let psnr = shown.psnr_db.get_or_insert_with(|| {
            let (psnr, exact) = (Arc::new(OnceLock::new()), shown.image.clone());
            let compared = psnr.clone();
            renderer.capture(full, move |drawn| {
                compared.set(drawn.ok().and_then(|drawn| psnr_db(&exact, &drawn)).unwrap_or(f64::NAN)).ok();
            });
            psnr
        });
        // A device that is lost says so elsewhere.
        renderer.device().poll(wgpu::PollType::Poll).ok();
        shown.told = psnr.get().is_some();
        ctx.request_repaint_after(if shown.told { Duration::ZERO } else { SOON });
    }
    /// The image in the window, where it is the full one of the view.
    fn current(&self) -> Option<&Shown> {
        self.shown.as_ref().filter(|shown| self.seen.as_ref() == Some(&shown.view))
    }
    /// The exact image of the view, where it is shown and complete.
    pub(super) fn complete(&self) -> Option<&Image8> {
        self.current().map(|shown| &*shown.image)
    }
    /// A line over the image, and whether the exact image of the view is still being computed.
    pub(super) fn sign(&self) -> (String, bool) {
        match (self.current(), &self.shown) {
            (Some(shown), _) => (format!("Exact · {:.0} ms{}", shown.ms, shown.agreement().map_or_else(String::new, |text| format!(" · {text}"))), false),
            (None, Some(shown)) => (format!("Exact · computing … (the image before took {:.0} ms)", shown.ms), true),
            (None, None) => ("Exact · computing the first image … (this is the player's)".to_string(), true),
        }
    }
    /// What drew the image in the window, in lines.
    pub(super) fn statistics(&self) -> Vec<String> {
        let Some(shown) = &self.shown else { return vec!["Drawn by the player".to_string()] };
        let camera = &shown.view.camera;
        let mut lines = vec![format!("Drawn exactly: {}", shown.renderer), format!("{}×{} pixels in {:.0} ms", camera.width, camera.height, shown.ms)];
        lines.extend(self.current().and_then(Shown::agreement).map(|text| format!("{text} against the player")));
        lines
    }
}

impl Shown {
    fn agreement(&self) -> Option<String> {
        let db = *self.psnr_db.as_ref()?.get()?;
        if db.is_infinite() { Some("identical".to_string()) } else { (!db.is_nan()).then(|| format!("PSNR {db:.2} dB")) }
    }
}

impl Drop for Switch {
    fn drop(&mut self) {
        // Both are told before either is waited for.
        self.worker.iter().chain(&self.last).for_each(ExactWorker::close);
    }
}
