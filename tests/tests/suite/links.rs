//! Links of the documents: every relative link leads to a file, and every anchor to a heading of it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

/// Markdown files below `folder`, without hidden folders and build outputs.
fn documents(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let (path, name) = entry.map(|e| (e.path(), e.file_name().to_string_lossy().into_owned())).unwrap();
        if path.is_dir() && !name.starts_with('.') && name != "target" {
            documents(&path, found);
        } else if name.ends_with(".md") {
            found.push(path);
        }
    }
}

/// The text without code.
fn prose(text: &str) -> String {
    let mut fenced = false;
    let lines = text.lines().map(|line| {
        let fence = line.trim_start().starts_with("```");
        let hidden = fenced || fence;
        fenced ^= fence;
        if hidden { "" } else { line }
    });
    let text = lines.collect::<Vec<_>>().join("\n");
    // Every second part lies between backticks.
    text.split('`').step_by(2).collect::<Vec<_>>().join("`")
}

/// What lies between `open` and the next `close`, everywhere.
fn between<'a>(text: &'a str, open: &str, close: char) -> impl Iterator<Item = &'a str> {
    text.split(open).skip(1).filter_map(move |rest| rest.split_once(close)).map(|(inside, _)| inside)
}

/// The anchors that headings get: lower case, hyphens for spaces, other punctuation left out.
fn anchors(text: &str) -> BTreeSet<String> {
    let mut fenced = false;
    let mut seen = BTreeMap::new();
    let mut found = BTreeSet::new();
    for line in text.lines() {
        fenced ^= line.trim_start().starts_with("```");
        let Some(heading) = line.strip_prefix('#').filter(|_| !fenced).map(|rest| rest.trim_start_matches('#').trim()) else { continue };
        // Of a link, its words count.
        let words: String =
            heading.split("](").enumerate().map(|(k, part)| if k == 0 { part } else { part.split_once(')').map_or("", |(_, rest)| rest) }).collect();
        let kept =
            words.to_lowercase().chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c)).map(|c| if c == ' ' { '-' } else { c }).collect::<String>();
        let again: &mut usize = seen.entry(kept.clone()).or_default();
        found.insert(if *again == 0 { kept } else { format!("{kept}-{again}") });
        *again += 1;
    }
    found
}

/// `path` without `..` and `.`.
fn plain(path: &Path) -> PathBuf {
    let mut parts = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir => drop(parts.pop()),
            Component::CurDir => {}
            _ => parts.push(part),
        }
    }
    parts
}

#[test]
fn every_link_of_the_documents_leads_somewhere() {
    let root = std::fs::canonicalize("..").unwrap();
    let mut files = Vec::new();
    documents(&root, &mut files);
    let texts: BTreeMap<PathBuf, String> = files.into_iter().map(|file| (file.clone(), std::fs::read_to_string(file).unwrap())).collect();
    let (mut links, mut broken) = (0, Vec::new());
    for (file, text) in &texts {
        let text = prose(text);
        for link in between(&text, "](", ')').chain(between(&text, " src=\"", '"')).chain(between(&text, " href=\"", '"')) {
            let link = link.split(' ').next().unwrap_or_default();
            if link.contains("://") || link.starts_with("mailto:") {
                continue;
            }
            links += 1;
            let (path, anchor) = link.split_once('#').unwrap_or((link, ""));
            let target = if path.is_empty() { file.clone() } else { plain(&file.with_file_name(path)) };
            let known = anchor.is_empty() || texts.get(&target).is_some_and(|text| anchors(text).contains(anchor));
            if !target.exists() || !known {
                broken.push(format!("{}: {link}", file.strip_prefix(&root).unwrap_or(file).display()));
            }
        }
    }
    println!("{links} links in {} documents", texts.len());
    assert!(links > 100, "{links} links were found");
    assert!(broken.is_empty(), "links that lead nowhere:\n{}", broken.join("\n"));
}

#[test]
fn a_broken_link_is_told() {
    let text = "# A [b](c.md) and `d`: e?\n\n```\n# no heading\n[no link](x.md)\n```\n`[none](y.md)` [one](z.md#q)\n# A b and d e\n";
    assert_eq!(anchors(text).into_iter().collect::<Vec<_>>(), ["a-b-and-d-e", "a-b-and-d-e-1"]);
    assert_eq!(between(&prose(text), "](", ')').collect::<Vec<_>>(), ["c.md", "z.md#q"]);
}
