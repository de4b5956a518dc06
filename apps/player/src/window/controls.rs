//! Controls of the window: time bar, settings, keys, gestures, messages.

use super::Window;
use crate::Mode;
use eframe::egui;
use std::sync::PoisonError;
use std::sync::atomic::Ordering;

/// Share of the distance to the target that is flown per second.
const FLIGHT: f64 = 1.0;
/// Angle in radians that a press of an arrow key turns by, and how many times nearer a press of plus comes.
const TURN: f64 = 0.08;
const NEARER: f64 = 1.1;
/// What mouse and keys do, for the settings.
const HELP: [(&str, &str); 10] = [
    ("drag, arrow keys", "orbit"),
    ("shift-drag, right button", "pan"),
    ("wheel, pinch, + and -", "zoom"),
    ("W A S D Q E", "fly"),
    ("F", "drag to look, or to orbit"),
    ("R", "first view"),
    ("Space, comma, full stop", "play, a frame back and on"),
    ("Home, End", "first and last frame"),
    ("X, T", "exact images, tint what moves"),
    ("P, C, O", "save a PNG, print the command, open a path"),
];

/// What a key does.
type Act = fn(&mut Window);

/// A line with `text` at the top; whether it was closed.
fn closed(ui: &mut egui::Ui, id: &'static str, text: &str) -> bool {
    let mut closed = false;
    egui::Panel::top(id).show(ui, |ui| {
        ui.horizontal_wrapped(|ui| {
            ui.label(text);
            closed = ui.button("Close").clicked();
        });
    });
    closed
}

impl Window {
    /// The state of a training, what went wrong, what is not shown of a file, and what was done.
    pub(super) fn messages(&mut self, ui: &mut egui::Ui) {
        if let Some(live) = &self.live {
            let (status, paused, ended) = live.status();
            egui::Panel::top("training").show(ui, |ui| {
                ui.horizontal(|ui| {
                    if !ended && ui.button(if paused { "Resume training" } else { "Pause training" }).clicked() {
                        live.pause(!paused);
                    }
                    ui.label(if status.is_empty() { "Training has not begun yet." } else { status.as_str() });
                });
            });
        }
        let mut trouble = self.trouble.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(text) = trouble.clone() {
            egui::Panel::top("trouble").show(ui, |ui| {
                ui.horizontal_wrapped(|ui| {
                    ui.colored_label(ui.visuals().error_fg_color, text);
                    if ui.button("Close").clicked() {
                        *trouble = None;
                    }
                });
            });
        }
        drop(trouble);
        if !self.read && !self.remarks.is_empty() && closed(ui, "remarks", &self.remarks) {
            self.read = true;
        }
        if self.notice.as_deref().is_some_and(|text| closed(ui, "notice", text)) {
            self.notice = None;
        }
    }
    pub(super) fn bar(&mut self, ui: &mut egui::Ui) {
        // The proportional font of egui has none of these signs.
        let sign = |text: &str| egui::RichText::new(text).monospace();
        let moves = self.clock.frames > 1;
        ui.horizontal(|ui| {
            ui.add_enabled_ui(moves, |ui| {
                if ui.button(sign(if self.clock.playing { "‖" } else { "▶" })).on_hover_text("Play (Space)").clicked() {
                    self.clock.play(!self.clock.playing);
                }
                if ui.button(sign("‹")).on_hover_text("One frame back (,)").clicked() {
                    self.clock.step(-1);
                }
                if ui.button(sign("›")).on_hover_text("One frame on (.)").clicked() {
                    self.clock.step(1);
                }
            });
            // From the right end, so that the slider takes what is left.
            ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
                ui.toggle_value(&mut self.settings, sign("≡")).on_hover_text("Settings");
                let exact = egui::Button::selectable(self.exact.is_on(), "Exact");
                let exact = ui.add_enabled(self.exact.lacks().is_none(), exact).on_disabled_hover_text(self.exact.lacks().unwrap_or_default());
                if exact.on_hover_text("Images of the deformer and the rasterizer of the model, in place of the player's (X)").clicked() {
                    self.exact.set(!self.exact.is_on());
                }
                ui.add_enabled_ui(moves, |ui| {
                    ui.toggle_value(&mut self.clock.looping, sign("↻")).on_hover_text("Loop");
                    ui.add(egui::DragValue::new(&mut self.clock.speed).range(-4.0..=4.0).speed(0.02).suffix("×")).on_hover_text("Speed");
                    let seconds = self.clock.time * self.clock.seconds;
                    ui.monospace(if moves { format!("{:>4} / {} · {seconds:.2} s", self.clock.frame() + 1, self.clock.frames) } else { "still".into() });
                    let mut time = self.clock.time;
                    ui.spacing_mut().slider_width = (ui.available_width() - ui.spacing().item_spacing.x).max(80.0);
                    if ui.add(egui::Slider::new(&mut time, 0.0..=1.0).show_value(false)).changed() {
                        self.clock.seek(time);
                    }
                });
            });
        });
    }
    pub(super) fn panel(&mut self, ui: &mut egui::Ui, adapter: &str) {
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
        // Exact images have all degrees.
        let degree = self.renderer.scene().map_or(0, |s| if self.exact.is_on() { s.sh_degree } else { s.drawn_degree });
        ui.add(egui::Slider::new(&mut self.look.scale, 0.1..=2.0).text("Size"));
        // A wish for more than this model has is kept for the next one.
        let mut shown = self.look.sh_degree.min(degree);
        if ui.add(egui::Slider::new(&mut shown, 0..=degree).text("SH degree")).changed() {
            self.look.sh_degree = shown;
        }
        ui.add(egui::Slider::new(&mut self.resolution, 0.25..=2.0).text("Resolution"));
        let mut depth = self.look.mode == Mode::Depth;
        ui.add_enabled_ui(!self.exact.is_on(), |ui| {
            for (value, text) in [(&mut self.look.tint, "Tint what moves"), (&mut depth, "Depth")] {
                ui.checkbox(value, text).on_disabled_hover_text("Exact images show the colours of the model. Switch them off for this.");
            }
        });
        self.look.mode = if depth { Mode::Depth } else { Mode::Color };
        ui.horizontal(|ui| {
            if ui.button("PNG (P)").on_hover_text("Save the image in the current folder").clicked() {
                self.save_png();
            }
            if self.source.is_some() {
                if ui.button("Print command (C)").on_hover_text("Print the command that opens this file at this time and pose").clicked() {
                    self.print_command();
                }
                if ui.button("Open (O)").on_hover_text("Type a path; files can be dropped on the window, too").clicked() {
                    self.ask_for_a_file();
                }
            }
        });
        ui.collapsing("Mouse and keys", |ui| {
            egui::Grid::new("help").show(ui, |ui| {
                for (keys, action) in HELP {
                    ui.small(keys);
                    ui.small(action);
                    ui.end_row();
                }
            });
        });
        ui.separator();
        if let Some(scene) = self.renderer.scene() {
            ui.small(format!("{:.0} frames/s", self.rate));
            for line in self.exact.statistics() {
                ui.small(line);
            }
            let drawn = if self.exact.is_on() { String::new() } else { format!("{} of ", self.visible.load(Ordering::Relaxed)) };
            ui.small(format!("{drawn}{} Gaussians{}, {} move", scene.count, if drawn.is_empty() { "" } else { " drawn" }, scene.moving));
            if self.bytes > 0 {
                ui.small(format!("{:.3} MB", self.bytes as f64 / 1e6));
            }
            ui.small(adapter);
        }
    }
    /// Orbits, or looks around while flying.
    fn turn(&mut self, right: f64, upwards: f64) {
        if self.flying { self.navigator.look(right, upwards) } else { self.navigator.orbit(right, upwards) }
    }
    /// Goes to a normalised time where there is more than one frame.
    fn go(&mut self, time: f32) {
        if self.clock.frames > 1 {
            self.clock.seek(time);
        }
    }
    pub(super) fn keys(&mut self, ctx: &egui::Context, elapsed_s: f64) {
        use egui::{Event, Key};
        // Whatever has the focus of the Tab key takes the keys.
        if ctx.egui_wants_keyboard_input() {
            return;
        }
        let again: [(Key, Act); 11] = [
            (Key::Comma, |w| w.clock.step(-1)),
            (Key::Period, |w| w.clock.step(1)),
            (Key::Home, |w| w.go(0.0)),
            (Key::End, |w| w.go(1.0)),
            (Key::ArrowLeft, |w| w.turn(-TURN, 0.0)),
            (Key::ArrowRight, |w| w.turn(TURN, 0.0)),
            (Key::ArrowUp, |w| w.turn(0.0, TURN)),
            (Key::ArrowDown, |w| w.turn(0.0, -TURN)),
            (Key::Plus, |w| w.navigator.zoom(NEARER)),
            (Key::Equals, |w| w.navigator.zoom(NEARER)),
            (Key::Minus, |w| w.navigator.zoom(1.0 / NEARER)),
        ];
        // Held down, these act once.
        let once: [(Key, Act); 8] = [
            (Key::Space, |w| w.clock.play(!w.clock.playing)),
            (Key::R, |w| w.navigator.reset()),
            (Key::F, |w| w.flying = !w.flying),
            (Key::T, |w| w.look.tint ^= !w.exact.is_on()),
            (Key::X, |w| w.exact.set(!w.exact.is_on())),
            (Key::P, Self::save_png),
            (Key::C, Self::print_command),
            (Key::O, Self::ask_for_a_file),
        ];
        let pressed = |event: &Event| match event {
            Event::Key { key, pressed: true, repeat, modifiers, .. } if !(modifiers.ctrl || modifiers.command || modifiers.alt) => Some((*key, *repeat)),
            _ => None,
        };
        let (pressed, held) = ctx.input(|i| {
            let pressed: Vec<(Key, bool)> = i.events.iter().filter_map(pressed).collect();
            (pressed, [Key::D, Key::A, Key::E, Key::Q, Key::W, Key::S].map(|k| f64::from(u8::from(i.key_down(k)))))
        });
        for (key, repeat) in pressed {
            let acts = again.iter().chain(once.iter().filter(|_| !repeat));
            acts.filter(|(of, _)| *of == key).for_each(|(_, act)| act(self));
        }
        // For tests, which have no other way to lose a device.
        if ctx.input_mut(|i| i.consume_key(egui::Modifiers::CTRL | egui::Modifiers::SHIFT, Key::F12)) {
            self.renderer.device().destroy();
            self.renderer.device().poll(wgpu::PollType::Poll).ok();
        }
        let by = |k: usize| FLIGHT * elapsed_s * (held[k] - held[k + 1]);
        if held.iter().any(|h| *h > 0.0) {
            self.navigator.fly(by(0), by(2), by(4));
            ctx.request_repaint();
        }
    }
    /// What the exact image in `rect` is, in its upper left corner.
    pub(super) fn sign(&self, ui: &mut egui::Ui, rect: egui::Rect) {
        let (text, computing) = self.exact.sign();
        let color = if computing { ui.visuals().warn_fg_color } else { ui.visuals().text_color() };
        ui.scope_builder(egui::UiBuilder::new().max_rect(rect.shrink(8.0)), |ui| {
            egui::Frame::popup(ui.style()).show(ui, |ui| ui.add(egui::Label::new(egui::RichText::new(text).color(color)).selectable(false)));
        });
    }
    pub(super) fn gestures(&mut self, ui: &egui::Ui, response: &egui::Response) {
        let height = f64::from(response.rect.height().max(1.0));
        let by = response.drag_delta();
        let (dx, dy) = (f64::from(by.x) / height, f64::from(by.y) / height);
        let pans = response.dragged_by(egui::PointerButton::Secondary) || response.dragged_by(egui::PointerButton::Middle) || ui.input(|i| i.modifiers.shift);
        if response.dragged() {
            match (pans, self.flying) {
                (true, _) => self.navigator.pan(-dx, -dy, self.drawn),
                (false, true) => self.navigator.look(-2.0 * dx, 2.0 * dy),
                (false, false) => self.navigator.orbit(-4.0 * dx, 4.0 * dy),
            }
        }
        if response.hovered() {
            let (scroll, pinch) = ui.input(|i| (i.smooth_scroll_delta.y, i.zoom_delta()));
            self.navigator.zoom(f64::from(pinch) * (f64::from(scroll) * 0.003).exp());
        }
    }
}
