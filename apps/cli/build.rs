//! Finds the commit that the program is built from, for the provenance in checkpoints and archives.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::Path;
use std::process::Command;

/// Folders of the repository that the program is not made of.
const OTHERS: [&str; 4] = ["benches", "docs", "target", "tests"];

/// What the program is made of, seen from this folder: the folders of the repository but [`OTHERS`], and the files of the workspace. A change there that is not
/// committed marks the commit as dirty.
fn sources() -> Vec<String> {
    let folders = std::fs::read_dir("../..").into_iter().flatten().flatten().filter(|entry| entry.path().is_dir());
    let names = folders.filter_map(|entry| entry.file_name().into_string().ok()).filter(|name| !name.starts_with('.') && !OTHERS.contains(&name.as_str()));
    let mut all: Vec<String> = names.chain(["Cargo.toml".into(), "Cargo.lock".into()]).map(|name| format!("../../{name}")).collect();
    all.sort();
    all
}

fn git(args: &[&str]) -> Option<String> {
    let output = Command::new("git").args(args).output().ok().filter(|o| o.status.success())?;
    Some(String::from_utf8_lossy(&output.stdout).trim().to_string())
}

/// The commit of the repository, with a mark where sources differ from it.
fn described(sources: &[String]) -> Option<String> {
    let commit = git(&["describe", "--always", "--abbrev=12", "--exclude=*"])?;
    let paths: Vec<&str> = sources.iter().map(String::as_str).collect();
    let changes = git(&[&["status", "--porcelain", "--untracked-files=no", "--"], &paths[..]].concat())?;
    if changes.is_empty() {
        return Some(commit);
    }
    // Two changes of one commit are two programs.
    let mut hash = DefaultHasher::new();
    git(&[&["diff", "HEAD", "--"], &paths[..]].concat())?.hash(&mut hash);
    Some(format!("{commit}-dirty-{:08x}", hash.finish() as u32))
}

fn main() {
    println!("cargo::rerun-if-env-changed=CC4DGS_COMMIT");
    println!("cargo::rerun-if-changed=build.rs");
    // The log of HEAD grows with every commit, checkout and rebase.
    let git_files = git(&["rev-parse", "--git-dir"]).into_iter().flat_map(|folder| ["HEAD", "logs/HEAD"].map(|name| Path::new(&folder).join(name)));
    // Cargo would run this script at every build if it named a path that does not exist.
    let sources = sources();
    for path in sources.iter().map(|source| Path::new(source).to_path_buf()).chain(git_files).filter(|path| path.exists()) {
        println!("cargo::rerun-if-changed={}", path.display());
    }
    // Packagers build without a repository and may say what they build.
    let commit = std::env::var("CC4DGS_COMMIT").ok().or_else(|| described(&sources));
    println!("cargo::rustc-env=CC4DGS_COMMIT={}", commit.unwrap_or_default());
}
