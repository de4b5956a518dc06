//! `raw`: every attribute as float32, bit-exact and in order.

use cc4dgs_format::storage::{Attributes, HARMONICS, META, Shape, extra_streams, from_planes, open, stage_of_column, to_planes};
use cc4dgs_format::{
    AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, HostGaussians, Plugin, Result, Stream, StreamStage, config, inventory, unknown_name,
};
use serde::Deserialize;

/// Version of the stored form.
const VERSION: u8 = 2;

struct Raw;

impl AttributeCodec for Raw {
    fn encode(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>> {
        crate::require_encoders()?;
        gaussians.validate("Gaussians to encode", &context.limits)?;
        let mut meta = vec![VERSION];
        Shape::of(gaussians).write(&mut meta)?;
        let mut streams = vec![Stream { name: META.into(), bytes: meta }];
        streams.extend(gaussians.columns().into_iter().map(|(name, width, values)| Stream { name: name.into(), bytes: to_planes(values, width) }));
        streams.extend(extra_streams(gaussians, Attributes::Exact));
        Ok(streams)
    }

    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        decode(streams, context, true)
    }
    fn stage(&self, name: &str) -> StreamStage {
        stage_of_column(name)
    }
    fn decode_stage(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        decode(streams, context, false)
    }

    fn losses(&self) -> Vec<DeclaredLoss> {
        Vec::new()
    }
}

/// Without `harmonics`, their streams are not read, and the column is zeros.
fn decode(streams: &[Stream], context: &CodecContext, harmonics: bool) -> Result<HostGaussians> {
    let (set, meta, shape) = open("raw", streams, VERSION, &context.limits)?;
    meta.finish()?;
    let mut out = HostGaussians { sh_degree: shape.sh_degree, ..Default::default() };
    for (name, width, values) in out.columns_mut() {
        *values = if name == HARMONICS && !harmonics { vec![0.0; shape.count * width] } else { from_planes(set.reader(name)?, shape.count, width)? };
    }
    shape.read_extra(&set, &mut out)?;
    out.validate_read("decoded Gaussians", &context.limits)?;
    Ok(out)
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {}

pub(crate) fn build(profile: &str, settings: &toml::Table) -> Result<Box<dyn AttributeCodec>> {
    if !matches!(profile, "" | "default") {
        return Err(unknown_name("profile of codec raw", profile, ["default"].into_iter()));
    }
    let Settings {} = config::parse_section("codec raw", settings)?;
    Ok(Box::new(Raw))
}

inventory::submit! {
    CodecPlugin {
        info: Plugin {
            name: "raw",
            version: "2",
            summary: "float32, bit-exact",
            paper: "the uncompressed baseline",
            schema: "# no settings\n",
            capabilities: &["lossless", "profiles=default"],
        },
        build,
    }
}
