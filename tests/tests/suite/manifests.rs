//! The manifests of the workspace ask for nothing that no source uses.

use std::fs;
use std::path::{Path, PathBuf};

/// The text of all Rust sources under `folder`.
fn sources(folder: &Path, into: &mut String) {
    for entry in fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display())) {
        let path = entry.unwrap().path();
        if path.is_dir() && !path.ends_with("target") {
            sources(&path, into);
        } else if path.extension().is_some_and(|e| e == "rs") {
            into.push_str(&fs::read_to_string(&path).unwrap());
        }
    }
}

/// Whether `name` occurs in `text` as a whole identifier.
fn names(text: &str, name: &str) -> bool {
    let part = |c: char| c.is_alphanumeric() || c == '_';
    text.match_indices(name).any(|(at, _)| !text[..at].ends_with(part) && !text[at + name.len()..].starts_with(part))
}

fn manifest(path: &Path) -> toml::Table {
    fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display())).parse().unwrap()
}

/// The dependencies of one manifest, of every kind and for every target.
fn dependencies(manifest: &toml::Table) -> Vec<String> {
    let tables = |table: &toml::Table| {
        let kinds = ["dependencies", "dev-dependencies", "build-dependencies"];
        kinds.iter().filter_map(|kind| table.get(*kind)?.as_table()).flat_map(|t| t.keys().cloned()).collect::<Vec<_>>()
    };
    let mut found = tables(manifest);
    if let Some(targets) = manifest.get("target").and_then(toml::Value::as_table) {
        found.extend(targets.values().filter_map(toml::Value::as_table).flat_map(tables));
    }
    found
}

#[test]
fn every_dependency_is_used() {
    let root = PathBuf::from("..");
    let workspace = manifest(&root.join("Cargo.toml"));
    let members = workspace["workspace"]["members"].as_array().unwrap();
    let mut unused = Vec::new();
    let mut used = Vec::new();
    for member in members.iter().map(|m| m.as_str().unwrap()) {
        let folder = root.join(member);
        let mut text = String::new();
        sources(&folder, &mut text);
        for dependency in dependencies(&manifest(&folder.join("Cargo.toml"))) {
            if !names(&text, &dependency.replace('-', "_")) {
                unused.push(format!("{member}: {dependency}"));
            }
            used.push(dependency);
        }
    }
    let shared = workspace["workspace"]["dependencies"].as_table().unwrap();
    unused.extend(shared.keys().filter(|name| !used.contains(name)).map(|name| format!("Cargo.toml: {name}")));
    assert!(unused.is_empty(), "remove these dependencies: {unused:?}");
}
