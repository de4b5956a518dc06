//! Adapters and devices.

use cc4dgs_format::{Error, Result};

/// An adapter that can present to `surface` (any, without one), and a device of it with the largest buffers it has.
///
/// # Errors
/// [`Error::Unsupported`] if there is no adapter or no device.
pub async fn request_device(instance: &wgpu::Instance, surface: Option<&wgpu::Surface<'_>>) -> Result<(wgpu::Adapter, wgpu::Device, wgpu::Queue)> {
    let options = wgpu::RequestAdapterOptions { power_preference: wgpu::PowerPreference::HighPerformance, compatible_surface: surface, ..Default::default() };
    let none = |problem: String| Error::unsupported("graphics adapter", problem, "Install a Vulkan, Metal or Direct3D 12 driver, or use a browser with WebGPU");
    let adapter = instance.request_adapter(&options).await.map_err(|e| none(e.to_string()))?;
    let (device, queue) = device_of(&adapter).await?;
    Ok((adapter, device, queue))
}

/// A device of `adapter` with the largest buffers it has.
///
/// # Errors
/// [`Error::Unsupported`] if it has none.
pub async fn device_of(adapter: &wgpu::Adapter) -> Result<(wgpu::Device, wgpu::Queue)> {
    let name = || format!("graphics adapter {}", adapter.get_info().name);
    adapter.request_device(&descriptor(adapter)).await.map_err(|e| Error::unsupported(name(), e.to_string(), "Choose another adapter, or update its driver"))
}

/// A device of `adapter` with the largest buffers and textures it has.
pub(crate) fn descriptor(adapter: &wgpu::Adapter) -> wgpu::DeviceDescriptor<'static> {
    let has = adapter.limits();
    let required_limits = wgpu::Limits {
        max_buffer_size: has.max_buffer_size,
        max_storage_buffer_binding_size: has.max_storage_buffer_binding_size,
        max_texture_dimension_2d: has.max_texture_dimension_2d,
        ..wgpu::Limits::default()
    };
    wgpu::DeviceDescriptor { label: Some("cc4dgs player"), required_limits, ..Default::default() }
}
