//! `half`: every attribute as 16-bit floats, in order; as float32 where those would lose too much. A codec needs nothing but `cc4dgs-format`.

use cc4dgs_format::storage::{Attributes, META, Shape, column_loss, extra_streams, open};
use cc4dgs_format::{
    AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, Error, HostGaussians, Plugin, Result, Stream, config, inventory, toml, unknown_name,
};
use half::f16;

/// Version of the stored form.
const VERSION: u8 = 1;
/// The promise, which holds for any input: sixteen bits keep eleven of a number, and columns whose mean is far from zero would lose more of their deviation.
const LOSS: f64 = 0.02;
/// How the values of a column are stored.
const HALF: u8 = 0;
const FLOAT: u8 = 1;
const COLUMNS: [&str; 7] = ["means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest", "dynamic_scores"];

struct Half;

impl AttributeCodec for Half {
    fn encode(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>> {
        gaussians.validate("Gaussians to encode", &context.limits)?;
        let mut meta = vec![VERSION];
        Shape::of(gaussians).write(&mut meta)?;
        let mut streams = Vec::new();
        for (name, width, values) in gaussians.columns() {
            let halves: Vec<f16> = values.iter().map(|v| f16::from_f32(*v)).collect();
            let decoded: Vec<f32> = halves.iter().map(|v| v.to_f32()).collect();
            // A value beyond 65,504 would become infinite, and the loss with it.
            let kept = column_loss(name, values, &decoded, width) <= LOSS;
            meta.push(if kept { HALF } else { FLOAT });
            let bytes = if kept { halves.iter().flat_map(|v| v.to_le_bytes()).collect() } else { values.iter().flat_map(|v| v.to_le_bytes()).collect() };
            streams.push(Stream { name: name.into(), bytes });
        }
        streams.push(Stream { name: META.into(), bytes: meta });
        // What other plug-ins keep per Gaussian survives as far as they ask for.
        streams.extend(extra_streams(gaussians, Attributes::AsAllowed));
        Ok(streams)
    }
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        // Checks the claimed counts against the limits before anything is allocated for them.
        let (set, mut meta, shape) = open("half", streams, VERSION, &context.limits)?;
        let mut out = HostGaussians { sh_degree: shape.sh_degree, ..Default::default() };
        for (name, width, values) in out.columns_mut() {
            let (mut stream, count) = (set.reader(name)?, shape.count.saturating_mul(width));
            *values = match meta.u8()? {
                HALF => stream.take(count.saturating_mul(2))?.as_chunks::<2>().0.iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect(),
                FLOAT => stream.f32s(count)?,
                other => return Err(meta.error(format!("{name} is stored in form {other}, which is none"))),
            };
            stream.finish()?;
        }
        meta.finish()?;
        shape.read_extra(&set, &mut out)?;
        out.validate_read("decoded Gaussians", &context.limits)?;
        Ok(out)
    }
    fn losses(&self) -> Vec<DeclaredLoss> {
        COLUMNS.map(|name| DeclaredLoss { attribute: name.into(), relative_rms: LOSS }).to_vec()
    }
}

fn build(profile: &str, settings: &toml::Table) -> Result<Box<dyn AttributeCodec>> {
    if !profile.is_empty() {
        return Err(unknown_name("profile of codec half", profile, [].into_iter()));
    }
    config::parse_section::<toml::Table>("codec half", settings).and_then(|table| match table.keys().next() {
        None => Ok(Box::new(Half) as Box<dyn AttributeCodec>),
        Some(key) => Err(Error::parameter(format!("codec half.{key}"), "there is no such setting", "Remove it")),
    })
}

inventory::submit! {
    CodecPlugin {
        info: Plugin { name: "half", version: "1", summary: "16-bit floats", paper: "an example", schema: "# no settings\n", capabilities: &["lossy"] },
        build,
    }
}
