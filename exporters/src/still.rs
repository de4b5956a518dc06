//! What exporters of one instant share.

use cc4dgs_format::{Error, ExportFacts, ExportSource, HostGaussians, Limits, Result};
use std::path::Path;

pub use cc4dgs_format::gaussians::unit_quaternion as unit;

/// The Gaussians of the instant that is asked for, refused where they are invalid: the first of so many `steps`.
pub fn instant(source: &mut dyn ExportSource, format: &str, steps: usize) -> Result<HostGaussians> {
    let time = source.facts().time_norm;
    let gaussians = source.gaussians(time)?;
    check(&gaussians, format)?;
    source.progress(1, steps)?;
    Ok(gaussians)
}

/// Refuses Gaussians that are not finite or have arrays of unequal lengths.
pub fn check(gaussians: &HostGaussians, format: &str) -> Result<()> {
    gaussians.validate(&format!("Gaussians to write as {format}"), &Limits { max_gaussians: u64::MAX, ..Limits::default() })
}

/// Logit of an invisible opacity (2e-35); that of opacity 0 is not finite.
const INVISIBLE: f32 = -80.0;

/// `gaussians` for formats that hold them as they are trained. Rotations of length zero, which are not drawn here, become the identity and invisible: other
/// programs divide by the length.
pub fn with_rotations(mut gaussians: HostGaussians) -> HostGaussians {
    for (q, logit) in gaussians.quaternions.as_chunks_mut::<4>().0.iter_mut().zip(&mut gaussians.opacity_logits) {
        if unit(q).is_none() {
            (*q, *logit) = ([1.0, 0.0, 0.0, 0.0], INVISIBLE);
        }
    }
    gaussians
}

/// What most viewers lose of a format that itself holds degree 4, as a part of [`sentence`].
pub fn highest_degree(facts: &ExportFacts) -> (bool, &'static str) {
    (facts.sh_degree > 3, "in most viewers harmonics over degree 3")
}

/// Writes `bytes` to `path`.
pub fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    std::fs::write(path, bytes).map_err(|e| Error::io(path, e))
}

/// The parts of what is lost as one sentence; empty parts are left out.
pub fn sentence(facts: &ExportFacts, parts: &[(bool, &str)]) -> String {
    let blur = facts.lost_blur();
    let lost: Vec<&str> = parts.iter().filter(|(applies, _)| *applies).map(|(_, part)| *part).chain(blur.as_deref()).collect();
    let rest = match lost.as_slice() {
        [] => String::new(),
        [one] => format!(", without {one}"),
        [most @ .., last] => format!(", without {} and {last}", most.join(", ")),
    };
    format!("{}{rest}.", facts.still())
}

/// Opacity in 0..1.
pub fn sigmoid(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

/// Colour of the degree-0 coefficients as models are trained: sRGB, 0..1 unless it is out of range.
pub fn color(dc: &[f32; 3]) -> [f32; 3] {
    /// 1 / (2 sqrt(pi)), the constant basis function.
    const SH_C0: f32 = 0.282_094_8;
    dc.map(|c| c * SH_C0 + 0.5)
}

/// [`color`] in bytes.
pub fn color_bytes(dc: &[f32; 3]) -> [u8; 3] {
    color(dc).map(byte)
}

/// A number in 0..1 in a byte.
pub fn byte(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rotations_of_length_zero_become_the_identity_and_invisible() {
        let gaussians = HostGaussians { quaternions: vec![0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0], opacity_logits: vec![3.0, 4.0], ..Default::default() };
        let out = with_rotations(gaussians);
        assert_eq!(out.quaternions, [1.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0]);
        assert!(out.opacity_logits[1] == 4.0 && (0.0..1e-30).contains(&sigmoid(out.opacity_logits[0])));
    }
}
