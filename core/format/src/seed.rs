//! Random seeds as a tree: a root seed and named children, so that a new consumer never changes another consumer's random numbers.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use serde::{Deserialize, Serialize};

/// A node of the seed tree. Equal paths from equal roots give equal numbers on every machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Seed(u64);

impl Seed {
    /// The root of a run, from the configuration.
    pub fn root(seed: u64) -> Self {
        Self(seed)
    }
    /// The child called `name` (a stage, a component).
    pub fn child(self, name: &str) -> Self {
        Self(xxhash_rust::xxh3::xxh3_64_with_seed(name.as_bytes(), self.0))
    }
    /// The `index`-th child (a level, an iteration).
    pub fn index(self, index: u64) -> Self {
        Self(xxhash_rust::xxh3::xxh3_64_with_seed(&index.to_le_bytes(), self.0))
    }
    /// The node's 64 bits.
    pub fn value(self) -> u64 {
        self.0
    }
    /// A generator seeded by this node.
    pub fn rng(self) -> ChaCha8Rng {
        ChaCha8Rng::seed_from_u64(self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::Seed;

    #[test]
    fn children_differ_by_name_and_index() {
        let root = Seed::root(7);
        assert_ne!(root.child("init"), root.child("loader"));
        assert_ne!(root.index(0), root.index(1));
        assert_eq!(root.child("init").index(3), Seed::root(7).child("init").index(3));
    }
}
