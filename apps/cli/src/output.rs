//! Results go to standard output (for people, or as JSON), everything else to standard error.

use crate::commands::{check_writable, create_parent};
use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::exporter::refuse_other_content;
use cc4dgs_core::{Error, Result};
use serde::Serialize;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// The first key of every result: the version of the program that wrote it. Files that begin otherwise are not replaced.
const MARK: &str = "cc4dgs";

/// The description of files for which [`is_result`] is true, for errors.
const RESULT: &str = "a result that --json wrote";

/// Names of standard output. It may be a file, which must be neither removed nor replaced while it is written to.
const STDOUT: [&str; 3] = ["/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"];

/// Whether `file` names an open file, such as that of `3> out.json`, which is written to and not replaced.
fn is_descriptor(file: &Path) -> bool {
    cfg!(unix) && (file == Path::new("/dev/stderr") || file.starts_with("/dev/fd") || file.starts_with("/proc")) && file.exists()
}

/// Writes `json` into the open file that `descriptor` names, in place of what it holds.
fn write_through(descriptor: &Path, json: &str) -> Result<()> {
    let opened = std::fs::OpenOptions::new().write(true).truncate(true).open(descriptor);
    opened.and_then(|mut file| file.write_all(json.as_bytes())).map_err(|e| Error::io(descriptor, e))
}

/// Where results go.
pub struct Output {
    json: Option<PathBuf>,
    quiet: bool,
    /// Whether standard output has the JSON of a result.
    printed: AtomicBool,
}

impl Output {
    /// `json` is the file that `--json` names, `-` or another name of standard output.
    pub fn new(json: Option<PathBuf>, quiet: bool) -> Self {
        let is_stdout = |file: &Path| cfg!(unix) && STDOUT.iter().any(|name| file == Path::new(name));
        let json = json.map(|file| if is_stdout(&file) { "-".into() } else { file });
        Self { json, quiet, printed: AtomicBool::new(false) }
    }
    /// Whether progress is unwanted.
    pub fn quiet(&self) -> bool {
        self.quiet
    }
    /// The file `--json` names, if it names one.
    pub fn json_file(&self) -> Option<&Path> {
        self.json.as_deref().filter(|p| p.as_os_str() != "-")
    }
    /// The file `--json` names, if other files may lie beside it: it is no device, no pipe and no open file.
    pub fn json_beside(&self) -> Option<&Path> {
        self.json_file().filter(|file| !is_descriptor(file) && file.metadata().map_or(true, |found| found.is_file()))
    }
    /// Refuses a file for the JSON that cannot be written, and one that exists and is no result of this program, and removes an earlier result, so that it is
    /// not taken for the result of a command that fails. Call it before any work.
    pub fn begin(&self) -> Result<()> {
        let Some(file) = self.json_file() else { return Ok(()) };
        refuse_other_content(file, RESULT, is_result)?;
        if is_descriptor(file) {
            return Ok(());
        }
        check_writable(file)?;
        // A link stays, and leads to nothing until the result is written; devices and pipes stay, too.
        match file.canonicalize() {
            Ok(earlier) if earlier.is_file() => std::fs::remove_file(&earlier).map_err(|e| Error::io(&earlier, e)),
            _ => Ok(()),
        }
    }
    /// Reports a result: as JSON where `--json` says, and as `text` on standard output unless the JSON went there.
    pub fn result(&self, value: &impl Serialize, text: impl FnOnce() -> String) -> Result<()> {
        let mut stdout = std::io::stdout().lock();
        let mut print = |line: &str| match writeln!(stdout, "{}", line.trim_end()) {
            // The reader closed the pipe (`| head`): not a failure.
            Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
            Err(e) => Err(Error::io("standard output", e)),
            Ok(()) => Ok(()),
        };
        match &self.json {
            None => print(&text()),
            Some(path) => {
                let json = to_json(value);
                if path.as_os_str() == "-" {
                    return match json {
                        Ok(json) => {
                            self.printed.store(true, Ordering::Relaxed);
                            print(&json)
                        }
                        Err(error) => {
                            // Standard output is for JSON; what was measured is not lost.
                            writeln!(std::io::stderr(), "{}", text()).ok();
                            Err(error)
                        }
                    };
                }
                // The command itself may have made a file of this name meanwhile, such as the plan of a sweep.
                let free = refuse_other_content(path, RESULT, is_result);
                let written = free.and(json).and_then(|json| match is_descriptor(path) {
                    true => write_through(path, &json),
                    false => create_parent(path).and_then(|()| write_atomically(path, json.as_bytes())),
                });
                // What was measured is shown where its file cannot be written, too.
                print(&text())?;
                written
            }
        }
    }
    /// Reports a failure: a line on standard error, and an object on standard output where JSON was expected there and none was written.
    pub fn failure(&self, error: &Error) {
        // If the streams themselves are broken, nothing can be reported.
        writeln!(std::io::stderr(), "error: {error}").ok();
        if let Some(object) = self.failure_object(error) {
            writeln!(std::io::stdout(), "{object}").ok();
        }
    }
    /// What standard output gets of a failure. Commands such as `stress` fail after they wrote their result: a second object behind it would be no JSON.
    fn failure_object(&self, error: &Error) -> Option<serde_json::Value> {
        let wanted = self.json.as_ref().is_some_and(|p| p.as_os_str() == "-") && !self.printed.load(Ordering::Relaxed);
        wanted.then(|| serde_json::json!({ "error": { "message": error.to_string(), "exit_code": error.exit_code() } }))
    }
}

/// Indented JSON with a final newline. Objects begin with [`MARK`]; of a list, each of its objects does.
pub fn to_json(value: &impl Serialize) -> Result<String> {
    let text = serde_json::to_string_pretty(value).map_err(|e| match e.to_string() {
        // The words of serde about paths.
        problem if problem.contains("invalid UTF-8") => Error::parameter("--json", problem, "Give files and folders names in Unicode, or leave --json out"),
        problem => Error::backend("JSON", problem, "Report this: every result should have a JSON form"),
    })?;
    let begin = |indent: &str| format!("{indent}{{\n{indent}  \"{MARK}\": \"{}\",\n", env!("CARGO_PKG_VERSION"));
    let marked = match text.strip_prefix("{\n") {
        Some(rest) => begin("") + rest,
        // Strings hold no line ends, so these are the objects of a list and nothing else.
        None => text.replace("\n  {\n", &format!("\n{}", begin("  "))),
    };
    Ok(marked + "\n")
}

/// Whether a file with the first bytes `head` is a result: an object that begins with [`MARK`], or a list of such objects.
fn is_result(head: &[u8]) -> bool {
    let text: String = String::from_utf8_lossy(head).chars().filter(|c| !c.is_whitespace()).collect();
    text.strip_prefix('[').unwrap_or(&text).starts_with(&format!("{{\"{MARK}\":\""))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_result_is_shown_where_its_file_cannot_be_written() {
        let folder = tempfile::tempdir().unwrap();
        let no_folder = folder.path().join("file");
        std::fs::write(&no_folder, "mine").unwrap();
        let mut shown = false;
        let text = || {
            shown = true;
            String::new()
        };
        assert!(Output::new(Some(no_folder.join("out.json")), true).result(&serde_json::json!({ "psnr_db": 30.5 }), text).is_err());
        assert!(shown);
    }

    #[test]
    fn a_file_that_cannot_be_written_is_refused_before_the_work() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        std::fs::write(&file, "mine").unwrap();
        let begin = |file: &Path| Output::new(Some(file.to_path_buf()), true).begin();
        assert!(begin(&file.join("out.json")).is_err() && begin(&folder.path().join("new/")).is_err());
        begin(&folder.path().join("deep/er/out.json")).unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is created");
    }

    #[cfg(unix)]
    #[test]
    fn open_files_are_written_to_and_not_replaced() {
        use std::os::fd::AsRawFd;
        for name in STDOUT {
            assert_eq!(Output::new(Some(name.into()), true).json.as_deref(), Some(Path::new("-")));
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.json");
        let open = std::fs::File::create(&path).unwrap();
        let output = Output::new(Some(format!("/dev/fd/{}", open.as_raw_fd()).into()), true);
        output.begin().unwrap();
        assert!(path.is_file(), "an open file stays");
        output.result(&serde_json::json!({ "cells": 2 }), String::new).unwrap();
        assert!(std::fs::read_to_string(&path).unwrap().contains("\"cells\": 2"));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no file of another name appears");
        // A contact sheet lies beside files alone.
        assert_eq!((output.json_beside(), Output::new(Some("/dev/null".into()), true).json_beside()), (None, None));
        assert_eq!(Output::new(Some(path.clone()), true).json_beside(), Some(path.as_path()));
        assert_eq!(Output::new(Some("new.json".into()), true).json_beside(), Some(Path::new("new.json")));
    }

    #[test]
    fn what_the_command_made_is_not_replaced_by_its_result() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("plan.json");
        let output = Output::new(Some(file.clone()), true);
        output.begin().unwrap();
        std::fs::write(&file, "{\"trainings\": []}").unwrap();
        let mut shown = false;
        let text = || {
            shown = true;
            String::new()
        };
        let error = output.result(&serde_json::json!({ "cells": 2 }), text).unwrap_err();
        assert!(shown && error.exit_code() == 2 && error.to_string().contains("plan.json"), "{error}");
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "{\"trainings\": []}");
        // An empty file, and an earlier result, which a command such as `demo` may have written, are replaced.
        for content in ["", "{\"cc4dgs\": \"0.0.9\"}"] {
            std::fs::write(&file, content).unwrap();
            output.result(&serde_json::json!({ "cells": 2 }), String::new).unwrap();
            assert!(std::fs::read_to_string(&file).unwrap().contains("\"cells\": 2"));
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_name_that_is_not_unicode_loses_no_result() {
        let name: &std::ffi::OsStr = std::os::unix::ffi::OsStrExt::from_bytes(b"model\xff");
        let value = std::collections::BTreeMap::from([("model", PathBuf::from(name))]);
        let output = Output::new(Some("-".into()), true);
        let mut shown = false;
        let text = || {
            shown = true;
            String::new()
        };
        let error = output.result(&value, text).unwrap_err();
        assert!(shown && error.exit_code() == 2 && error.to_string().contains("leave --json out"), "{error}");
        assert!(output.failure_object(&error).is_some(), "nothing else is on standard output");
    }

    #[test]
    fn standard_output_has_one_document() {
        let error = Error::failed("training a", "it is hopeless", "Look at its images");
        let output = Output::new(Some("-".into()), true);
        let object = output.failure_object(&error).unwrap();
        assert_eq!(object["error"]["exit_code"], 6);
        output.result(&serde_json::json!([{ "outcome": "hopeless" }]), String::new).unwrap();
        assert_eq!(output.failure_object(&error), None, "the result is there already");
        let folder = tempfile::tempdir().unwrap();
        for json in [None, Some(folder.path().join("out.json"))] {
            assert_eq!(Output::new(json, true).failure_object(&error), None);
        }
    }

    #[test]
    fn json_replaces_results_only() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("out");
        let begin = |file: &Path| Output::new(Some(file.to_path_buf()), true).begin();
        begin(&file).unwrap();
        let own = "\n{\"cc4dgs\":\"0.0.9\"}";
        let others = ["{}\n", "\n [1]", "{\"frames\": []}", "{\"frames\": [{\"cc4dgs\": \"1\"}]}", "\u{89}PNG", "name = 'grid'"];
        for (content, accepted) in [("", true), (own, true)].into_iter().chain(others.map(|content| (content, false))) {
            std::fs::write(&file, content).unwrap();
            assert_eq!(begin(&file).is_ok(), accepted, "{content}");
            assert_ne!(file.exists(), accepted, "{content}: earlier results are removed, and nothing else");
        }
        let message = begin(&file).unwrap_err().to_string();
        assert!(
            ["not a result that --json wrote", "another name, or remove it", file.to_str().unwrap()].iter().all(|part| message.contains(part)),
            "{message}"
        );
        assert!(begin(folder.path()).is_err() && folder.path().is_dir());
        // What is written may be written again.
        let object = serde_json::json!({ "scores": [{ "psnr_db": 30.5 }], "text": "a\n  {\nb" });
        for (value, pointer) in [(object.clone(), ""), (serde_json::json!([object, object]), "/1")] {
            let text = to_json(&value).unwrap();
            let read: serde_json::Value = serde_json::from_str(&text).unwrap();
            let mark = read.pointer(&format!("{pointer}/{MARK}")).and_then(serde_json::Value::as_str);
            assert_eq!((mark, text.matches("\"cc4dgs\"").count()), (Some(env!("CARGO_PKG_VERSION")), if pointer.is_empty() { 1 } else { 2 }), "{text}");
            assert_eq!(read.pointer(&format!("{pointer}/text")), Some(&object["text"]));
            std::fs::write(&file, text).unwrap();
            begin(&file).unwrap();
            assert!(!file.exists());
        }
        #[cfg(unix)]
        {
            let link = folder.path().join("link");
            std::os::unix::fs::symlink("out", &link).unwrap();
            std::fs::write(&link, own).unwrap();
            begin(&link).unwrap();
            assert!(link.is_symlink() && !file.exists());
            begin(&link).unwrap();
        }
        begin(Path::new("-")).unwrap();
        Output::new(None, true).begin().unwrap();
    }
}
