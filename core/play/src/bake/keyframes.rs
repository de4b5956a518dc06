//! Keyframes as a playback layer: large and made at once, for looking at a model in training.

use super::motion::offsets_of;
use cc4dgs_core::playback::{Head, MAX_FUNCTIONS, PlaybackLayer, Segment, Track};
use cc4dgs_core::{Error, HostGaussians, Result};

/// The layer that interpolates linearly between `moved`, the Gaussians `rows` of `canonical` at even times from 0 to 1. It is exact at these times. Its
/// functions are one hat per keyframe, so its size grows with their number; [`bake`](super::bake) makes small layers.
///
/// # Errors
/// [`Error::Parameter`] for fewer than 2 or more than [`MAX_FUNCTIONS`] keyframes, for keyframes of another number of Gaussians, and for rows that are not
/// ascending indices of `canonical`.
pub fn keyframes(canonical: &HostGaussians, rows: &[u32], moved: &[HostGaussians]) -> Result<PlaybackLayer> {
    let n = moved.len();
    if !(2..=MAX_FUNCTIONS).contains(&n) {
        return Err(Error::parameter("keyframes", format!("{n} of them"), format!("Give 2 to {MAX_FUNCTIONS}")));
    }
    if let Some(other) = moved.iter().find(|g| g.len() != rows.len() || g.sh_degree != canonical.sh_degree) {
        let problem = format!("one has {} Gaussians of degree {}, {} of degree {} move", other.len(), other.sh_degree, rows.len(), canonical.sh_degree);
        return Err(Error::parameter("keyframes", problem, "Give the moving Gaussians at every time"));
    }
    let indices: Vec<usize> = rows.iter().map(|&row| row as usize).collect();
    if let Some(row) = indices.iter().find(|row| **row >= canonical.len()) {
        return Err(Error::parameter("keyframes", format!("row {row} of {} Gaussians", canonical.len()), "Give indices of Gaussians that are there"));
    }
    if let Some(pair) = indices.windows(2).find(|pair| pair[0] >= pair[1]) {
        return Err(Error::parameter("keyframes", format!("row {} before row {}", pair[0], pair[1]), "Give each moving Gaussian once, in ascending order"));
    }
    let host = canonical.select(&indices);
    let functions: Vec<f32> = (0..n * n).map(|i| f32::from(u8::from(i / n == i % n))).collect();
    let track = |head: Head| {
        let coefficients: Vec<f32> = (0..rows.len()).flat_map(|i| offsets_of(head, &host, moved, i)).collect();
        let ranks = vec![n as u8; rows.len()];
        coefficients.iter().any(|c| *c != 0.0).then(|| Track { head, functions: functions.clone(), starts: Track::starts_of(&ranks), ranks, coefficients })
    };
    let tracks = Head::ALL.into_iter().filter_map(track).collect();
    Ok(PlaybackLayer { rows: rows.to_vec(), samples: n, sh_degree: canonical.sh_degree, segments: vec![Segment { first: 0, last: n - 1, tracks }] })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keyframes_are_met_and_joined_by_lines() {
        let gaussians = |offset: f32, opacity: f32| HostGaussians {
            means: vec![offset, 0.0, 1.0],
            log_scales: vec![-2.0; 3],
            quaternions: vec![2.0, 0.0, 0.0, 0.0],
            opacity_logits: vec![opacity],
            sh_dc: vec![0.1; 3],
            dynamic_scores: vec![1.0],
            ..Default::default()
        };
        let two = |a: &HostGaussians, b: &HostGaussians| {
            let join = |a: &[f32], b: &[f32]| a.iter().chain(b).copied().collect();
            HostGaussians {
                means: join(&a.means, &b.means),
                log_scales: join(&a.log_scales, &b.log_scales),
                quaternions: join(&a.quaternions, &b.quaternions),
                opacity_logits: join(&a.opacity_logits, &b.opacity_logits),
                sh_dc: join(&a.sh_dc, &b.sh_dc),
                dynamic_scores: join(&a.dynamic_scores, &b.dynamic_scores),
                ..Default::default()
            }
        };
        let canonical = two(&gaussians(9.0, 0.0), &gaussians(0.0, 0.0));
        let moved: Vec<HostGaussians> = [0.0, 1.0, 4.0].iter().map(|x| gaussians(*x, 2.0 - x)).collect();
        let layer = keyframes(&canonical, &[1], &moved).unwrap();
        for (time, x) in [(0.0, 0.0), (0.25, 0.5), (0.5, 1.0), (0.75, 2.5), (1.0, 4.0)] {
            let at = layer.apply(&canonical, time);
            assert!((at.means[3] - x).abs() < 1e-5 && at.means[0] == 9.0, "{time}: {:?}", at.means);
        }
        assert!((layer.apply(&canonical, 1.0).opacity_logits[1] + 2.0).abs() < 1e-3);
        assert_eq!(layer.segments[0].tracks.len(), 2, "scales, rotations and colours stay");
        assert!(
            keyframes(&canonical, &[1], &moved[..1]).is_err()
                && keyframes(&canonical, &[2], &moved).is_err()
                && keyframes(&canonical, &[0, 1], &moved).is_err()
        );
        let both: Vec<HostGaussians> = moved.iter().map(|g| two(g, g)).collect();
        assert!(
            keyframes(&canonical, &[0, 1], &both).is_ok() && keyframes(&canonical, &[1, 0], &both).is_err() && keyframes(&canonical, &[1, 1], &both).is_err(),
            "rows ascend"
        );
    }
}
