//! Names made of content: XXH3-64 as 16 hexadecimal digits.

use cc4dgs_core::{Error, Result};
use serde::Serialize;
use xxhash_rust::xxh3::Xxh3;

/// Collects parts; no two different lists of parts are one sequence of bytes.
#[derive(Default)]
pub(super) struct ContentHash(Xxh3);

impl ContentHash {
    /// Adds a part.
    pub fn part(&mut self, bytes: &[u8]) {
        self.0.update(&(bytes.len() as u64).to_le_bytes());
        self.0.update(bytes);
    }
    /// The name.
    pub fn name(&self) -> String {
        format!("{:016x}", self.0.digest())
    }
}

/// The name of `value` by its JSON form; keys of tables are sorted there.
///
/// # Errors
/// [`Error::Backend`] for values that JSON cannot write.
pub(super) fn name_of(value: &impl Serialize) -> Result<String> {
    let json = serde_json::to_value(value).map_err(|e| Error::backend("hash", e.to_string(), "Report this: every configuration should have a JSON form"))?;
    let mut hash = ContentHash::default();
    hash.part(json.to_string().as_bytes());
    Ok(hash.name())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_of_content() {
        let table = |text: &str| text.parse::<toml::Table>().unwrap();
        assert_eq!(name_of(&table("a = 1\nb = 2")).unwrap(), name_of(&table("b = 2\na = 1")).unwrap());
        assert_ne!(name_of(&table("a = 1")).unwrap(), name_of(&table("a = 1.0")).unwrap());
        let joined = |parts: &[&[u8]]| {
            let mut hash = ContentHash::default();
            parts.iter().for_each(|part| hash.part(part));
            hash.name()
        };
        assert_ne!(joined(&[b"ab", b"c"]), joined(&[b"a", b"bc"]));
        assert_eq!(joined(&[]).len(), 16);
    }
}
