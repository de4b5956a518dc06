//! `rig`: cameras and images listed in `rig.txt`, images as plain-text PPM files, which the framework itself does not read.

use cc4dgs_core::reader::files::{file_name, read_text};
use cc4dgs_core::{
    Camera, Distortion, Error, FrameSource, Image8, ImageSource, Limits, Plugin, RawCamera, RawScene, RawView, ReaderPlugin, Result, SceneOptions, Split,
    inventory,
};
use std::path::{Path, PathBuf};
use std::str::{FromStr, SplitWhitespace};
use std::sync::Arc;

/// The images, by index.
struct Ppm {
    files: Vec<PathBuf>,
    limits: Limits,
}

impl FrameSource for Ppm {
    fn load(&self, index: usize) -> Result<Image8> {
        let path =
            self.files.get(index).ok_or_else(|| Error::parameter(format!("image {index}"), format!("{} exist", self.files.len()), "Ask for one of them"))?;
        let object = path.display().to_string();
        let text = read_text(path, &self.limits)?;
        let mut words = Words { object: &object, words: text.split_whitespace() };
        if words.next::<String>()? != "P3" {
            return Err(Error::data(object, "it does not start with P3", "Write it as a plain PPM"));
        }
        let (width, height, _largest): (u32, u32, u8) = (words.next()?, words.next()?, words.next()?);
        // Nothing is allocated because a file claims to need it.
        self.limits.check_pixels(&object, u64::from(width), u64::from(height))?;
        let data = (0..3 * width as usize * height as usize).map(|_| words.next()).collect::<Result<_>>()?;
        Ok(Image8 { width, height, channels: 3, data })
    }
}

struct Words<'a> {
    object: &'a str,
    words: SplitWhitespace<'a>,
}

impl Words<'_> {
    fn next<T: FromStr>(&mut self) -> Result<T> {
        let word = self.words.next().unwrap_or("the end of the line");
        word.parse().map_err(|_| Error::data(self.object, format!("{word:?} is not the value expected there"), "Correct the file"))
    }
    fn point(&mut self) -> Result<[f64; 3]> {
        Ok([self.next()?, self.next()?, self.next()?])
    }
}

fn probe(path: &Path) -> bool {
    path.join("rig.txt").is_file()
}

/// Lines are `camera NAME WIDTH HEIGHT FOCAL EYE TARGET` (z is up) and `image CAMERA FRAME FILE train|test`, where CAMERA is a number from 0.
fn open(path: &Path, _: &SceneOptions, limits: &Limits) -> Result<RawScene> {
    let text = read_text(&path.join("rig.txt"), limits)?;
    let mut scene = RawScene { name: file_name(path), ..RawScene::default() };
    let (mut rows, mut files) = (Vec::new(), Vec::new());
    for (number, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        let object = format!("{}/rig.txt: line {}", path.display(), number + 1);
        let bad = |problem: String| Error::data(object.clone(), problem, "Correct the file");
        let mut words = Words { object: &object, words: line.split_whitespace() };
        match words.next::<String>()?.as_str() {
            "camera" => {
                let (name, size, focal): (String, [u32; 2], f64) = (words.next()?, [words.next()?, words.next()?], words.next()?);
                limits.check_pixels(&object, u64::from(size[0]), u64::from(size[1]))?;
                let pose = Camera::look_at(&name, (size[0], size[1]), 1.0, words.point()?, words.point()?, [0.0, 0.0, 1.0]);
                scene.cameras.push(RawCamera {
                    name,
                    size,
                    focal: [focal; 2],
                    principal: size.map(|n| 0.5 * f64::from(n)),
                    distortion: Distortion::None,
                    world_to_camera: pose.world_to_camera,
                });
            }
            "image" => {
                let (camera, frame, file): (usize, usize, String) = (words.next()?, words.next()?, words.next()?);
                let split = match words.next::<String>()?.as_str() {
                    "train" => Split::Train,
                    "test" => Split::Test,
                    other => return Err(bad(format!("the split {other:?} is neither train nor test"))),
                };
                rows.push((camera, frame, split));
                files.push(path.join(file));
            }
            other => return Err(bad(format!("{other:?} is neither camera nor image"))),
        }
    }
    let source: Arc<dyn FrameSource> = Arc::new(Ppm { files, limits: *limits });
    let view = |(index, (camera, frame, split))| {
        let image = ImageSource::Frames { source: source.clone(), index };
        RawView { camera, frame, time: None, split, image }
    };
    scene.views = rows.into_iter().enumerate().map(view).collect();
    Ok(scene)
}

inventory::submit! {
    ReaderPlugin {
        info: Plugin { name: "rig", version: "1", summary: "a text file of cameras, images as plain PPM", paper: "an example", schema: "", capabilities: &[] },
        looks_for: "rig.txt",
        order: 1000,
        probe,
        open,
    }
}
