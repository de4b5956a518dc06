//! The `[scene]` section: how a dataset is opened.

use crate::{Error, Result, unknown_name};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// A background colour: a name or RGB in 0..1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Background {
    /// `white`, `black` or `grey`.
    Name(String),
    /// Red, green, blue in 0..1.
    Rgb([f32; 3]),
}

impl Background {
    /// The colour as RGB in 0..1.
    ///
    /// # Errors
    /// [`Error::Parameter`] for an unknown name or values outside 0..1.
    pub fn rgb(&self) -> Result<[f32; 3]> {
        match self {
            Self::Name(name) => match name.as_str() {
                "white" => Ok([1.0; 3]),
                "black" => Ok([0.0; 3]),
                "grey" | "gray" => Ok([0.5; 3]),
                other => Err(unknown_name("scene.background", other, ["white", "black", "grey"].into_iter())),
            },
            Self::Rgb(c) if c.iter().all(|v| (0.0..=1.0).contains(v)) => Ok(*c),
            Self::Rgb(c) => Err(Error::parameter("scene.background", format!("{c:?} is outside 0..1"), "Write three numbers between 0 and 1")),
        }
    }
}

/// A camera by its index or its name.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum CameraRef {
    /// Index in the reader's order.
    Index(usize),
    /// Name as the dataset has it.
    Name(String),
}

/// Whether constant frame offsets between cameras are looked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SyncMode {
    /// Cameras that record videos are compared by the motion in them; an offset is undone where the evidence is clear, with a warning.
    #[default]
    Auto,
    /// Frames are taken as the timestamps say.
    Off,
}

/// Largest offset of a camera, in frames.
const MOST_OFFSET: i32 = 1_000_000;

/// How a dataset is opened. All keys are optional.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SceneOptions {
    /// Reader name, or `auto` to probe.
    pub reader: String,
    /// Target width in pixels; 0 keeps the native one, or the aspect if only the height is given. Images that are smaller keep their size.
    pub width: u32,
    /// Target height in pixels; 0 keeps the native one, or the aspect if only the width is given. Images that are smaller keep their size.
    pub height: u32,
    /// Divides the native size; not together with `width` and `height`. Below 1 it enlarges images that readers compute, and no others.
    pub downscale: f64,
    /// First frame, number of frames (0: all that follow) and stride, by frame index of the dataset.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frames: Option<[usize; 3]>,
    /// Background the images are composited over and the renders start from; the dataset's own if absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub background: Option<Background>,
    /// Memory for decoded frames and recorded depth, in megabytes (10^6 bytes).
    pub cache_mb: u64,
    /// Cameras to hold out, instead of the dataset's own split.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub test_cameras: Option<Vec<CameraRef>>,
    /// At most this many training views, evenly spread; 0 for all.
    pub max_views: usize,
    /// Which `transforms_*.json` is the held-out one of Blender-style scenes (`val` is the usual choice for D-NeRF lego). Otherwise views of
    /// `transforms_val.json` are validation views.
    pub test_split: String,
    /// The `ffmpeg` command for video input; `ffprobe` is expected in the same folder.
    pub ffmpeg: String,
    /// Folder for frames extracted from videos; if absent, one of the user's own among temporary files.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub video_cache: Option<PathBuf>,
    /// `auto` finds constant frame offsets between videos of up to 5 s, from their first 900 frames; `off` does not look for any.
    pub sync: SyncMode,
    /// Frame offsets of cameras by name, in place of a search: with `cam03 = 4`, frame k + 4 of cam03 shows what the others show at frame k. Frames
    /// that are not common to all cameras are dropped.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub offsets: BTreeMap<String, i32>,
}

impl Default for SceneOptions {
    fn default() -> Self {
        Self {
            reader: "auto".into(),
            width: 0,
            height: 0,
            downscale: 1.0,
            frames: None,
            background: None,
            cache_mb: 2000,
            test_cameras: None,
            max_views: 0,
            test_split: "test".into(),
            ffmpeg: "ffmpeg".into(),
            video_cache: None,
            sync: SyncMode::Auto,
            offsets: BTreeMap::new(),
        }
    }
}

impl SceneOptions {
    /// Refuses contradictory options and values out of range.
    ///
    /// # Errors
    /// [`Error::Parameter`] that names the option.
    pub fn validate(&self) -> Result<()> {
        if !(self.downscale.is_finite() && self.downscale > 0.0) {
            return Err(Error::parameter("scene.downscale", format!("{} is not a positive number", self.downscale), "Write 2 to halve the images"));
        }
        if self.downscale != 1.0 && (self.width > 0 || self.height > 0) {
            return Err(Error::parameter("scene.downscale", "given together with scene.width or scene.height", "Keep one of them"));
        }
        if self.frames.is_some_and(|f| f[2] == 0) {
            return Err(Error::parameter("scene.frames", "the stride is 0", "Write [start, count, stride] with a stride of 1 or more"));
        }
        if let Some(background) = &self.background {
            background.rgb()?;
        }
        if let Some((name, frames)) = self.offsets.iter().find(|(_, o)| o.unsigned_abs() > MOST_OFFSET as u32) {
            return Err(Error::parameter("scene.offsets", format!("{name} has {frames}, the limit is {MOST_OFFSET}"), "Write an offset in frames"));
        }
        Ok(())
    }
    /// The size, width and height in pixels, that is asked for where images have the size `native`. Readers that compute images compute them at this size;
    /// images of files and videos get [`Self::image_size`].
    pub fn target_size(&self, native: (u32, u32)) -> (u32, u32) {
        let (w, h) = (f64::from(native.0), f64::from(native.1));
        let pixels = |v: f64| v.round().clamp(1.0, f64::from(u32::MAX)) as u32;
        match (self.width, self.height) {
            (0, 0) => (pixels(w / self.downscale), pixels(h / self.downscale)),
            (width, 0) => (width, pixels(h * f64::from(width) / w)),
            (0, height) => (pixels(w * f64::from(height) / h), height),
            both => both,
        }
    }
    /// The size, width and height in pixels, to which images of the size `native` are scaled: [`Self::target_size`], but at most `native` along each axis.
    /// Enlarged images would show no more; they would cost time and blur what renders are compared with.
    pub fn image_size(&self, native: (u32, u32)) -> (u32, u32) {
        let asked = self.target_size(native);
        (asked.0.min(native.0), asked.1.min(native.1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_keep_the_aspect() {
        let native = (800, 600);
        let with = |width, height, downscale| SceneOptions { width, height, downscale, ..Default::default() }.target_size(native);
        assert_eq!(with(0, 0, 1.0), (800, 600));
        assert_eq!(with(400, 0, 1.0), (400, 300));
        assert_eq!(with(0, 150, 1.0), (200, 150));
        assert_eq!(with(100, 100, 1.0), (100, 100));
        assert_eq!(with(0, 0, 2.0), (400, 300));
    }

    #[test]
    fn images_are_not_enlarged() {
        let with = |width, height, downscale| SceneOptions { width, height, downscale, ..Default::default() }.image_size((800, 600));
        assert_eq!([with(400, 0, 1.0), with(0, 150, 1.0), with(0, 0, 2.0), with(100, 90, 1.0)], [(400, 300), (200, 150), (400, 300), (100, 90)]);
        assert_eq!([with(801, 0, 1.0), with(0, 1200, 1.0), with(0, 0, 0.5), with(1000, 1000, 1.0)], [(800, 600); 4]);
        assert_eq!(with(1000, 150, 1.0), (800, 150), "each axis on its own where both are stated");
    }

    #[test]
    fn contradictions_are_refused() {
        assert!(SceneOptions { downscale: 2.0, width: 100, ..Default::default() }.validate().is_err());
        assert!(SceneOptions { downscale: f64::NAN, ..Default::default() }.validate().is_err());
        assert!(SceneOptions { frames: Some([0, 4, 0]), ..Default::default() }.validate().is_err());
        assert!(SceneOptions { background: Some(Background::Rgb([0.0, 2.0, 0.0])), ..Default::default() }.validate().is_err());
        assert!(SceneOptions { offsets: [("a".to_string(), i32::MIN)].into(), ..Default::default() }.validate().is_err());
        assert!(SceneOptions::default().validate().is_ok());
    }

    #[test]
    fn toml_forms_are_read_and_unknown_keys_refused() {
        let read = |text: &str| crate::config::parse_table("t", text).and_then(|t| crate::config::parse_section::<SceneOptions>("scene", &t));
        let options = read("background = \"black\"\nframes = [0, 30, 5]\ntest_cameras = [0, \"cam10\"]").unwrap();
        assert_eq!(options.background.unwrap().rgb().unwrap(), [0.0; 3]);
        assert_eq!(options.test_cameras.unwrap(), vec![CameraRef::Index(0), CameraRef::Name("cam10".into())]);
        let options = read("sync = \"off\"\noffsets = { cam03 = 4, \"videos/a.mp4\" = -2 }").unwrap();
        assert_eq!((options.sync, options.offsets["cam03"], options.offsets["videos/a.mp4"]), (SyncMode::Off, 4, -2));
        assert!(read("sync = \"maybe\"").is_err());
        let text = toml::to_string(&options).unwrap();
        assert_eq!(read(&text).unwrap(), options, "{text}");
        assert!(read("widht = 3").unwrap_err().to_string().contains("widht"));
    }
}
