//! N3DV ("dynerf") and LLFF scenes: `poses_bounds.npy` with one row per camera, and per camera a video, a folder of frames, or one image.
//! First points come from a dense cloud or a COLMAP model beside it.

use super::camera_box::frustum_box;
use super::dense_clouds::first_points;
use super::nerfstudio::{LEAST_HELD_OUT, NOTHING_HELD_OUT};
use super::npy::read_npy;
use super::video;
use cc4dgs_core::reader::files::{file_name, image_size, is_image, list, read_bytes};
use cc4dgs_core::reader::pose::world_to_camera;
use cc4dgs_core::{Distortion, Error, ImageSource, Limits, Plugin, RawCamera, RawScene, RawView, ReaderPlugin, Result, SceneOptions, Split, inventory, plural};
use glam::{DMat3, DVec3};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The images of one camera in time order.
struct Footage {
    name: String,
    /// `None` where it has no image at that instant.
    images: Vec<Option<ImageSource>>,
    size: [u32; 2],
}

inventory::submit! {
    ReaderPlugin {
        info: Plugin {
            name: "llff",
            version: "1",
            summary: "Neural 3D Video and LLFF scenes",
            paper: "Neural 3D Video Synthesis (Li et al. 2022); Local Light Field Fusion (Mildenhall et al. 2019)",
            schema: "",
            capabilities: &[],
        },
        looks_for: "poses_bounds.npy with cam*.mp4, cam*/ folders of frames, or images/ (N3DV, LLFF)",
        order: 300,
        probe,
        open,
    }
}

fn probe(path: &Path) -> bool {
    path.join("poses_bounds.npy").is_file()
}

fn open(path: &Path, options: &SceneOptions, limits: &Limits) -> Result<RawScene> {
    let file = path.join("poses_bounds.npy");
    let object = file.display().to_string();
    let array = read_npy(&object, &read_bytes(&file, limits)?, limits)?;
    let bad = |problem: String, remedy: &str| Error::data(object.clone(), problem, remedy);
    if array.shape.len() != 2 || array.shape[1] != 17 || array.shape[0] == 0 {
        return Err(bad(format!("its shape is {:?}, not [cameras, 17]", array.shape), "Fetch the file again"));
    }
    if let Some(i) = array.values.iter().position(|v| !v.is_finite()) {
        return Err(bad(format!("row {} holds {}", i / 17, array.values[i]), "Fetch the file again"));
    }
    let mut scene = RawScene { name: file_name(path), ..Default::default() };
    let footage = footage(path, options, limits, &mut scene.warnings)?;
    if footage.len() != array.shape[0] {
        let problem = format!(
            "it has {} {}, {} {} found ({})",
            array.shape[0],
            plural(array.shape[0], "row", "rows"),
            footage.len(),
            plural(footage.len(), "camera was", "cameras were"),
            footage.iter().take(40).map(|f| f.name.as_str()).collect::<Vec<_>>().join(", ")
        );
        return Err(bad(problem, "Remove the row together with the camera"));
    }
    let frames = footage.iter().map(|f| f.images.len()).min().unwrap_or(0);
    let longest = footage.iter().map(|f| f.images.len()).max().unwrap_or(0);
    if let Some(shortest) = footage.iter().find(|f| f.images.len() == frames && frames < longest) {
        let used = if frames == 1 { "one of each is".to_string() } else { format!("{frames} of each are") };
        scene.warnings.push(format!("cameras have {frames} ({}) to {longest} frames; the first {used} used", shortest.name));
    }
    if array.shape[0] < LEAST_HELD_OUT && options.test_cameras.is_none() {
        scene.warnings.push(NOTHING_HELD_OUT.into());
    }
    let mut depths = Vec::new();
    for (index, (footage, row)) in footage.into_iter().zip(array.values.chunks_exact(17)).enumerate() {
        scene.cameras.push(camera(row, &footage).map_err(|e| bad(format!("row {index}: {e}"), "Fetch the file again"))?);
        depths.push((row[15], row[16]));
        // The first camera in sorted order is held out (the protocol of Neural 3D Video).
        let split = if index == 0 && array.shape[0] >= LEAST_HELD_OUT { Split::Test } else { Split::Train };
        for (frame, image) in footage.images.into_iter().take(frames).enumerate() {
            scene.views.extend(image.map(|image| RawView { camera: index, frame, time: None, split, image }));
        }
    }
    scene.points = first_points(path, "poses_bounds.npy", &scene.cameras, limits, &mut scene.warnings)?;
    scene.init_box = frustum_box(&scene.cameras, &depths);
    Ok(scene)
}

/// One row: a 3x5 matrix [R | t | (H, W, f)] with axes (down, right, backwards), then the near and far depth.
fn camera(row: &[f64], footage: &Footage) -> Result<RawCamera, String> {
    let column = |j: usize| DVec3::new(row[j], row[5 + j], row[10 + j]);
    let (down, right, backwards) = (column(0), column(1), column(2));
    let axes = DMat3::from_cols(right, down, -backwards);
    let (h, w, f) = (row[4], row[9], row[14]);
    if !(h >= 1.0 && w >= 1.0 && f > 0.0 && h <= 1e6 && w <= 1e6) {
        return Err(format!("height {h}, width {w}, focal length {f} are not a camera"));
    }
    // The rows hold the size the rig was calibrated at; the frames are often half of it.
    let s = [f64::from(footage.size[0]) / w, f64::from(footage.size[1]) / h];
    if (s[0] / s[1] - 1.0).abs() > 0.01 {
        return Err(format!("calibrated for {w}x{h} pixels, camera {} has {}x{}", footage.name, footage.size[0], footage.size[1]));
    }
    Ok(RawCamera {
        name: footage.name.clone(),
        size: footage.size,
        focal: [f * s[0], f * s[1]],
        principal: [0.5 * f64::from(footage.size[0]), 0.5 * f64::from(footage.size[1])],
        distortion: Distortion::None,
        world_to_camera: world_to_camera(axes, column(3)),
    })
}

fn stem(path: &Path) -> String {
    path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Per-camera folders of frames win over videos (someone extracted them), videos over single images.
fn footage(path: &Path, options: &SceneOptions, limits: &Limits, warnings: &mut Vec<String>) -> Result<Vec<Footage>> {
    let mut found = Vec::new();
    // The number of the first frame, and a camera that begins with it.
    let mut first_numbers = BTreeMap::new();
    let is_camera_folder = |p: &Path| p.is_dir() && file_name(p).starts_with("cam");
    for root in [path.to_path_buf(), path.join("frames")] {
        let mut cameras = Vec::new();
        for folder in list_if(&root, is_camera_folder)? {
            let inner = folder.join("images");
            cameras.push((file_name(&folder), list_if(if inner.is_dir() { &inner } else { &folder }, is_image)?));
        }
        // Where one camera has every second number, its images are those of every second instant.
        let step = cameras.iter().filter_map(|(_, files)| least_step(files)).min();
        for (name, files) in cameras {
            if let Some(first) = files.first() {
                let (w, h) = image_size(first, limits)?;
                if let Some(number) = files.iter().filter_map(|path| frame_number(path)).min() {
                    first_numbers.entry(number).or_insert_with(|| name.clone());
                }
                found.push(Footage { name, size: [w, h], images: frames(files, step, warnings) });
            }
        }
        if let (Some((low, one)), Some((high, other))) = (first_numbers.first_key_value(), first_numbers.last_key_value())
            && low < high
        {
            let numbers = format!("the frames of {one} begin with number {low}, those of {other} with {high}");
            warnings.push(format!("{numbers}: the first images of all cameras are taken as one instant"));
        }
        if !found.is_empty() {
            return Ok(found);
        }
    }
    for root in [path.to_path_buf(), path.join("videos")] {
        let videos = list_if(&root, |p| video::is_video(p) && p.is_file())?;
        let read = video::footage(&videos, options, limits, warnings)?;
        found.extend(videos.iter().zip(read).map(|(v, f)| Footage { name: stem(v), size: f.size, images: f.images }));
        if !found.is_empty() {
            return Ok(found);
        }
    }
    let images = path.join("images");
    for file in list_if(&images, is_image)? {
        let (w, h) = image_size(&file, limits)?;
        found.push(Footage { name: stem(&file), size: [w, h], images: frames(vec![file], None, warnings) });
    }
    if found.is_empty() {
        let remedy = "Put cam00.mp4 …, folders cam00/ … of PNG or JPEG frames, or images/ with such images beside poses_bounds.npy";
        return Err(Error::data(path.display().to_string(), "no videos, camera folders or images were found", remedy));
    }
    Ok(found)
}

/// The images of a camera, one per instant. Files whose names end in numbers come in the order of these, `frame_2` before `frame_10`: instants are `step`
/// numbers apart, and one whose number is missing has no image. Other files come in the order of their names, in which numbers count as numbers: `2_left`
/// before `10_left`.
fn frames(mut files: Vec<PathBuf>, step: Option<u64>, warnings: &mut Vec<String>) -> Vec<Option<ImageSource>> {
    let step = step.filter(|_| least_step(&files).is_some());
    let image = |path: PathBuf| Some(ImageSource::file(path));
    if files.iter().any(|path| frame_number(path).is_none()) {
        files.sort_by_cached_key(|path| padded(&stem(path)));
        return files.into_iter().map(image).collect();
    }
    files.sort_by_key(|path| frame_number(path));
    let numbers: Vec<u64> = files.iter().filter_map(|path| frame_number(path)).collect();
    let steps = || numbers.windows(2).map(|pair| pair[1] - pair[0]);
    let (Some(&first), Some(step)) = (numbers.first(), step) else { return files.into_iter().map(image).collect() };
    let slot = |number: u64| ((number - first) / step) as usize;
    let count = numbers.last().map_or(0, |&last| slot(last).saturating_add(1));
    // Numbers of another meaning, such as times, have no steps or leave most of them out.
    if steps().any(|s| !s.is_multiple_of(step)) || count > 4 * files.len() {
        return files.into_iter().map(image).collect();
    }
    if count > files.len() {
        let folder = files.first().and_then(|f| f.parent()).map(|f| f.display().to_string()).unwrap_or_default();
        let missing = count - files.len();
        warnings.push(format!("{folder}: {missing} of {count} frames {} missing", plural(missing, "is", "are")));
    }
    let mut images = vec![None; count];
    for (path, &number) in files.into_iter().zip(&numbers) {
        images[slot(number)] = image(path);
    }
    images
}

/// `name` with its numbers brought to 20 digits, so that their order is that of the texts.
fn padded(name: &str) -> String {
    let (mut text, mut number) = (String::new(), String::new());
    for c in name.chars().map(Some).chain([None]) {
        if let Some(digit) = c.filter(char::is_ascii_digit) {
            number.push(digit);
            continue;
        }
        if !number.is_empty() {
            text += &format!("{number:0>20}");
            number.clear();
        }
        text.extend(c);
    }
    text
}

/// The least difference of the numbers of `files`; none where two are equal, or fewer than two have any.
fn least_step(files: &[PathBuf]) -> Option<u64> {
    let mut numbers: Vec<u64> = files.iter().filter_map(|path| frame_number(path)).collect();
    numbers.sort_unstable();
    numbers.windows(2).map(|pair| pair[1] - pair[0]).min().filter(|step| *step > 0)
}

/// The number at the end of a file's name. Of a name that is a time with decimals, such as `12.040`, all digits count, in units of the last decimal: those
/// after the point begin anew every second.
fn frame_number(path: &Path) -> Option<u64> {
    let stem = stem(path);
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    match stem.split_once('.') {
        Some((whole, decimals)) if is_number(whole) && is_number(decimals) => format!("{whole}{decimals}").parse().ok(),
        _ => stem[stem.trim_end_matches(|c: char| c.is_ascii_digit()).len()..].parse().ok(),
    }
}

/// Sorted entries for which `keep` is true; none where there is no folder. Hidden files do not count: on some disks macOS writes a `._cam00.mp4` beside
/// `cam00.mp4`.
fn list_if(folder: &Path, keep: impl Fn(&Path) -> bool) -> Result<Vec<PathBuf>> {
    let shown = |path: &Path| !file_name(path).starts_with('.') && keep(path);
    if folder.is_dir() { list(folder, shown) } else { Ok(Vec::new()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The images of files of these names, in the order of `list`, and what is said of them.
    fn read(names: &[&str]) -> (Vec<Option<String>>, Vec<String>) {
        let mut files: Vec<PathBuf> = names.iter().map(|name| Path::new("cam00").join(name)).collect();
        files.sort();
        let (step, mut warnings) = (least_step(&files), Vec::new());
        let name = |image: Option<ImageSource>| match image {
            Some(ImageSource::File { path, .. }) => Some(file_name(&path)),
            _ => None,
        };
        (frames(files, step, &mut warnings).into_iter().map(name).collect(), warnings)
    }

    #[test]
    fn times_with_decimals_are_in_order_over_whole_seconds() {
        let in_order = |names: &[&str]| {
            let (images, said) = read(names);
            assert!(images.iter().map(Option::as_deref).eq(names.iter().map(|name| Some(*name))) && said.is_empty(), "{images:?} {said:?}");
        };
        in_order(&["9.50.png", "9.75.png", "10.00.png", "10.25.png"]);
        in_order(&["1305031102.175304.png", "1305031102.908411.png", "1305031103.107242.png"]);
        // Numbers that do not end the names.
        in_order(&["2_left.png", "9_left.png", "10_left.png", "100_left.png"]);
        // A camera and the number of its frame.
        in_order(&["cam1.8.png", "cam1.9.png", "cam1.10.png"]);
        let (images, said) = read(&["0.50.png", "0.75.png", "1.25.png", "1.50.png"]);
        assert!(images.len() == 5 && images[2].is_none() && said[0].contains("1 of 5 frames is missing"), "{images:?} {said:?}");
    }
}
