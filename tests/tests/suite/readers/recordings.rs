//! Videos that tests record with ffmpeg. Each frame holds the number of the instant that it shows.

use super::common::*;
use cc4dgs_core::{Image8, Limits, Scene, SceneOptions, Seed};
use rand::Rng;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

pub(super) const SIZE: (u32, u32) = (64, 48);
const BITS: u32 = 10;

/// Whether ffmpeg is here.
pub(super) fn ffmpeg() -> bool {
    let here =
        ["ffmpeg", "ffprobe"].iter().all(|c| Command::new(c).arg("-version").stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|s| s.success()));
    assert!(here || std::env::var_os("CC4DGS_REQUIRE_FFMPEG").is_none(), "the ffmpeg and ffprobe commands are absent");
    if !here {
        eprintln!("skipped: the ffmpeg and ffprobe commands are absent");
    }
    here
}

/// Runs ffmpeg on `arguments`.
pub(super) fn encode(arguments: &[&str], out: &Path) {
    let output = Command::new("ffmpeg").args(["-nostdin", "-v", "error", "-y"]).args(arguments).arg(out).stdin(Stdio::null()).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Column of a box that moves in bursts, per instant.
fn path(count: usize) -> Vec<u32> {
    let mut rng = Seed::root(4).rng();
    let (mut left, mut speed, mut x) = (0, 0.0f64, 20.0f64);
    let step = |_| {
        if left == 0 {
            (left, speed) = (rng.random_range(3..20), rng.random_range(-4.0..4.0));
        }
        left -= 1;
        if !(0.0..=48.0).contains(&(x + speed)) {
            speed = -speed;
        }
        x += speed;
        x.round() as u32
    };
    (0..count).map(step).collect()
}

/// A video of the given instants. Each camera sees the box at another height, every second one mirrored. The upper left corner is bright.
pub(super) fn record(out: &Path, camera: usize, instants: &[usize], rate: &str, more: &[&str]) {
    let motion = path(1 << BITS);
    let frames = tempfile::tempdir().unwrap();
    for (index, &instant) in instants.iter().enumerate() {
        let left = if camera.is_multiple_of(2) { motion[instant] } else { 48 - motion[instant] };
        let top = 14 + 4 * camera as u32;
        let image = image::GrayImage::from_fn(SIZE.0, SIZE.1, |x, y| {
            let code = y < 6 && (2..2 + 6 * BITS).contains(&x) && instant >> ((x - 2) / 6) & 1 == 1;
            let block = (left..left + 14).contains(&x) && (top..top + 14).contains(&y);
            image::Luma([if block || (x < 8 && y > 40) {
                230
            } else if code {
                130
            } else {
                40
            }])
        });
        image.save(frames.path().join(format!("{index:04}.png"))).unwrap();
    }
    let pattern = frames.path().join("%04d.png");
    let mut arguments = vec!["-framerate", rate, "-i", pattern.to_str().unwrap(), "-c:v", "mpeg4", "-q:v", "2", "-pix_fmt", "yuv420p", "-g", "24"];
    arguments.extend(more);
    encode(&arguments, out);
}

/// The instant a frame shows.
fn instant(image: &Image8) -> usize {
    let grey = |x: u32, y: u32| image.data[((y * image.width + x) * image.channels) as usize];
    (0..BITS).map(|bit| usize::from(grey(5 + 6 * bit, 2) > 85) << bit).sum()
}

/// Per frame the instants that the cameras show, in their order.
pub(super) fn instants(scene: &Scene) -> BTreeMap<usize, Vec<Option<usize>>> {
    let mut found: BTreeMap<usize, Vec<Option<usize>>> = BTreeMap::new();
    for (view, v) in scene.views.iter().enumerate() {
        found.entry(v.frame).or_insert_with(|| vec![None; scene.cameras.len()])[v.camera] = Some(instant(&scene.frame(view).unwrap()));
    }
    found
}

/// A folder for an N3DV scene of `cameras` cameras, and options with a cache of its own.
pub(super) fn rig(cameras: usize, size: (u32, u32)) -> (tempfile::TempDir, SceneOptions) {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("poses_bounds.npy"), npy(&[cameras, 17], &llff_rows(&ring(cameras, size.0, size.1)))).unwrap();
    let options = SceneOptions { video_cache: Some(dir.path().join("cache")), ..Default::default() };
    (dir, options)
}

pub(super) fn video(dir: &tempfile::TempDir, camera: usize) -> PathBuf {
    dir.path().join(format!("cam{camera:02}.mp4"))
}

pub(super) fn opened(dir: &tempfile::TempDir, options: &SceneOptions) -> Scene {
    open(dir.path(), options, &Limits::default()).unwrap()
}
