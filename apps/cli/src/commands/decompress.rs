//! `cc4dgs decompress`: `export ply` or `export spz`, by the ending of the file.

use super::{Context, export};
use crate::args::Decompress;
use crate::interrupt;
use crate::models::load_model;
use cc4dgs::export::{ExportJob, ExportRequest};
use cc4dgs_core::{Error, Result};

pub fn run(context: &Context, args: &Decompress) -> Result<()> {
    let format = if args.out.extension().is_some_and(|e| e.eq_ignore_ascii_case("spz")) { "spz" } else { "ply" };
    let mut settings = toml::Table::new();
    if format == "ply" {
        settings.insert("dynamic".into(), (!args.no_dynamic).into());
    } else if args.no_dynamic {
        return Err(Error::parameter("--no-dynamic", "SPZ files hold no dynamic scores", "Leave it out, or name a file that ends in .ply"));
    }
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
