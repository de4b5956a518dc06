//! What the fields of a stored layer hold. More is refused where a layer is written, never cut.

use super::layer::{Head, MAX_FUNCTIONS, MAX_SAMPLES, MAX_SEGMENTS};
use super::streams::CodedTrack;
use crate::{Error, Result};

/// Highest degree of spherical harmonics.
const HIGHEST_DEGREE: usize = 4;
/// Gaussians are numbered, and coefficients of a track indexed, with 32 bits.
const MOST: u64 = u32::MAX as u64;
const FEWER: &str = "Bake with a larger --max-error";
const WRONG: &str = "Correct the program that made the layer";

/// Refuses a degree and counts over what their fields hold.
///
/// # Errors
/// [`Error::Limit`].
pub(super) fn check_counts(sh_degree: usize, samples: usize, segments: &[(usize, Vec<CodedTrack>)]) -> Result<()> {
    let tracks = segments.iter().map(|(_, tracks)| tracks.len()).max().unwrap_or(0);
    let functions = segments.iter().flat_map(|(_, tracks)| tracks).map(|track| track.peaks.len()).max().unwrap_or(0);
    let last = segments.iter().map(|(last, _)| *last).max().unwrap_or(0);
    let counts = [
        ("samples", samples, MAX_SAMPLES, FEWER),
        ("segments", segments.len(), MAX_SEGMENTS, FEWER),
        ("functions of a track", functions, MAX_FUNCTIONS, FEWER),
        ("tracks of a segment", tracks, Head::ALL.len(), WRONG),
        ("last sample of a segment", last, samples.saturating_sub(1), WRONG),
        ("spherical-harmonics degree", sh_degree, HIGHEST_DEGREE, "Convert the model to degree 4 or lower"),
    ];
    match counts.into_iter().find(|(_, found, most, _)| found > most) {
        Some((what, found, most, remedy)) => Err(Error::limit(format!("{what} of the playback layer"), found as u64, most as u64, remedy)),
        None => Ok(()),
    }
}

/// The gaps between `rows`, ascending indices of Gaussians: each less the one before and one.
///
/// # Errors
/// [`Error::Parameter`] for rows that do not ascend, [`Error::Limit`] for Gaussians that archives cannot number.
pub(super) fn gaps(rows: &[usize]) -> Result<Vec<u32>> {
    let mut next = 0usize;
    let gap = |&row: &usize| {
        let Some(gap) = row.checked_sub(next) else {
            let problem = format!("Gaussian {row} comes after Gaussian {}", next - 1);
            return Err(Error::parameter("moving Gaussians of the playback layer", problem, "Give each moving Gaussian once, in ascending order"));
        };
        if row as u64 >= MOST {
            let count = (row as u64).saturating_add(1);
            return Err(Error::limit("number of Gaussians of the playback layer", count, MOST, "Remove Gaussians, or split the model into several"));
        }
        next = row + 1;
        Ok(gap as u32)
    };
    rows.iter().map(gap).collect()
}

/// The number of coefficients of a track whose Gaussians have these `ranks`, `width` for each function.
///
/// # Errors
/// [`Error::Limit`] for more than [`Track::starts`](super::Track::starts) and players can index.
pub(super) fn coefficient_count(ranks: &[u8], width: usize) -> Result<usize> {
    let count = ranks.iter().map(|rank| u64::from(*rank)).sum::<u64>().saturating_mul(width as u64);
    if count > MOST { Err(Error::limit("coefficients of a track of the playback layer", count, MOST, FEWER)) } else { Ok(count as usize) }
}

#[cfg(test)]
mod tests {
    use super::super::PlaybackLayer;
    use super::*;

    /// A track of so many functions, which one Gaussian uses at one time.
    fn track(head: Head, functions: usize) -> CodedTrack {
        CodedTrack {
            head,
            peaks: vec![1.0; functions],
            functions: vec![0; functions],
            ranks: vec![functions as u8],
            step: 1.0,
            exponents: vec![0],
            coefficients: vec![0; functions * head.width(0)],
        }
    }

    #[test]
    fn counts_over_their_fields_are_refused() {
        let empty = |segments: usize| (1..=segments).map(|last| (last, Vec::new())).collect::<Vec<(usize, Vec<CodedTrack>)>>();
        let one = |tracks: Vec<CodedTrack>| vec![(0, tracks)];
        let many = |functions: usize, tracks: usize| one(vec![track(Head::Means, functions); tracks]);
        let whole = empty(63).into_iter().chain([(4095, Vec::new())]).collect();
        for (degree, samples, segments) in [(4, 4096, whole), (0, 1, one(Head::ALL.map(|head| track(head, 255)).into()))] {
            assert!(PlaybackLayer::encode(&[0], degree, samples, &segments).is_ok());
        }
        let over = [
            (5, 1, one(Vec::new()), "spherical-harmonics degree of the playback layer: 5 is over the limit of 4"),
            (0, 4097, one(Vec::new()), "samples of the playback layer: 4097 is over the limit of 4096"),
            (0, 4096, empty(65), "segments of the playback layer: 65 is over the limit of 64"),
            (0, 64, empty(64), "last sample of a segment of the playback layer: 64 is over the limit of 63"),
            (0, 1, many(0, 6), "tracks of a segment of the playback layer: 6 is over the limit of 5"),
            (0, 1, many(256, 1), "functions of a track of the playback layer: 256 is over the limit of 255"),
        ];
        for (degree, samples, segments, said) in over {
            let error = PlaybackLayer::encode(&[0], degree, samples, &segments).unwrap_err();
            assert!(matches!(error, Error::Limit { .. }) && error.to_string().starts_with(said), "{error}");
        }
    }

    #[test]
    fn gaussians_that_archives_cannot_number_are_refused() {
        let most = u32::MAX as usize;
        let encode = |rows: &[usize]| PlaybackLayer::encode(rows, 0, 1, &[(0, Vec::new())]);
        assert_eq!(gaps(&[2, 3, most - 1]).unwrap(), [2, 0, u32::MAX - 5]);
        assert!(encode(&[2, 3, most - 1]).is_ok());
        for row in [most, most + 1] {
            let error = encode(&[2, 3, row]).unwrap_err();
            assert!(matches!(error, Error::Limit { value, limit: 4_294_967_295, .. } if value == row as u64 + 1), "{error}");
        }
        for rows in [[3, 3], [3, 1]] {
            let error = encode(&rows).unwrap_err().to_string();
            assert!(error.contains(&format!("Gaussian {} comes after Gaussian 3", rows[1])), "{error}");
        }
    }

    #[test]
    fn coefficients_that_cannot_be_indexed_are_refused() {
        // 48 numbers times 255 functions of each Gaussian.
        let ranks = vec![u8::MAX; 350_897];
        assert_eq!(coefficient_count(&ranks[1..], 48).unwrap(), 4_294_967_040);
        let segment = CodedTrack { ranks, ..track(Head::Colors, 255) };
        let rows: Vec<usize> = (0..350_897).collect();
        let error = PlaybackLayer::encode(&rows, 3, 1, &[(0, vec![segment])]).unwrap_err();
        assert!(matches!(error, Error::Limit { value: 4_294_979_280, limit: 4_294_967_295, .. }), "{error}");
    }
}
