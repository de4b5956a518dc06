//! `cc4dgs bench` as a process.
#![allow(clippy::unwrap_used, reason = "a test that meets an error should stop there, in helpers too")]

mod common;

use common::{fail, json_of, read_json, succeed, text, train_args};
use serde_json::Value;
use std::path::Path;

#[test]
fn synthetic_scenes_become_archives_that_play() {
    let folder = tempfile::tempdir().unwrap();
    let archive = folder.path().join("scene.cc4d");
    let small =
        ["bench", "frame", "--scale", "0.001", "--frames", "1", "--device", "flex", "--set", "deformer.kind=cdf-basis", "-q", "--archive", text(&archive)];
    assert!(fail(&small, 2).contains("--case"));
    let still = fail(&[&small[..], &["--case", "n3dv", "--motion", "0.05", "--set", "deformer.kind=none"]].concat(), 2);
    assert!(still.contains("--motion 0.05: it has no effect") && !archive.exists(), "{still}");
    succeed(&[&small[..], &["--case", "n3dv", "--motion", "0.05"]].concat());
    let info = json_of(&["info", text(&archive), "--json"]);
    assert_eq!(info["manifest"]["gaussian_count"], 335, "{info}");
    assert!(info["manifest"]["presentation"]["cameras"].as_array().unwrap().len() == 1, "{info}");
    let kinds: Vec<&Value> = info["streams"].as_array().unwrap().iter().map(|stream| &stream["kind"]).collect();
    assert!(kinds.iter().any(|kind| kind.as_str().is_some_and(|k| k.eq_ignore_ascii_case("playback"))), "{info}");
}

#[test]
fn skips_are_measured_where_they_apply() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (dir, archive, ply) = (at("run"), at("model.cc4d"), at("model.ply"));
    // Enough iterations for the scores to find Gaussians that move; with none of them there is no deformer to measure.
    succeed(&train_args(text(&dir), "train.iterations=200"));
    succeed(&["compress", text(&dir), "--codec", "raw", "--out", text(&archive), "-q"]);
    succeed(&["decompress", text(&archive), "--out", text(&ply), "-q"]);
    let measure = |model: &Path, more: &[&str]| {
        let args = ["bench", "skip", text(model), "--scene", "procedural:tiny", "--device", "flex", "--frames", "4", "--rounds", "2", "-q", "--json"];
        json_of(&[&args, more].concat())
    };
    let names = |rows: &Value| rows.as_array().unwrap().iter().map(|row| row["off"].as_str().unwrap().to_string()).collect::<Vec<_>>();
    let report = measure(&archive, &["--iterations", "20"]);
    let frames =
        ["nothing", "static gating", "feature cache", "vertex reuse", "feature cache, vertex reuse", "opacity early out", "transmittance early out", "all"];
    assert_eq!(names(&report["frames"]), frames, "{report}");
    assert_eq!(report["frames_per_case"], 4, "{report}");
    for row in report["frames"].as_array().unwrap() {
        assert!(row["same_bits"] == true && row["frame"]["median_ms"].as_f64().unwrap() > 0.0, "{row}");
        assert_eq!(row["largest_difference"], 0.0, "{row}");
        let first = row["first_frame"]["median_ms"].as_f64().unwrap();
        assert!(first > 0.0 && first < row["total_frame_ms"].as_f64().unwrap(), "{row}");
        let [before, peak] = ["memory_before_mb", "peak_memory_mb"].map(|key| row[key].as_f64());
        assert!(before <= peak && before.is_some() == cfg!(target_os = "linux"), "{row}");
    }
    let steps = names(&report["steps"]);
    assert!(steps.len() > 4 && steps[0] == "nothing" && steps[steps.len() - 1] == "all", "{report}");
    assert!(report["steps"].as_array().unwrap().iter().all(|row| row["ms_per_view"]["median_ms"].as_f64().unwrap() > 0.0), "{report}");
    // The preset draws full images from the start, so there is nothing to switch off.
    let left_out = names(&report["left_out"]);
    assert!(left_out.iter().any(|name| name.contains("lower resolution")) && left_out.iter().all(|name| !steps.contains(name)), "{report}");

    // A file without a deformer and without a configuration.
    let still = measure(&ply, &[]);
    assert_eq!(names(&still["frames"]), ["nothing", "opacity early out", "transmittance early out", "all"], "{still}");
    assert!(names(&still["left_out"]).contains(&"static gating".to_string()), "{still}");
    let refused = fail(&["bench", "skip", text(&ply), "--scene", "procedural:tiny", "--device", "flex", "--iterations", "5", "-q"], 2);
    assert!(refused.contains("no configuration"), "{refused}");
}

#[test]
fn the_step_benchmark_reports_its_cases() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bench.json");
    succeed(&["bench", "step", "--device", "flex", "--repeats", "1", "--json", text(&file), "-q"]);
    let report = read_json(&file);
    let cases = report["cases"].as_array().unwrap();
    assert!(!cases.is_empty());
    for case in cases {
        for key in ["width", "height", "gaussians", "median_ms", "pairs_per_s"] {
            assert!(case[key].as_f64().is_some_and(|v| v > 0.0), "{key} in {case}");
        }
    }
}
