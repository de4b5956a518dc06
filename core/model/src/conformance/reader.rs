//! The conformance suite of dataset readers.

mod limits;
mod order;
mod points;

use crate::reader::{ImageSource, InitBox, RawCamera, RawScene, RawView, ReaderPlugin, SceneOptions, files};
use crate::{Error, Image8, Limits, Result, Seed, Split};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

/// Damaged versions tried per file and kind of damage.
const DAMAGES: usize = 16;
/// Largest number of files that are damaged; images count twice, because many are similar.
const FILES: usize = 24;
/// Largest number of images that are decoded.
const IMAGES: usize = 12;
/// Limits for a tiny dataset.
const LIMITS: Limits = Limits { max_bytes: 1 << 24, max_gaussians: 100_000, max_pixels: 1 << 22, max_depth: 64 };
/// Replacements for numbers in text files.
const ABSURD: [&str; 6] = ["1e308", "-1", "99999999999999999999", "0", "nan", ""];

/// Tests a reader on the tiny dataset at `folder`, which it must be able to open. Each finding is a line; an empty list means that it passed.
///
/// - It recognises the folder, and neither an empty nor a missing one.
/// - Opening twice gives equal scenes.
/// - Poses are rigid; times lie in 0..1 and increase with frames; there is a training view.
/// - Points, or else the corners of the box, are in front of training cameras: not behind them, as where y and z axes point up and backwards.
/// - Images that the reader loads itself are the same in any order.
/// - Images and masks have the size of their cameras, or a scaled size of the same aspect; recorded depth has this aspect and can be read.
/// - A scene marked as resized has the size of `scene.width`.
/// - Index files of more bytes than the limits allow are refused.
/// - Damaged copies of its files (truncated, flipped bits, absurd numbers) give errors or valid scenes, never a panic.
///
/// The dataset is copied, not changed. A `folder` that does not exist is allowed for readers that compute their scenes.
pub fn reader(plugin: &ReaderPlugin, folder: &Path) -> Vec<String> {
    let mut findings = Vec::new();
    let mut note = |check: &str, outcome: Result<Vec<String>>| match outcome {
        Ok(found) => findings.extend(found.into_iter().map(|f| format!("{}, {check}: {f}", plugin.info.name))),
        Err(e) => findings.push(format!("{}, {check}: {e}", plugin.info.name)),
    };
    note("probe", probes_its_own(plugin, folder));
    match attempt(plugin, folder, &SceneOptions::default()) {
        Err(e) => note("open", Err(e)),
        Ok(scene) => {
            note("scene", Ok(soundness(&scene)));
            note("points", Ok(points::behind(&scene).into_iter().collect()));
            note("images", Ok(images(&scene)));
            note("order of images", Ok(order::matters(&scene).into_iter().collect()));
            note("limits", limits::kept(plugin, folder));
            note("repeats", repeats(plugin, folder, &scene));
            note("size", follows_the_size(plugin, folder, &scene));
            note("damaged files", survives_damage(plugin, folder));
        }
    }
    findings
}

/// Opens and validates; a panic becomes an error.
fn attempt(plugin: &ReaderPlugin, folder: &Path, options: &SceneOptions) -> Result<RawScene> {
    attempt_within(plugin, folder, options, &LIMITS)
}

/// As [`attempt`], within other limits.
fn attempt_within(plugin: &ReaderPlugin, folder: &Path, options: &SceneOptions, limits: &Limits) -> Result<RawScene> {
    let open = || (plugin.open)(folder, options, limits).and_then(|scene| scene.validate().map(|()| scene));
    catch_unwind(AssertUnwindSafe(open)).unwrap_or_else(|_| Err(Error::backend(folder.display().to_string(), PANIC, "Return an error instead")))
}

const PANIC: &str = "the reader panicked";

fn is_panic(e: &Error) -> bool {
    matches!(e, Error::Backend { problem, .. } if problem == PANIC)
}

fn temporary() -> Result<tempfile::TempDir> {
    tempfile::tempdir().map_err(|e| Error::io(std::env::temp_dir(), e))
}

fn probes_its_own(plugin: &ReaderPlugin, folder: &Path) -> Result<Vec<String>> {
    let empty = temporary()?;
    let missing = empty.path().join("missing");
    let mut found = Vec::new();
    for (path, what, wanted) in [(folder, "its own dataset", true), (empty.path(), "an empty folder", false), (&missing, "a missing folder", false)] {
        match catch_unwind(|| (plugin.probe)(path)) {
            Ok(answer) if answer == wanted => {}
            Ok(answer) => found.push(format!("it answers {answer} for {what}")),
            Err(_) => found.push(format!("it panics on {what}")),
        }
        if !wanted {
            match attempt(plugin, path, &SceneOptions::default()) {
                Ok(_) => found.push(format!("{what} was opened")),
                Err(e) if is_panic(&e) => found.push(format!("opening {what} panics")),
                Err(_) => {}
            }
        }
    }
    Ok(found)
}

fn soundness(scene: &RawScene) -> Vec<String> {
    let mut found = Vec::new();
    if !scene.views.iter().any(|v| v.split == Split::Train) {
        found.push("there is no training view".into());
    }
    let mut timed: Vec<&RawView> = scene.views.iter().filter(|v| v.time.is_some()).collect();
    timed.sort_by_key(|v| v.frame);
    if let Some(pair) = timed.windows(2).find(|p| if p[0].frame == p[1].frame { p[0].time != p[1].time } else { p[0].time > p[1].time }) {
        found.push(format!("frame {} is at {:?}, frame {} at {:?}", pair[0].frame, pair[0].time, pair[1].frame, pair[1].time));
    }
    let empty = match scene.init_box {
        Some(InitBox::Corners { low, high }) => !(0..3).all(|k| low[k] < high[k]),
        Some(InitBox::Cube { half_share }) => !(half_share.is_finite() && half_share > 0.0),
        None => false,
    };
    if empty {
        found.push(format!("its box {:?} is empty", scene.init_box));
    }
    found
}

fn images(scene: &RawScene) -> Vec<String> {
    let step = scene.views.len().div_ceil(IMAGES).max(1);
    let (mut found, mut read) = (Vec::new(), 0);
    for (index, view) in scene.views.iter().enumerate().step_by(step) {
        let camera = &scene.cameras[view.camera];
        let outcome = catch_unwind(AssertUnwindSafe(|| image(camera, &view.image)));
        match outcome.unwrap_or_else(|_| Err(Error::backend(format!("view {index}"), "loading its image panics", "Return an error instead"))) {
            Ok(was_read) => read += usize::from(was_read),
            Err(e) => found.push(e.to_string()),
        }
    }
    let has_video = scene.views.iter().any(|v| matches!(v.image, ImageSource::Video { .. }));
    if read == 0 && found.is_empty() && !has_video {
        found.push("none of its images exists".into());
    }
    found
}

/// Whether there is an image; its size must match the camera. Videos are skipped, because they need an external program.
fn image(camera: &RawCamera, source: &ImageSource) -> Result<bool> {
    match source {
        ImageSource::Video { .. } => Ok(false),
        ImageSource::File { path, .. } if !path.is_file() => Ok(false),
        ImageSource::File { path, mask, depth } => {
            let object = path.display().to_string();
            let found = files::read_png_or_jpeg(path, &LIMITS)?;
            fits(&object, camera, &found, true)?;
            if let Some(mask) = mask.as_ref().filter(|m| m.is_file()) {
                let size = files::image_size(mask, &LIMITS)?;
                if size != (found.width, found.height) {
                    return Err(Error::data(
                        mask.display().to_string(),
                        format!("a mask of {size:?} pixels for {object}"),
                        "Give the mask the size of its image",
                    ));
                }
            }
            if let Some(file) = depth {
                let depth = files::read_depth(&file.path, file.unit, &LIMITS)?;
                depth.validate_for(&file.path.display().to_string(), [found.width, found.height])?;
            }
            Ok(true)
        }
        ImageSource::Frames { source, index } => {
            fits(&format!("image {index}"), camera, &source.load(*index)?, false)?;
            if let Some(depth) = source.depth(*index)? {
                depth.validate_for(&format!("the depth of image {index}"), camera.size)?;
            }
            Ok(true)
        }
    }
}

/// Files may have another size than the calibration if the aspect is the same; frames that a reader computes have the camera's size.
fn fits(object: &str, camera: &RawCamera, image: &Image8, scaled: bool) -> Result<()> {
    image.validate(object)?;
    let scale = [0, 1].map(|k| f64::from([image.width, image.height][k]) / f64::from(camera.size[k]));
    let same = if scaled { (scale[0] / scale[1] - 1.0).abs() <= 0.01 } else { camera.size == [image.width, image.height] };
    if same {
        return Ok(());
    }
    let problem = format!("{}x{} pixels, camera {} has {}x{}", image.width, image.height, camera.name, camera.size[0], camera.size[1]);
    Err(Error::data(object, problem, "Give cameras the size of their images"))
}

fn repeats(plugin: &ReaderPlugin, folder: &Path, first: &RawScene) -> Result<Vec<String>> {
    let second = attempt(plugin, folder, &SceneOptions::default())?;
    let text = |s: &RawScene| format!("{:?} {:?} {:?} {:?}", s.cameras, s.views, s.points, s.init_box);
    Ok(if text(first) == text(&second) { Vec::new() } else { vec!["two openings differ".into()] })
}

fn follows_the_size(plugin: &ReaderPlugin, folder: &Path, scene: &RawScene) -> Result<Vec<String>> {
    if !scene.resized {
        return Ok(Vec::new());
    }
    let small = attempt(plugin, folder, &SceneOptions { width: 8, ..SceneOptions::default() })?;
    let wrong = small.cameras.iter().find(|c| c.size[0] != 8);
    Ok(wrong.map(|c| format!("camera {} has {:?} pixels, but scene.width is 8", c.name, c.size)).into_iter().collect())
}

fn survives_damage(plugin: &ReaderPlugin, folder: &Path) -> Result<Vec<String>> {
    let mut found = Vec::new();
    if !folder.exists() {
        return Ok(found);
    }
    let copy = temporary()?;
    let target = copy.path().join("dataset");
    let mut copied = Vec::new();
    copy_tree(folder, &target, &mut copied)?;
    // Index files first; most datasets have few.
    copied.sort_by_key(|p| (files::is_image(p), p.clone()));
    let images = copied.iter().filter(|p| files::is_image(p)).count();
    copied.truncate((copied.len() - images + FILES / 12).min(FILES));
    for (number, file) in copied.iter().enumerate() {
        let sound = std::fs::read(file).map_err(|e| Error::io(file, e))?;
        for (what, bytes) in damages(&sound, Seed::root(5).child("reader").index(number as u64)) {
            std::fs::write(file, bytes).map_err(|e| Error::io(file, e))?;
            match attempt(plugin, &target, &SceneOptions::default()) {
                Err(e) if is_panic(&e) => found.push(format!("it panics where {} {what}", files::file_name(file))),
                Err(e) if e.to_string().len() < 12 => found.push(format!("{} {what}: the error {e:?} is too short to be useful", files::file_name(file))),
                _ => {}
            }
        }
        std::fs::write(file, &sound).map_err(|e| Error::io(file, e))?;
    }
    found.truncate(8);
    Ok(found)
}

fn copy_tree(from: &Path, to: &Path, copied: &mut Vec<PathBuf>) -> Result<()> {
    if from.is_dir() {
        std::fs::create_dir_all(to).map_err(|e| Error::io(to, e))?;
        for path in files::list(from, |_| true)? {
            copy_tree(&path, &to.join(files::file_name(&path)), copied)?;
        }
        return Ok(());
    }
    let length = std::fs::metadata(from).map_err(|e| Error::io(from, e))?.len();
    LIMITS.check_bytes(&from.display().to_string(), length)?;
    std::fs::copy(from, to).map_err(|e| Error::io(from, e))?;
    copied.push(to.to_path_buf());
    Ok(())
}

/// Damaged versions of a file, each with a description of the damage.
fn damages(sound: &[u8], seed: Seed) -> Vec<(String, Vec<u8>)> {
    let mut out = vec![("is empty".to_string(), Vec::new())];
    if sound.is_empty() {
        return out;
    }
    let draw = |name: &str, k: usize, below: usize| (seed.child(name).index(k as u64).value() % below.max(1) as u64) as usize;
    for k in 0..DAMAGES {
        let at = draw("cut", k, sound.len());
        out.push((format!("is truncated at byte {at}"), sound[..at].to_vec()));
        let at = draw("flip", k, sound.len());
        let mut bytes = sound.to_vec();
        bytes[at] ^= 1 << (k % 8);
        out.push((format!("has a flipped bit at byte {at}"), bytes));
        // A wrong size or count; offsets near the beginning first, where headers are.
        let at = if k < 4 { 8 * k } else { draw("word", k, sound.len()) };
        let mut bytes = sound.to_vec();
        let value: u8 = if k % 2 == 0 { 0xff } else { 0x7f };
        bytes.iter_mut().skip(at).take(8).for_each(|b| *b = value);
        out.push((format!("has bytes {value:#x} from byte {at}"), bytes));
    }
    if let Ok(text) = std::str::from_utf8(sound) {
        let numbers = numbers(text);
        for k in 0..(2 * DAMAGES).min(ABSURD.len() * numbers.len()) {
            let (start, end) = numbers[draw("number", k, numbers.len())];
            let absurd = ABSURD[k % ABSURD.len()];
            out.push((
                format!("has '{absurd}' instead of '{}' at byte {start}", &text[start..end]),
                [&text[..start], absurd, &text[end..]].concat().into_bytes(),
            ));
        }
    }
    out
}

/// The byte ranges of numbers in a text.
fn numbers(text: &str) -> Vec<(usize, usize)> {
    let (mut found, mut start) = (Vec::new(), None);
    for (i, b) in text.bytes().chain([b' ']).enumerate() {
        let part = b.is_ascii_digit() || (start.is_some() && b"+-.eE".contains(&b)) || (start.is_none() && b == b'-');
        match (start, part) {
            (None, true) => start = Some(i),
            (Some(from), false) => {
                found.push((from, i));
                start = None;
            }
            _ => {}
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::{ImageSource, RawCamera, image, numbers};
    use crate::{DepthFile, DepthImage, Distortion, FrameSource, Image8, Result};
    use std::sync::Arc;

    /// An image of 8x6 pixels, and depth of as many as stated.
    struct Deep([u32; 2]);

    impl FrameSource for Deep {
        fn load(&self, _: usize) -> Result<Image8> {
            Ok(Image8 { width: 8, height: 6, channels: 3, data: vec![0; 144] })
        }
        fn depth(&self, _: usize) -> Result<Option<DepthImage>> {
            let [width, height] = self.0;
            Ok(Some(DepthImage { width, height, values: vec![1.0; (width * height) as usize] }))
        }
    }

    #[test]
    fn depth_of_other_proportions_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let (path, named) = (folder.path().join("a.png"), folder.path().join("depth.png"));
        ::image::RgbImage::new(8, 6).save(&path).unwrap();
        let camera = RawCamera {
            name: "a".into(),
            size: [8, 6],
            focal: [9.0; 2],
            principal: [4.0, 3.0],
            distortion: Distortion::None,
            world_to_camera: std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j)))),
        };
        for (size, fits) in [([8, 6], true), ([4, 3], true), ([6, 8], false)] {
            ::image::ImageBuffer::<::image::Luma<u16>, Vec<u16>>::new(size[0], size[1]).save(&named).unwrap();
            let file = ImageSource::File { path: path.clone(), mask: None, depth: Some(DepthFile { path: named.clone(), unit: 1e-3 }) };
            for source in [file, ImageSource::Frames { source: Arc::new(Deep(size)), index: 0 }] {
                assert_eq!(image(&camera, &source).is_ok(), fits, "{source:?}, depth of {size:?} pixels");
            }
        }
    }

    #[test]
    fn numbers_are_found_in_text() {
        let text = "{\"w\": 640, \"x\": [-1.5e-3, 7]}";
        let words: Vec<&str> = numbers(text).into_iter().map(|(a, b)| &text[a..b]).collect();
        assert_eq!(words, ["640", "-1.5e-3", "7"]);
    }
}
