//! Masks that come with a dataset and that its reader does not use: a warning says so, and what helps.

use cc4dgs_core::plural;
use std::path::Path;

/// What is done, and what helps.
const INSTEAD: &str = "not used, and all of each image is trained on (for an object without its surroundings, write the masks into the alpha channel of \
                       PNG images: transparent pixels show scene.background)";

/// Says so where `count` images of a JSON have a `mask_path`.
pub(super) fn warn_of_mask_paths(count: usize, warnings: &mut Vec<String>) {
    if count > 0 {
        let [have, masks] = [plural(count, "image has", "images have"), plural(count, "its mask is", "their masks are")];
        warnings.push(format!("{count} {have} a mask_path; {masks} {INSTEAD}"));
    }
}

/// Says so where a folder `masks` with files in it lies in one of `folders`; of the first of them.
pub(super) fn warn_of_mask_folder(folders: &[&Path], warnings: &mut Vec<String>) {
    let has_files = |folder: &Path| std::fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_some());
    if let Some(masks) = folders.iter().map(|folder| folder.join("masks")).find(|masks| has_files(masks)) {
        warnings.push(format!("the masks in {} are {INSTEAD}", masks.display()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_that_are_not_used_are_told_once() {
        let dir = tempfile::tempdir().unwrap();
        let [project, model] = ["project", "model"].map(|name| dir.path().join(name));
        let told = || {
            let mut warnings = Vec::new();
            warn_of_mask_folder(&[&model, &project], &mut warnings);
            warnings
        };
        for folder in [&project, &model] {
            std::fs::create_dir_all(folder.join("masks")).unwrap();
        }
        assert!(told().is_empty(), "empty folders have no masks");
        std::fs::write(project.join("masks/0.png"), "").unwrap();
        std::fs::write(model.join("masks/0.png.png"), "").unwrap();
        let said = told();
        assert!(said.len() == 1 && said[0].contains(model.join("masks").to_str().unwrap()) && said[0].contains("alpha channel"), "{said:?}");
        let mut warnings = Vec::new();
        warn_of_mask_paths(0, &mut warnings);
        assert!(warnings.is_empty());
        warn_of_mask_paths(3, &mut warnings);
        assert!(warnings[0].starts_with("3 images have a mask_path; their masks are not used") && warnings[0].contains("alpha channel"), "{warnings:?}");
        warn_of_mask_paths(1, &mut warnings);
        assert!(warnings[1].starts_with("1 image has a mask_path; its mask is not used"), "{warnings:?}");
    }
}
