//! `cc4dgs stress`: what is compared with what.
#![allow(clippy::unwrap_used, reason = "a test that meets an error should stop there, in helpers too")]

mod common;

use common::json_of;
use serde_json::Value;
use std::collections::BTreeSet;

#[test]
fn deformers_and_loss_terms_are_compared_with_float64() {
    let report = json_of(&["stress", "--device", "flex", "-q", "--json"]);
    let cases = report["cases"].as_array().unwrap();
    assert_eq!(report["failures"], Value::Array(Vec::new()));
    // Every part has cases where an error is no answer, so that a device that fails at everything does not pass.
    let parts = |only: &dyn Fn(&Value) -> bool| cases.iter().filter(|case| only(case)).filter_map(|case| case["part"].as_str()).collect::<BTreeSet<_>>();
    assert_eq!(parts(&|case| case["required"] == true), parts(&|_| true));
    let of = |part: &str| cases.iter().filter(|case| case["part"] == part && case["oracle"].is_string()).collect::<Vec<_>>();
    // All deformers but the one that moves nothing.
    let deformers: BTreeSet<&str> = parts(&|_| true).into_iter().filter(|part| part.starts_with("deformer ") && *part != "deformer none").collect();
    assert_eq!(deformers.len(), 10, "{deformers:?}");
    for part in deformers {
        let compared = of(part);
        assert!(compared.len() >= 30 && compared.iter().all(|case| case["oracle"] == "float64"), "{part}: {compared:?}");
        let at_half = compared.iter().filter(|case| case["level"] == "time 0.5");
        let errors: Vec<(&str, f64)> = at_half.map(|case| (case["condition"].as_str().unwrap(), case["error"].as_f64().unwrap())).collect();
        assert_eq!(errors.len(), 5, "{part}: {errors:?}");
        for (condition, error) in errors {
            // Rounding is visible and small: an oracle that computes the same would be off by nothing, another formula by more. The exception are zeros: this
            // deformer moves nothing outside the box.
            let zeros = part == "deformer swift4d-hash" && condition.contains("outside");
            // Float32 rounds a position in the box by up to 3e-8, and its product with the cells of a level by half an ulp. On the finest level of swift4d-hash
            // (524,287 cells per axis) each is up to 0.016 cells, on that of grid4d (2,047 cells) 6e-5. In the other conditions both are exact there.
            let most = match part {
                "deformer swift4d-hash" if condition == "centres in the box" => 0.02,
                "deformer grid4d" if condition == "centres in the box" => 1e-3,
                _ => 1e-4,
            };
            assert!(if zeros { error == 0.0 } else { (1e-12..most).contains(&error) }, "{part}, {condition}: {error:e}");
        }
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
    // The value of a loss term is one number, which may be exact by chance.
    let losses: BTreeSet<&str> = parts(&|_| true).into_iter().filter(|part| part.starts_with("loss ")).collect();
    assert_eq!(losses.len(), 8, "{losses:?}");
    for part in losses {
        let compared = of(part);
        let good = |case: &&Value| case["oracle"] == "float64" && case["error"].as_f64().is_some_and(|error| error < 1e-5);
        assert!(compared.len() == 5 && compared.iter().all(good), "{part}: {compared:?}");
    }
    let alone = of("deformer none");
    assert!(!alone.is_empty() && alone.iter().all(|case| case["oracle"] == "no oracle" && case["error"].is_null()), "{alone:?}");
}
