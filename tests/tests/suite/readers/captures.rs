//! `procedural:captures/NAME`: each capture has what its name promises, and its held-out images are the truth.

use super::common::*;
use cc4dgs_core::{Camera, Image8, Limits, Registry, Scene, SceneOptions, Split, conformance};
use cc4dgs_train::data::assemble;
use cc4dgs_train::data::procedural::{NAMES, ProceduralScene};
use std::collections::BTreeSet;
use std::path::Path;

fn captures() -> impl Iterator<Item = &'static str> {
    NAMES.into_iter().filter(|name| name.starts_with("captures/"))
}

fn truth(name: &str) -> ProceduralScene {
    ProceduralScene::named(&format!("captures/{name}")).unwrap()
}

fn whole(name: &str) -> Scene {
    assemble(truth(name).into_raw(name.into()), &options(), None, &Limits::default()).unwrap()
}

/// The first view of a side of the split.
fn view(scene: &Scene, split: Split) -> usize {
    scene.split(split)[0]
}

fn differences(a: &Image8, b: &Image8) -> impl Iterator<Item = f64> {
    assert_eq!((a.width, a.height), (b.width, b.height));
    a.data.iter().zip(&b.data).map(|(x, y)| f64::from(*x) - f64::from(*y))
}

fn psnr(a: &Image8, b: &Image8) -> f64 {
    let mse = differences(a, b).map(|d| d * d).sum::<f64>() / a.data.len() as f64;
    10.0 * (255.0 * 255.0 / mse.max(1e-9)).log10()
}

/// Standard deviations of the brightness of squares of 8x8 pixels.
fn contrasts(image: &Image8) -> Vec<f64> {
    let (w, h) = (image.width as usize, image.height as usize);
    let grey = |x: usize, y: usize| image.data[3 * (y * w + x)..][..3].iter().map(|v| f64::from(*v)).sum::<f64>() / 3.0;
    let square = |x: usize, y: usize| {
        let values: Vec<f64> = (0..64).map(|i| grey(x + i % 8, y + i / 8)).collect();
        let mean = values.iter().sum::<f64>() / 64.0;
        (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 64.0).sqrt()
    };
    (0..h / 8).flat_map(|y| (0..w / 8).map(move |x| (8 * x, 8 * y))).map(|(x, y)| square(x, y)).collect()
}

#[test]
fn each_has_the_views_it_promises_and_nothing_that_must_be_found() {
    // Training views, held-out views, frames, training cameras.
    let expected = [
        ("dome", 480, 60, 30, 16),
        ("rig", 720, 80, 40, 18),
        ("handheld", 120, 24, 144, 120),
        ("photos", 35, 5, 1, 35),
        ("turntable", 100, 20, 120, 100),
        ("sparse", 120, 30, 30, 4),
        ("long", 2400, 300, 300, 8),
        ("exposure", 360, 60, 30, 12),
        ("lens", 360, 60, 30, 12),
        ("units", 300, 60, 30, 10),
        ("units-km", 300, 60, 30, 10),
        ("dark", 360, 60, 30, 12),
        ("appear", 360, 60, 30, 12),
    ];
    assert_eq!(captures().collect::<Vec<_>>(), expected.map(|e| format!("captures/{}", e.0)));
    for (name, train, test, frames, cameras) in expected {
        let raw = truth(name).into_raw(name.into());
        assert!(raw.points.is_none() && raw.init_box.is_none() && raw.background.is_none(), "{name}");
        let scene = whole(name);
        let used: BTreeSet<usize> = scene.split(Split::Train).iter().map(|&v| scene.views[v].camera).collect();
        assert_eq!((scene.split(Split::Train).len(), scene.split(Split::Test).len(), scene.frame_count, used.len()), (train, test, frames, cameras), "{name}");
        // Held-out poses are poses of no training image.
        assert!(scene.split(Split::Test).iter().all(|&v| !used.contains(&scene.views[v].camera)), "{name}");
    }
    let one = |name: &str| {
        let scene = whole(name);
        (0..scene.frame_count).all(|frame| scene.views.iter().filter(|v| v.frame == frame).count() == 1)
    };
    assert!(one("handheld") && one("turntable"), "one camera per time");
}

#[test]
fn they_are_the_same_at_every_opening_and_on_any_number_of_threads() {
    for name in captures() {
        let render = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let options = SceneOptions { width: 48, ..options() };
                let scene = open(Path::new(&format!("procedural:{name}")), &options, &Limits::default()).unwrap();
                assert_eq!(scene.camera(0).width, 48);
                [Split::Train, Split::Test].map(|split| scene.frame(view(&scene, split)).unwrap().data.clone())
            })
        };
        assert_eq!(render(1), render(3), "{name}");
    }
    let registry = Registry::collect().unwrap();
    for name in ["lens", "handheld", "dark"] {
        let findings = conformance::reader(registry.reader("procedural").unwrap(), Path::new(&format!("procedural:captures/{name}")));
        assert!(findings.is_empty(), "{}", findings.join("\n"));
    }
}

#[test]
fn every_training_image_is_textured_everywhere() {
    for name in captures().map(|name| name.trim_start_matches("captures/")) {
        let scene = whole(name);
        let views = scene.split(Split::Train);
        for &v in views.iter().step_by(views.len() / 4) {
            let found = contrasts(&scene.frame(v).unwrap());
            let mean = found.iter().sum::<f64>() / found.len() as f64;
            let flat = found.iter().filter(|c| **c < 1.5).count() as f64 / found.len() as f64;
            match name {
                // Plain white around the object.
                "turntable" => assert!((0.4..0.95).contains(&flat) && mean > 3.0, "{name}, view {v}: {flat} {mean}"),
                "dark" => assert!(mean > 3.0, "{name}, view {v}: {mean}"),
                _ => assert!(mean > 9.0 && flat < 0.08, "{name}, view {v}: mean contrast {mean}, flat {flat}"),
            }
        }
    }
}

#[test]
fn what_moves_is_seen_to_move() {
    for name in captures().map(|name| name.trim_start_matches("captures/")) {
        let truth = truth(name);
        let camera = truth.cameras().pop().unwrap().0;
        let (first, last) = (truth.render(&camera, 0.1), truth.render(&camera, 0.6));
        let changed = differences(&first, &last).filter(|d| d.abs() > 12.0).count() as f64 / first.data.len() as f64;
        if name == "photos" {
            assert!(changed == 0.0 && truth.bodies.is_empty());
        } else {
            assert!((0.01..0.4).contains(&changed), "{name}: {:.1} % of the values change", 100.0 * changed);
            assert!(truth.bodies.iter().any(|b| b.name == "figure"), "{name}");
        }
    }
}

#[test]
fn seeds_change_the_room_and_bad_names_are_refused() {
    let image = |name: &str| {
        let truth = truth(name);
        truth.render(&truth.cameras()[0].0, 0.0)
    };
    assert_eq!(image("dome"), image("dome:0"));
    assert!(psnr(&image("dome"), &image("dome:1")) < 20.0 && psnr(&image("dome:1"), &image("dome:2")) < 20.0);
    let message = |name: &str| open(Path::new(&format!("procedural:{name}")), &options(), &Limits::default()).err().unwrap().to_string();
    assert!(message("captures/dom").contains("captures/dome"), "{}", message("captures/dom"));
    assert!(message("captures/").contains("captures/handheld"));
    for seed in ["x", "-1", "", "99999999999999999999", "1:2"] {
        assert!(message(&format!("captures/dome:{seed}")).contains("not a whole number"), "{seed}");
    }
}

#[test]
fn exposures_differ_by_camera_as_stated_and_held_out_images_are_the_truth() {
    for name in ["exposure", "dark", "lens"] {
        let (scene, truth) = (whole(name), truth(name));
        let v = view(&scene, Split::Test);
        let ideal = truth.render(&dataset_camera(&scene, v), f64::from(scene.views[v].time_norm));
        let found = psnr(&ideal, &scene.frame(v).unwrap());
        assert!(found > 50.0, "{name}: {found} dB");
    }
    let (scene, truth) = (whole("exposure"), truth("exposure"));
    let sensors = truth.sensors_of(&truth.viewpoints());
    let exposure = truth.sensors.exposure;
    let mut greens = Vec::new();
    for v in (0..scene.views.len()).filter(|&v| scene.views[v].frame == 0 && scene.views[v].split == Split::Train) {
        let image = scene.frame(v).unwrap();
        let ideal = truth.render(&dataset_camera(&scene, v), 0.0);
        let gain = sensors[scene.views[v].camera].gain.map(|g| g / exposure);
        for (k, gain) in gain.into_iter().enumerate() {
            // Where nothing is cut off.
            let pairs = image.data.iter().zip(&ideal.data).skip(k).step_by(3).filter(|(a, b)| **a < 250 && **b < 250);
            let (sum, of) = pairs.fold((0.0, 0.0), |s, (a, b)| (s.0 + f64::from(*a), s.1 + f64::from(*b)));
            assert!((sum / of / gain - 1.0).abs() < 0.01, "camera {}: {} where {gain} is stated", scene.camera(v).name, sum / of);
        }
        greens.push(gain[1]);
    }
    greens.sort_by(f64::total_cmp);
    assert!((greens[0] - 0.7).abs() < 1e-9 && (greens[11] - 1.4).abs() < 1e-9 && greens.windows(2).all(|p| p[1] > p[0]), "{greens:?}");
    assert!(sensors.iter().any(|s| (s.gain[0] / s.gain[1] - 1.0).abs() > 0.04), "no tint");
}

#[test]
fn noise_has_the_stated_size() {
    let (scene, truth) = (whole("dark"), truth("dark"));
    let noise = truth.sensors.noise.unwrap();
    let (mut sum, mut bias, mut count) = (0.0, 0.0, 0.0);
    for v in (0..scene.views.len()).filter(|&v| scene.views[v].frame == 3 && scene.views[v].split == Split::Train) {
        let ideal = truth.render(&dataset_camera(&scene, v), f64::from(scene.views[v].time_norm));
        for (found, ideal) in scene.frame(v).unwrap().data.iter().zip(&ideal.data).filter(|(_, ideal)| **ideal > 20) {
            // Both are rounded to whole numbers, which adds a sixth.
            let deviation = ((255.0 * noise.deviation(f64::from(*ideal) / 255.0)).powi(2) + 1.0 / 6.0).sqrt();
            let z = (f64::from(*found) - f64::from(*ideal)) / deviation;
            (sum, bias, count) = (sum + z * z, bias + z, count + 1.0);
        }
    }
    assert!(count > 1e5 && (sum / count - 1.0).abs() < 0.03 && (bias / count).abs() < 0.02, "{} {} of {count}", sum / count, bias / count);
}

#[test]
fn the_lens_is_undone() {
    let (scene, truth) = (whole("lens"), truth("lens"));
    let raw = truth.clone().into_raw("lens".into());
    let v = view(&scene, Split::Train);
    let ideal = truth.render(&dataset_camera(&scene, v), 0.0);
    let undone = psnr(&scene.frame(v).unwrap(), &ideal);
    let Some(cc4dgs_core::ImageSource::Frames { source, index }) = raw.views.iter().find(|v| v.camera == 0).map(|v| v.image.clone()) else { panic!("a frame") };
    let bent = source.load(index).unwrap();
    let straight = truth.render(&raw.cameras[0].pinhole(), 0.0);
    eprintln!("undone {undone:.1} dB, bent {:.1} dB", psnr(&bent, &straight));
    assert!(undone > 26.0 && psnr(&bent, &straight) < undone - 6.0, "{undone} dB undone, {} dB bent", psnr(&bent, &straight));
}

#[test]
fn units_are_as_stated_and_cancel() {
    let (mm, km) = (truth("units"), truth("units-km"));
    let centers = |scene: &ProceduralScene| scene.cameras().iter().map(|(c, _)| glam::DVec3::from(c.center_world())).collect::<Vec<_>>();
    let (a, b) = (centers(&mm), centers(&km));
    assert!(a.iter().all(|p| (1e5..1e6).contains(&p.abs().max_element())) && b.iter().all(|p| (1e-4..1e-2).contains(&p.length())), "{a:?} {b:?}");
    for (p, q) in a.iter().zip(&b) {
        assert!(((*p - a[0]) / 1e3 - (*q - b[0]) * 1e3).length() < 1e-6);
    }
    let (far, near) = (whole("units"), whole("units-km"));
    let of_both = |v: usize| [&far, &near].map(|scene| scene.frame(v).unwrap());
    for v in [0, far.split(Split::Test)[0]] {
        let [a, b] = of_both(v);
        assert!(psnr(&a, &b) > 45.0, "view {v}: {} dB", psnr(&a, &b));
        let (p, q): (&Camera, &Camera) = (far.camera(v), near.camera(v));
        let apart = (glam::DVec3::from(p.center_world()) - glam::DVec3::from(q.center_world())).length();
        assert!(apart < 1e-4, "normalised cameras are {apart} apart");
    }
}

/// Where cameras move, masks cover the pixels that differ from an image of the scene without its moving bodies, and no others.
#[test]
fn motion_masks_cover_what_moves() {
    for name in ["handheld", "turntable"] {
        let small = SceneOptions { width: 64, ..options() };
        let full = ProceduralScene { width: 64, height: truth(name).height * 64 / truth(name).width, ..truth(name) };
        let cast = full.bodies.iter().flat_map(|body| body.objects.clone()).collect::<BTreeSet<usize>>();
        let fixed = (0..full.objects.len()).filter(|object| !cast.contains(object)).map(|object| full.objects[object]).collect();
        let empty = ProceduralScene { objects: fixed, ..full.clone() };
        let scene = open(Path::new(&format!("procedural:captures/{name}")), &small, &Limits::default()).unwrap();
        let (mut both, mut moving, mut changed) = (0, 0, 0);
        for view in scene.split(Split::Test).into_iter().step_by(5) {
            let frame = scene.views[view].frame;
            let mask = scene.motion_mask(view).unwrap().unwrap();
            let camera = full.viewpoints().into_iter().find(|v| v.frame == Some(frame)).unwrap().camera;
            let (image, alone) = (scene.frame(view).unwrap(), empty.render(&camera, full.time(frame)));
            let differs = image.data.chunks_exact(3).zip(alone.data.chunks_exact(3)).map(|(a, b)| (0..3).any(|k| a[k].abs_diff(b[k]) > 12));
            assert_eq!(mask.len(), (image.width * image.height) as usize);
            for (moves, differs) in mask.into_iter().zip(differs) {
                both += usize::from(moves && differs);
                moving += usize::from(moves);
                changed += usize::from(differs);
            }
        }
        assert!(moving > 200 && 10 * both > 8 * moving.max(changed), "{name}: {moving} pixels move, {changed} differ, {both} do both");
    }
}

#[test]
fn nothing_moves_in_photos_and_no_mask_is_traced_through_a_lens() {
    let photos = truth("photos");
    assert!(photos.cameras().iter().all(|(camera, _)| !photos.moving_pixels(&camera.resized(40, 30), 0.0).contains(&true)));
    assert!(whole("photos").motion_mask(0).unwrap().is_none());
    // The objects of this scene move, but it has one frame.
    let still = open(Path::new("procedural:static"), &SceneOptions { width: 40, ..options() }, &Limits::default()).unwrap();
    assert!(still.motion_mask(view(&still, Split::Test)).unwrap().is_none());
    let lens = open(Path::new("procedural:captures/lens"), &SceneOptions { width: 40, ..options() }, &Limits::default()).unwrap();
    let masks = [Split::Train, Split::Test].map(|split| lens.motion_mask(view(&lens, split)).unwrap());
    assert!(masks[0].is_none() && masks[1].as_ref().unwrap().contains(&true));
}

#[test]
fn frames_can_be_finer_and_the_background_follows_the_option() {
    let finer = SceneOptions { frames: Some([0, 12, 1]), width: 40, ..options() };
    let scene = open(Path::new("procedural:captures/handheld"), &finer, &Limits::default()).unwrap();
    assert_eq!((scene.views.len(), scene.frame_count, scene.split(Split::Test).len()), (12, 12, 2));
    let black = SceneOptions { background: Some(cc4dgs_core::reader::Background::Rgb([0.0; 3])), width: 40, ..options() };
    let corner = |options: &SceneOptions| {
        let scene = open(Path::new("procedural:captures/turntable"), options, &Limits::default()).unwrap();
        scene.frame(0).unwrap().data[..3].to_vec()
    };
    assert_eq!((corner(&black), corner(&SceneOptions { width: 40, ..options() })), (vec![0; 3], vec![255; 3]));
}

#[test]
fn what_comes_and_goes_is_there_at_its_time_only() {
    let truth = truth("appear");
    let camera = truth.cameras()[0].0.clone();
    let seen = |time: f64| truth.tracer(time).objects_seen(&camera).into_iter().flatten().collect::<BTreeSet<usize>>();
    let index = |name: &str| truth.bodies.iter().find(|b| b.name == name).unwrap().objects.clone();
    let there = |name: &str, time: f64| index(name).any(|object| seen(time).contains(&object));
    let crates = (index("crate that appears").start, index("crate that vanishes").start);
    for (time, appears, vanishes) in [(0.0, false, true), (0.34, false, true), (0.36, true, true), (0.61, true, false), (1.0, true, false)] {
        assert_eq!((truth.objects[crates.0].is_there(time), truth.objects[crates.1].is_there(time)), (appears, vanishes), "{time}");
    }
    assert!(!there("crate that appears", 0.2) && there("crate that appears", 0.5), "from the first camera");
    // The figure comes from where no camera looks.
    let anywhere = |time: f64| {
        let tracer = truth.tracer(time);
        truth.cameras().iter().any(|(camera, _)| tracer.objects_seen(camera).into_iter().flatten().any(|object| index("figure").contains(&object)))
    };
    assert!(!anywhere(0.0) && anywhere(0.8));
}
