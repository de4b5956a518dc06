//! Fine-tuning with a trainer whose losses are known.

use super::super::allocate::allocate;
use super::super::encode::classify;
use super::super::job::{CODED, QUANTISED};
use super::super::joint::Directions;
use super::super::search::{estimate, search};
use super::super::{Choices, Motion, importance, layers, random_gaussians};
use super::*;
use cc4dgs_format::{Camera, EncodedWeights, Image8, Recorder, RenderModel, RenderedPlanes, Seed, TrainingViews};
use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;

/// A trainer whose PSNR falls with the mean squared error of the colours of degree 0 and rises with each iteration; its weight counts these.
struct Trainer {
    colors: Vec<f32>,
    cost: f64,
    /// Share of that which training leaves.
    remains: f64,
    gain: f64,
    /// Training fails after so many iterations.
    fails: Option<(f32, fn() -> Error)>,
    /// What was measured after so many iterations, and after how many those were that were adopted.
    measured: RefCell<BTreeMap<u32, f64>>,
    adopted: Cell<u32>,
    /// How often the weights after so many iterations were encoded.
    encoded: RefCell<BTreeMap<u32, usize>>,
}

impl Trainer {
    /// One by whose measure `attempt` loses so many dB before it trains.
    fn of(attempt: &Attempt, job: &Job, lost: f64, gain: f64) -> Self {
        let gaussians = job.planner.gaussians.to_host();
        let (colors, rounded) = (gaussians.sh_dc.clone(), job.restored(job.planner.gaussians, &attempt.plan));
        let (measured, adopted, encoded) = (RefCell::default(), Cell::new(0), RefCell::default());
        let mut out = Self { colors, cost: 1.0, remains: 0.3, gain, fails: None, measured, adopted, encoded };
        out.cost = lost / (40.0 - out.psnr(&rounded, &out.start(&gaussians).unwrap().weights, None).unwrap());
        out
    }
}

impl TuneModel for Trainer {
    fn caution(&self) -> Result<Option<String>> {
        Ok(None)
    }
    fn start(&self, gaussians: &HostGaussians) -> Result<TunedModel> {
        Ok(TunedModel { gaussians: gaussians.clone(), weights: vec![WeightArray { name: "iterations".into(), shape: vec![1], values: vec![0.0] }] })
    }
    fn tune(&self, from: &TunedModel, tuning: &Tuning) -> Result<TunedModel> {
        if let Some((_, error)) = self.fails.filter(|(after, _)| from.weights[0].values[0] >= *after) {
            return Err(error());
        }
        let mut out = from.clone();
        out.weights[0].values[0] += tuning.iterations as f32;
        Ok(out)
    }
    fn psnr(&self, gaussians: &HostGaussians, weights: &[WeightArray], _: Option<f64>) -> Result<f64> {
        // Scores are the indices of the rows, whose order may change.
        let rows = gaussians.dynamic_scores.iter().zip(gaussians.sh_dc.chunks_exact(3));
        let squares = rows.flat_map(|(&row, found)| found.iter().zip(&self.colors[3 * row as usize..])).map(|(a, b)| f64::from(a - b).powi(2));
        // Training compensates for most of the loss by rounding.
        let cost = self.cost * if weights[0].values[0] > 0.0 { self.remains } else { 1.0 };
        let psnr = 40.0 - cost * squares.sum::<f64>() / self.colors.len() as f64 + self.gain * f64::from(weights[0].values[0]);
        self.measured.borrow_mut().insert(weights[0].values[0] as u32, psnr);
        Ok(psnr)
    }
    fn encoded_weights(&self, weights: &[WeightArray], _: f64) -> Result<EncodedWeights> {
        *self.encoded.borrow_mut().entry(weights[0].values[0] as u32).or_default() += 1;
        Ok(EncodedWeights::default())
    }
    fn adopt(&self, weights: Vec<WeightArray>, _: f64) {
        self.adopted.set(weights[0].values[0] as u32);
    }
    fn adopted(&self) -> Result<Option<EncodedWeights>> {
        Ok(None)
    }
}

/// Calls `run` with a job of random Gaussians, the directions from which they are seen, and a context that notes events.
fn with_job(sh_degree: usize, run: impl for<'a> FnOnce(&mut Job<'a>, &'a Directions, &CodecContext, &Recorder)) {
    let n = 500;
    let mut g = random_gaussians(n, sh_degree);
    g.dynamic_scores = (0..n).map(|row| row as f32).collect();
    let events = Recorder::default();
    let context = CodecContext::new(Seed::root(1), Default::default(), &events);
    let importance = importance::estimate(&g, &context);
    let classes = classify(&importance.weights, &importance.shapes, false);
    let planner = Planner::new(Columns::from(&g), &importance, &classes, Choices { transform: true, rate_weight: 0.0 });
    let mut directions = Directions::new(n, sh_degree);
    for k in 0..20 {
        let eye = [4.0, (k as f64 * 0.7).sin(), (k as f64 * 1.3).cos()];
        directions.add(&Camera::look_at("t", (8, 8), 1.0, eye, [0.0; 3], [0.0, 0.0, 1.0]), &g.means, &vec![1.0; n]);
    }
    let (directions, layers) = (directions.factored(), layers::assign(&importance.weights, 1));
    let motion = Motion { free: 0, moving: None, levels: [0.0; 2] };
    let mut job = Job { planner, free: vec![false; n], directions: None, layers, motion, factors: [1.0; 6], joint: Cell::new(true) };
    run(&mut job, &directions, &context, &events);
}

#[test]
fn what_is_allowed_is_used_whatever_training_gains() {
    with_job(0, |job, _, context, _| {
        let attempt = job.attempt(0.01).unwrap().0;
        let streams = job.streams(job.planner.gaussians, &attempt.plan).unwrap();
        for (limit, gain) in [(0.05, 0.0), (0.05, 3e-4), (0.05, 1.5e-3), (0.3, 5e-4), (0.05, -1e-5)] {
            // The result without training loses almost as much as is allowed.
            let trainer = Trainer::of(&attempt, job, 0.99 * limit, gain);
            let found = Untuned { attempt: &attempt, streams: &streams, allowed: true };
            let tuned = tune(job, &found, &Goal::Drop(limit), &Settings::default(), &trainer, context).unwrap();
            let Tuned::Better(better) = tuned else { panic!("nothing better for {limit} dB and a gain of {gain}") };
            assert!(bytes_of(&better) < bytes_of(&streams));
            let lost = 40.0 - trainer.measured.borrow()[&trainer.adopted.get()];
            assert!((0.2 * limit..=limit).contains(&lost), "{limit} dB, a gain of {gain}: {:?}", trainer.measured);
        }
    });
}

fn not_finite() -> Error {
    Error::backend("fine-tuning", "a gradient is not finite", "Compress with finetune=0")
}

#[test]
fn a_round_that_fails_leaves_those_before() {
    with_job(0, |job, _, context, events| {
        let attempt = job.attempt(0.01).unwrap().0;
        let streams = job.streams(job.planner.gaussians, &attempt.plan).unwrap();
        let found = Untuned { attempt: &attempt, streams: &streams, allowed: true };
        let tuned = |after: f32, error: fn() -> Error| {
            // A round gains so much that each keeps what is allowed.
            let trainer = Trainer { fails: Some((after, error)), ..Trainer::of(&attempt, job, 0.29, 2e-2) };
            let tuned = tune(job, &found, &Goal::Drop(0.3), &Settings::default(), &trainer, context);
            (tuned, trainer.adopted.get())
        };
        let (first, adopted) = tuned(100.0, not_finite);
        assert!(matches!(first, Ok(Tuned::Better(better)) if bytes_of(&better) < bytes_of(&streams)) && adopted == 100, "{adopted} iterations");
        let warned = |event: &Event| matches!(event, Event::Warning { message, .. } if message.contains("round 2 of 5") && message.contains("not finite"));
        assert_eq!(events.events().iter().filter(|event| warned(event)).count(), 1);
        let (none, adopted) = tuned(0.0, not_finite);
        assert!(matches!(none, Ok(Tuned::Nothing { lost }) if (lost - 0.29).abs() < 1e-6) && adopted == 0);
        let (stopped, _) = tuned(100.0, || Error::Interrupted("in a test".into()));
        assert!(matches!(stopped, Err(Error::Interrupted(_))));
    });
}

#[test]
fn where_nothing_is_allowed_the_nearest_is_kept() {
    with_job(0, |job, _, context, _| {
        let attempt = job.attempt(0.01).unwrap().0;
        let streams = job.streams(job.planner.gaussians, &attempt.plan).unwrap();
        let found = Untuned { attempt: &attempt, streams: &streams, allowed: false };
        // Rounding costs 2 dB, 0.6 after training, and each round 1 dB more.
        let trainer = Trainer::of(&attempt, job, 2.0, -1e-2);
        let tuned = |goal: Goal| tune(job, &found, &goal, &Settings::default(), &trainer, context).unwrap();
        let Tuned::Nearest { streams: nearest, used } = tuned(Goal::Drop(0.05)) else { panic!("the first round loses less") };
        assert!((1.5..1.7).contains(&used) && trainer.adopted.get() == 100 && !nearest.is_empty(), "{used} dB");
        let Tuned::Nearest { streams: nearest, used } = tuned(Goal::Bytes(10.0)) else { panic!("larger steps have fewer bytes") };
        assert!(used == bytes_of(&nearest) as f64 && used < bytes_of(&streams) as f64, "{used} bytes");
    });
}

/// Views whose images are never read.
struct Unseen;

impl TrainingViews for Unseen {
    fn len(&self) -> usize {
        1
    }
    fn view(&self, _: usize) -> (&Camera, f32) {
        unreachable!("a size needs no views")
    }
    fn image(&self, _: usize) -> Result<Image8> {
        Err(not_finite())
    }
}

impl RenderModel for Unseen {
    fn render(&self, _: &HostGaussians, _: &Camera, _: f32) -> Result<RenderedPlanes> {
        Err(not_finite())
    }
    fn background(&self) -> [f32; 3] {
        [0.0; 3]
    }
}

#[test]
fn where_training_is_worth_nothing_colours_are_rounded_together() {
    with_job(2, |job, directions, context, _| {
        let attempt = job.attempt(0.01).unwrap().0;
        let limit = bytes_of(&job.streams(job.planner.gaussians, &attempt.plan).unwrap());
        let trainer = Trainer { fails: Some((0.0, not_finite)), ..Trainer::of(&attempt, job, 0.1, 0.0) };
        let context = CodecContext { views: Some(&Unseen), renderer: Some(&Unseen), tuner: Some(&trainer), ..*context };
        let settings = |finetune: usize| Settings { max_size_mb: limit as f64 / 1e6, allocate: false, finetune, ..Default::default() };
        let apart = search(job, &settings(0), &context).unwrap();
        job.directions = Some(directions);
        let together = search(job, &settings(100), &context).unwrap();
        assert!(job.directions.is_some() && together != apart && bytes_of(&together) <= limit, "{} of {limit} bytes", bytes_of(&together));
    });
}

#[test]
fn what_is_coded_is_quantised_once() {
    with_job(2, |job, directions, context, _| {
        job.directions = Some(directions);
        let plain = Settings { max_drop_db: 0.0, finetune: 0, allocate: false, ..Default::default() };
        let quality = estimate(plain.psnr_db, job.planner.importance);
        // Colours that exceed the declared loss together are rounded apart from then on.
        job.attempt(quality).unwrap();
        QUANTISED.set(0);
        let (attempt, rounded) = job.attempt(quality).unwrap();
        let passes = QUANTISED.replace(0);
        let (streams, stored) = job.stored(job.planner.gaussians, &attempt.plan).unwrap();
        assert!(QUANTISED.replace(0) == 1 && stored == rounded);
        assert!(job.restored(job.planner.gaussians, &attempt.plan) == rounded && QUANTISED.replace(0) == 1);
        // The first attempt uses almost all of this size.
        let bounded = Settings { max_size_mb: (bytes_of(&streams) + 1) as f64 / 1e6, ..plain.clone() };
        for settings in [plain, bounded] {
            assert!(search(job, &settings, context).unwrap() == streams, "{settings:?}");
            assert_eq!(QUANTISED.replace(0), passes, "{settings:?}");
        }
    });
}

#[test]
fn what_the_search_has_found_is_not_made_again() {
    with_job(2, |job, _, _, _| {
        let view = Uneven::new(job.planner.gaussians.sh_dc, 0.03);
        let whole = job.planner.gaussians.to_host();
        let (attempt, streams) = job.coded(&job.planner, 0.01, &job.factors).unwrap();
        assert!(job.repeats(&attempt, 0.01, &[1.0; 6]) && !job.repeats(&attempt, 0.02, &[1.0; 6]) && !job.repeats(&attempt, 0.01, &[2.0; 6]));
        CODED.set(0);
        let afresh = allocate(job, 0.01, None, &whole, &view, &view).unwrap();
        assert_eq!(CODED.replace(0), 7);
        assert_eq!(allocate(job, 0.01, Some((&attempt.plan, bytes_of(&streams))), &whole, &view, &view).unwrap(), afresh);
        assert_eq!(CODED.replace(0), 6);
        job.joint.set(false);
        assert!(!job.repeats(&attempt, 0.01, &[1.0; 6]), "colours would be rounded apart");
    });
}

#[test]
fn no_change_of_harmonics_is_tried_where_there_are_none() {
    with_job(0, |job, _, _, _| {
        let view = Uneven::new(job.planner.gaussians.sh_dc, 0.03);
        let whole = job.planner.gaussians.to_host();
        CODED.set(0);
        let factors = allocate(job, 0.01, None, &whole, &view, &view).unwrap();
        assert_eq!((CODED.replace(0), factors[5]), (6, 1.0));
    });
}

#[test]
fn weights_are_not_encoded_in_steps_that_no_round_takes() {
    with_job(0, |job, _, context, _| {
        let attempt = job.attempt(0.01).unwrap().0;
        let streams = job.streams(job.planner.gaussians, &attempt.plan).unwrap();
        let found = Untuned { attempt: &attempt, streams: &streams, allowed: true };
        let trainer = Trainer::of(&attempt, job, 0.01, 0.0);
        tune(job, &found, &Goal::Bytes(bytes_of(&streams) as f64), &Settings::default(), &trainer, context).unwrap();
        // In their steps, and but for the last round in steps twice as large, which tell how many bytes those of the next round save.
        let encoded: Vec<(u32, usize)> = trainer.encoded.take().into_iter().filter(|(iterations, _)| *iterations > 0).collect();
        assert_eq!(encoded, [(100, 2), (200, 2), (300, 2), (400, 2), (500, 1)]);
    });
}

/// A view, and a renderer whose images lose so many dB as soon as a colour is rounded, and no more in larger steps.
struct Uneven {
    colors: Vec<f32>,
    camera: Camera,
    lost: f64,
}

impl Uneven {
    fn new(colors: &[f32], lost: f64) -> Self {
        Self { colors: colors.to_vec(), camera: Camera::look_at("t", (2, 2), 1.0, [4.0, 0.0, 0.0], [0.0; 3], [0.0, 0.0, 1.0]), lost }
    }
}

impl TrainingViews for Uneven {
    fn len(&self) -> usize {
        1
    }
    fn view(&self, _: usize) -> (&Camera, f32) {
        (&self.camera, 0.5)
    }
    fn image(&self, _: usize) -> Result<Image8> {
        Ok(Image8 { width: 2, height: 2, channels: 3, data: vec![0; 12] })
    }
}

impl RenderModel for Uneven {
    fn render(&self, gaussians: &HostGaussians, _: &Camera, _: f32) -> Result<RenderedPlanes> {
        let mut rows = gaussians.dynamic_scores.iter().zip(gaussians.sh_dc.chunks_exact(3));
        let exact = rows.all(|(&row, found)| self.colors[3 * row as usize..].starts_with(found));
        let error = 0.01 * 10f64.powf(if exact { 0.0 } else { self.lost / 20.0 });
        Ok(RenderedPlanes { width: 2, height: 2, planes: vec![error as f32; 20] })
    }
    fn background(&self) -> [f32; 3] {
        [0.0; 3]
    }
}

#[test]
fn a_search_that_runs_out_of_attempts_says_so() {
    with_job(0, |job, _, context, events| {
        for (lost, ends) in [(0.03, true), (0.049, false)] {
            let uneven = Uneven::new(job.planner.gaussians.sh_dc, lost);
            let context = CodecContext { views: Some(&uneven), renderer: Some(&uneven), ..*context };
            let before = events.events().len();
            search(job, &Settings { max_drop_db: 0.05, finetune: 0, allocate: false, ..Default::default() }, &context).unwrap();
            let said = events.events().split_off(before);
            let part = "the search ended after 8 attempts";
            let noted = said.iter().any(|event| matches!(event, Event::Note { message, .. } if message.contains(part)));
            let warned = said.iter().any(|event| matches!(event, Event::Warning { message, .. } if message.contains(part) && message.contains("uses 60 %")));
            assert_eq!((noted, warned), (ends, ends), "{said:?}");
        }
    });
}

#[test]
fn a_size_that_only_the_coarsest_steps_have_is_reached() {
    with_job(0, |job, _, context, _| {
        // Of this start, all colours are zero after some 16 octaves; attempts are two octaves apart at most.
        let fine = Settings { psnr_db: 90.0, finetune: 0, allocate: false, ..Default::default() };
        let start = estimate(fine.psnr_db, job.planner.importance);
        let coarsest = bytes_of(&job.coded(&job.planner, start * libm::exp2(24.0), &job.factors).unwrap().1);
        let mut bounded = |limit: usize| search(job, &Settings { max_size_mb: limit as f64 / 1e6, ..fine.clone() }, context);
        for percent in [102, 110] {
            let limit = coarsest * percent / 100;
            let found = bytes_of(&bounded(limit).unwrap());
            assert!(found <= limit && 100 * found > 93 * limit, "{found} of {limit} bytes, the coarsest has {coarsest}");
        }
        let refused = bounded(coarsest * 9 / 10).unwrap_err().to_string();
        assert!(refused.contains("the smallest file it reached has"), "{refused}");
    });
}

#[test]
fn a_round_follows_where_the_last_one_missed() {
    with_job(0, |job, _, context, _| {
        let attempt = job.attempt(0.01).unwrap().0;
        let streams = job.streams(job.planner.gaussians, &attempt.plan).unwrap();
        let found = Untuned { attempt: &attempt, streams: &streams, allowed: true };
        // Training compensates for as much as expected, and for less.
        for (remains, rounds) in [(0.3, 5), (0.7, 6)] {
            let trainer = Trainer { remains, ..Trainer::of(&attempt, job, 0.0499, 0.0) };
            let tuned = tune(job, &found, &Goal::Drop(0.05), &Settings::default(), &trainer, context).unwrap();
            assert!(matches!(tuned, Tuned::Better(better) if bytes_of(&better) < bytes_of(&streams)));
            let lost: Vec<f64> = trainer.measured.borrow().values().map(|psnr| 40.0 - psnr).collect();
            assert!(lost.len() == rounds + 1 && lost[rounds] <= 0.05 && (rounds == 5 || lost[5] > 0.05), "{lost:?}");
        }
    });
}

#[test]
fn rounds_add_up() {
    for iterations in [0, 1, 4, 5, 999, 1000] {
        let rounds = rounds(iterations);
        assert_eq!(rounds.iter().sum::<usize>(), iterations);
        assert!(rounds.iter().all(|r| *r > 0) && rounds.len() <= ROUNDS, "{rounds:?}");
    }
}
