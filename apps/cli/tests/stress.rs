//! `cc4dgs stress`: what is compared with what.
#![allow(clippy::unwrap_used, reason = "a test that meets an error should stop there, in helpers too")]

mod common;

use common::json_of;
use serde_json::Value;
use std::collections::BTreeSet;

#[test]
fn deformers_are_compared_with_float64_or_with_nothing() {
    let report = json_of(&["stress", "--device", "flex", "-q", "--json"]);
    let cases = report["cases"].as_array().unwrap();
    assert_eq!(report["failures"], Value::Array(Vec::new()));
    // Every part has cases where an error is no answer, so that a device that fails at everything does not pass.
    let parts = |only: &dyn Fn(&Value) -> bool| cases.iter().filter(|case| only(case)).filter_map(|case| case["part"].as_str()).collect::<BTreeSet<_>>();
    assert_eq!(parts(&|case| case["required"] == true), parts(&|_| true));
    let of = |part: &str| cases.iter().filter(|case| case["part"] == part && case["oracle"].is_string()).collect::<Vec<_>>();
    for part in ["deformer cdf", "deformer cdf-basis", "deformer deform-mlp", "deformer free-time"] {
        let compared = of(part);
        assert!(compared.len() >= 24 && compared.iter().all(|case| case["oracle"] == "float64"), "{part}: {compared:?}");
        // Rounding is visible and small: an oracle that computes the same would be off by nothing, another formula by more.
        let errors: Vec<f64> = compared.iter().filter(|case| case["level"] == "time 0.5").map(|case| case["error"].as_f64().unwrap()).collect();
        assert!(errors.len() == 4 && errors.iter().all(|e| (1e-12..1e-4).contains(e)), "{part}: {errors:?}");
    }
    // Float32 holds moved scenes worse and worse. That is a limit, not a failure, and the first decades must be drawn on every device.
    for condition in ["moved scene against the unmoved", "moved scene, turned camera"] {
        for part in ["rasterizer", "gradients"] {
            let moved = of(part).into_iter().filter(|case| case["condition"] == condition).collect::<Vec<_>>();
            let required: Vec<bool> = moved.iter().map(|case| case["required"] == true).collect();
            assert_eq!(required, [true, true, false, false, false], "{part}, {condition}: {moved:?}");
            let errors: Vec<f64> = moved.iter().map(|case| case["error"].as_f64().unwrap()).collect();
            assert!(errors[0] < 1e-3 && errors[4] > 10.0 * errors[0], "{part}, {condition}: {errors:?}");
        }
    }
    let turned = |limit: &&Value| limit["part"] == "rasterizer" && limit["condition"] == "moved scene, turned camera";
    let limit = report["limits"].as_array().unwrap().iter().find(turned).unwrap();
    assert!(limit["level"].is_string(), "{limit}");
    for part in ["deformer hexplane", "loss l1"] {
        let alone = of(part);
        assert!(!alone.is_empty() && alone.iter().all(|case| case["oracle"] == "no oracle" && case["error"].is_null()), "{part}: {alone:?}");
    }
}
