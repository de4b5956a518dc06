//! `cc4dgs export` as a process, and what readers written from the formats' descriptions find in its files.
#![allow(clippy::unwrap_used, reason = "a test that meets an error should stop there, in helpers too")]

#[path = "../common/mod.rs"]
mod common;
mod read;

use cc4dgs::core::archive::{Archive, StreamKind};
use cc4dgs::exporters::web::{PAGE_FILES, PAGE_VERSION};
use cc4dgs::{HostGaussians, Image8, Model, Orbit, Session};
use common::{fail, json_of, succeed, text};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A small model that moves by `deformer` and whose harmonics have degree `sh_degree`.
fn train(out: &Path, deformer: &str, sh_degree: usize) {
    let preset = format!("demo+{deformer}");
    let degree = format!("train.sh_degree={sh_degree}");
    let sets = ["train.iterations=300", "train.checkpoint_every=0", "train.dynamic=all", "density.kind=none", degree.as_str()];
    let mut args = vec!["train", "--scene", "procedural:tiny", "--preset", &preset, "--device", "flex", "--out", text(out), "-q"];
    args.extend(sets.iter().flat_map(|set| ["--set", set]));
    succeed(&args);
}

/// Draws the model, and other Gaussians (in the dataset's coordinates) with the same cameras.
struct Judge {
    session: Session,
    run: PathBuf,
    model: Model,
}

impl Judge {
    fn new(run: &Path) -> Self {
        let session = Session::builder().device("flex").build().unwrap();
        Self { model: session.open(run).unwrap(), session, run: run.to_path_buf() }
    }
    fn images(&self, model: &Model, time: f32) -> Vec<Image8> {
        let orbit = Orbit { size: (96, 72), frames: 3, ..Orbit::default() };
        let cameras = orbit.around(&self.model.gaussians).unwrap();
        let mut player = self.session.player(model).unwrap();
        cameras.iter().map(|camera| player.frame(camera, time).unwrap()).collect()
    }
    /// PSNR in dB of `gaussians` against the model at `time`; `None` is the canonical model.
    fn psnr(&self, mut gaussians: HostGaussians, time: Option<f32>) -> f64 {
        let standing_in = |gaussians: HostGaussians| {
            let mut other = self.session.open(&self.run).unwrap();
            (other.gaussians, other.field) = (gaussians, None);
            other
        };
        self.model.normalisation.apply_gaussians(&mut gaussians);
        let found = self.images(&standing_in(gaussians), 0.0);
        let expected = match time {
            Some(time) => self.images(&self.model, time),
            None => self.images(&standing_in(self.model.gaussians.clone()), 0.0),
        };
        let squares = expected.iter().zip(&found).flat_map(|(a, b)| a.data.iter().zip(&b.data)).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2));
        let (sum, count) = squares.fold((0.0, 0.0), |(sum, count), square| (sum + square, count + 1.0));
        10.0 * (255.0f64.powi(2) * count / f64::max(sum, 0.25)).log10()
    }
}

#[test]
fn formats_hold_what_the_model_draws() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (dir, flat) = (at("run"), at("flat"));
    train(&dir, "cdf-basis", 2);
    train(&flat, "native-4d", 0);
    let judge = Judge::new(&dir);
    let export = |model: &Path, format: &str, name: &str, more: &[&str]| -> (PathBuf, Value) {
        let out = at(name);
        let mut args = vec!["export", format, text(model), "--out", text(&out), "--device", "flex", "-q", "--json"];
        args.extend(more);
        let report = json_of(&args);
        assert!(report["lost"].as_str().unwrap().ends_with('.') && report["format"] == format, "{report}");
        (out, report)
    };
    let (_, report) = export(&dir, "ply", "a.ply", &[]);
    assert!(report["lost"].as_str().unwrap().contains("motion"), "{report}");
    // At an instant and canonical; the bound is what the format allows.
    for (format, extension, least) in [("ply", "ply", 70.0), ("gltf", "glb", 70.0), ("spz", "spz", 45.0), ("sog", "sog", 45.0)] {
        for time in [None, Some(0.5f32)] {
            let name = format!("{format}-{}.{extension}", time.is_some());
            let (path, _) = export(&dir, format, &name, if time.is_some() { &["--time", "0.5"] } else { &[] });
            let psnr = judge.psnr(read::any(&path), time);
            eprintln!("{format} at {time:?}: {psnr:.1} dB");
            assert!(psnr >= least, "{format} at {time:?}: {psnr} dB");
        }
    }
    let (path, _) = export(&dir, "spz", "old.spz", &["--set", "version=3"]);
    assert!(judge.psnr(read::any(&path), None) >= 45.0);
    // A sequence is the model at the times of its frames, from the first, 0, to the last, 1.
    let (path, report) = export(&dir, "ply-sequence", "frames", &["--frames", "4"]);
    assert_eq!((std::fs::read_dir(&path).unwrap().count(), &report["frames"]), (4, &Value::from(4)));
    for k in [0usize, 3] {
        assert!(judge.psnr(read::any(&path.join(format!("frames_{k:04}.ply"))), Some(k as f32 / 3.0)) >= 70.0);
    }
    // Straight motion and bells of opacity are what the format holds; other deformers it only approximates. Colours without harmonics are held to it.
    let judge = Judge::new(&flat);
    let (path, report) = export(&flat, "splatv", "a.splatv", &[]);
    assert!(report["notes"][0].as_str().unwrap().contains("instants"), "{report}");
    for time in [0.0, 0.3, 0.6, 1.0] {
        let psnr = judge.psnr(read::splatv(&path, time), Some(time));
        eprintln!("splatv at {time}: {psnr:.1} dB");
        assert!(psnr >= 45.0, "splatv at {time}: {psnr} dB");
    }
}

#[test]
fn exports_are_refused_before_work_and_never_replace_unasked() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    train(&at("run"), "cdf-basis", 0);
    let (dir, out) = (at("run"), at("a.ply"));
    let export = |format: &str, out: &Path, more: &[&str]| -> Vec<String> {
        ["export", format, text(&dir), "--out", text(out), "-q", "--device", "flex"].iter().chain(more).map(ToString::to_string).collect()
    };
    let refused = |args: Vec<String>| fail(&args.iter().map(String::as_str).collect::<Vec<_>>(), 2);
    assert!(refused(export("plyy", &out, &[])).contains("ply"));
    assert!(refused(export("spz", &out, &[])).contains("a.spz"));
    assert!(refused(export("spz", &at("a.spz"), &["--set", "version=9"])).contains("version"));
    assert!(refused(export("ply", &out, &["--set", "dynamics=false"])).contains("dynamics"));
    assert!(refused(export("ply", &out, &["--time", "1.5"])).contains("0..1"));
    let still = refused(export("splatv", &at("a.splatv"), &["--time", "0.5"]));
    assert!(still.contains("--time 0.5: it has no effect on the format splatv") && still.contains("ply, sog, spz"), "{still}");
    assert!(!out.exists());
    std::fs::write(&out, "mine").unwrap();
    assert!(refused(export("ply", &out, &[])).contains("--overwrite"));
    assert_eq!(std::fs::read(&out).unwrap(), b"mine");
    let overwrite = export("ply", &out, &["--overwrite"]);
    succeed(&overwrite.iter().map(String::as_str).collect::<Vec<_>>());
    assert!(std::fs::read(&out).unwrap().starts_with(b"ply\n"));
    // A page needs the built player, and says what makes it.
    let page = at("a.html");
    let output = common::cc4dgs().args(export("web", &page, &[])).env("CC4DGS_PAGE", at("nowhere")).output().unwrap();
    assert!(!output.status.success() && common::said(&output).contains("nowhere") && !page.exists(), "{}", common::said(&output));
    // A folder that holds a run is not an export.
    assert!(refused(export("ply-sequence", &dir, &["--overwrite"])).contains("which is not of this format"));
    assert!(dir.join("checkpoint").is_file());
    // The alias writes the same bytes under the same rule.
    let alias = at("b.ply");
    let decompress = ["decompress", text(&dir), "--out", text(&alias), "-q"];
    succeed(&decompress);
    assert!(fail(&decompress, 2).contains("--overwrite"));
    succeed(&[&decompress[..], &["--overwrite"]].concat());
    assert!(std::fs::read(&alias).unwrap() == std::fs::read(&out).unwrap());
}

#[test]
fn videos_have_their_images() {
    if Command::new("ffmpeg").arg("-version").output().is_err() {
        eprintln!("ffmpeg is absent: skipped");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    train(&at("run"), "cdf-basis", 0);
    let (dir, video, captured) = (at("run"), at("orbit.mp4"), at("captured.mp4"));
    let size = ["--frames", "5", "--size", "50x39", "--fps", "29.97", "--device", "flex", "-q"];
    succeed(&[&["export", "mp4", text(&dir), "--out", text(&video)], &size[..]].concat());
    succeed(&["export", "mp4", text(&dir), "--out", text(&captured), "--scene", "procedural:tiny", "--frames", "3", "--device", "flex", "-q"]);
    let frames = at("frames");
    let both = at("both.mp4");
    succeed(&[&["render", text(&dir), "--out", text(&frames), "--mp4", text(&both)], &size[..]].concat());
    for (file, count, width, rate) in [(&video, 5, Some(50), "2997/100"), (&captured, 3, None, "30/1"), (&both, 5, Some(50), "2997/100")] {
        let probe = Command::new("ffprobe").args(["-v", "error", "-count_frames", "-show_streams", "-of", "json"]).arg(file).output().unwrap();
        let probe: Value = serde_json::from_slice(&probe.stdout).unwrap();
        let stream = &probe["streams"][0];
        assert_eq!((&stream["codec_name"], &stream["nb_read_frames"]), (&Value::from("h264"), &Value::from(count.to_string())), "{probe}");
        assert_eq!(stream["avg_frame_rate"], rate, "{probe}");
        assert!(width.is_none_or(|width| stream["width"] == width && stream["height"] == 40), "{probe}");
    }
    assert_eq!(std::fs::read_dir(&frames).unwrap().count(), 6, "five frames and the mark of the folder");
}

/// The page of the player is no part of this program; this stands in for it.
#[test]
fn pages_hold_an_archive_that_plays() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    train(&at("run"), "cdf-basis", 0);
    std::fs::create_dir(at("page")).unwrap();
    let stand_in = format!("export const PAGE_VERSION = {PAGE_VERSION};");
    PAGE_FILES.iter().for_each(|name| std::fs::write(at("page").join(name), &stand_in).unwrap());
    let (dir, site, baked, again) = (at("run"), at("site"), at("baked.cc4d"), at("again"));
    let page = format!("page={}", text(&at("page")));
    let export_with = |model: &Path, out: &Path, more: &[&str]| {
        let args = ["export", "web", text(model), "--out", text(out), "--set", &page, "--device", "flex", "-q", "--json"];
        json_of(&[&args, more].concat())
    };
    let export = |model: &Path, out: &Path| export_with(model, out, &[]);
    assert!(export(&dir, &at("one.html"))["bytes"].as_u64().unwrap() > 1000);
    assert!(std::fs::read_to_string(at("one.html")).unwrap().starts_with("<!doctype html>"));
    export(&dir, &site);
    assert_eq!(std::fs::read_dir(&site).unwrap().count(), PAGE_FILES.len() + 2);
    let events = cc4dgs_core::Silent;
    let model = cc4dgs_core::StoredModel::open(site.join("model.cc4d"), &cc4dgs::Limits::default(), &events).unwrap();
    assert!(model.playback.is_some() && model.manifest.presentation.home.is_some());
    // The page computes the motion of this deformer from its weights, unless a layer is asked for.
    let kinds = |site: &str| {
        let archive = Archive::open(at(site).join("model.cc4d"), &cc4dgs::Limits::default()).unwrap();
        [StreamKind::Field, StreamKind::Playback].map(|kind| archive.stream_sizes().iter().any(|s| s.kind == kind))
    };
    export_with(&dir, &at("layer"), &["--set", "baked=true"]);
    assert_eq!((kinds("site"), kinds("layer")), ([true, false], [false, true]));
    // An archive that is baked keeps its layer: the bound of the page does not apply to it.
    succeed(&["bake", text(&dir), "--out", text(&baked), "--max-error", "2px", "-q"]);
    export(&baked, &again);
    let layer = |path: &Path| cc4dgs_core::StoredModel::open(path, &cc4dgs::Limits::default(), &events).unwrap().playback;
    assert!(layer(&again.join("model.cc4d")) == layer(&baked) && layer(&baked) != model.playback);
    // What is said of clock and axis takes the place of what the archive states.
    succeed(&["bake", text(&dir), "--out", text(&at("slow.cc4d")), "--max-error", "2px", "--fps", "12", "--up", "z", "-q"]);
    export(&at("slow.cc4d"), &at("slow"));
    export_with(&at("slow.cc4d"), &at("fast"), &["--fps", "24", "--up", "y"]);
    let [slow, fast] = ["slow", "fast"].map(|site| {
        let archive = Archive::open(at(site).join("model.cc4d"), &cc4dgs::Limits::default()).unwrap();
        archive.manifest().presentation.clone()
    });
    assert_eq!((slow.frames_per_second, slow.up, fast.frames_per_second, fast.up), (Some(12.0), Some([0.0, 0.0, 1.0]), Some(24.0), Some([0.0, 1.0, 0.0])));
    assert!(slow.seconds.is_some() && fast.seconds.is_none(), "the duration of the archive is that of its rate");
    // Scene options count for the cameras of the page.
    export_with(&dir, &at("small"), &["--scene", "procedural:tiny", "--set", "scene.width=20"]);
    let small = cc4dgs_core::StoredModel::open(at("small/model.cc4d"), &cc4dgs::Limits::default(), &events).unwrap();
    let widths: Vec<u32> = small.manifest.presentation.cameras.iter().map(|camera| camera.width).collect();
    assert_eq!(widths, [20; 6]);
}

#[test]
fn archives_without_their_deformer_move_by_their_layer() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    train(&at("run"), "cdf-basis", 1);
    let (dir, bare) = (at("run"), at("bare.cc4d"));
    succeed(&["bake", text(&dir), "--out", text(&bare), "--max-error", "0.05px", "--without-field", "-q"]);
    let judge = Judge::new(&dir);
    let export = |name: &str, more: &[&str]| {
        let out = at(name);
        succeed(&[&["export", "ply", text(&bare), "--out", text(&out), "--device", "flex", "-q"], more].concat());
        read::any(&out)
    };
    let (still, moved) = (export("still.ply", &[]), export("half.ply", &["--time", "0.5"]));
    let (moves, stays, half) = (judge.psnr(still.clone(), Some(0.5)), judge.psnr(still, None), judge.psnr(moved, Some(0.5)));
    assert!(stays > 40.0 && half > 40.0 && moves < half - 3.0, "{stays} dB canonical, {half} dB at half time, {moves} dB without motion");
    for again in [&["compress", text(&bare), "--codec", "raw"][..], &["prune", text(&bare), "--scene", "procedural:tiny"]] {
        let message = fail(&[again, &["--out", text(&at("again.cc4d")), "-q"]].concat(), 2);
        assert!(message.contains("--without-field"), "{message}");
    }
    let args = ["bench", "skip", text(&bare), "--scene", "procedural:tiny", "--device", "flex", "--frames", "1", "--rounds", "1", "-q", "--json"];
    let skipped = json_of(&args);
    let frames: Vec<&str> = skipped["frames"].as_array().unwrap().iter().filter_map(|row| row["off"].as_str()).collect();
    assert!(frames.contains(&"static gating") && !frames.contains(&"vertex reuse"), "{skipped}");
}
