//! Whether a reader keeps to limits.

use super::{LIMITS, attempt, attempt_within, copy_tree, is_panic, temporary};
use crate::reader::{ReaderPlugin, SceneOptions, files};
use crate::{Error, Limits, Result};
use std::path::Path;

/// Bytes that an index file has in any case; fewer are allowed.
const LEAST_INDEX: u64 = 16;

/// What is wrong if a reader opens its dataset where limits allow none of its index files.
pub(super) fn kept(plugin: &ReaderPlugin, folder: &Path) -> Result<Vec<String>> {
    if !folder.is_dir() || !needs_index(plugin, folder)? {
        return Ok(Vec::new());
    }
    let few = Limits { max_bytes: LEAST_INDEX - 1, ..LIMITS };
    let found = match attempt_within(plugin, folder, &SceneOptions::default(), &few) {
        Ok(_) => format!("it opens its dataset where a file may have {} bytes at most; read files with cc4dgs_core::reader::files", few.max_bytes),
        Err(e) if is_panic(&e) => format!("it panics where a file may have {} bytes at most", few.max_bytes),
        Err(_) => return Ok(Vec::new()),
    };
    Ok(vec![found])
}

/// Whether the reader cannot open `folder` without what its files of [`LEAST_INDEX`] bytes or more hold that are no images. Others, such as a README, it need
/// not read.
fn needs_index(plugin: &ReaderPlugin, folder: &Path) -> Result<bool> {
    let (copy, mut copied) = (temporary()?, Vec::new());
    let target = copy.path().join("dataset");
    copy_tree(folder, &target, &mut copied)?;
    for path in copied.iter().filter(|path| !files::is_image(path)) {
        if std::fs::metadata(path).is_ok_and(|meta| meta.len() >= LEAST_INDEX) {
            std::fs::write(path, "").map_err(|e| Error::io(path, e))?;
        }
    }
    Ok(attempt(plugin, &target, &SceneOptions::default()).is_err())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Plugin, RawScene};

    #[test]
    fn a_reader_that_ignores_limits_is_found() {
        fn probe(_: &Path) -> bool {
            true
        }
        fn read(path: &Path, limits: &Limits) -> Result<RawScene> {
            match files::read_text(&path.join("index.txt"), limits)?.as_str() {
                "" => Err(Error::data("index.txt", "it is empty", "Fetch it again")),
                _ => Ok(RawScene::default()),
            }
        }
        fn careful(path: &Path, _: &SceneOptions, limits: &Limits) -> Result<RawScene> {
            read(path, limits)
        }
        fn careless(path: &Path, _: &SceneOptions, _: &Limits) -> Result<RawScene> {
            read(path, &Limits::default())
        }
        fn without_index(_: &Path, _: &SceneOptions, _: &Limits) -> Result<RawScene> {
            Ok(RawScene::default())
        }
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("index.txt"), "a camera, and another one").unwrap();
        let found = |open: fn(&Path, &SceneOptions, &Limits) -> Result<RawScene>| {
            let info = Plugin { name: "a-reader", version: "1", summary: "", paper: "", schema: "", capabilities: &[] };
            kept(&ReaderPlugin { info, looks_for: "index.txt", order: 0, probe, open }, folder.path()).unwrap()
        };
        assert!(found(careful).is_empty() && found(without_index).is_empty());
        assert!(found(careless)[0].contains("where a file may have 15 bytes at most"));
    }
}
