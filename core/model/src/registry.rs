//! All plug-ins that are linked in, collected once into a value. A name taken twice and a name unknown are errors.

use crate::plugin::Plugin;
use crate::{AttributeCodec, CodecPlugin, Deformer, DeformerContext, DeformerPlugin, Error, Rasterizer, RasterizerPlugin, Result};
use burn::tensor::Device;
use std::collections::BTreeMap;

/// The linked plug-ins by kind and name.
pub struct Registry {
    deformers: BTreeMap<&'static str, &'static DeformerPlugin>,
    codecs: BTreeMap<&'static str, &'static CodecPlugin>,
    rasterizers: BTreeMap<&'static str, &'static RasterizerPlugin>,
}

fn collect<P: 'static>(kind: &str, plugins: impl Iterator<Item = &'static P>, name: fn(&P) -> &'static str) -> Result<BTreeMap<&'static str, &'static P>> {
    let mut map = BTreeMap::new();
    for plugin in plugins {
        if map.insert(name(plugin), plugin).is_some() {
            return Err(Error::parameter(format!("{kind} {}", name(plugin)), "two plug-ins registered this name", "Rename one of them or link only one"));
        }
    }
    Ok(map)
}

/// An error about `name` that lists the nearest of `known`.
pub fn unknown_name<'a>(kind: &str, name: &str, known: impl Iterator<Item = &'a str>) -> Error {
    let mut known: Vec<&str> = known.collect();
    known.sort_by(|a, b| strsim::jaro_winkler(b, name).total_cmp(&strsim::jaro_winkler(a, name)).then(a.cmp(b)));
    // Jaro-Winkler misses swapped letters in short names, edit distance misses long names that share only their beginning.
    let few_edits = |k: &str| strsim::damerau_levenshtein(k, name) <= (name.chars().count() / 3).min(2);
    let near: Vec<&str> = known.iter().copied().filter(|k| strsim::jaro_winkler(k, name) > 0.75 || few_edits(k)).take(3).collect();
    let remedy =
        if near.is_empty() { format!("Known: {}", known.join(", ")) } else { format!("Did you mean {}? Known: {}", near.join(" or "), known.join(", ")) };
    Error::parameter(format!("{kind} '{name}'"), "no such name", remedy)
}

fn find<P>(kind: &str, name: &str, map: &BTreeMap<&'static str, &'static P>) -> Result<&'static P> {
    map.get(name).copied().ok_or_else(|| unknown_name(kind, name, map.keys().copied()))
}

impl Registry {
    /// Collects everything linked into this program.
    pub fn collect() -> Result<Self> {
        Ok(Self {
            deformers: collect("deformer", inventory::iter::<DeformerPlugin>.into_iter(), |p: &DeformerPlugin| p.info.name)?,
            codecs: collect("codec", inventory::iter::<CodecPlugin>.into_iter(), |p: &CodecPlugin| p.info.name)?,
            rasterizers: collect("rasterizer", inventory::iter::<RasterizerPlugin>.into_iter(), |p: &RasterizerPlugin| p.info.name)?,
        })
    }
    /// All entries as (kind, facts), sorted.
    pub fn plugins(&self) -> Vec<(&'static str, &'static Plugin)> {
        let deformers = self.deformers.values().map(|p| ("deformer", &p.info));
        let codecs = self.codecs.values().map(|p| ("codec", &p.info));
        let rasterizers = self.rasterizers.values().map(|p| ("rasterizer", &p.info));
        codecs.chain(deformers).chain(rasterizers).collect()
    }
    /// Facts of one deformer.
    pub fn deformer(&self, name: &str) -> Result<&'static DeformerPlugin> {
        find("deformer", name, &self.deformers)
    }
    /// Facts of one codec.
    pub fn codec(&self, name: &str) -> Result<&'static CodecPlugin> {
        find("codec", name, &self.codecs)
    }
    /// Facts of one rasterizer.
    pub fn rasterizer(&self, name: &str) -> Result<&'static RasterizerPlugin> {
        find("rasterizer", name, &self.rasterizers)
    }
    /// Builds the deformer of a `[deformer]` section (`kind` and its settings).
    pub fn build_deformer(&self, section: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
        let (kind, settings) = split_kind("deformer", section)?;
        (self.deformer(&kind)?.build)(&settings, context, device)
    }
    /// Builds the rasterizer of a `[rasterizer]` section (`kind` and its settings).
    pub fn build_rasterizer(&self, section: &toml::Table) -> Result<Box<dyn Rasterizer>> {
        let (kind, settings) = split_kind("rasterizer", section)?;
        (self.rasterizer(&kind)?.build)(&settings)
    }
    /// Builds the codec of `name` or `name:profile` with `settings`.
    pub fn build_codec(&self, spec: &str, settings: &toml::Table) -> Result<Box<dyn AttributeCodec>> {
        let (name, profile) = spec.split_once(':').unwrap_or((spec, ""));
        (self.codec(name)?.build)(profile, settings)
    }
}

/// Splits a plug-in section into its `kind` and the rest.
pub fn split_kind(object: &str, section: &toml::Table) -> Result<(String, toml::Table)> {
    let mut settings = section.clone();
    match settings.remove("kind") {
        Some(toml::Value::String(kind)) => Ok((kind, settings)),
        Some(other) => Err(Error::parameter(format!("{object}.kind"), format!("{other} is not a string"), "Write the plug-in's name in quotes")),
        None => Err(Error::parameter(format!("{object}.kind"), "missing", "Name a plug-in; `cc4dgs plugins` lists them")),
    }
}

#[cfg(test)]
mod tests {
    use super::unknown_name;

    #[test]
    fn unknown_names_list_near_matches() {
        let message = unknown_name("deformer", "cfd", ["cdf", "none", "swift4d-hash"].into_iter()).to_string();
        assert!(message.contains("Did you mean cdf"), "{message}");
        assert!(message.contains("swift4d-hash"), "{message}");
    }
}
