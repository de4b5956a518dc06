//! A scene on the GPU: its buffers, and the compute passes of a frame.

use super::pipelines::Pipelines;
use super::uniforms::{Frame, functions};
use super::{BLOCK, View};
use crate::scene::Scene;
use cc4dgs_format::playback::{Head, MAX_FUNCTIONS};
use cc4dgs_format::{Error, Result};

/// Pairs per workgroup of the sort.
const SORT_BLOCK: u32 = 2048;
/// Digits of a pass of the sort.
const DIGITS: u64 = 256;
/// Bytes of a screen record.
const SPLAT_BYTES: u64 = 48;
/// Byte at which the draw's arguments begin in the work buffer; the dispatch's are at 0.
pub(super) const DRAW_ARGUMENTS: u64 = 16;
/// Byte of the number of visible Gaussians.
const VISIBLE: u64 = 12;
const WORK_BYTES: u64 = 32;

/// Buffers and bind groups of one scene.
pub(super) struct Uploaded {
    /// What was uploaded; its arrays are empty now.
    pub(super) scene: Scene,
    pub(super) work: wgpu::Buffer,
    pub(super) draw: wgpu::BindGroup,
    harmonics: wgpu::Buffer,
    functions: wgpu::Buffer,
    project: wgpu::BindGroup,
    compact: wgpu::BindGroup,
    sort: [wgpu::BindGroup; 2],
    buffers: Vec<wgpu::Buffer>,
}

fn group(device: &wgpu::Device, layout: &wgpu::BindGroupLayout, buffers: &[&wgpu::Buffer]) -> wgpu::BindGroup {
    let entries: Vec<wgpu::BindGroupEntry> = (0..).zip(buffers).map(|(binding, b)| wgpu::BindGroupEntry { binding, resource: b.as_entire_binding() }).collect();
    device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout, entries: &entries })
}

/// Bytes of the largest buffer that shaders of `device` read.
pub(super) fn most_bytes(device: &wgpu::Device) -> u64 {
    device.limits().max_storage_buffer_binding_size.min(device.limits().max_buffer_size)
}

impl Uploaded {
    /// Refuses scenes that `device` has no buffers for.
    pub(super) fn check(device: &wgpu::Device, scene: &Scene) -> Result<()> {
        let n = scene.count as u64;
        let most = most_bytes(device);
        let words = [scene.gaussians.len(), scene.harmonics.len(), scene.starts.len(), scene.coefficients.len()];
        let largest = words.map(|w| 4 * w as u64).into_iter().chain([SPLAT_BYTES * n]);
        if let Some(bytes) = largest.max().filter(|b| *b > most) {
            let fits = n * most / bytes.max(1);
            let remedy = format!("This device holds about {fits} such Gaussians: remove some with `cc4dgs prune`, or open a smaller model");
            return Err(Error::limit("largest buffer of the model, in bytes", bytes, most, remedy));
        }
        let most_blocks = u64::from(device.limits().max_compute_workgroups_per_dimension);
        if n.div_ceil(u64::from(BLOCK)) > most_blocks {
            return Err(Error::limit("Gaussians", n, most_blocks * u64::from(BLOCK), "Remove Gaussians with `cc4dgs prune`"));
        }
        Ok(())
    }
    /// Uploads a scene that was checked.
    pub(super) fn new(device: &wgpu::Device, queue: &wgpu::Queue, pipelines: &Pipelines, mut scene: Scene) -> Self {
        use wgpu::BufferUsages as Usage;
        let n = scene.count as u64;
        let blocks = n.div_ceil(u64::from(BLOCK));
        let mut buffers = Vec::new();
        let mut buffer = |bytes: u64, usage: Usage| {
            // A binding may not be empty.
            let made =
                device.create_buffer(&wgpu::BufferDescriptor { label: None, size: bytes.max(16), usage: usage | Usage::STORAGE, mapped_at_creation: false });
            buffers.push(made.clone());
            made
        };
        let gaussians = buffer(4 * scene.gaussians.len() as u64, Usage::COPY_DST);
        let harmonics = buffer(4 * scene.harmonics.len() as u64, Usage::COPY_DST);
        let starts = buffer(4 * scene.starts.len() as u64, Usage::COPY_DST);
        let coefficients = buffer(4 * scene.coefficients.len() as u64, Usage::COPY_DST);
        let functions = buffer(4 * (Head::ALL.len() * MAX_FUNCTIONS) as u64, Usage::COPY_DST);
        let splats = buffer(SPLAT_BYTES * n, Usage::empty());
        let keys = buffer(4 * n, Usage::empty());
        let visible_of_block = buffer(4 * blocks, Usage::empty());
        let work = buffer(WORK_BYTES, Usage::INDIRECT | Usage::COPY_SRC);
        let pairs = [buffer(8 * n, Usage::empty()), buffer(8 * n, Usage::empty())];
        let counts = buffer(4 * DIGITS * n.div_ceil(u64::from(SORT_BLOCK)), Usage::empty());
        queue.write_buffer(&gaussians, 0, bytemuck::cast_slice(&scene.gaussians));
        queue.write_buffer(&harmonics, 0, bytemuck::cast_slice(&scene.harmonics));
        queue.write_buffer(&starts, 0, bytemuck::cast_slice(&scene.starts));
        queue.write_buffer(&coefficients, 0, bytemuck::cast_slice(&scene.coefficients));
        for (buffer, shift) in pipelines.shifts.iter().zip([0u32, 8]) {
            queue.write_buffer(buffer, 0, bytemuck::bytes_of(&[shift, 0, 0, 0]));
        }
        (scene.gaussians, scene.harmonics, scene.starts, scene.coefficients) = Default::default();
        let frame = &pipelines.frame;
        let project = [frame, &gaussians, &harmonics, &starts, &coefficients, &functions, &splats, &keys, &visible_of_block];
        let pass = |k: usize| group(device, &pipelines.sort_layout, &[&pipelines.shifts[k], &work, &pairs[k], &pairs[1 - k], &counts]);
        Self {
            project: group(device, &pipelines.project_layout, &project),
            compact: group(device, &pipelines.compact_layout, &[frame, &keys, &visible_of_block, &work, &pairs[0]]),
            sort: [pass(0), pass(1)],
            draw: group(device, &pipelines.draw_layout, &[frame, &splats, &pairs[0], &work]),
            scene,
            work,
            harmonics,
            functions,
            buffers,
        }
    }
    /// Writes harmonics that arrived after the scene; `words` are as many as it had.
    pub(super) fn write_harmonics(&self, queue: &wgpu::Queue, words: &[u32]) {
        queue.write_buffer(&self.harmonics, 0, bytemuck::cast_slice(words));
    }
    pub(super) fn destroy(self) {
        self.buffers.iter().for_each(wgpu::Buffer::destroy);
    }
    /// Writes the uniforms of `view` and φ at its time.
    pub(super) fn write_frame(&self, queue: &wgpu::Queue, pipelines: &Pipelines, view: &View, background: [f32; 3]) {
        let (values, heads) = functions(&self.scene, view.time);
        if !values.is_empty() {
            queue.write_buffer(&self.functions, 0, bytemuck::cast_slice(&values));
        }
        queue.write_buffer(&pipelines.frame, 0, bytemuck::bytes_of(&Frame::new(&self.scene, view, background, heads)));
    }
    /// Projects, lists what is visible, and sorts it by depth.
    pub(super) fn compute(&self, encoder: &mut wgpu::CommandEncoder, pipelines: &Pipelines) {
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some("project and sort"), timestamp_writes: None });
        let blocks = (self.scene.count as u32).div_ceil(BLOCK);
        pass.set_pipeline(&pipelines.project);
        pass.set_bind_group(0, &self.project, &[]);
        pass.dispatch_workgroups(blocks, 1, 1);
        pass.set_bind_group(0, &self.compact, &[]);
        pass.set_pipeline(&pipelines.scan_blocks);
        pass.dispatch_workgroups(1, 1, 1);
        pass.set_pipeline(&pipelines.compact);
        pass.dispatch_workgroups(blocks, 1, 1);
        for group in &self.sort {
            pass.set_bind_group(0, group, &[]);
            pass.set_pipeline(&pipelines.count);
            pass.dispatch_workgroups_indirect(&self.work, 0);
            pass.set_pipeline(&pipelines.scan);
            pass.dispatch_workgroups(1, 1, 1);
            pass.set_pipeline(&pipelines.scatter);
            pass.dispatch_workgroups_indirect(&self.work, 0);
        }
    }
    pub(super) fn count_visible(&self, device: &wgpu::Device, queue: &wgpu::Queue, done: impl FnOnce(u32) + wgpu::WasmNotSend + 'static) {
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ;
        let read = device.create_buffer(&wgpu::BufferDescriptor { label: None, size: 4, usage, mapped_at_creation: false });
        let mut encoder = device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(&self.work, VISIBLE, &read, 0, 4);
        queue.submit([encoder.finish()]);
        let buffer = read.clone();
        read.map_async(wgpu::MapMode::Read, .., move |mapped| {
            if mapped.is_ok()
                && let Ok(bytes) = buffer.get_mapped_range(..)
            {
                let count = u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
                drop(bytes);
                buffer.unmap();
                buffer.destroy();
                done(count);
            }
        });
    }
}
