//! `cc4dgs sweep` as its users meet it: a grid, a folder, processes, exit codes.
#![allow(clippy::unwrap_used, reason = "a test that meets an error should stop there, in helpers too")]

mod common;

use common::{cc4dgs, fail, json_of, read_json, run, said, text};
use serde_json::Value;
use std::path::Path;

const GRID: &str = "name = 'small'
iterations = 90
images = 1
max_views = 2
validation = 2
[[scene]]
name = 'tiny'
path = 'procedural:tiny'
family = 'demo'
[[method]]
name = 'cdf'
preset = '+'
[[method]]
name = 'still'
preset = '+none'
[[codec]]
name = 'raw'
codec = 'raw'
[[codec]]
name = 'half'
codec = 'quantize'
field_weights = 'fp16'
";

/// The report of a command that succeeds.
fn succeed(args: &[&str]) -> Value {
    json_of(&[args, &["-q", "--json"]].concat())
}

/// The results of a sweep by file name, without what differs between equal runs.
fn results(folder: &Path) -> Vec<(String, Value)> {
    let mut found: Vec<(String, Value)> = std::fs::read_dir(folder.join("results"))
        .unwrap()
        .map(|entry| {
            let path = entry.unwrap().path();
            let mut result: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
            result.as_object_mut().unwrap().remove("cost");
            (path.file_name().unwrap().to_str().unwrap().to_string(), result)
        })
        .collect();
    found.sort_by(|a, b| a.0.cmp(&b.0));
    found
}

#[test]
fn a_grid_becomes_tables() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("grid.toml"), GRID).unwrap();
    let (grid, pool, single) = (at("grid.toml"), at("pool"), at("single"));
    for out in [&pool, &single] {
        let report = succeed(&["sweep", "plan", text(&grid), "--out", text(out)]);
        assert_eq!((&report["trainings"], &report["cells"]), (&Value::from(2), &Value::from(4)), "{report}");
    }
    // Missing cells are named.
    succeed(&["sweep", "run", text(&single), "--index", "1"]);
    let said = fail(&["sweep", "collect", text(&single), "-q"], 3);
    assert!(said.contains("2 of 4 cells are missing") && said.contains("tiny cdf base seed 0 half") && said.contains("not begun"), "{said}");
    let report = succeed(&["report", text(&single), "--images", "none"]);
    assert!(report["gap"].as_str().unwrap().starts_with("2 of 4 cells of the sweep are missing: tiny cdf base seed 0 raw;"), "{report}");
    let page = std::fs::read_to_string(report["html"].as_str().unwrap()).unwrap();
    assert!(page.contains("2 of 4 cells of the sweep are missing"), "said on the page");
    let plan: Value = serde_json::from_slice(&std::fs::read(single.join("plan.json")).unwrap()).unwrap();
    let said = fail(&["sweep", "run", text(&single), "--plan", "0123456789abcdef", "--index", "0", "-q"], 2);
    assert!(said.contains("may be other trainings"), "{said}");
    let cell = |index: usize| plan["cells"][index]["id"].as_str().unwrap();
    // One cell trains; the other one of the training finds it trained.
    succeed(&["sweep", "run", text(&single), "--cell", cell(0)]);
    let trained = single.join("trainings").join(plan["trainings"][0]["id"].as_str().unwrap()).join("training.json");
    let written = std::fs::metadata(&trained).unwrap().modified().unwrap();
    let second = succeed(&["sweep", "run", text(&single), "--cell", cell(1)]);
    assert_eq!((second.as_array().unwrap().len(), second[0]["id"].as_str()), (1, Some(cell(1))));
    assert_eq!(std::fs::metadata(&trained).unwrap().modified().unwrap(), written, "trained once");

    // The pool reaches the same results, and leaves them alone when it runs again.
    let report = succeed(&["sweep", "run", text(&pool), "--jobs", "2", "--threads", "1"]);
    assert_eq!((&report["finished"], &report["planned"]), (&Value::from(4), &Value::from(4)), "{report}");
    let (mut threads_differ, whole) = (results(&single), results(&pool));
    for (_, result) in &mut threads_differ {
        result["provenance"]["device"]["threads"] = Value::from(1);
    }
    assert_eq!(threads_differ, whole);
    let times = |folder: &Path| {
        results(folder).iter().map(|(name, _)| std::fs::metadata(folder.join("results").join(name)).unwrap().modified().unwrap()).collect::<Vec<_>>()
    };
    let before = times(&pool);
    succeed(&["sweep", "run", text(&pool), "--jobs", "2"]);
    assert_eq!(times(&pool), before);

    let (_, result) = &whole[0];
    let column = |name: &str| result["images"][name].as_array().unwrap().clone();
    assert!(["camera", "frame", "truth", "render"].into_iter().all(|name| column(name).len() == 2), "{result}");
    let names = [column("truth"), column("render")].concat();
    let kept: Vec<&str> = names.iter().filter_map(Value::as_str).collect();
    let stored: Value = serde_json::from_slice(&std::fs::read(pool.join("results").join(&whole[0].0)).unwrap()).unwrap();
    let peaks = ["training_peak_memory_mb", "cell_peak_memory_mb"].map(|key| stored["cost"][key].as_f64());
    assert!(peaks.iter().all(|peak| *peak > Some(1.0)) || !cfg!(target_os = "linux"), "{}", stored["cost"]);
    let trained = &stored["cost"]["training_devices"];
    assert!(trained.as_array().unwrap().len() == 1 && trained[0]["threads"] == 1 && trained[0]["host"].is_string(), "{trained}");
    assert!(kept.len() == 2 && kept.iter().all(|name| pool.join(name).is_file()), "{kept:?}");
    let protocol = &result["metrics"]["psnr_db"]["protocol"];
    assert!(protocol["rounding"] == "eight-bit" && protocol["frames"]["count"] == 2, "{protocol}");
    assert!(result["absent"]["ms_ssim"].as_str().unwrap().contains("too small"), "{}", result["absent"]);
    assert!(result["curve"]["iteration"].as_array().unwrap().last() == Some(&Value::from(90)), "{}", result["curve"]);
    let curve = &stored["validation_curve"];
    assert!(curve["iteration"].as_array().unwrap().last() == Some(&Value::from(90)) && curve["psnr_db"][0].as_f64() > Some(1.0), "{curve}");
    assert_eq!(curve["iteration"].as_array().unwrap().len(), stored["cost"]["validation_seconds"].as_array().unwrap().len());
    assert_eq!(result["provenance"]["configuration"]["train"]["iterations"], 90);

    let report = succeed(&["sweep", "collect", text(&pool)]);
    assert_eq!((&report["finished"], &report["in_table"]), (&Value::from(4), &Value::from(4)), "{report}");
    let table = std::fs::read_to_string(pool.join("table.md")).unwrap();
    assert!(table.contains("| cdf | base | half | 1 |") && table.contains("## tiny"), "{table}");
    assert_eq!(std::fs::read_to_string(pool.join("results.jsonl")).unwrap().lines().count(), 4);
    assert_eq!(succeed(&["sweep", "collect", text(&pool), "--where", "codec=raw"])["in_table"], 2);

    // Results of other devices make no table.
    let name = pool.join("results").join(&whole[0].0);
    let other = std::fs::read_to_string(&name).unwrap().replace("\"name\":\"flex\"", "\"name\":\"ndarray\"");
    std::fs::write(&name, other).unwrap();
    let said = fail(&["sweep", "collect", text(&pool), "-q"], 3);
    assert!(said.contains("two devices") && said.contains("flex") && said.contains("ndarray"), "{said}");
}

#[test]
fn a_codec_that_fails_keeps_no_other_from_being_tried() {
    let folder = tempfile::tempdir().unwrap();
    let (grid, sweep) = (folder.path().join("grid.toml"), folder.path().join("sweep"));
    let text_of_grid = "name = 'strict'
iterations = 30
images = 0
max_views = 1
[[scene]]
name = 'tiny'
path = 'procedural:tiny'
family = 'demo'
[[method]]
name = 'still'
preset = '+none'
[[codec]]
name = 'impossible'
codec = 'compact:max-size=0.0001MB'
[[codec]]
name = 'raw'
codec = 'raw'
";
    std::fs::write(&grid, text_of_grid).unwrap();
    succeed(&["sweep", "plan", text(&grid), "--out", text(&sweep)]);
    let said = fail(&["sweep", "run", text(&sweep), "--index", "0", "-q"], 2);
    assert!(said.contains("codec compact"), "{said}");
    let found = results(&sweep);
    assert!(found.len() == 1 && found[0].1["axes"]["codec"] == "raw", "{found:?}");
    let said = fail(&["sweep", "collect", text(&sweep), "-q"], 3);
    assert!(said.contains("1 of 2 cells is missing") && said.contains("impossible") && said.contains("codec compact"), "{said}");
}

#[test]
fn plans_are_by_content_and_mistakes_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let plan = |text_of_grid: &str, name: &str| -> Result<Vec<String>, String> {
        let (grid, out) = (folder.path().join("grid.toml"), folder.path().join(name));
        std::fs::write(&grid, text_of_grid).unwrap();
        let output = run(&["sweep", "plan", text(&grid), "--out", text(&out), "-q"]);
        if !output.status.success() {
            assert_eq!(output.status.code(), Some(2));
            return Err(String::from_utf8_lossy(&output.stderr).into_owned());
        }
        let plan: Value = serde_json::from_slice(&std::fs::read(out.join("plan.json")).unwrap()).unwrap();
        let ids = |key: &str| plan[key].as_array().unwrap().iter().map(|t| t["id"].as_str().unwrap().to_string()).collect::<Vec<_>>();
        Ok([ids("trainings"), ids("cells")].concat())
    };
    let first = plan(GRID, "a").unwrap();
    assert_eq!(first.len(), 6);
    assert_eq!(plan(GRID, "b").unwrap(), first, "the same grid has the same names");
    let renamed = plan(&GRID.replace("'still'", "'static'"), "c").unwrap();
    assert_eq!(renamed, first, "names of axes are no content");
    let seeded = plan(&format!("seeds = [1]\n{GRID}"), "d").unwrap();
    assert!(seeded.iter().all(|id| !first.contains(id)));
    let codec = plan(&GRID.replace("fp16", "int8"), "e").unwrap();
    assert_eq!(codec.iter().filter(|id| first.contains(id)).count(), 4, "another weight codec changes two cells and no training");

    for (from, to, expected) in [
        ("'+none'", "'+nnoe'", "none"),
        ("'quantize'", "'quantise'", "quantize"),
        ("'fp16'", "'fp15'", "fp16"),
        ("procedural:tiny", "no/such/scene", "no/such/scene"),
        ("images = 1", "set = ['deformer.capasity=small']", "capasity"),
        ("images = 1", "set = ['train.iteratons=3']", "iteratons"),
        ("iterations = 90", "minutes = 2.0", "auto"),
        ("preset = '+none'", "preset = '+'", "same training"),
        ("images = 1", "image = 1", "image"),
        ("images = 1", "set = ['device=wgpu']", "top of the grid"),
        ("iterations = 90", "set = ['seed=3']", "seeds = [0]"),
    ] {
        let said = plan(&GRID.replace(from, to), "wrong").unwrap_err();
        assert!(said.contains(expected), "{to}: {said}");
    }
    assert!(!folder.path().join("wrong").exists(), "a refused plan leaves nothing behind");
    let sized = GRID.replace("iterations = 90", "minutes = 2.0").replace("family = 'demo'", "").replace("preset = '+none'", "preset = '+none'\nsize = 3.0");
    let said = plan(&sized, "wrong").unwrap_err();
    assert!(said.contains("has 6 minutes") && said.contains("scene.width"), "{said}");
    std::fs::write(
        folder.path().join("sized.toml"),
        sized.replace("images = 1", "images = 1\nset = ['scene.width=40', 'density.max_gaussians=500', 'appearance.lr=0.001']"),
    )
    .unwrap();
    assert_eq!(succeed(&["sweep", "plan", text(&folder.path().join("sized.toml"))])["minutes"], 8.0, "sizes count");
    let out = folder.path().join("a");
    assert!(fail(&["sweep", "run", text(&out), "--index", "2"], 2).contains("the plan has 2"));
    assert!(fail(&["sweep", "run", text(&out), "--cell", "0"], 2).contains("no such cell"));
    assert!(fail(&["sweep", "run", text(folder.path())], 2).contains("sweep plan"));
    let text_of_plan = std::fs::read_to_string(out.join("plan.json")).unwrap();
    let commit = serde_json::from_str::<Value>(&text_of_plan).unwrap()["commit"].as_str().unwrap().to_string();
    std::fs::write(out.join("plan.json"), text_of_plan.replace(&format!("\"commit\": \"{commit}\""), "\"commit\": \"other\"")).unwrap();
    assert!(fail(&["sweep", "run", text(&out)], 2).contains("was planned by"));
}

/// The grids of this repository; scenes that are not here are replaced by a built-in one.
#[test]
fn the_grids_of_the_studies_expand() {
    let folder = tempfile::tempdir().unwrap();
    let grids = std::fs::canonicalize("../../benches/grids").unwrap();
    let mut count = 0;
    for entry in std::fs::read_dir(&grids).unwrap() {
        let path = entry.unwrap().path();
        let mut text_of_grid = std::fs::read_to_string(&path).unwrap();
        for dataset in ["dnerf_mutant", "panoptic_basketball"] {
            text_of_grid = text_of_grid.replace(&format!("$CC4DGS_DATA/{dataset}"), "procedural:tiny");
        }
        // Paths in a grid are relative to the working directory.
        text_of_grid = text_of_grid.replace("config = \"benches", &format!("config = \"{}", grids.parent().unwrap().display()));
        let grid = folder.path().join(path.file_name().unwrap());
        std::fs::write(&grid, text_of_grid).unwrap();
        let report = succeed(&["sweep", "plan", text(&grid)]);
        assert!(report["cells"].as_u64().unwrap() > 0, "{}: {report}", path.display());
        count += 1;
    }
    assert!(count >= 10, "{count} grids");
}

#[test]
fn job_files_are_printed() {
    let folder = tempfile::tempdir().unwrap();
    let (grid, out) = (folder.path().join("grid.toml"), folder.path().join("sweep"));
    std::fs::write(&grid, GRID).unwrap();
    succeed(&["sweep", "plan", text(&grid), "--out", text(&out)]);
    for (scheduler, expected) in [("slurm", "#SBATCH --array=0-1\n"), ("k8s", "completions: 2\n"), ("skypilot", "seq 0 1")] {
        let output = run(&["--threads", "3", "sweep", "emit", scheduler, text(&out)]);
        let file = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success() && file.contains(expected) && file.contains(text(&out)) && file.contains("sweep"), "{file}");
    }
    assert!(fail(&["sweep", "emit", "pbs", text(&out)], 2).contains("slurm"));
    let hash = || read_json(&out.join("plan.json"))["trainings"][0]["data"]["hash"].as_str().unwrap().to_string();
    let stated = hash();
    // Pods do not have the variables of this machine.
    std::fs::write(&grid, GRID.replace("procedural:tiny", "$CC4DGS_SCENE")).unwrap();
    let planned = cc4dgs().env("CC4DGS_SCENE", "procedural:tiny").args(["sweep", "plan", text(&grid), "--out", text(&out), "-q"]).output().unwrap();
    assert!(planned.status.success(), "{}", said(&planned));
    assert_eq!(hash(), stated, "the scene counts, not the variable that names it");
    assert!(fail(&["sweep", "emit", "k8s", text(&out)], 2).contains("--env CC4DGS_SCENE=DIR"));
    let output = run(&["sweep", "emit", "k8s", text(&out), "--env", "CC4DGS_SCENE=procedural:tiny"]);
    let file = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && file.contains("value: \"procedural:tiny\""), "{file}");
}
