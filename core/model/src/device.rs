//! Devices by name.

use crate::adapters::auto_device;
use crate::{Error, Result, unknown_name};
use burn::tensor::Device;

/// The device names a configuration may use. `wgpu:N` is the N-th adapter of `cc4dgs doctor`, `wgpu` the first.
pub const DEVICE_NAMES: [&str; 5] = ["auto", "flex", "ndarray", "wgpu", "cuda"];

/// The device that `name` stands for: `auto` becomes the one that [`auto_device`] takes, other names stay.
pub fn resolved_device(name: &str) -> &str {
    if name == "auto" { auto_device().0 } else { name }
}

/// Turns a device name into a burn device. `auto` is wgpu on a graphics card and flex without one; see [`auto_device`].
///
/// # Errors
/// [`Error::Parameter`] for an unknown name, [`Error::Unsupported`] if the device is missing or not in this build.
pub fn parse_device(name: &str) -> Result<Device> {
    match resolved_device(name) {
        name @ ("flex" | "ndarray") => processor_device(name),
        "wgpu" => wgpu_device(0),
        "cuda" => cuda_device(),
        other => match other.strip_prefix("wgpu:").map(str::parse) {
            Some(Ok(index)) => wgpu_device(index),
            _ => Err(unknown_name("device", other, DEVICE_NAMES.into_iter())),
        },
    }
}

#[cfg(feature = "cpu")]
fn processor_device(name: &str) -> Result<Device> {
    if name == "ndarray" { ndarray_device() } else { Ok(Device::flex()) }
}

#[cfg(feature = "ndarray")]
fn ndarray_device() -> Result<Device> {
    Ok(Device::ndarray())
}

#[cfg(all(feature = "cpu", not(feature = "ndarray")))]
fn ndarray_device() -> Result<Device> {
    Err(Error::unsupported("device ndarray", "this build has no ndarray backend", "Build with the feature `ndarray`, or use --device flex"))
}

#[cfg(not(feature = "cpu"))]
fn processor_device(name: &str) -> Result<Device> {
    Err(Error::unsupported(format!("device {name}"), "this build has no backend for processors", "Build with the feature `cpu`, or use --device wgpu"))
}

#[cfg(feature = "cuda")]
fn cuda_device() -> Result<Device> {
    let device = || Device::cuda(0);
    // burn reports a missing driver by panicking.
    match std::panic::catch_unwind(|| burn::tensor::Tensor::<1>::from_floats([1.0, 2.0], &device()).sum().into_scalar::<f32>()) {
        Ok(sum) if sum == 3.0 => Ok(device()),
        _ => Err(Error::unsupported("device cuda", "no CUDA driver answers", "Use --device wgpu or flex")),
    }
}

#[cfg(not(feature = "cuda"))]
fn cuda_device() -> Result<Device> {
    Err(Error::unsupported("device cuda", "this build has no CUDA backend", "Build with `--features cuda`, or use --device wgpu or flex"))
}

#[cfg(feature = "wgpu")]
use adapter::wgpu_device;

#[cfg(not(feature = "wgpu"))]
fn wgpu_device(_: usize) -> Result<Device> {
    Err(Error::unsupported("device wgpu", "this build has no wgpu backend", "Build with the feature `wgpu`, or use --device flex"))
}

#[cfg(all(test, not(feature = "wgpu")))]
mod tests {
    use super::parse_device;

    #[test]
    fn a_build_for_processors_says_so() {
        for name in ["wgpu", "wgpu:1"] {
            let message = parse_device(name).map(|_| ()).expect_err("no wgpu here").to_string();
            assert!(message.contains("this build has no wgpu backend"), "{message}");
        }
        assert!(parse_device("auto").is_ok());
    }
}

#[cfg(feature = "wgpu")]
mod adapter {
    use crate::adapters::{LACKS_COMPILER, adapters};
    use crate::{Error, Result};
    use burn::tensor::{Device, DeviceKind, Tensor};
    use std::collections::BTreeMap;
    use std::sync::Mutex;

    /// The adapter at `index`, if it computes a small sum correctly.
    pub fn wgpu_device(index: usize) -> Result<Device> {
        static ANSWERS: Mutex<BTreeMap<usize, bool>> = Mutex::new(BTreeMap::new());
        let kind = match adapters().get(index) {
            Some(adapter) if !adapter.binds_enough() => {
                let problem = format!("a kernel may bind {} buffers there, and 8 are needed", adapter.max_storage_buffers);
                let device = format!("device wgpu:{index} ({})", adapter.name);
                return Err(Error::unsupported(device, problem, "Use --device flex, or another adapter of `cc4dgs doctor`"));
            }
            Some(adapter) if adapter.lacks_compiler() => {
                let remedy =
                    "Install a Vulkan driver (the one of the graphics card has it), put dxcompiler.dll (1.8.2502 or later) beside cc4dgs, or use --device flex";
                return Err(Error::unsupported(format!("device wgpu:{index} ({})", adapter.name), LACKS_COMPILER, remedy));
            }
            Some(adapter) => adapter.device_kind(),
            // burn may find an adapter that enumeration does not list.
            None if index == 0 => DeviceKind::DefaultDevice,
            None => {
                let problem = format!("there is no such adapter; this machine has {} adapters", adapters().len());
                return Err(Error::unsupported(format!("device wgpu:{index}"), problem, "`cc4dgs doctor` lists them"));
            }
        };
        let device = || Device::wgpu(kind.clone());
        let mut answers = ANSWERS.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let answers = *answers.entry(index).or_insert_with(|| {
            // burn reports a missing adapter by panicking.
            let sum = std::panic::catch_unwind(|| Tensor::<1>::from_floats([1.0, 2.0], &device()).sum().into_scalar::<f32>());
            // Exit handlers run in reverse order of registration, so this one must be registered after the driver was loaded.
            end_without_destructors();
            sum.is_ok_and(|sum| sum == 3.0)
        });
        if answers {
            return Ok(device());
        }
        let problem = match adapters().get(index) {
            Some(adapter) => format!("{} ({}) does not compute a small sum", adapter.name, adapter.api),
            None => "no graphics adapter was found (Vulkan, Metal, Dx12 or OpenGL)".to_string(),
        };
        Err(Error::unsupported("device wgpu", problem, "Install a Vulkan driver (mesa-vulkan-drivers for a software one), or use --device flex"))
    }

    /// Ends the process without the static destructors of graphics drivers. Mesa's software driver destroys its compiler while a thread may still be compiling
    /// kernels with it; about one process in four crashed at exit.
    fn end_without_destructors() {
        #[cfg(all(target_os = "linux", target_env = "gnu"))]
        {
            unsafe extern "C" {
                fn on_exit(run: extern "C" fn(status: i32, context: *mut std::ffi::c_void), context: *mut std::ffi::c_void) -> i32;
                fn _exit(status: i32) -> !;
            }
            extern "C" fn leave(status: i32, _: *mut std::ffi::c_void) {
                use std::io::Write;
                // An error cannot be handled here.
                let _ = std::io::stdout().flush();
                // SAFETY: ends the process without touching memory.
                unsafe { _exit(status) }
            }
            // SAFETY: the handler is a function of this program and has no context.
            unsafe { on_exit(leave, std::ptr::null_mut()) };
        }
    }
}
