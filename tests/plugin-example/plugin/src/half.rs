//! `half`: every attribute as 16-bit floats, in order.

use cc4dgs_core::archive::ByteReader;
use cc4dgs_core::burn::tensor::f16;
use cc4dgs_core::gaussians::sh_rest_len;
use cc4dgs_core::{
    AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, Error, ExtraAttribute, HostGaussians, Plugin, Result, Stream, config, inventory, toml,
    unknown_name,
};

/// Sixteen bits keep eleven of a number; columns whose mean is far from zero lose more of their deviation.
const LOSS: f64 = 0.02;
const COLUMNS: [&str; 7] = ["means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest", "dynamic_scores"];

struct Half;

impl AttributeCodec for Half {
    fn encode(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>> {
        gaussians.validate("Gaussians to encode", &context.limits)?;
        let mut meta = (gaussians.len() as u64).to_le_bytes().to_vec();
        meta.push(gaussians.sh_degree as u8);
        let mut streams = Vec::new();
        for (name, _, values) in gaussians.columns() {
            if let Some(v) = values.iter().find(|v| !f16::from_f32(**v).is_finite()) {
                return Err(Error::parameter(format!("codec half: {name}"), format!("{v} is beyond 65,504"), "Use another codec"));
            }
            streams.push(Stream { name: name.into(), bytes: values.iter().flat_map(|v| f16::from_f32(*v).to_le_bytes()).collect() });
        }
        // What other plug-ins keep per Gaussian passes unharmed.
        meta.push(gaussians.extra.len() as u8);
        for (name, attribute) in &gaussians.extra {
            meta.extend([name.len() as u8, attribute.width as u8]);
            meta.extend(name.as_bytes());
            streams.push(Stream { name: format!("extra.{name}"), bytes: attribute.values.iter().flat_map(|v| v.to_le_bytes()).collect() });
        }
        streams.push(Stream { name: "meta".into(), bytes: meta });
        Ok(streams)
    }
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        let reader = |name: &str| match streams.iter().find(|s| s.name == name) {
            Some(stream) => Ok(ByteReader::new(format!("half stream '{name}'"), &stream.bytes)),
            None => Err(Error::data(format!("half stream '{name}'"), "it is missing", "The file is damaged")),
        };
        let mut meta = reader("meta")?;
        let (count, degree) = (meta.u64()?, usize::from(meta.u8()?));
        // Nothing is allocated because a file claims to need it.
        context.limits.check_gaussians("encoded Gaussians", count)?;
        if degree > 4 {
            return Err(meta.error(format!("spherical-harmonics degree {degree} is over 4")));
        }
        let (n, mut out) = (count as usize, HostGaussians { sh_degree: degree, ..Default::default() });
        debug_assert_eq!(out.columns_mut()[5].1, 3 * sh_rest_len(degree));
        for (name, width, values) in out.columns_mut() {
            let mut stream = reader(name)?;
            let bytes = stream.take(n.saturating_mul(2 * width))?;
            *values = bytes.as_chunks::<2>().0.iter().map(|b| f16::from_le_bytes(*b).to_f32()).collect();
            stream.finish()?;
        }
        for _ in 0..meta.u8()? {
            let (length, width) = (usize::from(meta.u8()?), usize::from(meta.u8()?));
            let name = meta.name(length)?;
            let mut stream = reader(&format!("extra.{name}"))?;
            let values = stream.f32s(n.saturating_mul(width))?;
            stream.finish()?;
            out.extra.insert(name, ExtraAttribute { width, values });
        }
        meta.finish()?;
        out.validate("decoded Gaussians", &context.limits)?;
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
