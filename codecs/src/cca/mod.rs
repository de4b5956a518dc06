//! `cca`: compression of canonical attributes (paper Section IV-D). Values that the paper does not state are chosen here.
//!
//! Three paths. Positions and degree-0 colours stay float32. Log-scales, opacity logits and quaternions are quantised per component, dynamic
//! scores after mu-law companding. The higher colour coefficients pass through a conditional autoencoder whose latents are quantised; a k-means
//! codebook approximates the residuals. The autoencoder is trained on the Gaussians it encodes, and its decoder is stored with them.
//!
//! Differences from the paper's text; none of them adds error:
//! * Gaussians are stored in Morton order of their positions; their order carries no meaning and neighbours compress together.
//! * Quaternions are split into a unit part, with its sign, and a norm. Both matter, because deformation offsets are added before
//!   normalisation. In a model with unit quaternions the norms take no bytes.
//! * Outliers are stored exactly instead of clamping them (see [`cc4dgs_format::storage::column`]).
//! * Coefficients are stored without autoencoder, at 16 bits each or exactly, if that takes fewer bytes (few Gaussians, low degrees) or if the
//!   autoencoder's error is larger than [`AttributeCodec::losses`] declares.

mod appearance;
mod geometry;
mod network;
mod principal;
mod profile;
mod shard;
mod train;

use crate::morton;
use cc4dgs_format::gaussians::sh_rest_len;
use cc4dgs_format::storage::{Attributes, ESCAPES, META, Shape, extra_streams, from_planes, open, stage_of_column, to_planes};
use cc4dgs_format::{AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, HostGaussians, Plugin, Result, Stream, StreamStage, inventory};
pub use profile::{Profile, Settings};

/// Version of the stored form.
const VERSION: u8 = 2;

/// The codec with its profile and settings.
#[derive(Clone, Debug)]
pub struct Cca {
    profile: Profile,
    settings: Settings,
}

impl AttributeCodec for Cca {
    fn encode(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>> {
        crate::require_encoders()?;
        gaussians.validate("Gaussians to encode", &context.limits)?;
        let sorted = gaussians.select(&morton::order(&gaussians.means));
        let mut meta = vec![VERSION];
        Shape::of(&sorted).write(&mut meta)?;
        let mut escapes = Vec::new();
        let mut streams =
            vec![Stream { name: "means".into(), bytes: to_planes(&sorted.means, 3) }, Stream { name: "sh_dc".into(), bytes: to_planes(&sorted.sh_dc, 3) }];
        // The attributes that the decoder has before it decodes colours.
        let (geometry, known) = geometry::encode(&sorted, &self.profile, &mut meta, &mut escapes);
        streams.extend(geometry);
        streams.extend(appearance::encode(&sorted, &known, &self.profile, &self.settings, context, &mut meta, &mut escapes)?);
        streams.extend(extra_streams(&sorted, Attributes::AsAllowed));
        streams.push(Stream { name: ESCAPES.into(), bytes: escapes });
        streams.insert(0, Stream { name: META.into(), bytes: meta });
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
        let of = |attribute: &str, relative_rms| DeclaredLoss { attribute: attribute.into(), relative_rms };
        vec![
            of("log_scales", self.profile.scalar_loss),
            of("opacity_logits", self.profile.scalar_loss),
            of("quaternions", self.profile.scalar_loss),
            of("dynamic_scores", self.profile.dynamic_loss),
            of("sh_rest", self.profile.appearance_loss),
        ]
    }
}

/// Without `harmonics`, their streams are not read, and the column is zeros.
fn decode(streams: &[Stream], context: &CodecContext, harmonics: bool) -> Result<HostGaussians> {
    let (set, mut meta, shape) = open("cca", streams, VERSION, &context.limits)?;
    let mut escapes = set.reader(ESCAPES)?;
    let mut out = HostGaussians {
        sh_degree: shape.sh_degree,
        means: from_planes(set.reader("means")?, shape.count, 3)?,
        sh_dc: from_planes(set.reader("sh_dc")?, shape.count, 3)?,
        ..Default::default()
    };
    geometry::decode(&set, shape.count, &mut meta, &mut escapes, &mut out)?;
    // Last in meta and escapes.
    if harmonics {
        out.sh_rest = appearance::decode(&set, &out, shape.count, &mut meta, &mut escapes)?;
        meta.finish()?;
        escapes.finish()?;
    } else {
        out.sh_rest = vec![0.0; shape.count * 3 * sh_rest_len(shape.sh_degree)];
    }
    shape.read_extra(&set, &mut out)?;
    out.validate_read("decoded Gaussians", &context.limits)?;
    Ok(out)
}

pub(crate) fn build(profile: &str, settings: &toml::Table) -> Result<Box<dyn AttributeCodec>> {
    let settings = Settings::parse(settings)?;
    Ok(Box::new(Cca { profile: Profile::named(profile)?.with(&settings), settings }))
}

inventory::submit! {
    CodecPlugin {
        info: Plugin {
            name: "cca",
            version: "2",
            summary: "conditional autoencoder and residual codebook for colours, selective quantisation for the rest",
            paper: "CC-4DGS, Section IV-D",
            schema: profile::SCHEMA,
            capabilities: &["lossy", "reorders", "profiles=default,mid,low"],
        },
        build,
    }
}
