//! `cc4dgs prune`.

use super::compress::{compress, say_what_is_lost};
use super::{Context, check_file, create_parent};
use crate::args::Prune;
use crate::interrupt;
use crate::models::load_model;
use cc4dgs::scenes::open_as_trained;
use cc4dgs_core::Result;
use cc4dgs_play::ArchiveOptions;
use cc4dgs_play::prune::{PruneReport, prune};
use cc4dgs_train::train::{RefitJob, prune_and_refit};
use serde::Serialize;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

/// The result of pruning.
#[derive(Serialize)]
struct Report {
    archive: PathBuf,
    bytes: u64,
    seconds: f64,
    #[serde(flatten)]
    prune: PruneReport,
}

pub fn run(context: &Context, args: &Prune) -> Result<()> {
    let began = Instant::now();
    check_file(&args.out, args.overwrite)?;
    let events = context.listeners(None)?;
    create_parent(&args.out)?;
    let mut loaded = load_model(&args.model, &args.device, &context.registry, &context.limits, &events)?;
    loaded.model.check_storable()?;
    say_what_is_lost(context, &args.model, &events)?;
    let scene = open_as_trained(&args.scene, &loaded.model, &args.sets, &context.registry, &context.limits)?;
    // PLY files state no background.
    loaded.model.background = loaded.model.background.or(scene.background);
    let (registry, limits, events) = (&context.registry, &context.limits, &events);
    let found = match args.refit {
        0 => prune(&mut loaded.model, &scene, args.max_drop, registry, &loaded.device, events)?,
        iterations => {
            let job = RefitJob { registry, device: &loaded.device, limits, events, stop: interrupt::stop_flag()? };
            prune_and_refit(&mut loaded.model, &Arc::new(scene), args.max_drop, iterations, &job)?
        }
    };
    let options = ArchiveOptions { codec: "raw", settings: &toml::Table::new(), field_weights: "fp32", views: None, tuner: None };
    let written = compress(context, &loaded.model, &options, &args.out, events)?;
    let report = Report { archive: args.out.clone(), bytes: written.bytes, seconds: began.elapsed().as_secs_f64(), prune: found };
    context.output.result(&report, || text(&report))
}

fn text(report: &Report) -> String {
    let p = &report.prune;
    let alone = p.psnr_refit_alone_db.map_or(String::new(), |psnr| format!(" ({psnr:.3} dB after one re-fit with nothing removed)"));
    format!(
        "{}: {} of {} Gaussians kept, PSNR {:.3} dB instead of {:.3} dB on {} {} views{alone}, {:.1} s",
        report.archive.display(),
        p.after,
        p.before,
        p.psnr_after_db,
        p.psnr_before_db,
        p.views,
        p.judged_by.name(),
        report.seconds
    )
}
