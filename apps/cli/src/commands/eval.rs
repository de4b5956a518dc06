//! `cc4dgs eval`.

use super::{Context, check_writable, image_folder, lies_in};
use crate::args::Eval;
use crate::interrupt;
use crate::models::{Loaded, load_model};
use cc4dgs::scenes::{open_as_trained, options_as_trained};
use cc4dgs_core::exporter::refuse_other_content;
use cc4dgs_core::sample::spread_views;
use cc4dgs_core::{Error, Event, EventSink, Limits, Result, Scene, Split, plural};
use cc4dgs_train::data::procedural::{ProceduralScene, whole_scene};
use cc4dgs_train::eval::{EvalReport, Scored, evaluate};
use cc4dgs_train::images::{Comparison, SheetOptions, comparison_sheet, write_png};
use cc4dgs_train::trajectory::{MotionScore, motion_scores};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// The first bytes of every PNG file.
const PNG: &[u8] = b"\x89PNG\r\n\x1a\n";

/// An evaluation with what it was made from.
#[derive(Serialize)]
pub struct FullReport {
    pub model: PathBuf,
    pub device: String,
    /// Wall seconds of the whole evaluation.
    pub seconds: f64,
    /// The contact sheet, if one was drawn.
    pub sheet: Option<PathBuf>,
    /// Why the contact sheet could not be drawn or written. The numbers are reported first.
    #[serde(skip)]
    pub sheet_error: Option<Error>,
    #[serde(flatten)]
    pub eval: EvalReport,
    /// Trajectory error per moving body, for built-in scenes with known motion.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub motion: Vec<MotionScore>,
    pub provenance: Provenance,
}

/// A program.
#[derive(Serialize)]
pub struct Program {
    pub version: &'static str,
    /// Empty if unknown.
    pub commit: &'static str,
}

/// Where the model came from, and what scored it.
#[derive(Serialize)]
pub struct Provenance {
    pub evaluated_by: Program,
    /// Commit of the program that trained.
    pub commit: String,
    pub seed: u64,
    pub trained_on: String,
    pub limits: Limits,
    pub config: toml::Table,
}

/// What to draw besides the numbers.
#[derive(Default)]
pub struct Images {
    pub sheet: Option<PathBuf>,
    pub sheet_rows: usize,
    pub renders: Option<PathBuf>,
}

pub fn run(context: &Context, args: &Eval) -> Result<()> {
    if let (Some(sheet), 0) = (&args.sheet, args.sheet_rows) {
        return Err(Error::parameter(format!("--sheet {}", sheet.display()), "--sheet-rows 0 draws no contact sheet", "Leave one of the two out"));
    }
    let split = args.views.split.into();
    let sheet = args.sheet.clone().unwrap_or_else(|| default_sheet(&args.views.model, split, context.output.json_beside()));
    let images = Images { sheet: (args.sheet_rows > 0).then_some(sheet), sheet_rows: args.sheet_rows, renders: args.renders.clone() };
    if let Some(sheet) = &images.sheet {
        check_sheet(sheet, &args.views.scene, args.overwrite)?;
    }
    let earlier = match &images.renders {
        Some(folder) => earlier_renders(folder, args.overwrite)?,
        None => Vec::new(),
    };
    let events = context.listeners(None)?;
    let loaded = load_model(&args.views.model, &args.device, &context.registry, &context.limits, &events)?;
    let subject = Subject::open(context, &args.views.model, &loaded, &args.views.scene, &args.views.sets)?;
    let scored = Scored { split, max_views: args.max_views, perceptual: args.perceptual };
    scored.check(&subject.scene)?;
    images.renders.as_ref().map_or(Ok(()), |folder| image_folder::begin(folder, &earlier))?;
    let report = measure(context, &subject, scored, &images, &events)?;
    context.output.result(&report, || text(&report))?;
    report.sheet_error.map_or(Ok(()), Err)
}

/// Beside the JSON file if there is one, else in the run's folder, else beside the archive.
fn default_sheet(model: &Path, split: Split, json_file: Option<&Path>) -> PathBuf {
    let side = match split {
        Split::Train => "train",
        Split::Validation => "validation",
        Split::Test => "test",
    };
    match json_file.map(|file| (file, file.with_extension("png"))) {
        Some((file, sheet)) if sheet != file => sheet,
        _ if model.is_dir() => model.join(format!("eval-{side}.png")),
        _ => model.with_extension(format!("{side}.png")),
    }
}

/// Refuses to replace a file that is no PNG image by a contact sheet, and a file in the folder of the scene, which may be one of its images. A sheet that
/// cannot be written is refused, too: the numbers would be measured first.
fn check_sheet(sheet: &Path, scene: &Path, overwrite: bool) -> Result<()> {
    refuse_other_content(sheet, "a PNG image", |head| head.starts_with(PNG))?;
    if !overwrite && lies_in(sheet, scene) {
        let problem = format!("{} exists already in the folder of the scene, and may be one of its images", sheet.display());
        return Err(Error::parameter("--sheet", problem, "Name another file, or add --overwrite to replace this one"));
    }
    check_writable(sheet).map_err(|e| {
        let remedy = "Name a file in another folder (--sheet F.png), or draw no contact sheet (--sheet-rows 0)";
        Error::data(format!("contact sheet {}", sheet.display()), format!("it cannot be written: {e}"), remedy)
    })
}

/// The renders that an earlier command left in `folder`. A folder that holds anything is refused without `overwrite`; with it, one that holds anything else,
/// and one that no command marked, whose images may be those of a dataset.
fn earlier_renders(folder: &Path, overwrite: bool) -> Result<Vec<PathBuf>> {
    let refuse = |problem: String, remedy: &str| Err(Error::parameter("--renders", problem, remedy));
    let entries = image_folder::entries(folder)?;
    let Some(first) = entries.first() else { return Ok(entries) };
    if !overwrite {
        let problem = format!("{} is there already, and renders of two commands would mix", first.display());
        return refuse(problem, "Name another folder, or add --overwrite to replace the renders of an earlier command");
    }
    let is_digits = |name: &str| name.len() >= 5 && name.bytes().all(|b| b.is_ascii_digit());
    let is_render = |path: &Path| path.is_file() && path.file_name().and_then(|n| n.to_str()).and_then(|n| n.strip_suffix(".png")).is_some_and(is_digits);
    if let Some(other) = entries.iter().find(|path| !is_render(path)) {
        return refuse(format!("{} is not a render", other.display()), "Name another folder: only renders are replaced");
    }
    image_folder::refuse_unmarked("--renders", folder)?;
    Ok(entries)
}

/// A model and the scene it is scored on.
pub struct Subject<'a> {
    path: &'a Path,
    loaded: &'a Loaded,
    scene: Scene,
    /// The scene with its known motion, if it is built in and the model was trained on all of its frames.
    truth: Option<ProceduralScene>,
}

impl<'a> Subject<'a> {
    /// The model `loaded` from `path`, and the dataset at `scene` as it was trained on, with `sets` laid over.
    pub fn open(context: &Context, path: &'a Path, loaded: &'a Loaded, scene: &Path, sets: &[String]) -> Result<Self> {
        let stored = &loaded.model.provenance.config;
        let options = options_as_trained(stored, sets)?;
        let truth = match options_as_trained(stored, &[])?.frames == options.frames {
            true => whole_scene(scene, &options, &context.limits)?,
            false => None,
        };
        Ok(Self { path, loaded, scene: open_as_trained(scene, &loaded.model, sets, &context.registry, &context.limits)?, truth })
    }
}

/// Measures and draws.
pub fn measure(context: &Context, subject: &Subject, scored: Scored, images: &Images, events: &dyn EventSink) -> Result<FullReport> {
    let began = Instant::now();
    let stop = interrupt::stop_flag()?;
    let (loaded, scene) = (subject.loaded, &subject.scene);
    let model = &loaded.model;
    events.emit(&Event::RunStarted { command: "eval".into(), device: loaded.device_name.clone(), seed: model.provenance.seed });
    for message in &scene.warnings {
        events.emit(&Event::Warning { object: scene.name.clone(), message: message.clone() });
    }
    let rows = if images.sheet.is_some() { spread_views(scene, &scored.views(scene), images.sheet_rows) } else { Vec::new() };
    let mut comparisons = Vec::with_capacity(rows.len());
    let mut index = 0;
    let report = evaluate(model, scene, scored, &context.registry, &loaded.device, events, &mut |view, truth, render, score| {
        interrupt::check(stop, "evaluation; nothing of it was written but finished renders")?;
        if rows.contains(&view) {
            let caption =
                format!("{} frame {} t {:.3}  PSNR {:.2} dB  SSIM {:.4}", score.camera, score.frame, scene.views[view].time_norm, score.psnr_db, score.ssim);
            comparisons.push(Comparison { caption, reference: truth.clone(), render: render.clone() });
        }
        if let Some(folder) = &images.renders {
            write_png(folder.join(format!("{index:05}.png")), render)?;
        }
        index += 1;
        Ok(())
    })?;
    let (mut sheet, mut sheet_error) = (images.sheet.clone(), None);
    if let Some(path) = &images.sheet {
        let title = format!("{}: PSNR {:.2} dB  SSIM {:.4}  {:.3} MB", report.scene, report.psnr_db, report.ssim, report.size_mb.total);
        let drawn = comparison_sheet(&comparisons, &SheetOptions { title, ..Default::default() });
        if let Err(e) = drawn.and_then(|image| write_png(path, &image)) {
            (sheet, sheet_error) = (None, Some(e));
        }
    }
    for (counter, done, skipped) in [
        ("Gaussians deformed", report.work.deformed, report.work.static_skipped),
        ("spatial passes of the deformer", report.work.frames - report.work.spatial_cached, report.work.spatial_cached),
        ("vertices decoded", report.work.spatial.vertices_decoded, report.work.spatial.vertices_queried - report.work.spatial.vertices_decoded),
    ] {
        events.emit(&Event::Work { stage: "eval".into(), counter: counter.into(), done, skipped });
    }
    let motion = match &subject.truth {
        Some(truth) => motion_scores(model, truth, &context.registry, &loaded.device, events)?,
        None => Vec::new(),
    };
    let (provenance, (version, commit)) = (&model.provenance, cc4dgs_train::code::version());
    Ok(FullReport {
        model: subject.path.to_path_buf(),
        device: loaded.device_name.clone(),
        seconds: began.elapsed().as_secs_f64(),
        sheet,
        sheet_error,
        eval: report,
        motion,
        provenance: Provenance {
            evaluated_by: Program { version, commit },
            commit: provenance.commit.clone(),
            seed: provenance.seed,
            trained_on: provenance.device.clone(),
            limits: context.limits,
            config: provenance.config.clone(),
        },
    })
}

/// The report for people.
pub fn text(report: &FullReport) -> String {
    let e = &report.eval;
    let ms_ssim = e.ms_ssim.map_or_else(|| "too small".to_string(), |v| format!("{v:.4}"));
    let mut lines = vec![
        format!("{} on {} ({} {})", report.model.display(), e.scene, e.images.len(), plural(e.images.len(), "image", "images")),
        format!("  PSNR {:.3} dB   SSIM {:.4} (Inria) {:.4} (skimage)   MS-SSIM {ms_ssim}", e.psnr_db, e.ssim, e.ssim_skimage),
        e.flip.map_or_else(String::new, |flip| match &e.lpips_absent {
            None => format!("  LPIPS {} (AlexNet)   FLIP {flip:.4}", e.lpips.map_or_else(|| "-".to_string(), |v| format!("{v:.4}"))),
            Some(reason) => format!("  FLIP {flip:.4}   {reason}"),
        }),
        e.psnr_dynamic_db
            .zip(e.ssim_dynamic)
            .map_or_else(String::new, |(psnr, ssim)| format!("  PSNR {psnr:.3} dB   SSIM {ssim:.4} (Inria) where something moves")),
        e.psnr_worst_block_db.zip(e.lost_blocks).map_or_else(String::new, |(psnr, lost)| {
            format!("  worst moving block of an image: {psnr:.2} dB in the mean; {:.1} % of the moving blocks lost", 100.0 * lost)
        }),
        format!("  size {:.4} MB: deform {:.4} MB, point cloud {:.4} MB", e.size_mb.total, e.size_mb.deform, e.size_mb.point_cloud),
        format!("  {} Gaussians, {} of them dynamic", e.gaussians, e.dynamic_gaussians),
        format!(
            "  frame {:.2} ms: deformer {:.2} + rasterizer {:.2}; first frame: deformer {:.2} + rasterizer {:.2}",
            e.frame_ms.mean, e.frame_ms.field, e.frame_ms.raster, e.frame_ms.field_first, e.frame_ms.raster_first
        ),
    ];
    lines.retain(|line| !line.is_empty());
    if !report.motion.is_empty() {
        lines.push("  moving object            cycles  PSNR dB  trajectory error  Gaussians".into());
    }
    lines.extend(report.motion.iter().map(|m| {
        let error = m.trajectory_error.map_or_else(|| "-".to_string(), |e| format!("{e:.3}"));
        let cycles = m.cycles.map_or_else(|| "-".to_string(), |c| c.to_string());
        let psnr = m.psnr_db.map_or_else(|| "-".to_string(), |p| format!("{p:.2}"));
        format!("  {:<24} {cycles:>6} {psnr:>8} {error:>17} {:>10}", m.name, m.gaussians)
    }));
    if let Some(path) = &report.sheet {
        lines.push(format!("  contact sheet {}", path.display()));
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder with a scene of one image, and a path in it.
    fn scratch() -> (tempfile::TempDir, impl Fn(&str) -> PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().to_path_buf();
        std::fs::create_dir_all(root.join("scene/images")).unwrap();
        std::fs::write(root.join("scene/images/00000.png"), PNG).unwrap();
        std::fs::write(root.join("scene/transforms.json"), "{}").unwrap();
        (folder, move |name: &str| root.join(name))
    }

    #[test]
    fn a_sheet_replaces_no_model_and_no_image_of_the_scene() {
        let (_folder, at) = scratch();
        let check = |sheet: &str, scene: &str, overwrite| check_sheet(&at(sheet), &at(scene), overwrite).map_err(|e| e.to_string());
        std::fs::write(at("model.cc4d"), b"\x89CC4D\r\n\x1a").unwrap();
        std::fs::write(at("model.test.png"), PNG).unwrap();
        check("new.png", "scene", false).unwrap();
        check("model.test.png", "scene", false).unwrap();
        check("scene/new.png", "scene", false).unwrap();
        for overwrite in [false, true] {
            assert!(check("model.cc4d", "scene", overwrite).unwrap_err().contains("not a PNG image"));
            assert!(check("scene/transforms.json", "scene", overwrite).unwrap_err().contains("not a PNG image"));
        }
        for scene in ["scene", "scene/transforms.json"] {
            assert!(check("scene/images/00000.png", scene, false).unwrap_err().contains("--overwrite"));
            check("scene/images/00000.png", scene, true).unwrap();
        }
        check("scene/images/00000.png", "procedural:tiny", false).unwrap();
        // Nobody may write below a file.
        let message = check("model.cc4d/sheet.png", "scene", false).unwrap_err();
        assert!(message.contains("model.cc4d/sheet.png") && message.contains("--sheet-rows 0"), "{message}");
    }

    #[test]
    fn a_sheet_is_not_the_json_file() {
        let sheet = |json: Option<&str>| default_sheet(Path::new("runs/a.cc4d"), Split::Test, json.map(Path::new));
        assert_eq!(sheet(Some("out/eval.json")), Path::new("out/eval.png"));
        for json in [None, Some("eval.png")] {
            assert_eq!(sheet(json), Path::new("runs/a.test.png"));
        }
    }

    #[test]
    fn renders_replace_renders_only() {
        let (_folder, at) = scratch();
        let earlier = |folder: &str, overwrite| earlier_renders(&at(folder), overwrite).map_err(|e| e.to_string());
        let nothing: Vec<PathBuf> = Vec::new();
        assert_eq!(earlier("renders", false), Ok(nothing.clone()));
        image_folder::begin(&at("renders"), &[]).unwrap();
        assert_eq!(earlier("renders", false), Ok(nothing));
        std::fs::write(at("renders/00000.png"), PNG).unwrap();
        std::fs::write(at("renders/100000.png"), PNG).unwrap();
        assert!(earlier("renders", false).unwrap_err().contains("--overwrite"));
        assert_eq!(earlier("renders", true), Ok(vec![at("renders/00000.png"), at("renders/100000.png")]));
        std::fs::write(at("renders/frame_00001.png"), PNG).unwrap();
        assert!(earlier("renders", true).unwrap_err().contains("frame_00001.png is not a render"));
        // Images of a scene have the names of renders, wherever the file that names them lies.
        assert!(earlier("scene/images", false).unwrap_err().contains("--overwrite"));
        assert!(earlier("scene/images", true).unwrap_err().contains("may be those of a dataset"));
        assert!(earlier("scene", true).is_err() && earlier("scene/transforms.json", true).is_err());
    }
}
