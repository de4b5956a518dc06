//! Folders of images that `render` and `eval --renders` write. Datasets have images of such names, too, so images are replaced only in folders that are marked.

use cc4dgs_core::{Error, Result};
use std::path::{Path, PathBuf};

/// The file that marks a folder that was new or empty when a command began to write images into it.
const MARK: &str = ".cc4dgs-images";

/// What [`MARK`] says to people.
const MARK_TEXT: &str = "cc4dgs wrote the images of this folder; its commands replace them with --overwrite.\n";

/// What `folder` holds besides the mark, by name; nothing where there is no such folder.
///
/// Errors: [`Error::Parameter`] for a file, [`Error::Io`].
pub fn entries(folder: &Path) -> Result<Vec<PathBuf>> {
    if folder.is_file() {
        return Err(Error::parameter(folder.display().to_string(), "it is a file, and images are written into a folder", "Give the name of a folder"));
    }
    if folder.symlink_metadata().is_err() {
        return Ok(Vec::new());
    }
    let listed = std::fs::read_dir(folder).and_then(|entries| entries.map(|entry| entry.map(|e| e.path())).collect::<std::io::Result<Vec<_>>>());
    let mut found = listed.map_err(|e| Error::io(folder, e))?;
    found.retain(|path| path.file_name().is_none_or(|name| name != MARK));
    found.sort();
    Ok(found)
}

/// Refuses to replace the images of `folder`, which `option` named, where no command marked it.
///
/// Errors: [`Error::Parameter`].
pub fn refuse_unmarked(option: &str, folder: &Path) -> Result<()> {
    if folder.join(MARK).is_file() {
        return Ok(());
    }
    let problem = format!("{} holds images, and no file {MARK} says that this program wrote them: they may be those of a dataset", folder.display());
    Err(Error::parameter(option, problem, "Name another folder, or remove them yourself if they are not needed"))
}

/// Removes the images `earlier` of `folder`, or creates it, and marks it if it is new or empty.
///
/// Errors: [`Error::Io`].
pub fn begin(folder: &Path, earlier: &[PathBuf]) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
    if entries(folder)?.is_empty() {
        let mark = folder.join(MARK);
        std::fs::write(&mark, MARK_TEXT).map_err(|e| Error::io(&mark, e))?;
    }
    earlier.iter().try_for_each(|image| std::fs::remove_file(image).map_err(|e| Error::io(image, e)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_that_were_empty_are_marked() {
        let root = tempfile::tempdir().unwrap();
        let (new, used) = (root.path().join("a/new"), root.path().join("used"));
        std::fs::create_dir(&used).unwrap();
        std::fs::write(used.join("photo.png"), "").unwrap();
        [&new, &used].into_iter().for_each(|folder| begin(folder, &[]).unwrap());
        assert!(entries(&new).unwrap().is_empty() && new.join(MARK).is_file());
        refuse_unmarked("--out", &new).unwrap();
        let message = refuse_unmarked("--out", &used).unwrap_err().to_string();
        assert!(["used", "Name another folder", "remove them"].iter().all(|part| message.contains(part)), "{message}");
        let message = entries(&used.join("photo.png")).unwrap_err().to_string();
        assert!(["photo.png", "it is a file", "Give the name of a folder"].iter().all(|part| message.contains(part)), "{message}");
        // A folder that is marked stays so, and loses the images of the earlier command alone.
        ["0.png", "1.png"].iter().for_each(|name| std::fs::write(new.join(name), "").unwrap());
        begin(&new, &[new.join("0.png")]).unwrap();
        assert_eq!(entries(&new).unwrap(), [new.join("1.png")]);
        refuse_unmarked("--out", &new).unwrap();
    }
}
