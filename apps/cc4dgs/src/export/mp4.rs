//! `mp4`: rendered images as a video, through the `ffmpeg` command.

use crate::video::{VideoWriter, ffmpeg_version};
use cc4dgs_core::{Error, ExportFacts, ExportSource, ExportTarget, Exported, Exporter, ExporterPlugin, Plugin, Result, config, inventory, plural, toml};
use std::path::Path;

const SCHEMA: &str = "\
crf = 18                 # quality of x264: 0 is lossless, 51 the worst
";

struct Mp4 {
    crf: u32,
}

impl Exporter for Mp4 {
    fn loses(&self, facts: &ExportFacts) -> String {
        let images = plural(facts.images, "image", "images");
        format!("It holds {} {images} at {} per second and no Gaussians.", facts.images, facts.frames_per_second)
    }
    fn write(&self, source: &mut dyn ExportSource, path: &Path) -> Result<Exported> {
        ffmpeg_version()?;
        let facts = source.facts().clone();
        if facts.images == 0 {
            return Err(Error::parameter("mp4", "there are no cameras to render from", "Give cameras, such as those of an orbit or of --scene"));
        }
        let mut video = VideoWriter::new(path, facts.frames_per_second).quality(self.crf);
        for index in 0..facts.images {
            video.add(&source.image(index)?)?;
            source.progress(index + 1, facts.images)?;
        }
        video.finish()?;
        Ok(Exported { frames: facts.images, ..Exported::default() })
    }
}

fn build(settings: &toml::Table) -> Result<Box<dyn Exporter>> {
    #[derive(serde::Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Settings {
        #[serde(default = "standard")]
        crf: u32,
    }
    fn standard() -> u32 {
        18
    }
    let Settings { crf } = config::parse_section("exporter mp4", settings)?;
    if crf > 51 {
        return Err(Error::parameter("exporter mp4", format!("a crf of {crf}"), "Give 0 (lossless) to 51 (worst)"));
    }
    Ok(Box::new(Mp4 { crf }))
}

inventory::submit! {
    ExporterPlugin {
        info: Plugin {
            name: "mp4",
            version: "1",
            summary: "a video of an orbit or of a dataset's cameras, through ffmpeg",
            paper: "H.264 in MP4 (ISO/IEC 14496)",
            schema: SCHEMA,
            capabilities: &["images", "one-size"],
        },
        target: ExportTarget::File("mp4"),
        build,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{Registry, conformance};

    #[test]
    fn videos_conform() {
        if ffmpeg_version().is_err() {
            eprintln!("ffmpeg is absent: skipped");
            return;
        }
        let registry = Registry::collect().unwrap();
        let findings = conformance::exporter(registry.exporter("mp4").unwrap(), &toml::Table::new());
        assert!(findings.is_empty(), "{}", findings.join("\n"));
        assert!(registry.exporters().count() >= 7, "the other crate's exporters are linked");
    }
}
