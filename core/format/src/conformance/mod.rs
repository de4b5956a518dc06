//! Conformance suites for codecs and exporters. Call them from a test of the plug-in's own crate.
//!
//! Each returns a list of findings, one line each; an empty list means that the plug-in passed. They generate their own inputs and need no data.

mod codec;
#[cfg(not(target_arch = "wasm32"))]
mod exporter;
mod weight_codec;

pub use codec::codec;
#[cfg(not(target_arch = "wasm32"))]
pub use exporter::{MovingModel, export_facts, exporter};
pub use weight_codec::weight_codec;

use crate::{Error, Plugin, Result, Seed, config};

/// What is wrong with how a plug-in reads settings, if anything is: an unknown key must be refused by name, and the schema must be TOML that the plug-in
/// accepts. `build` builds it, with `settings` and with others; `kind` is that of the plug-in in errors.
///
/// # Errors
/// [`Error::Parameter`] for a schema that is not TOML, and what `build` reports without settings.
pub fn settings_are_read(kind: &str, info: &Plugin, settings: &toml::Table, build: impl Fn(&toml::Table) -> Result<()>) -> Result<Option<String>> {
    let mut odd = settings.clone();
    odd.insert("no_such_setting".into(), 1.into());
    match build(&odd) {
        Ok(()) => return Ok(Some("an unknown setting was accepted".into())),
        Err(e) if !e.to_string().contains("no_such_setting") => return Ok(Some(format!("the error does not name the unknown setting: {e}"))),
        Err(_) => {}
    }
    let stated = config::parse_table(&format!("schema of {kind} {}", info.name), info.schema)?;
    build(&toml::Table::new())?;
    Ok(build(&stated).err().map(|e| format!("it refuses the settings that its schema states: {e}")))
}

/// The `k`-th random number of `seed`, uniform in -1..1.
pub fn uniform(seed: Seed, k: usize) -> f32 {
    (seed.index(k as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0
}

/// What `work` returns where there are so many threads.
fn on_threads<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> Result<T> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = pool.map_err(|e| Error::backend("threads", e.to_string(), "Run the suite where a program can start threads"))?;
    Ok(pool.install(work))
}
