//! Errors that the suite must find: a lossless codec, in one correct and several wrong versions.

use super::*;
use crate::archive::ByteReader;
use crate::storage::{Attributes, META, Shape, extra_streams, from_planes, open, to_planes};
use crate::{DeclaredLoss, Plugin, unknown_name};
use serde::Deserialize;
use std::sync::atomic::{AtomicU8, Ordering};

/// Mistakes, which are the profiles of the codec, and what the suite says of each. The first is none.
const MISTAKES: [(&str, &str); 13] = [
    ("", ""),
    ("alike", "90 Gaussians that are alike: opacity_logits has a relative error"),
    ("far", "90 Gaussians far from the origin: means has a relative error"),
    ("apart", "means has a relative error"),
    ("threads", "of one thread and of three differ"),
    ("repeated", "two encodings of the same Gaussians differ"),
    ("unnamed", "an archive cannot hold a stream that is called \"\""),
    ("order", "streams in another order are not decoded to the same Gaussians"),
    ("motion", "became 0, across the threshold of"),
    ("unchecked", "was encoded"),
    ("limits", "more than the limit max_gaussians allows was decoded"),
    ("shorter", "is truncated at"),
    ("longer", "has trailing bytes"),
];

/// How often a codec with the mistake `repeated` has encoded.
static ENCODED: AtomicU8 = AtomicU8::new(0);

/// A codec with the mistake of this name.
struct Plain(&'static str);

impl AttributeCodec for Plain {
    fn encode(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>> {
        if self.0 != "unchecked" {
            gaussians.validate("Gaussians to encode", &context.limits)?;
        }
        let mut meta = vec![1];
        Shape::of(gaussians).write(&mut meta)?;
        let mut streams = vec![Stream { name: META.into(), bytes: meta }];
        streams.extend(gaussians.columns().map(|(name, width, values)| Stream { name: name.into(), bytes: to_planes(values, width) }));
        streams.extend(extra_streams(gaussians, Attributes::Exact));
        match self.0 {
            "threads" => streams.push(Stream { name: "threads".into(), bytes: vec![rayon::current_num_threads() as u8] }),
            "repeated" => streams.push(Stream { name: "count".into(), bytes: vec![ENCODED.fetch_add(1, Ordering::Relaxed)] }),
            "unnamed" => streams.push(Stream { name: String::new(), bytes: vec![0] }),
            _ => {}
        }
        Ok(streams)
    }
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        let limits = if self.0 == "limits" { Limits::default() } else { context.limits };
        let (set, meta, shape) = open("plain", streams, 1, &limits)?;
        meta.finish()?;
        let mut out = HostGaussians { sh_degree: shape.sh_degree, ..Default::default() };
        for (index, (column, width, values)) in out.columns_mut().into_iter().enumerate() {
            let at_index = streams.get(index + 1).filter(|_| self.0 == "order");
            let name = at_index.map_or(column, |stream| stream.name.as_str());
            let mut bytes = set.reader(name)?.rest().to_vec();
            let wanted = 4 * shape.count * width;
            match self.0 {
                "shorter" if bytes.len() < wanted => bytes.resize(wanted, 0),
                "longer" => bytes.truncate(wanted),
                _ => {}
            }
            *values = from_planes(ByteReader::new(name, &bytes), shape.count, width)?;
        }
        shape.read_extra(&set, &mut out)?;
        let first = out.means.get(..3).unwrap_or_default();
        let same = out.means.chunks_exact(3).all(|mean| mean == first);
        match self.0 {
            "alike" if out.len() > 1 && same => out.opacity_logits.fill(0.0),
            // Ten bits of mantissa are enough near the origin.
            "far" => out.means.iter_mut().for_each(|mean| *mean = f32::from_bits(mean.to_bits() & !0x1fff)),
            "apart" => {
                let attributes = std::mem::take(&mut out.extra);
                out = out.select(&(0..out.len()).rev().collect::<Vec<usize>>());
                out.extra = attributes;
            }
            "motion" => out.dynamic_scores.fill(0.0),
            _ => {}
        }
        out.validate_read("decoded Gaussians", &limits)?;
        Ok(out)
    }
    fn losses(&self) -> Vec<DeclaredLoss> {
        let loss = |attribute: &str, relative_rms: f64| vec![DeclaredLoss { attribute: attribute.into(), relative_rms }];
        match self.0 {
            // Enough for scores of 0.
            "motion" => loss("dynamic_scores", 10.0),
            "far" => loss("means", 0.01),
            _ => Vec::new(),
        }
    }
    fn keeps_motion(&self) -> bool {
        true
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {}

fn build(profile: &str, settings: &toml::Table) -> Result<Box<dyn AttributeCodec>> {
    let Settings {} = config::parse_section("codec plain", settings)?;
    match MISTAKES.iter().find(|(name, _)| *name == profile) {
        Some(&(name, _)) => Ok(Box::new(Plain(name))),
        None => Err(unknown_name("profile of codec plain", profile, MISTAKES.iter().map(|(name, _)| *name))),
    }
}

/// What the suite says of the codec with a mistake, whose schema is `schema`.
fn findings(mistake: &str, schema: &'static str) -> String {
    let info = Plugin { name: "plain", version: "1", summary: "a test", paper: "", schema, capabilities: &[] };
    codec(&CodecPlugin { info, build }, mistake, &toml::Table::new()).join("\n")
}

#[test]
fn mistakes_of_codecs_are_found() {
    for (mistake, expected) in MISTAKES {
        let found = findings(mistake, "# no settings\n");
        assert!(found.contains(expected) && found.is_empty() == mistake.is_empty(), "{mistake}: {found}");
    }
    let found = findings("", "bits = 8\n");
    assert!(found.contains("settings: it refuses the settings that its schema states") && found.contains("bits"), "{found}");
}
