//! Videos through the `ffmpeg` command.

use cc4dgs_core::{Error, Result};
use std::path::Path;
use std::process::{Command, Stdio};

const REMEDY: &str = "Install ffmpeg (Debian: apt install ffmpeg), or use the PNG frames without a video";

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

/// Makes the video `out` of the first `count` images in `frames`, named by [`frame_name`], at `fps` images per second; it appears complete or not at all.
///
/// # Errors
/// [`Error::Unsupported`] without ffmpeg, [`Error::Backend`] with its last message where it fails, [`Error::Io`] for a folder that cannot be written.
pub fn encode(frames: &Path, count: usize, fps: u32, out: &Path) -> Result<()> {
    let folder = out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let part = tempfile::Builder::new().prefix(".cc4dgs-").suffix(".mp4").tempfile_in(folder).map_err(|e| Error::io(folder, e))?.into_temp_path();
    let result = Command::new("ffmpeg")
        .args(["-y", "-loglevel", "error", "-framerate", &fps.to_string(), "-start_number", "0"])
        .arg("-i")
        .arg(frames.join("frame_%05d.png"))
        .args(["-frames:v", &count.to_string()])
        // Players want 4:2:0 colour, which needs even sides.
        .args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", "-movflags", "+faststart"])
        .arg(&part)
        .stdin(Stdio::null())
        .output();
    match result {
        Ok(o) if o.status.success() => part.persist(out).map_err(|e| Error::io(out, e.error)),
        Ok(o) => {
            let said = String::from_utf8_lossy(&o.stderr);
            Err(Error::backend(
                "ffmpeg",
                format!("it ended with {}: {}", o.status, said.trim().lines().last().unwrap_or("no message")),
                "The PNG frames are complete; encode them by hand",
            ))
        }
        Err(e) => Err(Error::unsupported("ffmpeg", format!("the command does not start: {e}"), REMEDY)),
    }
}
