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
use std::collections::BTreeSet;
use std::ffi::{OsStr, OsString};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

/// The first video stream that is not a cover image.
const STREAM: &str = "V:0";
/// Brings selected frames to consecutive times, whatever their own: with an output rate of 25, no version of ffmpeg repeats or drops any.
const CONSECUTIVE: &str = "settb=1/25,setpts=N";
/// What helps where videos cannot be read.
const EXTRACT: &str = "extract the frames yourself: into a folder per camera (cam00/0000.png …) beside poses_bounds.npy, else as images that a transforms.json names, \
                       each with its \"time\"";
/// The most bytes of messages that are read from a command.
const MESSAGES: u64 = 1 << 16;

/// Whether [`answers_interrupts`] was called.
static ANSWERS_INTERRUPTS: AtomicBool = AtomicBool::new(false);

/// Says that this program goes on after Ctrl-C, to stop at a safe point: Ctrl-C then does not reach ffmpeg, and a video that is being decoded is decoded to its
/// end. Without this call Ctrl-C ends ffmpeg together with the program. Else ffmpeg would go on alone, and its frames would stay in the cache without a use.
pub fn answers_interrupts() {
    ANSWERS_INTERRUPTS.store(true, Ordering::Relaxed);
}

/// The processes that [`run`] waits for.
static RUNNING: Mutex<BTreeSet<u32>> = Mutex::new(BTreeSet::new());

/// Asks all ffmpeg processes that decode videos to end. A program that [`answers_interrupts`] calls it before it ends at once, because they would go on alone.
pub fn end_commands() {
    RUNNING.lock().unwrap_or_else(PoisonError::into_inner).iter().for_each(|id| ask_to_end(*id));
}

#[cfg(unix)]
fn ask_to_end(id: u32) {
    // A process that has just ended cannot be asked.
    Command::new("sh").args(["-c", "kill \"$0\"", &id.to_string()]).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).status().ok();
}

/// Ctrl-C reaches them there.
#[cfg(not(unix))]
fn ask_to_end(_: u32) {}

/// A process while it is in [`RUNNING`].
struct Listed(u32);

impl Listed {
    fn new(id: u32) -> Self {
        RUNNING.lock().unwrap_or_else(PoisonError::into_inner).insert(id);
        Self(id)
    }
}

impl Drop for Listed {
    fn drop(&mut self) {
        RUNNING.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.0);
    }
}

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
    // Where this program answers Ctrl-C, it ends after the video.
    #[cfg(unix)]
    if ANSWERS_INTERRUPTS.load(Ordering::Relaxed) {
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
    }
    let mut child = command.spawn().map_err(|e| {
        Error::unsupported(
            object(),
            format!("the command {program} could not be started ({e})"),
            format!("Install ffmpeg, set scene.ffmpeg to its path, or {EXTRACT}"),
        )
    })?;
    let listed = Listed::new(child.id());
    let mut printed = Vec::new();
    let read = child.stdout.take().map_or(Ok(0), |pipe| pipe.take(most.saturating_add(1)).read_to_end(&mut printed));
    // Before it is waited for: after that, another process may have its number.
    drop(listed);
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

#[cfg(test)]
mod tests {
    #[cfg(target_os = "linux")]
    #[test]
    fn interrupts_reach_commands_unless_the_program_answers_them() {
        use super::*;
        let group_of_command = || {
            let script = OsStr::new("cut -d ' ' -f 5 /proc/$$/stat");
            let printed = run("sh", &[OsStr::new("-c"), script], Path::new("a.mp4"), 100, None).unwrap();
            String::from_utf8(printed).unwrap().trim().to_string()
        };
        let status = std::fs::read_to_string("/proc/self/stat").unwrap();
        // State, parent and group follow the name of the program, which is in parentheses.
        let own = status.rsplit(')').next().unwrap().split_whitespace().nth(2).unwrap().to_string();
        assert_eq!(group_of_command(), own);
        answers_interrupts();
        assert_ne!(group_of_command(), own);
        ANSWERS_INTERRUPTS.store(false, Ordering::Relaxed);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn commands_that_are_waited_for_can_be_ended() {
        use super::*;
        use std::time::{Duration, Instant};
        let seconds = "61.25";
        let waiting = std::thread::spawn(move || run("sleep", &[OsStr::new(seconds)], Path::new("a.mp4"), 100, None));
        // Other tests have commands, too.
        let is_ours = |id: &u32| std::fs::read(format!("/proc/{id}/cmdline")).is_ok_and(|line| String::from_utf8_lossy(&line).contains(seconds));
        let find = || RUNNING.lock().unwrap_or_else(PoisonError::into_inner).iter().copied().find(is_ours);
        let began = Instant::now();
        let id = loop {
            match find() {
                Some(id) => break id,
                None => assert!(began.elapsed() < Duration::from_secs(30), "the command is not listed"),
            }
            std::thread::sleep(Duration::from_millis(5));
        };
        ask_to_end(id);
        assert!(waiting.join().unwrap().is_err() && began.elapsed() < Duration::from_secs(50));
        assert!(find().is_none(), "what has ended is not listed");
    }
}
