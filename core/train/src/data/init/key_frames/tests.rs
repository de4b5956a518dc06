//! Key frames of a drawn ball that moves before a wall.

use super::super::super::focus::Focus;
use super::super::views::{Foreground, Level, WorkView};
use super::*;
use glam::{DMat3, DVec3};

const RED: [f32; 3] = [0.9, 0.1, 0.1];
const BLUE: [f32; 3] = [0.1, 0.2, 0.9];
const STEP: Vec3 = Vec3::new(0.3, 0.1, 0.0);

/// A view from `x` along z of a red disk at `ball` and a blue one that stands still, before grey.
fn view(x: f64, ball: Vec3) -> WorkView {
    let (width, height) = (80usize, 60usize);
    let k = DMat3::from_cols_array_2d(&[[60.0, 0.0, 0.0], [0.0, 60.0, 0.0], [40.0, 30.0, 1.0]]);
    let level = Level { width, height, gray: vec![0.5; width * height], rgb: vec![[0.5; 3]; width * height], k };
    let center = DVec3::new(x, 0.0, -4.0);
    let mut view = WorkView {
        levels: vec![level],
        rotation: DMat3::IDENTITY,
        translation: -center,
        center,
        partners: Vec::new(),
        witnesses: Vec::new(),
        depth_range: [1.0, 8.0],
        mask: None,
        opaque: None,
    };
    for (position, color) in [(still(), BLUE), (ball, RED)] {
        let Some((u, v, _)) = view.project(view.fine(), position) else { continue };
        for p in 0..width * height {
            let (du, dv) = ((p % width) as f32 + 0.5 - u, (p / width) as f32 + 0.5 - v);
            if du * du + dv * dv < 4.0 {
                view.levels[0].rgb[p] = color;
            }
        }
    }
    view
}

fn still() -> Vec3 {
    Vec3::new(-1.0, -0.5, 0.3)
}

fn ball(key: usize) -> Vec3 {
    Vec3::new(-0.2, 0.2, 0.0) + STEP * key as f32
}

/// Key frames at the first, the second and the third of frames that are half a sequence apart.
fn key_frames() -> KeyFrames {
    key_frames_at([0, 1, 2], 0.5)
}

/// Key frames at three of the frames that are `interval` apart; the ball moves by a step in each interval.
fn key_frames_at(frames: [usize; 3], interval: f64) -> KeyFrames {
    let set = |frame: usize| set_of(|x| view(x, ball(frame)));
    let candidate = |frame: usize, k: usize| Candidate { position: ball(frame) + offset(k), color: RED, confidence: 1.0, depth: 4.0 };
    let found = frames.iter().map(|&frame| (0..9).map(|k| candidate(frame, k)).collect()).collect();
    let times = frames.iter().map(|&frame| interval * frame as f64).collect();
    KeyFrames { times, sets: frames.iter().map(|&frame| set(frame)).collect(), found, still: Vec::new(), unchanged: UNCHANGED }
}

fn set_of(view: impl Fn(f64) -> WorkView) -> KeySet {
    let set = WorkSet {
        views: [-1.0, -0.4, 0.4, 1.0].map(view).into(),
        keys: 4,
        arrangement: Arrangement::OneTime,
        rig: Focus { point: DVec3::ZERO, distance: Some(4.0), half: 2.0 },
        foreground: Foreground::Unknown,
        box_low: Vec3::splat(-1.0),
        box_high: Vec3::splat(1.0),
    };
    KeySet::new(set, usize::MAX)
}

#[test]
fn key_frames_are_complete_and_in_the_order_of_their_times() {
    // Two cameras; camera 7 has a test view of frame 0 before its training view.
    let scene = |times: &[f32]| {
        let view = |frame: usize, camera: usize, split| View { camera, frame, time_norm: times[frame], split };
        let pairs = (0..times.len()).flat_map(|frame| [view(frame, 7, Split::Train), view(frame, 3, Split::Train)]);
        std::iter::once(view(0, 7, Split::Test)).chain(pairs).collect::<Vec<View>>()
    };
    let of = |views: &[View], count, every| complete_frames(views, &[3, 7], count, every);
    let mut views = scene(&[0.0, 0.5, 1.0]);
    assert_eq!(of(&views, 3, 1), Ok(vec![(0, vec![2, 1]), (1, vec![4, 3]), (2, vec![6, 5])]));
    assert_eq!(of(&views, 3, 2), Ok(vec![(0, vec![2, 1]), (2, vec![6, 5])]));
    views[3].split = Split::Validation;
    assert_eq!(of(&views, 3, 1), Ok(vec![(0, vec![2, 1]), (2, vec![6, 5])]), "frame 1 lacks an image");
    let reason = |found: Found<Vec<(usize, Vec<usize>)>>| found.unwrap_err();
    views[5].split = Split::Validation;
    assert!(reason(of(&views, 3, 1)).starts_with("of 3 key frames, only frame 0 has images"));
    views[1].split = Split::Validation;
    assert!(reason(of(&views, 3, 1)).starts_with("frame 0 lacks an image"));
    let frames = |times: &[f32]| of(&scene(times), times.len(), 1).map(|found| found.into_iter().map(|(frame, _)| frame).collect::<Vec<_>>());
    assert_eq!(frames(&[0.0, 1.0, 0.5, 0.5]), Ok(vec![0, 2, 3, 1]), "times that run backwards");
    assert_eq!(frames(&[0.0; 3]), Ok(vec![0, 1, 2]), "frames that claim to be simultaneous");
    assert!(frames(&[1.0, 0.5, 0.0]).unwrap_err().starts_with("frame 0 is not the earliest"));
}

#[test]
fn what_stands_still_is_always_there_and_what_moves_at_its_own_frame() {
    let frames = key_frames();
    let judged = frames.judge(vec![(still(), BLUE), (ball(1), RED), (ball(1), [0.1, 0.9, 0.1])], 1);
    assert_eq!(judged[0].map(|p| p.alive), Some([0, 2]));
    assert_eq!(judged[1].map(|p| p.alive), Some([1, 1]));
    assert!(judged[2].is_none(), "no image shows green");
}

#[test]
fn what_stands_still_reaches_over_the_time_in_which_it_is_hidden() {
    let (o, x) = (true, false);
    let reach = |there: [bool; 6], from: usize, hidden: usize| reach(|i| there[i], 6, from, hidden);
    assert_eq!(reach([o, o, x, o, x, x], 1, 0), [0, 1]);
    assert_eq!(reach([o, o, x, o, x, x], 1, 1), [0, 3], "gone for longer than something hides it");
    assert_eq!(reach([x, o, x, o, o, x], 3, 1), [0, 5], "hidden at both ends");
    let mut frames = key_frames();
    // The ball passes before what stands still at the middle one of seven key frames.
    frames.sets = (0..7).map(|key| set_of(|x| view(x, if key == 3 { still() } else { ball(key) }))).collect();
    frames.still = medians(&frames.sets);
    let judged = frames.judge(vec![(still(), BLUE), (ball(1), RED)], 1);
    assert_eq!(judged[0].map(|p| p.alive), Some([0, 6]));
    assert_eq!(judged[1].map(|p| p.alive), Some([1, 1]));
    assert!(medians(&frames.sets[..4]).is_empty());
}

#[test]
fn velocities_are_found_from_the_neighbouring_key_frames() {
    // The second and the third time the frame between 1 and 3 is left out: after the points' own key frame, then before it.
    for (at, interval, key) in [([0, 1, 2], 0.5, 1), ([0, 1, 3], 0.25, 1), ([0, 1, 3], 0.25, 2)] {
        let frames = key_frames_at(at, interval);
        let mut points: Vec<KeyPoint> = frames.judge((0..9).map(|k| (ball(at[key]) + offset(k), RED)).collect(), key).into_iter().flatten().collect();
        assert_eq!(points.len(), 9);
        frames.set_in_motion(&mut points, Seed::root(1));
        for point in points {
            let step = point.velocity * interval as f32;
            assert!((step - STEP).length() < 0.1, "{at:?}: {point:?}");
        }
    }
}

/// Points within the disk.
fn offset(k: usize) -> Vec3 {
    Vec3::new((k % 3) as f32 - 1.0, (k / 3) as f32 - 1.0, 0.0) * 0.04
}
