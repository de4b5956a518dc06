//! `cc4dgs render`.

use super::{Context, create_parent, lies_in};
use crate::args::Render;
use crate::models::load_model;
use crate::{interrupt, shots};
use cc4dgs::video::{self, VideoWriter};
use cc4dgs_core::exporter::refuse_existing;
use cc4dgs_core::{Error, Event, EventSink, Result};
use cc4dgs_play::player::Player;
use cc4dgs_train::images::write_png;
use serde::Serialize;
use std::path::{Path, PathBuf};

#[derive(Serialize)]
struct RenderReport {
    model: PathBuf,
    device: String,
    folder: PathBuf,
    frames: usize,
    mp4: Option<PathBuf>,
    /// Means over all frames but the first, which computes what the others reuse.
    frame_ms: Timing,
}

#[derive(Serialize)]
struct Timing {
    field: f64,
    raster: f64,
}

pub fn run(context: &Context, args: &Render) -> Result<()> {
    if let Some(path) = &args.mp4 {
        // Before any frame: an hour of rendering should not end in a missing program.
        video::ffmpeg_version()?;
        refuse_existing(path, args.overwrite)?;
    } else if args.shots.fps.is_some() {
        return Err(Error::parameter("--fps", "it is the rate of a video, and none is asked for", "Leave it out, or add --mp4 F.mp4"));
    }
    let earlier = frames_in(&args.out)?;
    if let Some(frame) = earlier.first().filter(|_| !args.overwrite) {
        let problem = format!("{} is there already, and frames of two commands would mix", frame.display());
        return Err(Error::parameter("--out", problem, "Name another folder, or add --overwrite"));
    }
    if !earlier.is_empty() {
        refuse_images(&args.out, args.shots.scene.as_deref(), |folder| context.registry.readers().iter().any(|reader| (reader.probe)(folder)))?;
    }
    let stop = interrupt::stop_flag()?;
    let events = context.listeners(None)?;
    let loaded = load_model(&args.model, &args.device, &context.registry, &context.limits, &events)?;
    let (shots, background) = shots::choose(context, &args.shots, &args.sets, &loaded.model, true)?;
    if let Some(path) = &args.mp4 {
        create_parent(path)?;
    }
    std::fs::create_dir_all(&args.out).map_err(|e| Error::io(&args.out, e))?;
    earlier.iter().try_for_each(|frame| std::fs::remove_file(frame).map_err(|e| Error::io(frame, e)))?;
    let mut player = Player::new(&loaded.model, &context.registry, &loaded.device)?.on(background);
    let mut video = args.mp4.as_ref().map(|path| VideoWriter::new(path, args.shots.rate()));
    let mut times = Vec::with_capacity(shots.len());
    for (index, (camera, time_norm)) in shots.iter().enumerate() {
        interrupt::check(stop, &format!("after {index} of {} frames in {}", shots.len(), args.out.display()))?;
        let (output, time) = player.render(camera, *time_norm)?;
        let image = player.download(output.planes)?;
        write_png(args.out.join(video::frame_name(index)), &image)?;
        if let Some(video) = &mut video {
            video.add(&image)?;
        }
        times.push(time);
        events.emit(&Event::Progress { task: "render".into(), done: index as u64 + 1, total: shots.len() as u64 });
    }
    if let Some(video) = video {
        video.finish()?;
    }
    let steady = if times.len() > 1 { &times[1..] } else { &times[..] };
    let mean = |pick: fn(&cc4dgs_play::player::FrameTime) -> f64| steady.iter().map(pick).sum::<f64>() / steady.len() as f64;
    let report = RenderReport {
        model: args.model.clone(),
        device: loaded.device_name.clone(),
        folder: args.out.clone(),
        frames: shots.len(),
        mp4: args.mp4.clone(),
        frame_ms: Timing { field: mean(|t| t.field_ms), raster: mean(|t| t.raster_ms) },
    };
    context.output.result(&report, || {
        let video = args.mp4.as_ref().map_or_else(String::new, |p| format!(" and {}", p.display()));
        format!(
            "{} frames in {}{video}; deformer {:.2} + rasterizer {:.2} ms per frame",
            report.frames,
            args.out.display(),
            report.frame_ms.field,
            report.frame_ms.raster
        )
    })
}

/// The frames that an earlier command left in `folder`, by their names; none where there is no such folder.
fn frames_in(folder: &Path) -> Result<Vec<PathBuf>> {
    if !folder.exists() {
        return Ok(Vec::new());
    }
    let is_frame = |name: &str| name.strip_prefix("frame_").and_then(|rest| rest.strip_suffix(".png")).is_some_and(|n| n.parse::<u32>().is_ok());
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| Error::io(folder, e))? {
        let entry = entry.map_err(|e| Error::io(folder, e))?;
        if entry.file_name().to_str().is_some_and(is_frame) {
            found.push(entry.path());
        }
    }
    found.sort();
    Ok(found)
}

/// Refuses to replace frames in the folder of the scene at `scene`, and in that of a dataset (`is_dataset`) or directly below: images have such names, too.
fn refuse_images(folder: &Path, scene: Option<&Path>, is_dataset: impl Fn(&Path) -> bool) -> Result<()> {
    let whole = folder.canonicalize().map_err(|e| Error::io(folder, e))?;
    if scene.is_some_and(|scene| lies_in(folder, scene)) || whole.ancestors().take(2).any(is_dataset) {
        let problem = format!("{} holds frame_NNNNN.png files and lies in the folder of a scene", folder.display());
        return Err(Error::parameter("--out", problem, "Name another folder: images of a scene are never replaced"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_of_a_scene_are_not_replaced() {
        let root = tempfile::tempdir().unwrap();
        let at = |name: &str| root.path().join(name);
        for folder in ["scene/images/left", "frames"] {
            std::fs::create_dir_all(at(folder)).unwrap();
        }
        std::fs::write(at("scene/transforms.json"), "{}").unwrap();
        std::fs::write(at("frames/frame_00001.png"), "").unwrap();
        assert_eq!(frames_in(&at("frames")).unwrap(), [at("frames/frame_00001.png")]);
        let is_dataset = |folder: &Path| folder.join("transforms.json").is_file();
        let check = |folder: &str, scene: Option<&str>| refuse_images(&at(folder), scene.map(at).as_deref(), is_dataset).map_err(|e| e.to_string());
        check("frames", None).unwrap();
        check("frames", Some("scene")).unwrap();
        for scene in ["scene", "scene/transforms.json"] {
            assert!(check("scene/images/left", Some(scene)).unwrap_err().contains("lies in the folder of a scene"));
        }
        // An orbit names no scene.
        assert!(check("scene/images", None).is_err() && check("scene", None).is_err());
    }
}
