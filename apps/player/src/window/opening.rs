//! Files that are opened while the window shows another: dropped ones, and those whose path is typed.

use super::{Open, Opened, Window, titled};
use crate::desktop::start::busy_with_training;
use cc4dgs_format::{Error, Result};
use eframe::egui;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, TryRecvError, channel};

/// A file that is being opened on a thread of its own: what moves may have to be baked first.
pub(super) struct Opening {
    path: PathBuf,
    result: Receiver<Result<Opened>>,
}

impl Opening {
    pub(super) fn new(path: PathBuf, open: Open, ctx: egui::Context) -> Result<Self> {
        let (sender, result) = channel();
        let of = path.clone();
        let work = move || {
            sender.send(open(&of)).ok();
            ctx.request_repaint();
        };
        let started = std::thread::Builder::new().name("open".into()).spawn(work);
        started.map_err(|e| Error::backend("thread", e.to_string(), "Close other programs and open the file again"))?;
        Ok(Self { path, result })
    }
}

impl Window {
    /// The file that is shown, where there is one.
    pub(super) fn file(&self) -> Option<&Path> {
        self.source.as_ref().map(|source| source.path.as_path())
    }
    /// Begins to open `path`; of several, the last is shown. A window of a training says what opens it.
    fn begin(&mut self, path: PathBuf, ctx: &egui::Context) {
        let Some(source) = &self.source else { return self.complain(busy_with_training(&path)) };
        match Opening::new(path, source.open.clone(), ctx.clone()) {
            Ok(opening) => self.opening = Some(opening),
            Err(e) => self.complain(e.to_string()),
        }
    }
    /// Opens files that were dropped on the window; what is wrong with one is said, and the model before it stays.
    pub(super) fn dropped(&mut self, ctx: &egui::Context) {
        for path in ctx.input(|i| i.raw.dropped_files.iter().map(|file| file.path().to_path_buf()).collect::<Vec<_>>()) {
            self.begin(path, ctx);
        }
        let Some(opening) = &self.opening else { return };
        let path = opening.path.clone();
        let opened = match opening.result.try_recv() {
            Ok(opened) => opened,
            Err(TryRecvError::Empty) => return,
            Err(TryRecvError::Disconnected) => Err(Error::backend(path.display().to_string(), "opening it panicked", "Report this with what was printed")),
        };
        self.opening = None;
        match opened.and_then(|opened| self.show(opened)) {
            Ok(()) => {
                self.silence();
                ctx.send_viewport_cmd(egui::ViewportCommand::Title(titled(&path)));
                if let Some(source) = &mut self.source {
                    source.path = path;
                }
            }
            Err(e) => self.complain(e.to_string()),
        }
        ctx.request_repaint();
    }
    /// The line that says what is being opened, and the one to type a path into.
    pub(super) fn opening_lines(&mut self, ui: &mut egui::Ui) {
        if let Some(opening) = &self.opening {
            let text = format!("Opening {} …", opening.path.display());
            egui::Panel::top("opening").show(ui, |ui| {
                ui.horizontal(|ui| {
                    ui.spinner();
                    ui.label(text);
                });
            });
        }
        let Some(mut text) = self.typed.take() else { return };
        let (mut chosen, mut cancelled) = (false, false);
        egui::Panel::top("path").show(ui, |ui| {
            ui.horizontal(|ui| {
                ui.label("File or run folder");
                let width = (ui.available_width() - 120.0).max(80.0);
                let field = ui.add(egui::TextEdit::singleline(&mut text).desired_width(width));
                let entered = field.lost_focus() && ui.input(|i| i.key_pressed(egui::Key::Enter));
                chosen = ui.button("Open").clicked() || entered;
                cancelled = ui.button("Cancel").clicked() || ui.input(|i| i.key_pressed(egui::Key::Escape));
                if !(chosen || cancelled || field.has_focus()) {
                    field.request_focus();
                }
            });
        });
        if chosen && !text.trim().is_empty() {
            self.begin(PathBuf::from(text.trim()), ui.ctx());
        } else if !chosen && !cancelled {
            self.typed = Some(text);
        }
    }
    /// Shows the line to type a path into.
    pub(super) fn ask_for_a_file(&mut self) {
        let Some(source) = &self.source else { return self.complain(busy_with_training(Path::new("FILE"))) };
        let folder = source.path.parent().filter(|p| !p.as_os_str().is_empty());
        self.typed = Some(folder.map_or_else(String::new, |p| format!("{}{}", p.display(), std::path::MAIN_SEPARATOR)));
    }
}
