//! Videos through the `ffmpeg` command.

use cc4dgs_core::archive::behind_links;
use cc4dgs_core::{Camera, Error, Image8, Result};
use std::io::Write;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

/// Images per second that a video may have.
pub const RATES: RangeInclusive<f64> = 0.01..=1000.0;

const REMEDY: &str = "Install ffmpeg (Debian: apt install ffmpeg), or render PNG frames without a video";

/// The first line `ffmpeg -version` prints, or why there is none.
///
/// # Errors
/// [`Error::Unsupported`] where the command does not start.
pub fn ffmpeg_version() -> Result<String> {
    let output = Command::new("ffmpeg").arg("-version").stdin(Stdio::null()).output();
    match output {
        Ok(o) if o.status.success() => Ok(String::from_utf8_lossy(&o.stdout).lines().next().unwrap_or("ffmpeg").to_string()),
        Ok(o) => Err(Error::unsupported("ffmpeg", format!("`ffmpeg -version` ended with {}", o.status), REMEDY)),
        Err(e) => Err(Error::unsupported("ffmpeg", format!("the command does not start: {e}"), REMEDY)),
    }
}

/// Name of the image of frame `index`, as [`encode`] expects it.
pub fn frame_name(index: usize) -> String {
    format!("frame_{index:05}.png")
}

/// The names of [`frame_name`] in the folder `frames` as ffmpeg's pattern, in which a percent sign of the folder's name is written twice.
fn pattern(frames: &Path) -> PathBuf {
    let folder = frames.to_str().map_or_else(|| frames.to_path_buf(), |folder| PathBuf::from(folder.replace('%', "%%")));
    folder.join("frame_%05d.png")
}

/// Refuses images of several sizes for the video that `object` names; `shots` are their cameras and times.
///
/// # Errors
/// [`Error::Parameter`] that names two of the sizes.
pub fn check_sizes(object: &str, shots: &[(Camera, f32)]) -> Result<()> {
    let mut sizes = shots.iter().map(|(camera, _)| [camera.width, camera.height]);
    let first = sizes.next();
    let Some(([w, h], [width, height])) = first.zip(sizes.find(|size| Some(*size) != first)) else { return Ok(()) };
    let problem = format!("there are images of {w}x{h} and of {width}x{height} pixels, and those of a video have one size");
    Err(Error::parameter(object, problem, "Give all images one size (--size), or leave the video out"))
}

/// Makes the video `out` of the first `count` images in `frames`, named by [`frame_name`], at `fps` images per second; it appears complete or not at all.
///
/// # Errors
/// [`Error::Parameter`] for a rate outside [`RATES`], [`Error::Unsupported`] without ffmpeg, [`Error::Backend`] with its last message where it fails,
/// [`Error::Io`] for a folder that cannot be written.
pub fn encode(frames: &Path, count: usize, fps: f64, out: &Path) -> Result<()> {
    let (rate, out) = (rate(fps)?, behind_links(out)?);
    let part = temporary(&out)?;
    let mut command = ffmpeg();
    command.args(["-framerate", &rate, "-start_number", "0", "-i"]).arg(pattern(frames)).args(["-frames:v", &count.to_string()]);
    let output = command.args(CODEC).arg(&part).stdin(Stdio::null()).output().map_err(absent)?;
    check(&output)?;
    part.persist(&out).map_err(|e| Error::io(&out, e.error))
}

/// `fps` as ffmpeg reads it, exactly: rates such as 29.97 are no whole numbers.
fn rate(fps: f64) -> Result<String> {
    if RATES.contains(&fps) {
        return Ok(fps.to_string());
    }
    Err(Error::parameter("video", format!("{fps} images per second"), format!("Give {} to {}", RATES.start(), RATES.end())))
}

/// Encoding that players agree on: 4:2:0 colour, which needs even sides, by the matrix of BT.709 whatever the size, and the index in front. Nothing of the day
/// or the program is written.
const CODEC: [&str; 18] = [
    "-c:v",
    "libx264",
    "-vf",
    "pad=ceil(iw/2)*2:ceil(ih/2)*2,scale=out_color_matrix=bt709:out_range=tv,format=yuv420p",
    "-colorspace",
    "bt709",
    "-color_primaries",
    "bt709",
    "-color_trc",
    "bt709",
    "-movflags",
    "+faststart",
    "-fflags",
    "+bitexact",
    "-flags:v",
    "+bitexact",
    "-map_metadata",
    "-1",
];

/// Encodes a video image by image, without files of single images. The video appears once it is finished.
pub struct VideoWriter {
    out: PathBuf,
    fps: f64,
    crf: Option<u32>,
    running: Option<Running>,
}

struct Running {
    ffmpeg: Child,
    part: Option<tempfile::TempPath>,
    /// The name of the video, behind links.
    out: PathBuf,
    size: (u32, u32),
}

impl Drop for Running {
    fn drop(&mut self) {
        // Ends the process of an unfinished video; after `finish` it has ended already.
        self.ffmpeg.kill().ok();
        self.ffmpeg.wait().ok();
    }
}

impl VideoWriter {
    /// The video `out` with `fps` images per second, one of [`RATES`]. Nothing is started before the first image.
    pub fn new(out: impl Into<PathBuf>, fps: f64) -> Self {
        Self { out: out.into(), fps, crf: None, running: None }
    }
    /// The same with the quality `crf` of x264: 0 is lossless, 51 the worst; ffmpeg's default is 23.
    pub fn quality(self, crf: u32) -> Self {
        Self { crf: Some(crf), ..self }
    }
    /// Appends an RGB image; all have the size of the first.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a rate outside [`RATES`], [`Error::Unsupported`] without ffmpeg, [`Error::Backend`] where it fails, [`Error::Data`] for an
    /// image of another size or with alpha.
    pub fn add(&mut self, image: &Image8) -> Result<()> {
        image.validate("image of a video")?;
        let size = (image.width, image.height);
        if image.channels != 3 {
            return Err(Error::data("image of a video", format!("{} channels", image.channels), "Give RGB images"));
        }
        let mut running = match self.running.take() {
            Some(running) => running,
            None => self.start(size)?,
        };
        if running.size != size {
            let problem = format!("{}x{} pixels after images of {}x{}", size.0, size.1, running.size.0, running.size.1);
            return Err(Error::data("image of a video", problem, "Give all images one size (--size)"));
        }
        let Some(Ok(())) = running.ffmpeg.stdin.as_mut().map(|pipe| pipe.write_all(&image.data)) else {
            return Err(running.failure());
        };
        self.running = Some(running);
        Ok(())
    }
    /// Ends the video and gives it its name.
    ///
    /// # Errors
    /// [`Error::Backend`] where ffmpeg fails, [`Error::Parameter`] for a video without images, [`Error::Io`].
    pub fn finish(mut self) -> Result<()> {
        let Some(mut running) = self.running.take() else {
            return Err(Error::parameter("video", "there are no images", "Add at least one"));
        };
        drop(running.ffmpeg.stdin.take());
        running.ended()?;
        running.part.take().map_or(Ok(()), |part| part.persist(&running.out)).map_err(|e| Error::io(&running.out, e.error))
    }
    fn start(&self, (width, height): (u32, u32)) -> Result<Running> {
        let (rate, out) = (rate(self.fps)?, behind_links(&self.out)?);
        let part = temporary(&out)?;
        let mut command = ffmpeg();
        command.args(["-f", "rawvideo", "-pixel_format", "rgb24", "-video_size", &format!("{width}x{height}")]);
        command.args(["-framerate", &rate, "-i", "-"]).args(CODEC);
        if let Some(crf) = self.crf {
            command.args(["-crf", &crf.to_string()]);
        }
        let ffmpeg = command.arg(&part).stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().map_err(absent)?;
        Ok(Running { ffmpeg, part: Some(part), out, size: (width, height) })
    }
}

impl Running {
    /// Waits for the end of the process.
    fn ended(&mut self) -> Result<()> {
        let mut said = Vec::new();
        if let Some(mut pipe) = self.ffmpeg.stderr.take() {
            std::io::Read::read_to_end(&mut pipe, &mut said).ok();
        }
        let status = self.ffmpeg.wait().map_err(|e| Error::io("ffmpeg", e))?;
        check(&Output { status, stdout: Vec::new(), stderr: said })
    }
    /// Why the process took no more images.
    fn failure(&mut self) -> Error {
        drop(self.ffmpeg.stdin.take());
        let ended = self.ended().err();
        ended.unwrap_or_else(|| Error::backend("ffmpeg", "it ended before the last image", "Render PNG frames and encode them by hand"))
    }
}

/// ffmpeg without questions, and with errors as its only messages.
fn ffmpeg() -> Command {
    let mut command = Command::new("ffmpeg");
    command.args(["-y", "-loglevel", "error"]);
    // Ctrl-C reaches this program alone, which then ends the video.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    command
}

/// A temporary name beside `out`.
fn temporary(out: &Path) -> Result<tempfile::TempPath> {
    let folder = out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut builder = tempfile::Builder::new();
    builder.prefix(".cc4dgs-").suffix(".mp4");
    // As any other file, and not for its owner alone.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    Ok(builder.tempfile_in(folder).map_err(|e| Error::io(folder, e))?.into_temp_path())
}

fn absent(error: std::io::Error) -> Error {
    Error::unsupported("ffmpeg", format!("the command does not start: {error}"), REMEDY)
}

fn check(output: &Output) -> Result<()> {
    if output.status.success() {
        return Ok(());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    let problem = format!("it ended with {}: {}", output.status, said.trim().lines().last().unwrap_or("no message"));
    Err(Error::backend("ffmpeg", problem, "Render PNG frames and encode them by hand"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percent_signs_of_a_folder_are_no_pattern() {
        for (folder, expected) in [("frames", "frames/frame_%05d.png"), ("50%d of a/b%", "50%%d of a/b%%/frame_%05d.png")] {
            assert_eq!(pattern(Path::new(folder)), Path::new(expected));
        }
    }

    #[test]
    fn images_of_a_video_have_one_size() {
        let shots = |sizes: &[(u32, u32)]| -> Vec<(Camera, f32)> {
            sizes.iter().map(|&size| (Camera::look_at("a", size, 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]), 0.0)).collect()
        };
        assert!(check_sizes("--mp4", &[]).is_ok() && check_sizes("--mp4", &shots(&[(80, 60); 3])).is_ok());
        let message = check_sizes("--mp4", &shots(&[(80, 60), (80, 60), (60, 80)])).unwrap_err().to_string();
        assert!(message.starts_with("--mp4") && message.contains("80x60 and of 60x80") && message.contains("--size"), "{message}");
    }

    #[test]
    fn rates_are_handed_on_exactly() {
        for (fps, text) in [(30.0, "30"), (29.97, "29.97"), (23.976, "23.976"), (0.5, "0.5"), (1000.0, "1000")] {
            assert_eq!(rate(fps).unwrap(), text);
        }
        for fps in [0.0, -1.0, 1e4, f64::NAN, f64::INFINITY] {
            let image = Image8 { width: 2, height: 2, channels: 3, data: vec![0; 12] };
            let message = VideoWriter::new("a.mp4", fps).add(&image).unwrap_err().to_string();
            assert!(message.contains(&format!("{fps} images per second")) && message.contains("0.01 to 1000"), "{message}");
        }
    }

    #[test]
    fn frames_of_any_folder_become_a_video() {
        if ffmpeg_version().is_err() {
            eprintln!("ffmpeg is absent: skipped");
            return;
        }
        let root = tempfile::tempdir().unwrap();
        let (frames, out) = (root.path().join("100%d"), root.path().join("a.mp4"));
        let image = Image8 { width: 16, height: 16, channels: 3, data: vec![128; 16 * 16 * 3] };
        (0..2).for_each(|index| cc4dgs_train::images::write_png(frames.join(frame_name(index)), &image).unwrap());
        encode(&frames, 2, 5.0, &out).unwrap();
        assert!(out.metadata().unwrap().len() > 100);
        // A link stays, and the video is where it leads.
        #[cfg(unix)]
        {
            let link = root.path().join("link.mp4");
            std::os::unix::fs::symlink("a.mp4", &link).unwrap();
            encode(&frames, 1, 5.0, &link).unwrap();
            let mut video = VideoWriter::new(&link, 5.0);
            video.add(&image).unwrap();
            video.finish().unwrap();
            assert!(link.is_symlink());
        }
    }
}
