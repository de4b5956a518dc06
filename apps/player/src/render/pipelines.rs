//! Shaders, pipelines and the uniforms that all scenes share.

use super::uniforms::Frame;
use wgpu::BindingType::{Buffer, Sampler, Texture};
use wgpu::{BufferBindingType, ShaderStages};

const FRAME: &str = include_str!("../shaders/frame.wgsl");
/// Format that Gaussians are blended in: 8 bits would round at every one of them.
pub(super) const BLEND_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba16Float;

/// Everything that does not depend on the scene.
pub(super) struct Pipelines {
    pub(super) format: wgpu::TextureFormat,
    pub(super) frame: wgpu::Buffer,
    /// Shifts of the two passes of the sort.
    pub(super) shifts: [wgpu::Buffer; 2],
    pub(super) sampler: wgpu::Sampler,
    pub(super) project_layout: wgpu::BindGroupLayout,
    pub(super) compact_layout: wgpu::BindGroupLayout,
    pub(super) sort_layout: wgpu::BindGroupLayout,
    pub(super) draw_layout: wgpu::BindGroupLayout,
    pub(super) present_layout: wgpu::BindGroupLayout,
    pub(super) project: wgpu::ComputePipeline,
    pub(super) scan_blocks: wgpu::ComputePipeline,
    pub(super) compact: wgpu::ComputePipeline,
    pub(super) count: wgpu::ComputePipeline,
    pub(super) scan: wgpu::ComputePipeline,
    pub(super) scatter: wgpu::ComputePipeline,
    pub(super) draw: wgpu::RenderPipeline,
    pub(super) present: wgpu::RenderPipeline,
}

const UNIFORM: wgpu::BindingType = Buffer { ty: BufferBindingType::Uniform, has_dynamic_offset: false, min_binding_size: None };
const READ: wgpu::BindingType = Buffer { ty: BufferBindingType::Storage { read_only: true }, has_dynamic_offset: false, min_binding_size: None };
const WRITE: wgpu::BindingType = Buffer { ty: BufferBindingType::Storage { read_only: false }, has_dynamic_offset: false, min_binding_size: None };

fn layout(device: &wgpu::Device, visibility: ShaderStages, types: &[wgpu::BindingType]) -> wgpu::BindGroupLayout {
    let entry = |(binding, &ty)| wgpu::BindGroupLayoutEntry { binding: binding as u32, visibility, ty, count: None };
    let entries: Vec<_> = types.iter().enumerate().map(entry).collect();
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: None, entries: &entries })
}

impl Pipelines {
    pub(super) fn new(device: &wgpu::Device, format: wgpu::TextureFormat) -> Self {
        let module = |label: &str, source: String| {
            device.create_shader_module(wgpu::ShaderModuleDescriptor { label: Some(label), source: wgpu::ShaderSource::Wgsl(source.into()) })
        };
        let with_frame = |source: &str| format!("{FRAME}\n{source}");
        let project = module("project", with_frame(include_str!("../shaders/project.wgsl")));
        let compact = module("compact", with_frame(include_str!("../shaders/compact.wgsl")));
        let sort = module("sort", include_str!("../shaders/sort.wgsl").to_string());
        let draw = module("draw", with_frame(include_str!("../shaders/draw.wgsl")));
        let present = module("present", with_frame(include_str!("../shaders/present.wgsl")));
        let compute = ShaderStages::COMPUTE;
        let project_layout = layout(device, compute, &[UNIFORM, READ, READ, READ, READ, READ, WRITE, WRITE, WRITE]);
        let compact_layout = layout(device, compute, &[UNIFORM, READ, WRITE, WRITE, WRITE]);
        let sort_layout = layout(device, compute, &[UNIFORM, READ, READ, WRITE, WRITE]);
        let draw_layout = layout(device, ShaderStages::VERTEX_FRAGMENT, &[UNIFORM, READ, READ, READ]);
        let image =
            Texture { sample_type: wgpu::TextureSampleType::Float { filterable: true }, view_dimension: wgpu::TextureViewDimension::D2, multisampled: false };
        let present_layout = layout(device, ShaderStages::VERTEX_FRAGMENT, &[UNIFORM, image, Sampler(wgpu::SamplerBindingType::Filtering)]);
        let of_layout = |layout: &wgpu::BindGroupLayout| {
            device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor { label: None, bind_group_layouts: &[Some(layout)], immediate_size: 0 })
        };
        let compute = |module: &wgpu::ShaderModule, entry: &str, layout: &wgpu::BindGroupLayout| {
            device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(entry),
                layout: Some(&of_layout(layout)),
                module,
                entry_point: Some(entry),
                compilation_options: Default::default(),
                cache: None,
            })
        };
        let over = wgpu::BlendState::PREMULTIPLIED_ALPHA_BLENDING;
        let render = |module: &wgpu::ShaderModule, layout: &wgpu::BindGroupLayout, topology, format, blend| {
            device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
                label: None,
                layout: Some(&of_layout(layout)),
                vertex: wgpu::VertexState { module, entry_point: Some("vertex"), compilation_options: Default::default(), buffers: &[] },
                primitive: wgpu::PrimitiveState { topology, ..Default::default() },
                depth_stencil: None,
                multisample: Default::default(),
                fragment: Some(wgpu::FragmentState {
                    module,
                    entry_point: Some("fragment"),
                    compilation_options: Default::default(),
                    targets: &[Some(wgpu::ColorTargetState { format, blend, write_mask: wgpu::ColorWrites::ALL })],
                }),
                multiview_mask: None,
                cache: None,
            })
        };
        let uniform = |size: usize| {
            let usage = wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST;
            device.create_buffer(&wgpu::BufferDescriptor { label: None, size: size as u64, usage, mapped_at_creation: false })
        };
        Self {
            format,
            frame: uniform(size_of::<Frame>()),
            shifts: [uniform(16), uniform(16)],
            sampler: device.create_sampler(&wgpu::SamplerDescriptor {
                mag_filter: wgpu::FilterMode::Linear,
                min_filter: wgpu::FilterMode::Linear,
                ..Default::default()
            }),
            project: compute(&project, "main", &project_layout),
            scan_blocks: compute(&compact, "scan_blocks", &compact_layout),
            compact: compute(&compact, "compact", &compact_layout),
            count: compute(&sort, "count", &sort_layout),
            scan: compute(&sort, "scan", &sort_layout),
            scatter: compute(&sort, "scatter", &sort_layout),
            draw: render(&draw, &draw_layout, wgpu::PrimitiveTopology::TriangleStrip, BLEND_FORMAT, Some(over)),
            present: render(&present, &present_layout, wgpu::PrimitiveTopology::TriangleList, format, None),
            project_layout,
            compact_layout,
            sort_layout,
            draw_layout,
            present_layout,
        }
    }
}
