//! Damaged streams of every codec, weight codec and playback layer: an error or a sound result, never a panic, and no allocation that the limits do not allow.
//!
//! `CC4DGS_HOSTILE_SECONDS=600 cargo test --release -p cc4dgs-codecs --test hostile` tries for so long per test, shared by its codecs and models; by default it
//! is a second for each. With `CC4DGS_HOSTILE_CORPUS=1` it adds a case to the corpus for every outcome that the corpus does not have. A program of its own,
//! because it watches every allocation.

#[path = "../../../core/format/tests/support/allocations.rs"]
mod allocations;
mod corpus;
mod damage;

use allocations::{LARGEST, Watching};
use cc4dgs_format::playback::{CodedTrack, Head, PlaybackLayer};
use cc4dgs_format::{
    AttributeCodec, Camera, CodecContext, CodecPlugin, Entries, Error, EvaluateDeformer, ExtraAttribute, HostGaussians, Image8, Limits, RenderModel,
    RenderedPlanes, Result, Seed, Silent, Stream, TrainingViews, WeightArray, WeightCodec, WeightCodecPlugin, toml,
};
use corpus::{Corpus, Growing, class, harmed};
use damage::damage;
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

#[global_allocator]
static ALLOCATOR: Watching = Watching;

/// Enough for what is encoded here, far below what damaged counts claim.
const LIMITS: Limits = Limits { max_bytes: 64 << 20, max_gaussians: 100_000, max_pixels: 1 << 20, max_depth: 16 };

fn context(threshold: Option<f32>) -> CodecContext<'static> {
    CodecContext { dynamic_threshold: threshold, ..CodecContext::new(Seed::root(17), LIMITS, &Silent) }
}

/// An image of 64 pixels, each the sum of the values of some Gaussians, so that an encoder finds that everything matters.
struct Sums(Camera);

impl RenderModel for Sums {
    fn render(&self, g: &HostGaussians, _: &Camera, _: f32) -> Result<RenderedPlanes> {
        let mut planes = vec![0.0; 5 * 64];
        let columns = g.columns().into_iter().map(|(_, width, values)| (width, values)).chain(g.extra.values().map(|a| (a.width, &a.values)));
        for (width, values) in columns.filter(|(width, _)| *width > 0) {
            for (k, value) in values.iter().enumerate() {
                planes[(k / width * 7 + k % width) % (3 * 64)] += 1e-4 * value;
            }
        }
        Ok(RenderedPlanes { width: 8, height: 8, planes })
    }
    fn background(&self) -> [f32; 3] {
        [0.0; 3]
    }
}

impl EvaluateDeformer for Sums {
    fn deform(&self, gaussians: &HostGaussians, _: f32) -> Result<HostGaussians> {
        Ok(gaussians.clone())
    }
}

impl TrainingViews for Sums {
    fn len(&self) -> usize {
        1
    }
    fn view(&self, _: usize) -> (&Camera, f32) {
        (&self.0, 0.5)
    }
    fn image(&self, _: usize) -> Result<Image8> {
        Ok(RenderedPlanes { width: 8, height: 8, planes: vec![0.5; 5 * 64] }.to_image())
    }
}

fn scene(count: usize, sh_degree: usize) -> HostGaussians {
    let draw = |i: usize, k: usize| (Seed::root(23).index(i as u64).index(k as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0;
    let mut g = HostGaussians { sh_degree, opacity_logits: vec![0.0; count], ..Default::default() };
    for (column, (name, width, values)) in g.columns_mut().into_iter().enumerate() {
        let (shift, scale) = if name == "log_scales" { (-4.0, 1.0) } else { (0.0, if name == "dynamic_scores" { 12.0 } else { 1.0 }) };
        *values = (0..count * width).map(|i| shift + scale * draw(i, column)).collect();
    }
    g.extra.insert("exact".into(), ExtraAttribute::exact(2, (0..2 * count).map(|i| draw(i, 90)).collect()));
    let needed = g.dynamic_scores.iter().map(|s| *s > 5.0).collect();
    g.extra.insert("near".into(), ExtraAttribute::exact(1, (0..count).map(|i| draw(i, 91)).collect()).within(0.01).needed_in(needed, 0.0));
    g
}

/// Seconds for each codec.
fn seconds(of: usize) -> Duration {
    let wanted = std::env::var("CC4DGS_HOSTILE_SECONDS").ok().and_then(|v| v.parse::<f64>().ok()).map_or(1.0, |total| total / of.max(1) as f64);
    Duration::from_secs_f64(wanted)
}

/// The outcome of decoding: its name, or what is wrong with the result.
type Outcome = std::result::Result<String, String>;

fn happened<T>(found: &Result<T>, sound: &[Stream]) -> String {
    found.as_ref().map_or_else(|e: &Error| class(&e.to_string(), sound), |_| "sound".into())
}

/// Repeats the damages of the corpus, then tries others until time is up, half of them on top of those. How many, and what is new in the corpus.
fn attack(name: &str, sound: &[Stream], time: Duration, decode: &dyn Fn(&[Stream]) -> Outcome) -> (u64, String) {
    let corpus = Corpus::read(name, sound);
    let limits = |name: &str| {
        let largest = LARGEST.load(Ordering::Relaxed) as u64;
        assert!(largest <= LIMITS.max_bytes, "{name}: {largest} bytes at once, {} are allowed", LIMITS.max_bytes);
    };
    if let Some(corpus) = &corpus {
        // Streams of an earlier encoder are decoded still.
        assert_eq!(decode(&corpus.sound), Ok("sound".into()), "{name}: the sound streams of the corpus");
        for case in &corpus.cases {
            if let Err(problem) = decode(&harmed(&corpus.sound, &case.damages)) {
                panic!("{name}: {problem} after {:?}", case.damages);
            }
            limits(name);
        }
    }
    let known = corpus.as_ref().map_or(&[][..], |corpus| &corpus.cases);
    let base = corpus.as_ref().map_or(sound, |corpus| &corpus.sound);
    let growing = std::cell::RefCell::new(Growing::new(name, sound, known, base));
    let began = Instant::now();
    let strategy = (any::<prop::sample::Index>(), any::<bool>(), prop::collection::vec((any::<usize>(), damage()), 1..4));
    let tried = std::cell::Cell::new(0);
    for round in 0.. {
        if began.elapsed() >= time {
            break;
        }
        // A runner stops after its number of cases, so each round has its own.
        let mut seed = [0; 32];
        seed[..8].copy_from_slice(&Seed::root(round).value().to_le_bytes());
        let rng = proptest::test_runner::TestRng::from_seed(proptest::test_runner::RngAlgorithm::ChaCha, &seed);
        let mut runner = TestRunner::new_with_rng(Config { cases: 64, failure_persistence: None, ..Config::default() }, rng);
        let outcome = runner.run(&strategy, |(from, fresh, damages)| {
            tried.set(tried.get() + 1);
            let mut growing = growing.borrow_mut();
            let before = if fresh { Vec::new() } else { growing.pick(from) };
            let damages = [before, damages].concat();
            match decode(&harmed(growing.sound(fresh), &damages)) {
                Ok(class) => {
                    growing.keep(fresh, class, damages);
                    Ok(())
                }
                Err(problem) => Err(TestCaseError::fail(problem)),
            }
        });
        if let Err(e) = outcome {
            panic!("{name}: {e}");
        }
        limits(name);
    }
    (tried.get(), growing.into_inner().write().unwrap_or_default())
}

#[test]
fn damaged_gaussians_give_errors() {
    cc4dgs_codecs::link();
    let plugins: Vec<_> = Entries::<CodecPlugin>::collect().unwrap().iter().collect();
    let time = seconds(plugins.len() * 3);
    let drawn = Sums(Camera::look_at("view", (8, 8), 0.8, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]));
    for plugin in plugins {
        let mut settings = toml::Table::new();
        for (name, value) in [("sample_budget", 20000), ("layers", 3)] {
            if plugin.info.schema.contains(&format!("{name} ")) {
                settings.insert(name.into(), value.into());
            }
        }
        let codec: Box<dyn AttributeCodec> = (plugin.build)("", &settings).unwrap();
        // The larger model is enough for forms that are chosen for large ones only.
        for (count, degree, threshold, seen) in [(40, 3, Some(5.0), false), (3000, 1, None, false), (200, 1, Some(5.0), true)] {
            let without = context(threshold);
            let context_of_scene = CodecContext { views: Some(&drawn), renderer: Some(&drawn), deformer: Some(&drawn), ..without };
            let sound = codec.encode(&scene(count, degree), if seen { &context_of_scene } else { &without }).unwrap();
            let (tried, new) = attack(&format!("{}-{count}", plugin.info.name), &sound, time, &|streams| {
                let found = [codec.decode(streams, &context(None)), codec.decode_stage(streams, &context(None))];
                let classes = found.each_ref().map(|found| happened(found, &sound));
                let wrong = found.into_iter().flatten().find_map(|found| found.validate("decoded", &LIMITS).err());
                wrong.map_or_else(|| Ok(if classes[0] == classes[1] { classes[0].clone() } else { classes.join("; by stage: ") }), |e| Err(e.to_string()))
            });
            println!("{}: {tried} damaged versions of {count} Gaussians, {:.1} s. {new}", plugin.info.name, time.as_secs_f64());
        }
    }
}

#[test]
fn damaged_playback_layers_give_errors() {
    let (rows, samples, degree) = ([1usize, 4, 5, 9, 30], 6, 1);
    let track = |head: Head, first: usize, last: usize| {
        let ranks = vec![2u8, 0, 1, 2, 1];
        let coefficients = ranks.iter().map(|r| usize::from(*r)).sum::<usize>() * head.width(degree);
        CodedTrack {
            head,
            peaks: vec![0.5, 2.0],
            functions: (0..2 * (last - first + 1)).map(|k| (k as i16 * 9973).wrapping_mul(3)).collect(),
            step: 1e-3,
            exponents: ranks.iter().map(|r| 3 * r).collect(),
            ranks,
            coefficients: (0..coefficients as i32).map(|k| k * 37 - 200).collect(),
        }
    };
    let segments = [(3, vec![track(Head::ALL[0], 0, 3), track(Head::ALL[2], 0, 3)]), (5, vec![track(Head::ALL[0], 3, 5)])];
    let sound = PlaybackLayer::encode(&rows, degree, samples, &segments).unwrap();
    PlaybackLayer::decode(&sound, 40, degree, &LIMITS).unwrap();
    let (tried, new) = attack("playback-layer", &sound, seconds(1), &|streams| {
        let found = PlaybackLayer::decode(streams, 40, degree, &LIMITS);
        let class = happened(&found, &sound);
        if found.is_ok_and(|layer| layer.rows.iter().any(|row| *row >= 40)) { Err("a row beyond the Gaussians".into()) } else { Ok(class) }
    });
    println!("playback layer: {tried} damaged versions. {new}");
}

#[test]
fn damaged_weights_give_errors() {
    cc4dgs_codecs::link();
    let plugins: Vec<_> = Entries::<WeightCodecPlugin>::collect().unwrap().iter().collect();
    let time = seconds(plugins.len());
    let array = |name: &str, shape: &[usize]| {
        let count = shape.iter().product::<usize>();
        WeightArray { name: name.into(), shape: shape.into(), values: (0..count).map(|i| (i as f32 * 0.37).sin()).collect() }
    };
    let weights = [array("grid", &[40, 33]), array("bias", &[5]), array("scale", &[]), array("none", &[0, 4])];
    for plugin in plugins {
        let codec: Box<dyn WeightCodec> = (plugin.build)(&toml::Table::new()).unwrap();
        // With steps of their own for rows, where the codec has them.
        let importance: Vec<Vec<f32>> = weights.iter().map(|a| (0..a.values.len()).map(|i| 4f32.powi(i as i32 / 16 % 12)).collect()).collect();
        let sound = codec.encode(&weights, &CodecContext { weight_importance: Some(&importance), ..context(None) }).unwrap();
        let (tried, new) = attack(&format!("weights-{}", plugin.info.name), &sound, time, &|streams| {
            let found = codec.decode(streams, &context(None));
            let class = happened(&found, &sound);
            let unsound = |a: &WeightArray| a.shape.iter().product::<usize>() != a.values.len() || a.values.iter().any(|v| !v.is_finite());
            found.ok().and_then(|arrays| arrays.into_iter().find(unsound)).map_or(Ok(class), |a| Err(format!("'{}' is not sound", a.name)))
        });
        println!("{}: {tried} damaged versions of weights. {new}", plugin.info.name);
    }
}
