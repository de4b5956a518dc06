//! `cc4dgs render`.

use super::{Context, check_file, create_parent, image_folder};
use crate::args::Render;
use crate::ignored::{Stated, refuse_ignored};
use crate::models::load_model;
use crate::{interrupt, shots};
use cc4dgs::video::{self, VideoWriter};
use cc4dgs_core::{Error, Event, EventSink, Result, plural};
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
        check_video(path, args.overwrite)?;
        video::ffmpeg_version()?;
    }
    let (value, remedy) = (args.shots.fps.map(|rate| rate.to_string()), "Leave it out, or add --mp4 F.mp4".into());
    refuse_ignored("frames without a video", [Stated { option: "--fps", value, used: args.mp4.is_some(), remedy }])?;
    shots::check_up(&args.shots)?;
    let earlier = earlier_frames(&args.out, args.overwrite)?;
    let stop = interrupt::stop_flag()?;
    let events = context.listeners(None)?;
    let loaded = load_model(&args.model, &args.device, &context.registry, &context.limits, &events)?;
    let (shots, background) = shots::choose(context, &args.shots, &args.sets, &loaded.model, true)?;
    if let Some(path) = &args.mp4 {
        video::check_sizes("--mp4", &shots)?;
        create_parent(path)?;
    }
    image_folder::begin(&args.out, &earlier)?;
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
            "{} {} in {}{video}; deformer {:.2} + rasterizer {:.2} ms per frame",
            report.frames,
            plural(report.frames, "frame", "frames"),
            args.out.display(),
            report.frame_ms.field,
            report.frame_ms.raster
        )
    })
}

/// Refuses a `video` by whose ending other programs take it for another format, and one that cannot be written.
fn check_video(video: &Path, overwrite: bool) -> Result<()> {
    if video.extension().is_none_or(|ending| !ending.eq_ignore_ascii_case("mp4")) {
        let remedy = format!("Name it {}", video.with_extension("mp4").display());
        return Err(Error::parameter(format!("--mp4 {}", video.display()), "the video is an MP4 file, whose name ends in .mp4", remedy));
    }
    check_file(video, overwrite)
}

/// The frames that an earlier command left in `folder`, by their names. They are refused without `overwrite`; with it, where no command marked the folder: they
/// may be images of a dataset.
fn earlier_frames(folder: &Path, overwrite: bool) -> Result<Vec<PathBuf>> {
    let is_frame = |name: &str| name.strip_prefix("frame_").and_then(|rest| rest.strip_suffix(".png")).is_some_and(|n| n.parse::<u32>().is_ok());
    let mut found = image_folder::entries(folder)?;
    found.retain(|path| path.file_name().and_then(|name| name.to_str()).is_some_and(is_frame));
    let Some(frame) = found.first() else { return Ok(found) };
    if !overwrite {
        let problem = format!("{} is there already, and frames of two commands would mix", frame.display());
        return Err(Error::parameter("--out", problem, "Name another folder, or add --overwrite"));
    }
    image_folder::refuse_unmarked("--out", folder)?;
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn videos_are_named_as_what_they_are() {
        let folder = tempfile::tempdir().unwrap();
        let check = |name: &str| check_video(&folder.path().join(name), false).map_err(|e| e.to_string());
        assert_eq!((check("a.mp4"), check("new/a.MP4")), (Ok(()), Ok(())));
        for name in ["a.avi", "a"] {
            let message = check(name).unwrap_err();
            assert!(message.contains("--mp4") && message.contains(name) && message.contains("a.mp4"), "{message}");
        }
        assert!(check("a.mp4/").unwrap_err().contains("ends with a separator"));
    }

    #[test]
    fn frames_replace_frames_only() {
        let root = tempfile::tempdir().unwrap();
        let at = |name: &str| root.path().join(name);
        let earlier = |folder: &str, overwrite| earlier_frames(&at(folder), overwrite).map_err(|e| e.to_string());
        let nothing: Vec<PathBuf> = Vec::new();
        // A dataset three folders up, and one whose file lies beside the folder: neither has to be found.
        for folder in ["cap/images/cam0", "cap/images"] {
            std::fs::create_dir_all(at(folder)).unwrap();
            assert_eq!(earlier(folder, false), Ok(nothing.clone()));
            std::fs::write(at(folder).join("frame_00001.png"), "").unwrap();
            assert!(earlier(folder, false).unwrap_err().contains("--overwrite"));
            let message = earlier(folder, true).unwrap_err();
            assert!(message.contains(folder) && message.contains("may be those of a dataset") && message.contains("Name another folder"), "{message}");
        }
        // A folder of an earlier command.
        assert_eq!(earlier("frames", true), Ok(nothing));
        image_folder::begin(&at("frames"), &[]).unwrap();
        ["frame_00001.png", "frame_00000.png", "frame_x.png", "00001.png"].iter().for_each(|name| std::fs::write(at("frames").join(name), "").unwrap());
        assert!(earlier("frames", false).unwrap_err().contains("--overwrite"));
        assert_eq!(earlier("frames", true), Ok(vec![at("frames/frame_00000.png"), at("frames/frame_00001.png")]));
    }
}
