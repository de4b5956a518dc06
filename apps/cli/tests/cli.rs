//! The command as its users meet it: a process, files, exit codes.
#![allow(clippy::unwrap_used, reason = "a test that meets an error should stop there, in helpers too")]

mod common;

use common::{cc4dgs, fail, json_of, read_json, succeed, text, train_args};
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

#[test]
fn plugins_are_listed_with_their_facts() {
    let list = json_of(&["plugins", "--json"]);
    let list = list.as_array().unwrap();
    for (kind, name) in [("deformer", "cdf"), ("deformer", "none"), ("codec", "raw"), ("codec", "cca"), ("rasterizer", "tile"), ("rasterizer", "reference")] {
        assert!(list.iter().any(|p| p["kind"] == kind && p["name"] == name), "{kind} {name} is missing");
    }
    for plugin in list {
        let keys: Vec<&String> = plugin.as_object().unwrap().keys().collect();
        assert_eq!(keys, ["cc4dgs", "kind", "name", "summary", "version"]);
        assert!(plugin.as_object().unwrap().values().all(|v| v.as_str().is_some_and(|s| !s.is_empty())), "{plugin}");
    }
    let cdf = json_of(&["plugins", "cdf", "--json"]);
    assert!(cdf[0]["schema"].as_str().unwrap().contains("capacity"), "{cdf}");
    assert!(fail(&["plugins", "cfd"], 2).contains("cdf"));
    // What the list names can be shown, presets among it.
    let preset = json_of(&["plugins", "dnerf+hexplane", "--json"]);
    assert_eq!((&preset[0]["kind"], &preset[0]["settings"]["deformer"]["kind"]), (&Value::from("preset"), &Value::from("hexplane")));
    assert!(fail(&["plugins", "dmeo"], 2).contains("demo"));
    // A few names, each once.
    let unknown = fail(&["plugins", "panoptik"], 2);
    assert!(unknown.matches("panoptic").count() == 1 && unknown.split(", ").count() <= 8 && unknown.contains("`cc4dgs plugins`"), "{unknown}");
}

#[test]
fn a_scene_goes_through_the_whole_chain() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (dir, archive, ply) = (at("run"), at("model.cc4d"), at("model.ply"));
    succeed(&train_args(text(&dir), "train.iterations=500"));
    for name in ["checkpoint", "config.toml", "events.jsonl"] {
        assert!(dir.join(name).is_file(), "{name}");
    }
    let log = std::fs::read_to_string(dir.join("events.jsonl")).unwrap();
    let events: Vec<Value> = log.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    assert_eq!(events[0]["event"], "run-started");
    assert!(events.iter().any(|e| e["event"] == "stage-started" && e["stage"] == "main"), "{log}");

    succeed(&["compress", text(&dir), "--codec", "cca:default", "--out", text(&archive), "-q"]);
    let packed = std::fs::read(&archive).unwrap();
    for again in [&["compress", text(&dir), "--codec", "raw"][..], &["bake", text(&archive)], &["decompress", text(&archive)]] {
        assert!(fail(&[again, &["--out", text(&archive), "-q"]].concat(), 2).contains("--overwrite"));
    }
    assert!(std::fs::read(&archive).unwrap() == packed, "a refused command leaves the file alone");
    let (json, sheet) = (at("eval.json"), at("eval.png"));
    succeed(&["eval", text(&archive), "--scene", "procedural:tiny", "--split", "test", "-q", "--json", text(&json)]);
    let report = read_json(&json);
    let number = |pointer: &str| report.pointer(pointer).and_then(Value::as_f64).unwrap_or_else(|| panic!("{pointer} in {report}"));
    assert!(number("/psnr_db") > 18.0 && number("/ssim") > 0.6 && number("/ssim") <= 1.0, "{report}");
    let on_disk = std::fs::metadata(&archive).unwrap().len() as f64;
    assert!((number("/size_mb/total") * 1e6 - on_disk).abs() < 0.5, "MB are 10^6 bytes on disk");
    assert!(number("/size_mb/point_cloud") > 0.0 && number("/size_mb/deform") > 0.0);
    assert!(number("/size_mb/point_cloud") + number("/size_mb/deform") <= number("/size_mb/total"));
    assert!(number("/frame_ms/mean") > 0.0);
    assert_eq!(report["images"].as_array().unwrap().len(), 4);
    assert!(image::open(&sheet).unwrap().width() > 3 * 40);
    // A contact sheet replaces only PNG images, and renders replace only renders.
    let (renders, measure) = (at("renders"), ["eval", text(&archive), "--scene", "procedural:tiny", "-q"]);
    let draw = [&measure[..], &["--sheet-rows", "0", "--renders", text(&renders)]].concat();
    assert!(fail(&[&measure[..], &["--sheet", text(&archive)]].concat(), 2).contains("not a PNG image"));
    succeed(&[&measure[..], &["--sheet", text(&sheet)]].concat());
    succeed(&draw);
    assert!(fail(&draw, 2).contains("--overwrite"));
    // A command without new renders keeps the old ones.
    assert!(fail(&[&draw[..], &["--overwrite", "--split", "validation"]].concat(), 2).contains("no view of split"));
    assert_eq!(std::fs::read_dir(&renders).unwrap().count(), 5, "four renders and the mark of the folder");
    succeed(&[&draw[..], &["--overwrite", "--max-views", "1"]].concat());
    assert_eq!(std::fs::read_dir(&renders).unwrap().count(), 2, "a render and the mark of the folder");
    assert!(fail(&[&measure[..], &["--renders", text(&dir), "--overwrite"]].concat(), 2).contains("is not a render"));
    assert!(std::fs::read(&archive).unwrap() == packed && dir.join("checkpoint").is_file());

    // The checkpoint evaluates too, and its float32 form is the larger one.
    let plain = json_of(&["eval", text(&dir), "--scene", "procedural:tiny", "-q", "--sheet-rows", "0", "--json"]);
    assert!(plain["size_mb"]["total"].as_f64().unwrap() > number("/size_mb/total"));
    assert!((plain["psnr_db"].as_f64().unwrap() - number("/psnr_db")).abs() < 0.5);

    // A run is not overwritten unasked.
    let before = std::fs::read(dir.join("checkpoint")).unwrap();
    assert!(fail(&train_args(text(&dir), "train.iterations=30"), 2).contains("--overwrite"));
    assert_eq!(std::fs::read(dir.join("checkpoint")).unwrap(), before);
    assert_eq!(std::fs::read_to_string(dir.join("events.jsonl")).unwrap(), log, "a refused run leaves the log alone");

    succeed(&["decompress", text(&archive), "--out", text(&ply), "-q"]);
    let played = json_of(&["bench", "play", text(&archive), "--scene", "procedural:tiny", "--device", "flex", "--frames", "5", "-q", "--json"]);
    assert!(played["frames_per_s"].as_f64().unwrap() > 0.0 && played["field"]["median_ms"].as_f64().unwrap() > 0.0, "{played}");
    // Two frames of warming up and five of measuring, waited for, and the same without waiting.
    assert_eq!(played["work"]["frames"], 14);

    let (model, cloud) = (json_of(&["info", text(&archive), "--json"]), json_of(&["info", text(&ply), "--json"]));
    assert_eq!((&model["kind"], &cloud["kind"]), (&Value::from("archive"), &Value::from("ply")));
    assert_eq!(model["manifest"]["gaussian_count"], cloud["gaussians"]["count"]);
    let spz = at("cloud.spz");
    succeed(&["decompress", text(&archive), "--out", text(&spz), "-q"]);
    let found = json_of(&["info", text(&spz), "--json"]);
    assert_eq!((&found["kind"], &found["gaussians"]["count"]), (&Value::from("spz"), &cloud["gaussians"]["count"]));
    // The parts of the storage table add up, and its last row is the file.
    let mb = |row: usize, key: &str| model["storage"][row][key].as_f64().unwrap();
    assert!((mb(2, "float32_mb") + mb(3, "float32_mb") - mb(4, "float32_mb")).abs() < 1e-6 && mb(0, "float32_mb") + mb(1, "float32_mb") > 0.0);
    assert!((mb(4, "stored_mb") * 1e6 - on_disk).abs() < 0.5 && mb(3, "stored_mb") < mb(3, "float32_mb"));
    assert_eq!(json_of(&["info", text(&dir), "--json"])["gaussians"]["count"], cloud["gaussians"]["count"]);

    let frames = at("frames");
    let report = json_of(&["render", text(&archive), "--out", text(&frames), "--frames", "3", "--size", "48x36", "-q", "--json"]);
    assert_eq!(report["frames"], 3);
    for i in 0..3 {
        let image = image::open(frames.join(format!("frame_{i:05}.png"))).unwrap();
        assert_eq!((image.width(), image.height()), (48, 36));
    }
    // Frames of an earlier command would be taken for the last ones of a shorter orbit.
    let shorter = ["render", text(&archive), "--out", text(&frames), "--frames", "2", "--size", "48x36", "-q"];
    assert!(fail(&shorter, 2).contains("--overwrite"));
    succeed(&[&shorter[..], &["--overwrite"]].concat());
    assert_eq!(std::fs::read_dir(&frames).unwrap().count(), 3, "two frames and the mark of the folder");
    succeed(&["render", text(&archive), "--out", text(&at("views")), "--scene", "procedural:tiny", "--frames", "2", "-q"]);
    assert_eq!(std::fs::read_dir(at("views")).unwrap().count(), 3);
    let output = cc4dgs().args(["render", text(&archive), "--out", text(&at("v")), "--mp4", text(&at("v.mp4"))]).env("PATH", "").output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("ffmpeg") && !at("v").exists());
    // A limit below the model's size is its own kind of failure.
    fail(&["--limit", "max_gaussians=5", "decompress", text(&archive), "--out", text(&at("no.ply")), "-q"], 4);
    assert!(!at("no.ply").exists());
}

/// Every command that takes a model takes all kinds of it.
#[test]
fn every_kind_of_model_is_taken_everywhere() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (dir, archive, ply, spz) = (at("run"), at("a.cc4d"), at("a.ply"), at("a.spz"));
    succeed(&train_args(text(&dir), "train.iterations=120"));
    succeed(&["compress", text(&dir), "--codec", "raw", "--out", text(&archive), "-q"]);
    succeed(&["decompress", text(&dir), "--out", text(&ply), "-q"]);
    succeed(&["decompress", text(&dir), "--out", text(&spz), "-q"]);
    let checkpoint = dir.join("checkpoint");
    let mut sources = vec![(dir.clone(), "checkpoint"), (checkpoint, "checkpoint"), (archive, "archive"), (ply, "ply"), (spz, "spz")];
    // A file of another program, if CC4DGS_DATA names the folder with real data.
    match std::env::var_os("CC4DGS_DATA").map(|root| Path::new(&root).join("playbot_31k/lod3_decoded_3dgs.ply")).filter(|p| p.is_file()) {
        Some(file) => sources.push((file, "ply")),
        None => eprintln!("CC4DGS_DATA names no folder with playbot_31k: its part of the test is skipped"),
    }
    for (source, kind) in sources {
        let source = text(&source);
        let info = json_of(&["info", source, "--json"]);
        assert_eq!(info["kind"], kind, "{source}");
        let count = info.pointer("/gaussians/count").or(info.pointer("/manifest/gaussian_count")).unwrap().as_u64().unwrap();
        assert!(count > 0);
        let (packed, flat, frames) = (at("packed.cc4d"), at("flat.ply"), at("frames"));
        let report = json_of(&["compress", source, "--codec", "quantize", "--out", text(&packed), "--overwrite", "-q", "--json"]);
        assert_eq!(report["gaussians"].as_u64(), Some(count), "{source}");
        // Against float32, whatever the source was.
        assert!(report["ratio"].as_f64().unwrap() > 1.2, "{source}: {report}");
        let report = json_of(&["decompress", source, "--out", text(&flat), "--overwrite", "-q", "--json"]);
        assert_eq!(report["gaussians"].as_u64(), Some(count), "{source}");
        json_of(&["decompress", text(&packed), "--out", text(&flat), "--time", "0.5", "--overwrite", "-q", "--json"]);
        let report =
            json_of(&["render", source, "--out", text(&frames), "--overwrite", "--frames", "2", "--size", "40x30", "--device", "flex", "-q", "--json"]);
        assert_eq!(report["frames"], 2);
        let drawn = image::open(frames.join("frame_00000.png")).unwrap().to_rgb8();
        assert!(drawn.pixels().any(|p| p != drawn.get_pixel(0, 0)), "{source}: the image is empty");
        let report = json_of(&["eval", source, "--scene", "procedural:tiny", "--device", "flex", "--max-views", "1", "--sheet-rows", "0", "-q", "--json"]);
        assert_eq!(report["gaussians"].as_u64(), Some(count), "{source}");
        assert!(report["psnr_db"].as_f64().unwrap().is_finite() && report["size_mb"]["total"].as_f64().unwrap() > 0.0, "{source}: {report}");
    }
    // A file that is no model, and a folder without one, are refused as such.
    std::fs::write(at("notes.txt"), "no model").unwrap();
    for bad in [at("notes.txt"), at("frames")] {
        assert!(fail(&["compress", text(&bad), "--out", text(&at("no.cc4d")), "-q"], 3).contains("SPZ"));
    }
}

/// A downloaded file has no scene: the codec that measures looks at it from all round.
#[test]
fn a_model_without_a_scene_is_measured_in_an_orbit() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (ply, archive, count) = (at("a.ply"), at("a.cc4d"), 40);
    let gaussians = cc4dgs_core::HostGaussians {
        means: (0..3 * count).map(|i| (1.7 * i as f32).sin()).collect(),
        log_scales: vec![-1.5; 3 * count],
        quaternions: [1.0, 0.0, 0.0, 0.0].repeat(count),
        opacity_logits: vec![1.0; count],
        sh_dc: (0..3 * count).map(|i| (2.3 * i as f32).cos()).collect(),
        dynamic_scores: vec![0.0; count],
        ..Default::default()
    };
    cc4dgs_core::ply::write(&ply, &gaussians, false).unwrap();
    let output = succeed(&["compress", text(&ply), "--orbit", "16", "--codec", "compact:psnr=45dB", "--out", text(&archive), "--json"]);
    let (report, said): (Value, String) = (serde_json::from_slice(&output.stdout).unwrap(), common::said(&output));
    assert!(report["gaussians"] == count && report["bytes"] == std::fs::metadata(&archive).unwrap().len(), "{report}");
    assert!(said.contains("16 orbit views"), "{said}");
}

#[test]
fn the_storage_table_counts_attributes() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (run, archive) = (at("run"), at("a.cc4d"));
    let settings = ["train.iterations=120", "train.checkpoint_every=0"];
    let mut args = vec!["train", "--scene", "procedural:tiny", "--preset", "demo+native-4d", "--device", "flex", "--out", text(&run), "-q"];
    args.extend(settings.iter().flat_map(|s| ["--set", s]));
    succeed(&args);
    // Every codec stores attributes in streams of its own.
    for codec in ["raw", "quantize"] {
        succeed(&["compress", text(&run), "--codec", codec, "--out", text(&archive), "--overwrite", "-q"]);
        let [before, after] = [&run, &archive].map(|path| json_of(&["info", text(path), "--json"]));
        assert!(before["gaussians"]["extra"].as_array().unwrap().len() > 2, "{before}");
        for row in 0..5 {
            assert_eq!(before["storage"][row]["float32_mb"], after["storage"][row]["float32_mb"], "{codec}: row {row}");
        }
    }
}

/// What an archive says of plug-ins that this program lacks.
#[test]
fn archives_of_plug_ins_that_are_not_linked_say_what_to_link() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    succeed(&train_args(text(&at("run")), "train.iterations=120"));
    succeed(&["compress", text(&at("run")), "--codec", "raw", "--out", text(&at("a.cc4d")), "-q"]);
    let limits = cc4dgs_core::Limits::default();
    let archive = cc4dgs_core::archive::Archive::open(at("a.cc4d"), &limits).unwrap();
    let rewrite = |name: &str, change: &dyn Fn(&mut cc4dgs_core::archive::Manifest)| {
        use cc4dgs_core::archive::{ArchiveWriter, StreamKind};
        let mut manifest = archive.manifest().clone();
        change(&mut manifest);
        let writer = [StreamKind::Canonical, StreamKind::Field]
            .into_iter()
            .fold(ArchiveWriter::new(manifest), |writer, kind| writer.add_all(kind, archive.read_kind(kind).unwrap()));
        writer.write_to(at(name)).unwrap();
    };
    rewrite("codec.cc4d", &|m| (m.codec.name, m.codec.version) = ("halves".into(), "7".into()));
    rewrite("field.cc4d", &|m| m.deformer.as_mut().unwrap().name = "sway".into());
    for (file, kind, name) in [("codec.cc4d", "codec", "halves' (version 7)"), ("field.cc4d", "deformer", "sway'")] {
        let said = fail(&["render", text(&at(file)), "--out", text(&at("frames")), "-q"], 2);
        assert!([file, kind, name, "links the crate"].iter().all(|part| said.contains(part)), "{said}");
        let info = json_of(&["info", text(&at(file)), "--json"]);
        assert!(info["notes"][0].as_str().unwrap().contains(name), "{info}");
        assert!(info["manifest"]["gaussian_count"].as_u64().unwrap() > 0 && !info["streams"].as_array().unwrap().is_empty());
    }
}

#[cfg(unix)]
#[test]
fn an_interrupted_run_resumes_to_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let whole = folder.path().join("whole");
    let iterations = "train.iterations=400";
    succeed(&train_args(text(&whole), iterations));
    let whole = std::fs::read(whole.join("checkpoint")).unwrap();

    for signal in ["-INT", "-TERM"] {
        let parts = folder.path().join(signal);
        let log = parts.join("events.jsonl");
        let mut child = cc4dgs().args(train_args(text(&parts), iterations)).stderr(Stdio::piped()).spawn().unwrap();
        let began = Instant::now();
        while !std::fs::read_to_string(&log).is_ok_and(|l| l.contains("\"iteration\"")) && child.try_wait().unwrap().is_none() {
            assert!(began.elapsed() < Duration::from_secs(120), "no iteration within two minutes");
            std::thread::sleep(Duration::from_millis(5));
        }
        // Twice, as by `timeout`, which signals its child and then the group that it is in.
        let send = format!("kill {signal} {0} && sleep 0.02 && kill {signal} {0}", child.id());
        let sent = Command::new("sh").args(["-c", &send]).status().unwrap();
        assert!(sent.success(), "the training ended before it was interrupted");
        let output = child.wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(130), "{signal}: {}", String::from_utf8_lossy(&output.stderr));
        assert_ne!(std::fs::read(parts.join("checkpoint")).unwrap(), whole);

        // A continuation with other settings is refused and leaves those of the run.
        let config = std::fs::read_to_string(parts.join("config.toml")).unwrap();
        let other = ["train", "--scene", "procedural:tiny", "--resume", "--set", "train.iterations=500", "--out", text(&parts), "-q"];
        assert!(fail(&other, 2).contains("train.iterations was 400 and is 500"));
        assert_eq!(std::fs::read_to_string(parts.join("config.toml")).unwrap(), config);

        let lines = std::fs::read_to_string(&log).unwrap().lines().count();
        succeed(&["train", "--scene", "procedural:tiny", "--resume", "--out", text(&parts), "-q"]);
        assert!(std::fs::read_to_string(&log).unwrap().lines().count() > lines, "the log goes on where it ended");
        assert!(std::fs::read(parts.join("checkpoint")).unwrap() == whole, "{signal}: interruption changed the result");
    }
}

#[test]
fn the_doctor_finds_the_rasterizers_right() {
    let report = json_of(&["doctor", "--json"]);
    assert_eq!(report["healthy"], true, "{report}");
    let checks = report["self_check"].as_array().unwrap();
    for device in ["flex", "ndarray"] {
        assert!(checks.iter().any(|c| c["device"] == device && c["rasterizer"] == "tile"), "{report}");
    }
}
