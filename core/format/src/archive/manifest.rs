//! The manifest of an archive.

use super::Presentation;
use crate::{BLUR, BLUR_RANGE, DeformerContext, Error, Limits, Result, Rules, Similarity};
use serde::{Deserialize, Serialize};

/// The archive version this build writes and reads.
pub const FORMAT_VERSION: u32 = 3;
/// The most frames of a sequence.
pub const MOST_FRAMES: usize = 1 << 20;

/// The codec of some of the streams.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CodecEntry {
    /// Registry name.
    pub name: String,
    /// Profile; empty for the codec's default profile.
    pub profile: String,
    /// Version of the codec's stored form ([`crate::Plugin::version`]).
    pub version: String,
    /// The codec's settings.
    pub settings: toml::Table,
}

/// The deformer of the weight streams.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DeformerEntry {
    /// Registry name.
    pub name: String,
    /// Version of the deformer's stored form.
    pub version: String,
    /// The settings it was built with, without `kind`.
    pub settings: toml::Table,
    /// What the deformer knows of the scene.
    pub context: DeformerContext,
    /// The weight codec of the weight streams. Weight codecs have no profiles.
    pub weights: CodecEntry,
}

/// How the model is rendered.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RasterizerEntry {
    /// Registry name of the rasterizer used in training.
    pub name: String,
    /// The rules it was trained with.
    pub rules: Rules,
    /// Whether the antialiasing compensation was on.
    pub antialiased: bool,
    /// What a pixel adds to both diagonal entries of the projected covariance, square pixels; absent if it is [`BLUR`].
    #[serde(default = "blur", skip_serializing_if = "is_usual")]
    pub blur: f64,
    /// Longest focal length in pixels of the training images: longer ones blur more ([`blur_at`](crate::blur_at)); absent if all blur alike.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub focal: Option<f64>,
    /// Smallest camera depth drawn, units of the model; absent if the rules' default was used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub near: Option<f32>,
    /// Its settings, without `kind`.
    pub settings: toml::Table,
}

fn blur() -> f64 {
    BLUR
}

fn is_usual(blur: &f64) -> bool {
    *blur == BLUR
}

impl Default for RasterizerEntry {
    fn default() -> Self {
        Self { name: String::new(), rules: Rules::default(), antialiased: false, blur: BLUR, focal: None, near: None, settings: toml::Table::new() }
    }
}

impl RasterizerEntry {
    /// Refuses a blur, focal length or depth that nothing can be drawn with; `object` names the file in errors.
    fn validate(&self, object: &str) -> Result<()> {
        let problem = match (self.focal, self.near) {
            _ if !BLUR_RANGE.contains(&self.blur) => format!("its blur of {} is not between {} and {}", self.blur, BLUR_RANGE.start(), BLUR_RANGE.end()),
            (Some(focal), _) if !focal.is_finite() || focal <= 0.0 => format!("its longest focal length is {focal}"),
            (_, Some(near)) if !near.is_finite() || near < 0.0 => format!("its smallest depth is {near}"),
            _ => return Ok(()),
        };
        Err(damaged(object, problem))
    }
}

/// The origin of a model. It has nothing that differs between equal runs (no clock, no host name), so that equal runs write equal bytes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Commit of the program; empty if unknown.
    pub commit: String,
    /// Root seed.
    pub seed: u64,
    /// Device name.
    pub device: String,
    /// The whole configuration of the run.
    pub config: toml::Table,
}

/// The archive's manifest. Readers ignore unknown keys; writers put additions into `extra`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`FORMAT_VERSION`] of the writer.
    pub format_version: u32,
    /// The codec of the canonical streams.
    pub codec: CodecEntry,
    /// The deformer; `None` for a static model.
    pub deformer: Option<DeformerEntry>,
    /// How to render it.
    pub rasterizer: RasterizerEntry,
    /// Frames in the sequence, 1 for a static model.
    pub frame_count: usize,
    /// First and last normalised time.
    pub time_range: [f32; 2],
    /// From the coordinates of the dataset to those of the model. Exports undo it.
    #[serde(default)]
    pub normalisation: Similarity,
    /// Lower and upper corner of the model in its own units.
    pub box_world: [[f32; 3]; 2],
    /// RGB background colour in 0..1 that it was trained with.
    pub background: [f32; 3],
    /// Spherical-harmonics degree of the Gaussians.
    pub sh_degree: usize,
    /// A Gaussian is dynamic if and only if its score is above this (zeta of the paper).
    pub dynamic_threshold: f32,
    /// Number of Gaussians in the canonical streams.
    pub gaussian_count: u64,
    /// The origin of the model.
    pub provenance: Provenance,
    /// How a player shows it.
    #[serde(default, skip_serializing_if = "is_empty")]
    pub presentation: Presentation,
    /// Additional data of writers.
    #[serde(default)]
    pub extra: serde_json::Map<String, serde_json::Value>,
}

fn is_empty(presentation: &Presentation) -> bool {
    *presentation == Presentation::default()
}

impl Manifest {
    /// The manifest as JSON. Refuses a manifest that does not survive a round trip (numbers that are not finite).
    ///
    /// # Errors
    /// [`Error::Parameter`].
    pub fn to_json(&self) -> Result<Vec<u8>> {
        let refuse = |problem: String| Error::parameter("archive manifest", problem, "Give finite numbers and plain TOML values");
        let json = serde_json::to_vec(self).map_err(|e| refuse(e.to_string()))?;
        let back: Self = serde_json::from_slice(&json).map_err(|e| refuse(format!("its JSON cannot be read back: {e}")))?;
        if &back == self { Ok(json) } else { Err(refuse("it does not survive a round trip through JSON".into())) }
    }
    /// Parses and checks untrusted JSON; `object` names the file in errors.
    ///
    /// # Errors
    /// [`Error::Data`] or [`Error::Limit`].
    pub fn from_json(object: &str, json: &[u8], limits: &Limits) -> Result<Self> {
        let object = format!("manifest of {object}");
        check_depth(&object, json, limits.max_depth)?;
        let manifest: Self = serde_json::from_slice(json).map_err(|e| damaged(&object, e.to_string()))?;
        manifest.validate(&object, limits)?;
        Ok(manifest)
    }
    /// Refuses what no model has; `object` names the manifest in errors.
    ///
    /// # Errors
    /// [`Error::Data`] or [`Error::Limit`].
    pub(super) fn validate(&self, object: &str, limits: &Limits) -> Result<()> {
        if self.format_version != FORMAT_VERSION {
            return Err(damaged(object, format!("format version {} differs from the file's version {FORMAT_VERSION}", self.format_version)));
        }
        limits.check_gaussians(object, self.gaussian_count)?;
        self.normalisation.validate(object)?;
        self.presentation.validate(object)?;
        self.rasterizer.validate(object)?;
        if self.sh_degree > 4 {
            return Err(damaged(object, format!("spherical-harmonics degree {} is over 4", self.sh_degree)));
        }
        if !(1..=MOST_FRAMES).contains(&self.frame_count) {
            return Err(damaged(object, format!("frame_count {} is not in 1..{MOST_FRAMES}", self.frame_count)));
        }
        self.deformer.iter().try_for_each(|d| d.context.validate(object))?;
        let mut numbers = self.time_range.iter().chain(self.box_world.iter().flatten()).chain(&self.background).chain([&self.dynamic_threshold]);
        // A decimal beyond the range of f32 is parsed as infinity.
        if let Some(v) = numbers.find(|v| !v.is_finite()) {
            return Err(damaged(object, format!("a time, box, colour or threshold is {v}")));
        }
        Ok(())
    }
}

fn damaged(object: &str, problem: String) -> Error {
    Error::data(object, problem, "The file is damaged; fetch or write it again")
}

/// Refuses JSON nested deeper than `max_depth`, before a recursive parser reads it.
fn check_depth(object: &str, json: &[u8], max_depth: u32) -> Result<()> {
    let (mut depth, mut in_string, mut escaped) = (0u32, false, false);
    for &byte in json {
        if in_string {
            in_string = escaped || byte != b'"';
            escaped = !escaped && byte == b'\\';
            continue;
        }
        match byte {
            b'"' => in_string = true,
            b'{' | b'[' => {
                depth += 1;
                if depth > max_depth {
                    return Err(Error::limit(object, u64::from(depth), u64::from(max_depth), "Raise limits.max_depth if the file is trusted"));
                }
            }
            b'}' | b']' => depth = depth.saturating_sub(1),
            _ => {}
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_counts_brackets_outside_strings_only() {
        assert!(check_depth("t", br#"{"a":"[[[[[\"[[[","b":[[1]]}"#, 3).is_ok());
        assert!(check_depth("t", br#"{"a":[[[1]]]}"#, 3).is_err());
        assert!(check_depth("t", br#"{"a":"\\","b":[[[1]]]}"#, 3).is_err());
    }

    #[test]
    fn numbers_that_json_cannot_hold_are_refused() {
        let sound = Manifest { format_version: FORMAT_VERSION, frame_count: 1, ..Default::default() };
        assert!(sound.to_json().is_ok());
        assert!(Manifest { dynamic_threshold: f32::NAN, ..sound }.to_json().is_err());
    }

    #[test]
    fn a_sequence_has_frames_and_not_too_many() {
        let of = |frame_count| Manifest { format_version: FORMAT_VERSION, frame_count, ..Default::default() }.validate("m", &Limits::default());
        assert!(of(1).is_ok() && of(MOST_FRAMES).is_ok());
        assert!(of(0).is_err() && of(MOST_FRAMES + 1).is_err() && of(usize::MAX).is_err());
    }

    #[test]
    fn deformers_of_impossible_degrees_and_boxes_are_refused() {
        let of = |sh_degree: usize, corner: f32| {
            let context = DeformerContext { box_min: [-1.0; 3], box_max: [corner; 3], frame_count: 1, sh_degree, seed: crate::Seed::root(1) };
            let deformer = DeformerEntry { name: "d".into(), version: "1".into(), settings: toml::Table::new(), context, weights: CodecEntry::default() };
            Manifest { format_version: FORMAT_VERSION, frame_count: 1, deformer: Some(deformer), ..Default::default() }.validate("m", &Limits::default())
        };
        assert!(of(4, 1.0).is_ok() && of(5, 1.0).is_err() && of(usize::MAX, 1.0).is_err() && of(0, f32::INFINITY).is_err());
    }

    #[test]
    fn what_nothing_can_be_drawn_with_is_refused() {
        let of = |rasterizer: &RasterizerEntry| {
            let manifest = Manifest { format_version: FORMAT_VERSION, frame_count: 1, rasterizer: rasterizer.clone(), ..Default::default() };
            manifest.validate("m", &Limits::default())
        };
        let sound = RasterizerEntry { blur: *BLUR_RANGE.start(), focal: Some(1e-3), near: Some(0.0), ..Default::default() };
        assert!(of(&sound).is_ok() && of(&RasterizerEntry::default()).is_ok());
        for blur in [0.0, -0.3, 101.0, f64::NAN] {
            assert!(of(&RasterizerEntry { blur, ..sound.clone() }).is_err(), "a blur of {blur}");
        }
        for focal in [0.0, -500.0, f64::INFINITY] {
            assert!(of(&RasterizerEntry { focal: Some(focal), ..sound.clone() }).is_err(), "a focal length of {focal}");
        }
        for near in [-0.01, f32::INFINITY, f32::NAN] {
            assert!(of(&RasterizerEntry { near: Some(near), ..sound.clone() }).is_err(), "a depth of {near}");
        }
    }

    #[test]
    fn the_usual_blur_is_not_written_and_another_one_comes_back() {
        let of = |blur: f64| RasterizerEntry { blur, ..Default::default() };
        let larger = RasterizerEntry { focal: Some(123.45), ..of(0.1) };
        let text = |entry: &RasterizerEntry| serde_json::to_string(entry).unwrap();
        assert!(!text(&of(BLUR)).contains("blur") && text(&of(0.1)).contains("\"blur\":0.1"));
        assert!(!text(&of(0.1)).contains("focal"));
        for entry in [of(BLUR), of(0.1), larger] {
            assert_eq!(serde_json::from_str::<RasterizerEntry>(&text(&entry)).unwrap(), entry);
        }
    }

    #[test]
    fn long_decimals_are_no_reason_to_refuse() {
        // Thresholds that `auto` chooses, as float64: serde_json returns some of them in another last bit unless its feature float_roundtrip is on.
        for hundredths in 50..500u16 {
            let mut manifest = Manifest { format_version: FORMAT_VERSION, frame_count: 1, ..Default::default() };
            manifest.extra.insert("zeta".into(), serde_json::json!(f32::from(hundredths) / 100.0));
            let json = manifest.to_json().unwrap();
            assert_eq!(serde_json::from_slice::<Manifest>(&json).unwrap(), manifest);
        }
    }
}
