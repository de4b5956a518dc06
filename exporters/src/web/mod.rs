//! `web`: the model with the player, as one HTML file that opens from disk without a network, or as a folder for any static server.
//!
//! The player's page is built apart from this program (`apps/player/build-web`); [`Page`] finds it. The archive is stored with the deformer's weights where the
//! page can compute the motion from them, else with a playback layer and without the deformer.

mod html;
mod page;

use crate::still;
use cc4dgs_format::playback::MaxError;
use cc4dgs_format::{Error, ExportFacts, ExportSource, ExportTarget, Exported, Exporter, ExporterPlugin, Plugin, Result, config, inventory};
pub use page::{PAGE_FILES, PAGE_VARIABLE, PAGE_VERSION, Page, page_paths};
use serde::Deserialize;
use std::path::Path;

const SCHEMA: &str = "\
max_error = \"0.1px\"      # how far a point may be off where motion has to be baked; as for `cc4dgs bake`
baked = false            # bake motion even where the page can compute it from the deformer's weights: mostly a larger file, which opens sooner
autoplay = true          # play as soon as the model is there
page = \"\"                # folder of the page that apps/player/build-web made; by default the one that `cc4dgs doctor` names
";
/// Name of the archive in a folder.
const MODEL: &str = "model.cc4d";
/// Name of the page in a folder.
const INDEX: &str = "index.html";
/// All files of a folder.
const FOLDER: [&str; PAGE_FILES.len() + 2] = {
    let mut names = [INDEX; PAGE_FILES.len() + 2];
    names[1] = MODEL;
    let mut i = 0;
    while i < PAGE_FILES.len() {
        names[i + 2] = PAGE_FILES[i];
        i += 1;
    }
    names
};

#[derive(Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Settings {
    max_error: String,
    baked: bool,
    autoplay: bool,
    page: String,
}

impl Default for Settings {
    fn default() -> Self {
        Self { max_error: "0.1px".into(), baked: false, autoplay: true, page: String::new() }
    }
}

struct Web {
    max_error: MaxError,
    baked: bool,
    autoplay: bool,
    /// Folder of the page, or empty. It is read when a file is written, so that settings can be checked without one.
    page: String,
}

impl Exporter for Web {
    fn loses(&self, facts: &ExportFacts) -> String {
        if facts.moving == 0 {
            return "It holds the Gaussians and the player.".into();
        }
        let bound = self.max_error;
        if self.baked {
            return format!("It holds the Gaussians, their motion within {bound} (or as the archive has it baked) and the player, without the deformer.");
        }
        format!("It holds the Gaussians, the player, and the motion: as the deformer's weights where the page can compute it from them, else within {bound}.")
    }
    fn write(&self, source: &mut dyn ExportSource, path: &Path) -> Result<Exported> {
        let page = &if self.page.is_empty() { Page::find()? } else { Page::read(Path::new(&self.page))? };
        let facts = source.facts().clone();
        let archive = source.playable(self.max_error, self.baked)?;
        source.progress(1, 2)?;
        let mut notes = vec![format!("The archive in it has {:.3} MB, the player is from {}", archive.len() as f64 / 1e6, page.origin)];
        if path.is_dir() {
            for (name, bytes) in &page.files {
                still::write(&path.join(name), bytes)?;
            }
            still::write(&path.join(MODEL), &archive)?;
            still::write(&path.join(INDEX), html::of_folder(&facts.name, MODEL, self.autoplay).as_bytes())?;
            notes.push("A static server shows the folder: python3 -m http.server -d FOLDER".into());
        } else {
            still::write(path, html::single(page, &facts.name, &archive, self.autoplay)?.as_bytes())?;
        }
        source.progress(2, 2)?;
        Ok(Exported { gaussians: facts.gaussians, sh_degree: facts.sh_degree, frames: facts.times_norm.len(), notes })
    }
}

pub(crate) fn build(settings: &toml::Table) -> Result<Box<dyn Exporter>> {
    let Settings { max_error, baked, autoplay, page } = config::parse_section("exporter web", settings)?;
    let max_error =
        max_error.parse().map_err(|e: Error| Error::parameter("exporter web: max_error", e.to_string(), "Write pixels, 0.1px, or a length, 0.002"))?;
    Ok(Box::new(Web { max_error, baked, autoplay, page }))
}

inventory::submit! {
    ExporterPlugin {
        info: Plugin {
            name: "web",
            version: "1",
            summary: "a page that plays the model: one HTML file, or a folder for a static server",
            paper: "none: the player of this project",
            schema: SCHEMA,
            capabilities: &["motion", "player"],
        },
        target: ExportTarget::FileOrFolder { file: "html", folder: &FOLDER },
        build,
    }
}
