//! `cc4dgs decompress`.

use super::{Context, create_parent, megabytes};
use crate::args::Decompress;
use crate::models::load_model;
use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::{Error, Event, EventSink, Result, ply, spz};
use cc4dgs_play::player::Player;
use serde_json::json;

pub fn run(context: &Context, args: &Decompress) -> Result<()> {
    if let Some(time) = args.time.filter(|t| !(0.0..=1.0).contains(t)) {
        return Err(Error::parameter("--time", format!("{time} is not in 0..1"), "Give the normalised time, 0 for the first frame and 1 for the last"));
    }
    let events = context.listeners(None)?;
    let loaded = load_model(&args.model, &args.device, &context.registry, &context.limits, &events)?;
    let mut gaussians = match args.time {
        None => loaded.model.gaussians.clone(),
        Some(time) => Player::new(&loaded.model, &context.registry, &loaded.device)?.gaussians_at(time)?.to_host()?,
    };
    // Other programs expect the coordinates of the dataset.
    loaded.model.to_dataset(&mut gaussians);
    create_parent(&args.out)?;
    let is_spz = args.out.extension().is_some_and(|e| e.eq_ignore_ascii_case("spz"));
    if is_spz {
        write_atomically(&args.out, &spz::to_spz(&gaussians, 8, 8)?)?;
    } else {
        ply::write(&args.out, &gaussians, !args.no_dynamic)?;
    }
    let bytes = std::fs::metadata(&args.out).map_err(|e| Error::io(&args.out, e))?.len();
    events.emit(&Event::Saved { path: args.out.display().to_string(), bytes });
    let report = json!({
        "file": args.out,
        "format": if is_spz { "spz" } else { "ply" },
        "gaussians": gaussians.len(),
        "sh_degree": gaussians.sh_degree,
        "time": args.time,
        "bytes": bytes,
        "size_mb": megabytes(bytes),
    });
    context.output.result(&report, || format!("{}: {} Gaussians, {:.3} MB", args.out.display(), gaussians.len(), megabytes(bytes)))
}
