//! Where the first points of a scene come from, how long it takes, and, for built-in scenes, how many lie on a surface.
//!
//! `init_points SCENE [SOURCE [COUNT [WIDTH]]]`, where SOURCE is `auto`, `photo`, `hull` or `random`.
#![allow(clippy::print_stdout, reason = "its output is what it is for")]

use cc4dgs_core::{Limits, Registry, Scene, SceneOptions, Seed, Split};
use cc4dgs_train::config::InitSource;
use cc4dgs_train::data::init::{FoundPoints, find_points};
use cc4dgs_train::data::open;
use cc4dgs_train::data::procedural::{ProceduralScene, name_of};
use glam::DVec3;
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let argument = |i: usize, default: &str| arguments.get(i).cloned().unwrap_or_else(|| default.into());
    let path = argument(0, "procedural");
    let source = match argument(1, "auto").as_str() {
        "photo" => InitSource::Photo,
        "hull" => InitSource::Hull,
        "random" => InitSource::Random,
        _ => InitSource::Auto,
    };
    let (count, width) = (argument(2, "20000").parse()?, argument(3, "0").parse()?);
    let options = SceneOptions { width, ..Default::default() };
    let scene = open(Path::new(&path), &options, &Registry::collect()?, &Limits::default())?;
    let start = std::time::Instant::now();
    let found = find_points(&scene, source, count, Seed::root(0))?;
    println!("{path}: {} in {:.1} s", found.describe(), start.elapsed().as_secs_f64());
    if let Some(name) = name_of(Path::new(&path)) {
        let truth = ProceduralScene::named(name)?;
        let mut first = 0;
        let kinds = [("matched", found.matched), ("between", found.between), ("hull", found.hull), ("guessed", found.guessed), ("random", found.random)];
        for (kind, n) in kinds.into_iter().filter(|k| k.1 > 0) {
            let errors = errors(&scene, &truth, &found, first..first + n);
            let share = |most: f64| 100.0 * errors.iter().filter(|e| **e < most).count() as f64 / n as f64;
            let shares = [0.002, 0.005, 0.01, 0.02, 0.05].map(|most| format!("{} % {:.1}", 100.0 * most, share(most)));
            println!("  {kind}: within {} % of {n}", shares.join(", "));
            first += n;
        }
    }
    Ok(())
}

/// Per point, how far the surface that a training camera sees there is from it, as a share of its distance; the least over some views.
fn errors(scene: &Scene, truth: &ProceduralScene, found: &FoundPoints, rows: std::ops::Range<usize>) -> Vec<f64> {
    let views = scene.split(Split::Train);
    let views: Vec<usize> = (0..24).map(|i| views[i * views.len() / 24]).collect();
    let back = scene.normalisation.inverse();
    let eyes: Vec<_> = views.iter().map(|&v| (back.apply_camera(scene.camera(v)), truth.tracer(f64::from(scene.views[v].time_norm)))).collect();
    rows.map(|row| {
        let p = DVec3::from(back.apply(found.cloud.positions[row].map(f64::from)));
        let seen = eyes.iter().filter_map(|(camera, tracer)| {
            let (r, t) = camera.rotation_translation();
            let c = r * p + t;
            let (u, v) = (camera.fx * c.x / c.z + camera.cx, camera.fy * c.y / c.z + camera.cy);
            let inside = c.z > 0.0 && u >= 0.0 && v >= 0.0 && u <= f64::from(camera.width) && v <= f64::from(camera.height);
            let eye = DVec3::from(camera.center_world());
            let distance = eye.distance(p);
            inside.then(|| tracer.hit(eye, (p - eye) / distance)).flatten().map(|hit| (hit.distance / distance - 1.0).abs())
        });
        seen.fold(f64::INFINITY, f64::min)
    })
    .collect()
}
