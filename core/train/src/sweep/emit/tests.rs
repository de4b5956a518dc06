//! Job files against a part of their schedulers' schemas, and scripts in the hands of a shell.

use super::super::plan::PlannedTraining;
use super::super::plan::tests::example as plan;
use super::*;
use serde_json::Value;
use yaml_rust::{Yaml, YamlLoader};

/// The keys that the files have, each with its value or type. A part of the schedulers' own schemas.
const SHAPES: &str = include_str!("shapes.json");

fn options() -> EmitOptions {
    EmitOptions {
        folder: "/sweeps/it's a $(test)".into(),
        working_folder: "/data".into(),
        program: "/opt/cc4dgs".into(),
        threads: 2,
        limits: Vec::new(),
        variables: Vec::new(),
        memory_gb: 8,
        minutes: 60,
        parallel: 0,
        image: "registry.example/cc4dgs:1".into(),
        claim: "sweeps".into(),
        bucket: "s3://sweeps".into(),
    }
}

/// The one document of a YAML file.
fn parse(text: &str) -> Value {
    let mut documents = YamlLoader::load_from_str(text).unwrap_or_else(|e| panic!("{e}\n{text}"));
    assert_eq!(documents.len(), 1, "{text}");
    json(documents.remove(0))
}
fn json(yaml: Yaml) -> Value {
    match yaml {
        Yaml::Null => Value::Null,
        Yaml::Boolean(value) => value.into(),
        Yaml::Integer(value) => value.into(),
        Yaml::String(value) | Yaml::Real(value) => value.into(),
        Yaml::Array(items) => items.into_iter().map(json).collect(),
        Yaml::Hash(entries) => Value::Object(entries.into_iter().map(|(key, value)| (key.into_string().unwrap(), json(value))).collect()),
        other => panic!("{other:?} is not expected in a job file"),
    }
}

/// Where the value differs from `shape`: objects name all keys, arrays all items; strings that start with `<` are types, anything else is the value itself.
fn faults(value: &Value, shape: &Value, path: &str, found: &mut Vec<String>) {
    match shape {
        Value::Object(keys) => {
            for (key, inner) in keys {
                match value.get(key) {
                    Some(value) => faults(value, inner, &format!("{path}.{key}"), found),
                    None => found.push(format!("{path}.{key} is missing")),
                }
            }
            let unknown = value.as_object().into_iter().flatten().filter(|(key, _)| !keys.contains_key(key.as_str()));
            found.extend(unknown.map(|(key, _)| format!("{path}.{key} is unknown")));
        }
        Value::Array(items) => {
            for (index, inner) in items.iter().enumerate() {
                match value.get(index) {
                    Some(value) => faults(value, inner, &format!("{path}[{index}]"), found),
                    None => found.push(format!("{path}[{index}] is missing")),
                }
            }
            let count = value.as_array().map_or(0, Vec::len);
            found.extend((items.len()..count).map(|index| format!("{path}[{index}] is unknown")));
        }
        Value::String(text) if text.starts_with('<') => {
            let right = match text.as_str() {
                "<string>" => value.as_str().is_some_and(|s| !s.is_empty()),
                "<count>" => value.as_u64().is_some_and(|n| n > 0),
                "<name>" => value.as_str().is_some_and(|s| s.len() <= 63 && s.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-')),
                "<null>" => value.is_null(),
                other => panic!("unknown type {other}"),
            };
            if !right {
                found.push(format!("{path} is {value}, not {text}"));
            }
        }
        other if other != value => found.push(format!("{path} is {value}, not {other}")),
        _ => {}
    }
}

#[test]
fn yaml_files_have_the_shape_of_their_schedulers() {
    let shapes: Value = serde_json::from_str(SHAPES).unwrap();
    let check = |text: &str, name: &str| {
        let mut found = Vec::new();
        faults(&parse(text), &shapes[name], name, &mut found);
        found.join("\n")
    };
    let emitted = |scheduler| emit(scheduler, &plan(), &options()).unwrap();
    let (kubernetes, skypilot) = (emitted(Scheduler::Kubernetes), emitted(Scheduler::SkyPilot));
    assert_eq!(check(&kubernetes, "kubernetes"), "", "{kubernetes}");
    assert_eq!(check(&skypilot, "skypilot"), "", "{skypilot}");
    // The check itself finds wrong values, misspelt keys, and superfluous keys and items.
    for (right, wrong, found) in [
        ("completions: 1", "completions: one", "kubernetes.spec.completions is \"one\", not <count>"),
        ("backoffLimitPerIndex", "backOffLimit", "kubernetes.spec.backoffLimitPerIndex is missing\nkubernetes.spec.backOffLimit is unknown"),
        ("        workingDir:", "        tty: true\n        workingDir:", "kubernetes.spec.template.spec.containers[0].tty is unknown"),
        ("      volumes:", "      - name: second\n      volumes:", "kubernetes.spec.template.spec.containers[1] is unknown"),
    ] {
        assert!(kubernetes.contains(right), "{right}");
        assert_eq!(check(&kubernetes.replacen(right, wrong, 1), "kubernetes"), found);
    }
    for (right, wrong, found) in [
        ("  cpus: 2+", "  cpu: 2+", "skypilot.resources.cpus is missing\nskypilot.resources.cpu is unknown"),
        ("num_nodes: 1", "num_nodes: 1\nnodes: 1", "skypilot.nodes is unknown"),
        ("mode: MOUNT", "mode: COPY", "skypilot.file_mounts./data.mode is \"COPY\", not \"MOUNT\""),
    ] {
        assert!(skypilot.contains(right), "{right}");
        assert_eq!(check(&skypilot.replacen(right, wrong, 1), "skypilot"), found);
    }
}

#[test]
fn names_of_jobs_end_in_a_letter_or_digit() {
    let named = |name: &str| job_name(&Plan { name: name.into(), ..plan() });
    assert_eq!(["My_Grid.v2", "a_", "_"].map(named), ["cc4dgs-my-grid-v2", "cc4dgs-a", "cc4dgs"]);
}

/// The words of an `#SBATCH` line, as sbatch reads them (`get_argument` in Slurm's sources).
fn sbatch_words(line: &str) -> Vec<String> {
    let (mut words, mut word, mut quote, mut escaped): (Vec<String>, String, Option<char>, bool) = Default::default();
    for c in line.strip_prefix("#SBATCH").unwrap().chars() {
        match c {
            _ if escaped => {
                word.push(c);
                escaped = false;
            }
            '\\' => escaped = true,
            '"' | '\'' if quote.is_none() => quote = Some(c),
            _ if quote == Some(c) => quote = None,
            '#' if quote.is_none() => break,
            ' ' if quote.is_none() => words.push(std::mem::take(&mut word)),
            _ => word.push(c),
        }
    }
    assert!(quote.is_none() && !escaped, "{line}");
    words.push(word);
    words.retain(|word| !word.is_empty());
    words
}

#[test]
fn sbatch_finds_the_log_in_any_folder() {
    let output = |folder: &str| {
        let text = emit(Scheduler::Slurm, &plan(), &EmitOptions { folder: folder.into(), ..options() }).unwrap();
        sbatch_words(text.lines().find(|line| line.contains("--output")).unwrap())
    };
    for folder in ["/sweeps/plain", "/my sweeps/it's a $(test)", "/a \"quoted\" #1"] {
        assert_eq!(output(folder), [format!("--output={folder}/logs/slurm-%a.log")]);
    }
    assert_eq!(output("/100 %"), ["--output=/100 %%/logs/slurm-%a.log"]);
    // The program looks for a relative folder in its working folder.
    assert_eq!(output("runs/a"), ["--output=/data/runs/a/logs/slurm-%a.log"]);
    let error = emit(Scheduler::Slurm, &plan(), &EmitOptions { folder: "/a\\b".into(), ..options() }).unwrap_err().to_string();
    assert!(error.contains("backslash") && error.contains("--job-dir"), "{error}");
}

#[test]
fn jobs_stop_before_their_time_limit() {
    assert_eq!([1, 2, 3, 60, u32::MAX].map(stop_after), [60, 60, 60, 3480, 2_147_483_647]);
    let of = |scheduler, minutes| emit(scheduler, &plan(), &EmitOptions { minutes, ..options() }).unwrap();
    assert!(of(Scheduler::Slurm, 90).contains("#SBATCH --time=90\n") && of(Scheduler::Slurm, 4).contains("#SBATCH --time=4\n"));
    let error = emit(Scheduler::Slurm, &plan(), &EmitOptions { minutes: 3, ..options() }).unwrap_err().to_string();
    assert!(error.contains("--time-limit: 3 minutes") && error.contains("at least 4 minutes"), "{error}");
    let pod = parse(&of(Scheduler::Kubernetes, 90));
    assert_eq!(pod["spec"]["template"]["spec"]["activeDeadlineSeconds"], 5280);
    assert!(pod["spec"].get("activeDeadlineSeconds").is_none(), "that would be a limit for all indices together");
    let task = parse(&of(Scheduler::SkyPilot, 90));
    assert!(task["run"].as_str().unwrap().contains("\ntimeout --preserve-status --kill-after=120 5280 '/opt/cc4dgs' --quiet"), "{task}");
}

#[test]
fn indices_reach_the_program() {
    let text = emit(Scheduler::Kubernetes, &plan(), &options()).unwrap();
    let value = parse(&text);
    let container = &value["spec"]["template"]["spec"]["containers"][0];
    let arguments: Vec<&str> = container["args"].as_array().unwrap().iter().map(|a| a.as_str().unwrap()).collect();
    let id = plan().id();
    assert_eq!(arguments, ["--quiet", "--threads", "2", "sweep", "run", "/sweeps/it's a $$(test)", "--plan", &id, "--index", "$(JOB_COMPLETION_INDEX)"]);
    let slurm = emit(Scheduler::Slurm, &plan(), &EmitOptions { parallel: 3, ..options() }).unwrap();
    assert!(slurm.contains("#SBATCH --array=0-0%3\n") && slurm.contains(&format!("--plan {id} --index \"$SLURM_ARRAY_TASK_ID\"")), "{slurm}");
    let sky = emit(Scheduler::SkyPilot, &plan(), &options()).unwrap();
    assert!(sky.contains(&format!("--plan {id} --index \"$INDEX\"")), "{sky}");
    let mut grown = plan();
    grown.trainings.push(PlannedTraining { id: "another".into(), ..grown.trainings[0].clone() });
    assert!(plan().check_id(&id).is_ok());
    assert!(grown.check_id(&id).unwrap_err().to_string().contains("sweep emit"));
}

#[test]
fn limits_reach_the_program() {
    let limited = EmitOptions { limits: ["max_bytes=7", "max_pixels=9"].map(String::from).to_vec(), ..options() };
    let of = |scheduler| emit(scheduler, &plan(), &limited).unwrap();
    for scheduler in [Scheduler::Slurm, Scheduler::SkyPilot] {
        let text = of(scheduler);
        assert!(text.contains(" --threads 2 --limit 'max_bytes=7' --limit 'max_pixels=9' sweep run "), "{text}");
    }
    let pod = parse(&of(Scheduler::Kubernetes));
    let arguments = &pod["spec"]["template"]["spec"]["containers"][0]["args"];
    assert_eq!(arguments.as_array().unwrap()[3..8], ["--limit", "max_bytes=7", "--limit", "max_pixels=9", "sweep"].map(Value::from));
}

#[test]
fn variables_reach_the_jobs() {
    let emitted = |scheduler, path: &str, variables: &[&str]| {
        let mut plan = plan();
        plan.trainings[0].data.path = path.into();
        emit(scheduler, &plan, &EmitOptions { variables: variables.iter().map(ToString::to_string).collect(), ..options() })
    };
    let job = |scheduler| emitted(scheduler, "$CC4DGS_DATA/mutant", &["CC4DGS_DATA=/it's $(HOME)", "no=1=2"]).unwrap();
    let pod = parse(&job(Scheduler::Kubernetes));
    let environment = &pod["spec"]["template"]["spec"]["containers"][0]["env"];
    assert_eq!(environment.as_array().unwrap().len(), 3, "{environment}");
    assert_eq!(environment[1], serde_json::json!({ "name": "CC4DGS_DATA", "value": "/it's $$(HOME)" }));
    assert_eq!(environment[2], serde_json::json!({ "name": "no", "value": "1=2" }));
    let task = parse(&job(Scheduler::SkyPilot));
    assert_eq!(task["envs"], serde_json::json!({ "INDEX": null, "CC4DGS_DATA": "/it's $(HOME)", "no": "1=2" }));
    let slurm = job(Scheduler::Slurm);
    assert!(slurm.contains("\nexport CC4DGS_DATA='/it'\\''s $(HOME)'\nexport no='1=2'\ncd "), "{slurm}");

    // Where scenes start from a variable, jobs have it or there is no file. Every system has PATH.
    let refused = |scheduler, path: &str, variables: &[&str]| emitted(scheduler, path, variables).unwrap_err().to_string();
    for scheduler in [Scheduler::Kubernetes, Scheduler::SkyPilot] {
        let message = refused(scheduler, "$PATH/mutant", &["OTHER=1"]);
        assert!(message.contains("scene $PATH/mutant") && message.contains("--env PATH=DIR"), "{message}");
    }
    let here = format!("\nexport PATH={}\n", quoted(&std::env::var("PATH").unwrap()));
    assert!(emitted(Scheduler::Slurm, "$PATH/mutant", &[]).unwrap().contains(&here));
    assert!(emitted(Scheduler::Slurm, "$PATH/mutant", &["PATH=/there"]).unwrap().contains("\nexport PATH='/there'\n"));
    let message = refused(Scheduler::Slurm, "$CC4DGS_NO_SUCH_VARIABLE/mutant", &[]);
    assert!(message.contains("CC4DGS_NO_SUCH_VARIABLE is not set here"), "{message}");
    assert_eq!(value_here("A", Ok("/data".into())), Ok("/data".into()));
    assert!([Ok(String::new()), Err(VarError::NotPresent)].into_iter().all(|found| value_here("A", found).unwrap_err().contains("A is not set here")));
    for wrong in [&["A"][..], &["A="], &["1A=x"], &["A B=x"], &["=x"], &["INDEX=3"], &["A=x", "A=y"], &["A=x\ny"]] {
        assert!(emitted(Scheduler::SkyPilot, "procedural:tiny", wrong).is_err(), "{wrong:?}");
    }
}

#[cfg(unix)]
#[test]
fn a_variable_that_is_not_unicode_is_not_called_absent() {
    let value: std::ffi::OsString = std::os::unix::ffi::OsStringExt::from_vec(b"/d\xe9part".to_vec());
    let message = value_here("CC4DGS_DATA", Err(VarError::NotUnicode(value))).unwrap_err();
    assert!(message.contains("CC4DGS_DATA is not Unicode here") && message.contains("part") && !message.contains("not set"), "{message}");
}

/// The script as bash reads it, with a program that answers with its arguments, a variable and an exit code. Slurm's notice is a signal to the script alone;
/// where a task is cancelled or preempted, the program gets one, too.
#[cfg(unix)]
#[test]
fn the_slurm_script_is_bash_and_requeues_what_was_asked_to_stop_before_its_limit() {
    use std::os::unix::fs::PermissionsExt;
    use std::process::Command;
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let program = |name: &str, text: &str| {
        std::fs::write(at(name), format!("#!/bin/bash\n{text}\n")).unwrap();
        std::fs::set_permissions(at(name), std::fs::Permissions::from_mode(0o755)).unwrap();
    };
    program("scontrol", &format!("echo \"$@\" >> {}", at("requeued").display()));
    let path = format!("{}:{}", folder.path().display(), std::env::var("PATH").unwrap_or_default());
    let interrupted = i32::from(INTERRUPTED);
    // Sends signals, and waits until it is asked to stop: by none or by two signals it ends with 1.
    let signalled = |signals: &str| {
        let wait = "for _ in $(seq 200); do [ $asked -gt 0 ] && break; sleep 0.05; done; sleep 0.3";
        format!("asked=0; trap 'asked=$((asked + 1))' TERM\n{signals}\n{wait}\n[ $asked -eq 1 ] && exit {interrupted}\nexit 1")
    };
    for (end, code, requeued) in [
        ("exit 0".to_string(), 0, ""),
        ("exit 6".to_string(), 6, ""),
        (signalled("kill -USR1 $PPID"), interrupted, "requeue 7_3\n"),
        // Cancelled, which must not be undone, or preempted, where Slurm itself queues the task again.
        (signalled("kill -TERM $PPID $$"), interrupted, ""),
    ] {
        std::fs::remove_file(at("requeued")).ok();
        program("it's the program", &format!("printf '%s\\n' \"$@\" \"$CC4DGS_DATA\" > {}\n{end}", at("arguments").display()));
        let options = EmitOptions {
            program: at("it's the program").display().to_string(),
            working_folder: folder.path().display().to_string(),
            variables: vec!["CC4DGS_DATA=/it's $HOME".into()],
            ..options()
        };
        std::fs::write(at("array.sh"), emit(Scheduler::Slurm, &plan(), &options).unwrap()).unwrap();
        assert!(Command::new("bash").arg("-n").arg(at("array.sh")).status().unwrap().success());
        let status =
            Command::new("bash").arg(at("array.sh")).env("PATH", &path).env("SLURM_ARRAY_JOB_ID", "7").env("SLURM_ARRAY_TASK_ID", "3").status().unwrap();
        assert_eq!(status.code(), Some(code));
        let arguments = std::fs::read_to_string(at("arguments")).unwrap();
        assert_eq!(
            arguments.lines().collect::<Vec<_>>(),
            ["--quiet", "--threads", "2", "sweep", "run", "/sweeps/it's a $(test)", "--plan", &plan().id(), "--index", "3", "/it's $HOME"]
        );
        assert_eq!(std::fs::read_to_string(at("requeued")).unwrap_or_default(), requeued);
    }
}

/// Slurm refuses arrays with more tasks than its `MaxArraySize`, so a task of a large plan has several trainings.
#[cfg(unix)]
#[test]
fn arrays_of_slurm_are_no_larger_than_it_takes() {
    use std::os::unix::fs::PermissionsExt;
    use std::process::Command;
    let with = |trainings: usize| {
        let mut large = plan();
        large.trainings = vec![large.trainings[0].clone(); trainings];
        large
    };
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let program = |name: &str, text: &str| {
        std::fs::write(at(name), format!("#!/bin/bash\n{text}\n")).unwrap();
        std::fs::set_permissions(at(name), std::fs::Permissions::from_mode(0o755)).unwrap();
    };
    let options = EmitOptions { program: at("program").display().to_string(), working_folder: folder.path().display().to_string(), ..options() };
    let script = |trainings: usize| emit(Scheduler::Slurm, &with(trainings), &options).unwrap();
    for (trainings, array) in [(1001, "--array=0-1000\n"), (1002, "--array=0-1000\n"), (7, "--array=0-6\n")] {
        assert!(script(trainings).contains(array), "{trainings}");
    }
    program("scontrol", &format!("echo \"$@\" >> {}", at("requeued").display()));
    let path = format!("{}:{}", folder.path().display(), std::env::var("PATH").unwrap_or_default());
    std::fs::write(at("array.sh"), script(2500)).unwrap();
    let interrupted = i32::from(INTERRUPTED);
    // The last argument is the index.
    let notice = format!("trap 'exit {interrupted}' TERM; kill -USR1 $PPID; for _ in $(seq 200); do sleep 0.05; done; exit 1");
    for (task, end, code, indices, requeued) in [
        ("3", "exit 0", 0, "3\n1004\n2005\n", ""),
        ("999", "exit 0", 0, "999\n2000\n", ""),
        ("3", "[ \"${!#}\" = 1004 ] && exit 6; exit 0", 6, "3\n1004\n2005\n", ""),
        ("3", notice.as_str(), interrupted, "3\n", "requeue 7_3\n"),
        // Cancelled: the program was asked to stop by Slurm itself.
        ("3", "exit 130", interrupted, "3\n", ""),
    ] {
        std::fs::remove_file(at("requeued")).ok();
        std::fs::remove_file(at("indices")).ok();
        program("program", &format!("echo \"${{!#}}\" >> {}\n{end}", at("indices").display()));
        let status =
            Command::new("bash").arg(at("array.sh")).env("PATH", &path).env("SLURM_ARRAY_JOB_ID", "7").env("SLURM_ARRAY_TASK_ID", task).status().unwrap();
        assert_eq!(status.code(), Some(code), "{end}");
        assert_eq!(std::fs::read_to_string(at("indices")).unwrap(), indices, "{end}");
        assert_eq!(std::fs::read_to_string(at("requeued")).unwrap_or_default(), requeued, "{end}");
    }
}

#[test]
fn what_cannot_be_written_is_refused() {
    let empty = Plan { trainings: Vec::new(), ..plan() };
    assert!(emit(Scheduler::Slurm, &empty, &options()).unwrap_err().to_string().contains("no training"));
    let broken = EmitOptions { image: "a\nb".into(), ..options() };
    assert!(emit(Scheduler::Kubernetes, &plan(), &broken).unwrap_err().to_string().contains("--image"));
    assert!(emit(Scheduler::Slurm, &plan(), &EmitOptions { minutes: 0, ..options() }).is_err());
    let several = EmitOptions { parallel: 3, ..options() };
    assert!(emit(Scheduler::Kubernetes, &plan(), &several).unwrap().contains("  parallelism: 3\n"));
    let message = emit(Scheduler::SkyPilot, &plan(), &several).unwrap_err().to_string();
    assert!(message.contains("--parallel: 3") && message.contains("Leave it out"), "{message}");
}
