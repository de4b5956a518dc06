//! Finds the commit that the program is built from, for the provenance in checkpoints and archives.

use std::path::Path;
use std::process::Command;

fn main() {
    let git = |args: &[&str]| {
        let output = Command::new("git").args(args).output().ok().filter(|o| o.status.success())?;
        Some(String::from_utf8_lossy(&output.stdout).trim().to_string())
    };
    println!("cargo::rerun-if-env-changed=CC4DGS_COMMIT");
    println!("cargo::rerun-if-changed=src");
    // The log of HEAD grows with every commit, checkout and rebase.
    if let Some(folder) = git(&["rev-parse", "--git-dir"]) {
        for name in ["HEAD", "logs/HEAD"] {
            let path = Path::new(&folder).join(name);
            if path.exists() {
                println!("cargo::rerun-if-changed={}", path.display());
            }
        }
    }
    // Packagers build without a repository and may say what they build.
    let commit = std::env::var("CC4DGS_COMMIT").ok().or_else(|| git(&["describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]));
    println!("cargo::rustc-env=CC4DGS_COMMIT={}", commit.unwrap_or_default());
}
