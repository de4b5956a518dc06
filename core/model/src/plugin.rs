//! What every plug-in says of itself.

use serde::Serialize;

/// Facts of one registry entry.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Plugin {
    /// The name used in configurations; lower-case kebab.
    pub name: &'static str,
    /// Version of the plug-in's stored form.
    pub version: &'static str,
    /// One line for lists.
    pub summary: &'static str,
    /// Where the method comes from.
    pub paper: &'static str,
    /// Settings with defaults, as TOML text with comments.
    pub schema: &'static str,
    /// What it can do: `differentiable`, `static-only`, `profiles=…`.
    pub capabilities: &'static [&'static str],
}
