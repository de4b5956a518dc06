//! The videos of a COLMAP scene: one for each image, of its name or of that of its folder.

use super::colmap::{ColmapImage, project_folder};
use super::video::{self, Footage};
use cc4dgs_core::reader::files::{file_name, list};
use cc4dgs_core::{Limits, Result, SceneOptions, plural};
use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

/// The footage of the images, in their order. Empty unless each image has a video.
pub(super) fn videos(path: &Path, images: &[ColmapImage], options: &SceneOptions, limits: &Limits, warnings: &mut Vec<String>) -> Result<Vec<Footage>> {
    video::footage(&video_files(path, images, warnings)?, options, limits, warnings)
}

/// Whether there is a file that is not hidden.
fn is_shown(path: &Path) -> bool {
    path.is_file() && !file_name(path).starts_with('.')
}

/// A part of a path as text; empty where there is none.
fn text(part: Option<&OsStr>) -> String {
    part.map(|part| part.to_string_lossy().into_owned()).unwrap_or_default()
}

/// The video of each name. A video belongs to the first image of its name alone.
fn matched<'a>(names: &[String], videos: &'a BTreeMap<String, PathBuf>) -> Vec<Option<&'a PathBuf>> {
    let mut seen = BTreeSet::new();
    names.iter().map(|name| videos.get(name).filter(|_| seen.insert(name))).collect()
}

/// The videos of the images, in their order: `cam00.mp4` for `cam00.png`, or for `cam00/0001.png` where not every image has a video of its own name and each
/// lies in a folder of its own. They are in the folder of the project or in its `videos/`, also where `path` is the folder of a model in `sparse/`. Empty
/// unless each image has one. Hidden files do not count.
fn video_files(path: &Path, images: &[ColmapImage], warnings: &mut Vec<String>) -> Result<Vec<PathBuf>> {
    let project = project_folder(path);
    let own = (project != path).then(|| [path.join("videos"), path.to_path_buf()]);
    let folders: Vec<PathBuf> = [project.join("videos"), project].into_iter().chain(own.into_iter().flatten()).filter(|f| f.is_dir()).collect();
    let stem = |file: &Path| text(file.file_stem());
    let stems: Vec<String> = images.iter().map(|image| stem(Path::new(&image.name))).collect();
    let folder_of = |image: &ColmapImage| text(Path::new(&image.name.replace('\\', "/")).parent().and_then(Path::file_name));
    let image_folders: Vec<String> = images.iter().map(folder_of).collect();
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
        let names: BTreeSet<&String> = stems.iter().chain(&image_folders).collect();
        for folder in folders.iter().filter(|f| f.ends_with("videos")) {
            let unknown = list(folder, |p| is_shown(p) && names.contains(&stem(p)))?;
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
    let mut found = matched(&stems, &by_stem);
    let by_folder = matched(&image_folders, &by_stem);
    let is_by_folder = found.contains(&None) && !by_folder.contains(&None);
    if is_by_folder {
        found = by_folder;
    }
    if let Some((_, lacking)) = found.iter().zip(images).find(|(video, _)| video.is_none()) {
        if available > 0 {
            let (count, name) = (found.iter().filter(|f| f.is_none()).count(), &lacking.name);
            let have = plural(count, "has no video of its name", "have no video of their name");
            let problem = format!("{count} of {} images {have} ({name})", images.len());
            let videos = plural(available, "video is", "videos are");
            warnings.push(format!("{problem}: the {available} {videos} not used, and the scene is read as one instant"));
        }
        return Ok(Vec::new());
    }
    let unused: Vec<String> = by_stem.values().filter(|&video| !found.contains(&Some(video))).map(|video| file_name(video)).collect();
    if !unused.is_empty() {
        let names = unused.iter().take(3).cloned().collect::<Vec<_>>().join(", ");
        let more = if unused.len() > 3 { ", …" } else { "" };
        let (count, [are, their]) = (unused.len(), [plural(unused.len(), "is", "are"), plural(unused.len(), "its", "their")]);
        let image = if is_by_folder { "image in a folder" } else { "image" };
        warnings.push(format!("{count} of {available} videos {are} not used, since the COLMAP model has no {image} of {their} name: {names}{more}"));
    }
    Ok(found.into_iter().flatten().cloned().collect())
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

    #[test]
    fn images_in_folders_of_their_own_have_the_videos_of_these_folders() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("videos")).unwrap();
        let film = |name: &str| std::fs::write(dir.path().join("videos").join(name), "").unwrap();
        let found = |names: &[&str]| {
            let images: Vec<ColmapImage> = names.iter().map(|name| image(name)).collect();
            let mut warnings = Vec::new();
            let files = video_files(dir.path(), &images, &mut warnings).unwrap();
            (files.iter().map(|file| file_name(file)).collect::<Vec<_>>(), warnings.join("\n"))
        };
        film("cam00.mp4");
        film("cam01.mp4");
        let both = (vec!["cam00.mp4".to_string(), "cam01.mp4".to_string()], String::new());
        assert_eq!(found(&["cam00/0001.png", "cam01/0001.png"]), both);
        assert_eq!(found(&["rig/cam00/0001.png", "rig\\cam01\\0007.png"]), both);
        assert_eq!(found(&["a/cam00.png", "b/cam01.png"]), both, "names count before folders");
        // Two images of one camera cannot share its video, and an image outside of a folder has none.
        for names in [&["cam00/0001.png", "cam00/0002.png"], &["cam00/0001.png", "0001.png"]] {
            let (files, said) = found(names);
            assert!(files.is_empty() && said.contains("the 2 videos are not used"), "{files:?} {said}");
        }
        film("cam02.mp4");
        let (files, said) = found(&["cam00/0001.png", "cam01/0001.png"]);
        assert!(files == both.0 && said.contains("no image in a folder of its name: cam02.mp4"), "{files:?} {said}");
    }
}
