//! Frames of videos, through the `ffmpeg` command. A video is decoded once, on the first use of one of its frames, into a cache folder.

use super::frames::Plan;
use cc4dgs_core::{Error, ImageSource, RawView, Result, SceneOptions, Seed};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;

/// What `ffprobe` says about a video.
pub(crate) struct VideoFacts {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Number of frames.
    pub frames: usize,
}

/// The frames wanted of one video, an arithmetic progression.
struct Clip {
    first: usize,
    stride: usize,
    count: usize,
    size: [u32; 2],
    /// Held while the clip is extracted, so that it happens once.
    busy: Mutex<()>,
}

/// All videos of a scene.
#[derive(Default)]
pub(super) struct VideoFrames {
    clips: BTreeMap<PathBuf, Clip>,
    ffmpeg: String,
    cache: PathBuf,
}

fn run(program: &str, arguments: &[&str], video: &Path) -> Result<String> {
    let output = Command::new(program).args(arguments).stdin(Stdio::null()).output().map_err(|e| {
        Error::unsupported(
            format!("video {}", video.display()),
            format!("the command {program} could not be started ({e})"),
            "Install ffmpeg, set scene.ffmpeg to its path, or extract the frames to one folder per camera (cam00/0000.png …)",
        )
    })?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        let last = said.lines().rev().find(|l| !l.trim().is_empty()).unwrap_or("no message").chars().take(300).collect::<String>();
        return Err(Error::data(format!("video {}", video.display()), format!("{program} failed: {last}"), "Check the video, or extract its frames yourself"));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Size and number of frames. Packets are counted, not decoded.
pub(crate) fn probe(video: &Path, options: &SceneOptions) -> Result<VideoFacts> {
    let ffprobe = match options.ffmpeg.strip_suffix("ffmpeg") {
        Some(folder) => format!("{folder}ffprobe"),
        None => "ffprobe".into(),
    };
    let path = video.to_string_lossy();
    let arguments =
        ["-v", "error", "-select_streams", "v:0", "-count_packets", "-show_entries", "stream=width,height,nb_read_packets", "-of", "csv=p=0", path.as_ref()];
    let said = run(&ffprobe, &arguments, video)?;
    let numbers: Vec<u64> = said.trim().split(',').filter_map(|t| t.trim().parse().ok()).collect();
    match numbers[..] {
        [w, h, frames] if (1..=1 << 16).contains(&w) && (1..=1 << 16).contains(&h) && (1..=1 << 32).contains(&frames) => {
            Ok(VideoFacts { size: [w as u32, h as u32], frames: frames as usize })
        }
        _ => Err(Error::data(format!("video {}", video.display()), format!("ffprobe said {:?}", said.trim()), "Check the video")),
    }
}

impl VideoFrames {
    /// Collects which frames of which videos the views want.
    pub(super) fn new(views: &[RawView], plans: &[Plan], options: &SceneOptions) -> Result<Self> {
        let mut wanted: BTreeMap<PathBuf, (Vec<usize>, usize)> = BTreeMap::new();
        for view in views {
            if let ImageSource::Video { path, frame } = &view.image {
                wanted.entry(path.clone()).or_insert_with(|| (Vec::new(), view.camera)).0.push(*frame);
            }
        }
        let mut clips = BTreeMap::new();
        for (path, (mut frames, camera)) in wanted {
            frames.sort_unstable();
            frames.dedup();
            let (first, last) = (frames[0], frames[frames.len() - 1]);
            // Gaps that are not a stride (scene.max_views) are extracted too: a few images too many instead of a long filter.
            let stride = frames.windows(2).map(|w| w[1] - w[0]).min().unwrap_or(1);
            let stride = if frames.iter().all(|f| (f - first).is_multiple_of(stride)) { stride } else { 1 };
            clips.insert(path, Clip { first, stride, count: (last - first) / stride + 1, size: plan_size(&plans[camera]), busy: Mutex::new(()) });
        }
        let cache = options.video_cache.clone().unwrap_or_else(|| std::env::temp_dir().join("cc4dgs-frames"));
        Ok(Self { clips, ffmpeg: options.ffmpeg.clone(), cache })
    }
    /// The size extracted frames have.
    pub(super) fn size(&self, plan: &Plan) -> [u32; 2] {
        plan_size(plan)
    }
    /// The file of frame `frame` of `video`; decodes the video if that has not happened.
    pub(super) fn extract(&self, video: &Path, frame: usize) -> Result<PathBuf> {
        let bug = || Error::parameter(format!("video {}", video.display()), format!("frame {frame} was not asked for"), "Reopen the scene");
        let clip = self.clips.get(video).ok_or_else(bug)?;
        let rank = frame.checked_sub(clip.first).ok_or_else(bug)? / clip.stride;
        let folder = self.folder(video, clip)?;
        // A poisoned lock only means that another extraction failed; this one may do better.
        let _guard = clip.busy.lock().unwrap_or_else(|e| e.into_inner());
        if !folder.is_dir() {
            self.decode(video, clip, &folder)?;
        }
        let file = folder.join(format!("{:06}.png", rank + 1));
        if !file.is_file() {
            return Err(Error::data(format!("video {}", video.display()), format!("it has no frame {frame}"), "Shorten scene.frames"));
        }
        Ok(file)
    }

    /// A folder name that changes with the video and with what is taken from it.
    fn folder(&self, video: &Path, clip: &Clip) -> Result<PathBuf> {
        let full = video.canonicalize().map_err(|e| Error::io(video, e))?;
        let meta = std::fs::metadata(&full).map_err(|e| Error::io(video, e))?;
        let modified = meta.modified().ok().and_then(|t| t.duration_since(std::time::UNIX_EPOCH).ok()).map(|d| d.as_nanos()).unwrap_or(0);
        let facts = format!("{}|{}|{modified}|{}|{}|{}|{:?}", full.display(), meta.len(), clip.first, clip.stride, clip.count, clip.size);
        let mut key = Seed::root(0);
        key = key.child(&facts);
        let stem = video.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        Ok(self.cache.join(format!("{stem}-{:016x}", key.value())))
    }

    fn decode(&self, video: &Path, clip: &Clip, folder: &Path) -> Result<()> {
        std::fs::create_dir_all(&self.cache).map_err(|e| Error::io(&self.cache, e))?;
        let work = tempfile::tempdir_in(&self.cache).map_err(|e| Error::io(&self.cache, e))?;
        let last = clip.first + clip.stride * (clip.count - 1);
        // Consecutive timestamps keep ffmpeg from filling the gaps the selection leaves.
        let filter = format!(
            "select='between(n,{},{last})*not(mod(n-{},{}))',setpts=N/FRAME_RATE/TB,scale={}:{}:flags=lanczos",
            clip.first, clip.first, clip.stride, clip.size[0], clip.size[1]
        );
        let (input, count, pattern) = (video.to_string_lossy(), clip.count.to_string(), work.path().join("%06d.png"));
        let pattern = pattern.to_string_lossy();
        run(&self.ffmpeg, &["-nostdin", "-v", "error", "-i", input.as_ref(), "-map", "0:v:0", "-vf", &filter, "-frames:v", &count, pattern.as_ref()], video)?;
        let kept = work.keep();
        if let Err(e) = std::fs::rename(&kept, folder) {
            let _ = std::fs::remove_dir_all(&kept);
            // Another process may have finished first.
            if !folder.is_dir() {
                return Err(Error::io(folder, e));
            }
        }
        Ok(())
    }
}

/// ffmpeg scales as it extracts, unless a lens has to be undone at the native size first.
fn plan_size(plan: &Plan) -> [u32; 2] {
    if plan.undistort.is_some() { plan.native } else { [plan.output.0, plan.output.1] }
}
