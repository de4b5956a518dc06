//! The player in a desktop window (eframe), which shares the device with its controls.

use crate::{Clock, Content, Mode, Navigator, Renderer, View};
use cc4dgs_format::{Camera, Error, Result};
use eframe::egui;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

/// Format of the texture that egui shows.
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;
/// Share of the distance to the target that is flown per second.
const FLIGHT: f64 = 1.0;

/// Shows `content` in a window until it is closed. Call it on the main thread: some systems allow windows there only.
///
/// # Errors
/// [`Error::Limit`] for models that the device has no memory for, [`Error::Unsupported`] where no window can be opened.
pub fn show(title: &str, content: Content) -> Result<()> {
    let options = eframe::NativeOptions {
        viewport: egui::ViewportBuilder::default().with_title(format!("{title} – cc4dgs")).with_inner_size([1100.0, 760.0]),
        ..Default::default()
    };
    let failure = Arc::new(std::sync::Mutex::new(None));
    let told = failure.clone();
    let created = move |cc: &eframe::CreationContext<'_>| -> std::result::Result<Box<dyn eframe::App>, Box<dyn std::error::Error + Send + Sync>> {
        match Window::new(cc, content) {
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

struct Shown {
    view: wgpu::TextureView,
    id: egui::TextureId,
    size: (u32, u32),
}

struct Window {
    renderer: Renderer,
    navigator: Navigator,
    clock: Clock,
    cameras: Vec<Camera>,
    lacks_motion: bool,
    look: View,
    resolution: f32,
    flying: bool,
    settings: bool,
    shown: Option<Shown>,
    visible: Arc<AtomicU32>,
    counted: f64,
    /// Frames per second, smoothed.
    rate: f32,
}

impl Window {
    fn new(cc: &eframe::CreationContext<'_>, content: Content) -> Result<Self> {
        let none = || Error::unsupported("window", "it has no wgpu device", "Install a Vulkan, Metal or Direct3D 12 driver");
        let state = cc.wgpu_render_state.as_ref().ok_or_else(none)?;
        let mut renderer = Renderer::new(state.device.clone(), state.queue.clone(), FORMAT);
        let [lower, upper] = content.scene.bounds;
        let navigator = Navigator::new(&content.presentation, lower, upper);
        let mut clock = Clock::new(content.frame_count, content.presentation.seconds_of(content.frame_count));
        clock.playing = content.frame_count > 1;
        renderer.load(content.scene)?;
        Ok(Self {
            renderer,
            look: View::new(navigator.camera(16, 16), 0.0),
            navigator,
            clock,
            cameras: content.presentation.cameras,
            lacks_motion: content.lacks_motion,
            resolution: 1.0,
            flying: false,
            settings: false,
            shown: None,
            visible: Arc::default(),
            counted: 0.0,
            rate: 0.0,
        })
    }
    fn bar(&mut self, ui: &mut egui::Ui) {
        ui.horizontal(|ui| {
            let still = self.clock.frames < 2;
            ui.add_enabled_ui(!still, |ui| {
                if ui.button(if self.clock.playing { "⏸" } else { "▶" }).on_hover_text("Play (Space)").clicked() {
                    self.clock.playing = !self.clock.playing;
                }
                if ui.button("⏮").on_hover_text("One frame back (,)").clicked() {
                    self.clock.step(-1);
                }
                if ui.button("⏭").on_hover_text("One frame on (.)").clicked() {
                    self.clock.step(1);
                }
                let mut time = self.clock.time;
                ui.spacing_mut().slider_width = (ui.available_width() - 330.0).max(80.0);
                if ui.add(egui::Slider::new(&mut time, 0.0..=1.0).show_value(false)).changed() {
                    self.clock.seek(time);
                }
                let seconds = self.clock.time * self.clock.seconds;
                ui.monospace(if still { "still".into() } else { format!("{:>4} / {} · {seconds:6.2} s", self.clock.frame() + 1, self.clock.frames) });
                ui.add(egui::DragValue::new(&mut self.clock.speed).range(-4.0..=4.0).speed(0.02).suffix("×")).on_hover_text("Speed");
                ui.toggle_value(&mut self.clock.looping, "⟳").on_hover_text("Loop");
            });
            ui.toggle_value(&mut self.settings, "☰").on_hover_text("Settings");
        });
    }
    fn panel(&mut self, ui: &mut egui::Ui, adapter: &str) {
        egui::ComboBox::from_label("Camera").selected_text("choose").show_ui(ui, |ui| {
            if ui.button("Home").clicked() {
                self.navigator.reset();
            }
            for camera in &self.cameras {
                if ui.button(&camera.name).clicked() {
                    self.navigator.go_to(camera);
                }
            }
        });
        ui.horizontal(|ui| {
            if ui.button("Reset (R)").clicked() {
                self.navigator.reset();
            }
            ui.toggle_value(&mut self.flying, "Fly (F)").on_hover_text("W A S D Q E, drag to look");
        });
        let degree = self.renderer.scene().map_or(0, |s| s.sh_degree);
        self.look.sh_degree = self.look.sh_degree.min(degree);
        ui.add(egui::Slider::new(&mut self.look.scale, 0.1..=2.0).text("Size"));
        ui.add(egui::Slider::new(&mut self.look.sh_degree, 0..=degree).text("SH degree"));
        ui.add(egui::Slider::new(&mut self.resolution, 0.25..=2.0).text("Resolution"));
        ui.checkbox(&mut self.look.tint, "Tint what moves");
        let mut depth = self.look.mode == Mode::Depth;
        ui.checkbox(&mut depth, "Depth");
        self.look.mode = if depth { Mode::Depth } else { Mode::Color };
        ui.separator();
        if let Some(scene) = self.renderer.scene() {
            ui.small(format!("{:.0} frames/s", self.rate));
            ui.small(format!("{} of {} Gaussians drawn, {} move", self.visible.load(Ordering::Relaxed), scene.count, scene.moving));
            ui.small(adapter);
        }
        if self.lacks_motion {
            ui.small("No playback layer: the model stands still.");
        }
    }
    fn keys(&mut self, ctx: &egui::Context, elapsed_s: f64) {
        use egui::Key;
        if ctx.egui_wants_keyboard_input() {
            return;
        }
        let (pressed, held) = ctx.input(|i| {
            let pressed = [Key::Space, Key::Comma, Key::Period, Key::R, Key::F, Key::T, Key::Home, Key::End].map(|k| i.key_pressed(k));
            (pressed, [Key::D, Key::A, Key::E, Key::Q, Key::W, Key::S].map(|k| f64::from(u8::from(i.key_down(k)))))
        });
        let actions: [fn(&mut Self); 8] = [
            |w| w.clock.playing = !w.clock.playing,
            |w| w.clock.step(-1),
            |w| w.clock.step(1),
            |w| w.navigator.reset(),
            |w| w.flying = !w.flying,
            |w| w.look.tint = !w.look.tint,
            |w| w.clock.seek(0.0),
            |w| w.clock.seek(1.0),
        ];
        pressed.iter().zip(actions).filter(|(pressed, _)| **pressed).for_each(|(_, act)| act(self));
        let by = |k: usize| FLIGHT * elapsed_s * (held[k] - held[k + 1]);
        if held.iter().any(|h| *h > 0.0) {
            self.navigator.fly(by(0), by(2), by(4));
            ctx.request_repaint();
        }
    }
    fn gestures(&mut self, ui: &egui::Ui, response: &egui::Response) {
        let height = f64::from(response.rect.height().max(1.0));
        let by = response.drag_delta();
        let (dx, dy) = (f64::from(by.x) / height, f64::from(by.y) / height);
        let pans = response.dragged_by(egui::PointerButton::Secondary) || response.dragged_by(egui::PointerButton::Middle) || ui.input(|i| i.modifiers.shift);
        if response.dragged() {
            match (pans, self.flying) {
                (true, _) => self.navigator.pan(-dx, -dy),
                (false, true) => self.navigator.look(-2.0 * dx, -2.0 * dy),
                (false, false) => self.navigator.orbit(-4.0 * dx, 4.0 * dy),
            }
        }
        if response.hovered() {
            let (scroll, pinch) = ui.input(|i| (i.smooth_scroll_delta.y, i.zoom_delta()));
            self.navigator.zoom(f64::from(pinch) * (f64::from(scroll) * 0.003).exp());
        }
    }
    /// Draws the scene and shows it in what is left of the window.
    fn scene(&mut self, ui: &mut egui::Ui, frame: &eframe::Frame) {
        let Some(state) = frame.wgpu_render_state() else { return };
        let scale = ui.ctx().pixels_per_point() * self.resolution;
        let room = ui.available_size();
        let most = self.renderer.device().limits().max_texture_dimension_2d;
        let side = |points: f32| ((points * scale).round() as u32).clamp(1, most);
        let size = (side(room.x), side(room.y));
        if self.shown.as_ref().is_none_or(|s| s.size != size) {
            let texture = self.renderer.device().create_texture(&wgpu::TextureDescriptor {
                label: Some("window"),
                size: wgpu::Extent3d { width: size.0, height: size.1, depth_or_array_layers: 1 },
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format: FORMAT,
                usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING,
                view_formats: &[],
            });
            let view = texture.create_view(&Default::default());
            let mut egui_renderer = state.renderer.write();
            if let Some(old) = self.shown.take() {
                egui_renderer.free_texture(&old.id);
            }
            let id = egui_renderer.register_native_texture(self.renderer.device(), &view, wgpu::FilterMode::Linear);
            self.shown = Some(Shown { view, id, size });
        }
        let Some(shown) = &self.shown else { return };
        let image = egui::Image::from_texture((shown.id, room)).sense(egui::Sense::click_and_drag());
        let view = View { camera: self.navigator.camera(size.0, size.1), time: self.clock.time, ..self.look.clone() };
        self.renderer.draw(&view, &shown.view);
        let response = ui.add(image);
        self.gestures(ui, &response);
    }
}

impl eframe::App for Window {
    fn ui(&mut self, ui: &mut egui::Ui, frame: &mut eframe::Frame) {
        let ctx = ui.ctx().clone();
        let elapsed = ctx.input(|i| i.stable_dt).min(0.25);
        self.rate += 0.1 * (1.0 / elapsed.max(1e-4) - self.rate);
        if self.clock.tick(elapsed) {
            ctx.request_repaint();
        }
        self.keys(&ctx, f64::from(elapsed));
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
