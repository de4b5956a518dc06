//! What the suites share.
#![allow(deprecated)] // burn deprecates NdArray in favour of Flex; it stays a tested choice here.

use burn::tensor::Device;
use cc4dgs_core::parse_device;

/// The devices every suite runs on: the CPU's, and wgpu where an adapter answers (Mesa's lavapipe is enough).
pub fn devices() -> Vec<(&'static str, Device)> {
    let mut devices: Vec<(&str, Device)> = vec![("flex", Device::flex()), ("ndarray", Device::ndarray())];
    match parse_device("wgpu") {
        Ok(device) => devices.push(("wgpu", device)),
        Err(e) if std::env::var_os("CC4DGS_REQUIRE_WGPU").is_some() => panic!("{e}"),
        // A machine without Vulkan may still run everything else; CI installs lavapipe and sets the variable.
        Err(e) => eprintln!("{e}: its part of the suite is skipped"),
    }
    devices
}
