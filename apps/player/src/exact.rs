//! Exact images: those of a model's own deformer and rasterizer, drawn on a thread of their own and shown in place of the player's.
//!
//! This crate knows neither deformers nor burn. A program that does hands an [`ExactImages`] to the window.

use crate::View;
use cc4dgs_format::{Error, Image8, Result};
use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Instant;

/// Draws images by the deformer and the rasterizer of one model.
pub trait ExactImages: Send {
    /// Opens what it needs, then calls [`ExactRequests::each`], which returns when no more images are wanted. An [`ExactWorker`] calls it on its thread when
    /// the first image is asked for, and after an error or a panic when the next one is.
    ///
    /// # Errors
    /// What keeps it from drawing at all.
    fn serve(&mut self, requests: &ExactRequests) -> Result<()>;
}

/// The exact images of a model, or the reason in words why there are none.
pub type Exact = std::result::Result<Box<dyn ExactImages>, String>;

/// One image, or what went wrong.
#[derive(Debug)]
pub struct ExactImage {
    /// What was asked for.
    pub view: View,
    /// The 8-bit image.
    pub result: Result<Image8>,
    /// What drew it, in words; empty if nothing could.
    pub renderer: String,
    /// How long that took in milliseconds.
    pub ms: f64,
}

#[derive(Default)]
struct State {
    /// Asked for, not begun.
    wanted: Option<View>,
    drawing: Option<View>,
    drawn: Option<ExactImage>,
    closed: bool,
}

/// What is asked of [`ExactImages`]: of several requests, the latest.
pub struct ExactRequests {
    state: Mutex<State>,
    changed: Condvar,
    wake: Box<dyn Fn() + Send + Sync>,
}

impl ExactRequests {
    fn lock(&self) -> MutexGuard<'_, State> {
        // A panic elsewhere leaves nothing half written here.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// Draws the latest request with `draw`, again and again, until no more images are wanted. Of a view, camera, time, degree of spherical harmonics and scale
    /// count. `renderer` names in words what draws.
    pub fn each(&self, renderer: &str, mut draw: impl FnMut(&View) -> Result<Image8>) {
        while self.wait() {
            let taken = {
                let mut state = self.lock();
                state.drawing = state.wanted.take();
                state.drawing.clone()
            };
            let Some(view) = taken else { continue };
            let began = Instant::now();
            let result = draw(&view);
            self.answer(ExactImage { view, result, renderer: renderer.to_string(), ms: began.elapsed().as_secs_f64() * 1000.0 });
        }
    }
    /// Waits for a request; false once there will be none.
    fn wait(&self) -> bool {
        let mut state = self.lock();
        while state.wanted.is_none() && !state.closed {
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        !state.closed
    }
    fn answer(&self, image: ExactImage) {
        {
            let mut state = self.lock();
            (state.drawing, state.drawn) = (None, Some(image));
        }
        (self.wake)();
    }
    /// Answers the request under way, or the waiting one, with `error`.
    fn fail(&self, error: Error) {
        let view = {
            let mut state = self.lock();
            state.drawing.take().or_else(|| state.wanted.take())
        };
        if let Some(view) = view {
            self.answer(ExactImage { view, result: Err(error), renderer: String::new(), ms: 0.0 });
        }
    }
}

/// A thread that draws exact images. Dropping it waits for the image under way.
pub struct ExactWorker {
    requests: Arc<ExactRequests>,
    thread: Option<JoinHandle<()>>,
}

impl ExactWorker {
    /// Starts the thread; `wake` is called there after each image.
    ///
    /// # Errors
    /// [`Error::Backend`] where the system has no thread left.
    pub fn new(mut images: Box<dyn ExactImages>, wake: impl Fn() + Send + Sync + 'static) -> Result<Self> {
        let requests = Arc::new(ExactRequests { state: Mutex::default(), changed: Condvar::new(), wake: Box::new(wake) });
        let asked = requests.clone();
        let work = move || {
            while asked.wait() {
                match catch_unwind(AssertUnwindSafe(|| images.serve(&asked))) {
                    Ok(Ok(())) if asked.lock().closed => {}
                    Ok(Ok(())) => asked.fail(stopped("it ended before all images were drawn")),
                    Ok(Err(e)) => asked.fail(e),
                    Err(panic) => asked.fail(stopped(&format!("it panicked: {}", said(panic.as_ref())))),
                }
            }
        };
        let thread = std::thread::Builder::new().name("exact images".into()).spawn(work);
        let thread = thread.map_err(|e| Error::backend("exact images", e.to_string(), "Close other programs"))?;
        Ok(Self { requests, thread: Some(thread) })
    }
    /// Asks for the image of `view` in place of all that were asked for before and not begun.
    pub fn ask(&self, view: View) {
        let mut state = self.requests.lock();
        state.wanted = if state.drawing.as_ref() == Some(&view) { None } else { Some(view) };
        self.requests.changed.notify_all();
    }
    /// The image that was drawn last and not taken yet.
    pub fn take(&self) -> Option<ExactImage> {
        self.requests.lock().drawn.take()
    }
    /// Asks the thread to end after the image under way.
    pub fn close(&self) {
        self.requests.lock().closed = true;
        self.requests.changed.notify_all();
    }
    /// Whether the thread has ended.
    pub fn is_finished(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }
}

impl Drop for ExactWorker {
    fn drop(&mut self) {
        self.close();
        if let Some(thread) = self.thread.take() {
            // Its panics were caught and told.
            thread.join().ok();
        }
    }
}

fn stopped(problem: &str) -> Error {
    Error::backend("exact images", problem, "Switch them on again, at a smaller resolution or with another --device")
}

/// The message of a panic.
fn said(panic: &(dyn Any + Send)) -> &str {
    panic.downcast_ref::<&str>().copied().or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("without a message")
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_format::Camera;
    use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
    use std::sync::mpsc::{Receiver, Sender, channel};
    use std::time::Duration;

    const PATIENCE: Duration = Duration::from_secs(20);

    fn view(time: f32) -> View {
        View::new(Camera::look_at("t", (2, 1), 0.8, [3.0, 0.0, 0.0], [0.0; 3], [0.0, 0.0, 1.0]), time)
    }

    /// How an image ends, by the time of its view.
    type Ending = fn(f32) -> Result<Image8>;

    /// Says the time of each image it begins, and finishes it when it is told how.
    struct Slow {
        begun: Sender<f32>,
        finish: Receiver<Ending>,
        ended: Arc<AtomicBool>,
    }

    impl ExactImages for Slow {
        fn serve(&mut self, requests: &ExactRequests) -> Result<()> {
            requests.each("slow", |view| {
                self.begun.send(view.time).unwrap();
                self.finish.recv().unwrap()(view.time)
            });
            self.ended.store(true, Ordering::Relaxed);
            Ok(())
        }
    }

    /// The worker is dropped last: a test that fails must not wait for an image that nobody finishes.
    struct Bench {
        begun: Receiver<f32>,
        finish: Sender<Ending>,
        woken: Receiver<()>,
        ended: Arc<AtomicBool>,
        worker: ExactWorker,
    }

    impl Bench {
        fn new() -> Self {
            let ((begun, begins), (finish, finishes), (wake, woken)) = (channel(), channel(), channel());
            let ended = Arc::new(AtomicBool::new(false));
            let images = Slow { begun, finish: finishes, ended: ended.clone() };
            let worker = ExactWorker::new(Box::new(images), move || _ = wake.send(())).unwrap();
            Self { worker, begun: begins, finish, woken, ended }
        }
        fn begins(&self) -> f32 {
            self.begun.recv_timeout(PATIENCE).expect("an image is begun")
        }
        /// Lets the image under way end as `how` says.
        fn ends(&self, how: Ending) -> ExactImage {
            self.finish.send(how).unwrap();
            self.woken.recv_timeout(PATIENCE).expect("the window is woken");
            self.worker.take().expect("an image")
        }
    }

    fn grey(time: f32) -> Result<Image8> {
        Ok(Image8 { width: 2, height: 1, channels: 3, data: vec![(100.0 * time) as u8; 6] })
    }

    #[test]
    fn the_latest_request_wins() {
        let bench = Bench::new();
        bench.worker.ask(view(0.1));
        assert_eq!(bench.begins(), 0.1);
        for time in [0.2, 0.3, 0.4] {
            bench.worker.ask(view(time));
        }
        let first = bench.ends(grey);
        assert_eq!((first.view.time, first.renderer.as_str(), first.result.unwrap().data[0]), (0.1, "slow", 10));
        assert_eq!(bench.begins(), 0.4, "older requests are dropped");
        // What is being drawn already is not drawn twice, and what waited is forgotten.
        bench.worker.ask(view(0.9));
        bench.worker.ask(view(0.4));
        assert_eq!(bench.ends(grey).view.time, 0.4);
        assert!(bench.begun.recv_timeout(Duration::from_millis(100)).is_err() && bench.worker.take().is_none());
        bench.worker.ask(view(0.5));
        assert_eq!(bench.begins(), 0.5);
        bench.ends(grey);
    }

    #[test]
    fn errors_and_panics_are_reported_and_the_next_image_is_drawn() {
        let bench = Bench::new();
        let outcomes: [(Ending, &str); 3] = [
            (|_| Err(Error::parameter("scale", "it is zero", "Give another")), "scale"),
            (|_| panic!("out of memory"), "it panicked: out of memory"),
            (|time| panic!("at {time}"), "it panicked: at 0.5"),
        ];
        for (outcome, expected) in outcomes {
            bench.worker.ask(view(0.5));
            bench.begins();
            let message = bench.ends(outcome).result.expect_err("no image").to_string();
            assert!(message.contains(expected), "{message}");
        }
        bench.worker.ask(view(0.5));
        bench.begins();
        assert!(bench.ends(grey).result.is_ok());
    }

    /// Cannot be opened the first time.
    struct Missing(Arc<AtomicUsize>);

    impl ExactImages for Missing {
        fn serve(&mut self, requests: &ExactRequests) -> Result<()> {
            match self.0.fetch_add(1, Ordering::Relaxed) {
                0 => Err(Error::data("model", "it is gone", "Bring it back")),
                1 => Ok(()),
                _ => {
                    requests.each("found", |view| grey(view.time));
                    Ok(())
                }
            }
        }
    }

    #[test]
    fn a_model_that_cannot_be_opened_is_tried_again_when_it_is_asked_for() {
        let (tries, (wake, woken)) = (Arc::new(AtomicUsize::new(0)), channel());
        let worker = ExactWorker::new(Box::new(Missing(tries.clone())), move || _ = wake.send(())).unwrap();
        for expected in ["it is gone", "it ended before"] {
            worker.ask(view(0.0));
            woken.recv_timeout(PATIENCE).unwrap();
            let message = worker.take().unwrap().result.expect_err("no image").to_string();
            assert!(message.contains(expected), "{message}");
        }
        worker.ask(view(0.0));
        woken.recv_timeout(PATIENCE).unwrap();
        assert!(worker.take().unwrap().result.is_ok());
        drop(worker);
        assert_eq!(tries.load(Ordering::Relaxed), 3);
    }

    #[test]
    fn it_ends_cleanly_idle_and_while_it_draws() {
        let idle = Bench::new();
        idle.worker.ask(view(0.1));
        idle.begins();
        idle.ends(grey);
        drop(idle.worker);
        assert!(idle.ended.load(Ordering::Relaxed), "an idle thread has ended");

        let busy = Bench::new();
        busy.worker.ask(view(0.1));
        busy.begins();
        busy.worker.ask(view(0.2));
        busy.worker.close();
        assert!(!busy.worker.is_finished());
        busy.finish.send(grey).unwrap();
        drop(busy.worker);
        assert!(busy.ended.load(Ordering::Relaxed) && busy.begun.try_recv().is_err(), "it ends after the image under way");

        let never_asked = Bench::new();
        drop(never_asked.worker);
        assert!(!never_asked.ended.load(Ordering::Relaxed), "nothing was opened");
    }
}
