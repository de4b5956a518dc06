//! What a stored layer must be: one that is written and one that is read pass the same checks.

use super::layer::{Head, MAX_SAMPLES, MAX_SEGMENTS, Track};
use super::sizes::coefficient_count;
use super::streams::{CodedTrack, MAX_EXPONENT};
use crate::{Error, Result};

/// Checks the segments and tracks of a layer in their order.
pub(super) struct Checks {
    samples: usize,
    /// Gaussians that move.
    moving: usize,
    sh_degree: usize,
    /// Makes the error of a problem: who is at fault depends on where the layer is from.
    refuse: fn(String) -> Error,
    /// The segment that is looked at, counted from 0, its first and last sample, and the head of its last track so far.
    segment: Option<usize>,
    first: usize,
    last: usize,
    head: Option<Head>,
}

impl Checks {
    /// Of a layer with `samples` times and so many segments, for `moving` Gaussians of degree `sh_degree`.
    pub fn new(samples: usize, segments: usize, moving: usize, sh_degree: usize, refuse: fn(String) -> Error) -> Result<Self> {
        if samples == 0 || samples > MAX_SAMPLES || segments == 0 || segments > MAX_SEGMENTS {
            return Err(refuse(format!("it has {samples} samples of 1 to {MAX_SAMPLES} and {segments} segments of 1 to {MAX_SEGMENTS}")));
        }
        Ok(Self { samples, moving, sh_degree, refuse, segment: None, first: 0, last: 0, head: None })
    }
    fn index(&self) -> usize {
        self.segment.unwrap_or(0)
    }
    /// Begins the next segment, which ends at the sample `last`; the number of its samples.
    pub fn segment(&mut self, last: usize) -> Result<usize> {
        (self.segment, self.first, self.head) = (Some(self.segment.map_or(0, |before| before + 1)), self.last, None);
        if last >= self.samples || (last <= self.first && self.samples > 1) {
            let problem = format!("segment {} begins at sample {} and ends at sample {last} of {}", self.index(), self.first, self.samples);
            return Err((self.refuse)(problem));
        }
        self.last = last;
        Ok(last - self.first + 1)
    }
    /// Begins the next track of the segment.
    pub fn head(&mut self, head: Head) -> Result<()> {
        if let Some(before) = self.head.filter(|before| *before >= head) {
            let problem = format!("in segment {}, {} come after {}", self.index(), head.name(), before.name());
            return Err((self.refuse)(problem));
        }
        self.head = Some(head);
        Ok(())
    }
    /// The `track` of [`Checks::head`] as players use it.
    pub fn track(&self, track: &CodedTrack) -> Result<Track> {
        let refuse = |problem: String| Err((self.refuse)(format!("{} of segment {}: {problem}", track.head.name(), self.index())));
        let (functions, samples, width) = (track.peaks.len(), self.last - self.first + 1, track.head.width(self.sh_degree));
        let coefficients = coefficient_count(&track.ranks, width)?;
        let counts = [
            ("values of functions", track.functions.len(), functions * samples),
            ("ranks", track.ranks.len(), self.moving),
            ("exponents", track.exponents.len(), self.moving),
            ("coefficients", track.coefficients.len(), coefficients),
        ];
        if let Some((what, found, wanted)) = counts.into_iter().find(|(_, found, wanted)| found != wanted) {
            return refuse(format!("{found} {what} instead of {wanted}"));
        }
        let used = track.ranks.iter().copied().max().map_or(0, usize::from);
        if used != functions {
            return refuse(format!("its Gaussians use {used} of {functions} functions; there must be no others"));
        }
        if let Some((_, exponent)) = track.ranks.iter().zip(&track.exponents).find(|(rank, exponent)| **rank > 0 && **exponent > MAX_EXPONENT) {
            return refuse(format!("an exponent is {exponent}, over {MAX_EXPONENT}"));
        }
        if let Some(odd) = track.peaks.iter().chain([&track.step]).find(|v| !v.is_finite()) {
            return refuse(format!("a step or the largest value of a function is {odd}"));
        }
        // A product of finite numbers may overflow.
        let found = track.decoded(width);
        match found.impossible() {
            Some(odd) => refuse(format!("a coefficient or function is {odd}")),
            None => Ok(found),
        }
    }
    /// Refuses segments that do not cover all samples.
    pub fn finish(self) -> Result<()> {
        if self.last + 1 == self.samples {
            return Ok(());
        }
        Err((self.refuse)(format!("its segments end at sample {} of {}", self.last, self.samples)))
    }
}

#[cfg(test)]
mod tests {
    use super::super::PlaybackLayer;
    use super::*;
    use crate::{Limits, Stream};

    type Segments = Vec<(usize, Vec<CodedTrack>)>;

    /// What is done to a sound layer.
    type Harm = fn(&mut Segments);

    /// Two segments of five samples for three Gaussians.
    fn sound() -> Segments {
        let track = |head: Head| CodedTrack {
            head,
            peaks: vec![1.0, 0.5],
            functions: vec![32767, 0, -32767, 100, 200, 300],
            ranks: vec![2, 0, 1],
            step: 0.01,
            exponents: vec![3, 0, 0],
            coefficients: (0..3 * head.width(1) as i32).map(|i| 7 * i - 20).collect(),
        };
        vec![(2, vec![track(Head::Means), track(Head::Opacities)]), (4, vec![track(Head::Rotations)])]
    }

    fn encode(samples: usize, segments: &[(usize, Vec<CodedTrack>)]) -> Result<Vec<Stream>> {
        PlaybackLayer::encode(&[1, 2, 9], 1, samples, segments)
    }

    #[test]
    fn what_cannot_be_read_again_is_not_written() {
        let decode = |streams: &[Stream]| PlaybackLayer::decode(streams, 10, 1, &Limits::default());
        assert!(decode(&encode(5, &sound()).unwrap()).is_ok());
        let cases: [(&str, Harm); 16] = [
            ("means of segment 0: 5 values of functions instead of 6", |s| s[0].1[0].functions.truncate(5)),
            ("opacities of segment 0: 4 ranks instead of 3", |s| s[0].1[1].ranks.push(0)),
            ("rotations of segment 1: 2 exponents instead of 3", |s| s[1].1[0].exponents.truncate(2)),
            ("means of segment 0: 8 coefficients instead of 9", |s| s[0].1[0].coefficients.truncate(8)),
            ("means of segment 0: 9 coefficients instead of 6", |s| s[0].1[0].ranks[0] = 1),
            ("opacities of segment 0: its Gaussians use 1 of 2 functions", |s| (s[0].1[1].ranks[0], s[0].1[1].coefficients) = (1, vec![1; 2])),
            ("means of segment 0: an exponent is 63, over 62", |s| s[0].1[0].exponents[2] = 63),
            ("means of segment 0: a step or the largest value of a function is inf", |s| s[0].1[0].step = f32::INFINITY),
            ("means of segment 0: a step or the largest value of a function is NaN", |s| s[0].1[0].peaks[1] = f32::NAN),
            ("means of segment 0: a coefficient or function is", |s| s[0].1[0].step = 1e30),
            ("means of segment 0: a coefficient or function is", |s| s[0].1[0].peaks[0] = 2e18),
            ("in segment 0, means come after opacities", |s| s[0].1.reverse()),
            ("in segment 0, opacities come after opacities", |s| s[0].1[0] = s[0].1[1].clone()),
            ("segment 1 begins at sample 2 and ends at sample 2 of 5", |s| s[1].0 = 2),
            ("its segments end at sample 2 of 5", |s| s.truncate(1)),
            ("it has 5 samples of 1 to 4096 and 0 segments of 1 to 64", Vec::clear),
        ];
        for (said, harm) in cases {
            let mut segments = sound();
            harm(&mut segments);
            let error = encode(5, &segments).unwrap_err();
            assert!(matches!(error, Error::Parameter { .. }) && error.to_string().starts_with(&format!("playback layer: {said}")), "{error}");
        }
        assert!(encode(0, &[]).unwrap_err().to_string().contains("0 samples"));
        // The exponent of a Gaussian without functions is not stored.
        let mut unused = sound();
        unused[0].1[0].exponents[1] = 63;
        assert!(decode(&encode(5, &unused).unwrap()).is_ok());
    }

    #[test]
    fn what_is_read_is_refused_for_the_same_reasons() {
        let damaged = |name: &str, at: usize, value: u8| {
            let mut streams = encode(5, &sound()).unwrap();
            let stream = streams.iter_mut().find(|s| s.name == name).unwrap();
            stream.bytes[at] = value;
            PlaybackLayer::decode(&streams, 10, 1, &Limits::default()).unwrap_err()
        };
        for (name, at, value, said) in [
            ("playback.0.means.exponents", 0, 63, "playback layer: means of segment 0: an exponent is 63, over 62"),
            // Behind version, degree, samples, segments and Gaussians: the last sample of the first segment.
            ("playback.meta", 10, 5, "playback layer: segment 0 begins at sample 0 and ends at sample 5 of 5"),
        ] {
            let error = damaged(name, at, value);
            assert!(matches!(error, Error::Data { .. }) && error.to_string().starts_with(said), "{error}");
        }
    }
}
