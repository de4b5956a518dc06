//! Frames of several videos at common instants.
//!
//! The instants are equally spaced, at the lowest frame rate of the videos, over the time that all of them cover. Each video contributes the frame whose
//! timestamp is nearest, and none where the nearest is over half an interval away: an image at the wrong time is worse than no image. For videos of one
//! constant rate that start together, frame k is frame k of the file.

use cc4dgs_core::plural;

/// Of the interval: how far past the end of the shortest video the last instant may lie, against rounding.
const SLACK: f64 = 0.25;
/// Rates that differ by less than this share are called equal.
const SAME_RATE: f64 = 0.005;
/// More instants per frame than this mean that the median interval does not describe the video.
const MOST_INSTANTS_PER_FRAME: f64 = 4.0;

/// The frames of several videos at common instants.
pub(super) struct Timeline {
    /// Per video and instant the index of its frame.
    pub frames: Vec<Vec<Option<usize>>>,
    /// What somebody should know who thinks that frame k of a video is frame k of the scene.
    pub notes: Vec<String>,
}

/// Frame rate of ascending `times`, in frames per second: the mean of the intervals that are within a quarter of the median one, so that pauses and rounded
/// timestamps do not count. `None` for fewer than two instants.
fn rate(times: &[f64]) -> Option<f64> {
    let (first, last) = (*times.first()?, *times.last()?);
    let span = last - first;
    if !(span > 0.0 && span.is_finite()) {
        return None;
    }
    let average = (times.len() - 1) as f64 / span;
    let mut intervals: Vec<f64> = times.windows(2).map(|w| w[1] - w[0]).collect();
    intervals.sort_by(f64::total_cmp);
    let median = intervals[intervals.len() / 2];
    let usual: Vec<f64> = intervals.into_iter().filter(|d| (d - median).abs() <= 0.25 * median).collect();
    let typical = usual.len() as f64 / usual.iter().sum::<f64>();
    Some(if typical * span <= MOST_INSTANTS_PER_FRAME * times.len() as f64 { typical } else { average })
}

/// The frames of videos with the given names and ascending, non-empty frame times in seconds.
pub(super) fn timeline(names: &[String], times: &[&[f64]]) -> Timeline {
    let mut notes = Vec::new();
    let rates: Vec<Option<f64>> = times.iter().map(|t| rate(t)).collect();
    let slowest = rates.iter().flatten().copied().fold(f64::INFINITY, f64::min);
    let fastest = rates.iter().flatten().copied().fold(0.0, f64::max);
    let rate = if slowest.is_finite() { slowest } else { 1.0 };
    if fastest > slowest * (1.0 + SAME_RATE) {
        let listed = names.iter().zip(&rates).filter_map(|(n, r)| r.map(|r| format!("{n} {r:.2}"))).take(8).collect::<Vec<_>>().join(", ");
        notes.push(format!("the videos have different frame rates ({listed}); all are sampled at the lowest, {rate:.2} frames per second"));
    }
    let first = |t: &[f64]| t.first().copied().unwrap_or(0.0);
    let last = |t: &[f64]| t.last().copied().unwrap_or(0.0);
    // The common range. Clocks that have nothing in common are not compared.
    let range = |origin: &dyn Fn(&[f64]) -> f64| {
        let low = times.iter().map(|t| first(t) - origin(t)).fold(f64::NEG_INFINITY, f64::max);
        let high = times.iter().map(|t| last(t) - origin(t)).fold(f64::INFINITY, f64::min);
        (low, high)
    };
    let (mut low, mut high) = range(&|_| 0.0);
    let disjoint = high < low;
    let starts = times.iter().map(|t| first(t)).fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), t| (a.min(t), b.max(t)));
    if disjoint {
        (low, high) = range(&first);
        if slowest.is_finite() {
            notes.push(format!(
                "the videos start at {:.3} s to {:.3} s and have no time in common; their first frames are taken as one instant",
                starts.0, starts.1
            ));
        }
    } else if (starts.1 - starts.0) * rate > 0.5 {
        notes.push(format!("the videos start at {:.3} s to {:.3} s; their frames are matched by time", starts.0, starts.1));
    }
    let shortest = times.iter().map(|t| t.len()).min().unwrap_or(0);
    let most = (MOST_INSTANTS_PER_FRAME * shortest as f64) as usize + 1;
    let count = (((high - low).max(0.0) * rate + SLACK) as usize).saturating_add(1).min(most);
    let frames: Vec<Vec<Option<usize>>> = times.iter().map(|t| sample(t, low + if disjoint { first(t) } else { 0.0 }, rate, count)).collect();
    for (name, frames) in names.iter().zip(&frames) {
        let missing = frames.iter().filter(|f| f.is_none()).count();
        if missing > 0 {
            notes.push(format!("video {name} has a variable frame rate: it has no frame at {missing} of {count} instants of {rate:.2} per second"));
        }
    }
    if times.iter().any(|t| t.len() != shortest) && fastest <= slowest * (1.0 + SAME_RATE) {
        notes.push(format!("the videos have different numbers of frames ({shortest} and more); the {count} that all have {} used", plural(count, "is", "are")));
    }
    Timeline { frames, notes }
}

/// The frame nearest to each of `count` instants from `start` on. A frame is used once.
fn sample(times: &[f64], start: f64, rate: f64, count: usize) -> Vec<Option<usize>> {
    let mut chosen: Vec<Option<usize>> = Vec::with_capacity(count);
    let mut previous: Option<(usize, usize, f64)> = None;
    for k in 0..count {
        let instant = start + k as f64 / rate;
        let after = times.partition_point(|t| *t < instant);
        let near = [after.checked_sub(1), (after < times.len()).then_some(after)].into_iter().flatten();
        let best = near.map(|i| (i, (times[i] - instant).abs() * rate)).min_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, distance)| *distance <= 0.501);
        chosen.push(best.map(|(i, _)| i));
        let Some((index, distance)) = best else { continue };
        match previous {
            Some((_, same, nearer)) if same == index && nearer <= distance => chosen[k] = None,
            Some((earlier, same, _)) if same == index => {
                chosen[earlier] = None;
                previous = Some((k, index, distance));
            }
            _ => previous = Some((k, index, distance)),
        }
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(count: usize, rate: f64, start: f64) -> Vec<f64> {
        (0..count).map(|k| (1e6 * (start + k as f64 / rate)).round() / 1e6).collect()
    }

    fn run(times: &[Vec<f64>]) -> Timeline {
        let names: Vec<String> = (0..times.len()).map(|i| format!("cam{i:02}.mp4")).collect();
        timeline(&names, &times.iter().map(Vec::as_slice).collect::<Vec<_>>())
    }

    #[test]
    fn one_constant_rate_keeps_every_frame() {
        for (rate, start) in [(30.0, 0.0), (30000.0 / 1001.0, 1.4), (23.976, 0.0), (0.5, 0.0), (240.0, 3600.0)] {
            let found = run(&[grid(3000, rate, start), grid(3000, rate, start), grid(3000, rate, start)]);
            assert!(found.notes.is_empty(), "{:?}", found.notes);
            found.frames.iter().for_each(|f| assert!(f.iter().enumerate().all(|(k, i)| *i == Some(k)) && f.len() == 3000, "{rate}"));
        }
        // Rounded to milliseconds, as Matroska has them.
        let rounded: Vec<f64> = grid(2000, 24000.0 / 1001.0, 0.0).iter().map(|t| (t * 1000.0).round() / 1000.0).collect();
        assert!(run(&[rounded.clone(), rounded]).frames[1].iter().enumerate().all(|(k, i)| *i == Some(k)));
    }

    #[test]
    fn rates_are_brought_to_the_lowest() {
        let found = run(&[grid(120, 60.0, 0.0), grid(50, 25.0, 0.0)]);
        assert_eq!(found.frames[1], (0..50).map(Some).collect::<Vec<_>>());
        for (k, i) in found.frames[0].iter().enumerate() {
            assert!((i.unwrap() as f64 / 60.0 - k as f64 / 25.0).abs() <= 0.5 / 60.0 + 1e-6, "{k} {i:?}");
        }
        assert!(found.notes[0].contains("different frame rates") && found.notes[0].contains("25.00"), "{:?}", found.notes);
    }

    #[test]
    fn start_times_count_and_pauses_are_left_out() {
        let found = run(&[grid(30, 30.0, 0.0), grid(30, 30.0, 0.2)]);
        assert_eq!((found.frames[0][0], found.frames[1][0], found.frames[0].len()), (Some(6), Some(0), 24));
        assert!(found.notes[0].contains("0.200 s"), "{:?}", found.notes);
        // Frames 10 to 14 were dropped while recording.
        let mut paused = grid(60, 30.0, 0.0);
        paused.drain(10..15);
        let found = run(&[grid(60, 30.0, 0.0), paused]);
        assert_eq!(found.frames[0].len(), 60);
        assert_eq!((found.frames[1][9], found.frames[1][12], found.frames[1][15]), (Some(9), None, Some(10)));
        assert!(found.notes.iter().any(|n| n.contains("no frame at 5 of 60")), "{:?}", found.notes);
        // Clocks without a common time are each taken from their start.
        let found = run(&[grid(30, 30.0, 0.0), grid(30, 30.0, 5000.0)]);
        assert_eq!(found.frames[1], (0..30).map(Some).collect::<Vec<_>>());
        assert!(found.notes[0].contains("no time in common"), "{:?}", found.notes);
    }

    #[test]
    fn absurd_times_neither_hang_nor_allocate() {
        for times in [vec![0.0], vec![5.0; 40], vec![0.0, 1e-6, 2e-6, 1e18], vec![-1e300, 0.0, 1e300], vec![0.0, f64::MIN_POSITIVE, 1.0], vec![-1e308, 1e308]] {
            for other in [vec![0.0], grid(100, 30.0, 0.0)] {
                let found = run(&[times.clone(), other.clone()]);
                assert!(found.frames.iter().all(|f| f.len() == found.frames[0].len() && f.len() <= 500));
                assert!(found.frames.iter().zip([&times, &other]).all(|(f, t)| f.iter().flatten().all(|i| *i < t.len())));
            }
        }
    }
}
