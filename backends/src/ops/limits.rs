//! Errors for what a device cannot bind, and for what it does not give back.

use burn::tensor::Device;
use cc4dgs_core::{Error, Result};
use std::fmt::Display;

/// The error for an array with more rows than one binding of the adapter holds; `unit` says what a row is, in the plural.
pub(super) fn over_binding(object: &str, unit: &str, found: u64, limit: u64) -> Error {
    let counted = format!("The value counts {unit}; the limit follows from the largest binding of the adapter");
    let remedy = format!("Use a device with larger bindings (`cc4dgs doctor` lists them), or fewer {unit}");
    Error::limit(object, found, limit, format!("{counted}. {remedy}"))
}

/// An error if an array of `rows` rows, `bytes` each, is more than one binding of `device` holds. Processors have no such limit.
#[cfg(feature = "cube")]
pub(super) fn check_binding(device: &Device, object: &str, unit: &str, rows: usize, bytes: usize) -> Result<()> {
    let device = device.clone().without_autodiff();
    let burn::backend::DispatchDevice::Cube(device) = device.as_dispatch() else { return Ok(()) };
    let limit = crate::cube::tensor::binding_bytes(&device.client()) / bytes.max(1) as u64;
    if rows as u64 > limit { Err(over_binding(object, unit, rows as u64, limit)) } else { Ok(()) }
}

/// An error if an array is more than one binding of the device holds. Processors have no such limit.
#[cfg(not(feature = "cube"))]
pub(super) fn check_binding(_: &Device, _: &str, _: &str, _: usize, _: usize) -> Result<()> {
    Ok(())
}

/// Upper bound on the items that a GPU sorts: prefix sums saturate there.
#[cfg(feature = "cube")]
const MOST_SORTED: u64 = i32::MAX as u64;

/// Upper bound on the rows of `items` sorted items each.
#[cfg(feature = "cube")]
fn most_sorted_rows(items: usize) -> u64 {
    MOST_SORTED / items.max(1) as u64
}

/// An error if `rows` rows of `items` items each are more items than `device` sorts at once; `unit` says what a row is, in the plural. Processors have no such
/// limit.
#[cfg(feature = "cube")]
pub(super) fn check_sorted(device: &Device, object: &str, unit: &str, rows: usize, items: usize) -> Result<()> {
    let device = device.clone().without_autodiff();
    let burn::backend::DispatchDevice::Cube(_) = device.as_dispatch() else { return Ok(()) };
    let limit = most_sorted_rows(items);
    if rows as u64 <= limit {
        return Ok(());
    }
    let remedy = format!("The value counts {unit}; a GPU sorts {items} items for each of them, and at most {MOST_SORTED} at once. Give fewer {unit}");
    Err(Error::limit(object, rows as u64, limit, remedy))
}

/// An error if there are more items than the device sorts at once. Processors have no such limit.
#[cfg(not(feature = "cube"))]
pub(super) fn check_sorted(_: &Device, _: &str, _: &str, _: usize, _: usize) -> Result<()> {
    Ok(())
}

/// The error for `object`, which the device did not give back.
pub(super) fn unread(object: &str, error: impl Display) -> Error {
    let text = error.to_string();
    // CubeCL appends a backtrace.
    let cause: Vec<&str> = text.lines().take_while(|line| !line.starts_with("Backtrace")).map(str::trim).collect();
    let problem = format!("reading it back from the device failed ({})", cause.join(" "));
    Error::backend(object, problem, "The device may be lost or out of memory: use smaller images, fewer Gaussians, or another device (--device flex)")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_given_back_is_named_without_a_backtrace() {
        let error = unread("the number of pairs", "An error happened\nCaused by:\n  device lost\nBacktrace:\n   0: main").to_string();
        assert!(error.contains("the number of pairs") && error.contains("device lost") && error.contains("--device flex"), "{error}");
        assert!(!error.contains("main"), "{error}");
    }

    #[cfg(feature = "cube")]
    #[test]
    fn sorted_items_and_sums_over_them_stay_below_where_prefix_sums_saturate() {
        for items in [0, 1, 8, 128, 1000] {
            let rows = most_sorted_rows(items);
            assert!(rows * items as u64 <= MOST_SORTED && (rows + 1) * items.max(1) as u64 > MOST_SORTED, "{rows} rows of {items} items");
        }
    }

    /// WebGPU guarantees 8 storage buffers per kernel, of which CubeCL takes one for scalars and lengths.
    #[test]
    fn kernels_have_at_most_seven_arrays() {
        let mut folders = vec![std::path::PathBuf::from("src/cube")];
        let mut kernels = 0;
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(&folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() {
                    folders.push(path);
                    continue;
                }
                let source = std::fs::read_to_string(&path).unwrap();
                for kernel in source.split("#[cube(launch").skip(1) {
                    let signature = kernel.split(") {").next().unwrap();
                    let arrays = signature.matches(": &[").count() + signature.matches(": &mut [").count();
                    assert!(arrays <= 7, "{} has {arrays} arrays: {signature}", path.display());
                    kernels += 1;
                }
            }
        }
        assert!(kernels > 30, "{kernels} kernels found");
    }
}
