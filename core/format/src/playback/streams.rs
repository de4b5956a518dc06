//! The layer as bytes, and back from untrusted ones.
//!
//! `playback.meta`: u8 version 1, u8 degree, u16 samples, u16 segments, u32 M, then per segment u16 last sample, u8 tracks, and per track u8 head, u8 R, f32
//! step, R x f32 largest absolute value of each function. `playback.rows`: the gaps between ascending rows, u32 [M]. Then per segment k and head,
//! `playback.k.HEAD.functions`: i16 [R, samples], 32767 standing for the largest value; `.ranks`: u8 [M]; `.exponents`: u8 [M] of the Gaussians of rank over 0;
//! `.coefficients`: zigzag u32, function by function, then number by number, then Gaussian by Gaussian of a sufficient rank. A coefficient is its integer times
//! step times 2^-exponent. All little-endian.

use super::checks::Checks;
use super::layer::{Head, PlaybackLayer, Segment, Track};
use super::sizes::{check_counts, coefficient_count, gaps};
use crate::archive::ByteReader;
use crate::{Error, Limits, Result, Stream};

const VERSION: u8 = 1;
/// Names of the layer's streams begin so.
const PREFIX: &str = "playback.";
const META: &str = "playback.meta";
const ROWS: &str = "playback.rows";
/// Integer that stands for the largest value of a function.
const FULL: f32 = 32767.0;
/// Largest exponent: steps of 2^-62 of the coarsest.
pub(super) const MAX_EXPONENT: u8 = 62;

/// A track as it is stored: integers.
#[derive(Clone, Debug, PartialEq)]
pub struct CodedTrack {
    /// What it changes.
    pub head: Head,
    /// Largest absolute value of each function `[R]`.
    pub peaks: Vec<f32>,
    /// Samples of the functions over their peaks, in 1/32767 `[R, samples]`.
    pub functions: Vec<i16>,
    /// Functions used by each moving Gaussian `[M]`.
    pub ranks: Vec<u8>,
    /// The coarsest step of a coefficient.
    pub step: f32,
    /// Per moving Gaussian, its coefficients are multiples of step times 2^-exponent `[M]`; 0 where the rank is 0.
    pub exponents: Vec<u8>,
    /// Coefficients of the moving Gaussians one after the other, each `[its rank, width]`, in their steps.
    pub coefficients: Vec<i32>,
}

/// 2^-`exponent` times `step`.
pub fn exponent_step(step: f32, exponent: u8) -> f32 {
    step * f32::from_bits((127 - u32::from(exponent.min(MAX_EXPONENT))) << 23)
}

impl CodedTrack {
    /// The track that players use.
    pub fn decoded(&self, width: usize) -> Track {
        let samples = self.functions.len() / self.peaks.len().max(1);
        let functions = self.functions.iter().enumerate().map(|(i, &v)| f32::from(v) / FULL * self.peaks[i / samples.max(1)]).collect();
        let starts = Track::starts_of(&self.ranks);
        let mut coefficients = Vec::with_capacity(self.coefficients.len());
        for (row, &exponent) in self.exponents.iter().enumerate() {
            let step = exponent_step(self.step, exponent);
            coefficients.extend(self.coefficients[starts[row] as usize * width..starts[row + 1] as usize * width].iter().map(|&q| q as f32 * step));
        }
        Track { head: self.head, functions, ranks: self.ranks.clone(), starts, coefficients }
    }
    /// For each function and number, the indices of the coefficients in `coefficients`, in stored order.
    fn order(ranks: &[u8], width: usize) -> impl Iterator<Item = usize> {
        let starts = Track::starts_of(ranks);
        let most = ranks.iter().copied().max().unwrap_or(0);
        let mut users: Vec<(u8, u32)> = ranks.iter().copied().zip(starts).collect();
        (0..most).flat_map(move |f| {
            // Who does not use this one uses none of the later ones, so that the work is the number of coefficients.
            users.retain(|(rank, _)| *rank > f);
            let of_function: Vec<u32> = users.iter().map(|(_, start)| start + u32::from(f)).collect();
            (0..width).flat_map(move |c| of_function.clone().into_iter().map(move |at| at as usize * width + c))
        })
    }
}

impl PlaybackLayer {
    /// The streams of a layer: `rows` (ascending) of Gaussians of degree `sh_degree`, `samples` times, and per segment its last sample and tracks.
    ///
    /// # Errors
    /// [`Error::Limit`] for counts over what the format holds, [`Error::Parameter`] for rows that do not ascend and for all that [`PlaybackLayer::decode`]
    /// refuses, whatever its limits.
    pub fn encode(rows: &[usize], sh_degree: usize, samples: usize, segments: &[(usize, Vec<CodedTrack>)]) -> Result<Vec<Stream>> {
        check_counts(sh_degree, samples, segments)?;
        let gaps = gaps(rows)?;
        let refuse = |problem: String| Error::parameter("playback layer", problem, "Correct the program that made the layer");
        let mut checks = Checks::new(samples, segments.len(), rows.len(), sh_degree, refuse)?;
        let mut meta = vec![VERSION, sh_degree as u8];
        meta.extend((samples as u16).to_le_bytes());
        meta.extend((segments.len() as u16).to_le_bytes());
        meta.extend((gaps.len() as u32).to_le_bytes());
        let mut out = Vec::new();
        let mut add = |name: String, bytes: Vec<u8>| out.push(Stream { name, bytes });
        add(ROWS.into(), gaps.into_iter().flat_map(u32::to_le_bytes).collect());
        for (k, (last, tracks)) in segments.iter().enumerate() {
            checks.segment(*last)?;
            meta.extend((*last as u16).to_le_bytes());
            meta.push(tracks.len() as u8);
            for track in tracks {
                checks.head(track.head)?;
                checks.track(track)?;
                meta.extend([Head::ALL.iter().position(|h| *h == track.head).unwrap_or(0) as u8, track.peaks.len() as u8]);
                meta.extend(track.step.to_le_bytes());
                meta.extend(track.peaks.iter().flat_map(|p| p.to_le_bytes()));
                let name = |part: &str| format!("{PREFIX}{k}.{}.{part}", track.head.name());
                let width = track.head.width(sh_degree);
                add(name("functions"), track.functions.iter().flat_map(|v| v.to_le_bytes()).collect());
                add(name("ranks"), track.ranks.clone());
                add(name("exponents"), track.ranks.iter().zip(&track.exponents).filter(|(rank, _)| **rank > 0).map(|(_, e)| *e).collect());
                add(name("coefficients"), CodedTrack::order(&track.ranks, width).flat_map(|i| zigzag(track.coefficients[i]).to_le_bytes()).collect());
            }
        }
        checks.finish()?;
        out.insert(0, Stream { name: META.into(), bytes: meta });
        Ok(out)
    }
    /// Decodes the layer of `count` Gaussians of degree `sh_degree` from its streams.
    ///
    /// # Errors
    /// [`Error::Data`] for damaged streams, [`Error::Limit`], [`Error::Unsupported`] for other versions.
    pub fn decode(streams: &[Stream], count: usize, sh_degree: usize, limits: &Limits) -> Result<Self> {
        let reader = |name: &str| match streams.iter().find(|s| s.name == name) {
            Some(stream) => Ok(ByteReader::new(format!("playback layer, stream '{name}'"), &stream.bytes)),
            None => Err(Error::data(format!("playback layer, stream '{name}'"), "it is missing", "Bake the archive again")),
        };
        let mut meta = reader(META)?;
        let version = meta.u8()?;
        if version != VERSION {
            return Err(Error::unsupported("playback layer", format!("version {version} is not {VERSION}"), "Use a release of cc4dgs that knows it"));
        }
        let degree = usize::from(meta.u8()?);
        let (samples, segment_count, m) = (usize::from(meta.u16()?), usize::from(meta.u16()?), meta.u32()? as usize);
        if degree != sh_degree || m > count {
            return Err(meta.error(format!("{m} moving Gaussians of degree {degree} do not fit {count} Gaussians of degree {sh_degree}")));
        }
        let refuse = |problem: String| Error::data("playback layer", problem, "Bake the archive again");
        let mut checks = Checks::new(samples, segment_count, m, sh_degree, refuse)?;
        let rows = read_rows(reader(ROWS)?, m, count)?;
        let (mut segments, mut first) = (Vec::new(), 0usize);
        for k in 0..segment_count {
            let (last, track_count) = (usize::from(meta.u16()?), usize::from(meta.u8()?));
            let samples = checks.segment(last)?;
            let mut tracks: Vec<Track> = Vec::new();
            for _ in 0..track_count {
                let code = meta.u8()?;
                let Some(head) = Head::ALL.get(usize::from(code)).copied() else {
                    return Err(meta.error(format!("head {code} of segment {k} is unknown")));
                };
                checks.head(head)?;
                let functions = usize::from(meta.u8()?);
                let step = meta.f32()?;
                let peaks = meta.f32s(functions)?;
                let part = |part: &str| reader(&format!("{PREFIX}{k}.{}.{part}", head.name()));
                let shape = TrackShape { head, width: head.width(sh_degree), functions, samples, m };
                tracks.push(checks.track(&shape.read(step, peaks, part, limits)?)?);
            }
            segments.push(Segment { first, last, tracks });
            first = last;
        }
        checks.finish()?;
        meta.finish()?;
        Ok(Self { rows, samples, sh_degree, segments })
    }
}

fn read_rows(mut reader: ByteReader, m: usize, count: usize) -> Result<Vec<u32>> {
    let (mut rows, mut next) = (Vec::new(), 0u64);
    for _ in 0..m {
        let row = next + u64::from(reader.u32()?);
        if row >= count as u64 {
            return Err(reader.error(format!("row {row} of {count} Gaussians")));
        }
        rows.push(row as u32);
        next = row + 1;
    }
    reader.finish()?;
    Ok(rows)
}

/// Sizes of a track that is being read.
struct TrackShape {
    head: Head,
    width: usize,
    functions: usize,
    samples: usize,
    m: usize,
}

impl TrackShape {
    fn read<'a>(&self, step: f32, peaks: Vec<f32>, part: impl Fn(&str) -> Result<ByteReader<'a>>, limits: &Limits) -> Result<CodedTrack> {
        let mut reader = part("functions")?;
        let bytes = reader.take(2 * self.functions * self.samples)?;
        let functions: Vec<i16> = bytes.as_chunks::<2>().0.iter().map(|b| i16::from_le_bytes(*b)).collect();
        reader.finish()?;
        let mut reader = part("ranks")?;
        let ranks = reader.take(self.m)?.to_vec();
        reader.finish()?;
        let (users, total) = (ranks.iter().filter(|r| **r > 0).count(), coefficient_count(&ranks, self.width)?);
        limits.check_bytes("coefficients of the playback layer", 4 * total as u64)?;
        let mut reader = part("exponents")?;
        let mut stored = reader.take(users)?.iter();
        let exponents = ranks.iter().map(|r| if *r > 0 { stored.next().copied().unwrap_or(0) } else { 0 }).collect();
        reader.finish()?;
        let mut reader = part("coefficients")?;
        let words = reader.take(4 * total)?.as_chunks::<4>().0;
        let mut coefficients = vec![0i32; total];
        for (i, word) in CodedTrack::order(&ranks, self.width).zip(words) {
            coefficients[i] = unzigzag(u32::from_le_bytes(*word));
        }
        reader.finish()?;
        Ok(CodedTrack { head: self.head, peaks, functions, ranks, step, exponents, coefficients })
    }
}

fn zigzag(v: i32) -> u32 {
    ((v << 1) ^ (v >> 31)) as u32
}

fn unzigzag(v: u32) -> i32 {
    (v >> 1) as i32 ^ -((v & 1) as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn coded() -> (Vec<usize>, Vec<(usize, Vec<CodedTrack>)>) {
        let track = |head: Head, width: usize| CodedTrack {
            head,
            peaks: vec![1.0, 0.5],
            functions: vec![32767, 0, -32767, 100, 200, 300],
            ranks: vec![2, 0, 1],
            step: 0.01,
            exponents: vec![3, 0, 0],
            coefficients: (0..3 * width as i32).map(|i| 7 * i - 20).collect(),
        };
        (vec![1, 2, 9], vec![(2, vec![track(Head::Means, 3), track(Head::Opacities, 1)]), (4, vec![track(Head::Rotations, 4)])])
    }

    #[test]
    fn layers_come_back_and_claims_are_checked() {
        let (rows, segments) = coded();
        let streams = PlaybackLayer::encode(&rows, 1, 5, &segments).unwrap();
        let layer = PlaybackLayer::decode(&streams, 10, 1, &Limits::default()).unwrap();
        assert_eq!((layer.rows.as_slice(), layer.samples, layer.segments.len()), ([1, 2, 9].as_slice(), 5, 2));
        for (segment, (_, tracks)) in layer.segments.iter().zip(&segments) {
            for (found, coded) in segment.tracks.iter().zip(tracks) {
                assert_eq!(*found, coded.decoded(coded.head.width(1)));
            }
        }
        let t = &layer.segments[0].tracks[0];
        assert!((t.coefficients[0] + 20.0 * 0.01 / 8.0).abs() < 1e-7 && (t.functions[2] + 1.0).abs() < 1e-6);
        for (count, degree) in [(9, 1), (10, 0), (2, 1)] {
            assert!(PlaybackLayer::decode(&streams, count, degree, &Limits::default()).is_err());
        }
        assert!(PlaybackLayer::decode(&streams, 10, 1, &Limits { max_bytes: 8, ..Limits::default() }).is_err());
    }

    #[test]
    fn coefficients_are_stored_function_by_function() {
        let (ranks, width) = ([0u8, 3, 1, 0, 2, 3, 255], 2);
        let starts = Track::starts_of(&ranks);
        let mut expected = Vec::new();
        for (f, c) in (0..255u8).flat_map(|f| [(f, 0), (f, 1)]) {
            let users = ranks.iter().zip(&starts).filter(|(rank, _)| **rank > f);
            expected.extend(users.map(|(_, start)| (*start as usize + usize::from(f)) * width + c));
        }
        assert_eq!(CodedTrack::order(&ranks, width).collect::<Vec<usize>>(), expected);
        assert_eq!(CodedTrack::order(&[0, 0], width).count(), 0);
    }

    #[test]
    fn no_damage_panics() {
        let (rows, segments) = coded();
        let streams = PlaybackLayer::encode(&rows, 1, 5, &segments).unwrap();
        for which in 0..streams.len() {
            for at in 0..streams[which].bytes.len() {
                for value in [0, 1, 0x7f, 0xff] {
                    let mut damaged = streams.clone();
                    damaged[which].bytes[at] = value;
                    if let Ok(layer) = PlaybackLayer::decode(&damaged, 10, 1, &Limits::default()) {
                        let at = layer.weights_at(0.3);
                        layer.segments[at.segment].tracks.iter().for_each(|t| drop(t.functions_at(&at)));
                    }
                }
            }
            let mut short = streams.clone();
            short[which].bytes.pop();
            assert!(PlaybackLayer::decode(&short, 10, 1, &Limits::default()).is_err(), "{}", short[which].name);
            short.remove(which);
            assert!(PlaybackLayer::decode(&short, 10, 1, &Limits::default()).is_err());
        }
    }
}
