//! Drawing on the GPU.

mod device;
mod pipelines;
mod size;
mod target;
mod uniforms;
mod uploaded;

use crate::scene::Scene;
use cc4dgs_format::{Camera, Error, HostGaussians, Image8, Result};
use pipelines::Pipelines;
use target::Target;
use uploaded::Uploaded;

#[cfg(all(feature = "window", not(target_arch = "wasm32")))]
pub(crate) use device::descriptor;
pub use device::{device_of, request_device};
pub(crate) use size::MostPixels;
#[cfg(any(target_arch = "wasm32", feature = "window"))]
pub(crate) use size::remark;
#[cfg(target_arch = "wasm32")]
pub(crate) use uniforms::{Frame, functions};

/// Workgroups of 256 Gaussians.
pub(crate) const BLOCK: u32 = 256;

/// What the colours show.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Mode {
    /// The colours of the model.
    #[default]
    Color,
    /// Depth of each Gaussian: near ones red, far ones blue.
    Depth,
}

/// One frame.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// The camera; its size is that of the image.
    pub camera: Camera,
    /// Normalised time, 0..1.
    pub time: f32,
    /// Largest degree of spherical harmonics that is evaluated.
    pub sh_degree: usize,
    /// Factor of all scales; 1 draws the model.
    pub scale: f32,
    /// What the colours show.
    pub mode: Mode,
    /// Whether moving Gaussians are tinted.
    pub tint: bool,
    /// Background, RGB in 0..1, instead of the model's.
    pub background: Option<[f32; 3]>,
}

impl View {
    /// The model as it is, through `camera` at `time`.
    pub fn new(camera: Camera, time: f32) -> Self {
        Self { camera, time, sh_degree: 4, scale: 1.0, mode: Mode::Color, tint: false, background: None }
    }
}

/// Draws one scene on one device.
pub struct Renderer {
    device: wgpu::Device,
    queue: wgpu::Queue,
    pipelines: Pipelines,
    uploaded: Option<Uploaded>,
    target: Option<Target>,
}

impl Renderer {
    /// A renderer whose images go to textures of `format`.
    pub fn new(device: wgpu::Device, queue: wgpu::Queue, format: wgpu::TextureFormat) -> Self {
        let pipelines = Pipelines::new(&device, format);
        Self { device, queue, pipelines, uploaded: None, target: None }
    }
    /// The device.
    pub fn device(&self) -> &wgpu::Device {
        &self.device
    }
    /// The queue.
    pub fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }
    /// 32-bit numbers that one buffer of the device holds: what [`Content::fit_harmonics`](crate::Content::fit_harmonics) asks for.
    pub fn most_words(&self) -> u64 {
        uploaded::most_bytes(&self.device) / 4
    }
    /// Uploads `scene` in place of the one before, whose buffers are freed first. Where it is refused, the one before stays.
    ///
    /// # Errors
    /// [`Error::Limit`] for scenes that the device has no buffers for.
    pub fn load(&mut self, scene: Scene) -> Result<()> {
        Uploaded::check(&self.device, &scene)?;
        self.unload();
        self.uploaded = Some(Uploaded::new(&self.device, &self.queue, &self.pipelines, scene));
        Ok(())
    }
    /// Takes the colour coefficients of degree 1 and up of `gaussians`, of which the scene was made before these had arrived.
    ///
    /// # Errors
    /// [`Error::Data`] for other Gaussians.
    pub fn load_harmonics(&mut self, gaussians: &HostGaussians) -> Result<()> {
        if let Some(uploaded) = &self.uploaded {
            uploaded.write_harmonics(&self.queue, &uploaded.scene.harmonics_of(gaussians)?);
        }
        Ok(())
    }
    /// Frees the scene.
    pub fn unload(&mut self) {
        if let Some(old) = self.uploaded.take() {
            old.destroy();
        }
    }
    /// The scene, whose arrays have gone to the GPU.
    pub fn scene(&self) -> Option<&Scene> {
        self.uploaded.as_ref().map(|u| &u.scene)
    }
    /// What an image in a page or a window may have at most.
    pub(crate) fn most_pixels(&self) -> MostPixels {
        let limits = self.device.limits();
        MostPixels::new(limits.max_texture_dimension_2d, limits.max_buffer_size)
    }
    /// Encodes a frame into `out`, a texture view of the renderer's format and of any size; the image is scaled to it. Cameras of larger images than the
    /// textures of the device are drawn with as many pixels as fit, in the same shape. Nothing is waited for.
    pub fn draw(&mut self, view: &View, out: &wgpu::TextureView) {
        let wanted = (view.camera.width, view.camera.height);
        let (width, height) = MostPixels { all: u64::MAX, ..self.most_pixels() }.fit(wanted);
        let fitted;
        let view = if width < wanted.0 || height < wanted.1 {
            fitted = View { camera: view.camera.resized(width, height), ..view.clone() };
            &fitted
        } else {
            view
        };
        if self.target.as_ref().is_none_or(|t| t.size != (width, height)) {
            if let Some(old) = self.target.take() {
                old.destroy();
            }
            self.target = Some(Target::new(&self.device, &self.pipelines, (width, height)));
        }
        let Some(target) = &self.target else { return };
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("frame") });
        let background = view.background.or(self.uploaded.as_ref().map(|u| u.scene.background)).unwrap_or_default();
        if let Some(uploaded) = self.uploaded.as_ref().filter(|u| u.scene.count > 0) {
            uploaded.write_frame(&self.queue, &self.pipelines, view, background);
            uploaded.compute(&mut encoder, &self.pipelines);
            target.blend(&mut encoder, &self.pipelines, Some(uploaded));
        } else {
            uniforms::write_empty(&self.queue, &self.pipelines, background);
            target.blend(&mut encoder, &self.pipelines, None);
        }
        target.present(&mut encoder, &self.pipelines, out);
        self.queue.submit([encoder.finish()]);
    }
    /// Draws a frame and starts to copy it to host memory; `done` receives the 8-bit RGB image. In a browser that happens later, elsewhere when the device is
    /// polled.
    pub fn capture(&mut self, view: &View, done: impl FnOnce(Result<Image8>) + wgpu::WasmNotSend + 'static) {
        let (width, height) = (view.camera.width.max(1), view.camera.height.max(1));
        let limits = self.device.limits();
        let (side, most) = (width.max(height), limits.max_texture_dimension_2d);
        if side > most {
            return done(Err(Error::limit("side of an image in pixels", side.into(), most.into(), "Ask for a smaller image")));
        }
        let row = (4 * width).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let bytes = u64::from(row) * u64::from(height);
        if bytes > limits.max_buffer_size {
            let object = format!("buffer for an image of {width}x{height} pixels, in bytes");
            return done(Err(Error::limit(object, bytes, limits.max_buffer_size, "Ask for a smaller image")));
        }
        let format = self.pipelines.format;
        let size = wgpu::Extent3d { width, height, depth_or_array_layers: 1 };
        let usage = wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC;
        let texture = self.device.create_texture(&wgpu::TextureDescriptor {
            label: Some("capture"),
            size,
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format,
            usage,
            view_formats: &[],
        });
        self.draw(view, &texture.create_view(&wgpu::TextureViewDescriptor::default()));
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("capture"),
            size: bytes,
            usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
            mapped_at_creation: false,
        });
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("capture") });
        let layout = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(row), rows_per_image: None };
        encoder.copy_texture_to_buffer(texture.as_image_copy(), wgpu::TexelCopyBufferInfo { buffer: &buffer, layout }, size);
        self.queue.submit([encoder.finish()]);
        // It goes once the copy is made. A browser would keep what is only dropped until it collects garbage.
        texture.destroy();
        let swapped = matches!(format.remove_srgb_suffix(), wgpu::TextureFormat::Bgra8Unorm);
        let read = buffer.clone();
        buffer.map_async(wgpu::MapMode::Read, .., move |mapped| {
            let image = mapped.map_err(|e| failed(&e)).and_then(|()| {
                let bytes = read.get_mapped_range(..).map_err(|e| failed(&e))?;
                let rows = bytes.chunks_exact(row as usize).flat_map(|r| r[..4 * width as usize].chunks_exact(4));
                let data = rows.flat_map(|p| if swapped { [p[2], p[1], p[0]] } else { [p[0], p[1], p[2]] }).collect();
                Ok(Image8 { width, height, channels: 3, data })
            });
            read.unmap();
            read.destroy();
            done(image);
        });
    }
    /// Draws a frame and waits for its 8-bit RGB image.
    ///
    /// # Errors
    /// [`Error::Backend`] for a device that is lost.
    #[cfg(not(target_arch = "wasm32"))]
    pub fn image(&mut self, view: &View) -> Result<Image8> {
        let (sender, receiver) = std::sync::mpsc::channel();
        self.capture(view, move |image| drop(sender.send(image)));
        self.device.poll(wgpu::PollType::wait_indefinitely()).map_err(|e| failed(&e))?;
        receiver.recv().map_err(|e| failed(&e))?
    }
    /// Starts to read how many Gaussians the last frame drew, for statistics; `done` receives the number.
    pub fn count_visible(&self, done: impl FnOnce(u32) + wgpu::WasmNotSend + 'static) {
        if let Some(uploaded) = &self.uploaded {
            uploaded.count_visible(&self.device, &self.queue, done);
        }
    }
}

fn failed(error: &dyn std::fmt::Display) -> Error {
    Error::backend("graphics device", error.to_string(), "Load the model again, or choose another adapter")
}
