//! Helpers that the test suites share.
#![allow(deprecated)] // burn deprecates NdArray in favour of Flex; it stays a tested choice here.

pub mod golden;

use burn::tensor::{Device, Tensor};
use cc4dgs_core::{Event, EventSink, parse_device};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// The devices every suite runs on: the CPU's, and wgpu where an adapter answers (Mesa's lavapipe is enough).
pub fn devices() -> Vec<(&'static str, Device)> {
    let mut devices: Vec<(&str, Device)> = vec![("flex", Device::flex()), ("ndarray", Device::ndarray())];
    match parse_device("wgpu") {
        Ok(device) => devices.push(("wgpu", device)),
        Err(e) if std::env::var_os("CC4DGS_REQUIRE_WGPU").is_some() => panic!("{e}"),
        // A machine without Vulkan can still run all other tests; CI installs lavapipe and sets the variable.
        Err(e) => eprintln!("{e}: its part of the suite is skipped"),
    }
    devices
}

/// The larger of two numbers; NaN if one is NaN, unlike `f32::max`, so that an assertion about the largest of many numbers fails.
pub fn larger<T: PartialOrd + Copy>(a: T, b: T) -> T {
    if a.partial_cmp(&a).is_none() || a >= b { a } else { b }
}

/// Sets the stop flag at the n-th iteration event.
pub struct StopAfter<'a> {
    /// Events that are left.
    pub left: AtomicUsize,
    /// The flag.
    pub stop: &'a AtomicBool,
}

impl EventSink for StopAfter<'_> {
    fn emit(&self, event: &Event) {
        if matches!(event, Event::Iteration { .. }) && self.left.fetch_sub(1, Ordering::Relaxed) == 1 {
            self.stop.store(true, Ordering::Relaxed);
        }
    }
}

/// Fills the device's free memory with NaNs, so that tests detect kernels that read uninitialised memory.
pub fn poison(device: &Device) {
    let mut held = Vec::new();
    for bits in 6..22 {
        held.extend((0..4).map(|_| Tensor::<1>::full([1 << bits], f32::NAN, device)));
    }
    device.sync().expect("the device answers");
}

/// The snippets of CONTRIBUTING.md, compiled by the documentation tests.
#[cfg(doctest)]
#[doc = include_str!("../../CONTRIBUTING.md")]
pub struct Contributing;

/// The program of README.md, compiled by the documentation tests.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
pub struct Readme;
