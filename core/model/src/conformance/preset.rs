//! The conformance suite of presets.

use crate::{PresetPlugin, PresetRole, Registry};

/// Tests a preset. Each finding is a line; an empty list means that it passed.
///
/// - Its name can be used in `FAMILY+METHOD`.
/// - Its layer is TOML; a method's layer has tables for families and changes a setting.
/// - Combined with every family or method, it gives settings with a registered deformer.
pub fn preset(plugin: &PresetPlugin, registry: &Registry) -> Vec<String> {
    let name = plugin.info.name;
    let mut findings = Vec::new();
    let mut note = |finding: String| findings.push(format!("{name}: {finding}"));
    if name.is_empty() || !name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-') {
        note("the name is not lower-case letters, digits and '-'".into());
    }
    let layer = match plugin.layer() {
        Ok(layer) => layer,
        Err(e) => {
            note(e.to_string());
            return findings;
        }
    };
    let is_method = plugin.role == PresetRole::Method;
    if is_method && (layer.is_empty() || layer.values().any(|v| !v.is_table())) {
        note("a method's layer consists of tables: [all.deformer], [DATASET.deformer], [cpu.deformer]".into());
    }
    let others = registry.presets().filter(|p| (p.role == PresetRole::Method) != is_method).map(|p| p.info.name);
    let joined = others.map(|other| if is_method { format!("{other}+{name}") } else { format!("{name}+{other}") });
    let alone = if is_method { None } else { Some(name.to_string()) };
    for full in joined.chain(alone) {
        let kind = |table: &toml::Table| table.get("deformer")?.get("kind")?.as_str().map(str::to_string);
        match registry.preset(&full) {
            Err(e) => note(e.to_string()),
            Ok(settings) => {
                if let Some(Err(e)) = kind(&settings).map(|kind| registry.deformer(&kind)) {
                    note(format!("{full}: {e}"));
                }
            }
        }
    }
    findings
}
