//! `cc4dgs plugins`.

use super::Context;
use crate::args::Plugins;
use cc4dgs_core::{DEVICE_NAMES, Error, Result, by_likeness};
use serde_json::json;

/// Names that the error about an unknown one lists, at most.
const NEAREST: usize = 8;

pub fn run(context: &Context, args: &Plugins) -> Result<()> {
    match &args.name {
        None => list(context),
        Some(name) => show(context, name),
    }
}

fn list(context: &Context) -> Result<()> {
    let plugins = context.registry.plugins();
    let array: Vec<_> = plugins.iter().map(|(kind, p)| json!({ "kind": kind, "name": p.name, "version": p.version, "summary": p.summary })).collect();
    context.output.result(&array, || {
        let line = |(kind, p): &(&str, &cc4dgs_core::Plugin)| {
            // A method's preset is written behind a family's: dnerf+hexplane.
            let plus = if *kind == "preset" && p.capabilities.contains(&"method") { "+" } else { "" };
            format!("{kind:<11} {:<12} {:<6} {}", format!("{plus}{}", p.name), p.version, p.summary)
        };
        let mut lines: Vec<String> = plugins.iter().map(line).collect();
        lines.push(String::new());
        lines.push(format!("{:<11} {}", "devices", DEVICE_NAMES.join(", ")));
        lines.push("\n`cc4dgs plugins NAME` shows the settings of a plug-in.".into());
        lines.join("\n")
    })
}

/// The settings of a combined preset, such as `dnerf+hexplane`.
fn show_preset(context: &Context, name: &str, settings: &toml::Table) -> Result<()> {
    let array = [json!({ "kind": "preset", "name": name, "settings": settings })];
    context.output.result(&array, || format!("preset {name}\n\n{settings}"))
}

/// The error about a name that is none of `known`. They are too many to be listed.
fn unknown<'a>(name: &str, known: impl Iterator<Item = &'a str>) -> Error {
    let nearest = by_likeness(name, known).into_iter().take(NEAREST).collect::<Vec<_>>().join(", ");
    Error::parameter(format!("plug-in or preset '{name}'"), "unknown name", format!("The nearest are {nearest}; `cc4dgs plugins` lists all"))
}

/// Everything of the name, whatever its kind: a codec and a deformer may share one.
fn show(context: &Context, name: &str) -> Result<()> {
    let plugins = context.registry.plugins();
    let found: Vec<_> = plugins.iter().filter(|(_, p)| p.name == name).collect();
    if found.is_empty() {
        return match context.registry.preset(name) {
            Ok(settings) => show_preset(context, name, &settings),
            Err(_) => Err(unknown(name, plugins.iter().map(|(_, p)| p.name))),
        };
    }
    let full = |(kind, p): &&(&str, &cc4dgs_core::Plugin)| json!({ "kind": kind, "name": p.name, "version": p.version, "summary": p.summary, "paper": p.paper, "capabilities": p.capabilities, "schema": p.schema });
    let array: Vec<_> = found.iter().map(full).collect();
    context.output.result(&array, || {
        let one = |(kind, p): &&(&str, &cc4dgs_core::Plugin)| {
            let capabilities = if p.capabilities.is_empty() { "none".to_string() } else { p.capabilities.join(", ") };
            format!("{kind} {} {}: {}\npaper: {}\ncapabilities: {capabilities}\n\n{}", p.name, p.version, p.summary, p.paper, p.schema)
        };
        found.iter().map(one).collect::<Vec<_>>().join("\n")
    })
}
