//! COLMAP models, text or binary, with their sparse points. Every eighth image is held out. Scenes are static, unless each image has a video of its name or of
//! that of its folder.

use super::assemble::fit_to_image;
use super::colmap_camera::ColmapCamera;
use super::colmap_videos::videos;
use super::masks::warn_of_mask_folder;
use super::nerfstudio::{HOLD_OUT_EVERY, LEAST_HELD_OUT, NOTHING_HELD_OUT, file_named};
use super::{colmap_binary, colmap_text};
use cc4dgs_core::reader::files::{file_name, read_bytes, read_text};
use cc4dgs_core::reader::pose::{Matrix4, from_quaternion};
use cc4dgs_core::{Error, ImageSource, Limits, Plugin, RawCamera, RawPoints, RawScene, RawView, ReaderPlugin, Result, SceneOptions, Split, inventory, plural};
use glam::DVec3;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Distance up to which two centres are those of one camera, as a share of the size of the rig.
const SAME_CENTER: f64 = 1e-3;

/// An image record.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ColmapImage {
    pub camera: u32,
    pub name: String,
    /// Quaternion (w,x,y,z), world to camera.
    pub rotation: [f64; 4],
    pub translation: [f64; 3],
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
        looks_for: "sparse/0/cameras.bin or .txt, with images.* beside it and images in images/, or a video of each image's name or folder (COLMAP)",
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
        let named = format!("{object}: camera {}", image.camera);
        let (focal, principal, distortion) = camera.intrinsics(&named)?;
        let size = camera.size.map(|v| u32::try_from(v).unwrap_or(u32::MAX));
        limits.check_pixels(&named, camera.size[0], camera.size[1])?;
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
    let (own, spread) = rig(cameras);
    let agree = cameras.iter().zip(&own).all(|(c, o)| centers.get(c.name.as_str()).is_some_and(|p| (*p - *o).length() <= SAME_CENTER * spread));
    Ok((agree && spread > 0.0).then_some(model.points))
}

/// Whether at least half of the images of the model in `folder`, whatever their names, were taken where one of `cameras` stands, to a thousandth of the rig.
/// `None` where there is no sound model with images, or where all cameras stand at one point.
pub(super) fn stands_with(folder: &Path, cameras: &[RawCamera], limits: &Limits) -> Option<bool> {
    if !["bin", "txt"].iter().any(|extension| is_complete(folder, extension)) {
        return None;
    }
    let images = read_images(folder, limits).ok().filter(|images| !images.is_empty())?;
    let (own, spread) = rig(cameras);
    let is_own = |p: DVec3| own.iter().any(|o| (p - *o).length() <= SAME_CENTER * spread);
    let agree = images.iter().filter(|i| from_quaternion(i.rotation, i.translation).is_ok_and(|pose| is_own(center(&pose)))).count();
    (spread > 0.0).then_some(2 * agree >= images.len())
}

/// The centres of `cameras` in the world, and the largest distance of two of them.
fn rig(cameras: &[RawCamera]) -> (Vec<DVec3>, f64) {
    let own: Vec<DVec3> = cameras.iter().map(|c| center(&c.world_to_camera)).collect();
    let spread = own.iter().flat_map(|a| own.iter().map(move |b| (*a - *b).length())).fold(0.0, f64::max);
    (own, spread)
}

fn center(m: &Matrix4) -> DVec3 {
    DVec3::from(std::array::from_fn::<f64, 3, _>(|j| -(0..3).map(|i| m[i][j] * m[i][3]).sum::<f64>()))
}
