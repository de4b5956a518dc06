//! `cc4dgs info`.

use super::compress::StreamSize;
use super::storage::{Storage, table};
use super::{Context, megabytes};
use crate::args::Info;
use cc4dgs_core::archive::{Archive, MAGIC, StreamKind};
use cc4dgs_core::gaussians::sh_rest_len;
use cc4dgs_core::{Error, HostGaussians, Result, SceneOptions, Silent, Split, parse_device, ply, spz};
use cc4dgs_engine::data;
use cc4dgs_engine::eval::SizeMb;
use cc4dgs_engine::model::Model;
use cc4dgs_engine::train::CHECKPOINT;
use serde_json::{Value, json};
use std::io::Read;
use std::path::Path;

/// How SPZ files start: they are gzip streams.
const GZIP: [u8; 2] = [0x1f, 0x8b];

pub fn run(context: &Context, args: &Info) -> Result<()> {
    let (mut value, storage) = describe(context, &args.path)?;
    let rows = storage.map_or(Vec::new(), |s| s.rows());
    let mut lines = Vec::new();
    flatten("", &value, &mut lines);
    if let (false, Value::Object(map)) = (rows.is_empty(), &mut value) {
        map.insert("storage".into(), plain(&rows)?);
        lines.extend(table(&rows));
    }
    context.output.result(&value, || lines.join("\n"))
}

fn describe(context: &Context, path: &Path) -> Result<(Value, Option<Storage>)> {
    if path.is_dir() && path.join(CHECKPOINT).is_file() {
        return checkpoint(context, path);
    }
    if path.is_file() {
        let mut head = Vec::new();
        std::fs::File::open(path).and_then(|f| f.take(8).read_to_end(&mut head)).map_err(|e| Error::io(path, e))?;
        if head == MAGIC {
            return archive(context, path);
        }
        if head.starts_with(b"ply") {
            return Ok((json!({ "kind": "ply", "path": path, "gaussians": gaussians(&ply::read(path, &context.limits)?)? }), None));
        }
        if head.starts_with(&GZIP) {
            let bytes = std::fs::read(path).map_err(|e| Error::io(path, e))?;
            let found = spz::from_spz(&path.display().to_string(), &bytes, &context.limits)?;
            return Ok((json!({ "kind": "spz", "path": path, "gaussians": gaussians(&found)? }), None));
        }
        // A checkpoint is a safetensors file: a length of eight bytes, of which the upper ones are zero.
        if head.len() == 8 && head[4..] == [0; 4] {
            return checkpoint(context, path);
        }
    }
    Ok((scene(context, path)?, None))
}

/// An archive's directory and manifest; no stream is decoded.
fn archive(context: &Context, path: &Path) -> Result<(Value, Option<Storage>)> {
    let archive = Archive::open(path, &context.limits)?;
    let manifest = plain(archive.manifest())?;
    let stored = archive.stream_sizes();
    let of_kind = |kind| stored.iter().filter(|s| s.kind == kind).map(|s| s.stored_bytes).sum::<u64>();
    let of = archive.manifest();
    let (deform_grid, deform_net) = match &of.deformer {
        None => (0, 0),
        Some(entry) => {
            let mut section = entry.settings.clone();
            section.insert("kind".into(), entry.name.clone().into());
            context.registry.build_deformer(&section, &entry.context, &parse_device("flex")?)?.size_bytes()
        }
    };
    let total = archive.total_bytes()?;
    // Plug-ins' own attributes are stored as they are.
    let extra: u64 = stored.iter().filter(|s| s.name.starts_with("extra.")).map(|s| s.decoded_bytes).sum();
    let point_cloud = 4 * of.gaussian_count * (15 + 3 * sh_rest_len(of.sh_degree) as u64) + extra;
    let storage = Storage { deform_grid, deform_net, point_cloud, stored: Some([of_kind(StreamKind::Field), of_kind(StreamKind::Canonical), total]) };
    let streams: Vec<StreamSize> = stored.into_iter().map(StreamSize::from).collect();
    Ok((json!({ "kind": "archive", "path": path, "size_mb": megabytes(total), "streams": streams, "manifest": manifest }), Some(storage)))
}

fn checkpoint(context: &Context, path: &Path) -> Result<(Value, Option<Storage>)> {
    let model = Model::load(path, &context.registry, &parse_device("auto")?, &context.limits, &Silent)?;
    let moving = model.moving.rows(&model.gaussians.dynamic_scores).map_or(model.gaussians.len(), |rows| rows.len());
    let size: SizeMb = model.size.into();
    let storage = Storage { deform_grid: model.size.deform_grid, deform_net: model.size.deform_net, point_cloud: model.size.point_cloud, stored: None };
    let field = match &model.field {
        Some(f) => json!({ "settings": plain(&f.section)?, "context": plain(&f.context)? }),
        None => Value::Null,
    };
    let value = json!({
        "kind": "checkpoint",
        "path": path,
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
    let scene = data::open(path, &SceneOptions::default(), &context.registry, &context.limits)?;
    let sizes: std::collections::BTreeSet<(u32, u32)> = scene.cameras.iter().map(|c| (c.width, c.height)).collect();
    let sizes: Vec<String> = sizes.into_iter().map(|(w, h)| format!("{w}x{h}")).collect();
    Ok(json!({
        "kind": "scene",
        "path": path,
        "name": scene.name,
        "cameras": scene.cameras.len(),
        "frames": scene.frame_count,
        "train_views": scene.split(Split::Train).len(),
        "test_views": scene.split(Split::Test).len(),
        "picture_sizes": sizes,
        "camera_extent": plain(&scene.extent())?,
        "normalisation": plain(&scene.normalisation)?,
        "initial_points": scene.points.as_ref().map(|p| p.positions.len()),
        "init_box": plain(&scene.init_box)?,
        "background": plain(&scene.background)?,
        "warnings": scene.warnings,
    }))
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
