//! What the suites share.
#![allow(deprecated)] // burn deprecates NdArray in favour of Flex; it stays a tested choice here.

use burn::tensor::{Device, Tensor};

/// The devices every suite runs on: the CPU's, and wgpu where an adapter answers (Mesa's lavapipe is enough).
pub fn devices() -> Vec<(&'static str, Device)> {
    let mut devices: Vec<(&str, Device)> = vec![("flex", Device::flex()), ("ndarray", Device::ndarray())];
    match std::panic::catch_unwind(|| {
        let device = Device::wgpu(Default::default());
        let sum = Tensor::<1>::from_floats([1.0, 2.0], &device).sum().into_scalar::<f32>();
        (sum == 3.0).then_some(device)
    }) {
        Ok(Some(device)) => devices.push(("wgpu", device)),
        // A machine without Vulkan may still run everything else; CI installs lavapipe.
        _ => eprintln!("no wgpu adapter answers: its part of the suite is skipped"),
    }
    devices
}
