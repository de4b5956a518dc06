//! `cc4dgs decompress`: `export ply` or `export spz`, by the ending of the file.

use super::{Context, check_writable, export};
use crate::args::Decompress;
use crate::interrupt;
use crate::models::load_model;
use cc4dgs::export::{ExportJob, ExportRequest, check_time};
use cc4dgs_core::exporter::check_target;
use cc4dgs_core::{Error, ExportTarget, Registry, Result};
use std::path::Path;

pub fn run(context: &Context, args: &Decompress) -> Result<()> {
    let format = if args.out.extension().is_some_and(|e| e.eq_ignore_ascii_case("spz")) { "spz" } else { "ply" };
    refuse_other_format(&context.registry, format, &args.out)?;
    let mut settings = toml::Table::new();
    if format == "ply" {
        settings.insert("dynamic".into(), (!args.no_dynamic).into());
    } else if args.no_dynamic {
        return Err(Error::parameter("--no-dynamic", "SPZ files hold no dynamic scores", "Leave it out, or name a file that ends in .ply"));
    }
    let plugin = context.registry.exporter(format)?;
    check_time(&context.registry, plugin, args.time)?;
    check_target(&args.out, plugin.target, args.overwrite)?;
    check_writable(&args.out)?;
    let events = context.listeners(None)?;
    let loaded = load_model(&args.model, &args.device, &context.registry, &context.limits, &events)?;
    export::finish(
        context,
        &ExportJob {
            model: &loaded.model,
            archive: None,
            format,
            settings: &settings,
            request: ExportRequest { time_norm: args.time, ..ExportRequest::default() },
            out: &args.out,
            overwrite: args.overwrite,
            registry: &context.registry,
            device: &loaded.device,
            limits: &context.limits,
            events: &events,
            stop: interrupt::stop_flag()?,
        },
    )
}

/// Refuses a file that `format` would be written to under the ending of another exporter's files.
fn refuse_other_format(registry: &Registry, format: &str, out: &Path) -> Result<()> {
    let is_file_of = |target: ExportTarget| match target.at(out) {
        ExportTarget::File(ending) => out.extension().is_some_and(|e| e.eq_ignore_ascii_case(ending)),
        _ => false,
    };
    if is_file_of(registry.exporter(format)?.target) {
        return Ok(());
    }
    let Some(other) = registry.exporters().find(|plugin| is_file_of(plugin.target)).map(|plugin| plugin.info.name) else { return Ok(()) };
    let problem = format!("files with this ending are of the format {other}, and decompress writes PLY and SPZ");
    Err(Error::parameter(format!("--out {}", out.display()), problem, format!("Use `cc4dgs export {other}`, or name a file that ends in .ply or .spz")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endings_of_other_formats_are_refused() {
        let registry = Registry::collect().unwrap();
        let refused = |format: &str, out: &str| refuse_other_format(&registry, format, Path::new(out)).map_err(|error| error.to_string());
        for (format, out) in [("ply", "a.ply"), ("ply", "a.PLY"), ("spz", "a.spz"), ("ply", "a"), ("ply", "a.bin"), ("ply", "a.cc4d")] {
            assert_eq!(refused(format, out), Ok(()), "{out}");
        }
        for (out, other) in [("a.glb", "gltf"), ("a.SOG", "sog"), ("a.splatv", "splatv"), ("a.html", "web"), ("a.mp4", "mp4")] {
            let message = refused("ply", out).unwrap_err();
            assert!(message.contains(&format!("--out {out}")) && message.contains(&format!("`cc4dgs export {other}`")), "{message}");
        }
    }
}
