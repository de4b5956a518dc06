//! The graphics adapters of this machine, and the choice of `auto` among them.

use serde::Serialize;
use std::path::PathBuf;

/// What kind of hardware an adapter is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum AdapterKind {
    /// A graphics card.
    Discrete,
    /// A GPU on the processor's chip.
    Integrated,
    /// A virtual GPU, assigned by a hypervisor.
    Virtual,
    /// Software that runs on the processor, such as Mesa's lavapipe.
    Software,
    /// Not stated by the driver.
    Other,
}

/// One adapter and its limits.
#[derive(Clone, Debug, Serialize)]
pub struct Adapter {
    /// Its name, as the driver states it.
    pub name: String,
    /// Kind of hardware.
    pub kind: AdapterKind,
    /// Vulkan or Metal; Dx12 if no graphics card answers through these, then Gl.
    pub api: String,
    /// Driver and its version.
    pub driver: String,
    /// Largest buffer binding of a kernel, in bytes.
    pub max_binding_bytes: u64,
    /// Largest buffer, in bytes.
    pub max_buffer_bytes: u64,
    /// Shared memory of a workgroup, in bytes.
    pub workgroup_memory_bytes: u32,
    /// Upper bound on the threads of a workgroup.
    pub max_workgroup_threads: u32,
    /// Upper bound on the buffers of a kernel.
    pub max_storage_buffers: u32,
    /// Threads of the smallest and the largest subgroup; `None` without subgroup operations.
    pub subgroup_threads: Option<[u32; 2]>,
    /// Whether kernels can write timestamps.
    pub timestamps: bool,
    /// Index among the adapters of its kind.
    #[cfg_attr(not(feature = "wgpu"), allow(dead_code))]
    index_in_kind: usize,
}

impl Adapter {
    /// Whether it is software that runs on the processor.
    pub fn is_software(&self) -> bool {
        self.kind == AdapterKind::Software
    }
    /// Whether its kernels may bind the buffers they need: seven arrays, and one for scalars and lengths. WebGPU guarantees as many.
    pub fn binds_enough(&self) -> bool {
        self.max_storage_buffers >= 8
    }
    /// Whether it answers through OpenGL only.
    pub fn is_opengl(&self) -> bool {
        self.api == "Gl"
    }
    /// Whether Direct3D 12 would compile its kernels with FXC, which refuses barriers in loops whose end depends on data.
    pub fn lacks_compiler(&self) -> bool {
        self.api == "Dx12" && !finds_dxc()
    }
}

/// What is wrong with an adapter that [lacks a compiler](Adapter::lacks_compiler).
pub(crate) const LACKS_COMPILER: &str = "it answers through Direct3D 12 only, whose compiler FXC refuses our kernels, and dxcompiler.dll was not found";

/// Whether Windows finds the shader compiler DXC: beside the program, in the current folder, or on the path.
fn finds_dxc() -> bool {
    let beside = std::env::current_exe().ok().and_then(|program| program.parent().map(PathBuf::from));
    let path = std::env::var_os("PATH").unwrap_or_default();
    beside.into_iter().chain([PathBuf::new()]).chain(std::env::split_paths(&path)).any(|folder| folder.join("dxcompiler.dll").is_file())
}

/// All adapters, the most capable kind first; enumerated once. None in a build without the feature `wgpu`.
#[cfg(not(feature = "wgpu"))]
pub fn adapters() -> &'static [Adapter] {
    &[]
}

#[cfg(feature = "wgpu")]
pub use enumeration::adapters;

#[cfg(feature = "wgpu")]
mod enumeration {
    use super::{Adapter, AdapterKind};
    use burn::tensor::DeviceKind;
    use std::sync::OnceLock;
    use wgpu::{Backends, DeviceType, Instance, InstanceDescriptor};

    impl Adapter {
        /// burn's name for it.
        pub(crate) fn device_kind(&self) -> DeviceKind {
            match self.kind {
                _ if self.is_opengl() => DeviceKind::DefaultDevice,
                AdapterKind::Discrete => DeviceKind::DiscreteGpu(self.index_in_kind),
                AdapterKind::Integrated => DeviceKind::IntegratedGpu(self.index_in_kind),
                AdapterKind::Virtual => DeviceKind::VirtualGpu(self.index_in_kind),
                AdapterKind::Software => DeviceKind::Cpu,
                AdapterKind::Other => DeviceKind::DefaultDevice,
            }
        }
    }

    /// All adapters, the most capable kind first; enumerated once. None in a build without the feature `wgpu`.
    pub fn adapters() -> &'static [Adapter] {
        static ADAPTERS: OnceLock<Vec<Adapter>> = OnceLock::new();
        ADAPTERS.get_or_init(settle)
    }

    /// The adapters of one API, chosen as burn chooses: the first API with a GPU, else the first with software. Other APIs list the same cards again, and the
    /// indices of burn's devices count within one API.
    fn settle() -> Vec<Adapter> {
        let apis: &[Backends] = if cfg!(target_os = "macos") { &[Backends::METAL] } else { &[Backends::VULKAN, Backends::DX12, Backends::GL] };
        let mut software = Vec::new();
        for &api in apis {
            // A driver that panics during enumeration counts as absent.
            let found = std::panic::catch_unwind(|| enumerate(api)).unwrap_or_default();
            if found.iter().any(|adapter| !adapter.is_software()) {
                return found;
            }
            if software.is_empty() {
                software = found;
            }
        }
        software
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
            let index_in_kind = all.iter().filter(|a| a.kind == kind).count();
            all.push(Adapter {
                name: info.name,
                kind,
                api: format!("{:?}", info.backend),
                driver: format!("{} {}", info.driver, info.driver_info).trim().to_string(),
                max_binding_bytes: limits.max_storage_buffer_binding_size,
                max_buffer_bytes: limits.max_buffer_size,
                workgroup_memory_bytes: limits.max_compute_workgroup_storage_size,
                max_workgroup_threads: limits.max_compute_invocations_per_workgroup,
                max_storage_buffers: limits.max_storage_buffers_per_shader_stage,
                subgroup_threads: features.contains(wgpu::Features::SUBGROUP).then_some([info.subgroup_min_size, info.subgroup_max_size]),
                timestamps: features.contains(wgpu::Features::TIMESTAMP_QUERY),
                index_in_kind,
            });
        }
        all.sort_by_key(|a| a.kind);
        all
    }

    /// The value of a future that is ready at the first poll, as wgpu's futures are outside browsers.
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
}

/// The device name that `auto` resolves to, and the reason.
pub fn auto_device() -> (&'static str, String) {
    if !cfg!(feature = "wgpu") {
        return ("flex", "this build has no wgpu backend, and flex is the CPU device burn recommends".into());
    }
    match adapters() {
        [] => ("flex", "no graphics adapter answers, and flex is the CPU device burn recommends".into()),
        [first, ..] if first.is_software() => {
            ("flex", format!("the only adapter, {}, is software on the processor, where flex is faster; --device wgpu selects it", first.name))
        }
        [first, ..] if !first.binds_enough() => {
            ("flex", format!("a kernel of {} may bind {} buffers, and 8 are needed", first.name, first.max_storage_buffers))
        }
        [first, ..] if first.lacks_compiler() => ("flex", format!("{}: {LACKS_COMPILER}", first.name)),
        [first, ..] if first.is_opengl() => ("flex", format!("{} answers through OpenGL only; --device wgpu selects it", first.name)),
        [first, ..] => ("wgpu", format!("{} is a graphics card", first.name)),
    }
}
