//! Finds the commit that the program is built from, for the provenance in checkpoints and archives.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::Path;
use std::process::Command;

/// The repository, seen from this folder, in which cargo runs this script.
const ROOT: &str = "../..";
/// Folders of the repository that hold crates of which the program is not made.
const OTHERS: [&str; 4] = ["benches", "docs", "target", "tests"];

/// What the program is made of: the folders of the repository at `root` that hold crates, but [`OTHERS`], and the files of the workspace. A change there that
/// is not committed marks the commit as dirty.
fn sources(root: &Path) -> Vec<String> {
    let paths_in = |folder: &Path| std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let holds_crate = |folder: &Path| std::iter::once(folder.to_path_buf()).chain(paths_in(folder)).any(|path| path.join("Cargo.toml").is_file());
    let names = paths_in(root).filter_map(|path| path.file_name()?.to_str().map(String::from));
    let names = names.filter(|name| !name.starts_with('.') && !OTHERS.contains(&name.as_str()) && holds_crate(&root.join(name)));
    let mut all: Vec<String> = names.chain(["Cargo.toml".into(), "Cargo.lock".into()]).collect();
    all.sort();
    all
}

/// What git prints in the folder `root`; `None` where there is no git, and where it fails.
fn git(root: &Path, args: &[&str]) -> Option<String> {
    let mut command = Command::new("git");
    // Hooks of git set these; the folder alone decides which repository is meant.
    ["GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE"].into_iter().for_each(|name| _ = command.env_remove(name));
    let output = command.current_dir(root).args(args).output().ok().filter(|o| o.status.success())?;
    Some(String::from_utf8_lossy(&output.stdout).trim().to_string())
}

/// The commit of the repository at `root`, with a mark where sources differ from it.
fn described(root: &Path, sources: &[String]) -> Option<String> {
    let commit = git(root, &["describe", "--always", "--abbrev=12", "--exclude=*"])?;
    let of_sources = |args: &[&str]| {
        let paths = sources.iter().map(String::as_str);
        git(root, &args.iter().copied().chain(["--"]).chain(paths).collect::<Vec<_>>())
    };
    if of_sources(&["status", "--porcelain", "--untracked-files=all"])?.is_empty() {
        return Some(commit);
    }
    // Two changes of one commit are two programs.
    let mut hash = DefaultHasher::new();
    of_sources(&["diff", "HEAD"])?.hash(&mut hash);
    // The difference leaves out files that git does not know yet.
    for name in of_sources(&["ls-files", "--others", "--exclude-standard", "-z"])?.split_terminator('\0') {
        name.hash(&mut hash);
        std::fs::read(root.join(name)).ok().hash(&mut hash);
    }
    Some(format!("{commit}-dirty-{:08x}", hash.finish() as u32))
}

fn main() {
    println!("cargo::rerun-if-env-changed=CC4DGS_COMMIT");
    println!("cargo::rerun-if-changed=build.rs");
    let root = Path::new(ROOT);
    // The log of HEAD grows with every commit, checkout and rebase.
    let git_files = git(root, &["rev-parse", "--git-dir"]).into_iter().flat_map(|folder| ["HEAD", "logs/HEAD"].map(|name| root.join(&folder).join(name)));
    // Cargo would run this script at every build if it named a path that does not exist.
    let sources = sources(root);
    for path in sources.iter().map(|source| root.join(source)).chain(git_files).filter(|path| path.exists()) {
        println!("cargo::rerun-if-changed={}", path.display());
    }
    // Packagers build without a repository and may say what they build.
    let commit = std::env::var("CC4DGS_COMMIT").ok().or_else(|| described(root, &sources));
    println!("cargo::rustc-env=CC4DGS_COMMIT={}", commit.unwrap_or_default());
}

/// They run as a part of `tests/build_script.rs`.
#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn untracked_sources_mark_the_commit() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let write = |name: &str, text: &str| {
            let path = root.join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        let id = || described(root, &sources(root));
        for name in ["Cargo.toml", "core/train/Cargo.toml", "fields/Cargo.toml", "tests/Cargo.toml", "core/train/src/lib.rs"] {
            write(name, "1");
        }
        write(".gitignore", "*.log\n");
        assert_eq!(sources(root), ["Cargo.lock", "Cargo.toml", "core", "fields"]);
        assert_eq!(id(), None, "there is no repository");
        if git(root, &["init", "-q"]).is_none() {
            return;
        }
        git(root, &["add", "."]).unwrap();
        let commit = ["-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false", "commit", "-q", "-m", "a"];
        git(root, &commit).unwrap();
        let clean = id().unwrap();
        for other in ["tests/new.rs", "data/image.png", "core/train/a.log"] {
            write(other, "1");
        }
        assert!(id().unwrap() == clean && !clean.contains("dirty"), "{clean}");
        let mut ids = Vec::new();
        for (name, text) in [("core/train/src/new.rs", "1"), ("core/train/src/new.rs", "2"), ("fields/src/new.rs", "2"), ("core/train/src/lib.rs", "2")] {
            write(name, text);
            ids.push(id().unwrap());
        }
        assert!(ids.iter().all(|id| id.starts_with(&format!("{clean}-dirty-"))), "{ids:?}");
        ids.sort();
        ids.dedup();
        assert_eq!(ids.len(), 4, "every change is another program: {ids:?}");
    }
}
