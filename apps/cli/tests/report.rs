//! Reports, and the metrics that need weights, as users of the command meet them.
#![allow(clippy::unwrap_used, reason = "a test that meets an error should stop there, in helpers too")]

mod common;

use common::{cc4dgs, text};
use serde_json::Value;
use std::process::Output;

fn run(args: &[&str]) -> Output {
    // Weights of this machine must not decide what the test sees.
    cc4dgs().env("CC4DGS_LPIPS", "/no/such/weights.safetensors").args(args).output().expect("the program starts")
}

fn said(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

#[test]
fn a_folder_of_results_becomes_a_page_and_tables() {
    let folder = tempfile::tempdir().unwrap();
    let documented = include_str!("../../../docs/results.md").split("```json\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
    std::fs::write(folder.path().join("one.json"), documented).unwrap();
    let output = run(&["report", text(folder.path()), "--json"]);
    assert!(output.status.success(), "{}", said(&output));
    let files: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(files["cells"], 1);
    for (key, part) in [("html", "31.25"), ("csv", "mutant,cdf,base,cca,done,1,31.25"), ("markdown", "## mutant"), ("latex", "\\caption{mutant}")] {
        let file = std::fs::read_to_string(files[key].as_str().unwrap()).unwrap();
        assert!(file.contains(part), "{key}");
    }
    assert_eq!(files["html"], text(&folder.path().join("report.html")));
    // Results of two devices are refused, and the remedy works.
    let other = documented.replace("4be29fd1c80a7e53", "0000000000000000").replace("\"name\": \"flex\"", "\"name\": \"wgpu\"");
    std::fs::write(folder.path().join("two.json"), other).unwrap();
    let output = run(&["report", text(folder.path())]);
    assert!(output.status.code() == Some(3) && said(&output).contains("--where"), "{}", said(&output));
    assert!(run(&["report", text(folder.path()), "--where", "device=wgpu"]).status.success());
    let output = run(&["report", text(&folder.path().join("nowhere"))]);
    assert!(output.status.code() == Some(2) && said(&output).contains("the folder of a sweep"), "{}", said(&output));
    assert_eq!(run(&["report", text(folder.path()), "--where", "device"]).status.code(), Some(2));
}

#[test]
fn evaluation_says_why_lpips_is_absent_and_measures_flip() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("run");
    let train = ["train", "--scene", "procedural:tiny", "--preset", "demo", "--set", "train.iterations=60", "--device", "flex", "--out", text(&dir), "-q"];
    let output = run(&train);
    assert!(output.status.success(), "{}", said(&output));
    let plain = ["eval", text(&dir), "--scene", "procedural:tiny", "--device", "flex", "--sheet-rows", "0", "-q"];
    let output = run(&[&plain[..], &["--json"]].concat());
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(report["flip"].is_null() && report["metrics"]["flip"].is_null() && report["lpips_absent"].as_str().unwrap().contains("--perceptual"), "{report}");
    let eval = [&plain[..], &["--perceptual"]].concat();
    let output = run(&eval);
    assert!(said(&output).contains("LPIPS is not measured: /no/such/weights.safetensors"), "{}", said(&output));
    let output = run(&[&eval[..], &["--json"]].concat());
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(report["lpips"].is_null() && report["lpips_absent"].as_str().unwrap().contains("/no/such"), "{report}");
    assert!(report["metrics"]["lpips"].is_null() && report["images"][0]["lpips"].is_null());
    let flip = report["flip"].as_f64().unwrap();
    assert!((0.001..1.0).contains(&flip), "{flip}");
    assert!((report["metrics"]["flip"]["pixels_per_degree"].as_f64().unwrap() - 67.02).abs() < 0.01);
    let doctor = run(&["doctor", "--json"]);
    let doctor: Value = serde_json::from_slice(&doctor.stdout).unwrap();
    assert_eq!(doctor["lpips"]["paths"], serde_json::json!(["/no/such/weights.safetensors"]));
    assert!(doctor["lpips"]["source"].is_null() && doctor["lpips"]["absent"].as_str().unwrap().contains("/no/such"));
}
