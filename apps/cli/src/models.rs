//! The model a command works on.

use cc4dgs_core::{EventSink, Limits, Registry, Result, parse_device, resolved_device};
use cc4dgs_play::model::Model;
use std::path::Path;

/// A model on a device.
pub struct Loaded {
    pub model: Model,
    pub device: burn::tensor::Device,
    pub device_name: String,
}

/// Opens a run's folder, a checkpoint, an archive, a PLY or an SPZ file.
pub fn load_model(path: &Path, device_name: &str, registry: &Registry, limits: &Limits, events: &dyn EventSink) -> Result<Loaded> {
    let device = parse_device(device_name)?;
    let model = Model::open(path, registry, &device, limits, events)?;
    Ok(Loaded { model, device, device_name: resolved_device(device_name).to_string() })
}
