//! Device names of the configuration.

use crate::registry::unknown_name;
use crate::{Error, Result};
use burn::tensor::Device;

/// The device names a configuration may use.
pub const DEVICE_NAMES: [&str; 5] = ["auto", "flex", "ndarray", "wgpu", "cuda"];

/// Turns a device name into a burn device. `auto` is `flex` until the GPU operations exist.
pub fn parse_device(name: &str) -> Result<Device> {
    match name {
        "auto" | "flex" => Ok(Device::flex()),
        "ndarray" => Ok(Device::ndarray()),
        "wgpu" | "cuda" => Err(Error::unsupported(format!("device {name}"), "the GPU operations are not built yet", "Use --device flex")),
        other => Err(unknown_name("device", other, DEVICE_NAMES.into_iter())),
    }
}
