//! Constant frame offsets between cameras, from how much their images change over time.
//!
//! What moves in a scene starts, stops and speeds up at the same moment for every camera. Each camera gives one signal, its motion energy. Signals are
//! compressed, freed of slow trends and correlated pairwise over a range of lags. A pair counts only if its peak is high, clearly above what unrelated
//! signals of that smoothness reach (Bartlett's formula), and without a rival at another lag, so still scenes, noise and periodic motion give no pair.
//! The offsets that maximise the sum of all pairwise correlations are then found from the strongest pairs on, one camera at a time, and each is dropped
//! again that its pairs or its gain do not support. Better no offset than a wrong one.

use rayon::prelude::*;

/// The fewest steps that can be compared.
pub(super) const FEWEST: usize = 90;
/// Least correlation of a pair at its peak.
const LEAST_PEAK: f32 = 0.4;
/// Least peak in standard deviations of the correlation of unrelated signals, after Fisher's transform.
const LEAST_SIGMAS: f32 = 4.5;
/// The next best peak of a pair, as a share of its best, at most.
const MOST_RIVAL: f32 = 0.7;
/// Least mean correlation that an offset gains over no offset.
const LEAST_GAIN: f32 = 0.1;
/// Half the window whose mean is subtracted, in steps.
const TREND: usize = 15;
/// Changes of fewer grey levels than this are no motion.
const STILL: f32 = 1e-3;
/// Each camera is compared with at most so many that follow it, in a cycle.
const MOST_PARTNERS: usize = 32;

/// The offset of a camera in time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct FrameOffset {
    /// The camera shows at frame k + `frames` what the median camera shows at frame k.
    pub frames: i64,
    /// Mean correlation with the other cameras at this offset, up to 1.
    pub confidence: f32,
}

/// Correlations of the cameras `a` and `b` at lags of `-most..=most`: b's step k + lag with a's step k.
struct Pair {
    a: usize,
    b: usize,
    correlations: Vec<f32>,
    /// Its lag and height, if there is a clear one.
    peak: Option<(i64, f32)>,
}

impl Pair {
    fn at(&self, lag: i64) -> Option<f32> {
        let most = (self.correlations.len() / 2) as i64;
        usize::try_from(lag + most).ok().and_then(|i| self.correlations.get(i)).copied()
    }
}

/// Offsets of cameras from their motion energies (one number per step, NaN where unknown), at most `most` frames between two of them. `None` for cameras
/// about which nothing can be said. The median of the others is the reference.
pub(super) fn frame_offsets(energies: &[Vec<f32>], most: usize) -> Vec<Option<FrameOffset>> {
    let shortest = energies.iter().map(Vec::len).min().unwrap_or(0);
    let most = most.min(shortest / 3);
    let mut found = vec![None; energies.len()];
    if shortest < FEWEST || most == 0 {
        return found;
    }
    let signals: Vec<Option<Vec<f32>>> = energies.iter().map(|e| signal(e)).collect();
    let pairs = pairs(&signals, most);
    let Some((members, mut offsets)) = tree(&pairs, energies.len()) else { return found };
    // The reference must be the majority's: offsets within a few cameras say nothing about the others.
    if 2 * members.len() <= signals.iter().flatten().count() {
        return found;
    }
    refine(&pairs, &members, &mut offsets, most as i64);
    let mut sorted: Vec<i64> = members.iter().map(|m| offsets[*m]).collect();
    sorted.sort_unstable();
    let median = sorted[(sorted.len() - 1) / 2];
    offsets.iter_mut().for_each(|o| *o -= median);
    for &camera in &members {
        found[camera] = judge(&pairs, &members, &offsets, camera);
    }
    found
}

/// The part of a motion energy that can be compared: logarithm, without outliers and trend, of unit power. `None` for a still camera.
fn signal(energy: &[f32]) -> Option<Vec<f32>> {
    let known: Vec<f32> = energy.iter().copied().filter(|v| v.is_finite()).collect();
    if known.len() * 2 < energy.len() || known.len() < FEWEST {
        return None;
    }
    let mean = known.iter().sum::<f32>() / known.len() as f32;
    if mean < STILL {
        return None;
    }
    // The median of three removes single steps: changes of exposure, errors of the recording.
    let steps = filled(energy);
    let middle = |k: usize| {
        let [a, b, c] = [k.saturating_sub(1), k, (k + 1).min(steps.len() - 1)].map(|i| steps[i]);
        a.min(b).max(a.max(b).min(c))
    };
    let logs: Vec<f32> = (0..steps.len()).map(|k| (1.0 + middle(k).max(0.0) / mean).ln()).collect();
    let trend = |k: usize| {
        let window = &logs[k.saturating_sub(TREND)..(k + TREND + 1).min(logs.len())];
        window.iter().sum::<f32>() / window.len() as f32
    };
    let values: Vec<f32> = logs.iter().enumerate().map(|(k, v)| v - trend(k)).collect();
    let power = |v: &[f32]| (v.iter().map(|v| v * v).sum::<f32>() / v.len() as f32).sqrt();
    let scale = power(&values);
    // Less than a hundredth of its own size is rounding, not a change of pace.
    (scale > 0.01).then(|| values.iter().map(|v| v / scale).collect())
}

/// Unknown values as straight lines between their neighbours.
fn filled(energy: &[f32]) -> Vec<f32> {
    let known: Vec<usize> = (0..energy.len()).filter(|k| energy[*k].is_finite()).collect();
    let value = |k: usize| {
        let after = known.partition_point(|i| *i < k);
        match (after.checked_sub(1).map(|i| known[i]), known.get(after)) {
            (_, Some(&b)) if b == k => energy[k],
            (Some(a), Some(&b)) => energy[a] + (energy[b] - energy[a]) * (k - a) as f32 / (b - a) as f32,
            (Some(a), None) => energy[a],
            (None, Some(&b)) => energy[b],
            (None, None) => 0.0,
        }
    };
    (0..energy.len()).map(value).collect()
}

fn pairs(signals: &[Option<Vec<f32>>], most: usize) -> Vec<Pair> {
    let n = signals.len();
    let mut wanted: Vec<(usize, usize)> = Vec::new();
    for a in 0..n {
        for step in 1..=MOST_PARTNERS.min(n - 1) {
            let b = (a + step) % n;
            wanted.push((a.min(b), a.max(b)));
        }
    }
    wanted.sort_unstable();
    wanted.dedup();
    let own: Vec<Option<Vec<f32>>> = signals.par_iter().map(|s| s.as_ref().map(|s| correlations(s, s, most))).collect();
    let pair = |&(a, b): &(usize, usize)| {
        let (x, y) = (signals[a].as_ref()?, signals[b].as_ref()?);
        let correlations = correlations(x, y, most);
        let spread = own[a]
            .as_ref()
            .zip(own[b].as_ref())
            .map(|(p, q)| p.iter().zip(q).map(|(p, q)| (p * q).abs()).sum::<f32>().max(1.0) / (x.len().min(y.len()) - most) as f32);
        let peak = clear_peak(&correlations, LEAST_PEAK.max((LEAST_SIGMAS * spread?.sqrt()).tanh()));
        Some(Pair { a, b, correlations, peak })
    };
    wanted.par_iter().filter_map(pair).collect()
}

/// Correlation of y's step k + lag with x's step k, for lags of `-most..=most`.
fn correlations(x: &[f32], y: &[f32], most: usize) -> Vec<f32> {
    (-(most as i64)..=most as i64)
        .map(|lag| {
            let (from_x, from_y) = ((-lag).max(0) as usize, lag.max(0) as usize);
            let (mut xy, mut xx, mut yy) = (0.0f32, 0.0f32, 0.0f32);
            for (x, y) in x.iter().skip(from_x).zip(y.iter().skip(from_y)) {
                (xy, xx, yy) = (xy + x * y, xx + x * x, yy + y * y);
            }
            let size = (xx * yy).sqrt();
            if size > 0.0 { xy / size } else { 0.0 }
        })
        .collect()
}

/// Lag and height of the highest correlation, if it is at least `least`, not at the end of the range, and no other hill comes near it.
fn clear_peak(correlations: &[f32], least: f32) -> Option<(i64, f32)> {
    let best = (0..correlations.len()).max_by(|a, b| correlations[*a].total_cmp(&correlations[*b]).then(b.cmp(a)))?;
    let height = correlations[best];
    if height < least || best == 0 || best + 1 == correlations.len() {
        return None;
    }
    let low = (0..best).rev().find(|i| correlations[*i] < 0.5 * height)?;
    let high = (best + 1..correlations.len()).find(|i| correlations[*i] < 0.5 * height)?;
    let rival = correlations[..low].iter().chain(&correlations[high..]).copied().fold(0.0, f32::max);
    (rival <= MOST_RIVAL * height).then_some((best as i64 - (correlations.len() / 2) as i64, height))
}

/// The cameras of the largest group that clear peaks connect, ascending, and offsets of all cameras from the strongest peaks that connect it.
fn tree(pairs: &[Pair], count: usize) -> Option<(Vec<usize>, Vec<i64>)> {
    let mut clear: Vec<(&Pair, i64, f32)> = pairs.iter().filter_map(|p| p.peak.map(|(lag, height)| (p, lag, height))).collect();
    clear.sort_by(|x, y| y.2.total_cmp(&x.2).then((x.0.a, x.0.b).cmp(&(y.0.a, y.0.b))));
    let mut group: Vec<usize> = (0..count).collect();
    let mut offsets = vec![0i64; count];
    for (pair, lag, _) in clear {
        let (into, from) = (group[pair.a], group[pair.b]);
        if into == from {
            continue;
        }
        // The whole group of b moves so that this pair fits.
        let shift = offsets[pair.a] + lag - offsets[pair.b];
        for camera in (0..count).filter(|c| group[*c] == from).collect::<Vec<_>>() {
            offsets[camera] += shift;
            group[camera] = into;
        }
    }
    let size = |g: usize| group.iter().filter(|x| **x == g).count();
    let largest = (0..count).max_by(|a, b| size(*a).cmp(&size(*b)).then(b.cmp(a)))?;
    let members: Vec<usize> = (0..count).filter(|c| group[*c] == largest).collect();
    (members.len() > 1).then_some((members, offsets))
}

/// Mean correlation of a camera with the other members if its offset were `offset`.
fn support(pairs: &[Pair], members: &[usize], offsets: &[i64], camera: usize, offset: i64) -> f32 {
    let (mut sum, mut count) = (0.0, 0);
    for pair in pairs.iter().filter(|p| p.a == camera || p.b == camera) {
        let other = if pair.a == camera { pair.b } else { pair.a };
        if members.binary_search(&other).is_ok() {
            let lag = if pair.a == camera { offsets[other] - offset } else { offset - offsets[other] };
            sum += pair.at(lag).unwrap_or(0.0);
            count += 1;
        }
    }
    if count > 0 { sum / count as f32 } else { 0.0 }
}

/// Moves one camera at a time to the offset with the most support, until none moves.
fn refine(pairs: &[Pair], members: &[usize], offsets: &mut [i64], most: i64) {
    for _ in 0..10 {
        let mut moved = false;
        for &camera in members {
            let here = offsets[camera];
            let mut best = (here, support(pairs, members, offsets, camera, here));
            for candidate in here - most..=here + most {
                let value = support(pairs, members, offsets, camera, candidate);
                if value > best.1 + 1e-6 {
                    best = (candidate, value);
                }
            }
            moved |= best.0 != here;
            offsets[camera] = best.0;
        }
        if !moved {
            return;
        }
    }
}

/// The offset of a camera, if over half of its clear peaks agree and it gains enough over no offset.
fn judge(pairs: &[Pair], members: &[usize], offsets: &[i64], camera: usize) -> Option<FrameOffset> {
    let (mut agree, mut all) = (0, 0);
    for pair in pairs.iter().filter(|p| p.a == camera || p.b == camera) {
        if let Some((lag, _)) = pair.peak
            && members.binary_search(&pair.a).is_ok()
            && members.binary_search(&pair.b).is_ok()
        {
            all += 1;
            agree += usize::from((lag - (offsets[pair.b] - offsets[pair.a])).abs() <= 1);
        }
    }
    let frames = offsets[camera];
    let confidence = support(pairs, members, offsets, camera, frames);
    let gain = confidence - support(pairs, members, offsets, camera, 0);
    (2 * agree > all && (frames == 0 || gain >= LEAST_GAIN)).then_some(FrameOffset { frames, confidence })
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::Seed;
    use rand::Rng;

    /// Motion with bursts of random length and strength.
    fn bursts(count: usize, seed: u64) -> Vec<f32> {
        let mut rng = Seed::root(seed).rng();
        let (mut left, mut level) = (0, 0.0f32);
        let steps = (0..count + 4).map(|_| {
            if left == 0 {
                (left, level) = (rng.random_range(3..25), rng.random_range(0.0..6.0f32));
            }
            left -= 1;
            level
        });
        let steps: Vec<f32> = steps.collect();
        steps.windows(5).map(|w| w.iter().sum::<f32>() / 5.0).collect()
    }

    /// What cameras record of one motion from `start` on: their own strength, floor and noise.
    fn record(motion: &[f32], starts: &[usize], length: usize, noise: f32, seed: u64) -> Vec<Vec<f32>> {
        let mut rng = Seed::root(seed).child("cameras").rng();
        starts
            .iter()
            .map(|start| {
                let (gain, floor) = (rng.random_range(0.2..1.5f32), rng.random_range(0.05..0.5f32));
                motion[*start..start + length].iter().map(|v| gain * v + floor + noise * gain * rng.random_range(-1.0..1.0f32)).map(|v| v.max(0.0)).collect()
            })
            .collect()
    }

    fn frames(found: &[Option<FrameOffset>]) -> Vec<Option<i64>> {
        found.iter().map(|f| f.map(|f| f.frames)).collect()
    }

    #[test]
    fn offsets_of_noisy_cameras_are_found() {
        for seed in 0..8 {
            let motion = bursts(700, seed);
            // A camera that starts earlier shows the same moment later.
            let starts = [40, 40, 36, 40, 63, 40, 17];
            let mut energies = record(&motion, &starts, 600, 0.5, seed);
            energies[3][50..60].fill(f32::NAN);
            energies[5][120] = 500.0;
            let found = frame_offsets(&energies, 90);
            assert_eq!(frames(&found), [0, 0, 4, 0, -23, 0, 23].map(Some), "seed {seed}: {found:?}");
            // Under strong noise a camera may be a frame off, or left alone.
            let found = frame_offsets(&record(&motion, &starts, 600, 1.5, seed), 90);
            let close = |(f, truth): (&Option<FrameOffset>, i64)| f.is_none_or(|f| (f.frames - truth).abs() <= 1);
            assert!(found.iter().zip([0, 0, 4, 0, -23, 0, 23]).all(close), "seed {seed}: {found:?}");
            assert!(found.iter().flatten().all(|f| f.confidence > 0.4), "{found:?}");
        }
        // Two cameras: the first of both in time is the reference.
        let found = frame_offsets(&record(&bursts(300, 3), &[20, 12], 200, 0.5, 3), 60);
        assert_eq!(frames(&found), [Some(0), Some(8)]);
    }

    #[test]
    fn the_odd_camera_out_is_left_alone() {
        for seed in 0..8 {
            let mut energies = record(&bursts(400, seed), &[40, 40, 30, 40], 300, 0.5, seed);
            energies.push(bursts(300, seed + 100));
            energies.push(vec![0.7; 300]);
            energies.push(vec![0.0; 300]);
            energies.push(vec![f32::NAN; 300]);
            assert_eq!(frames(&frame_offsets(&energies, 90)), [Some(0), Some(0), Some(10), Some(0), None, None, None, None], "seed {seed}");
        }
    }

    #[test]
    fn nothing_is_claimed_without_evidence() {
        let claims = |energies: &[Vec<f32>]| frame_offsets(energies, 150).iter().flatten().any(|f| f.frames != 0);
        for seed in 0..60 {
            let mut rng = Seed::root(seed).rng();
            let noise: Vec<Vec<f32>> = (0..5).map(|_| (0..300).map(|_| rng.random_range(0.5..1.0f32)).collect()).collect();
            assert!(!claims(&noise), "noise, seed {seed}");
            let unrelated: Vec<Vec<f32>> = (0..5).map(|c| bursts(300, 1000 * (seed + 1) + c)).collect();
            assert!(!claims(&unrelated), "unrelated motion, seed {seed}");
            let short: Vec<Vec<f32>> = (0..5).map(|c| bursts(FEWEST, 1000 * (seed + 1) + c)).collect();
            assert!(!claims(&short), "short unrelated motion, seed {seed}");
            assert!(!claims(&record(&bursts(300, seed), &[0; 6], 300, 2.0, seed)), "synchronous, seed {seed}");
            let periodic: Vec<f32> = (0..400).map(|k| 2.0 + (k as f32 * 0.35).sin()).collect();
            assert!(!claims(&record(&periodic, &[0, 5, 11], 300, 0.3, seed)), "periodic, seed {seed}");
        }
        assert!(!claims(&[]) && !claims(&[vec![]]) && !claims(&[vec![f32::INFINITY; 99], vec![f32::NAN; 99]]));
        assert!(!claims(&record(&bursts(60, 1), &[0, 9], 20, 0.0, 1)), "too short");
    }

    #[test]
    fn offsets_over_the_largest_are_not_claimed() {
        let energies = record(&bursts(400, 5), &[80, 0], 300, 0.2, 5);
        assert!(frame_offsets(&energies, 50).iter().flatten().all(|f| f.frames == 0));
        assert_eq!(frames(&frame_offsets(&energies, 95)), [Some(0), Some(80)]);
    }
}
