//! `demo+swaying`, `dnerf+swaying` and so on: a family's settings with the deformer of this crate.

use cc4dgs_core::{Plugin, PresetPlugin, PresetRole, inventory};

inventory::submit! {
    PresetPlugin {
        info: Plugin {
            name: "swaying",
            version: "1",
            summary: "the deformer sway; everything moves",
            paper: "an example",
            schema: "[all.deformer]\nkind = \"sway\"\n[all.train]\ndynamic = \"all\"\n[dnerf.deformer]\ncycles = 2.0\n",
            capabilities: &["method"],
        },
        role: PresetRole::Method,
    }
}

/// A family brings a whole configuration; methods (`tiny+swaying`) are laid over it.
const TINY: &str = "[deformer]\nkind = \"sway\"\n[init]\ncount = 200\n[train]\niterations = 40\nbatch = 1\nsh_degree = 0\n";

inventory::submit! {
    PresetPlugin {
        info: Plugin { name: "tiny", version: "1", summary: "seconds on one core", paper: "an example", schema: TINY, capabilities: &["family"] },
        role: PresetRole::Family { dataset: "tiny", small: true },
    }
}
