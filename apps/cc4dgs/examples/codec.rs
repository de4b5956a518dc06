//! A codec of one's own: float32 with fewer bits of mantissa. The archive separates the bytes and compresses them, so zeroed bits cost next to nothing.
//!
//! `cargo run --release --example codec -- [ITERATIONS]`.
#![allow(clippy::print_stdout, reason = "its output is what it is for")]

use cc4dgs::core::storage::{Attributes, META, Shape, column_loss, extra_streams, from_planes, open, to_planes};
use cc4dgs::core::{AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, Plugin, Stream, config, conformance, inventory, serde, toml, unknown_name};
use cc4dgs::{Error, HostGaussians, Result, Session};

/// Version of the stored form, the first byte of the meta stream.
const VERSION: u8 = 1;
/// The most that a column loses, of its deviation.
const LOSS: f64 = 0.02;

struct Rounded;

/// Keeps 9 of 23 bits of mantissa.
fn rounded(value: f32) -> f32 {
    let result = f32::from_bits(value.to_bits().saturating_add(1 << 13) & !0x3fff);
    if result.is_finite() { result } else { value }
}

impl AttributeCodec for Rounded {
    fn encode(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>> {
        gaussians.validate("Gaussians to encode", &context.limits)?;
        let mut meta = vec![VERSION];
        Shape::of(gaussians).write(&mut meta)?;
        let mut streams = vec![Stream { name: META.into(), bytes: meta }];
        for (name, width, values) in gaussians.columns() {
            let fewer: Vec<f32> = values.iter().copied().map(rounded).collect();
            // Where the mean is far from zero, rounding loses more; what is promised holds for any input.
            let kept = if column_loss(name, values, &fewer, width) <= LOSS { &fewer } else { values };
            streams.push(Stream { name: name.into(), bytes: to_planes(kept, width) });
        }
        streams.extend(extra_streams(gaussians, Attributes::AsAllowed));
        Ok(streams)
    }
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        // The bytes may come from anywhere: `open` holds claimed counts to the limits before anything is allocated.
        let (set, meta, shape) = open("rounded", streams, VERSION, &context.limits)?;
        meta.finish()?;
        let mut out = HostGaussians { sh_degree: shape.sh_degree, ..Default::default() };
        for (name, width, values) in out.columns_mut() {
            *values = from_planes(set.reader(name)?, shape.count, width)?;
        }
        shape.read_extra(&set, &mut out)?;
        out.validate_read("decoded Gaussians", &context.limits)?;
        Ok(out)
    }
    fn losses(&self) -> Vec<DeclaredLoss> {
        let columns = HostGaussians::default().columns().map(|(name, _, _)| name);
        columns.map(|name| DeclaredLoss { attribute: name.into(), relative_rms: LOSS }).to_vec()
    }
}

#[derive(serde::Deserialize)]
#[serde(crate = "self::serde", deny_unknown_fields)]
struct Settings {}

fn build(profile: &str, settings: &toml::Table) -> Result<Box<dyn AttributeCodec>> {
    let Settings {} = config::parse_section("codec rounded", settings)?;
    if profile.is_empty() { Ok(Box::new(Rounded)) } else { Err(unknown_name("profile of codec rounded", profile, [].into_iter())) }
}

inventory::submit! {
    CodecPlugin {
        info: Plugin { name: "rounded", version: "1", summary: "fewer bits of mantissa", paper: "an example", schema: "# no settings\n", capabilities: &["lossy"] },
        build,
    }
}

fn main() -> Result<()> {
    let iterations = std::env::args().nth(1).unwrap_or_else(|| "300".into());
    let session = Session::new()?;
    let findings = conformance::codec(session.registry().codec("rounded")?, "", &toml::Table::new());
    if !findings.is_empty() {
        return Err(Error::backend("codec rounded", findings.join("\n"), "Correct it"));
    }
    let config = session.config("demo", &[&format!("train.iterations={iterations}")])?;
    let model = session.train(&config, session.read_scene("procedural:tiny", &config.scene)?, None)?;
    let folder = tempfile::tempdir().map_err(|e| Error::io(std::env::temp_dir(), e))?;
    let size = |codec: &str| model.save(folder.path().join(format!("{codec}.cc4d")), codec);
    println!("raw: {} bytes, rounded: {} bytes", size("raw")?, size("rounded")?);
    Ok(())
}
