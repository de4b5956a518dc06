//! COLMAP models, text or binary, with their sparse points. Every eighth image is held out. Scenes are static, unless each image has a video of its name.

use super::assemble::fit_to_image;
use super::masks::warn_of_mask_folder;
use super::nerfstudio::{HOLD_OUT_EVERY, LEAST_HELD_OUT, NOTHING_HELD_OUT, file_named};
use super::video::{self, Footage};
use super::{colmap_binary, colmap_text};
use cc4dgs_core::reader::files::{file_name, list, read_bytes, read_text};
use cc4dgs_core::reader::pose::{Matrix4, from_quaternion};
use cc4dgs_core::{
    Distortion, Error, ImageSource, Limits, Plugin, RawCamera, RawPoints, RawScene, RawView, ReaderPlugin, Result, SceneOptions, Split, inventory, plural,
};
use glam::DVec3;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// A camera record: model, size in pixels, parameters.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ColmapCamera {
    pub model: Model,
    pub size: [u64; 2],
    pub parameters: Vec<f64>,
}

/// An image record.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ColmapImage {
    pub camera: u32,
    pub name: String,
    /// Quaternion (w,x,y,z), world to camera.
    pub rotation: [f64; 4],
    pub translation: [f64; 3],
}

/// The camera models this reader knows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Model {
    SimplePinhole,
    Pinhole,
    SimpleRadial,
    Radial,
    OpenCv,
    OpenCvFisheye,
    SimpleRadialFisheye,
    RadialFisheye,
}

impl Model {
    const ALL: [(Model, &'static str, i32, usize); 8] = [
        (Model::SimplePinhole, "SIMPLE_PINHOLE", 0, 3),
        (Model::Pinhole, "PINHOLE", 1, 4),
        (Model::SimpleRadial, "SIMPLE_RADIAL", 2, 4),
        (Model::Radial, "RADIAL", 3, 5),
        (Model::OpenCv, "OPENCV", 4, 8),
        (Model::OpenCvFisheye, "OPENCV_FISHEYE", 5, 8),
        (Model::SimpleRadialFisheye, "SIMPLE_RADIAL_FISHEYE", 8, 4),
        (Model::RadialFisheye, "RADIAL_FISHEYE", 9, 5),
    ];
    /// By COLMAP's number.
    pub(crate) fn from_id(id: i32) -> Option<Self> {
        Self::ALL.iter().find(|m| m.2 == id).map(|m| m.0)
    }
    /// By COLMAP's name.
    pub(crate) fn from_name(name: &str) -> Option<Self> {
        Self::ALL.iter().find(|m| m.1 == name).map(|m| m.0)
    }
    /// How many numbers it has.
    pub(crate) fn parameters(self) -> usize {
        Self::ALL.iter().find(|m| m.0 == self).map_or(0, |m| m.3)
    }
    pub(crate) fn known() -> String {
        Self::ALL.iter().map(|m| m.1).collect::<Vec<_>>().join(", ")
    }
}

impl ColmapCamera {
    /// Focal lengths, principal point, lens.
    fn intrinsics(&self) -> ([f64; 2], [f64; 2], Distortion) {
        let p = &self.parameters;
        let brown = |k1: f64, k2: f64, p1: f64, p2: f64| Distortion::Brown { radial: [k1, k2, 0.0, 0.0], tangential: [p1, p2] };
        match self.model {
            Model::SimplePinhole => ([p[0]; 2], [p[1], p[2]], Distortion::None),
            Model::Pinhole => ([p[0], p[1]], [p[2], p[3]], Distortion::None),
            Model::SimpleRadial => ([p[0]; 2], [p[1], p[2]], brown(p[3], 0.0, 0.0, 0.0)),
            Model::Radial => ([p[0]; 2], [p[1], p[2]], brown(p[3], p[4], 0.0, 0.0)),
            Model::OpenCv => ([p[0], p[1]], [p[2], p[3]], brown(p[4], p[5], p[6], p[7])),
            Model::OpenCvFisheye => ([p[0], p[1]], [p[2], p[3]], Distortion::Fisheye { radial: [p[4], p[5], p[6], p[7]] }),
            Model::SimpleRadialFisheye => ([p[0]; 2], [p[1], p[2]], Distortion::Fisheye { radial: [p[3], 0.0, 0.0, 0.0] }),
            Model::RadialFisheye => ([p[0]; 2], [p[1], p[2]], Distortion::Fisheye { radial: [p[3], p[4], 0.0, 0.0] }),
        }
    }
}

/// The folder with `cameras.bin` or `cameras.txt`.
fn model_folder(path: &Path) -> Option<PathBuf> {
    let candidates = [path.join("sparse/0"), path.join("sparse"), path.join("colmap/sparse/0"), path.to_path_buf()];
    candidates.into_iter().find(|f| ["bin", "txt"].iter().any(|e| is_complete(f, e)))
}

/// Whether a folder has cameras and images in the form with this extension.
fn is_complete(folder: &Path, extension: &str) -> bool {
    ["cameras", "images"].iter().all(|stem| folder.join(format!("{stem}.{extension}")).is_file())
}

/// The folder of the project that the dataset at `path` belongs to: of a COLMAP model in a folder `sparse`, or in a folder of it, the one above `sparse`; else
/// `path`.
pub(crate) fn project_folder(path: &Path) -> PathBuf {
    let is_model = ["cameras.bin", "cameras.txt"].iter().any(|name| path.join(name).is_file());
    // A path such as `.` has no name.
    let whole = path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    let is_sparse = |folder: Option<&Path>| folder.and_then(Path::file_name).is_some_and(|name| name == "sparse");
    if is_model && is_sparse(Some(whole.as_path())) {
        path.join("..")
    } else if is_model && is_sparse(whole.parent()) {
        path.join("../..")
    } else {
        path.to_path_buf()
    }
}

struct ColmapModel {
    cameras: BTreeMap<u32, ColmapCamera>,
    images: Vec<ColmapImage>,
    points: RawPoints,
}

fn read_model(folder: &Path, limits: &Limits) -> Result<ColmapModel> {
    let file = |stem: &str, extension: &str| folder.join(format!("{stem}.{extension}"));
    let named = |path: &Path| path.display().to_string();
    let (cameras, images, points);
    if is_complete(folder, "bin") {
        let (c, p) = (file("cameras", "bin"), file("points3D", "bin"));
        cameras = colmap_binary::cameras(&named(&c), &read_bytes(&c, limits)?)?;
        images = read_images(folder, limits)?;
        points = if p.is_file() { colmap_binary::points(&named(&p), &read_bytes(&p, limits)?, limits)? } else { RawPoints::default() };
    } else {
        let (c, p) = (file("cameras", "txt"), file("points3D", "txt"));
        cameras = colmap_text::cameras(&named(&c), &read_text(&c, limits)?)?;
        images = read_images(folder, limits)?;
        points = if p.is_file() { colmap_text::points(&named(&p), &read_text(&p, limits)?, limits)? } else { RawPoints::default() };
    }
    Ok(ColmapModel { cameras, images, points })
}

/// The images of the model in `folder`, of its binary form where it has both.
fn read_images(folder: &Path, limits: &Limits) -> Result<Vec<ColmapImage>> {
    let binary = is_complete(folder, "bin");
    let file = folder.join(if binary { "images.bin" } else { "images.txt" });
    let name = file.display().to_string();
    if binary { colmap_binary::images(&name, &read_bytes(&file, limits)?) } else { colmap_text::images(&name, &read_text(&file, limits)?) }
}

/// The folder with the images of a model at `path`.
fn image_folder(path: &Path, images: &[ColmapImage]) -> PathBuf {
    let folders = [path.join("images"), path.join("../images"), path.join("../../images"), path.to_path_buf()];
    let has_images = |f: &&PathBuf| images.iter().any(|image| file_named(f, &image.name).is_file());
    folders.iter().find(has_images).or_else(|| folders.iter().find(|f| f.is_dir())).unwrap_or(&folders[0]).clone()
}

/// The files of the images of the model at `path`, some of which may be missing; none where there is no sound model.
pub(super) fn image_files(path: &Path, limits: &Limits) -> Vec<PathBuf> {
    let images = model_folder(path).and_then(|folder| read_images(&folder, limits).ok()).unwrap_or_default();
    let folder = image_folder(path, &images);
    images.iter().map(|image| file_named(&folder, &image.name)).collect()
}

inventory::submit! {
    ReaderPlugin {
        info: Plugin {
            name: "colmap",
            version: "1",
            summary: "COLMAP models, static or with a video per image",
            paper: "Structure-from-Motion Revisited (Schoenberger and Frahm 2016)",
            schema: "",
            capabilities: &[],
        },
        looks_for: "sparse/0/cameras.bin or .txt, with images.* beside it and images in images/, or a video of each image's name (COLMAP)",
        order: 600,
        probe,
        open,
    }
}

fn probe(path: &Path) -> bool {
    model_folder(path).is_some()
}

fn open(path: &Path, options: &SceneOptions, limits: &Limits) -> Result<RawScene> {
    let folder = model_folder(path)
        .ok_or_else(|| Error::data(path.display().to_string(), "it holds no cameras.bin or cameras.txt", "Point to the folder above sparse/"))?;
    let object = folder.display().to_string();
    let ColmapModel { cameras, mut images, points } = read_model(&folder, limits)?;
    images.sort_by(|a, b| a.name.cmp(&b.name));
    let mut scene = RawScene { name: file_name(path), points: Some(points), ..Default::default() };
    if folder != path && folder.ends_with("0") && ["bin", "txt"].iter().any(|e| is_complete(&folder.with_file_name("1"), e)) {
        let read = format!("there are several models; that of {object} is read, with {} {}", images.len(), plural(images.len(), "image", "images"));
        scene.warnings.push(format!("{read} (to read another, give its folder as the path)"));
    }
    let image_folder = image_folder(path, &images);
    let beside = if image_folder.ends_with("images") { image_folder.parent() } else { None };
    warn_of_mask_folder(&[beside.unwrap_or(&image_folder), &project_folder(path)], &mut scene.warnings);
    let hold_out = images.len() >= LEAST_HELD_OUT;
    if !hold_out && options.test_cameras.is_none() {
        scene.warnings.push(NOTHING_HELD_OUT.into());
    }
    let mut videos = videos(path, &images, options, limits, &mut scene.warnings)?.into_iter();
    for (index, image) in images.iter().enumerate() {
        let bad = |problem: String| Error::data(format!("{object}: image {}", image.name), problem, "Export the model again");
        let camera = cameras.get(&image.camera).ok_or_else(|| bad(format!("its camera {} is not in the model", image.camera)))?;
        let (focal, principal, distortion) = camera.intrinsics();
        let size = camera.size.map(|v| u32::try_from(v).unwrap_or(u32::MAX));
        limits.check_pixels(&format!("{object}: camera {}", image.camera), camera.size[0], camera.size[1])?;
        let world_to_camera: Matrix4 = from_quaternion(image.rotation, image.translation).map_err(bad)?;
        let mut camera = RawCamera { name: image.name.clone(), size, focal, principal, distortion, world_to_camera };
        let split = if hold_out && index % HOLD_OUT_EVERY == 0 { Split::Test } else { Split::Train };
        if let Some(footage) = videos.next() {
            fit_to_image(&mut camera, (footage.size[0], footage.size[1]), &mut scene.warnings)?;
            scene.cameras.push(camera);
            let shown = footage.images.into_iter().enumerate().filter_map(|(frame, image)| image.map(|image| (frame, image)));
            scene.views.extend(shown.map(|(frame, image)| RawView { camera: index, frame, time: None, split, image }));
            continue;
        }
        scene.cameras.push(camera);
        let source = ImageSource::file(file_named(&image_folder, &image.name));
        scene.views.push(RawView { camera: index, frame: 0, time: Some(0.0), split, image: source });
    }
    Ok(scene)
}

/// The footage of the images, in their order. Empty unless each image has a video.
fn videos(path: &Path, images: &[ColmapImage], options: &SceneOptions, limits: &Limits, warnings: &mut Vec<String>) -> Result<Vec<Footage>> {
    video::footage(&video_files(path, images, warnings)?, options, limits, warnings)
}

/// Whether there is a file that is not hidden.
fn is_shown(path: &Path) -> bool {
    path.is_file() && !file_name(path).starts_with('.')
}

/// The videos of the images, in their order: `cam00.mp4` for `cam00.png`, in the folder of the project or in its `videos/`, also where `path` is the folder of a
/// model in `sparse/`. Empty unless each image has one of its own. Hidden files do not count.
fn video_files(path: &Path, images: &[ColmapImage], warnings: &mut Vec<String>) -> Result<Vec<PathBuf>> {
    let project = project_folder(path);
    let own = (project != path).then(|| [path.join("videos"), path.to_path_buf()]);
    let folders: Vec<PathBuf> = [project.join("videos"), project].into_iter().chain(own.into_iter().flatten()).filter(|f| f.is_dir()).collect();
    let stem = |file: &Path| file.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    let mut by_stem: BTreeMap<String, PathBuf> = BTreeMap::new();
    let mut pairs = Vec::new();
    // Of two videos of one name, that beside the model counts.
    for folder in &folders {
        for file in list(folder, |p| video::is_video(p) && is_shown(p))? {
            let other = by_stem.insert(stem(&file), file.clone());
            pairs.extend(other.map(|other| format!("{} and {}", other.display(), file.display())));
        }
    }
    if let Some(first) = pairs.first() {
        let more = if pairs.len() > 1 { ", …" } else { "" };
        warnings.push(format!("of {} {} of videos of one name the second is used: {first}{more}", pairs.len(), plural(pairs.len(), "pair", "pairs")));
    }
    if by_stem.is_empty() {
        let stems: BTreeSet<String> = images.iter().map(|image| stem(Path::new(&image.name))).collect();
        for folder in folders.iter().filter(|f| f.ends_with("videos")) {
            let unknown = list(folder, |p| is_shown(p) && stems.contains(&stem(p)))?;
            if let Some(first) = unknown.first() {
                warnings.push(format!(
                    "{} {} in {} {} ({}): the known endings are {}",
                    unknown.len(),
                    plural(unknown.len(), "file", "files"),
                    folder.display(),
                    plural(unknown.len(), "is not read as a video", "are not read as videos"),
                    file_name(first),
                    video::ENDINGS.join(", ")
                ));
            }
        }
    }
    let available = by_stem.len();
    let of = |image: &ColmapImage| by_stem.remove(Path::new(&image.name).file_stem()?.to_str()?);
    let found: Vec<Option<PathBuf>> = images.iter().map(of).collect();
    if let Some(lacking) = found.iter().position(Option::is_none) {
        if available > 0 {
            let (count, name) = (found.iter().filter(|f| f.is_none()).count(), &images[lacking].name);
            let have = plural(count, "has no video of its name", "have no video of their name");
            let problem = format!("{count} of {} images {have} ({name})", images.len());
            let videos = plural(available, "video is", "videos are");
            warnings.push(format!("{problem}: the {available} {videos} not used, and the scene is read as one instant"));
        }
        return Ok(Vec::new());
    }
    if !by_stem.is_empty() {
        let names = by_stem.values().take(3).map(|file| file_name(file)).collect::<Vec<_>>().join(", ");
        let more = if by_stem.len() > 3 { ", …" } else { "" };
        let (count, [are, their]) = (by_stem.len(), [plural(by_stem.len(), "is", "are"), plural(by_stem.len(), "its", "their")]);
        warnings.push(format!("{count} of {available} videos {are} not used, since the COLMAP model has no image of {their} name: {names}{more}"));
    }
    Ok(found.into_iter().flatten().collect())
}

/// The points of a COLMAP model beside another calibration, if both use the same world: every camera must have an image of its name whose
/// centre agrees to a thousandth of the rig.
pub(crate) fn points_in_same_world(path: &Path, cameras: &[RawCamera], limits: &Limits) -> Result<Option<RawPoints>> {
    let Some(folder) = model_folder(path) else { return Ok(None) };
    let model = read_model(&folder, limits)?;
    let centers: BTreeMap<&str, DVec3> = model
        .images
        .iter()
        .filter_map(|i| {
            let stem = Path::new(&i.name).file_stem()?.to_str()?;
            Some((stem, center(&from_quaternion(i.rotation, i.translation).ok()?)))
        })
        .collect();
    let own: Vec<DVec3> = cameras.iter().map(|c| center(&c.world_to_camera)).collect();
    let spread = own.iter().flat_map(|a| own.iter().map(move |b| (*a - *b).length())).fold(0.0, f64::max);
    let agree = cameras.iter().zip(&own).all(|(c, o)| centers.get(c.name.as_str()).is_some_and(|p| (*p - *o).length() <= 1e-3 * spread));
    Ok((agree && spread > 0.0).then_some(model.points))
}

fn center(m: &Matrix4) -> DVec3 {
    DVec3::from(std::array::from_fn::<f64, 3, _>(|j| -(0..3).map(|i| m[i][j] * m[i][3]).sum::<f64>()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(name: &str) -> ColmapImage {
        ColmapImage { camera: 1, name: name.into(), rotation: [1.0, 0.0, 0.0, 0.0], translation: [0.0; 3] }
    }

    #[test]
    fn videos_have_any_usual_ending_and_others_are_told() {
        let dir = tempfile::tempdir().unwrap();
        let videos = dir.path().join("videos");
        std::fs::create_dir(&videos).unwrap();
        let film = |name: &str| std::fs::write(videos.join(name), "").unwrap();
        let found = || {
            let mut warnings = Vec::new();
            let files = video_files(dir.path(), &[image("c0.png")], &mut warnings).unwrap();
            (files.iter().map(|file| file_name(file)).collect::<Vec<_>>(), warnings.join("\n"))
        };
        film("c0.braw");
        let (files, said) = found();
        assert!(files.is_empty() && said.contains("is not read as a video (c0.braw)") && said.contains("m2ts"), "{files:?} {said}");
        for name in ["c0.MTS", "c0.m2ts", "c0.MP4", "c0.mov", "c0.mkv", "c0.avi", "c0.webm"] {
            film(name);
            assert_eq!(found(), (vec![name.to_string()], String::new()));
            std::fs::remove_file(videos.join(name)).unwrap();
        }
        film("c0.MTS");
        film("c0.mp4");
        let (files, said) = found();
        assert!(files == ["c0.mp4"] && said.contains("of 1 pair of videos of one name") && said.contains("c0.MTS and "), "{files:?} {said}");
    }

    #[test]
    fn videos_are_those_of_the_project_and_those_without_an_image_are_told() {
        let dir = tempfile::tempdir().unwrap();
        let model = dir.path().join("sparse/1");
        std::fs::create_dir_all(&model).unwrap();
        std::fs::create_dir(dir.path().join("videos")).unwrap();
        std::fs::write(model.join("cameras.bin"), "").unwrap();
        let film = |name: &str| std::fs::write(dir.path().join("videos").join(name), "").unwrap();
        for name in ["c0.mp4", "c1.MOV", "._c0.mp4"] {
            film(name);
        }
        let images = ["c0.png", "c1.png"].map(image);
        let found = |path: &Path| {
            let mut warnings = Vec::new();
            let files = video_files(path, &images, &mut warnings).unwrap();
            assert!(files.iter().all(|file| file.is_file()));
            (files.iter().map(|file| file_name(file)).collect::<Vec<_>>(), warnings.join("\n"))
        };
        let both = vec!["c0.mp4".to_string(), "c1.MOV".to_string()];
        for path in [dir.path(), model.as_path()] {
            assert_eq!(found(path), (both.clone(), String::new()));
        }
        // COLMAP has not registered the image of this camera.
        film("c2.mp4");
        for path in [dir.path(), model.as_path()] {
            let (files, said) = found(path);
            assert!(
                files == both && said.contains("1 of 3 videos is not used, since the COLMAP model has no image of its name") && said.contains("c2.mp4"),
                "{files:?} {said}"
            );
        }
    }
}
