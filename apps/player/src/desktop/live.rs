//! A model that changes while a window shows it: a training under way.

use crate::Content;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Duration;

/// How often a paused training looks whether it is to stop.
const POLL: Duration = Duration::from_millis(100);
/// How soon a new line is shown.
const SOON: Duration = Duration::from_millis(200);

/// Asks a window to draw again after so long.
type Repaint = Box<dyn Fn(Duration) + Send + Sync>;

/// What training and window tell each other. The training offers models and says where it stands; the window takes them and pauses it.
#[derive(Default)]
pub struct Live {
    state: Mutex<State>,
    changed: Condvar,
    window: OnceLock<Repaint>,
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
    fn repaint_after(&self, delay: Duration) {
        if let Some(repaint) = self.window.get() {
            repaint(delay);
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
        self.repaint_after(Duration::ZERO);
    }
    /// Says where the training stands, in a line.
    pub fn say(&self, status: String) {
        self.lock().status = status;
        self.repaint_after(SOON);
    }
    /// Says how the training ended; there is nothing left to pause.
    pub fn end(&self, status: String) {
        {
            let mut state = self.lock();
            (state.status, state.ended) = (status, true);
        }
        self.repaint_after(Duration::ZERO);
    }
    /// Says what failed; it stays beside the line.
    pub fn fail(&self, failure: String) {
        self.lock().failure = failure;
        self.repaint_after(Duration::ZERO);
    }
    /// Returns once the window lets the training go on, was closed, or `stop` is set.
    pub fn wait_while_paused(&self, stop: &AtomicBool) {
        let mut state = self.lock();
        while state.paused && !state.closed && !stop.load(Ordering::Relaxed) {
            state = self.changed.wait_timeout(state, POLL).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
    /// The window is open; `repaint` asks it to draw again after so long.
    pub(crate) fn open(&self, repaint: impl Fn(Duration) + Send + Sync + 'static) {
        // A second window of the same training repaints by itself.
        self.window.set(Box::new(repaint)).ok();
        self.lock().closed = false;
    }
    /// The window is closed: nothing is shown any more, and a paused training goes on.
    pub(crate) fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }
    /// The model that was offered last and not taken yet.
    pub(crate) fn take(&self) -> Option<Content> {
        self.lock().content.take()
    }
    /// The line, with what failed; whether the training is paused, and whether it has ended.
    pub(crate) fn status(&self) -> (String, bool, bool) {
        let state = self.lock();
        let line = [&state.status, &state.failure].into_iter().filter(|text| !text.is_empty()).cloned().collect::<Vec<_>>().join(" · ");
        (line, state.paused, state.ended)
    }
    pub(crate) fn pause(&self, on: bool) {
        self.lock().paused = on;
        self.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Scene;
    use cc4dgs_format::HostGaussians;
    use cc4dgs_format::archive::Presentation;
    use std::sync::Arc;

    #[test]
    fn a_window_is_woken_by_what_is_offered_and_takes_it_once() {
        let (live, woken) = (Live::default(), Arc::new(Mutex::new(Vec::new())));
        let scene = Scene::new(&HostGaussians::default(), None).unwrap();
        let content = Content { scene, presentation: Presentation::default(), frame_count: 1, lacks_motion: false, remarks: Vec::new(), bytes: 0 };
        let noted = woken.clone();
        live.open(move |delay| noted.lock().unwrap().push(delay));
        assert!(live.is_open() && live.wants() && live.take().is_none());
        live.offer(content);
        assert!(!live.wants(), "the last one has not been taken");
        live.say("main 1 of 5".into());
        assert_eq!(*woken.lock().unwrap(), [Duration::ZERO, SOON]);
        assert!(live.take().is_some() && live.take().is_none() && live.wants());
        live.close();
        assert!(!live.is_open() && !live.wants());
    }

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
