//! Where the built page of the player is found.

use cc4dgs_format::installed::{program_folder, user_data_folder, variable_path};
use cc4dgs_format::{Error, Result};
use std::path::{Path, PathBuf};

/// Variable that names the folder of the page; if it is set, no other path is searched.
pub const PAGE_VARIABLE: &str = "CC4DGS_PAGE";
/// Name of the folder where the variable does not state one.
const PAGE_FOLDER: &str = "page";
/// Files of the page that `apps/player/build-web` makes; `index.html` is written anew.
pub const PAGE_FILES: [&str; 11] = [
    "player.js",
    "controls.js",
    "device.js",
    "gestures.js",
    "loading.js",
    "shaders.js",
    "sort.js",
    "webgl.js",
    "player.css",
    "cc4dgs_player.js",
    "cc4dgs_player_bg.wasm",
];
/// The version of the page that plays what is exported, as `player.js` states it: version 2 computes motion from weights, version 3 draws with the blur of the
/// model, and version 4 has `device.js` and `shaders.js`.
pub const PAGE_VERSION: u32 = 4;
/// Upper bound on the size of a file of the page, in bytes.
const MOST_BYTES: u64 = 64 << 20;

/// The page: its files by name, in the order of [`PAGE_FILES`].
#[derive(Clone, Debug)]
pub struct Page {
    /// Names and contents.
    pub files: Vec<(&'static str, Vec<u8>)>,
    /// The folder, or `this program`.
    pub origin: String,
}

/// The folders that [`Page::find`] searches, in order: the one that the variable `CC4DGS_PAGE` names, or else `page` in [`user_data_folder`],
/// `share/cc4dgs/page` beside the folder of the program, and `page` in it.
pub fn page_paths() -> Vec<PathBuf> {
    if let Some(folder) = variable_path(PAGE_VARIABLE) {
        return vec![folder];
    }
    let beside = program_folder();
    let shared = beside.as_ref().and_then(|folder| Some(folder.parent()?.join("share/cc4dgs")));
    [user_data_folder(), shared, beside].into_iter().flatten().map(|folder| folder.join(PAGE_FOLDER)).collect()
}

impl Page {
    /// The page of the first folder of [`page_paths`] that exists, else the one that the feature `embed-page` built in.
    ///
    /// # Errors
    /// [`Error::Unsupported`] where there is none, and as [`Page::read`].
    pub fn find() -> Result<Self> {
        let paths = page_paths();
        let named = variable_path(PAGE_VARIABLE).is_some();
        if let Some(folder) = paths.iter().find(|folder| named || folder.is_dir()) {
            return Self::read(folder);
        }
        if let Some(files) = embedded() {
            return Self { files: PAGE_FILES.into_iter().zip(files).collect(), origin: "this program".into() }.checked();
        }
        let looked: Vec<String> = paths.iter().map(|p| p.display().to_string()).collect();
        let problem = format!("it is neither built in nor in {}", looked.join(" or "));
        let remedy = format!("Build it with apps/player/build-web FOLDER, then name the folder: {PAGE_VARIABLE}=FOLDER or --set page=FOLDER");
        Err(Error::unsupported("page of the player", problem, remedy))
    }
    /// The page in `folder`.
    ///
    /// # Errors
    /// [`Error::Io`] for files that are missing, [`Error::Limit`] for files that are too large for it, [`Error::Unsupported`] for an older page.
    pub fn read(folder: &Path) -> Result<Self> {
        let read = |name: &'static str| {
            let path = folder.join(name);
            let bytes = std::fs::metadata(&path).map_err(|e| Error::io(&path, e))?.len();
            if bytes > MOST_BYTES {
                return Err(Error::limit(path.display().to_string(), bytes, MOST_BYTES, "Name a folder that apps/player/build-web made"));
            }
            Ok((name, std::fs::read(&path).map_err(|e| Error::io(&path, e))?))
        };
        let mut page = Self { files: Vec::with_capacity(PAGE_FILES.len()), origin: folder.display().to_string() };
        for name in PAGE_FILES {
            page.files.push(read(name)?);
            // The version comes first: an older page lacks files.
            page = page.checked()?;
        }
        Ok(page)
    }
    /// The page, where it has the version that is needed.
    fn checked(self) -> Result<Self> {
        let stated = format!("export const PAGE_VERSION = {PAGE_VERSION};");
        if String::from_utf8_lossy(self.file("player.js")).contains(&stated) {
            return Ok(self);
        }
        let problem = format!("it is not version {PAGE_VERSION} of the page, which plays what is exported");
        Err(Error::unsupported(self.origin, problem, "Build it again with apps/player/build-web FOLDER"))
    }
    /// The file `name` of [`PAGE_FILES`].
    pub(super) fn file(&self, name: &str) -> &[u8] {
        self.files.iter().find(|(own, _)| *own == name).map_or(&[], |(_, bytes)| bytes)
    }
}

#[cfg(feature = "embed-page")]
fn embedded() -> Option<[Vec<u8>; PAGE_FILES.len()]> {
    macro_rules! file {
        ($name:literal) => {
            include_bytes!(concat!(
                env!("CC4DGS_PAGE", "the feature embed-page needs the variable CC4DGS_PAGE: the absolute path of the folder that apps/player/build-web made"),
                "/",
                $name
            ))
            .to_vec()
        };
    }
    Some([
        file!("player.js"),
        file!("controls.js"),
        file!("device.js"),
        file!("gestures.js"),
        file!("loading.js"),
        file!("shaders.js"),
        file!("sort.js"),
        file!("webgl.js"),
        file!("player.css"),
        file!("cc4dgs_player.js"),
        file!("cc4dgs_player_bg.wasm"),
    ])
}

#[cfg(not(feature = "embed-page"))]
fn embedded() -> Option<[Vec<u8>; PAGE_FILES.len()]> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn older_pages_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        PAGE_FILES.iter().for_each(|name| std::fs::write(folder.path().join(name), "export const PAGE_VERSION = 1;").unwrap());
        let refused = || {
            let message = Page::read(folder.path()).unwrap_err().to_string();
            assert!(message.contains(&folder.path().display().to_string()) && message.contains("build-web"), "{message}");
        };
        refused();
        std::fs::remove_file(folder.path().join("device.js")).unwrap();
        refused();
        std::fs::write(folder.path().join("device.js"), "").unwrap();
        std::fs::write(folder.path().join("player.js"), include_str!("../../../apps/player/web/player.js")).unwrap();
        assert!(Page::read(folder.path()).is_ok());
    }
}
