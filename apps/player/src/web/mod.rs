//! The player in a browser: what the page's JavaScript calls. Gestures, buttons and fetching are the page's, everything else is here.

mod capture;
mod download;
mod plain;

use crate::render::{MostPixels, remark};
use crate::{Clock, Content, Mode, Navigator, Renderer, Scene, View, request_device};
use capture::Capture;
use cc4dgs_format::{Camera, Error, Limits, StreamStage};
use download::Download;
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use wasm_bindgen::prelude::*;
// Asynchronous methods expand to calls of it.
use wasm_bindgen_futures as _;

/// Memory of a browser's tab is small.
const LIMITS: Limits = Limits { max_bytes: 1 << 30, max_gaussians: 8_000_000, max_pixels: 64 << 20, max_depth: 64 };

fn error(error: impl std::fmt::Display) -> JsError {
    JsError::new(&error.to_string())
}

unsafe extern "C" {
    /// The linker's: runs the constructors that register codecs. Where nobody calls it, every exported function would.
    fn __wasm_call_ctors();
}

/// Runs once, when the module is loaded: panics go to the console with their text.
#[wasm_bindgen(start)]
fn start() {
    // SAFETY: called once, before any other function of the module.
    unsafe { __wasm_call_ctors() };
    std::panic::set_hook(Box::new(|info| web_sys::console::error_1(&info.to_string().into())));
}

/// Where images go.
#[allow(clippy::large_enum_variant, reason = "there is one player")]
enum Output {
    /// A canvas with WebGPU.
    WebGpu {
        surface: wgpu::Surface<'static>,
        configuration: wgpu::SurfaceConfiguration,
        renderer: Renderer,
        adapter: String,
        lost: Arc<AtomicBool>,
        failure: Arc<Mutex<Option<String>>>,
    },
    /// The page draws with WebGL2 from the arrays of `scene`, none of which may have more than `most_words` numbers, and which are empty once it has them.
    Plain { scene: Option<Scene>, most_words: u64 },
}

/// A player on a canvas.
#[wasm_bindgen]
pub struct Player {
    output: Output,
    /// Of the canvas, in pixels.
    size: (u32, u32),
    /// What the canvas may have at most.
    most: MostPixels,
    /// What an image may have at most: less than that where there was no memory for one.
    most_drawn: MostPixels,
    /// Whether the console has said that an image is smaller than it was to be.
    told: Cell<bool>,
    navigator: Navigator,
    clock: Clock,
    cameras: Vec<Camera>,
    /// What is drawn; camera and time are those of navigator and clock.
    look: View,
    /// Pixels drawn per pixel of the canvas, each way.
    resolution: f32,
}

#[wasm_bindgen]
impl Player {
    /// A player that draws on `canvas` with WebGPU. Rejects where the browser has no adapter.
    pub async fn create(canvas: web_sys::HtmlCanvasElement) -> Result<Player, JsError> {
        let wanted = (canvas.width().max(1), canvas.height().max(1));
        let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
        descriptor.backends = wgpu::Backends::BROWSER_WEBGPU;
        let instance = wgpu::Instance::new(descriptor);
        let surface = instance.create_surface(wgpu::SurfaceTarget::Canvas(canvas)).map_err(error)?;
        let (adapter, device, queue) = request_device(&instance, Some(&surface)).await.map_err(error)?;
        let limits = device.limits();
        let most = MostPixels::new(limits.max_texture_dimension_2d, limits.max_buffer_size);
        // A canvas that had another device may be too large for this one.
        let (width, height) = most.fit(wanted);
        let mut configuration = surface.get_default_config(&adapter, width, height).ok_or_else(|| JsError::new("the canvas cannot be drawn on"))?;
        configuration.format = configuration.format.remove_srgb_suffix();
        surface.configure(&device, &configuration);
        let (lost, failure) = (Arc::new(AtomicBool::new(false)), Arc::new(Mutex::new(None::<String>)));
        let (flag, first) = (lost.clone(), failure.clone());
        device.set_device_lost_callback(move |_, _| flag.store(true, Ordering::Relaxed));
        device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| {
            web_sys::console::error_1(&e.to_string().into());
            first.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(e.to_string());
        }));
        let renderer = Renderer::new(device, queue, configuration.format);
        let adapter = format!("{} {}", adapter.get_info().name, adapter.get_info().driver).trim().to_string();
        Ok(Self::on(Output::WebGpu { surface, configuration, renderer, adapter, lost, failure }, (width, height), most))
    }
    /// A player that decodes, keeps time and navigates, for a page that draws by itself: at most `most_words` numbers per array, `most_side` pixels each way.
    pub fn plain(width: u32, height: u32, most_words: f64, most_side: u32) -> Player {
        let most = MostPixels::new(most_side, u64::MAX);
        Self::on(Output::Plain { scene: None, most_words: most_words as u64 }, most.fit((width, height)), most)
    }
    fn on(output: Output, size: (u32, u32), most: MostPixels) -> Self {
        let navigator = Navigator::new(&Default::default(), [-1.0; 3], [1.0; 3]);
        let look = View::new(navigator.camera(size.0, size.1), 0.0);
        Self { output, size, most, most_drawn: most, told: Cell::new(false), navigator, clock: Clock::new(1, 1.0), cameras: Vec::new(), look, resolution: 1.0 }
    }
    /// Opens a whole file: an archive, a PLY or an SPZ file. Returns facts as JSON.
    pub fn open(&mut self, name: &str, bytes: Vec<u8>) -> Result<String, JsError> {
        let content = Content::read(name, bytes, &LIMITS).map_err(error)?;
        self.show(content, true)
    }
    /// Shows what has arrived of `download`: the Gaussians up to `layer` (255: all), and where these are there their motion, and their harmonics up to `degree`
    /// (0: none, 255: all). Returns facts as JSON.
    #[wasm_bindgen(js_name = openPart)]
    pub fn open_part(&mut self, download: &mut Download, layer: u8, motion: bool, degree: u8, first: bool) -> Result<String, JsError> {
        let stage = if degree > 0 { StreamStage::Harmonics(degree) } else { StreamStage::Layer(layer) };
        let content = download.content(stage, motion, &LIMITS).map_err(error)?;
        self.show(content, first)
    }
    /// Adds the harmonics of `download` up to `degree` (255: all) to what `openPart` shows.
    #[wasm_bindgen(js_name = openHarmonics)]
    pub fn open_harmonics(&mut self, download: &mut Download, degree: u8) -> Result<(), JsError> {
        let gaussians = download.gaussians(StreamStage::Harmonics(degree), &LIMITS).map_err(error)?;
        match &mut self.output {
            Output::WebGpu { renderer, .. } => renderer.load_harmonics(&gaussians).map_err(error)?,
            Output::Plain { scene: Some(scene), .. } => scene.harmonics = scene.harmonics_of(&gaussians).map_err(error)?,
            Output::Plain { scene: None, .. } => {}
        }
        Ok(())
    }
    fn show(&mut self, mut content: Content, first: bool) -> Result<String, JsError> {
        let (most_words, array, remedy) = match &self.output {
            Output::WebGpu { renderer, .. } => (renderer.most_words(), "a buffer of WebGPU here", "`cc4dgs view` may show all"),
            Output::Plain { most_words, .. } => (*most_words, "a texture of WebGL2", "Use a browser with WebGPU to see all"),
        };
        content.fit_harmonics(most_words, array, remedy);
        let Content { scene, presentation, frame_count, lacks_motion, remarks, bytes } = content;
        let (count, moving, gpu_bytes, [lower, upper]) = (scene.count, scene.moving, scene.gpu_bytes(), scene.bounds);
        let degrees = [scene.drawn_degree, scene.sh_degree];
        match &mut self.output {
            Output::WebGpu { renderer, .. } => renderer.load(scene).map_err(error)?,
            Output::Plain { scene: kept, most_words } => {
                // Where it is refused, the one before stays.
                let words = [scene.gaussians.len(), scene.starts.len(), scene.coefficients.len()];
                let largest = words.into_iter().max().unwrap_or(0) as u64;
                if largest > *most_words {
                    let remedy = "Use a browser with WebGPU, or open it on the desktop: cc4dgs view FILE";
                    return Err(error(Error::limit("largest texture of the model for WebGL2, in numbers", largest, *most_words, remedy)));
                }
                *kept = Some(scene);
            }
        }
        let seconds = presentation.seconds_of(frame_count);
        if first {
            self.navigator = Navigator::new(&presentation, lower, upper);
            self.clock = self.clock.of_other(frame_count, seconds);
        }
        (self.clock.frames, self.clock.seconds) = (frame_count.max(1), seconds.max(1e-3));
        self.cameras = presentation.cameras;
        let names: Vec<&str> = self.cameras.iter().map(|c| c.name.as_str()).collect();
        let facts = serde_json::json!({
            "gaussians": count, "moving": moving, "shDegree": degrees[0], "storedDegree": degrees[1], "gpuBytes": gpu_bytes, "bytes": bytes,
            "frames": frame_count, "seconds": seconds, "remarks": remarks,
            "framesPerSecond": frame_count.saturating_sub(1).max(1) as f32 / seconds.max(1e-3), "cameras": names, "lacksMotion": lacks_motion,
        });
        Ok(facts.to_string())
    }
    /// Resizes the canvas' buffer to pixels, or, where that is more than can be drawn, to as many as can, in the same shape. Returns columns and rows.
    pub fn resize(&mut self, width: u32, height: u32) -> Vec<u32> {
        self.size = self.fitted(self.most, (width.max(1), height.max(1)));
        if let Output::WebGpu { surface, configuration, renderer, .. } = &mut self.output {
            (configuration.width, configuration.height) = self.size;
            surface.configure(renderer.device(), configuration);
        }
        vec![self.size.0, self.size.1]
    }
    /// Halves the number of pixels of later images, where the page had no memory for the current one; false where they are as small as images get.
    #[wasm_bindgen(js_name = drawFewer)]
    pub fn draw_fewer(&mut self) -> bool {
        let fewer = self.most_drawn.fewer(self.image_size());
        self.most_drawn = fewer.unwrap_or(self.most_drawn);
        fewer.is_some()
    }
    /// The size that is drawn where `wanted` is asked for, `most` at most; the console says once that it is smaller.
    fn fitted(&self, most: MostPixels, wanted: (u32, u32)) -> (u32, u32) {
        let drawn = most.fit(wanted);
        if let Some(remark) = remark(wanted, drawn).filter(|_| !self.told.replace(true)) {
            web_sys::console::warn_1(&remark.into());
        }
        drawn
    }
    /// Columns and rows of the image that is scaled to the canvas.
    fn image_size(&self) -> (u32, u32) {
        let scaled = |side: u32| ((side as f32 * self.resolution).round() as u32).max(1);
        self.fitted(self.most_drawn, (scaled(self.size.0), scaled(self.size.1)))
    }
    fn view(&self) -> View {
        let (width, height) = self.image_size();
        View { camera: self.navigator.camera(width, height), time: self.clock.time, ..self.look.clone() }
    }
    /// The current view, or the one through `camera` (JSON) and at `time`.
    fn view_of(&self, camera: Option<String>, time: Option<f32>) -> Result<View, JsError> {
        let mut view = self.view();
        if let Some(json) = camera {
            let remedy = "Give name, width, height, fx, fy, cx, cy and world_to_camera (four rows of four numbers)";
            view.camera = serde_json::from_str(&json).map_err(|e| error(Error::parameter("camera of an image", e.to_string(), remedy)))?;
            view.camera.validate().map_err(error)?;
            LIMITS.check_pixels("captured image", view.camera.width.into(), view.camera.height.into()).map_err(error)?;
            let side = view.camera.width.max(view.camera.height);
            if side > self.most.side {
                return Err(error(Error::limit("side of an image in pixels", side.into(), self.most.side.into(), "Ask for a smaller image")));
            }
        }
        view.time = time.unwrap_or(view.time);
        Ok(view)
    }
    /// Draws a frame on the canvas; nothing where the page draws.
    pub fn draw(&mut self) {
        use wgpu::CurrentSurfaceTexture::{Suboptimal, Success};
        let view = self.view();
        let Output::WebGpu { surface, renderer, lost, .. } = &mut self.output else { return };
        if lost.load(Ordering::Relaxed) {
            return;
        }
        if let Success(frame) | Suboptimal(frame) = surface.get_current_texture() {
            renderer.draw(&view, &frame.texture.create_view(&Default::default()));
            renderer.queue().present(frame);
        }
    }
    /// Moves the clock on; whether time changed.
    pub fn tick(&mut self, elapsed_s: f32) -> bool {
        self.clock.tick(elapsed_s)
    }
    /// Whether the device is lost: create a new player.
    #[wasm_bindgen(getter)]
    pub fn lost(&self) -> bool {
        matches!(&self.output, Output::WebGpu { lost, .. } if lost.load(Ordering::Relaxed))
    }
    /// The first of what the device failed to do since this was asked last, such as to find memory for a buffer.
    #[wasm_bindgen(js_name = takeFailure)]
    pub fn take_failure(&self) -> Option<String> {
        let Output::WebGpu { failure, .. } = &self.output else { return None };
        failure.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
    /// Loses the device on purpose: when a player is destroyed, and in tests.
    #[wasm_bindgen(js_name = loseDevice)]
    pub fn lose_device(&self) {
        if let Output::WebGpu { renderer, .. } = &self.output {
            renderer.device().destroy();
        }
    }
    /// The adapter's name.
    #[wasm_bindgen(getter)]
    pub fn adapter(&self) -> String {
        if let Output::WebGpu { adapter, .. } = &self.output { adapter.clone() } else { String::new() }
    }
    /// Normalised time, 0..1.
    #[wasm_bindgen(getter)]
    pub fn time(&self) -> f32 {
        self.clock.time
    }
    /// Index of the nearest frame.
    #[wasm_bindgen(getter)]
    pub fn frame(&self) -> usize {
        self.clock.frame()
    }
    /// Whether time runs.
    #[wasm_bindgen(getter)]
    pub fn playing(&self) -> bool {
        self.clock.playing
    }
    /// Plays or pauses; at the end, playing starts again.
    #[wasm_bindgen(setter)]
    pub fn set_playing(&mut self, on: bool) {
        self.clock.play(on);
    }
    /// Multiple of the recorded speed.
    #[wasm_bindgen(setter)]
    pub fn set_speed(&mut self, speed: f32) {
        self.clock.speed = if speed.is_finite() { speed } else { 1.0 };
    }
    /// Whether time starts again at the end.
    #[wasm_bindgen(setter)]
    pub fn set_looping(&mut self, on: bool) {
        self.clock.looping = on;
    }
    /// Goes to a normalised time.
    pub fn seek(&mut self, time_norm: f32) {
        self.clock.seek(time_norm);
    }
    /// Goes some frames on, or back, and stops.
    pub fn step(&mut self, frames: i32) {
        self.clock.step(frames);
    }
    /// Orbits by angles in radians.
    pub fn orbit(&mut self, right: f64, upwards: f64) {
        self.navigator.orbit(right, upwards);
    }
    /// Turns the view around the eye by angles in radians.
    pub fn look(&mut self, right: f64, upwards: f64) {
        self.navigator.look(right, upwards);
    }
    /// Moves along the image, by shares of its height.
    pub fn pan(&mut self, right: f64, down: f64) {
        self.navigator.pan(right, down, self.size);
    }
    /// Divides the distance to the orbited point.
    pub fn zoom(&mut self, factor: f64) {
        self.navigator.zoom(factor);
    }
    /// Flies by shares of the distance to the orbited point.
    pub fn fly(&mut self, right: f64, up: f64, forward: f64) {
        self.navigator.fly(right, up, forward);
    }
    /// Back to the first view: the home camera, where the file has one.
    pub fn reset(&mut self) {
        self.navigator.reset();
    }
    /// Takes the view of a capture camera.
    #[wasm_bindgen(js_name = goTo)]
    pub fn go_to(&mut self, index: usize) {
        if let Some(camera) = self.cameras.get(index) {
            self.navigator.go_to(camera);
        }
    }
    /// The pose that leads back to exactly this view: nine numbers.
    #[wasm_bindgen(getter)]
    pub fn pose(&self) -> Vec<f64> {
        self.navigator.pose().to_vec()
    }
    /// The pose of what the canvas shows, as links have it.
    #[wasm_bindgen(getter, js_name = poseText)]
    pub fn pose_text(&self) -> String {
        Navigator::pose_text(self.navigator.pose_shown(self.size.0, self.size.1))
    }
    /// Takes a pose of the getter, or one of seven or eight numbers, without aspect, or without roll and aspect. Others are ignored.
    #[wasm_bindgen(setter)]
    pub fn set_pose(&mut self, pose: Vec<f64>) {
        if let Some(pose) = Navigator::pose_of(&pose) {
            self.navigator.set_pose(pose);
        }
    }
    /// Factor of all scales.
    #[wasm_bindgen(setter)]
    pub fn set_scale(&mut self, scale: f32) {
        self.look.scale = if scale.is_finite() { scale.clamp(0.01, 10.0) } else { 1.0 };
    }
    /// Largest degree of spherical harmonics that is evaluated.
    #[wasm_bindgen(setter, js_name = shDegree)]
    pub fn set_sh_degree(&mut self, degree: usize) {
        self.look.sh_degree = degree;
    }
    /// Pixels drawn per pixel of the canvas, each way.
    #[wasm_bindgen(setter)]
    pub fn set_resolution(&mut self, share: f32) {
        self.resolution = if share.is_finite() { share.clamp(0.1, 2.0) } else { 1.0 };
    }
    /// Whether moving Gaussians are tinted.
    #[wasm_bindgen(setter)]
    pub fn set_tint(&mut self, on: bool) {
        self.look.tint = on;
    }
    /// Whether depth is shown instead of colour.
    #[wasm_bindgen(setter)]
    pub fn set_depth(&mut self, on: bool) {
        self.look.mode = if on { Mode::Depth } else { Mode::Color };
    }
    /// The RGBA pixels of the current view, in the size in which it is drawn (that of the canvas times `resolution`), or of `camera` (JSON of a camera) in the
    /// size of that camera; at `time`, by default that of the clock. A promise of a [`Capture`].
    pub fn capture(&mut self, camera: Option<String>, time: Option<f32>) -> Result<js_sys::Promise, JsError> {
        let view = self.view_of(camera, time)?;
        let Output::WebGpu { renderer, .. } = &mut self.output else { return Err(JsError::new("the page draws by itself")) };
        Ok(js_sys::Promise::new(&mut |resolve, reject| {
            renderer.capture(&view, move |image| {
                let called = match image {
                    Ok(image) => resolve.call1(&JsValue::NULL, &Capture { image }.into()),
                    Err(e) => reject.call1(&JsValue::NULL, &error(e).into()),
                };
                drop(called);
            });
        }))
    }
    /// How many Gaussians the last frame drew; a promise of a number.
    #[wasm_bindgen(js_name = countVisible)]
    pub fn count_visible(&self) -> js_sys::Promise {
        js_sys::Promise::new(&mut |resolve, _| {
            if let Output::WebGpu { renderer, .. } = &self.output {
                renderer.count_visible(move |count| drop(resolve.call1(&JsValue::NULL, &count.into())));
            }
        })
    }
}
