//! One process at a time works on a training. The lock is one of the operating system, so that it ends with the process that holds it, however that ends;
//! the file only says who it is.

use cc4dgs_core::{Error, Result};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::Path;

/// The lock of a training, until it is dropped.
pub struct TrainingLock {
    _file: File,
}

impl TrainingLock {
    /// Takes the lock at `path`; `None` where another process has it.
    ///
    /// # Errors
    /// [`Error::Io`], also for file systems without locks.
    pub fn take(path: &Path) -> Result<Option<Self>> {
        let io = |e| Error::io(path, e);
        let mut file = OpenOptions::new().create(true).read(true).write(true).truncate(false).open(path).map_err(io)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Ok(None),
            Err(TryLockError::Error(e)) => return Err(io(e)),
        }
        let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
        file.set_len(0).and_then(|()| writeln!(file, "process {} on {}", std::process::id(), host.trim())).map_err(io)?;
        Ok(Some(Self { _file: file }))
    }
    /// Who holds the lock at `path`, if somebody does.
    pub fn holder(path: &Path) -> Option<String> {
        let mut file = OpenOptions::new().read(true).write(true).open(path).ok()?;
        // Shared, so that two that ask at a time do not take each other for holders.
        match file.try_lock_shared() {
            Err(TryLockError::WouldBlock) => {}
            _ => return None,
        }
        let mut text = String::new();
        file.rewind().and_then(|()| file.read_to_string(&mut text)).ok()?;
        Some(text.trim().to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_holder_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.lock");
        assert!(TrainingLock::holder(&path).is_none());
        // What a dead process left behind.
        std::fs::write(&path, "process 999999999 on nowhere, and more").unwrap();
        let lock = TrainingLock::take(&path).unwrap().unwrap();
        assert!(TrainingLock::take(&path).unwrap().is_none());
        let holder = TrainingLock::holder(&path).unwrap();
        assert!(holder.starts_with(&format!("process {} on", std::process::id())) && !holder.contains("nowhere"), "{holder}");
        drop(lock);
        assert!(TrainingLock::holder(&path).is_none() && TrainingLock::take(&path).unwrap().is_some());
        // Somebody else who asks holds nothing.
        let asking = File::open(&path).unwrap();
        asking.lock_shared().unwrap();
        assert_eq!(TrainingLock::holder(&path), None);
    }
}
