//! The graphics adapters of this machine, and which of them `auto` takes.

use burn::tensor::DeviceKind;
use serde::Serialize;
use std::sync::OnceLock;
use wgpu::{Backends, DeviceType, Instance, InstanceDescriptor};

/// What an adapter is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum AdapterKind {
    /// A card of its own.
    Discrete,
    /// Part of the processor's chip.
    Integrated,
    /// A share of a card, lent by a hypervisor.
    Virtual,
    /// A program on the processor, such as Mesa's lavapipe.
    Software,
    /// The driver does not say.
    Other,
}

/// One adapter, and the limits that decide what fits.
#[derive(Clone, Debug, Serialize)]
pub struct Adapter {
    /// What its driver calls it.
    pub name: String,
    /// What it is made of.
    pub kind: AdapterKind,
    /// Vulkan, Metal or Dx12; Gl where nothing answers through these.
    pub api: String,
    /// Driver and its version.
    pub driver: String,
    /// Largest buffer a kernel may read, in bytes.
    pub max_binding_bytes: u64,
    /// Largest buffer, in bytes.
    pub max_buffer_bytes: u64,
    /// Memory the units of a workgroup share, in bytes.
    pub workgroup_memory_bytes: u32,
    /// Most units of a workgroup.
    pub max_workgroup_units: u32,
    /// Most buffers a kernel may have.
    pub max_storage_buffers: u32,
    /// Smallest and largest subgroup; `None` without subgroup operations.
    pub subgroup_units: Option<[u32; 2]>,
    /// Whether kernels can write timestamps.
    pub timestamps: bool,
    /// Place among the adapters of its kind.
    place: usize,
}

impl Adapter {
    /// Whether it is a program on the processor.
    pub fn is_software(&self) -> bool {
        self.kind == AdapterKind::Software
    }
    /// Whether it answers through OpenGL only.
    pub fn is_opengl(&self) -> bool {
        self.api == "Gl"
    }
    /// What burn calls it.
    pub(crate) fn device_kind(&self) -> DeviceKind {
        match self.kind {
            _ if self.is_opengl() => DeviceKind::DefaultDevice,
            AdapterKind::Discrete => DeviceKind::DiscreteGpu(self.place),
            AdapterKind::Integrated => DeviceKind::IntegratedGpu(self.place),
            AdapterKind::Virtual => DeviceKind::VirtualGpu(self.place),
            AdapterKind::Software => DeviceKind::Cpu,
            AdapterKind::Other => DeviceKind::DefaultDevice,
        }
    }
}

/// All adapters, the most capable kind first; asked for once.
pub fn adapters() -> &'static [Adapter] {
    static ADAPTERS: OnceLock<Vec<Adapter>> = OnceLock::new();
    // A driver that cannot be asked is a driver that is not there.
    let enumerate = |backends| std::panic::catch_unwind(|| enumerate(backends)).unwrap_or_default();
    // burn takes OpenGL where there is nothing better. Beside Vulkan it would list the same cards again.
    ADAPTERS.get_or_init(|| Some(enumerate(Backends::PRIMARY)).filter(|all| !all.is_empty()).unwrap_or_else(|| enumerate(Backends::GL)))
}

fn enumerate(backends: Backends) -> Vec<Adapter> {
    let instance = Instance::new(InstanceDescriptor { backends, ..InstanceDescriptor::new_without_display_handle() });
    let mut all: Vec<Adapter> = Vec::new();
    for adapter in wait(instance.enumerate_adapters(backends)) {
        let (info, limits, features) = (adapter.get_info(), adapter.limits(), adapter.features());
        let kind = match info.device_type {
            DeviceType::DiscreteGpu => AdapterKind::Discrete,
            DeviceType::IntegratedGpu => AdapterKind::Integrated,
            DeviceType::VirtualGpu => AdapterKind::Virtual,
            DeviceType::Cpu => AdapterKind::Software,
            DeviceType::Other => AdapterKind::Other,
        };
        let place = all.iter().filter(|a| a.kind == kind).count();
        all.push(Adapter {
            name: info.name,
            kind,
            api: format!("{:?}", info.backend),
            driver: format!("{} {}", info.driver, info.driver_info).trim().to_string(),
            max_binding_bytes: limits.max_storage_buffer_binding_size,
            max_buffer_bytes: limits.max_buffer_size,
            workgroup_memory_bytes: limits.max_compute_workgroup_storage_size,
            max_workgroup_units: limits.max_compute_invocations_per_workgroup,
            max_storage_buffers: limits.max_storage_buffers_per_shader_stage,
            subgroup_units: features.contains(wgpu::Features::SUBGROUP).then_some([info.subgroup_min_size, info.subgroup_max_size]),
            timestamps: features.contains(wgpu::Features::TIMESTAMP_QUERY),
            place,
        });
    }
    all.sort_by_key(|a| a.kind);
    all
}

/// The value of a future that is ready as soon as it is asked, as wgpu's are outside browsers.
fn wait<T>(future: impl Future<Output = T>) -> T {
    let mut future = std::pin::pin!(future);
    let mut context = std::task::Context::from_waker(std::task::Waker::noop());
    loop {
        if let std::task::Poll::Ready(value) = future.as_mut().poll(&mut context) {
            return value;
        }
        std::thread::yield_now();
    }
}

/// The device `auto` takes, and why.
pub fn auto_device() -> (&'static str, String) {
    match adapters() {
        [] => ("flex", "no graphics adapter answers, and flex is the CPU device burn recommends".into()),
        [first, ..] if first.is_software() => {
            ("flex", format!("the only adapter, {}, is a program on the processor, where flex is faster; --device wgpu takes it", first.name))
        }
        [first, ..] if first.is_opengl() => ("flex", format!("{} answers through OpenGL only; --device wgpu takes it", first.name)),
        [first, ..] => ("wgpu", format!("{} is a graphics card", first.name)),
    }
}
