//! A model that changes while a window shows it: a training under way.

use crate::Content;
use eframe::egui;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Duration;

/// How often a paused training looks whether it is to stop.
const POLL: Duration = Duration::from_millis(100);
/// How soon a new line is shown.
const SOON: Duration = Duration::from_millis(200);

/// What training and window tell each other. The training offers models and says where it stands; the window takes them and pauses it.
#[derive(Default)]
pub struct Live {
    state: Mutex<State>,
    changed: Condvar,
    window: OnceLock<egui::Context>,
}

#[derive(Default)]
struct State {
    content: Option<Content>,
    status: String,
    failure: String,
    ended: bool,
    paused: bool,
    closed: bool,
}

impl Live {
    fn lock(&self) -> MutexGuard<'_, State> {
        // A panic elsewhere leaves nothing half written here.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
    fn repaint(&self) {
        if let Some(window) = self.window.get() {
            window.request_repaint();
        }
    }
    /// Whether the window is open.
    pub fn is_open(&self) -> bool {
        !self.lock().closed && self.window.get().is_some()
    }
    /// Whether a model would be shown at once: the window is open and has taken the last one.
    pub fn wants(&self) -> bool {
        self.is_open() && self.lock().content.is_none()
    }
    /// Hands over a model.
    pub fn offer(&self, content: Content) {
        self.lock().content = Some(content);
        self.repaint();
    }
    /// Says where the training stands, in a line.
    pub fn say(&self, status: String) {
        self.lock().status = status;
        if let Some(window) = self.window.get() {
            window.request_repaint_after(SOON);
        }
    }
    /// Says how the training ended; there is nothing left to pause.
    pub fn end(&self, status: String) {
        {
            let mut state = self.lock();
            (state.status, state.ended) = (status, true);
        }
        self.repaint();
    }
    /// Says what failed; it stays beside the line.
    pub fn fail(&self, failure: String) {
        self.lock().failure = failure;
        self.repaint();
    }
    /// Returns once the window lets the training go on, was closed, or `stop` is set.
    pub fn wait_while_paused(&self, stop: &AtomicBool) {
        let mut state = self.lock();
        while state.paused && !state.closed && !stop.load(Ordering::Relaxed) {
            state = self.changed.wait_timeout(state, POLL).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
    /// The window is open.
    pub(super) fn open(&self, window: egui::Context) {
        // A second window of the same training repaints by itself.
        self.window.set(window).ok();
        self.lock().closed = false;
    }
    /// The window is closed: nothing is shown any more, and a paused training goes on.
    pub(super) fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }
    /// The model that was offered last and not taken yet.
    pub(super) fn take(&self) -> Option<Content> {
        self.lock().content.take()
    }
    /// The line, with what failed; whether the training is paused, and whether it has ended.
    pub(super) fn status(&self) -> (String, bool, bool) {
        let state = self.lock();
        let line = [&state.status, &state.failure].into_iter().filter(|text| !text.is_empty()).cloned().collect::<Vec<_>>().join(" · ");
        (line, state.paused, state.ended)
    }
    pub(super) fn pause(&self, on: bool) {
        self.lock().paused = on;
        self.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_paused_training_waits_until_the_window_closes_or_it_is_stopped() {
        let (live, stop) = (Live::default(), AtomicBool::new(false));
        live.wait_while_paused(&stop);
        assert!(!live.wants(), "no window");
        live.pause(true);
        let closed = AtomicBool::new(false);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                std::thread::sleep(Duration::from_millis(50));
                closed.store(true, Ordering::Relaxed);
                live.close();
            });
            live.wait_while_paused(&stop);
            assert!(closed.load(Ordering::Relaxed), "it waited for the window");
        });
        live.lock().closed = false;
        stop.store(true, Ordering::Relaxed);
        live.wait_while_paused(&stop);
        live.say("main 3 of 5".into());
        assert_eq!(live.status(), ("main 3 of 5".to_string(), true, false));
        live.fail("no model".into());
        live.say("main 4 of 5".into());
        assert_eq!(live.status().0, "main 4 of 5 · no model", "a failure stays");
        live.end("done".into());
        assert_eq!(live.status(), ("done · no model".to_string(), true, true));
    }
}
