//! `cc4dgs demo`: the whole chain on the built-in scene.

use super::eval::{FullReport, Images, Subject, measure};
use super::train::{Trained, layers, train_into};
use super::{Context, compress, create_parent, eval, train};
use crate::args::Demo;
use crate::models::load_model;
use crate::output::to_json;
use cc4dgs::runs::{EVENTS, Existing};
use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::exporter::refuse_existing;
use cc4dgs_core::{Error, Result, Split};
use cc4dgs_play::ArchiveOptions;
use cc4dgs_train::eval::Scored;
use cc4dgs_train::train::TrainReport;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::Instant;

const CODEC: &str = "cca:default";
const FIELD_WEIGHTS: &str = "fp32";

/// What the demo reports, and writes as `report.json`.
#[derive(Serialize)]
struct DemoReport {
    scene: String,
    device: String,
    seconds: f64,
    /// Of the archive.
    psnr_db: f64,
    /// Of the archive.
    ssim: f64,
    /// What compression cost, in dB.
    codec_loss_db: f64,
    archive: PathBuf,
    sheet: Option<PathBuf>,
    size_mb: cc4dgs_train::eval::SizeMb,
    frame_ms: cc4dgs_train::eval::FrameMs,
    train: TrainReport,
    compress: compress::CompressReport,
    eval_checkpoint: FullReport,
    eval_archive: FullReport,
}

pub fn run(context: &Context, args: &Demo) -> Result<()> {
    let began = Instant::now();
    if args.out.to_str().is_none() {
        let object = format!("--out {}", args.out.display());
        return Err(Error::parameter(object, "the name is not UTF-8, and report.json states it", "Give another name"));
    }
    let [archive, sheet, file] = ["model.cc4d", "sheet.png", "report.json"].map(|name| args.out.join(name));
    // A folder without a run may hold files of these names, too.
    [&archive, &sheet, &file].into_iter().try_for_each(|path| refuse_existing(path, args.overwrite))?;
    let layers = layers(context, Some("demo"), None, &args.sets, args.device.as_deref())?;
    let scene_path = Path::new("procedural");
    let existing = if args.overwrite { Existing::Overwrite } else { Existing::Refuse };
    let Trained { scene: scene_name, config, report: trained } = train_into(context, &layers, scene_path, &args.out, existing, None)?;

    let events = context.listeners(Some((&args.out.join(EVENTS), true)))?;
    let loaded = load_model(&args.out, &config.device, &context.registry, &context.limits, &events)?;
    let options = ArchiveOptions { codec: CODEC, settings: &toml::Table::new(), field_weights: FIELD_WEIGHTS, views: None, tuner: None };
    let packed = compress::compress(context, &loaded.model, &options, &archive, &events)?;

    let subject = Subject::open(context, &args.out, &loaded, scene_path, &[])?;
    let before = measure(context, &subject, Scored::all(Split::Test), &Images::default(), &events)?;
    let images = Images { sheet: Some(sheet), sheet_rows: 6, renders: None };
    let unpacked = load_model(&archive, &config.device, &context.registry, &context.limits, &events)?;
    let subject = Subject::open(context, &archive, &unpacked, scene_path, &[])?;
    let after = measure(context, &subject, Scored::all(Split::Test), &images, &events)?;

    let report = DemoReport {
        scene: scene_name,
        device: config.device.clone(),
        seconds: began.elapsed().as_secs_f64(),
        psnr_db: after.eval.psnr_db,
        ssim: after.eval.ssim,
        codec_loss_db: before.eval.psnr_db - after.eval.psnr_db,
        archive,
        sheet: after.sheet.clone(),
        size_mb: after.eval.size_mb,
        frame_ms: after.eval.frame_ms,
        train: trained,
        compress: packed,
        eval_checkpoint: before,
        eval_archive: after,
    };
    create_parent(&file)?;
    write_atomically(&file, to_json(&report)?.as_bytes())?;
    context.output.result(&report, || text(&report, &file))?;
    report.eval_archive.sheet_error.map_or(Ok(()), Err)
}

fn text(report: &DemoReport, file: &Path) -> String {
    [
        train::text(&report.train),
        compress::text(&report.compress),
        eval::text(&report.eval_checkpoint),
        eval::text(&report.eval_archive),
        format!("compression cost {:.3} dB", report.codec_loss_db),
        format!("report {}   done in {:.1} s", file.display(), report.seconds),
    ]
    .join("\n")
}
