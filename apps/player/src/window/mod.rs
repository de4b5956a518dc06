//! The player in a desktop window (eframe), which shares the device with its controls. What needs no window library, and tests of it, is in `desktop`.

mod controls;
mod image;
mod keep;
mod opening;
mod switch;

use crate::desktop::lost::Lost;
pub use crate::desktop::{live::Live, start::Start};
use crate::exact::Exact;
use crate::render::{descriptor, remark};
use crate::{Clock, Content, Navigator, Renderer, View};
use cc4dgs_format::{Camera, Error, Result};
use eframe::egui;
use eframe::egui_wgpu::{WgpuConfiguration, WgpuSetup, WgpuSetupCreateNew};
use image::{FORMAT, Image};
use opening::Opening;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use switch::Switch;

/// What a window shows.
pub enum Shown {
    /// A model.
    Model(Box<Opened>, Source),
    /// A training under way.
    Training(Arc<Live>),
}

/// A model for a window.
pub struct Opened {
    /// What the player draws.
    pub content: Content,
    /// The images of its deformer and rasterizer, or why there are none.
    pub exact: Exact,
}

/// Where a model comes from.
#[derive(Clone)]
pub struct Source {
    /// Its file or folder.
    pub path: PathBuf,
    /// How this file is opened again, and how others are; on a thread of its own.
    pub open: Open,
    /// Where the window begins.
    pub start: Start,
    /// The command that opens a window, with the options that say how, such as `cc4dgs view --device wgpu`.
    pub command: String,
}

/// Opens the model in a file.
pub type Open = Arc<dyn Fn(&Path) -> Result<Opened> + Send + Sync>;

/// Why a training has no exact images.
const COPIES: &str = "A training hands over copies of its Gaussians, without its deformer. Open its folder when it is done.";

/// Opens a window until it is closed. Call it on the main thread: some systems allow windows there only.
///
/// # Errors
/// [`Error::Limit`] for models that the device has no memory for, [`Error::Unsupported`] where no window can be opened, [`Error::Backend`] where the device is
/// lost.
pub fn show(title: &str, shown: Shown) -> Result<()> {
    let lost = Lost::default();
    let of_window = lost.clone();
    lost.guard(|| run(title, shown, of_window))
}

fn run(title: &str, shown: Shown, lost: Lost) -> Result<()> {
    let setup = WgpuSetupCreateNew { device_descriptor: Arc::new(descriptor), ..WgpuSetupCreateNew::without_display_handle() };
    let options = eframe::NativeOptions {
        viewport: egui::ViewportBuilder::default().with_title(format!("{title} – cc4dgs")).with_inner_size([1100.0, 760.0]),
        wgpu_options: WgpuConfiguration { wgpu_setup: WgpuSetup::CreateNew(setup), ..Default::default() },
        ..Default::default()
    };
    let failure = Arc::new(Mutex::new(None));
    let told = failure.clone();
    let created = move |cc: &eframe::CreationContext<'_>| -> std::result::Result<Box<dyn eframe::App>, Box<dyn std::error::Error + Send + Sync>> {
        match Window::new(cc, shown, lost) {
            Ok(window) => Ok(Box::new(window)),
            Err(e) => {
                let text = e.to_string();
                if let Ok(mut told) = told.lock() {
                    *told = Some(e);
                }
                Err(text.into())
            }
        }
    };
    let result = eframe::run_native("cc4dgs", options, Box::new(created));
    if let Some(error) = failure.lock().ok().and_then(|mut told| told.take()) {
        return Err(error);
    }
    result.map_err(|e| Error::unsupported("window", e.to_string(), "Start it in a graphical session with a Vulkan, Metal or Direct3D 12 driver"))
}

/// Title of a window that shows the file `path`.
fn titled(path: &Path) -> String {
    format!("{} – cc4dgs", path.file_name().unwrap_or(path.as_os_str()).to_string_lossy())
}

struct Window {
    renderer: Renderer,
    navigator: Navigator,
    clock: Clock,
    cameras: Vec<Camera>,
    live: Option<Arc<Live>>,
    /// Where the model comes from, and how others are opened; absent from a training, which has a model of its own to show.
    source: Option<Source>,
    opening: Option<Opening>,
    /// The path that is being typed.
    typed: Option<String>,
    exact: Switch,
    /// What the device or the training complained about last.
    trouble: Arc<Mutex<Option<String>>>,
    /// What was done, or why the image is smaller than it was to be.
    notice: Option<String>,
    /// Whether a notice has said that the image is smaller than it was to be.
    told: bool,
    lost: Lost,
    /// What the file holds and is not shown, and whether that was read.
    remarks: String,
    read: bool,
    /// Size of the file; 0 where there is none.
    bytes: u64,
    /// Whether a model has been shown.
    loaded: bool,
    look: View,
    resolution: f32,
    flying: bool,
    settings: bool,
    image: Option<Image>,
    /// The view that `image` has; `None` where it has none of this scene.
    painted: Option<View>,
    /// Size of the player's last image in pixels.
    drawn: (u32, u32),
    visible: Arc<AtomicU32>,
    counted: f64,
    /// Frames per second, smoothed.
    rate: f32,
}

impl Window {
    fn new(cc: &eframe::CreationContext<'_>, shown: Shown, lost: Lost) -> Result<Self> {
        let none = || Error::unsupported("window", "it has no wgpu device", "Install a Vulkan, Metal or Direct3D 12 driver");
        let state = cc.wgpu_render_state.as_ref().ok_or_else(none)?;
        let trouble = Arc::new(Mutex::new(None));
        let told = trouble.clone();
        // Without a handler, wgpu ends the process.
        state.device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| *told.lock().unwrap_or_else(PoisonError::into_inner) = Some(e.to_string())));
        let (noted, ctx) = (lost.clone(), cc.egui_ctx.clone());
        state.device.set_device_lost_callback(move |_, _| {
            noted.lose();
            ctx.request_repaint();
        });
        let navigator = Navigator::new(&Default::default(), [-1.0; 3], [1.0; 3]);
        let mut window = Self {
            renderer: Renderer::new(state.device.clone(), state.queue.clone(), FORMAT),
            look: View::new(navigator.camera(16, 16), 0.0),
            navigator,
            clock: Clock::new(1, 1.0),
            cameras: Vec::new(),
            live: None,
            source: None,
            opening: None,
            typed: None,
            exact: Switch::new(Err(COPIES.to_string())),
            trouble,
            notice: None,
            told: false,
            lost,
            remarks: String::new(),
            read: false,
            bytes: 0,
            loaded: false,
            resolution: 1.0,
            flying: false,
            settings: false,
            image: None,
            painted: None,
            drawn: (1, 1),
            visible: Arc::default(),
            counted: 0.0,
            rate: 0.0,
        };
        match shown {
            Shown::Model(opened, source) => {
                window.show(*opened)?;
                if let Some(pose) = source.start.pose {
                    window.navigator.set_pose(pose);
                }
                if let Some(time) = source.start.time {
                    window.clock.play(false);
                    window.clock.seek(time);
                }
                window.source = Some(source);
            }
            Shown::Training(live) => {
                let ctx = cc.egui_ctx.clone();
                live.open(move |delay| ctx.request_repaint_after(delay));
                window.live = Some(live);
            }
        }
        Ok(window)
    }
    /// Shows `content`; the first one sets camera and clock, later ones leave them.
    fn load(&mut self, mut content: Content) -> Result<()> {
        content.fit_harmonics(self.renderer.most_words(), "a buffer of this graphics device", "Use a device with larger buffers to see all");
        let Content { scene, presentation, frame_count, lacks_motion: _, remarks, bytes } = content;
        let ([lower, upper], seconds) = (scene.bounds, presentation.seconds_of(frame_count));
        self.renderer.load(scene)?;
        self.painted = None;
        if !self.loaded {
            self.navigator = Navigator::new(&presentation, lower, upper);
            self.clock = self.clock.of_other(frame_count, seconds);
        }
        (self.clock.frames, self.clock.seconds) = (frame_count.max(1), seconds.max(1e-3));
        let remarks = remarks.join(" ");
        // What every model of a training leaves out is read once.
        self.read &= self.loaded && remarks == self.remarks;
        (self.cameras, self.remarks, self.bytes, self.loaded) = (presentation.cameras, remarks, bytes, true);
        Ok(())
    }
    /// Takes what the training offered.
    fn follow(&mut self) {
        let Some(content) = self.live.as_ref().and_then(|live| live.take()) else { return };
        if let Err(e) = self.load(content) {
            self.complain(e.to_string());
        }
    }
    /// Says what is wrong.
    fn complain(&self, text: String) {
        *self.trouble.lock().unwrap_or_else(PoisonError::into_inner) = Some(text);
    }
    /// Forgets what was wrong.
    fn silence(&self) {
        *self.trouble.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }
    /// Shows a model that was opened, from its start. Where it is refused, the one before stays.
    fn show(&mut self, opened: Opened) -> Result<()> {
        let before = std::mem::replace(&mut self.loaded, false);
        if let Err(e) = self.load(opened.content) {
            self.loaded = before;
            return Err(e);
        }
        self.exact.replace(opened.exact);
        self.clock.play(true);
        Ok(())
    }
    /// The view of an image of this size.
    fn view(&self, width: u32, height: u32) -> View {
        View { camera: self.navigator.camera(width, height), time: self.clock.time, ..self.look.clone() }
    }
    /// Draws the scene and shows it in what is left of the window.
    fn scene(&mut self, ui: &mut egui::Ui, frame: &eframe::Frame) {
        let Some(state) = frame.wgpu_render_state() else { return };
        let scale = ui.ctx().pixels_per_point() * self.resolution;
        let available = ui.available_size();
        let side = |points: f32| ((points * scale).round() as u32).max(1);
        let wanted = (side(available.x), side(available.y));
        let size = self.renderer.most_pixels().fit(wanted);
        if let Some(remark) = remark(wanted, size).filter(|_| !self.told) {
            (self.told, self.notice) = (true, Some(remark));
        }
        self.drawn = size;
        let view = self.view(size.0, size.1);
        let exact = self.exact.follow(ui.ctx(), state, &mut self.renderer, &view).unwrap_or_else(|e| {
            self.complain(e.to_string());
            ui.ctx().request_repaint();
            None
        });
        let id = exact.unwrap_or_else(|| {
            let image = Image::sized(&mut self.image, state, size);
            // The window repaints at every move of the pointer, and the scene is by far the largest part of that: it is drawn where it changed.
            if self.painted.as_ref() != Some(&view) {
                self.renderer.draw(&view, &image.view);
                self.painted = Some(view.clone());
            }
            image.id
        });
        // No stop of the Tab key: what has its focus takes the keys.
        let image = egui::Image::from_texture((id, available)).sense(egui::Sense::CLICK | egui::Sense::DRAG);
        let response = ui.add(image);
        self.gestures(ui, &response);
        if self.exact.is_on() {
            self.sign(ui, response.rect);
        }
    }
}

impl Drop for Window {
    fn drop(&mut self) {
        if let Some(live) = &self.live {
            live.close();
        }
    }
}

impl eframe::App for Window {
    fn ui(&mut self, ui: &mut egui::Ui, frame: &mut eframe::Frame) {
        let ctx = ui.ctx().clone();
        if self.lost.is_lost() {
            ctx.send_viewport_cmd(egui::ViewportCommand::Close);
            return;
        }
        self.lost.note(self.command());
        let elapsed = ctx.input(|i| i.stable_dt).min(0.25);
        self.rate += 0.1 * (1.0 / elapsed.max(1e-4) - self.rate);
        if self.clock.tick(elapsed) || self.clock.runs() {
            ctx.request_repaint();
        }
        self.follow();
        self.dropped(&ctx);
        self.keys(&ctx, f64::from(elapsed));
        self.messages(ui);
        self.opening_lines(ui);
        egui::Panel::bottom("time").show(ui, |ui| self.bar(ui));
        if self.settings {
            let adapter = frame.wgpu_render_state().map(|s| s.adapter.get_info().name).unwrap_or_default();
            egui::Panel::right("settings").show(ui, |ui| self.panel(ui, &adapter));
            let now = ctx.input(|i| i.time);
            if now - self.counted > 1.0 {
                self.counted = now;
                let visible = self.visible.clone();
                self.renderer.count_visible(move |count| visible.store(count, Ordering::Relaxed));
            }
        }
        egui::CentralPanel::no_frame().show(ui, |ui| self.scene(ui, frame));
    }
}
