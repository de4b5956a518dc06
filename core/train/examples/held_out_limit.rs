//! How well a held-out camera of a built-in scene can be drawn from what its training cameras see, if the surfaces are known: each pixel is traced, and gets
//! the colours that the training cameras have where they see the same point. What a training reaches beyond that is guessed; what it misses is its own fault.
//!
//! `held_out_limit NAME [FRAMES]`, where NAME is a built-in scene such as `captures/units:7`, and FRAMES how many frames of each held-out camera are drawn.
#![allow(clippy::print_stdout, reason = "its output is what it is for")]

use cc4dgs_core::{Camera, Image8, Split};
use cc4dgs_train::data::procedural::{ProceduralScene, Tracer};
use glam::DVec3;
use rayon::prelude::*;

/// Cameras that are averaged.
const BLENDED: usize = 3;
/// A point is seen if the nearest surface is this near to it, as a share of the distance.
const SAME_POINT: f64 = 2e-3;
/// Frames of a training camera in which a point may be seen that is hidden at the time in question.
const OTHER_TIMES: usize = 5;

/// What training cameras see at one time.
struct Instant<'a> {
    time: f64,
    tracer: Tracer,
    eyes: Vec<(&'a Camera, Image8)>,
}

/// A pixel of a held-out camera: mean colour of the nearest training cameras, of the nearest alone, and the angle to that in degrees.
struct Guess {
    blended: [f64; 3],
    nearest: [f64; 3],
    angle: f64,
}

/// Sums over pixels.
#[derive(Clone, Copy, Default)]
struct Sums {
    pixels: f64,
    unseen: f64,
    /// Seen from more than 30 and 60 degrees away only.
    far: [f64; 2],
    /// Squared errors of the blend and of the nearest camera, unseen pixels apart.
    blended: f64,
    nearest: f64,
    /// Squared error of the mean colour on unseen pixels.
    mean: f64,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let name = arguments.first().map_or("default", String::as_str);
    let name = name.strip_prefix("procedural:").unwrap_or(name);
    let frames: usize = arguments.get(1).map_or(Ok(3), |n| n.parse())?;
    let scene = ProceduralScene::named(name)?;
    let viewpoints = scene.viewpoints();
    let every = |count: usize, i: usize| if count > 1 { i * (scene.frames - 1) / (count - 1) } else { 0 };
    let instant = |frame: usize| {
        let time = scene.time(frame);
        let takes = viewpoints.iter().filter(|v| v.split == Split::Train && v.frame.is_none_or(|own| own == frame));
        Instant { time, tracer: scene.tracer(time), eyes: takes.map(|v| (&v.camera, scene.render(&v.camera, time))).collect() }
    };
    let moving = viewpoints.iter().any(|v| v.frame.is_some());
    let count = if moving { scene.frames } else { OTHER_TIMES.min(scene.frames) };
    let others: Vec<Instant> = (0..count).map(|i| instant(every(count, i))).collect();
    println!("{name}: PSNR in dB with known surfaces: mean of {BLENDED} cameras / nearest camera / mean, without unseen pixels;");
    println!("  share of the pixels unseen, seen from over 30, and over 60 degrees away only");
    let mut all = Vec::new();
    for viewpoint in viewpoints.iter().filter(|v| v.split == Split::Test) {
        let taken: Vec<usize> = match viewpoint.frame {
            Some(own) => vec![own],
            None => (0..frames.min(scene.frames)).map(|i| every(frames.min(scene.frames), i)).collect(),
        };
        let mut of_camera = Vec::new();
        for frame in taken {
            let now = instant(frame);
            of_camera.push(compare(&scene, &viewpoint.camera, &now, &others));
        }
        if !moving {
            println!("  {:<12} {}", viewpoint.camera.name, describe(&of_camera));
        }
        all.extend(of_camera);
    }
    println!("  {:<12} {}", "all", describe(&all));
    Ok(())
}

fn describe(images: &[Sums]) -> String {
    let n = images.len().max(1) as f64;
    let psnr = |error: &dyn Fn(&Sums) -> f64| images.iter().map(|s| -10.0 * (error(s) / 3.0).max(1e-10).log10()).sum::<f64>() / n;
    let share = |part: &dyn Fn(&Sums) -> f64| 100.0 * images.iter().map(|s| part(s) / s.pixels).sum::<f64>() / n;
    format!(
        "{:.2} / {:.2} / {:.2} dB; {:.1} %, {:.1} %, {:.1} %",
        psnr(&|s| (s.blended + s.mean) / s.pixels),
        psnr(&|s| (s.nearest + s.mean) / s.pixels),
        psnr(&|s| s.blended / (s.pixels - s.unseen).max(1.0)),
        share(&|s| s.unseen),
        share(&|s| s.far[0]),
        share(&|s| s.far[1])
    )
}

fn compare(scene: &ProceduralScene, camera: &Camera, now: &Instant, others: &[Instant]) -> Sums {
    let truth = scene.render(camera, now.time);
    let mean = mean_colour(now.eyes.iter().chain(others.iter().flat_map(|o| &o.eyes)).map(|(_, image)| image));
    let error = |a: [f64; 3], b: [f64; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>();
    let of_pixel = |i: u32| {
        let (x, y) = (i % camera.width, i / camera.width);
        let at = (y * camera.width + x) as usize * 3;
        let is = [0, 1, 2].map(|k| f64::from(truth.data[at + k]) / 255.0);
        let mut sums = Sums { pixels: 1.0, ..Sums::default() };
        match guess(scene, camera, [f64::from(x) + 0.5, f64::from(y) + 0.5], now, others) {
            Some(guess) => {
                sums.far = [30.0, 60.0].map(|limit| f64::from(u8::from(guess.angle > limit)));
                (sums.blended, sums.nearest) = (error(guess.blended, is), error(guess.nearest, is));
            }
            None => (sums.unseen, sums.mean) = (1.0, error(mean, is)),
        }
        sums
    };
    let add = |a: Sums, b: Sums| Sums {
        pixels: a.pixels + b.pixels,
        unseen: a.unseen + b.unseen,
        far: [a.far[0] + b.far[0], a.far[1] + b.far[1]],
        blended: a.blended + b.blended,
        nearest: a.nearest + b.nearest,
        mean: a.mean + b.mean,
    };
    (0..camera.width * camera.height).into_par_iter().map(of_pixel).reduce(Sums::default, add)
}

fn guess(scene: &ProceduralScene, camera: &Camera, [u, v]: [f64; 2], now: &Instant, others: &[Instant]) -> Option<Guess> {
    let (rotation, _) = camera.rotation_translation();
    let eye = DVec3::from(camera.center_world());
    let local = DVec3::new((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0);
    let direction = (rotation.transpose() * local).normalize();
    let Some(hit) = now.tracer.hit(eye, direction) else {
        let background = scene.background.map(f64::from);
        return Some(Guess { blended: background, nearest: background, angle: 0.0 });
    };
    let is_still = scene.objects[hit.object].motion.is_still();
    let seen_at = |instant: &Instant, found: &mut Vec<(f64, [f64; 3])>| {
        let point = if is_still || instant.time == now.time { hit.point } else { scene.advect(hit.object, hit.point, now.time, instant.time) };
        for (other, image) in &instant.eyes {
            let (rotation, translation) = other.rotation_translation();
            let p = rotation * point + translation;
            let (u, v) = (other.fx * p.x / p.z + other.cx, other.fy * p.y / p.z + other.cy);
            if p.z <= 0.0 || u < 0.5 || v < 0.5 || u > f64::from(other.width) - 0.5 || v > f64::from(other.height) - 0.5 {
                continue;
            }
            let from = DVec3::from(other.center_world());
            let distance = from.distance(point);
            let sees = instant.tracer.hit(from, (point - from) / distance);
            if sees.is_some_and(|seen| seen.object == hit.object && (seen.distance / distance - 1.0).abs() < SAME_POINT) {
                let angle = (from - point).angle_between(eye - hit.point).to_degrees();
                found.push((angle, bilinear(image, u - 0.5, v - 0.5)));
            }
        }
    };
    let mut found = Vec::new();
    seen_at(now, &mut found);
    if found.is_empty() {
        others.iter().for_each(|instant| seen_at(instant, &mut found));
    }
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    found.truncate(BLENDED);
    let &(angle, nearest) = found.first()?;
    let weight = |angle: f64| 1.0 / (angle + 1.0);
    let total: f64 = found.iter().map(|f| weight(f.0)).sum();
    let blended = [0, 1, 2].map(|k| found.iter().map(|f| weight(f.0) * f.1[k]).sum::<f64>() / total);
    Some(Guess { blended, nearest, angle })
}

/// The colour at `(x, y)`, where pixel centres have whole coordinates.
fn bilinear(image: &Image8, x: f64, y: f64) -> [f64; 3] {
    let (w, h) = (image.width as usize, image.height as usize);
    let (left, top) = ((x.max(0.0) as usize).min(w - 1), (y.max(0.0) as usize).min(h - 1));
    let (right, bottom) = ((left + 1).min(w - 1), (top + 1).min(h - 1));
    let (fx, fy) = (x - left as f64, y - top as f64);
    let at = |x: usize, y: usize, k: usize| f64::from(image.data[(y * w + x) * 3 + k]) / 255.0;
    [0, 1, 2].map(|k| {
        let upper = at(left, top, k) * (1.0 - fx) + at(right, top, k) * fx;
        let lower = at(left, bottom, k) * (1.0 - fx) + at(right, bottom, k) * fx;
        upper * (1.0 - fy) + lower * fy
    })
}

fn mean_colour<'a>(images: impl Iterator<Item = &'a Image8>) -> [f64; 3] {
    let (mut sums, mut pixels) = ([0.0; 3], 0.0);
    for image in images {
        for pixel in image.data.chunks_exact(3) {
            (0..3).for_each(|k| sums[k] += f64::from(pixel[k]) / 255.0);
            pixels += 1.0;
        }
    }
    sums.map(|sum: f64| sum / f64::max(pixels, 1.0))
}
