//! `cc4dgs plugins`.

use super::Context;
use crate::args::Plugins;
use cc4dgs_core::{DEVICE_NAMES, Result, unknown_name};
use cc4dgs_engine::config::RunConfig;
use cc4dgs_engine::{data, presets};
use serde_json::json;

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
        let mut lines: Vec<String> = plugins.iter().map(|(kind, p)| format!("{kind:<11} {:<12} {:<6} {}", p.name, p.version, p.summary)).collect();
        lines.push(String::new());
        lines.extend(RunConfig::presets().into_iter().map(|(name, summary)| format!("{:<11} {name:<12} {:<6} {summary}", "preset", "")));
        lines.extend(
            presets::methods()
                .into_iter()
                .map(|(name, summary)| format!("{:<11} {:<12} {:<6} {summary}, as in dnerf+{name}", "preset", format!("...+{name}"), "")),
        );
        lines.extend(data::readers().into_iter().map(|(name, looks_for)| format!("{:<11} {name:<12} {:<6} looks for {looks_for}", "reader", "")));
        lines.push(format!("{:<11} {}", "devices", DEVICE_NAMES.join(", ")));
        lines.push("\n`cc4dgs plugins NAME` shows the settings of a plug-in.".into());
        lines.join("\n")
    })
}

/// The settings of a preset, such as `demo` or `dnerf+hexplane`.
fn show_preset(context: &Context, name: &str, settings: &toml::Table) -> Result<()> {
    let text = settings.to_string();
    let family = name.split('+').next().unwrap_or(name);
    let summary = RunConfig::presets().into_iter().find(|(known, _)| *known == family).map_or("", |(_, summary)| summary);
    let array = [json!({ "kind": "preset", "name": name, "summary": summary, "settings": settings })];
    context.output.result(&array, || format!("preset {name}: {summary}\n\n{text}"))
}

/// Everything of the name, whatever its kind: a codec and a deformer may share one.
fn show(context: &Context, name: &str) -> Result<()> {
    let plugins = context.registry.plugins();
    let found: Vec<_> = plugins.iter().filter(|(_, p)| p.name == name).collect();
    if found.is_empty() {
        return match presets::table(name) {
            Ok(settings) => show_preset(context, name, &settings),
            Err(_) => {
                let presets: Vec<&str> = RunConfig::presets().into_iter().map(|(name, _)| name).collect();
                Err(unknown_name("plug-in or preset", name, plugins.iter().map(|(_, p)| p.name).chain(presets)))
            }
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
