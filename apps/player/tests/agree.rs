//! Images of the player against those of the tile renderer, of a small model trained here and baked.
#![allow(clippy::unwrap_used)]

use cc4dgs::core::metrics::{Metric, Rounding};
use cc4dgs::core::{Limits, Silent, StoredModel};
use cc4dgs::play::bake::MaxError;
use cc4dgs::play::player::FrameOptions;
use cc4dgs::playable::{PlayableOptions, Storage, Stored, Surroundings};
use cc4dgs::{Camera, Orbit, Session};
use cc4dgs_player::{Content, Mode, Renderer, View, request_device};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

const TIMES: [f32; 3] = [0.0, 0.37, 1.0];
/// Decibels of agreement that are asked for, and iterations that train a model good enough to tell images apart.
const LEAST_DB: f64 = 45.0;
const ITERATIONS: usize = 300;

/// A renderer without a window; `None` where there is no adapter and none is required.
fn renderer() -> Option<Renderer> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    match pollster::block_on(request_device(&instance, None)) {
        Ok((_, device, queue)) => Some(Renderer::new(device, queue, wgpu::TextureFormat::Rgba8Unorm)),
        Err(e) if std::env::var_os("CC4DGS_REQUIRE_WGPU").is_some() => panic!("{e}"),
        Err(_) => None,
    }
}

fn cameras(session: &Session, path: &Path) -> Vec<Camera> {
    let model = session.open(path).unwrap();
    let all = Orbit { size: (300, 220), frames: 5, ..Orbit::default() }.around(&model.gaussians).unwrap();
    vec![all[0].clone(), all[2].clone()]
}

/// An archive of a small trained model with the deformer that `overrides` choose: with a playback layer, whose error over its bound is returned, or with the
/// deformer's weights alone.
fn archive(session: &Session, folder: &Path, overrides: &[&str], baked: bool) -> (PathBuf, Option<f32>) {
    let iterations = format!("train.iterations={ITERATIONS}");
    let overrides: Vec<&str> = overrides.iter().copied().chain([iterations.as_str(), "train.dynamic=all", "train.checks=false"]).collect();
    let config = session.config("demo", &overrides).unwrap();
    let scene = session.read_scene("procedural:tiny", &config.scene).unwrap();
    let model = session.train(&config, scene, None).unwrap();
    let (plain, out) = (folder.join("plain.cc4d"), folder.join("baked.cc4d"));
    model.save(&plain, "quantize:high").unwrap();
    let stop = AtomicBool::new(false);
    let around = Surroundings::of(session, &stop);
    let stored = Stored::open(&plain, Storage::default(), around).unwrap();
    let presentation = stored.presentation(&[], None).unwrap();
    let options = PlayableOptions { max_error: Some(MaxError::Pixels(0.1)), cameras: &[], presentation, poster: false, without_field: false, baked };
    let playable = stored.playable(options, around).unwrap();
    std::fs::write(&out, playable.bytes).unwrap();
    if !baked {
        let played = StoredModel::open(&out, &Limits::default(), &Silent).unwrap().playback;
        assert!(played.is_some() && stored.computed_motion(around).unwrap() == played, "players compute another motion from the file");
    }
    (out, playable.report.map(|report| report.at_samples))
}

fn agrees(deformer: &[&str], with_layer: bool) {
    let Some(mut renderer) = renderer() else { return };
    let folder = tempfile::tempdir().unwrap();
    let session = Session::builder().device("flex").build().unwrap();
    let (path, error) = archive(&session, folder.path(), deformer, with_layer);
    assert_eq!(error.is_some(), with_layer);
    assert!(error.is_none_or(|error| error <= 1.0), "the layer is off by {error:?} of its bound");
    let content = Content::read("model", std::fs::read(&path).unwrap(), &Limits::default()).unwrap();
    assert!(content.scene.moving > 0 && !content.lacks_motion && content.presentation.home.is_some());
    renderer.load(content.scene).unwrap();
    let model = session.open(&path).unwrap();
    let mut player = session.player(&model).unwrap();
    let (mut least, mut motion) = (f64::INFINITY, f64::INFINITY);
    for camera in cameras(&session, &path) {
        let mut first = None;
        for time in TIMES {
            let wanted = player.frame(&camera, time).unwrap();
            let found = renderer.image(&View::new(camera.clone(), time)).unwrap();
            let psnr = Metric::psnr(Rounding::EightBit);
            least = least.min(psnr.score_images(&wanted, &found).unwrap());
            let first = first.get_or_insert_with(|| wanted.clone());
            if time > 0.0 {
                motion = motion.min(psnr.score_images(first, &wanted).unwrap());
            }
            assert_eq!(found.data, renderer.image(&View::new(camera.clone(), time)).unwrap().data, "equal frames are equal bytes");
        }
    }
    // The options that both renderers have mean the same.
    let options = FrameOptions { sh_degree: 0, scale: 0.6 };
    let camera = cameras(&session, &path).remove(0);
    let wanted = player.frame_as(&camera, 0.37, options).unwrap();
    let found = renderer.image(&View { sh_degree: options.sh_degree, scale: options.scale, ..View::new(camera.clone(), 0.37) }).unwrap();
    let psnr = Metric::psnr(Rounding::EightBit);
    least = least.min(psnr.score_images(&wanted, &found).unwrap());
    assert!(psnr.score_images(&wanted, &player.frame(&camera, 0.37).unwrap()).unwrap() < LEAST_DB - 5.0, "the options change nothing");
    assert!(player.frame_as(&camera, 0.37, FrameOptions { scale: f32::NAN, ..options }).is_err());
    assert!(least >= LEAST_DB, "{deformer:?}: {least:.1} dB between player and tile renderer");
    // The images differ over time by much more than the renderers do, so agreement says something about motion.
    assert!(motion < LEAST_DB - 5.0, "{deformer:?}: hardly anything moves ({motion:.1} dB)");
}

#[test]
fn images_of_a_field_that_is_linear_in_its_functions_agree() {
    agrees(&["deformer.kind=cdf-basis"], true);
}

#[test]
fn images_of_motion_that_is_computed_from_weights_agree() {
    // The images compared are larger than this focal length, and blur more.
    agrees(&["deformer.kind=cdf-basis", "render.focal=100.0"], false);
    agrees(&["deformer.kind=hash-basis"], false);
}

#[test]
fn images_of_gaussians_that_appear_and_vanish_agree() {
    agrees(&["deformer.kind=native-4d"], true);
}

#[test]
fn options_change_what_is_drawn() {
    let Some(mut renderer) = renderer() else { return };
    let mut gaussians = cc4dgs::HostGaussians {
        means: vec![0.0, 0.0, 0.0, 0.0, 0.6, 0.0],
        log_scales: vec![-2.0; 6],
        quaternions: [1.0, 0.0, 0.0, 0.0].repeat(2),
        opacity_logits: vec![3.0; 2],
        sh_dc: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        dynamic_scores: vec![0.0; 2],
        ..Default::default()
    };
    let camera = Camera::look_at("t", (64, 48), 0.8, [3.0, 0.0, 0.0], [0.0; 3], [0.0, 0.0, 1.0]);
    let bytes = cc4dgs::core::ply::to_bytes(&gaussians, true).unwrap();
    renderer.load(Content::read("two.ply", bytes, &Limits::default()).unwrap().scene).unwrap();
    let plain = View::new(camera.clone(), 0.0);
    let image = renderer.image(&plain).unwrap();
    let light = |data: &[u8]| data.iter().map(|v| u64::from(*v)).sum::<u64>();
    assert!(light(&image.data) > 10_000);
    assert!(light(&renderer.image(&View { scale: 0.5, ..plain.clone() }).unwrap().data) < light(&image.data));
    assert_ne!(renderer.image(&View { mode: Mode::Depth, ..plain.clone() }).unwrap().data, image.data);
    assert_eq!(renderer.image(&View { tint: true, ..plain.clone() }).unwrap().data, image.data, "nothing moves, so nothing is tinted");
    assert!(light(&renderer.image(&View { background: Some([1.0; 3]), ..plain.clone() }).unwrap().data) > light(&image.data));
    // Gaussians that are far away, behind the camera, or of size and rotation zero are no harm.
    gaussians.means = vec![1e30, 0.0, 0.0, 9.0, 0.0, 0.0];
    gaussians.quaternions[0] = 0.0;
    let bytes = cc4dgs::core::ply::to_bytes(&gaussians, true).unwrap();
    renderer.load(Content::read("two.ply", bytes, &Limits::default()).unwrap().scene).unwrap();
    assert_eq!(light(&renderer.image(&plain).unwrap().data), 0);
    renderer.unload();
    assert_eq!(light(&renderer.image(&plain).unwrap().data), 0);
}

#[test]
fn footprints_along_the_axes_of_the_image_are_drawn_whole() {
    let Some(mut renderer) = renderer() else { return };
    // Columns of the image are along the world's y, rows along its z.
    let camera = Camera::look_at("t", (200, 100), 0.8, [3.0, 0.0, 0.0], [0.0; 3], [0.0, 0.0, 1.0]);
    let log_scale = |sigma_px: f64| (sigma_px * 3.0 / camera.fx).ln() as f32;
    for step in 0..60 {
        // The square of the width is just below a power of two, and over it with that of the height: there sums are rounded most.
        let width_px = 30.0 + 0.03 * f64::from(step);
        let gaussians = cc4dgs::HostGaussians {
            means: vec![0.0; 3],
            log_scales: vec![-9.0, log_scale(width_px), log_scale(15.0)],
            quaternions: vec![1.0, 0.0, 0.0, 0.0],
            opacity_logits: vec![3.0],
            sh_dc: vec![1.77; 3],
            dynamic_scores: vec![0.0],
            ..Default::default()
        };
        let bytes = cc4dgs::core::ply::to_bytes(&gaussians, true).unwrap();
        renderer.load(Content::read("one.ply", bytes, &Limits::default()).unwrap().scene).unwrap();
        let image = renderer.image(&View::new(camera.clone(), 0.0)).unwrap();
        // Two standard deviations from the middle: exp(-2) of white.
        let found = image.data[3 * (50 * 200 + 100 + (2.0 * width_px) as usize)];
        assert!((25..45).contains(&found), "{width_px} pixels wide: {found}");
    }
}

/// A renderer as [`renderer`] makes one, on a device with buffers of 131,072 bytes at most.
fn small_renderer() -> Option<Renderer> {
    renderer()?;
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let adapter = pollster::block_on(instance.request_adapter(&Default::default())).unwrap();
    let required_limits = wgpu::Limits { max_storage_buffer_binding_size: 1 << 17, ..Default::default() };
    let small = wgpu::DeviceDescriptor { required_limits, ..Default::default() };
    let (device, queue) = pollster::block_on(adapter.request_device(&small)).unwrap();
    Some(Renderer::new(device, queue, wgpu::TextureFormat::Rgba8Unorm))
}

#[test]
fn harmonics_that_no_buffer_holds_are_drawn_up_to_the_degree_that_fits() {
    let (Some(mut small), Some(mut large)) = (small_renderer(), renderer()) else { return };
    // At degree 3 the harmonics take 184,000 bytes, at degree 2 they take 96,000.
    let n = 2000;
    let gaussians = cc4dgs::HostGaussians {
        sh_degree: 3,
        means: [0.0, 0.1, 0.2].repeat(n),
        log_scales: vec![-2.0; 3 * n],
        quaternions: [1.0, 0.0, 0.0, 0.0].repeat(n),
        opacity_logits: vec![3.0; n],
        sh_dc: vec![0.5; 3 * n],
        sh_rest: (0..45).map(|k| 0.02 * k as f32).collect::<Vec<f32>>().repeat(n),
        dynamic_scores: vec![0.0; n],
        ..Default::default()
    };
    let bytes = cc4dgs::core::ply::to_bytes(&gaussians, true).unwrap();
    let content = || Content::read("n.ply", bytes.clone(), &Limits::default()).unwrap();
    assert!(small.load(content().scene).is_err(), "the buffers are not small enough to say anything");
    let mut fitted = content();
    fitted.fit_harmonics(small.most_words(), "a buffer", "Use another device");
    assert!(fitted.remarks.len() == 1 && fitted.remarks[0].contains("degree 2 of 3"), "{:?}", fitted.remarks);
    small.load(fitted.scene).unwrap();
    large.load(content().scene).unwrap();
    let view = View::new(Camera::look_at("t", (64, 48), 0.8, [3.0, 0.0, 0.0], [0.0; 3], [0.0, 0.0, 1.0]), 0.0);
    let found = small.image(&view).unwrap().data;
    assert_eq!(found, large.image(&View { sh_degree: 2, ..view.clone() }).unwrap().data);
    assert_ne!(found, large.image(&view).unwrap().data, "degree 3 changes nothing");
    // Those of all degrees, which arrive later, are cut down to the same.
    small.load_harmonics(&gaussians).unwrap();
    assert_eq!(found, small.image(&view).unwrap().data);
}

#[test]
fn a_model_that_the_device_refuses_leaves_the_one_before() {
    let Some(mut renderer) = small_renderer() else { return };
    let scene = |n: usize| {
        let gaussians = cc4dgs::HostGaussians {
            means: [0.0, 0.1, 0.2].repeat(n),
            log_scales: vec![-2.0; 3 * n],
            quaternions: [1.0, 0.0, 0.0, 0.0].repeat(n),
            opacity_logits: vec![3.0; n],
            sh_dc: vec![1.0; 3 * n],
            dynamic_scores: vec![0.0; n],
            ..Default::default()
        };
        Content::read("n.ply", cc4dgs::core::ply::to_bytes(&gaussians, true).unwrap(), &Limits::default()).unwrap().scene
    };
    let view = View::new(Camera::look_at("t", (64, 48), 0.8, [3.0, 0.0, 0.0], [0.0; 3], [0.0, 0.0, 1.0]), 0.0);
    renderer.load(scene(2)).unwrap();
    let before = renderer.image(&view).unwrap();
    assert!(before.data.iter().any(|v| *v > 100));
    // 64 bytes each, so 2,048 fit.
    let message = renderer.load(scene(2049)).unwrap_err().to_string();
    assert!(message.contains("131072") && message.contains("2048"), "{message}");
    assert_eq!((renderer.scene().map(|s| s.count), renderer.image(&view).unwrap().data == before.data), (Some(2), true));
    renderer.load(scene(2048)).unwrap();
}
