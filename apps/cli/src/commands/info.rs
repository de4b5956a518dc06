//! `cc4dgs info`.

use super::compress::StreamSize;
use super::storage::{Storage, table};
use super::{Context, megabytes};
use crate::args::Info;
use cc4dgs_core::archive::{Archive, DeformerEntry, StreamKind};
use cc4dgs_core::gaussians::sh_rest_len;
use cc4dgs_core::{Error, HostGaussians, Result, Scene, SceneOptions, Silent, Split, parse_device, plural};
use cc4dgs_play::source::{Source, SourceKind};
use cc4dgs_play::{Model, attribute_width};
use cc4dgs_train::data;
use cc4dgs_train::eval::SizeMb;
use serde_json::{Value, json};
use std::path::Path;

/// Nothing is drawn here, so no graphics driver is asked.
const DEVICE: &str = "flex";
/// The most cameras of a scene that people are shown.
const MOST_CAMERAS: usize = 12;
/// The key of the cameras of a scene.
const CAMERAS: &str = "camera_list";

pub fn run(context: &Context, args: &Info) -> Result<()> {
    let (mut value, storage) = describe(context, &args.path)?;
    let rows = storage.map_or(Vec::new(), |s| s.rows());
    let mut lines = Vec::new();
    let mut shown = value.clone();
    let cameras = shown.as_object_mut().and_then(|map| map.remove(CAMERAS));
    flatten("", &shown, &mut lines);
    lines.extend(cameras.iter().flat_map(camera_lines));
    if let (false, Value::Object(map)) = (rows.is_empty(), &mut value) {
        map.insert("storage".into(), plain(&rows)?);
        lines.extend(table(&rows));
    }
    context.output.result(&value, || lines.join("\n"))
}

/// Paths are stated as text: `json!` panics at one that is not UTF-8.
fn describe(context: &Context, path: &Path) -> Result<(Value, Option<Storage>)> {
    // The built-in scenes are names and not paths.
    let source = if path.exists() { Source::find(path)? } else { None };
    match source.map(|s| s.kind) {
        Some(SourceKind::Archive) => archive(context, path),
        Some(SourceKind::Checkpoint) => checkpoint(context, path),
        Some(kind @ (SourceKind::Ply | SourceKind::Spz)) => {
            let model = Model::open(path, &context.registry, &parse_device(DEVICE)?, &context.limits, &Silent)?;
            let size: SizeMb = model.size.into();
            Ok((json!({ "kind": kind, "path": path.to_string_lossy(), "size_mb": size.total, "gaussians": gaussians(&model.gaussians)? }), None))
        }
        None => Ok((scene(context, path)?, None)),
    }
}

/// An archive's directory and manifest; no stream is decoded. Plug-ins that are not linked are named in `notes`.
fn archive(context: &Context, path: &Path) -> Result<(Value, Option<Storage>)> {
    let archive = Archive::open(path, &context.limits)?;
    let of = archive.manifest();
    let stored = archive.stream_sizes();
    let sum = |kind, bytes: fn(&cc4dgs_core::archive::StreamInfo) -> u64| stored.iter().filter(|s| s.kind == kind).map(bytes).sum::<u64>();
    let mut notes = Vec::new();
    if context.registry.codec(&of.codec.name).is_err() {
        notes.push(not_linked("codec", &of.codec.name, &of.codec.version));
    }
    if let Some(weights) = of.deformer.as_ref().map(|d| &d.weights).filter(|w| context.registry.weight_codec(&w.name).is_err()) {
        notes.push(not_linked("weight codec", &weights.name, &weights.version));
    }
    let field = match &of.deformer {
        None => Some((0, 0)),
        Some(entry) if context.registry.deformer(&entry.name).is_err() => {
            notes.push(not_linked("deformer", &entry.name, &entry.version));
            None
        }
        Some(entry) => match field_bytes(context, entry) {
            Ok(parts) => Some(parts),
            Err(e) => {
                notes.push(e.to_string());
                None
            }
        },
    };
    let total = archive.total_bytes()?;
    let floats = (15 + 3 * sh_rest_len(of.sh_degree) as u64).saturating_add(attribute_width(of));
    let storage = Storage {
        field,
        point_cloud: of.gaussian_count.saturating_mul(floats).saturating_mul(4),
        stored: Some([sum(StreamKind::Field, |s| s.stored_bytes), sum(StreamKind::Canonical, |s| s.stored_bytes), total]),
    };
    let manifest = plain(of)?;
    let streams: Vec<StreamSize> = stored.into_iter().map(StreamSize::from).collect();
    let path = path.to_string_lossy();
    let mut value = json!({ "kind": SourceKind::Archive, "path": path, "size_mb": megabytes(total), "streams": streams, "manifest": manifest });
    if let (false, Value::Object(map)) = (notes.is_empty(), &mut value) {
        map.insert("notes".into(), notes.into());
    }
    Ok((value, Some(storage)))
}

/// Float32 bytes of the weights of a stored deformer: (grid, net).
fn field_bytes(context: &Context, entry: &DeformerEntry) -> Result<(u64, u64)> {
    let mut section = entry.settings.clone();
    section.insert("kind".into(), entry.name.clone().into());
    Ok(context.registry.build_deformer(&section, &entry.context, &parse_device(DEVICE)?)?.size_bytes())
}

fn not_linked(kind: &str, name: &str, version: &str) -> String {
    format!("the {kind} '{name}' (version {version}) is not linked into this program; use one that links the crate of this {kind} to play the model")
}

fn checkpoint(context: &Context, path: &Path) -> Result<(Value, Option<Storage>)> {
    let model = Model::open(path, &context.registry, &parse_device(DEVICE)?, &context.limits, &Silent)?;
    let moving = model.moving.rows(&model.gaussians.dynamic_scores).map_or(model.gaussians.len(), |rows| rows.len());
    let size: SizeMb = model.size.into();
    let storage = Storage { field: Some((model.size.deform_grid, model.size.deform_net)), point_cloud: model.size.point_cloud, stored: None };
    let field = match &model.field {
        Some(f) => json!({ "settings": plain(&f.section)?, "context": plain(&f.context)? }),
        None => Value::Null,
    };
    let value = json!({
        "kind": SourceKind::Checkpoint,
        "path": path.to_string_lossy(),
        "size_mb": size,
        "gaussians": gaussians(&model.gaussians)?,
        "dynamic_gaussians": moving,
        "moving": plain(&model.moving)?,
        "frame_count": model.frame_count,
        "deformer": field,
        "rasterizer": plain(&model.rasterizer)?,
        "render": plain(&model.render)?,
        "provenance": plain(&model.provenance)?,
    });
    Ok((value, Some(storage)))
}

fn gaussians(host: &HostGaussians) -> Result<Value> {
    let range = |k: usize| {
        let axis = host.means.iter().skip(k).step_by(3);
        (!host.is_empty()).then(|| [axis.clone().copied().fold(f32::INFINITY, f32::min), axis.copied().fold(f32::NEG_INFINITY, f32::max)])
    };
    let extra: Vec<_> = host.extra.iter().map(|(name, a)| json!({ "name": name, "width": a.width })).collect();
    let [x, y, z] = [plain(&range(0))?, plain(&range(1))?, plain(&range(2))?];
    Ok(json!({ "count": host.len(), "sh_degree": host.sh_degree, "x": x, "y": y, "z": z, "extra": extra }))
}

fn scene(context: &Context, path: &Path) -> Result<Value> {
    facts(path, &data::open(path, &SceneOptions::default(), &context.registry, &context.limits)?)
}

/// What is shown of `scene`, which was opened at `path`.
fn facts(path: &Path, scene: &Scene) -> Result<Value> {
    let sizes: std::collections::BTreeSet<(u32, u32)> = scene.cameras.iter().map(|c| (c.width, c.height)).collect();
    let sizes: Vec<String> = sizes.into_iter().map(|(w, h)| format!("{w}x{h}")).collect();
    Ok(json!({
        "kind": "scene",
        "path": path.to_string_lossy(),
        "name": scene.name,
        "cameras": scene.cameras.len(),
        CAMERAS: cameras(scene),
        "frames": scene.frame_count,
        "train_views": scene.split(Split::Train).len(),
        "validation_views": scene.split(Split::Validation).len(),
        "test_views": scene.split(Split::Test).len(),
        "image_sizes": sizes,
        "camera_extent": plain(&scene.extent())?,
        "normalisation": plain(&scene.normalisation)?,
        "recorded_depth": scene.has_depth().map_or_else(|e| Value::from(e.to_string()), Value::from),
        "initial_points": scene.points.as_ref().map(|p| p.positions.len()),
        "init_box": plain(&scene.init_box)?,
        "background": plain(&scene.background)?,
        "warnings": scene.warnings,
    }))
}

/// Name, image size and views of every camera of `scene`.
fn cameras(scene: &Scene) -> Vec<Value> {
    let mut views = vec![[0usize; 3]; scene.cameras.len()];
    for view in &scene.views {
        views[view.camera][view.split as usize] += 1;
    }
    let described = scene.cameras.iter().zip(views);
    described
        .map(|(camera, [train, validation, test])| {
            json!({ "name": camera.name, "size": format!("{}x{}", camera.width, camera.height), "train": train, "validation": validation, "test": test })
        })
        .collect()
}

/// The first of the cameras that [`cameras`] listed, a line each.
fn camera_lines(cameras: &Value) -> Vec<String> {
    let all = cameras.as_array().map_or(&[][..], Vec::as_slice);
    let text = |camera: &Value, key: &str| camera[key].as_str().unwrap_or_default().to_string();
    let line = |camera: &Value| {
        let (name, size) = (text(camera, "name"), text(camera, "size"));
        format!("camera {name}: {size}, {} training, {} validation and {} test views", camera["train"], camera["validation"], camera["test"])
    };
    let mut lines: Vec<String> = all.iter().take(MOST_CAMERAS).map(line).collect();
    if all.len() > MOST_CAMERAS {
        let more = all.len() - MOST_CAMERAS;
        lines.push(format!("and {more} more {}, which --json lists", plural(more, "camera", "cameras")));
    }
    lines
}

/// The JSON form through text, so that a float32 of 0.1 reads 0.1 and not its nearest float64.
fn plain(value: &impl serde::Serialize) -> Result<Value> {
    serde_json::to_string(value)
        .and_then(|text| serde_json::from_str(&text))
        .map_err(|e| Error::backend("JSON", e.to_string(), "Report this: every fact should have a JSON form"))
}

/// One `key: value` line per leaf; lists of objects line by line.
fn flatten(prefix: &str, value: &Value, lines: &mut Vec<String>) {
    match value {
        Value::Object(map) => {
            for (key, inner) in map {
                let name = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
                flatten(&name, inner, lines);
            }
        }
        Value::Array(items) if items.iter().any(Value::is_object) => {
            for (i, inner) in items.iter().enumerate() {
                lines.push(format!("{prefix}[{i}]: {inner}"));
            }
        }
        Value::String(text) => lines.push(format!("{prefix}: {text}")),
        Value::Null => {}
        other => lines.push(format!("{prefix}: {other}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{Camera, NoImages, View};
    use std::sync::Arc;

    #[test]
    fn cameras_are_listed_with_their_views() {
        let camera = |k: usize| Camera::look_at(&format!("cam{k:02}"), (8 + k as u32, 6), 1.0, [k as f64, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let split = |camera: usize| match camera {
            0 => Split::Test,
            1 => Split::Validation,
            _ => Split::Train,
        };
        let views = (0..30).map(|i| View { camera: i % 15, frame: i / 15, time_norm: 0.0, split: split(i % 15) }).collect();
        let scene = Scene::new("s", (0..15).map(camera).collect(), views, Arc::new(NoImages), 0).unwrap();
        let all = Value::from(cameras(&scene));
        assert_eq!(all.as_array().unwrap().len(), 15);
        let lines = camera_lines(&all);
        assert_eq!((lines.len(), lines[0].as_str()), (MOST_CAMERAS + 1, "camera cam00: 8x6, 0 training, 0 validation and 2 test views"));
        assert_eq!(lines[1], "camera cam01: 9x6, 0 training, 2 validation and 0 test views");
        assert_eq!(lines[MOST_CAMERAS], "and 3 more cameras, which --json lists");
        let facts = facts(Path::new("s"), &scene).unwrap();
        assert_eq!(facts["recorded_depth"], Value::Bool(false));
        assert_eq!(["train_views", "validation_views", "test_views"].map(|key| facts[key].as_u64()), [Some(26), Some(2), Some(2)]);
    }
}
