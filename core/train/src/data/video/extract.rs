//! Single frames of videos. A video is decoded once, on the first use of one of its frames, into a cache folder.

use super::super::frames::Plan;
use super::decoded::{Decoded, PRINT_TIMES};
use super::probe::{MOST_PRINTED, count_images, probe, turn_of};
use super::{CONSECUTIVE, STREAM, cache_folder, cache_name, input, run};
use cc4dgs_core::{Error, ImageSource, Limits, RawView, Result, SceneOptions};
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// File of a cache folder that says how many images were decoded into it.
const COUNT: &str = "count";
/// The most ranges that a filter lists.
const MOST_RANGES: usize = 300;

/// The frames wanted of one video.
struct Clip {
    wanted: Wanted,
    size: [u32; 2],
    /// Held while the clip is extracted, so that it happens once.
    busy: Mutex<()>,
}

/// Frame numbers of a video.
#[derive(Debug, PartialEq)]
enum Wanted {
    /// An arithmetic progression.
    Progression { first: usize, stride: usize, count: usize },
    /// Ascending ranges, both ends included.
    Ranges(Vec<[usize; 2]>),
}

impl Wanted {
    /// `frames` are ascending and distinct. Frames between them that are not asked for may be included where that keeps the filter short.
    fn new(frames: &[usize]) -> Self {
        let (first, last) = (frames[0], frames[frames.len() - 1]);
        let stride = frames.windows(2).map(|w| w[1] - w[0]).min().unwrap_or(1);
        if frames.windows(2).all(|w| w[1] - w[0] == stride) {
            return Self::Progression { first, stride, count: frames.len() };
        }
        let mut ranges: Vec<[usize; 2]> = Vec::new();
        for &frame in frames {
            match ranges.last_mut() {
                Some(range) if range[1] + 1 == frame => range[1] = frame,
                _ => ranges.push([frame, frame]),
            }
        }
        if ranges.len() <= MOST_RANGES {
            return Self::Ranges(ranges);
        }
        // Gaps that are not a stride: a few images too many instead of a long filter.
        let stride = if frames.iter().all(|f| (f - first).is_multiple_of(stride)) { stride } else { 1 };
        Self::Progression { first, stride, count: (last - first) / stride + 1 }
    }
    fn count(&self) -> usize {
        match self {
            Self::Progression { count, .. } => *count,
            Self::Ranges(ranges) => ranges.iter().map(|r| r[1] - r[0] + 1).sum(),
        }
    }
    /// The highest of the frame numbers.
    fn last(&self) -> usize {
        match self {
            Self::Progression { first, stride, count } => first + stride * count.saturating_sub(1),
            Self::Ranges(ranges) => ranges.last().map_or(0, |range| range[1]),
        }
    }
    /// How many wanted frames come before `frame`, if it is one of them.
    fn rank(&self, frame: usize) -> Option<usize> {
        match self {
            Self::Progression { first, stride, count } => {
                let offset = frame.checked_sub(*first)?;
                (offset.is_multiple_of(*stride) && offset / stride < *count).then_some(offset / stride)
            }
            Self::Ranges(ranges) => {
                let mut before = 0;
                for [low, high] in ranges {
                    if frame < *low {
                        return None;
                    }
                    if frame <= *high {
                        return Some(before + frame - low);
                    }
                    before += high - low + 1;
                }
                None
            }
        }
    }
    /// The condition on the frame number `n` in ffmpeg's language.
    fn condition(&self) -> String {
        match self {
            Self::Progression { first, stride, count } => {
                format!("between(n,{first},{})*not(mod(n-{first},{stride}))", first + stride * (count - 1))
            }
            Self::Ranges(ranges) => ranges.iter().map(|[low, high]| format!("between(n,{low},{high})")).collect::<Vec<_>>().join("+"),
        }
    }
}

/// All videos of a scene.
#[derive(Default)]
pub(crate) struct VideoFrames {
    clips: BTreeMap<PathBuf, Clip>,
    options: SceneOptions,
    limits: Limits,
}

impl VideoFrames {
    /// Collects which frames of which videos the views want.
    pub(crate) fn new(views: &[RawView], plans: &[Plan], options: &SceneOptions, limits: &Limits) -> Result<Self> {
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
            clips.insert(path, Clip { wanted: Wanted::new(&frames), size: plan_size(&plans[camera]), busy: Mutex::new(()) });
        }
        Ok(Self { clips, options: options.clone(), limits: *limits })
    }
    /// The size extracted frames have.
    pub(crate) fn size(&self, plan: &Plan) -> [u32; 2] {
        plan_size(plan)
    }
    /// The file of frame `frame` of `video`; decodes the video if that has not happened.
    ///
    /// Errors: [`Error::Data`] for a video of which frames up to the last wanted one do not decode, [`Error::Io`] for a cache that cannot be written.
    pub(crate) fn extract(&self, video: &Path, frame: usize) -> Result<PathBuf> {
        let bug = || Error::parameter(format!("video {}", video.display()), format!("frame {frame} was not asked for"), "Reopen the scene");
        let clip = self.clips.get(video).ok_or_else(bug)?;
        let rank = clip.wanted.rank(frame).ok_or_else(bug)?;
        // Older caches, of images that were matched by their order alone, have names without "by time".
        let what = format!("rgb24 by time|{}|{:?}", clip.wanted.condition(), clip.size);
        let folder = cache_folder(&self.options)?.join(cache_name(video, &what)?);
        // A poisoned lock only means that another extraction failed; this one may do better.
        let _guard = clip.busy.lock().unwrap_or_else(|e| e.into_inner());
        let file = folder.join(format!("{:06}.png", rank + 1));
        // Whoever cleans a cache may leave a part of it. Where images are fewer than frames, it is not known whose they are.
        if !file.is_file() || decoded_count(&folder) != Some(clip.wanted.count()) {
            if folder.is_dir() {
                std::fs::remove_dir_all(&folder).map_err(|e| Error::io(&folder, e))?;
            }
            self.decode(video, clip, &folder)?;
        }
        Ok(file)
    }

    fn decode(&self, video: &Path, clip: &Clip, folder: &Path) -> Result<()> {
        let cache = cache_folder(&self.options)?;
        std::fs::create_dir_all(&cache).map_err(|e| Error::io(&cache, e))?;
        let work = tempfile::tempdir_in(&cache).map_err(|e| Error::io(&cache, e))?;
        let facts = probe(video, &self.options, &self.limits)?;
        // The display matrix is applied here, because versions of ffmpeg differ in what they do with it.
        let turn = turn_of(video, &self.options)?.filter;
        let turn = if turn.is_empty() { String::new() } else { format!("{turn},") };
        let (condition, [width, height]) = (clip.wanted.condition(), clip.size);
        let filter = format!("{PRINT_TIMES},select='{condition}',{turn}{CONSECUTIVE},scale={width}:{height}:flags=lanczos,format=rgb24");
        // In a pattern, a percent sign of the folder's name is written twice.
        let outputs = work.path().to_str().map_or_else(|| work.path().to_path_buf(), |folder| PathBuf::from(folder.replace('%', "%%")));
        let (video_input, count, pattern) = (input(video), clip.wanted.count().to_string(), outputs.join("%06d.png"));
        // The times of the packets as they are: by default ffmpeg subtracts that at which the file starts.
        let before = ["-nostdin", "-v", "error", "-copyts", "-noautorotate", "-protocol_whitelist", "file", "-i"];
        let map = format!("0:{STREAM}");
        let after = ["-map", &map, "-vf", &filter, "-r", "25", "-frames:v", &count];
        let mut arguments = before.map(OsStr::new).to_vec();
        arguments.push(&video_input);
        arguments.extend(after.map(OsStr::new));
        arguments.push(pattern.as_os_str());
        let printed = run(&self.options.ffmpeg, &arguments, video, MOST_PRINTED, Some(&cache))?;
        let decoded = std::fs::read_dir(work.path()).map_err(|e| Error::io(work.path(), e))?.count();
        let frames = Decoded::read(&printed);
        // Where images are missing, the video was decoded to its end.
        let total = || if decoded < clip.wanted.count() { Ok(Some(frames.times.len())) } else { count_images(video, &self.options) };
        frames.check(video, &facts, clip.wanted.last(), total)?;
        if decoded != clip.wanted.count() {
            let problem = format!("{decoded} of {count} wanted frames were decoded");
            return Err(Error::data(format!("video {}", video.display()), problem, "Check the video, or shorten scene.frames"));
        }
        let counted = work.path().join(COUNT);
        std::fs::write(&counted, decoded.to_string()).map_err(|e| Error::io(&counted, e))?;
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

/// How many images the video gave, as [`VideoFrames`] noted it; `None` if it did not.
fn decoded_count(folder: &Path) -> Option<usize> {
    std::fs::read_to_string(folder.join(COUNT)).ok()?.parse().ok()
}

/// ffmpeg scales as it extracts: to the final size, or to the one at which a lens is undone.
fn plan_size(plan: &Plan) -> [u32; 2] {
    if plan.undistort.is_some() { plan.native } else { [plan.output.0, plan.output.1] }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wanted_frames_are_found_by_rank() {
        let irregular: Vec<usize> = (0..2000).map(|k| k * 5 / 2).collect();
        for frames in [vec![7], vec![3, 5, 7], vec![0, 1, 2, 6, 7, 20], irregular] {
            let wanted = Wanted::new(&frames);
            let ranks: Vec<usize> = frames.iter().map(|f| wanted.rank(*f).unwrap()).collect();
            assert!(ranks.is_sorted_by(|a, b| a < b) && *ranks.last().unwrap() == wanted.count() - 1, "{wanted:?}");
            assert!(wanted.rank(frames[frames.len() - 1] + 1).is_none() && wanted.last() == frames[frames.len() - 1], "{wanted:?}");
        }
        assert_eq!(Wanted::new(&[3, 5, 7]).condition(), "between(n,3,7)*not(mod(n-3,2))");
        let gaps = Wanted::new(&[0, 1, 2, 6, 7, 20]);
        assert_eq!((gaps.condition().as_str(), gaps.rank(4), gaps.rank(6)), ("between(n,0,2)+between(n,6,7)+between(n,20,20)", None, Some(3)));
    }
}
