//! A texture of the device that egui shows.

use cc4dgs_format::Image8;
use eframe::egui;
use eframe::egui_wgpu::RenderState;

/// Format of the textures that egui shows.
pub(super) const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;

/// A texture of a size in pixels.
pub(super) struct Image {
    texture: wgpu::Texture,
    pub(super) view: wgpu::TextureView,
    pub(super) id: egui::TextureId,
    pub(super) size: (u32, u32),
}

impl Image {
    /// Makes sure that `image` has this size; another one is replaced.
    pub(super) fn sized<'a>(image: &'a mut Option<Self>, state: &RenderState, size: (u32, u32)) -> &'a Self {
        if image.as_ref().is_some_and(|i| i.size != size) {
            Self::free(image.take(), state);
        }
        image.get_or_insert_with(|| Self::new(state, size))
    }
    fn new(state: &RenderState, size: (u32, u32)) -> Self {
        let usage = wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST;
        let texture = state.device.create_texture(&wgpu::TextureDescriptor {
            label: Some("window"),
            size: extent(size),
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: FORMAT,
            usage,
            view_formats: &[],
        });
        let view = texture.create_view(&Default::default());
        let id = state.renderer.write().register_native_texture(&state.device, &view, wgpu::FilterMode::Linear);
        Self { texture, view, id, size }
    }
    /// Forgets `image`.
    pub(super) fn free(image: Option<Self>, state: &RenderState) {
        if let Some(image) = image {
            state.renderer.write().free_texture(&image.id);
        }
    }
    /// Fills it with `pixels` of its size.
    pub(super) fn write(&self, state: &RenderState, pixels: &Image8) {
        let opaque: Vec<u8> = pixels.data.chunks_exact(pixels.channels.max(3) as usize).flat_map(|p| [p[0], p[1], p[2], 255]).collect();
        let layout = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(4 * self.size.0), rows_per_image: None };
        state.queue.write_texture(self.texture.as_image_copy(), &opaque, layout, extent(self.size));
    }
}

fn extent((width, height): (u32, u32)) -> wgpu::Extent3d {
    wgpu::Extent3d { width, height, depth_or_array_layers: 1 }
}
