//! Results go to standard output (for people, or as JSON), everything else to standard error.

use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::exporter::refuse_other_content;
use cc4dgs_core::{Error, Result};
use serde::Serialize;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Where results go.
pub struct Output {
    json: Option<PathBuf>,
    quiet: bool,
}

impl Output {
    pub fn new(json: Option<PathBuf>, quiet: bool) -> Self {
        Self { json, quiet }
    }
    /// Whether progress is unwanted.
    pub fn quiet(&self) -> bool {
        self.quiet
    }
    /// The file `--json` names, if it names one.
    pub fn json_file(&self) -> Option<&Path> {
        self.json.as_deref().filter(|p| p.as_os_str() != "-")
    }
    /// Refuses a file for the JSON that exists and holds something else. Call it before long work.
    pub fn check(&self) -> Result<()> {
        let is_json = |head: &[u8]| head.trim_ascii_start().starts_with(b"{") || head.trim_ascii_start().starts_with(b"[");
        self.json_file().map_or(Ok(()), |file| refuse_other_content(file, "a JSON file", is_json))
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
                let json = to_json(value)?;
                if path.as_os_str() == "-" {
                    return print(&json);
                }
                if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
                    std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
                }
                write_atomically(path, json.as_bytes())?;
                print(&text())
            }
        }
    }
    /// Reports a failure: a line on standard error, and an object on standard output where JSON was expected there.
    pub fn failure(&self, error: &Error) {
        // If the streams themselves are broken, nothing can be reported.
        writeln!(std::io::stderr(), "error: {error}").ok();
        if self.json.as_ref().is_some_and(|p| p.as_os_str() == "-") {
            let object = serde_json::json!({ "error": { "message": error.to_string(), "exit_code": error.exit_code() } });
            writeln!(std::io::stdout(), "{object}").ok();
        }
    }
}

/// Indented JSON with a final newline.
pub fn to_json(value: &impl Serialize) -> Result<String> {
    let text = serde_json::to_string_pretty(value).map_err(|e| Error::backend("JSON", e.to_string(), "Report this: every result should have a JSON form"))?;
    Ok(text + "\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_replaces_json_only() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("out");
        let check = |file: &Path| Output::new(Some(file.to_path_buf()), true).check();
        check(&file).unwrap();
        for (content, accepted) in [("", true), ("{}\n", true), ("\n [1]", true), ("\u{89}PNG", false), ("name = 'grid'", false)] {
            std::fs::write(&file, content).unwrap();
            assert_eq!(check(&file).is_ok(), accepted, "{content}");
        }
        assert!(check(&file).unwrap_err().to_string().contains("not a JSON file"));
        assert!(check(folder.path()).is_err());
        check(Path::new("-")).unwrap();
        Output::new(None, true).check().unwrap();
    }
}
