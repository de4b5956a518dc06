//! ZIP files whose members are stored as they are: the images inside are compressed already.

use cc4dgs_format::{Error, Result};
use flate2::Crc;

const LOCAL: u32 = 0x0403_4b50;
const CENTRAL: u32 = 0x0201_4b50;
const END: u32 = 0x0605_4b50;
/// The version of the specification that a reader needs: 1.0.
const VERSION: u16 = 10;
/// The first day that a ZIP file can state, so that equal contents give equal bytes.
const DATE: u16 = 0x21;

/// A ZIP file of (name, content).
pub fn store(files: &[(&str, Vec<u8>)]) -> Result<Vec<u8>> {
    let mut out = Vec::new();
    let mut directory = Vec::new();
    for (name, content) in files {
        let mut crc = Crc::new();
        crc.update(content);
        let offset = small(out.len())?;
        let size = small(content.len())?;
        // What the local header and the directory share: version, flags, method, time, date, checksum, sizes, lengths of name and extra field.
        let mut common = Vec::new();
        common.extend([VERSION, 0, 0, 0, DATE].into_iter().flat_map(u16::to_le_bytes));
        common.extend([crc.sum(), size, size].into_iter().flat_map(u32::to_le_bytes));
        common.extend([name.len() as u16, 0].into_iter().flat_map(u16::to_le_bytes));
        out.extend(LOCAL.to_le_bytes());
        out.extend(&common);
        out.extend(name.as_bytes());
        out.extend(content);
        directory.extend(CENTRAL.to_le_bytes());
        directory.extend(VERSION.to_le_bytes());
        directory.extend(&common);
        // Comment, disk, attributes.
        directory.extend([0u8; 10]);
        directory.extend(offset.to_le_bytes());
        directory.extend(name.as_bytes());
    }
    let start = small(out.len())?;
    let count = files.len() as u16;
    let size = small(directory.len())?;
    out.extend(directory);
    out.extend(END.to_le_bytes());
    out.extend([0, 0, count, count].into_iter().flat_map(u16::to_le_bytes));
    out.extend([size, start].into_iter().flat_map(u32::to_le_bytes));
    out.extend([0, 0]);
    Ok(out)
}

/// The members of a ZIP file that `store` could have written, as (name, content). For tests and tools; files of other writers may be refused.
///
/// # Errors
/// [`Error::Data`] for other files and wrong checksums.
pub fn stored(bytes: &[u8]) -> Result<Vec<(String, Vec<u8>)>> {
    let bad = |problem: &str| Error::data("ZIP file", problem, "Give a ZIP file with stored members and no comment");
    let word = |at: usize| bytes.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).ok_or_else(|| bad("it is truncated"));
    let half = |at: usize| Ok::<_, Error>(word(at)? as u16 as usize);
    let end = bytes.len().checked_sub(22).ok_or_else(|| bad("it is truncated"))?;
    if word(end)? != END {
        return Err(bad("it has no directory at its end"));
    }
    let mut at = word(end + 16)? as usize;
    let mut files = Vec::new();
    for _ in 0..word(end + 8)? >> 16 {
        if word(at)? != CENTRAL || half(at + 10)? != 0 {
            return Err(bad("a member is not stored"));
        }
        let (crc, size, name_len, local) = (word(at + 16)?, word(at + 20)? as usize, half(at + 28)?, word(at + 42)? as usize);
        let name = bytes.get(at + 46..at + 46 + name_len).ok_or_else(|| bad("it is truncated"))?;
        let start = local.saturating_add(30 + half(local.saturating_add(26))? + word(local.saturating_add(28))? as u16 as usize);
        let content = bytes.get(start..start.saturating_add(size)).ok_or_else(|| bad("it is truncated"))?;
        let mut found = Crc::new();
        found.update(content);
        if found.sum() != crc {
            return Err(bad("a checksum is wrong"));
        }
        files.push((String::from_utf8_lossy(name).into_owned(), content.to_vec()));
        at += 46 + name_len + half(at + 30)? + half(at + 32)?;
    }
    Ok(files)
}

fn small(size: usize) -> Result<u32> {
    u32::try_from(size).map_err(|_| Error::limit("ZIP file", size as u64, u64::from(u32::MAX), "Prune the model, or export PLY"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn members_come_back_and_damage_is_found() {
        let files = [("meta.json", b"{}".to_vec()), ("empty", Vec::new()), ("a.webp", (0..200).collect())];
        let bytes = store(&files).unwrap();
        let found = stored(&bytes).unwrap();
        assert!(found.iter().zip(&files).all(|((a, b), (c, d))| a == c && b == d) && found.len() == 3);
        for cut in 0..bytes.len() {
            assert!(stored(&bytes[..cut]).is_err());
        }
        let mut damaged = bytes.clone();
        damaged[40] ^= 1;
        assert!(stored(&damaged).is_err());
    }
}
