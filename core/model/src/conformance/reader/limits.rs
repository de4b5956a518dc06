//! Whether a reader keeps to limits.

use super::{LIMITS, attempt_within, is_panic};
use crate::reader::{ReaderPlugin, SceneOptions, files};
use crate::{Limits, Result};
use std::path::Path;

/// Bytes that an index file has in any case; fewer are allowed.
const LEAST_INDEX: u64 = 16;

/// What is wrong if a reader opens its dataset where limits allow none of its index files.
pub(super) fn kept(plugin: &ReaderPlugin, folder: &Path) -> Result<Vec<String>> {
    if !folder.is_dir() || !has_index(folder)? {
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

/// Whether `folder` has a file of [`LEAST_INDEX`] bytes or more that is no image.
fn has_index(folder: &Path) -> Result<bool> {
    for path in files::list(folder, |_| true)? {
        let large = || !files::is_image(&path) && std::fs::metadata(&path).is_ok_and(|meta| meta.len() >= LEAST_INDEX);
        let found = if path.is_dir() { has_index(&path)? } else { large() };
        if found {
            return Ok(true);
        }
    }
    Ok(false)
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
        fn careful(path: &Path, _: &SceneOptions, limits: &Limits) -> Result<RawScene> {
            files::read_text(&path.join("index.txt"), limits).map(|_| RawScene::default())
        }
        fn careless(path: &Path, _: &SceneOptions, _: &Limits) -> Result<RawScene> {
            files::read_text(&path.join("index.txt"), &Limits::default()).map(|_| RawScene::default())
        }
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("index.txt"), "a camera, and another one").unwrap();
        let found = |open: fn(&Path, &SceneOptions, &Limits) -> Result<RawScene>| {
            let info = Plugin { name: "a-reader", version: "1", summary: "", paper: "", schema: "", capabilities: &[] };
            kept(&ReaderPlugin { info, looks_for: "index.txt", order: 0, probe, open }, folder.path()).unwrap()
        };
        assert!(found(careful).is_empty());
        assert!(found(careless)[0].contains("where a file may have 15 bytes at most"));
    }
}
