//! Videos through the `ffmpeg` and `ffprobe` commands: what they contain ([`probe`]), their frames on a common clock ([`footage`]), extraction of
//! single frames ([`VideoFrames`]), which frames decode ([`decoded`]), and the motion in them over time ([`motion`]).

mod decoded;
mod extract;
mod motion;
mod probe;
mod timeline;

pub(super) use extract::VideoFrames;
pub(super) use motion::motion;
pub(super) use probe::{VideoFacts, probe};
use timeline::timeline;

use cc4dgs_core::reader::files::{file_name, has_extension};
use cc4dgs_core::{Error, ImageSource, Limits, Result, SceneOptions, Seed, plural};
use std::ffi::{OsStr, OsString};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// The first video stream that is not a cover image.
const STREAM: &str = "V:0";
/// Brings selected frames to consecutive times, whatever their own: with an output rate of 25, no version of ffmpeg repeats or drops any.
const CONSECUTIVE: &str = "settb=1/25,setpts=N";
/// What helps where videos cannot be read.
const EXTRACT: &str = "extract the frames yourself: into a folder per camera (cam00/0000.png …) beside poses_bounds.npy, else as images that a transforms.json names, \
                       each with its \"time\"";
/// The most bytes of messages that are read from a command.
const MESSAGES: u64 = 1 << 16;

/// The endings of videos, in lower case: of the containers that cameras and programs write and ffmpeg reads.
pub(super) const ENDINGS: [&str; 16] = ["3gp", "avi", "flv", "m2ts", "m4v", "mkv", "mov", "mp4", "mpeg", "mpg", "mts", "mxf", "ogv", "ts", "webm", "wmv"];

/// Whether the extension is that of a video.
pub(super) fn is_video(path: &Path) -> bool {
    has_extension(path, &ENDINGS)
}

/// A video on the clock of its scene.
pub(super) struct Footage {
    /// Width and height in pixels, as displayed.
    pub size: [u32; 2],
    /// Its image at each instant; `None` where it has no frame near enough.
    pub images: Vec<Option<ImageSource>>,
}

/// The images of the videos of one scene at common instants, so that image k of every video shows the same moment as far as their timestamps say.
///
/// Errors: [`Error::Data`] for files that are no videos, [`Error::Limit`] for frames over the limits, [`Error::Unsupported`] without `ffprobe`.
pub(super) fn footage(videos: &[PathBuf], options: &SceneOptions, limits: &Limits, warnings: &mut Vec<String>) -> Result<Vec<Footage>> {
    if videos.is_empty() {
        return Ok(Vec::new());
    }
    let facts = videos.iter().map(|v| probe(v, options, limits)).collect::<Result<Vec<VideoFacts>>>()?;
    let names: Vec<String> = videos.iter().map(|v| file_name(v)).collect();
    let times: Vec<&[f64]> = facts.iter().map(|f| f.times.as_slice()).collect();
    let common = timeline(&names, &times);
    warnings.extend(common.notes);
    warnings.extend(of_two_moments(&names, &facts));
    warnings.extend(of_high_range(&names, &facts));
    let sources = |(video, frames): (&PathBuf, Vec<Option<usize>>)| -> Vec<Option<ImageSource>> {
        frames.into_iter().map(|frame| frame.map(|frame| ImageSource::Video { path: video.clone(), frame })).collect()
    };
    Ok(facts.iter().zip(videos.iter().zip(common.frames)).map(|(f, found)| Footage { size: f.size, images: sources(found) }).collect())
}

/// A warning of the videos whose frames show two moments each, and what helps; `None` where there are none.
fn of_two_moments(names: &[String], facts: &[VideoFacts]) -> Option<String> {
    let interlaced: Vec<&str> = names.iter().zip(facts).filter(|(_, facts)| facts.interlaced).map(|(name, _)| name.as_str()).collect();
    let first = interlaced.first()?;
    let stem = Path::new(first).file_stem().unwrap_or_default().to_string_lossy();
    Some(format!(
        "interlaced frames in {} of {} {} ({first}{}): the odd and the even rows of a frame show different moments, so what moves has combed edges. \
         Deinterlace each (ffmpeg -i {first} -vf yadif -c:v libx264 -crf 12 OTHER_FOLDER/{stem}.mp4) and put the new files in their place",
        interlaced.len(),
        names.len(),
        plural(names.len(), "video", "videos"),
        if interlaced.len() > 1 { " and others" } else { "" }
    ))
}

/// A warning of the videos with colours of high dynamic range, and what helps; `None` where there are none.
fn of_high_range(names: &[String], facts: &[VideoFacts]) -> Option<String> {
    let high: Vec<&str> = names.iter().zip(facts).filter(|(_, facts)| facts.high_range).map(|(name, _)| name.as_str()).collect();
    let first = high.first()?;
    let stem = Path::new(first).file_stem().unwrap_or_default().to_string_lossy();
    Some(format!(
        "colours of high dynamic range (PQ or HLG) in {} of {} {} ({first}{}): they are taken as they are stored, so images are pale, and differ from those of \
         other videos. Convert each (ffmpeg -i {first} -vf zscale=t=linear:npl=100,format=gbrpf32le,tonemap=hable:desat=0,zscale=p=bt709:t=bt709:m=bt709:r=tv,\
         format=yuv420p -c:v libx264 -crf 12 OTHER_FOLDER/{stem}.mp4) and put the new files in their place",
        high.len(),
        names.len(),
        plural(names.len(), "video", "videos"),
        if high.len() > 1 { " and others" } else { "" }
    ))
}

/// A path as an input or output of ffmpeg: never an address or an option, whatever its name.
fn input(path: &Path) -> OsString {
    let mut text = OsString::from("file:");
    text.push(path);
    text
}

/// The folder for what is computed from videos.
fn cache_folder(options: &SceneOptions) -> Result<PathBuf> {
    options.video_cache.clone().map_or_else(usual_cache_folder, Ok)
}

/// A folder for temporary files that is the user's alone: on a shared machine everyone may write beside it.
#[cfg(unix)]
fn usual_cache_folder() -> Result<PathBuf> {
    use std::os::unix::fs::{DirBuilderExt, MetadataExt};
    let base = std::env::temp_dir();
    let user = tempfile::tempfile().and_then(|file| file.metadata()).map_err(|e| Error::io(&base, e))?.uid();
    let folder = base.join(format!("cc4dgs-frames-{user}"));
    let failed = |e| Error::io(&folder, e);
    std::fs::DirBuilder::new().recursive(true).mode(0o700).create(&folder).map_err(failed)?;
    if std::fs::symlink_metadata(&folder).map_err(failed)?.uid() == user {
        return Ok(folder);
    }
    Err(Error::parameter("scene.video_cache", format!("{} belongs to another user", folder.display()), "Name a folder of your own for the frames of videos"))
}

#[cfg(not(unix))]
fn usual_cache_folder() -> Result<PathBuf> {
    Ok(std::env::temp_dir().join("cc4dgs-frames"))
}

/// A name in the cache that changes with the video and with `what` is computed from it.
fn cache_name(video: &Path, what: &str) -> Result<String> {
    let full = video.canonicalize().map_err(|e| Error::io(video, e))?;
    let meta = std::fs::metadata(&full).map_err(|e| Error::io(video, e))?;
    let modified = meta.modified().ok().and_then(|t| t.duration_since(std::time::UNIX_EPOCH).ok()).map(|d| d.as_nanos()).unwrap_or(0);
    let key = Seed::root(0).child(&format!("{}|{}|{modified}|{what}", full.display(), meta.len()));
    // With the key, a long name would be too long for a file.
    let stem: String = video.file_stem().map(|s| s.to_string_lossy().chars().take(48).collect()).unwrap_or_default();
    Ok(format!("{stem}-{:016x}", key.value()))
}

/// Runs a command to its end and returns what it prints, at most `most` bytes. `writes` is the folder of the cache that it writes files into, if it does.
fn run(program: &str, arguments: &[&OsStr], video: &Path, most: u64, writes: Option<&Path>) -> Result<Vec<u8>> {
    let object = || format!("video {}", video.display());
    let failed = |e: std::io::Error| Error::io(video, e);
    // A file, because a pipe that nobody reads would stop the command.
    let mut messages = tempfile::tempfile().map_err(failed)?;
    let stderr = messages.try_clone().map_err(failed)?;
    let mut command = Command::new(program);
    command.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(stderr);
    // Ctrl-C is for this program, which ends after the video.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    let mut child = command.spawn().map_err(|e| {
        Error::unsupported(
            object(),
            format!("the command {program} could not be started ({e})"),
            format!("Install ffmpeg, set scene.ffmpeg to its path, or {EXTRACT}"),
        )
    })?;
    let mut printed = Vec::new();
    let read = child.stdout.take().map_or(Ok(0), |pipe| pipe.take(most.saturating_add(1)).read_to_end(&mut printed));
    if read.is_err() || printed.len() as u64 > most {
        let _ = child.kill();
        let _ = child.wait();
        read.map_err(failed)?;
        return Err(Error::limit(format!("{}: output of {program}", object()), most.saturating_add(1), most, "Cut the video into shorter ones"));
    }
    let status = child.wait().map_err(failed)?;
    if !status.success() {
        let end = messages.seek(SeekFrom::End(0)).map_err(failed)?;
        messages.seek(SeekFrom::Start(end.saturating_sub(MESSAGES))).map_err(failed)?;
        let mut said = Vec::new();
        messages.take(MESSAGES).read_to_end(&mut said).map_err(failed)?;
        let said = String::from_utf8_lossy(&said);
        let last = said.lines().rev().find(|l| !l.trim().is_empty()).unwrap_or("no message").chars().take(300).collect::<String>();
        let remedy = match writes {
            Some(cache) => {
                format!("Check that {} can be written and has space (scene.video_cache names another folder), and the video; or {EXTRACT}", cache.display())
            }
            None => format!("Check the video, or {EXTRACT}"),
        };
        return Err(Error::data(object(), format!("{program} failed: {last}"), remedy));
    }
    Ok(printed)
}
