//! What a video contains, as `ffprobe` says: size, orientation, times of the frames. Packets are listed, not decoded.

use super::{STREAM, input, run};
use cc4dgs_core::{Error, Limits, Result, SceneOptions};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;

/// The most that is read of the list of packets or frames: days of video.
pub(super) const MOST_PRINTED: u64 = 1 << 28;
/// Tangent of one degree. ffmpeg takes angles that near to a multiple of 90 degrees as that multiple, and so do we.
const TAN_ONE_DEGREE: f64 = 0.017_455;
/// The rate of a video that states none. It cancels out where all videos of a scene state none.
const DEFAULT_RATE: f64 = 25.0;

/// Packets among which the first key frame of a video is looked for that does not begin with one: those of ten seconds at 30 frames per second.
const MOST_LEADING: usize = 300;

/// Difference of times in seconds that is rounding.
pub(super) const SAME_TIME: f64 = 1e-4;

/// What `ffprobe` says about a video.
#[derive(Clone)]
pub(crate) struct VideoFacts {
    /// Width and height in pixels, as displayed.
    pub size: [u32; 2],
    /// Presentation times of the decoded frames in seconds, ascending.
    pub times: Vec<f64>,
    /// Whether each frame is a key frame.
    pub keys: Vec<bool>,
    /// Whether the file states the times of all frames. Else `times` are those of a constant rate, from 0 on.
    pub is_timed: bool,
    /// Whether each frame holds two fields of different moments, every second row of one.
    pub interlaced: bool,
    /// Whether its colours are those of high dynamic range: PQ or HLG.
    pub high_range: bool,
}

/// One of the eight orientations of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Turn {
    /// The ffmpeg filter that does it; empty for upright frames.
    pub filter: &'static str,
    /// Whether width and height change places.
    pub swaps: bool,
}

#[derive(Deserialize)]
struct Printed {
    #[serde(default)]
    packets: Vec<Packet>,
    #[serde(default)]
    streams: Vec<Stream>,
    #[serde(default)]
    frames: Vec<Frame>,
}

#[derive(Deserialize)]
struct Frame {
    pts_time: Option<String>,
}

#[derive(Deserialize)]
struct Packet {
    pts_time: Option<String>,
    dts_time: Option<String>,
    #[serde(default)]
    flags: String,
}

#[derive(Deserialize)]
struct Stream {
    codec_name: Option<String>,
    nb_read_frames: Option<String>,
    #[serde(default)]
    width: u64,
    #[serde(default)]
    height: u64,
    r_frame_rate: Option<String>,
    avg_frame_rate: Option<String>,
    field_order: Option<String>,
    color_transfer: Option<String>,
    #[serde(default)]
    side_data_list: Vec<SideData>,
}

#[derive(Deserialize)]
struct SideData {
    displaymatrix: Option<String>,
    rotation: Option<f64>,
}

/// Size, orientation and times of a video.
///
/// Errors: [`Error::Data`] for a file without video, with no frame, or turned by other than multiples of 90 degrees, [`Error::Limit`] for large frames,
/// [`Error::Unsupported`] without `ffprobe`.
pub(crate) fn probe(video: &Path, options: &SceneOptions, limits: &Limits) -> Result<VideoFacts> {
    // Listing packets reads the whole file, and a plan opens its scene several times.
    static KNOWN: Mutex<BTreeMap<(PathBuf, u64, SystemTime, String), VideoFacts>> = Mutex::new(BTreeMap::new());
    let known = || KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
    let file = std::fs::metadata(video).and_then(|facts| Ok((video.to_path_buf(), facts.len(), facts.modified()?, options.ffmpeg.clone()))).ok();
    if let Some(facts) = file.as_ref().and_then(|file| known().get(file).cloned()) {
        limits.check_pixels(&format!("video {}", video.display()), u64::from(facts.size[0]), u64::from(facts.size[1]))?;
        return Ok(facts);
    }
    let facts = list(video, options, limits)?;
    if let Some(file) = file {
        known().insert(file, facts.clone());
    }
    Ok(facts)
}

fn list(video: &Path, options: &SceneOptions, limits: &Limits) -> Result<VideoFacts> {
    let stream = "stream=codec_name,width,height,r_frame_rate,avg_frame_rate,field_order,color_transfer:stream_side_data=displaymatrix,rotation";
    let printed = ask(video, options, &["-show_entries", &format!("packet=pts_time,dts_time,flags:{stream}")])?;
    let bad = |problem: String, remedy: &str| Error::data(format!("video {}", video.display()), problem, remedy);
    let Some(stream) = printed.streams.first() else { return Err(bad("it holds no video".into(), "Check the file")) };
    if !(1..=1 << 16).contains(&stream.width) || !(1..=1 << 16).contains(&stream.height) {
        return Err(bad(format!("its frames have {}x{} pixels, not 1 to 65536 each way", stream.width, stream.height), "Check the video"));
    }
    limits.check_pixels(&format!("video {}", video.display()), stream.width, stream.height)?;
    let turn = stream.turn().map_err(|angle| bad(format!("it is displayed turned by {angle:.1} degrees"), "Turn it by a multiple of 90 degrees"))?;
    let size = [stream.width as u32, stream.height as u32];
    let first = if has_leading(&printed.packets) { first_decoded(video, &printed.packets, options)? } else { None };
    let (times, keys) = frame_times(&printed.packets, stream, first);
    let is_timed = shown_from(&printed.packets, first).all(|packet| seconds(&packet.pts_time).is_some());
    if times.is_empty() {
        return Err(bad("it has no frame".into(), "Check the video"));
    }
    let size = if turn.swaps { [size[1], size[0]] } else { size };
    Ok(VideoFacts { size, times, keys, is_timed, interlaced: stream.is_interlaced(), high_range: stream.is_high_range() })
}

/// How the frames of a video are turned, without listing its packets.
pub(super) fn turn_of(video: &Path, options: &SceneOptions) -> Result<Turn> {
    let printed = ask(video, options, &["-show_entries", "stream=width:stream_side_data=displaymatrix,rotation"])?;
    let turn = printed.streams.first().map_or(Ok(Turn::UPRIGHT), Stream::turn);
    turn.map_err(|angle| {
        Error::data(format!("video {}", video.display()), format!("it is displayed turned by {angle:.1} degrees"), "Turn it by a multiple of 90 degrees")
    })
}

/// When the first frame is shown that can be decoded. `packets` are those of the video.
fn first_decoded(video: &Path, packets: &[Packet], options: &SceneOptions) -> Result<Option<f64>> {
    let begins_with_key = packets.first().is_some_and(|packet| packet.flags.contains('K'));
    let interval = format!("%+#{}", if begins_with_key { 1 } else { MOST_LEADING });
    let printed = ask(video, options, &["-read_intervals", &interval, "-show_entries", "frame=pts_time"])?;
    Ok(printed.frames.first().and_then(|frame| seconds(&frame.pts_time)))
}

/// How many images a video gives, decoded to its end; `None` where `ffprobe` does not say.
pub(super) fn count_images(video: &Path, options: &SceneOptions) -> Result<Option<usize>> {
    let printed = ask(video, options, &["-count_frames", "-show_entries", "stream=nb_read_frames"])?;
    Ok(printed.streams.first().and_then(|stream| stream.nb_read_frames.as_deref()?.parse().ok()))
}

/// Runs `ffprobe` on `video`; `what` says what it shows.
fn ask(video: &Path, options: &SceneOptions, what: &[&str]) -> Result<Printed> {
    let beside = |name: &str| options.ffmpeg.strip_suffix(name).map(|folder| format!("{folder}{}", name.replace("ffmpeg", "ffprobe")));
    let ffprobe = beside("ffmpeg").or_else(|| beside("ffmpeg.exe")).unwrap_or_else(|| "ffprobe".into());
    let arguments = ["-v", "error", "-protocol_whitelist", "file", "-select_streams", STREAM, "-of", "json=compact=1"];
    let video_input = input(video);
    let mut arguments: Vec<&OsStr> = arguments.iter().chain(what).map(OsStr::new).collect();
    arguments.push(&video_input);
    let printed = run(&ffprobe, &arguments, video, MOST_PRINTED, None)?;
    serde_json::from_slice(&printed).map_err(|e| {
        let said: String = String::from_utf8_lossy(&printed).trim().chars().take(200).collect();
        Error::data(format!("video {}", video.display()), format!("{ffprobe} said {said:?} ({e})"), "Check the video, and that ffprobe is the one of ffmpeg")
    })
}

impl Turn {
    const UPRIGHT: Self = Self { filter: "", swaps: false };

    /// The turn of a display matrix: a point (x, y) of the frame is shown at (a x + c y, b x + d y), y downwards. The angle in degrees where it is none.
    fn from_matrix([a, b, c, d]: [f64; 4]) -> Result<Self, f64> {
        let (least, most) = (|x: f64, y: f64| x.abs().min(y.abs()), |x: f64, y: f64| x.abs().max(y.abs()));
        if [a, b, c, d].iter().all(|v| *v == 0.0) {
            return Ok(Self::UPRIGHT);
        }
        if least(a, d) > 0.0 && most(b, c) <= TAN_ONE_DEGREE * least(a, d) {
            let filter = match (a < 0.0, d < 0.0) {
                (false, false) => "",
                (true, false) => "hflip",
                (false, true) => "vflip",
                (true, true) => "hflip,vflip",
            };
            return Ok(Self { filter, swaps: false });
        }
        if least(b, c) > 0.0 && most(a, d) <= TAN_ONE_DEGREE * least(b, c) {
            let filter = match (b > 0.0, c > 0.0) {
                (true, true) => "transpose=cclock_flip",
                (true, false) => "transpose=clock",
                (false, true) => "transpose=cclock",
                (false, false) => "transpose=clock_flip",
            };
            return Ok(Self { filter, swaps: true });
        }
        Err(b.atan2(a).to_degrees())
    }
}

impl Stream {
    fn turn(&self) -> Result<Turn, f64> {
        for data in &self.side_data_list {
            if let Some(matrix) = data.displaymatrix.as_deref().and_then(display_matrix) {
                return Turn::from_matrix(matrix);
            }
            if let Some(degrees) = data.rotation {
                // ffprobe counts counterclockwise.
                let (s, c) = (-degrees).to_radians().sin_cos();
                return Turn::from_matrix([c, s, -s, c]);
            }
        }
        Ok(Turn::UPRIGHT)
    }
    fn rate(&self) -> f64 {
        let parse = |text: &Option<String>| {
            let (n, d) = text.as_deref()?.split_once('/')?;
            Some(n.parse::<f64>().ok()? / d.parse::<f64>().ok()?).filter(|r| (1e-3..=1e6).contains(r))
        };
        parse(&self.avg_frame_rate).or_else(|| parse(&self.r_frame_rate)).unwrap_or(DEFAULT_RATE)
    }
    /// Whether its frames consist of two fields, whichever is first in the file or shown first.
    fn is_interlaced(&self) -> bool {
        matches!(self.field_order.as_deref(), Some("tt" | "bb" | "tb" | "bt"))
    }
    /// Whether some packets give no image of their own: the alternative reference frames of VP8. Each has the time of the next packet.
    fn has_hidden(&self) -> bool {
        self.codec_name.as_deref() == Some("vp8")
    }
    /// Whether its values follow one of the two curves of high dynamic range.
    fn is_high_range(&self) -> bool {
        matches!(self.color_transfer.as_deref(), Some("smpte2084" | "arib-std-b67"))
    }
}

/// The upper left 2x2 numbers of a display matrix, which ffprobe prints as three numbered lines of three integers.
fn display_matrix(text: &str) -> Option<[f64; 4]> {
    let rows: Vec<Vec<f64>> = text
        .lines()
        .filter_map(|line| line.split_once(':'))
        .map(|(_, numbers)| numbers.split_whitespace().filter_map(|t| t.parse::<i64>().ok()).map(|v| v as f64).collect())
        .collect();
    match &rows[..] {
        [first, second, _] if first.len() == 3 && second.len() == 3 => Some([first[0], first[1], second[0], second[1]]),
        _ => None,
    }
}

/// A time that is stated.
fn seconds(text: &Option<String>) -> Option<f64> {
    text.as_deref().and_then(|text| text.parse::<f64>().ok()).filter(|time| time.is_finite())
}

/// Packets that are shown, not only decoded.
fn shown(packets: &[Packet]) -> impl Iterator<Item = &Packet> {
    packets.iter().filter(|packet| !packet.flags.contains('D'))
}

/// Whether packets come before the first key frame, or have no time beside others that have one: in a video that was cut without decoding it, those cannot be
/// decoded.
///
/// Some containers (MPEG program streams) state times of presentation for some frames only, all through the video, and of decoding for all: none is missing
/// then.
fn has_leading(packets: &[Packet]) -> bool {
    let mut rest = shown(packets).skip_while(|packet| !packet.flags.contains('K'));
    let Some(key) = rest.next().and_then(|packet| seconds(&packet.pts_time)) else { return false };
    let is_leading = |packet: &&Packet| seconds(&packet.pts_time).is_none_or(|time| time < key);
    let is_partly_timed = rest.skip_while(is_leading).any(|packet| seconds(&packet.pts_time).is_none() && seconds(&packet.dts_time).is_some());
    !is_partly_timed && shown(packets).any(|packet| is_leading(&packet))
}

/// Packets that are shown, from the time `first` on where one is given.
fn shown_from(packets: &[Packet], first: Option<f64>) -> impl Iterator<Item = &Packet> {
    shown(packets).filter(move |packet| first.is_none_or(|first| seconds(&packet.pts_time).is_some_and(|time| time >= first - SAME_TIME)))
}

/// Times and key frames in the order of presentation, from the time `first` on where one is given. Packets that are only decoded, not shown, are left out.
fn frame_times(packets: &[Packet], stream: &Stream, first: Option<f64>) -> (Vec<f64>, Vec<bool>) {
    let shown: Vec<&Packet> = shown_from(packets, first).collect();
    let stated: Option<Vec<f64>> = shown.iter().map(|packet| seconds(&packet.pts_time)).collect();
    let has_hidden = stated.is_some() && stream.has_hidden();
    // Without times of all frames, their order is that of the packets, at a constant rate.
    let times = stated.unwrap_or_else(|| (0..shown.len()).map(|i| i as f64 / stream.rate()).collect());
    let mut frames: Vec<(f64, bool)> = times.into_iter().zip(shown.iter().map(|p| p.flags.contains('K'))).collect();
    frames.sort_by(|a, b| a.0.total_cmp(&b.0));
    if has_hidden {
        frames.dedup_by(|later, kept| {
            let is_same = later.0 - kept.0 <= SAME_TIME;
            kept.1 |= is_same && later.1;
            is_same
        });
    }
    frames.into_iter().unzip()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn display_matrices_are_one_of_eight_turns_or_refused() {
        let turn = |m: [f64; 4]| Turn::from_matrix(m).map(|t| (t.filter, t.swaps));
        let one = 65536.0;
        assert_eq!(turn([one, 0.0, 0.0, one]), Ok(("", false)));
        assert_eq!(turn([0.0; 4]), Ok(("", false)));
        assert_eq!(turn([-one, 0.0, 0.0, -one]), Ok(("hflip,vflip", false)));
        assert_eq!(turn([-one, 0.0, 0.0, one]), Ok(("hflip", false)));
        assert_eq!(turn([0.0, one, -one, 0.0]), Ok(("transpose=clock", true)));
        assert_eq!(turn([0.0, -one, one, 0.0]), Ok(("transpose=cclock", true)));
        assert_eq!(turn([0.0, one, one, 0.0]), Ok(("transpose=cclock_flip", true)));
        assert!((turn([46341.0, 46341.0, -46341.0, 46341.0]).unwrap_err() - 45.0).abs() < 1e-6);
        assert!(turn([one, 0.0, 0.0, 0.0]).is_err(), "a flat matrix");
        let text =
            "\n00000000:            0       65536           0\n00000001:      -65536           0           0\n00000002:            0           0  1073741824\n";
        assert_eq!(display_matrix(text), Some([0.0, one, -one, 0.0]));
        assert_eq!(display_matrix("00000000: 1 2"), None);
        let stream = |side: &str| serde_json::from_str::<Stream>(&format!("{{\"side_data_list\": [{side}]}}")).unwrap().turn();
        assert_eq!(stream("{\"rotation\": -90}").unwrap().filter, "transpose=clock");
        assert!(stream("{\"rotation\": 30}").is_err());
        assert_eq!(stream("{}"), Ok(Turn::UPRIGHT));
    }

    #[test]
    fn only_frames_of_two_fields_are_interlaced() {
        let stream = |order: &str| serde_json::from_str::<Stream>(&format!("{{\"field_order\": \"{order}\"}}")).unwrap().is_interlaced();
        assert!(["tt", "bb", "tb", "bt"].into_iter().all(stream));
        assert!(!stream("progressive") && !stream("unknown") && !serde_json::from_str::<Stream>("{}").unwrap().is_interlaced());
    }

    #[test]
    fn only_two_curves_are_of_high_range() {
        let stream = |transfer: &str| serde_json::from_str::<Stream>(&format!("{{\"color_transfer\": \"{transfer}\"}}")).unwrap().is_high_range();
        assert!(stream("smpte2084") && stream("arib-std-b67"));
        assert!(!stream("bt709") && !stream("bt2020-10") && !serde_json::from_str::<Stream>("{}").unwrap().is_high_range());
    }

    #[test]
    fn frames_whose_container_states_no_time_of_presentation_count() {
        // As ffprobe lists MPEG program streams with B frames, in the order of decoding: I P B B P B P.
        let packets = r#"[{"pts_time":"0.54","dts_time":"0.50","flags":"K_"},{"dts_time":"0.54"},{"pts_time":"0.58","dts_time":"0.58"},
            {"pts_time":"0.62","dts_time":"0.62"},{"dts_time":"0.66"},{"pts_time":"0.70","dts_time":"0.70"},{"dts_time":"0.74"}]"#;
        let packets: Vec<Packet> = serde_json::from_str(packets).unwrap();
        assert!(!has_leading(&packets));
        let stream: Stream = serde_json::from_str(r#"{"avg_frame_rate":"25/1"}"#).unwrap();
        assert_eq!(frame_times(&packets, &stream, None).0.len(), 7);
        // Second fields have neither time, and no frame of their own.
        let fields: Vec<Packet> = serde_json::from_str(r#"[{"pts_time":"0","flags":"K_"},{},{"pts_time":"0.04"},{}]"#).unwrap();
        assert!(has_leading(&fields));
        assert_eq!(frame_times(&fields, &stream, Some(0.0)).0, [0.0, 0.04]);
    }

    #[test]
    fn times_are_sorted_and_hidden_packets_left_out() {
        let read = |packets: &str, stream: &str| {
            frame_times(&serde_json::from_str::<Vec<Packet>>(packets).unwrap(), &serde_json::from_str::<Stream>(stream).unwrap(), None)
        };
        let packets = r#"[{"pts_time":"0.0","flags":"KD"},{"pts_time":"0.1","flags":"K_"},{"pts_time":"0.3","flags":"__"},{"pts_time":"0.2"}]"#;
        assert_eq!(read(packets, "{}"), (vec![0.1, 0.2, 0.3], vec![true, false, false]));
        // A time is missing, or no number: a constant rate.
        for odd in ["{}", r#"{"pts_time":"nan"}"#] {
            let (times, _) = read(&format!("[{odd},{{\"pts_time\":\"7\"}}]"), r#"{"avg_frame_rate":"0/0","r_frame_rate":"10/1"}"#);
            assert_eq!(times, vec![0.0, 0.1]);
        }
        assert_eq!(read("[{},{}]", r#"{"avg_frame_rate":"1/0"}"#).0, vec![0.0, 1.0 / DEFAULT_RATE]);
        // Of two packets of VP8 at one time, the first is not shown.
        let twice = r#"[{"pts_time":"0.0","flags":"K_"},{"pts_time":"0.04"},{"pts_time":"0.04"},{"pts_time":"0.08"}]"#;
        assert_eq!(read(twice, r#"{"codec_name":"vp8"}"#), (vec![0.0, 0.04, 0.08], vec![true, false, false]));
        assert_eq!(read(twice, r#"{"codec_name":"h264"}"#).0, [0.0, 0.04, 0.04, 0.08]);
        // Cut without decoding: what comes before the first key frame needs frames that are gone.
        let cut: Vec<Packet> = serde_json::from_str(r#"[{"pts_time":"0.2","flags":"K_"},{"pts_time":"0.1"},{},{"pts_time":"0.3"}]"#).unwrap();
        assert!(has_leading(&cut) && !has_leading(&cut[..1]));
        assert_eq!(frame_times(&cut, &serde_json::from_str("{}").unwrap(), Some(0.2)), (vec![0.2, 0.3], vec![true, false]));
    }
}
