//! Which frames of a video were decoded. `ffprobe` lists packets; where one of them gives no image, the images of all later frames would be one too early.

use super::probe::{SAME_TIME, VideoFacts};
use cc4dgs_core::reader::files::file_name;
use cc4dgs_core::{Error, Result};
use std::path::Path;

/// Prints number and time of each frame that passes to standard output. The numbers begin with 0, as those of the filter `select` do.
pub(super) const PRINT_TIMES: &str = "settb=1/1000000,metadata=mode=add:key=cc4dgs:value=1,metadata=mode=print:file=-";
/// Of the median interval: a longer one shows that a frame is missing. Frames that last three fields beside frames of two (films in NTSC) have 1.5.
const LONGEST: f64 = 1.75;

/// The frames that a decoder gave.
#[derive(Debug, PartialEq)]
pub(super) struct Decoded {
    /// Their times in seconds in the order in which they came; NaN where a frame has none.
    pub times: Vec<f64>,
    /// Time of the first frame of another size or pixel format: filters count anew from there, and `times` ends before it.
    pub changed: Option<f64>,
}

impl Decoded {
    /// Reads what [`PRINT_TIMES`] printed.
    pub(super) fn read(printed: &[u8]) -> Self {
        let mut times = Vec::new();
        for line in String::from_utf8_lossy(printed).lines() {
            let Some((number, rest)) = line.strip_prefix("frame:").and_then(|rest| rest.split_once("pts:")) else { continue };
            let stated = rest.split_whitespace().next().and_then(|text| text.parse::<f64>().ok());
            let time = stated.map_or(f64::NAN, |microseconds| microseconds / 1e6);
            if number.trim().parse::<usize>().ok() != Some(times.len()) {
                return Self { times, changed: Some(time) };
            }
            times.push(time);
        }
        Self { times, changed: None }
    }

    /// For each of the first `count` frames of a video the number of its decoded image; `None` where it was not decoded.
    pub(super) fn images(&self, facts: &VideoFacts, count: usize) -> Vec<Option<usize>> {
        let expected = facts.times.get(..count).unwrap_or(&facts.times);
        let found = if facts.is_timed { self.matched(expected) } else { Vec::new() };
        if found.iter().any(Option::is_some) {
            return found;
        }
        // Without times that can be compared, the order counts.
        (0..expected.len()).map(|frame| (frame < self.times.len()).then_some(frame)).collect()
    }

    /// Refuses a video of which image k is not that of frame k, for any k up to `last`. `total` decodes the video to its end and counts its images. It is
    /// called only where the times do not tell.
    ///
    /// Errors: [`Error::Data`] that names the video, the first frame that is wrong and its time; those of `total`.
    pub(super) fn check(&self, video: &Path, facts: &VideoFacts, last: usize, total: impl FnOnce() -> Result<Option<usize>>) -> Result<()> {
        let expected = facts.times.get(..=last).unwrap_or(&facts.times);
        if let Some(time) = self.changed
            && self.times.len() < expected.len()
        {
            let problem = format!("its frames change their size or pixel format at {time:.3} s (frame {})", self.times.len());
            return Err(refused(video, problem, self.times.len(), Some(facts.size)));
        }
        let compared = &self.times[..self.times.len().min(expected.len())];
        let (problem, sound, may_be_right) = if facts.is_timed {
            let found = self.matched(expected);
            let wrong = expected.iter().zip(found).enumerate().find_map(|(frame, (time, image))| (image != Some(frame)).then_some((frame, *time)));
            let Some((frame, time)) = wrong else { return Ok(()) };
            let are_known = self.times.iter().all(|time| contains(&facts.times, *time));
            let problem = match (are_known, self.times.iter().any(|t| (t - time).abs() <= SAME_TIME)) {
                (true, false) => format!("its frame {frame}, at {time:.3} s, does not decode: the file is damaged there"),
                (true, true) => format!("from frame {frame} on, at {time:.3} s, its frames are out of the order of their times, or fewer than its packets"),
                (false, _) => format!("from frame {frame} on, at {time:.3} s, its frames decode at other times than its packets state"),
            };
            (problem, frame, !are_known && is_ascending(&self.times) && is_ascending(&facts.times))
        } else {
            let is_short = compared.len() < expected.len();
            let pause = pause(compared);
            if !is_short && pause.is_none() {
                return Ok(());
            }
            let (problem, sound) = match pause.and_then(|frame| Some((frame, compared.get(frame)?))) {
                Some((frame, time)) => (format!("what follows its frame {frame}, at {time:.3} s, does not decode: the file is damaged there"), frame + 1),
                None => (format!("only {} of its first {} frames decode", compared.len(), expected.len()), compared.len()),
            };
            (problem, sound, !is_short)
        };
        // As many images as frames, each in order: image k is frame k, whatever their clocks.
        if may_be_right && total()? == Some(facts.times.len()) { Ok(()) } else { Err(refused(video, problem, sound, None)) }
    }

    /// For each of the ascending `times` the number of the image that was decoded for it. Images are not taken back: `times` and images go forward together.
    fn matched(&self, times: &[f64]) -> Vec<Option<usize>> {
        let mut next = 0;
        let image_at = |time: &f64| {
            while self.times.get(next).is_some_and(|t| t.is_nan() || *t < time - SAME_TIME) {
                next += 1;
            }
            let found = self.times.get(next).filter(|t| **t <= time + SAME_TIME).map(|_| next);
            next += usize::from(found.is_some());
            found
        };
        times.iter().map(image_at).collect()
    }
}

/// Whether one of the ascending `times` is `time`.
fn contains(times: &[f64], time: f64) -> bool {
    times.get(times.partition_point(|t| *t < time - SAME_TIME)).is_some_and(|t| *t <= time + SAME_TIME)
}

fn is_ascending(times: &[f64]) -> bool {
    times.is_sorted_by(|a, b| a < b)
}

/// The first frame whose distance to the next one is too long for the rate of the frames.
fn pause(times: &[f64]) -> Option<usize> {
    let intervals: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let mut sorted = intervals.clone();
    sorted.sort_by(f64::total_cmp);
    let usual = sorted.get(sorted.len() / 2)?;
    intervals.iter().position(|interval| *interval > LONGEST * usual)
}

/// The error of a video of which only the first `sound` images are known to be those of their frames, and the command that helps: `size` is the one to bring
/// all frames to, where they have several.
fn refused(video: &Path, problem: String, sound: usize, size: Option<[u32; 2]>) -> Error {
    let (name, stem) = (file_name(video), video.file_stem().unwrap_or_default().to_string_lossy());
    let scale = size.map_or_else(String::new, |[width, height]| format!(" -vf scale={width}:{height}"));
    let before = if sound > 0 { ". Or choose frames before (scene.frames)" } else { "" };
    Error::data(
        format!("video {}", video.display()),
        problem,
        format!(
            "Encode it anew (ffmpeg -i {name}{scale} -c:v libx264 -crf 12 -pix_fmt yuv444p OTHER_FOLDER/{stem}.mkv) and put the new file in its place: it has no frames at the \
             times that do not decode{before}"
        ),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn facts(times: &[f64], is_timed: bool) -> VideoFacts {
        VideoFacts { size: [64, 48], times: times.to_vec(), keys: vec![true; times.len()], is_timed, interlaced: false, high_range: false }
    }

    fn decoded(times: &[f64]) -> Decoded {
        Decoded { times: times.to_vec(), changed: None }
    }

    /// The message of a check up to frame `last` of a video, of which `total` images are found where they are counted.
    fn message(times: &[f64], facts: &VideoFacts, last: usize, total: Option<usize>) -> Option<String> {
        decoded(times).check(Path::new("a/cam03.mp4"), facts, last, || Ok(total)).err().map(|error| error.to_string())
    }

    #[test]
    fn printed_times_are_read_until_the_count_begins_anew() {
        let printed = "frame:0    pts:0       pts_time:0\ncc4dgs=1\nframe:1    pts:-40000  pts_time:-0.04\ncc4dgs=1\nframe:2    pts:NOPTS   pts_time:NOPTS\n";
        let read = Decoded::read(printed.as_bytes());
        assert!(read.times.len() == 3 && read.times[..2] == [0.0, -0.04] && read.times[2].is_nan() && read.changed.is_none(), "{read:?}");
        let again = Decoded::read(b"frame:0    pts:1000000 pts_time:1\nframe:0    pts:2000000 pts_time:2\nframe:1    pts:3000000 pts_time:3\n");
        assert_eq!(again, Decoded { times: vec![1.0], changed: Some(2.0) });
        assert_eq!(Decoded::read(b"frame:\xff pts\nno frame\n"), decoded(&[]));
        let error = again.check(Path::new("a.mp4"), &facts(&[1.0, 2.0, 3.0], true), 2, || Ok(None)).unwrap_err().to_string();
        assert!(error.contains("2.000 s (frame 1)") && error.contains("-vf scale=64:48"), "{error}");
        assert!(again.check(Path::new("a.mp4"), &facts(&[1.0, 2.0, 3.0], true), 0, || Ok(None)).is_ok());
    }

    #[test]
    fn lost_frames_are_named_with_their_time() {
        let video = facts(&[0.0, 0.04, 0.08, 0.12, 0.16], true);
        assert_eq!(message(&[0.0, 0.04, 0.08, 0.12, 0.16], &video, 4, None), None);
        assert_eq!(message(&[0.0, 0.04, 0.12], &video, 1, None), None, "nothing that is wanted is damaged");
        let lost = message(&[0.0, 0.04, 0.12, 0.16], &video, 3, Some(5)).unwrap();
        assert!(["a/cam03.mp4", "frame 2, at 0.080 s", "OTHER_FOLDER/cam03.mkv", "scene.frames"].iter().all(|part| lost.contains(part)), "{lost}");
        let first = message(&[0.04, 0.08, 0.12, 0.16], &video, 0, None).unwrap();
        assert!(first.contains("frame 0, at 0.000 s") && !first.contains("scene.frames"), "{first}");
        assert!(message(&[0.0, 0.04, 0.08, 0.12], &video, 4, None).unwrap().contains("frame 4, at 0.160 s"));
        assert!(message(&[], &video, 0, None).unwrap().contains("frame 0"));
        assert_eq!(decoded(&[0.0, 0.04, 0.12]).images(&video, 4), [Some(0), Some(1), None, Some(2)]);
    }

    #[test]
    fn frames_at_one_time_and_times_that_go_back() {
        let twice = facts(&[0.0, 0.04, 0.04, 0.08], true);
        assert_eq!(message(&[0.0, 0.04, 0.04, 0.08], &twice, 3, None), None);
        // Two recordings in one file, both from 0 on.
        let error = message(&[0.0, 0.04, 0.0, 0.04], &facts(&[0.0, 0.0, 0.04, 0.04], true), 3, Some(4)).unwrap();
        assert!(error.contains("out of the order of their times"), "{error}");
    }

    #[test]
    fn times_of_another_clock_are_settled_by_a_count() {
        let video = facts(&[0.0, 0.04, 0.08], true);
        assert_eq!(message(&[1.01, 1.05, 1.09], &video, 2, Some(3)), None);
        assert!(message(&[1.01, 1.05, 1.09], &video, 2, Some(2)).unwrap().contains("at other times"));
        assert!(message(&[1.01, 1.05, 1.03], &video, 2, Some(3)).is_some(), "out of order");
        assert!(message(&[f64::NAN; 3], &video, 2, Some(3)).is_some());
        assert_eq!(decoded(&[1.01, 1.05, 1.09]).images(&video, 3), [Some(0), Some(1), Some(2)]);
    }

    #[test]
    fn without_stated_times_a_pause_is_a_lost_frame() {
        let video = facts(&[0.0, 0.04, 0.08, 0.12, 0.16], false);
        assert_eq!(message(&[0.54, 0.58, 0.62, 0.66, 0.7], &video, 4, None), None);
        let lost = message(&[0.54, 0.58, 0.66, 0.7, 0.74], &video, 4, Some(4)).unwrap();
        assert!(lost.contains("follows its frame 1, at 0.580 s"), "{lost}");
        assert_eq!(message(&[0.54, 0.58, 0.66, 0.7, 0.74], &video, 4, Some(5)), None, "the recording paused");
        assert!(message(&[0.54, 0.58, 0.62, 0.66], &video, 4, Some(4)).unwrap().contains("only 4 of its first 5"));
        // Two fields beside three.
        assert_eq!(message(&[0.0, 0.0334, 0.0834, 0.1168, 0.1668], &video, 4, None), None);
    }
}
