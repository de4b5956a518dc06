//! Damages that are kept in `tests/corpus`: one for every outcome that a decoder was seen to have. A file holds sound streams, as an encoder of its
//! time wrote them, and a line per case. They are repeated by every run, and new damages are done on top of them.

use super::damage::{Damage, harm};
use cc4dgs_format::Stream;
use proptest::sample::Index;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Streams larger than this have no corpus, so that the repository stays small.
const MOST_BYTES: usize = 12_000;
/// Damages of a case, and cases of a file, at most.
const MOST_DAMAGES: usize = 4;
const MOST_CASES: usize = 80;

/// Damages, each with the stream that it is done to.
pub type Damages = Vec<(usize, Damage)>;

#[derive(Clone, Serialize, Deserialize)]
pub struct Case {
    /// What happens, without numbers.
    pub outcome: String,
    pub damages: Damages,
}

pub struct Corpus {
    pub sound: Vec<Stream>,
    pub cases: Vec<Case>,
}

/// The streams with all damages done in turn.
pub fn harmed(sound: &[Stream], damages: &[(usize, Damage)]) -> Vec<Stream> {
    let mut streams = sound.to_vec();
    damages.iter().for_each(|(which, damage)| harm(&mut streams, *which, damage));
    streams
}

/// A message without its numbers, and without names that are none of the sound `streams`.
pub fn class(message: &str, streams: &[Stream]) -> String {
    let known = |name: &str| streams.iter().any(|s| s.name == name);
    let parts = message.split('\'').enumerate().map(|(k, part)| if k % 2 == 0 || known(part) { part } else { "..." });
    let text = parts.collect::<Vec<_>>().join("'");
    let words = text.split_whitespace().map(|word| if word.contains(|c: char| c.is_ascii_digit()) { "#" } else { word });
    words.collect::<Vec<_>>().join(" ")
}

fn size(streams: &[Stream]) -> usize {
    streams.iter().map(|s| s.bytes.len()).sum()
}

/// Whether the corpus is to be extended.
fn grows() -> bool {
    std::env::var_os("CC4DGS_HOSTILE_CORPUS").is_some()
}

fn path(name: &str) -> PathBuf {
    Path::new("tests/corpus").join(format!("{name}.jsonl"))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

fn from_hex(text: &str) -> Vec<u8> {
    (0..text.len() / 2).map(|k| u8::from_str_radix(&text[2 * k..2 * k + 2], 16).expect("hexadecimal digits")).collect()
}

impl Corpus {
    /// That of `name`, whose streams are `fresh` now; `None` where these are too large for one, or where it is to be written. Fails where it is missing.
    pub fn read(name: &str, fresh: &[Stream]) -> Option<Self> {
        let path = path(name);
        if !path.exists() {
            let missing = size(fresh) <= MOST_BYTES && !grows();
            assert!(!missing, "codecs/{} is missing: restore it, or have this test write it with CC4DGS_HOSTILE_CORPUS=1", path.display());
            return None;
        }
        let text = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let mut lines = text.lines();
        let streams: Vec<(String, String)> = serde_json::from_str(lines.next().unwrap_or_default()).expect("streams in the first line");
        let sound = streams.into_iter().map(|(name, bytes)| Stream { name, bytes: from_hex(&bytes) }).collect();
        Some(Self { sound, cases: lines.map(|line| serde_json::from_str(line).expect("a case")).collect() })
    }
}

/// The corpus as it grows.
pub struct Growing {
    name: String,
    /// Fresh streams, and those of the corpus.
    sound: [Vec<Stream>; 2],
    cases: Vec<Case>,
    outcomes: BTreeSet<String>,
    before: usize,
}

impl Growing {
    pub fn new(name: &str, fresh: &[Stream], known: &[Case], base: &[Stream]) -> Self {
        let outcomes = known.iter().map(|case| case.outcome.clone()).collect();
        Self { name: name.into(), sound: [fresh.to_vec(), base.to_vec()], cases: known.to_vec(), outcomes, before: known.len() }
    }
    pub fn sound(&self, fresh: bool) -> &[Stream] {
        &self.sound[usize::from(!fresh)]
    }
    /// The damages of some case; none where there is no case.
    pub fn pick(&self, index: Index) -> Damages {
        if self.cases.is_empty() { Vec::new() } else { index.get(&self.cases).damages.clone() }
    }
    /// Remembers damages to the streams of the corpus that had an outcome not seen before.
    pub fn keep(&mut self, fresh: bool, outcome: String, damages: Damages) {
        let of_corpus = !fresh || self.sound[0] == self.sound[1];
        let small = damages.len() <= MOST_DAMAGES && self.cases.len() < MOST_CASES;
        if of_corpus && small && self.outcomes.insert(outcome.clone()) {
            self.cases.push(Case { outcome, damages });
        }
    }
    /// Writes the corpus where that is asked for and something was found, and says so.
    pub fn write(self) -> Option<String> {
        if !grows() || self.cases.len() == self.before || size(&self.sound[1]) > MOST_BYTES {
            return None;
        }
        let streams: Vec<(&str, String)> = self.sound[1].iter().map(|s| (s.name.as_str(), hex(&s.bytes))).collect();
        let lines = std::iter::once(serde_json::to_string(&streams)).chain(self.cases.iter().map(serde_json::to_string));
        let text: Vec<String> = lines.map(|line| line.expect("JSON")).collect();
        let path = path(&self.name);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder for the corpus");
        std::fs::write(&path, text.join("\n") + "\n").expect("the corpus is written");
        Some(format!("{}: {} cases, {} of them new", self.name, self.cases.len(), self.cases.len() - self.before))
    }
}
