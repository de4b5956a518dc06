//! The texture that Gaussians are blended in.

use super::pipelines::{BLEND_FORMAT, Pipelines};
use super::uploaded::{DRAW_ARGUMENTS, Uploaded};

/// A texture of one size, and the bind group that presents it.
pub(super) struct Target {
    pub(super) size: (u32, u32),
    texture: wgpu::Texture,
    view: wgpu::TextureView,
    present: wgpu::BindGroup,
}

fn pass<'a>(encoder: &'a mut wgpu::CommandEncoder, label: &str, view: &wgpu::TextureView) -> wgpu::RenderPass<'a> {
    encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: Some(label),
        color_attachments: &[Some(wgpu::RenderPassColorAttachment {
            view,
            depth_slice: None,
            resolve_target: None,
            ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store: wgpu::StoreOp::Store },
        })],
        depth_stencil_attachment: None,
        timestamp_writes: None,
        occlusion_query_set: None,
        multiview_mask: None,
    })
}

impl Target {
    pub(super) fn new(device: &wgpu::Device, pipelines: &Pipelines, size: (u32, u32)) -> Self {
        let texture = device.create_texture(&wgpu::TextureDescriptor {
            label: Some("blended"),
            size: wgpu::Extent3d { width: size.0, height: size.1, depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: BLEND_FORMAT,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING,
            view_formats: &[],
        });
        let view = texture.create_view(&Default::default());
        let present = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("present"),
            layout: &pipelines.present_layout,
            entries: &[
                wgpu::BindGroupEntry { binding: 0, resource: pipelines.frame.as_entire_binding() },
                wgpu::BindGroupEntry { binding: 1, resource: wgpu::BindingResource::TextureView(&view) },
                wgpu::BindGroupEntry { binding: 2, resource: wgpu::BindingResource::Sampler(&pipelines.sampler) },
            ],
        });
        Self { size, texture, view, present }
    }
    pub(super) fn destroy(self) {
        self.texture.destroy();
    }
    /// Clears, and blends the sorted Gaussians of `scene`.
    pub(super) fn blend(&self, encoder: &mut wgpu::CommandEncoder, pipelines: &Pipelines, scene: Option<&Uploaded>) {
        let mut pass = pass(encoder, "blend", &self.view);
        if let Some(scene) = scene {
            pass.set_pipeline(&pipelines.draw);
            pass.set_bind_group(0, &scene.draw, &[]);
            pass.draw_indirect(&scene.work, DRAW_ARGUMENTS);
        }
    }
    /// Writes the image over the background to `out`.
    pub(super) fn present(&self, encoder: &mut wgpu::CommandEncoder, pipelines: &Pipelines, out: &wgpu::TextureView) {
        let mut pass = pass(encoder, "present", out);
        pass.set_pipeline(&pipelines.present);
        pass.set_bind_group(0, &self.present, &[]);
        pass.draw(0..3, 0..1);
    }
}
