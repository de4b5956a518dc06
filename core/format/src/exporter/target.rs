//! Bringing an export to its name: complete or not at all.
#![cfg(not(target_arch = "wasm32"))]

use super::{ExportSource, ExportTarget, Exported, Exporter};
use crate::archive::behind_links;
use crate::{Error, Result};
use std::io::Read;
use std::path::{Path, PathBuf};

/// So much of a file is looked at to tell what it is.
const HEAD_BYTES: u64 = 4096;

/// Runs `exporter` on a temporary name beside `path`, and renames. Returns what it reported and the bytes on disk. An existing `path` is replaced only if
/// `overwrite` is set, and a folder only if all it holds has names that the exporter writes.
///
/// # Errors
/// [`Error::Parameter`] for a `path` that may not be replaced, [`Error::Io`], and those of [`Exporter::write`].
pub fn export(exporter: &dyn Exporter, target: ExportTarget, source: &mut dyn ExportSource, path: &Path, overwrite: bool) -> Result<(Exported, u64)> {
    let target = target.at(path);
    check_target(path, target, overwrite)?;
    let Some(name) = path.file_name() else {
        return Err(Error::parameter("export", format!("{} is no name to write to", path.display()), "Give the name of the file or folder to write"));
    };
    // A file behind a link is replaced where it is.
    let real = match target {
        ExportTarget::File(_) => behind_links(path)?,
        _ => path.to_path_buf(),
    };
    let path = real.as_path();
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
    let beside = tempfile::Builder::new().prefix(".cc4dgs-").suffix(".part").tempdir_in(folder).map_err(|e| Error::io(folder, e))?;
    let part = beside.path().join(name);
    if let ExportTarget::Folder(_) = target {
        std::fs::create_dir(&part).map_err(|e| Error::io(&part, e))?;
    }
    let exported = exporter.write(source, &part)?;
    let files = files(&part)?;
    let mut bytes = 0;
    for file in &files {
        // On the disk before it has its name.
        let synced = std::fs::OpenOptions::new().read(true).write(true).open(file).and_then(|f| f.sync_all().and_then(|()| f.metadata()));
        bytes += synced.map_err(|e| Error::io(path, e))?.len();
    }
    // The folder was empty so far, so its old content can wait there; it goes with the temporary folder.
    let old = beside.path().join(".replaced");
    let replaced = path.is_dir();
    if replaced {
        std::fs::rename(path, &old).map_err(|e| Error::io(path, e))?;
    }
    if let Err(e) = std::fs::rename(&part, path) {
        if replaced && std::fs::rename(&old, path).is_err() {
            let kept = beside.keep().join(".replaced");
            let problem = format!("it could not be replaced: {e}; the old folder is {}", kept.display());
            return Err(Error::data(path.display().to_string(), problem, "Move the old folder back, or export to another name"));
        }
        return Err(Error::io(path, e));
    }
    Ok((exported, bytes))
}

/// Refuses a `path` to which a file cannot be written: that of a folder, also by a separator at its end, and one that exists, unless it may be replaced. A link
/// that leads nowhere exists, too. Call it before long work.
///
/// # Errors
/// [`Error::Parameter`].
pub fn refuse_existing(path: &Path, overwrite: bool) -> Result<()> {
    if path.is_dir() {
        return Err(Error::parameter(path.display().to_string(), "it is a folder, and a file is to be written", "Give the name of a file"));
    }
    refuse_folder_name(path)?;
    refuse_unasked(path, overwrite)
}

/// Refuses a `path` that ends with a separator, as only names of folders may: a file would fail to get this name when it is finished.
fn refuse_folder_name(path: &Path) -> Result<()> {
    let is_separator = |byte: &u8| std::path::is_separator(char::from(*byte));
    if !path.as_os_str().as_encoded_bytes().last().is_some_and(is_separator) {
        return Ok(());
    }
    Err(Error::parameter(
        path.display().to_string(),
        "it ends with a separator, as the name of a folder, and a file is to be written",
        "Give the name of a file",
    ))
}

fn refuse_unasked(path: &Path, overwrite: bool) -> Result<()> {
    if overwrite || path.symlink_metadata().is_err() {
        return Ok(());
    }
    Err(Error::parameter(path.display().to_string(), "it exists already", "Give another name, or --overwrite to replace it"))
}

/// Refuses a `path` that exists and holds something else than what will be written there. `kind` says what that is ("a PNG image"); `is_kind` tells it by the
/// first bytes of a file, 4,096 at most. An empty file may be replaced, and a link that leads to nothing yet may be written through; a name that ends with a
/// separator is refused. Call it before long work.
///
/// # Errors
/// [`Error::Parameter`], and [`Error::Io`] for a file that cannot be read.
pub fn refuse_other_content(path: &Path, kind: &str, is_kind: impl FnOnce(&[u8]) -> bool) -> Result<()> {
    let Ok(found) = std::fs::metadata(path) else { return refuse_folder_name(path) };
    let (mut head, is_file) = (Vec::new(), found.is_file());
    if !is_file && !found.is_dir() {
        // A device or a pipe holds nothing that could be lost.
        return Ok(());
    }
    if is_file {
        std::fs::File::open(path).and_then(|file| file.take(HEAD_BYTES).read_to_end(&mut head)).map_err(|e| Error::io(path, e))?;
    }
    if is_file && (head.is_empty() || is_kind(&head)) {
        return Ok(());
    }
    Err(Error::parameter(
        path.display().to_string(),
        format!("it exists already and is not {kind}"),
        "Give another name, or remove it: other files are never replaced",
    ))
}

/// Refuses a `path` that an export may not replace, as [`export`] does. Call it before long work.
///
/// # Errors
/// [`Error::Parameter`], and [`Error::Io`] for a folder that cannot be listed.
pub fn check_target(path: &Path, target: ExportTarget, overwrite: bool) -> Result<()> {
    let refuse = |problem: &str, remedy: &str| Err(Error::parameter(path.display().to_string(), problem, remedy));
    let target = target.at(path);
    let Ok(found) = std::fs::symlink_metadata(path) else {
        return if matches!(target, ExportTarget::File(_)) { refuse_folder_name(path) } else { Ok(()) };
    };
    match target {
        // Also behind a link, where a file would take its place.
        ExportTarget::File(_) if path.is_dir() => refuse("it is a folder, and this format is a file", "Give the name of a file"),
        // A rename would put a file in its place.
        ExportTarget::File(_) if path.exists() && !path.is_file() => refuse("it is a device or a pipe, and this format is a file", "Give the name of a file"),
        ExportTarget::Folder(_) if !found.is_dir() => refuse("it is a file, and this format is a folder of files", "Give the name of a folder"),
        ExportTarget::Folder(names) => match files(path)?.iter().find(|file| !names.iter().any(|name| is_named(file, name))) {
            Some(other) => {
                let problem = format!("the folder also holds {}, which is not of this format ({})", other.display(), names.join(", "));
                refuse(&problem, "Give another folder; only exports are replaced")
            }
            None => refuse_unasked(path, overwrite),
        },
        ExportTarget::File(_) | ExportTarget::FileOrFolder { .. } => refuse_unasked(path, overwrite),
    }
}

/// Whether a file has the name; `*.ply` stands for every name that ends so.
fn is_named(file: &Path, name: &str) -> bool {
    match name.strip_prefix("*.") {
        Some(extension) => file.is_file() && file.extension().is_some_and(|own| own == extension),
        None => file.is_file() && file.file_name().is_some_and(|own| own == name),
    }
}

/// The file itself, or everything in the folder, sorted.
fn files(path: &Path) -> Result<Vec<PathBuf>> {
    if !path.is_dir() {
        return Ok(vec![path.to_path_buf()]);
    }
    let entries = std::fs::read_dir(path).and_then(|entries| entries.map(|e| e.map(|e| e.path())).collect::<std::io::Result<Vec<_>>>());
    let mut entries = entries.map_err(|e| Error::io(path, e))?;
    entries.sort();
    Ok(entries)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::playback::MaxError;
    use crate::{ExportFacts, HostGaussians, Image8};

    struct Nothing(ExportFacts);
    impl ExportSource for Nothing {
        fn facts(&self) -> &ExportFacts {
            &self.0
        }
        fn gaussians(&mut self, _: Option<f32>) -> Result<HostGaussians> {
            Ok(HostGaussians::default())
        }
        fn image(&mut self, _: usize) -> Result<Image8> {
            Err(Error::unsupported("image", "none", "None"))
        }
        fn playable(&mut self, _: MaxError, _: bool) -> Result<Vec<u8>> {
            Err(Error::unsupported("archive", "none", "None"))
        }
        fn progress(&mut self, _: usize, _: usize) -> Result<()> {
            Ok(())
        }
    }

    /// Writes its text into the file, or into two files of the folder; then fails if told so.
    struct Text(&'static str, bool);
    impl Exporter for Text {
        fn loses(&self, _: &ExportFacts) -> String {
            "All of it.".into()
        }
        fn write(&self, _: &mut dyn ExportSource, path: &Path) -> Result<Exported> {
            let files = if path.is_dir() { vec![path.join("a.txt"), path.join("b.txt")] } else { vec![path.to_path_buf()] };
            files.iter().try_for_each(|file| std::fs::write(file, self.0)).map_err(|e| Error::io(path, e))?;
            if self.1 { Err(Error::data("text", "it fails", "Nothing")) } else { Ok(Exported::default()) }
        }
    }

    #[test]
    fn exports_appear_complete_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        let mut source = Nothing(crate::conformance::export_facts(0, 0));
        let mut run = |text, fails, target, name: &str, overwrite| export(&Text(text, fails), target, &mut source, &folder.path().join(name), overwrite);
        let (file, dir) = (ExportTarget::File("txt"), ExportTarget::Folder(&["a.txt", "*.txt"]));
        for (target, name) in [(file, "deep/one.txt"), (dir, "deep/many")] {
            let copies = if target == file { 1 } else { 2 };
            assert!(run("first", true, target, name, false).is_err());
            assert!(!folder.path().join(name).exists(), "a failed export leaves nothing");
            assert_eq!(run("first", false, target, name, false).unwrap().1, 5 * copies);
            assert!(run("second", false, target, name, false).unwrap_err().to_string().contains("--overwrite"));
            assert!(run("second", true, target, name, true).is_err());
            let first = if target == file { name.to_string() } else { format!("{name}/b.txt") };
            assert_eq!(std::fs::read_to_string(folder.path().join(&first)).unwrap(), "first");
            assert_eq!(run("third!", false, target, name, true).unwrap().1, 6 * copies);
            assert_eq!(std::fs::read_to_string(folder.path().join(&first)).unwrap(), "third!");
        }
        assert_eq!(std::fs::read_dir(folder.path().join("deep")).unwrap().count(), 2, "no temporary names are left");
        // The name says which of the two is wanted.
        let either = ExportTarget::FileOrFolder { file: "txt", folder: &["a.txt", "b.txt"] };
        assert_eq!((run("one", false, either, "x.txt", false).unwrap().1, run("two", false, either, "x", false).unwrap().1), (3, 6));
        // What was not exported is never replaced.
        std::fs::create_dir(folder.path().join("models")).unwrap();
        std::fs::write(folder.path().join("models/c.txt"), "mine").unwrap();
        assert!(run("x", false, either, "models", true).unwrap_err().to_string().contains("c.txt"));
        std::fs::write(folder.path().join("deep/many/notes.md"), "mine").unwrap();
        assert!(run("x", false, dir, "deep/many", true).unwrap_err().to_string().contains("notes.md"));
        assert!(run("x", false, file, "deep/many", true).is_err());
        assert!(run("x", false, dir, "deep/one.txt", true).is_err());
    }

    #[cfg(unix)]
    #[test]
    fn a_link_stays_and_its_file_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let (real, link) = (folder.path().join("real"), folder.path().join("link.txt"));
        std::fs::create_dir(&real).unwrap();
        std::os::unix::fs::symlink("real/one.txt", &link).unwrap();
        let mut source = Nothing(crate::conformance::export_facts(0, 0));
        // It leads to nothing yet, then to a file.
        for text in ["first", "second"] {
            export(&Text(text, false), ExportTarget::File("txt"), &mut source, &link, true).unwrap();
            assert!(link.is_symlink() && std::fs::read_to_string(real.join("one.txt")).unwrap() == text);
        }
        assert_eq!(std::fs::read_dir(&real).unwrap().count(), 1, "no temporary names are left");
        // A link to a folder is none to a file, and the folder stays.
        let folder_link = folder.path().join("folder.txt");
        std::os::unix::fs::symlink("real", &folder_link).unwrap();
        let refused = export(&Text("third", false), ExportTarget::File("txt"), &mut source, &folder_link, true).unwrap_err().to_string();
        assert!(refused.contains("it is a folder") && folder_link.is_symlink() && real.join("one.txt").is_file(), "{refused}");
    }

    #[cfg(unix)]
    #[test]
    fn devices_and_pipes_are_not_replaced_by_files() {
        use std::os::unix::fs::FileTypeExt;
        let folder = tempfile::tempdir().unwrap();
        let (pipe, link) = (folder.path().join("pipe.txt"), folder.path().join("link.txt"));
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        std::os::unix::fs::symlink("pipe.txt", &link).unwrap();
        let mut source = Nothing(crate::conformance::export_facts(0, 0));
        for path in [&pipe, &link] {
            let refused = export(&Text("x", false), ExportTarget::File("txt"), &mut source, path, true).unwrap_err().to_string();
            assert!(refused.contains("a device or a pipe") && pipe.symlink_metadata().unwrap().file_type().is_fifo(), "{refused}");
        }
    }

    #[test]
    fn what_overwriting_cannot_replace_is_refused_without_proposing_it() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.txt");
        std::fs::write(&file, "mine").unwrap();
        let mut source = Nothing(crate::conformance::export_facts(0, 0));
        let mut run = |target, path: &Path, overwrite| export(&Text("x", false), target, &mut source, path, overwrite).map(|_| ());
        for overwrite in [false, true] {
            let refused = [
                refuse_existing(folder.path(), overwrite),
                run(ExportTarget::File("txt"), folder.path(), overwrite),
                run(ExportTarget::Folder(&["b.txt"]), folder.path(), overwrite),
                run(ExportTarget::Folder(&["b.txt"]), &file, overwrite),
            ];
            for message in refused.map(|refused| refused.unwrap_err().to_string()) {
                assert!(!message.contains("--overwrite") && message.contains("Give "), "{message}");
            }
        }
        // With a separator at its end a name is that of a folder, whatever is there.
        for name in ["a.txt/", "new.txt/"] {
            let path = folder.path().join(name);
            let refused = [
                refuse_existing(&path, true),
                refuse_other_content(&path, "a list", |_| true),
                check_target(&path, ExportTarget::File("txt"), true),
                check_target(&path, ExportTarget::FileOrFolder { file: "txt", folder: &["b.txt"] }, true),
            ];
            for message in refused.map(|refused| refused.unwrap_err().to_string()) {
                assert!(message.contains(name) && message.contains("ends with a separator") && message.contains("Give "), "{message}");
            }
        }
        check_target(&folder.path().join("new/"), ExportTarget::Folder(&["b.txt"]), false).unwrap();
        assert!(refuse_existing(&file, false).unwrap_err().to_string().contains("--overwrite"));
        refuse_existing(&file, true).unwrap();
        assert_eq!(std::fs::read(&file).unwrap(), b"mine");
    }

    #[test]
    fn files_of_another_kind_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        let check = |path: &Path| refuse_other_content(path, "a list", |head| head.starts_with(b"list"));
        check(&path).unwrap();
        for (content, accepted) in [("", true), ("list: 1", true), ("lis", false), ("a model", false)] {
            std::fs::write(&path, content).unwrap();
            assert_eq!(check(&path).is_ok(), accepted, "{content}");
        }
        let message = check(folder.path()).unwrap_err().to_string();
        assert!(message.contains("not a list"), "{message}");
        #[cfg(unix)]
        {
            let link = folder.path().join("link");
            std::os::unix::fs::symlink("a", &link).unwrap();
            assert!(check(&link).is_err());
            std::fs::remove_file(&path).unwrap();
            check(&link).unwrap();
        }
    }
}
