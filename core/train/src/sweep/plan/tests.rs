//! Grids that are expanded, and plans that are read back.

use super::*;

pub(in crate::sweep) fn grid(text: &str) -> Grid {
    // A family that no method is put on is refused.
    let family = if text.contains("'+") { "family = 'demo'\n" } else { "" };
    let base = format!("name = 'g'\n[[scene]]\nname = 'tiny'\npath = 'procedural:tiny'\n{family}");
    let (top, tables) = text.split_once("---").unwrap_or(("", text));
    Grid::parse("g.toml", &format!("{top}{base}{tables}")).unwrap()
}
fn expand(text: &str) -> Result<Plan> {
    Plan::expand(&grid(text), &Registry::collect().unwrap(), &|_| Ok(()))
}
const METHODS: &str = "[[method]]\nname = 'own'\npreset = '+'\n[[method]]\nname = 'planes'\npreset = '+hexplane'\n";
// This crate links no codecs, so grids of its own tests have none that could be built; the plan of trainings is what is tested here.
const CODEC: &str = "[[codec]]\nname = 'c'\ncodec = 'none-linked'\n";

/// The plan of trainings of a grid whose codecs are not built.
fn trainings(text: &str) -> Result<Vec<(PlannedTraining, toml::Table)>> {
    let (grid, registry) = (grid(text), Registry::collect().unwrap());
    let data = fingerprint(&grid.scene[0].own.path, &registry)?;
    let mut all = Vec::new();
    for (method, setting) in grid.method.iter().flat_map(|m| grid.setting.iter().map(move |s| (m, s))) {
        for &seed in &grid.seeds {
            let training = planned(&grid, &grid.scene[0], method, setting, seed, data.clone(), String::new(), &registry)?;
            let layers = training.layers(&registry)?;
            layers.config().map_err(|error| at(&training, error))?;
            all.push((training, layers.table().clone()));
        }
    }
    Ok(all)
}

#[test]
fn axes_are_multiplied_and_sized() {
    let text = format!(
        "iterations = 100\nseeds = [3, 4]\nset = ['train.batch=2']\n---{METHODS}[[setting]]\nname = 'small'\n[[setting]]\nname = 'large'\nsize = 2.5\nset = ['train.sh_degree=1']\n{CODEC}"
    );
    let all = trainings(&text).unwrap();
    assert_eq!(all.len(), 8);
    let labels: Vec<String> = all.iter().map(|(t, _)| t.label()).collect();
    assert_eq!((labels[0].as_str(), labels[7].as_str()), ("tiny own small seed 3", "tiny planes large seed 4"));
    assert_eq!((all[0].0.preset.as_str(), all[4].0.preset.as_str()), ("demo", "demo+hexplane"));
    let train = |index: usize, key: &str| all[index].1["train"][key].as_integer().unwrap();
    assert_eq!((train(0, "iterations"), train(2, "iterations"), train(2, "sh_degree"), train(7, "batch")), (100, 250, 1, 2));
    assert_eq!((all[1].1["seed"].as_integer(), all[1].1["device"].as_str()), (Some(4), Some("flex")));
    let validation = trainings(&format!("split = 'validation'\n---{METHODS}{CODEC}")).unwrap();
    assert_eq!(validation[0].1["train"]["validation"].as_integer(), Some(12));
}

#[test]
fn a_changed_kind_drops_the_settings_of_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("config.toml");
    std::fs::write(&file, "[density]\nkind = 'mcmc'\nrelocate = 0\n[train]\nbatch = 3\n").unwrap();
    let method = format!("[[method]]\nname = 'm'\npreset = 'demo'\nconfig = '{}'\n", file.display());
    let settings = "[[setting]]\nname = 'same'\n[[setting]]\nname = 'other'\nset = ['density.kind=clone-split', 'density.every=50']\n";
    let all = trainings(&format!("{method}{settings}{CODEC}")).unwrap();
    assert_eq!((all[0].1["density"]["relocate"].as_integer(), all[1].1["train"]["batch"].as_integer()), (Some(0), Some(3)));
    assert_eq!(all[1].1["density"], toml::Value::Table("kind = 'clone-split'\nevery = 50".parse().unwrap()));
}

#[test]
fn hours_are_those_of_every_size() {
    let axes = "[[method]]\nname = 'm'\npreset = 'auto'\nsize = 2.0\n[[setting]]\nname = 'small'\nsize = 0.5\n[[setting]]\nname = 'large'\nsize = 3.0\n";
    let plan_of = |top: &str| {
        let trainings = trainings(&format!("{top}seeds = [0, 1]\n---{axes}{CODEC}")).unwrap().into_iter().map(|(training, _)| training).collect();
        Plan { trainings, ..example() }
    };
    let timed = plan_of("minutes = 10.0\n");
    assert_eq!(timed.trainings.iter().map(|training| training.minutes).collect::<Vec<_>>(), [10.0, 10.0, 60.0, 60.0].map(Some));
    assert_eq!((timed.minutes(), plan_of("iterations = 10\n").minutes()), (Some(140.0), None));
}

#[test]
fn images_of_a_scene_have_one_size_in_any_time() {
    let axes = "[[method]]\nname = 'm'\npreset = 'auto'\n[[setting]]\nname = 'small'\n[[setting]]\nname = 'large'\nsize = 3.0\n";
    let refused = |set: &str| {
        let all: Vec<PlannedTraining> = trainings(&format!("minutes = 2.0\nset = [{set}]\n---{axes}{CODEC}")).unwrap().into_iter().map(|(t, _)| t).collect();
        refuse_image_sizes(&all, &Registry::collect().unwrap()).map_err(|error| error.to_string())
    };
    for open in ["", "'scene.downscale=1.0'"] {
        let message = refused(open).unwrap_err();
        let parts = ["tiny m small seed 0' has 2 minutes", "tiny m large seed 0' has 6 minutes", "scene.width"];
        assert!(parts.iter().all(|part| message.contains(part)), "{message}");
    }
    for stated in ["'scene.width=320'", "'scene.height=200'", "'scene.downscale=2.0'"] {
        assert_eq!(refused(stated), Ok(()));
    }
}

#[test]
fn minutes_of_a_set_count_for_the_size_of_images() {
    let preset = |name: &str, preset: &str| format!("[[method]]\nname = '{name}'\npreset = '{preset}'\n");
    let methods = format!("{}{}{}set = ['auto.minutes=7']\n", preset("a", "demo"), preset("b", "auto"), preset("c", "auto"));
    let refused = |set: &str| {
        let all: Vec<PlannedTraining> = trainings(&format!("set = [{set}]\n---{methods}{CODEC}")).unwrap().into_iter().map(|(t, _)| t).collect();
        refuse_image_sizes(&all, &Registry::collect().unwrap()).map_err(|error| error.to_string())
    };
    let message = refused("").unwrap_err();
    let parts = ["tiny b base seed 0' has the minutes of its preset", "tiny c base seed 0' has 7 minutes", "auto.minutes"];
    assert!(parts.iter().all(|part| message.contains(part)), "{message}");
    for equal in ["'scene.width=320'", "'auto.minutes=7'"] {
        assert_eq!(refused(equal), Ok(()));
    }
}

#[test]
fn minutes_need_a_training_that_plans() {
    let refused = |top: &str, presets: [&str; 2], set_of_second: &str| {
        let methods = format!("[[method]]\nname = 'a'\npreset = '{}'\n[[method]]\nname = 'b'\npreset = '{}'\n{set_of_second}", presets[0], presets[1]);
        let text = format!("{top}---{methods}{CODEC}");
        let all: Vec<PlannedTraining> = trainings(&text).unwrap().into_iter().map(|(training, _)| training).collect();
        refuse_minutes(&grid(&text), &all, &Registry::collect().unwrap()).map_err(|error| error.to_string())
    };
    let (minutes, own) = ("set = ['auto.minutes=7']\n", "set = ['auto.minutes=9']\n");
    for (top, presets, set) in [(minutes, ["demo", "auto"], ""), ("", ["demo", "auto+hexplane"], own), ("", ["demo", "demo+hexplane"], "")] {
        assert_eq!(refused(top, presets, set), Ok(()));
    }
    for (top, presets, set, part) in
        [(minutes, ["demo", "demo+hexplane"], "", "set: auto.minutes: 7"), ("", ["auto", "demo"], own, "[[method]] 'b', set: auto.minutes: 9")]
    {
        let message = refused(top, presets, set).unwrap_err();
        assert!(message.starts_with(part) && message.contains("only the preset auto") && message.contains("train.iterations"), "{message}");
    }
}

#[test]
fn mistakes_name_their_place() {
    let wrong = format!("{METHODS}[[setting]]\nname = 'typo'\nset = ['train.iteratons=5']\n{CODEC}");
    let message = trainings(&wrong).unwrap_err().to_string();
    assert!(message.contains("tiny own typo") && message.contains("iteratons"), "{message}");
    let message = expand(&format!("{METHODS}{CODEC}")).unwrap_err().to_string();
    assert!(message.contains("codec 'c'") && message.contains("none-linked"), "{message}");
}

#[test]
fn plans_are_read_strictly() {
    let folder = tempfile::tempdir().unwrap();
    assert!(Plan::read(folder.path()).unwrap_err().to_string().contains("sweep plan"));
    let plan = example();
    plan.write(folder.path()).unwrap();
    assert_eq!(Plan::read(folder.path()).unwrap(), plan);
    plan.check_program().unwrap();
    let other = Plan { commit: "other".into(), ..plan.clone() };
    let message = other.check_program().unwrap_err().to_string();
    assert!(message.contains("other") && message.contains("Plan again"), "{message}");
    let write = |from: &str, to: &str| {
        let text = std::fs::read_to_string(folder.path().join(PLAN)).unwrap();
        std::fs::write(folder.path().join(PLAN), text.replace(from, to)).unwrap();
        Plan::read(folder.path()).unwrap_err()
    };
    assert!(write("00000000000000c0", "../../etc/passwd").to_string().contains("passwd"));
    assert!(matches!(write("\"schema\": 1", "\"schema\": 9"), Error::Unsupported { .. }));
    assert!(matches!(write(KIND, "other"), Error::Data { .. }));
}

#[test]
fn a_plan_replaces_plans_only_and_lies_in_no_dataset() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("sweep");
    let mut plan = example();
    plan.write(&out).unwrap();
    plan.write(&out).unwrap();
    std::fs::write(out.join(PLAN), "{\"name\": \"mine\"}").unwrap();
    let message = plan.write(&out).unwrap_err().to_string();
    assert!(message.contains("plan.json") && message.contains("not the plan of a sweep"), "{message}");
    assert_eq!(std::fs::read_to_string(out.join(PLAN)).unwrap(), "{\"name\": \"mine\"}");
    let message = plan.write(&out.join(PLAN)).unwrap_err().to_string();
    assert!(message.contains("--out") && message.contains("it is a file") && message.contains("name of a folder"), "{message}");
    // A training begins when the files of its dataset are those of the plan.
    plan.trainings[0].data.path = folder.path().display().to_string();
    let inner = folder.path().join("runs/a");
    let message = plan.write(&inner).unwrap_err().to_string();
    assert!(message.contains("lies in the dataset") && message.contains("outside of the dataset") && !inner.exists(), "{message}");
}

/// A plan of one training with two cells.
pub(crate) fn example() -> Plan {
    let (version, commit) = code::version();
    let choice = CodecChoice { codec: "raw".into(), field_weights: "fp32".into(), settings: toml::Table::new() };
    let cell = |id: &str, codec: &str| PlannedCell { id: id.into(), training: "00000000000000a0".into(), codec: codec.into(), choice: choice.clone() };
    Plan {
        kind: KIND.into(),
        schema: SCHEMA,
        name: "g".into(),
        version: version.into(),
        commit: commit.into(),
        split: ScoredViews::Test,
        max_views: 0,
        images: 0,
        trainings: vec![PlannedTraining {
            id: "00000000000000a0".into(),
            scene: "tiny".into(),
            method: "own".into(),
            setting: "base".into(),
            seed: 0,
            preset: "demo".into(),
            sets: Vec::new(),
            minutes: None,
            data: DataFingerprint { path: "procedural:tiny".into(), hash: "0".into(), files: 0, bytes: 0 },
            listing: String::new(),
        }],
        cells: vec![cell("00000000000000c0", "raw"), cell("00000000000000c1", "half")],
    }
}
