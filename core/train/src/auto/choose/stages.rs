//! The stages of a plan: their lengths, what moves, and rates of positions.

use super::{Choice, Machine, all_move, choice, is_short, rate, stands_alone, stands_still};
use crate::auto::facts::{Arrangement, Facts};
use toml::Value;

/// Share of a short run with smaller images, whose iterations take a fraction of the time: 0.9 dB on mutant in ten minutes of one thread, 0.2 on basketball in
/// five, 0.3 on its five times as many frames in twenty. In ten, the former gains nothing more, and a long run of mutant with 100,000 Gaussians got worse while
/// its images were small.
const IMAGE_GROWTH: f64 = 0.5;
/// Frames that are learned in such a run, and up to how many times as many make it longer: more have not been tried.
const FRAMES: f64 = 30.0;
const MOST_TIMES: f64 = 5.0;
/// Weight of strain where one camera at a time sees everything move, from unrelated poses: 0.3 dB on mutant.
const STRAIN: f64 = 0.03;
/// Up to so many Gaussians, means learn at their full rate. With 86,000 and more, training views of mutant got worse for a thousand iterations.
const FULL_RATE_GAUSSIANS: f64 = 15_000.0;

/// Factor of the learning rate of means for so many Gaussians: their size falls with the root of their number, and a step stays the same share of it.
pub(super) fn slower(gaussians: f64) -> f64 {
    (FULL_RATE_GAUSSIANS / gaussians).sqrt().min(1.0)
}

pub(super) fn stages(facts: &Facts, machine: Machine, minutes: f64, most: f64, key_frames: Option<usize>) -> Choice {
    let shares = |shares: [f64; 3]| Value::Array(shares.map(Value::Float).to_vec());
    let slower = if all_move(facts) { slower(most) } else { 1.0 };
    let growth = if small_images_pay(facts, machine, minutes) { IMAGE_GROWTH } else { 0.0 };
    let (mut settings, reason) = match facts.arrangement {
        _ if stands_still(facts) => (vec![("train.shares", shares([1.0, 0.0, 4.0])), ("train.coarse_frames", "all".into())], "a static scene".to_string()),
        Arrangement::OneMovingCamera if !stands_alone(facts) => (
            vec![("train.shares", shares([5.0, 2.0, 18.0])), ("train.coarse_frames", "all".into()), ("train.dynamic", "score".into())],
            "one moving camera: all frames come at once, and what a static reconstruction does not explain may move".into(),
        ),
        Arrangement::OneMovingCamera | Arrangement::OneCameraAnywhere => (
            vec![
                ("train.shares", shares([2.0, 0.0, 18.0])),
                ("train.coarse_frames", "all".into()),
                ("train.dynamic", "all".into()),
                ("train.recover", Value::Boolean(true)),
                // Short runs end before what moves has its shape and colour: 0.35 dB on mutant after 2,000 iterations against the published rates.
                ("train.lr.means", rate(3.2e-4 * slower)),
                ("train.lr.log_scales", Value::Float(1e-2)),
                ("train.lr.sh_rest", Value::Float(5e-4)),
                ("train.strain", Value::Float(if facts.arrangement == Arrangement::OneCameraAnywhere { STRAIN } else { 0.0 })),
                ("train.image_growth", Value::Float(growth)),
            ],
            format!("{}: all frames come at once, everything may move, and what crosses the scene is looked for", facts.arrangement.describe()),
        ),
        Arrangement::Photos | Arrangement::Dome | Arrangement::Rig => {
            // Lives need neither frames that come one after another nor a smooth function of space.
            let (ramp, smooth) = match key_frames {
                Some(_) => (0.0, 0.0),
                None => (0.4, if facts.frames < 12 { 0.0 } else { 0.05 }),
            };
            (
                vec![
                    ("train.shares", shares([5.0, 3.0, 20.0])),
                    ("train.coarse_frames", "first".into()),
                    ("train.dynamic", "auto".into()),
                    ("train.time_ramp", Value::Float(ramp)),
                    ("train.lambda_r", Value::Float(smooth)),
                    ("train.image_growth", Value::Float(growth)),
                ],
                format!("{} training cameras, {}: the first frame, then what moves", facts.cameras, facts.arrangement.describe()),
            )
        }
    };
    // Positions still settle at the end of a short run: 0.3 dB on two built-in captures against a rate that falls a hundredfold.
    settings.push(("train.lr.means_end", rate(1.6e-5 * slower)));
    choice(settings, reason)
}

/// Whether a run of a moving scene begins with smaller images: several cameras have more to learn in the same time where there are more frames.
fn small_images_pay(facts: &Facts, machine: Machine, minutes: f64) -> bool {
    let times = if facts.arrangement.has_several_cameras() { (facts.frames as f64 / FRAMES).clamp(1.0, MOST_TIMES) } else { 1.0 };
    // What stands still is learned once.
    is_short(machine, minutes / times.sqrt())
}
