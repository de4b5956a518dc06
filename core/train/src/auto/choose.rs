//! From what is known of a scene and a machine to settings, each with its reason.

mod stages;

use super::facts::{Arrangement, Facts};
use super::overlap::Overlap;
use crate::masks::PUBLISHED_SIGMA;
use cc4dgs_core::{SceneOptions, plural};
use stages::stages;
use toml::Value;

/// Pixels per image that a thread can train on in a minute and still see every part of the scene a few hundred times.
const PIXELS_PER_THREAD_MINUTE: f64 = 1.0e4;
/// How many threads a graphics card stands for.
const GRAPHICS_THREADS: f64 = 100.0;
/// Minutes of a graphics card from which fields have their full size. With it an H200 took 36 ms per iteration for 40,200 moving Gaussians, whatever the views,
/// and 3 to 4 ms per view for the rest. The two sizes were not compared on a card.
const FULL_SIZE_MINUTES: f64 = 10.0;
/// Images up to this much larger than that are left as they are.
const SPARE: f64 = 1.4;
/// Fewest pixels that images are reduced to.
const LEAST_PIXELS: f64 = 2.0e4;
/// Gaussians per pixel with detail.
const PER_DETAIL: f64 = 0.8;
/// Cameras around a scene beyond the first two that bear as many Gaussians as one image has: with four cameras in all, 12,000 were 0.9 dB better than 20,000.
const CAMERAS_PER_PART: f64 = 6.0;
/// Frames that do: what moves has Gaussians of its own at many times. A capture of 300 frames lost a decibel on moving pixels with half as many.
const FRAMES_PER_PART: f64 = 150.0;
/// Fewest Gaussians at most.
const LEAST_GAUSSIANS: f64 = 4000.0;
/// Gaussians that a thread can train in a minute: on five captures 0.05 to 0.9 dB better than 4,000; 10,000 are no better.
const PER_THREAD_MINUTE: f64 = 6500.0;
/// The same where all of them move; and how many more there are per pixel with detail, where there is time for them: 0.7 dB on mutant at equal time.
const ALL_MOVE_PER_THREAD_MINUTE: f64 = 1200.0;
/// The same with stored features, whose deformer costs less: in seven minutes of one thread, 17,000 are 1.35 dB better than 8,500 on mutant.
const STORED_PER_THREAD_MINUTE: f64 = 2400.0;
const ALL_MOVE_DETAIL: f64 = 2.0;
/// Deformers that plans know.
const FREE_TIME: &str = "free-time";
const CDF_BASIS: &str = "cdf-basis";
const HASH_BASIS: &str = "hash-basis";
/// Minutes of one thread below which `cdf-basis` has no finest voxels, whose vertices are most of a step, and half the width, `hash-basis` has smaller tables,
/// and images of moving scenes are small at first (of several cameras and many frames for longer).
const SHORT: f64 = 16.0;
/// |ln| of the brightness ratio of neighbouring cameras from which exposures are taken to differ.
const EXPOSURE: f32 = 0.09;
/// Share of moving pixels below which a scene is static.
const STATIC: f32 = 2e-4;
/// Width in pixels of the images that masks were published for (N3DV at half size).
const PUBLISHED_WIDTH: f64 = 1352.0;
/// Share of the time for matching key frames, seconds of one thread per matched pixel, and the most pixels of an image that are matched.
const MATCHING_SHARE: f64 = 0.08;
const SECONDS_PER_MATCHED_PIXEL: f64 = 1.6e-6;
const MOST_MATCHED_PIXELS: f64 = 96_000.0;
/// Least and most frames between key frames: in fewer hardly anything moves; in more, straight lines do not follow.
const LEAST_KEY_INTERVAL: f64 = 3.0;
const MOST_KEY_INTERVAL: usize = 16;
/// Fewest points that a key frame must get: with 420, 19 key frames of 8 cameras were 0.8 dB better than 34 with 235, and 0.4 dB than 12 with 660.
const LEAST_KEY_POINTS: f64 = 400.0;
/// Share of the frames in which a moving pixel differs from its median, from which things move on the spot rather than pass: key frames then lose 3 to 4 dB on
/// moving pixels against a deformer, where they gain 2.6 dB if things pass. Captures have 0.20 to 0.28 where a figure walks and 0.46 where it sits.
const ON_THE_SPOT: f32 = 0.37;
/// Share of the Gaussians that there are at the start; the rest are points of key frames, or grow.
const AT_START: f64 = 0.6;
/// Up to this many cameras, Gaussians are dropped. Held-out cameras gained 0.9 dB with 4 (3.1 where opacities fade by 0.02), and up to 1.1 or lost 0.9 with 8;
/// with 10 nothing, with 27 a loss of 0.4.
const FEW_CAMERAS: usize = 8;
/// The share of Gaussians that views are drawn without then, at the end.
const DROPOUT: f64 = 0.2;
/// The share by which every view lowers the opacity of the Gaussians that it shows.
const DECAY: f64 = 0.005;
/// Larger ones, where half of what a camera sees is seen by at most so many. Held-out cameras gain 2.2 to 5.1 dB from 0.02 with 3 of 3 or 4, and 0.3 on average
/// from 0.01 with 5 to 8 of 9 to 16. With 18 of 18, 0.01 costs moving pixels 0.7 and 1.2 dB; with 5 of 10, 0.02 costs them 0.6.
const DECAYS: [(usize, f64); 2] = [(4, 0.02), (10, 0.01)];
/// The most cameras for which that is done: captures of 4 to 18 gain, one of 27 loses. Overlap does not tell them apart: half of what a camera sees is
/// seen by 12 of the 27, and by 3 of 4, 5 of 10, 8 of 16 and 18 of 18 of the others.
const DECAY_CAMERAS: usize = 20;
/// What a pixel adds to a footprint, square pixels: little more than the 1/12 of its own area. Held-out views gain 0.0 to 0.34 dB over 0.3.
const BLUR: f64 = 0.1;
/// Share of transparent pixels from which a scene is an object without surroundings.
const OBJECT: f32 = 0.05;

/// The computer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Machine {
    /// Threads of the processor that are used.
    pub threads: usize,
    /// Whether a graphics card computes.
    pub graphics: bool,
    /// Memory in bytes that this process may use, if the system says.
    pub memory: Option<u64>,
}

impl Machine {
    /// How many processor threads it stands for.
    fn speed(self) -> f64 {
        if self.graphics { GRAPHICS_THREADS } else { self.threads.max(1) as f64 }
    }
}

/// Settings that have one reason.
#[derive(Clone, Debug, PartialEq)]
pub struct Choice {
    /// Keys such as `train.batch`, with their values.
    pub settings: Vec<(&'static str, Value)>,
    /// Why, in words.
    pub reason: String,
}

fn choice(settings: impl IntoIterator<Item = (&'static str, Value)>, reason: impl Into<String>) -> Choice {
    Choice { settings: settings.into_iter().collect(), reason: reason.into() }
}

fn float(value: f64) -> Value {
    // Six digits: what is written to config.toml is read back to the same number.
    Value::Float(format!("{value:.6}").parse().unwrap_or(value))
}

/// A learning rate with three significant digits: decimals would round small ones by much.
fn rate(value: f64) -> Value {
    Value::Float(format!("{value:.2e}").parse().unwrap_or(value))
}

fn integer(value: f64) -> Value {
    Value::Integer(value.round() as i64)
}

/// The width images are trained at, where the median of the `native` sizes of the cameras, which are sorted, is too much for the time. Sizes that the user
/// stated count instead.
pub(super) fn image_size(native: &[[u32; 2]], options: &SceneOptions, machine: Machine, minutes: f64) -> Option<Choice> {
    if options.width > 0 || options.height > 0 || options.downscale != 1.0 {
        return None;
    }
    let median = native.get(native.len() / 2)?;
    let pixels = f64::from(median[0]) * f64::from(median[1]);
    let affordable = (PIXELS_PER_THREAD_MINUTE * machine.speed() * minutes).max(LEAST_PIXELS);
    if pixels <= SPARE * affordable {
        return None;
    }
    let width = (f64::from(median[0]) * (affordable / pixels).sqrt()).round().max(1.0);
    let narrower = native.iter().filter(|size| f64::from(size[0]) < width).count();
    let have = plural(narrower, "has", "have");
    let kept = if narrower > 0 { format!("; {narrower} of {} cameras {have} smaller ones, which are not enlarged", native.len()) } else { String::new() };
    let time = format!("{minutes} {}", plural(minutes, "minute", "minutes"));
    let reason = format!("images of {}x{} pixels are too many for {time} on this machine{kept}", median[0], median[1]);
    Some(choice([("scene.width", integer(width))], reason))
}

/// What the configuration states and the plan follows.
#[derive(Clone, Copy, Default)]
pub(super) struct Stated<'a> {
    /// The deformer.
    pub deformer: Option<&'a str>,
    /// The upper bound of Gaussians.
    pub gaussians: Option<f64>,
    /// The first Gaussians; a bound that is not stated is no lower.
    pub first: Option<f64>,
}

/// Every other setting but the number of iterations.
pub(super) fn choose(facts: &Facts, machine: Machine, minutes: f64, stated: Stated) -> Vec<Choice> {
    let most = stated.gaussians.unwrap_or_else(|| most_gaussians(facts, machine, minutes).max(stated.first.unwrap_or(0.0)));
    let free = stated.deformer.is_none_or(|kind| kind == FREE_TIME);
    let every = free.then(|| key_frames(facts, machine, minutes, most)).flatten();
    let mut choices = vec![field(facts, machine, minutes, stated.deformer, every), stages(facts, machine, minutes, most, every), counts(facts, most)];
    choices.extend(background(facts));
    choices.extend(near(facts));
    choices.push(blur());
    choices.extend(noise(facts));
    choices.extend(masks(facts));
    choices.extend(exposure(facts));
    choices.extend(colour(facts));
    choices.extend(dropout(facts));
    choices.extend(decay(facts));
    choices
}

fn stands_still(facts: &Facts) -> bool {
    facts.frames <= 1 || facts.moving.is_some_and(|share| share < STATIC)
}

/// Whether the images show an object without surroundings.
fn stands_alone(facts: &Facts) -> bool {
    facts.plain.is_some() || facts.transparent > OBJECT
}

/// How many frames lie between key frames, where several cameras see each, things pass, and there is time to match enough of them for `most` Gaussians.
fn key_frames(facts: &Facts, machine: Machine, minutes: f64, most: f64) -> Option<usize> {
    // Where no camera stands still, nothing says what moves.
    if stands_still(facts) || facts.moving.is_none() || !facts.arrangement.has_several_cameras() || facts.occupied.is_some_and(|share| share > ON_THE_SPOT) {
        return None;
    }
    let image = facts.pixels().min(MOST_MATCHED_PIXELS) * facts.cameras as f64;
    // Images are matched by the processor on every machine.
    let affordable = MATCHING_SHARE * 60.0 * minutes * machine.threads.max(1) as f64 / (SECONDS_PER_MATCHED_PIXEL * image.max(1.0));
    let points = (1.0 - AT_START) * most / LEAST_KEY_POINTS;
    let every = (facts.frames as f64 / affordable.min(points).max(1.0)).ceil().max(LEAST_KEY_INTERVAL) as usize;
    (every <= MOST_KEY_INTERVAL && facts.frames >= 2 * every).then_some(every)
}

fn field(facts: &Facts, machine: Machine, minutes: f64, stated: Option<&str>, key_frames: Option<usize>) -> Choice {
    if stands_still(facts) {
        return choice([("deformer.kind", "none".into()), ("train.dynamic", "none".into())], "nothing moves");
    }
    if let Some(every) = key_frames {
        let reason = format!("{} cameras see each frame: what moves starts with points of key frames, each with a velocity and a life", facts.cameras);
        return choice([("deformer.kind", FREE_TIME.into()), ("train.key_frames", integer(every as f64))], reason);
    }
    // Where poses have nothing to do with each other, stored features are 0.8 to 1.5 dB better than decoded ones on mutant and as good on the built-in
    // turntable; where one camera moves through time they are 0.2 dB worse.
    let stored = match stated {
        Some(kind) => kind == HASH_BASIS,
        None => facts.arrangement == Arrangement::OneCameraAnywhere,
    };
    // Higher bands would learn every training time of unrelated poses by itself and the times between not at all. Half a cycle lets the last frame differ from
    // the first: 0.2 dB on mutant, 0.9 on its first frame, with the same highest frequency.
    let (bands, cycles) = match facts.arrangement {
        Arrangement::OneCameraAnywhere => (5, 0.5),
        _ if facts.frames > 100 => (6, 1.0),
        _ => (4, 1.0),
    };
    let short = is_short(machine, minutes);
    let kind = if stored { HASH_BASIS } else { CDF_BASIS };
    let mut settings = vec![("deformer.kind", kind.into()), ("deformer.time_bands", Value::Integer(bands)), ("deformer.cycles", Value::Float(cycles))];
    if stored {
        settings.push(("deformer.log2_rows", Value::Integer(if short { 13 } else { 15 })));
        // The features are weights themselves. Without hidden layers in the heads, plans of five minutes of one thread on mutant run 1.4 to 2 times the
        // iterations and have 0.3 to 1.1 dB more.
        settings.push(("deformer.head_layers", Value::Integer(0)));
    } else if short && facts.arrangement == Arrangement::OneCameraAnywhere {
        // The penalty that takes unneeded functions out also makes needed ones smaller. Short runs of mutant have 0.3 dB more without it, 1.1 and 4.1 on the
        // first frame; longer ones nothing, and one of 90 minutes had 1.8 dB less, because rounds of density control cost more than was won back between them.
        settings.push(("deformer.sparsity", Value::Float(0.0)));
    }
    if !stored && (!machine.graphics || minutes < FULL_SIZE_MINUTES) {
        settings.push(("deformer.capacity", "small".into()));
        let resolutions: &[i64] = if short { &[8, 16, 32] } else { &[8, 16, 32, 64] };
        settings.push(("deformer.resolutions", Value::Array(resolutions.iter().map(|&r| Value::Integer(r)).collect())));
        settings.push(("deformer.hashes", Value::Integer(if short { 32 } else { 64 })));
        settings.push(("deformer.width", Value::Integer(if short { 64 } else { 128 })));
    }
    choice(settings, format!("{} frames; the most accurate deformer for its time", facts.frames))
}

/// Whether there is little time for a machine without a graphics card.
fn is_short(machine: Machine, minutes: f64) -> bool {
    !machine.graphics && machine.speed() * minutes < SHORT
}

/// Whether one camera at a time sees an object without surroundings, or nothing that stands still.
fn all_move(facts: &Facts) -> bool {
    !facts.arrangement.has_several_cameras() && !stands_still(facts) && (stands_alone(facts) || facts.arrangement == Arrangement::OneCameraAnywhere)
}

/// The published dataset that the scene is most like, whose sizes a method has on a graphics card.
pub(super) fn dataset_like(facts: &Facts) -> &'static str {
    if all_move(facts) { "dnerf" } else { "n3dv" }
}

/// The upper bound of Gaussians.
fn most_gaussians(facts: &Facts, machine: Machine, minutes: f64) -> f64 {
    // Cameras around a scene, and one that walks through it, see different parts of it.
    let parts = match facts.arrangement {
        Arrangement::Rig | Arrangement::OneCameraAnywhere => 1.0,
        _ if stands_alone(facts) => 1.0,
        Arrangement::Photos | Arrangement::OneMovingCamera | Arrangement::Dome => {
            let cameras = facts.cameras.saturating_sub(2) as f64 / CAMERAS_PER_PART;
            cameras.max(facts.frames as f64 / FRAMES_PER_PART).min(2.0)
        }
    };
    let (detail, per_minute) = match facts.arrangement {
        _ if !all_move(facts) => (1.0, PER_THREAD_MINUTE),
        Arrangement::OneCameraAnywhere => (ALL_MOVE_DETAIL, STORED_PER_THREAD_MINUTE),
        _ => (ALL_MOVE_DETAIL, ALL_MOVE_PER_THREAD_MINUTE),
    };
    let wanted = detail * parts * PER_DETAIL * facts.pixels() * f64::from(facts.detail);
    let affordable = per_minute * machine.speed() * minutes;
    (wanted.min(affordable).max(LEAST_GAUSSIANS) / 500.0).ceil() * 500.0
}

fn counts(facts: &Facts, most: f64) -> Choice {
    let reason = format!("{:.0} % of the pixels show detail", 100.0 * facts.detail);
    // What is split while it learns to move has to learn it again: all at once are 0.1 to 0.4 dB better on mutant.
    let at_start = if all_move(facts) { most } else { AT_START * most };
    choice([("density.kind", "mcmc".into()), ("density.max_gaussians", integer(most)), ("init.count", integer(at_start))], reason)
}

fn background(facts: &Facts) -> Option<Choice> {
    let (colour, reason) = match (facts.plain, facts.mean) {
        (Some(colour), _) => (colour, "the images have a plain background of this colour"),
        // The dataset states it.
        (None, None) => return None,
        (None, Some(_)) if stands_alone(facts) => ([1.0; 3], "the images are transparent"),
        (None, Some(mean)) => (mean, "where nothing is known of the surroundings, held-out views get the mean colour of the images"),
    };
    Some(choice([("render.background", Value::Array(colour.map(|c| float(f64::from(c))).to_vec()))], reason))
}

fn blur() -> Choice {
    choice([("render.blur", Value::Float(BLUR))], "with the 0.3 square pixels of 3D Gaussian splatting nothing is drawn sharper than half a pixel")
}

fn near(facts: &Facts) -> Option<Choice> {
    match facts.arrangement {
        Arrangement::Dome => Some(choice(
            [("render.rules", "inria".into()), ("render.near", Value::Float(1.0))],
            "other cameras of the dome may stand among its Gaussians: nothing nearer than a quarter of the way is drawn",
        )),
        Arrangement::OneMovingCamera | Arrangement::Rig | Arrangement::Photos => {
            Some(choice([("render.rules", "inria".into()), ("render.near", Value::Float(0.2))], "nothing nearer than a twentieth of the way is drawn"))
        }
        Arrangement::OneCameraAnywhere => None,
    }
}

fn noise(facts: &Facts) -> Option<Choice> {
    let noise = f64::from(facts.noise?);
    let threshold = 4.0 * noise;
    let reason = format!("the images have noise of {:.1} levels", 255.0 * noise);
    (threshold > 0.02 && !stands_still(facts)).then(|| choice([("train.mask_threshold", float(threshold.min(0.2)))], reason))
}

/// Masks of what moves as sharp as the published ones are on their images.
fn masks(facts: &Facts) -> Option<Choice> {
    let sigma = f64::from(PUBLISHED_SIGMA) * f64::from(facts.size[0]) / PUBLISHED_WIDTH;
    let reason = "masks of what moves are blurred in proportion to the width of the images";
    (facts.arrangement.has_several_cameras() && !stands_still(facts)).then(|| choice([("train.mask_sigma", float(sigma.clamp(0.7, 5.0)))], reason))
}

fn exposure(facts: &Facts) -> Option<Choice> {
    let ratio = facts.exposure.filter(|ratio| *ratio > EXPOSURE)?;
    let reason = format!("neighbouring cameras differ in brightness by {:.0} %", 100.0 * (ratio.exp() - 1.0));
    Some(choice([("appearance.kind", "affine".into())], reason))
}

/// Few cameras cannot tell how colours change with the direction.
fn colour(facts: &Facts) -> Option<Choice> {
    let degree = match facts.cameras {
        0..=4 => 0,
        5..=40 => 1,
        _ => return None,
    };
    let say = plural(facts.cameras, "camera says", "cameras say");
    Some(choice([("train.sh_degree", Value::Integer(degree))], format!("{} {say} little of how colours change with the direction", facts.cameras)))
}

/// What few cameras see may stand anywhere along their rays.
fn dropout(facts: &Facts) -> Option<Choice> {
    let few = facts.arrangement != Arrangement::OneCameraAnywhere && facts.arrangement != Arrangement::OneMovingCamera && facts.cameras <= FEW_CAMERAS;
    let noun = plural(facts.cameras, "camera", "cameras");
    let reason = format!("only {} {noun}: no Gaussian may be alone in explaining a pixel", facts.cameras);
    few.then(|| choice([("train.dropout", Value::Float(DROPOUT))], reason))
}

/// Opacities fall wherever a view shows a Gaussian. Those that images need recover; the others are removed.
fn decay(facts: &Facts) -> Option<Choice> {
    let fixed = matches!(facts.arrangement, Arrangement::Dome | Arrangement::Photos | Arrangement::Rig) && !stands_alone(facts);
    let are = plural(facts.cameras, "camera is", "cameras are");
    let overlap = facts.overlap.as_ref().map_or_else(String::new, |Overlap { cameras, compared, .. }| {
        format!(", the faster the fewer cameras see the same: half of what a camera sees is seen by {cameras} or more of {compared} cameras")
    });
    let reason = format!("{} {are} easily over-fitted: Gaussians that images do not need fade{overlap}", facts.cameras);
    let seen_by = facts.overlap.as_ref().map_or(usize::MAX, |overlap| overlap.cameras);
    let share = DECAYS.iter().find(|(most, _)| seen_by <= *most).map_or(DECAY, |(_, share)| *share);
    (fixed && facts.cameras <= DECAY_CAMERAS).then(|| choice([("density.decay", Value::Float(share))], reason))
}

#[cfg(test)]
mod tests;
