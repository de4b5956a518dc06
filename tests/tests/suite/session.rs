//! The library as used by a program.

use cc4dgs::{Camera, Error, Event, Orbit, RunConfig, Session, Split};
use cc4dgs_core::{Seed, Similarity, ply, resolved_device};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

fn flex() -> Session {
    Session::builder().device("flex").build().unwrap()
}

#[test]
fn a_session_trains_saves_opens_and_plays() {
    let heard = Arc::new(AtomicUsize::new(0));
    let count = heard.clone();
    let session =
        Session::builder().device("flex").on_event(move |event| _ = count.fetch_add(usize::from(matches!(event, Event::Saved { .. })), Ordering::Relaxed));
    let session = session.build().unwrap();
    let config = session.config("demo", &["train.iterations=60", "scene.background=black"]).unwrap();
    assert_eq!(config.device, "flex");
    let scene = Arc::new(session.read_scene("procedural:tiny", &config.scene).unwrap());

    // With and without a run folder the bytes are equal.
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    let model = session.train(&config, scene.clone(), Some(&run)).unwrap();
    assert!(run.join("checkpoint").is_file());
    let alone = session.train(&config, scene.clone(), None).unwrap();
    assert!(alone.gaussians == model.gaussians && alone.provenance == model.provenance);
    let refused = session.train(&config, scene.clone(), Some(&run)).err().unwrap();
    assert!(refused.to_string().contains("holds a run already"), "{refused}");
    assert!(session.resume(scene.clone(), &run).unwrap().gaussians == model.gaussians, "a finished run has nothing left to do");

    let (lower, upper) = model.bounds();
    assert!((0..3).all(|k| lower[k] < upper[k] && lower[k] > -20.0 && upper[k] < 20.0), "{lower:?} {upper:?}");

    let file = folder.path().join("model.cc4d");
    let before = heard.load(Ordering::Relaxed);
    assert_eq!(model.save(&file, "raw").unwrap(), std::fs::metadata(&file).unwrap().len());
    assert_eq!(heard.load(Ordering::Relaxed), before + 1, "saving is an event");
    let opened = session.open(&file).unwrap();
    // Codecs that use the scene are given it, and may train the model further.
    let tuned = folder.path().join("tuned.cc4d");
    let settings = "finetune = 20".parse().unwrap();
    let bytes = model.save_tuned(&tuned, "compact", &settings, "compact", &scene).unwrap();
    assert!(2 * bytes < std::fs::metadata(&file).unwrap().len() && session.open(&tuned).unwrap().gaussians.len() == model.gaussians.len());
    // Without a scene, they may have views round the model.
    let around = folder.path().join("around.cc4d");
    let on_orbit = |count: usize| model.save_on_orbit(&around, "raw", &toml::Table::new(), "fp32", count);
    assert_eq!(on_orbit(12).unwrap(), std::fs::metadata(&file).unwrap().len());
    assert!(on_orbit(5).unwrap_err().to_string().contains("12 to 512"));
    let orbit = Orbit { size: (40, 30), frames: 3, ..Orbit::default() };
    let cameras = orbit.around(&model.gaussians).unwrap();
    let (mut first, mut second) = (session.player(&model).unwrap(), session.player(&opened).unwrap());
    for (index, camera) in cameras.iter().enumerate() {
        let image = first.frame(camera, orbit.time(index)).unwrap();
        assert_eq!((image.width, image.height, image.data.len()), (40, 30, 3 * 40 * 30));
        assert!(image == second.frame(camera, orbit.time(index)).unwrap(), "a lossless archive draws the same image");
    }

    // The scene with the background that the model was trained with: black instead of the scene's own.
    let again = session.open_scene("procedural:tiny", &opened).unwrap();
    assert_eq!(again.background, Some([0.0; 3]));
    let report = session.evaluate(&opened, &again, Split::Test).unwrap();
    assert_eq!(report.psnr_db, session.evaluate(&model, &scene, Split::Test).unwrap().psnr_db);
}

#[test]
fn settings_out_of_range_are_refused_before_anything_is_written() {
    let session = flex();
    let config = session.config("demo", &["train.iterations=30"]).unwrap();
    let scene = Arc::new(session.read_scene("procedural:tiny", &config.scene).unwrap());
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    type Change = fn(&mut RunConfig);
    let changes: [(&str, Change); 3] = [
        ("train.iterations", |config| config.train.iterations = 0),
        ("train.batch", |config| config.train.batch = 0),
        ("train.smooth_delta", |config| config.train.smooth_delta = -0.1),
    ];
    for (key, change) in changes {
        let mut config = config.clone();
        change(&mut config);
        let error = session.train(&config, scene.clone(), Some(&run)).err().unwrap();
        assert!(matches!(error, Error::Parameter { .. }) && error.to_string().contains(key), "{error}");
        assert!(!run.exists(), "{key}");
    }
}

#[test]
fn key_frames_that_are_further_apart_than_the_scene_is_long_are_warned_of_with_both_numbers() {
    let heard: Arc<Mutex<Vec<String>>> = Arc::default();
    let listener = heard.clone();
    let session = Session::builder().device("flex").on_event(move |event| {
        if let Event::Warning { object, message } = event
            && object == "train.key_frames"
        {
            listener.lock().unwrap().push(message.clone());
        }
    });
    let session = session.build().unwrap();
    let config = session.config("demo", &["train.iterations=30", "train.key_frames=4000"]).unwrap();
    let scene = session.read_scene("procedural:tiny", &config.scene).unwrap();
    let expected = format!("4000 is not below the {} frames", scene.frame_count);
    session.train(&config, scene, None).unwrap();
    let heard = heard.lock().unwrap();
    assert!(heard.len() == 1 && heard[0].contains(&expected), "{heard:?}");
}

#[test]
fn a_session_names_the_device_it_took() {
    let session = Session::new().unwrap();
    let taken = session.config("demo", &[]).unwrap().device;
    assert_eq!(taken, resolved_device("auto"));
    assert_ne!(taken, "auto");
}

#[test]
fn higher_colour_coefficients_are_stepped_as_often_as_asked() {
    let session = flex();
    let rest = |every: &str| {
        let config = session.config("demo", &["train.iterations=40", "train.sh_degree=1", "train.sh_interval=1", every]).unwrap();
        let scene = Arc::new(session.read_scene("procedural:tiny", &config.scene).unwrap());
        session.train(&config, scene, None).unwrap().gaussians.sh_rest.clone()
    };
    let learned = |rest: &[f32]| rest.iter().any(|v| *v != 0.0);
    assert!(!learned(&rest("train.sh_every=1000")), "no iteration is the thousandth");
    let (each, fourth) = (rest("train.sh_every=1"), rest("train.sh_every=4"));
    assert!(learned(&each) && learned(&fourth) && each != fourth);
    assert!(
        session
            .config("demo", &["train.sh_every=0"])
            .and_then(|c| session.train(&c, Arc::new(session.read_scene("procedural:tiny", &c.scene)?), None))
            .is_err()
    );
}

#[test]
fn a_stopped_training_leaves_a_checkpoint_and_resumes() {
    let session = flex();
    let stopper = session.clone();
    let stopping = Session::builder().device("flex").on_event(move |_| stopper.stop()).build().unwrap();
    // A session stops only its own trainings.
    let config = stopping.config("demo", &["train.iterations=30"]).unwrap();
    let scene = Arc::new(stopping.read_scene("procedural:tiny", &config.scene).unwrap());
    let whole = stopping.train(&config, scene.clone(), None).unwrap();

    let folder = tempfile::tempdir().unwrap();
    let handle: Arc<std::sync::OnceLock<Session>> = Arc::default();
    let inside = handle.clone();
    let session = Session::builder().device("flex").on_event(move |event| {
        if let (Event::StageFinished { .. }, Some(session)) = (event, inside.get()) {
            session.stop();
        }
    });
    let session = session.build().unwrap();
    assert!(handle.set(session.clone()).is_ok());
    let mut result = session.train(&config, scene.clone(), Some(folder.path()));
    let mut stops = 0;
    while let Err(Error::Interrupted(_)) = result {
        stops += 1;
        assert!(stops < 10, "it never ends");
        result = session.resume(scene.clone(), folder.path());
    }
    assert!(stops > 0, "nothing was interrupted");
    assert!(result.unwrap().gaussians == whole.gaussians, "interruption changed the result");
}

#[test]
fn errors_are_sentences_however_they_are_printed() {
    let session = flex();
    for error in [
        Session::builder().device("fleks").build().err().unwrap(),
        session.open("no/such/model.cc4d").err().unwrap(),
        session.config("dmeo", &[]).err().unwrap(),
        session.config("demo", &["train.iterations=0"]).err().unwrap(),
    ] {
        assert_eq!(format!("{error:?}"), error.to_string());
        assert!(error.to_string().contains(". "), "no remedy: {error}");
    }
}

#[test]
fn a_ply_in_any_unit_looks_the_same() {
    let session = flex();
    let folder = tempfile::tempdir().unwrap();
    let original = crate::raster::scene(300, Seed::root(3));
    let image = |scale: f64| {
        let mut gaussians = original.clone();
        Similarity { scale, translation: [0.0; 3] }.apply_gaussians(&mut gaussians);
        let file = folder.path().join("model.ply");
        ply::write(&file, &gaussians, false).unwrap();
        let model = session.open(&file).unwrap();
        let camera = Orbit { size: (48, 36), frames: 1, ..Orbit::default() }.around(&model.gaussians).unwrap().remove(0);
        session.player(&model).unwrap().frame(&camera, 0.0).unwrap().data
    };
    let usual = image(1.0);
    let range = usual.iter().max().unwrap() - usual.iter().min().unwrap();
    assert!(range > 100, "the image shows nothing: its values differ by {range}");
    for scale in [1e-6, 1e-4, 1e4] {
        let worst = image(scale).iter().zip(&usual).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        assert!(worst <= 2, "scaled by {scale}: a value differs by {worst}");
    }
}

#[test]
fn players_refuse_what_cannot_be_drawn() {
    let session = flex();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("model.ply");
    ply::write(&file, &crate::raster::scene(20, Seed::root(3)), false).unwrap();
    let mut model = session.open(&file).unwrap();
    let camera = Orbit { size: (16, 12), frames: 1, ..Orbit::default() }.around(&model.gaussians).unwrap().remove(0);
    let frame = |camera: &Camera, time_norm: f32| session.player(&model).unwrap().frame(camera, time_norm).map_err(|e| e.to_string());
    assert_eq!(frame(&camera, 0.5).unwrap().data.len(), 3 * 16 * 12);
    assert!(frame(&Camera { width: 0, ..camera.clone() }, 0.5).unwrap_err().contains("image size 0x12 is empty"));
    // Nothing moves, but a time that is no number is a mistake of the program all the same.
    for time_norm in [f32::NAN, f32::INFINITY] {
        assert!(frame(&camera, time_norm).unwrap_err().contains("is not a number"));
    }
    let eye = camera.center_world();
    let nowhere = Camera::look_at("nowhere", (16, 12), 1.0, eye, eye, [0.0, 0.0, 1.0]);
    assert!(frame(&nowhere, 0.5).unwrap_err().contains("camera nowhere: a parameter is not finite"));
    // A program may change a model.
    model.gaussians.means.truncate(57);
    let refused = session.player(&model).err().unwrap().to_string();
    assert!(refused.starts_with("Gaussians to play: means has 57 values, 20 Gaussians need 60"), "{refused}");
}
