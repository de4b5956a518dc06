//! The trainings of a plan as jobs of schedulers. Each index runs `cc4dgs sweep run DIR --index I`: the training and the cells it lacks.

use super::plan::Plan;
use cc4dgs_core::{Error, Result};

/// Exit code of a process that was asked to stop and left a checkpoint.
pub const INTERRUPTED: u8 = 130;
/// Exit codes after which the same command would fail again: wrong request, wrong data, hopeless training.
const FINAL: [u8; 3] = [2, 3, 6];
/// Seconds before a time limit at which a job is asked to stop.
const NOTICE_SECONDS: u32 = 120;

/// A scheduler.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scheduler {
    /// A Slurm array script.
    Slurm,
    /// A Kubernetes Indexed Job.
    Kubernetes,
    /// A SkyPilot task; one launch per index.
    SkyPilot,
}

/// What a scheduler is told besides the plan.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EmitOptions {
    /// The sweep's folder as the jobs see it.
    pub folder: String,
    /// The folder that relative paths of the grid start from.
    pub working_folder: String,
    /// The program as the jobs see it.
    pub program: String,
    /// Processors and threads of a job.
    pub threads: usize,
    /// Memory of a job in GB (10^9 bytes).
    pub memory_gb: u32,
    /// Time limit of a job in minutes.
    pub minutes: u32,
    /// Jobs at a time; 0 is as many as the scheduler starts.
    pub parallel: usize,
    /// Container image (Kubernetes).
    pub image: String,
    /// Persistent volume claim, mounted at the working folder (Kubernetes).
    pub claim: String,
    /// Bucket, mounted at the working folder (SkyPilot).
    pub bucket: String,
}

/// The file for `scheduler`.
///
/// # Errors
/// [`Error::Parameter`] for a plan without trainings, and for texts that would need more than quoting.
pub fn emit(scheduler: Scheduler, plan: &Plan, options: &EmitOptions) -> Result<String> {
    if plan.trainings.is_empty() {
        return Err(Error::parameter(format!("sweep {}", plan.name), "it has no training", "Make the plan again from a grid with at least one cell"));
    }
    let o = options;
    for (option, text) in
        [("folder", &o.folder), ("--cd", &o.working_folder), ("--program", &o.program), ("--image", &o.image), ("--claim", &o.claim), ("--bucket", &o.bucket)]
    {
        if text.chars().any(char::is_control) {
            return Err(Error::parameter(option, "it has a line break or another control character", "Use another name"));
        }
    }
    if o.threads == 0 || o.memory_gb == 0 || o.minutes == 0 {
        return Err(Error::parameter("sweep emit", "threads, memory and minutes are positive", "Give --threads, --memory-gb and --time-limit"));
    }
    Ok(match scheduler {
        Scheduler::Slurm => slurm(plan, o),
        Scheduler::Kubernetes => kubernetes(plan, o),
        Scheduler::SkyPilot => skypilot(plan, o),
    })
}

/// `text` as one word of a shell.
fn quoted(text: &str) -> String {
    format!("'{}'", text.replace('\'', "'\\''"))
}

/// `text` as a YAML string: JSON strings are.
fn yaml(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

/// The grid's name as schedulers accept it: lower case, digits and '-'.
fn job_name(plan: &Plan) -> String {
    let name: String = plan.name.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' }).take(40).collect();
    format!("cc4dgs-{}", name.trim_matches('-'))
}

fn slurm(plan: &Plan, o: &EmitOptions) -> String {
    let last = plan.trainings.len() - 1;
    let throttle = if o.parallel > 0 { format!("%{}", o.parallel) } else { String::new() };
    let output = format!("{}/logs/slurm-%a.log", o.folder.replace('%', "%%"));
    format!(
        r#"#!/bin/bash
# {trainings} trainings, {cells} cells. Submit with: sbatch FILE. A task that is stopped before its time limit, or preempted, leaves a checkpoint and
# is queued again; finished cells are never run twice.
#SBATCH --job-name={name}
#SBATCH --array=0-{last}{throttle}
#SBATCH --cpus-per-task={threads}
#SBATCH --mem={memory}M
#SBATCH --time={minutes}
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=B:TERM@{NOTICE_SECONDS}
#SBATCH --output={output}
set -u
cd {cd} || exit 2
{program} --quiet --threads {threads} sweep run {folder} --index "$SLURM_ARRAY_TASK_ID" &
work=$!
trap 'kill -TERM "$work" 2>/dev/null' TERM INT
# A signal ends the first wait; the second one waits for the checkpoint.
wait "$work"
code=$?
while kill -0 "$work" 2>/dev/null; do
    wait "$work"
    code=$?
done
if [ "$code" -eq {INTERRUPTED} ]; then
    scontrol requeue "${{SLURM_ARRAY_JOB_ID}}_${{SLURM_ARRAY_TASK_ID}}" || true
fi
exit "$code"
"#,
        trainings = plan.trainings.len(),
        cells = plan.cells.len(),
        name = job_name(plan),
        threads = o.threads,
        memory = u64::from(o.memory_gb) * 1_000_000_000 / (1 << 20),
        minutes = o.minutes,
        cd = quoted(&o.working_folder),
        program = quoted(&o.program),
        folder = quoted(&o.folder),
    )
}

fn kubernetes(plan: &Plan, o: &EmitOptions) -> String {
    let parallel = if o.parallel > 0 { o.parallel } else { plan.trainings.len() };
    format!(
        r#"# {trainings} trainings, {cells} cells. Submit with: kubectl apply -f FILE. Interrupted and evicted pods are replaced and go on from the checkpoint;
# codes after which the same command would fail again end their index only. Needs Kubernetes 1.33, or 1.29 with its defaults.
apiVersion: batch/v1
kind: Job
metadata:
  name: {name}
spec:
  completionMode: Indexed
  completions: {trainings}
  parallelism: {parallel}
  backoffLimitPerIndex: 3
  maxFailedIndexes: {trainings}
  podFailurePolicy:
    rules:
    - action: Ignore
      onPodConditions:
      - type: DisruptionTarget
    - action: Ignore
      onExitCodes:
        containerName: cell
        operator: In
        values: [{INTERRUPTED}]
    - action: FailIndex
      onExitCodes:
        containerName: cell
        operator: In
        values: [{finals}]
  template:
    spec:
      restartPolicy: Never
      terminationGracePeriodSeconds: {NOTICE_SECONDS}
      containers:
      - name: cell
        image: {image}
        workingDir: {cd}
        command: [{program}]
        args: ["--quiet", "--threads", "{threads}", "sweep", "run", {folder}, "--index", "$(JOB_COMPLETION_INDEX)"]
        env:
        - name: JOB_COMPLETION_INDEX
          valueFrom:
            fieldRef:
              fieldPath: metadata.annotations['batch.kubernetes.io/job-completion-index']
        resources:
          requests:
            cpu: "{threads}"
            memory: {memory}M
          limits:
            memory: {memory}M
        volumeMounts:
        - name: sweep
          mountPath: {cd}
      volumes:
      - name: sweep
        persistentVolumeClaim:
          claimName: {claim}
"#,
        trainings = plan.trainings.len(),
        cells = plan.cells.len(),
        name = job_name(plan),
        finals = FINAL.map(|code| code.to_string()).join(", "),
        image = yaml(&o.image),
        cd = yaml(&o.working_folder),
        program = yaml(&o.program),
        folder = yaml(&o.folder),
        threads = o.threads,
        memory = u64::from(o.memory_gb) * 1000,
        claim = yaml(&o.claim),
    )
}

fn skypilot(plan: &Plan, o: &EmitOptions) -> String {
    let name = job_name(plan);
    let last = plan.trainings.len() - 1;
    let command = format!("{} --quiet --threads {} sweep run {} --index \"$INDEX\"", quoted(&o.program), o.threads, quoted(&o.folder));
    format!(
        r#"# {trainings} trainings, {cells} cells. Launch one managed job per index:
#   for index in $(seq 0 {last}); do sky jobs launch --yes --detach-run --name "{name}-$index" --env INDEX="$index" FILE; done
# A machine that is taken away is replaced, and the training goes on from its checkpoint in the bucket.
name: {name}
num_nodes: 1
resources:
  cpus: {threads}+
  memory: {memory}+
  use_spot: true
  job_recovery:
    strategy: FAILOVER
    max_restarts_on_errors: 3
envs:
  INDEX: null
file_mounts:
  {cd}:
    source: {bucket}
    mode: MOUNT
run: |
  cd {cd_shell} || exit 2
  {command}
  code=$?
  # Errors that would come again are no reason for a restart; `sweep collect` names them.
  case "$code" in
    {finals}) exit 0 ;;
    *) exit "$code" ;;
  esac
"#,
        trainings = plan.trainings.len(),
        cells = plan.cells.len(),
        threads = o.threads,
        memory = o.memory_gb,
        cd = yaml(&o.working_folder),
        cd_shell = quoted(&o.working_folder),
        bucket = yaml(&o.bucket),
        finals = FINAL.map(|code| code.to_string()).join("|"),
    )
}

#[cfg(test)]
mod tests {
    use super::super::plan::tests::example as plan;
    use super::*;
    use serde_json::Value;
    use yaml_rust::{Yaml, YamlLoader};

    /// What the files must have: path, and the value or type. A part of the schedulers' own schemas.
    const SHAPES: &str = include_str!("emit_shapes.json");

    fn options() -> EmitOptions {
        EmitOptions {
            folder: "/sweeps/it's a $(test)".into(),
            working_folder: "/data".into(),
            program: "/opt/cc4dgs".into(),
            threads: 2,
            memory_gb: 8,
            minutes: 60,
            parallel: 3,
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

    /// What of `shape` the value does not fulfil: objects name required keys; strings that start with `<` are types, anything else is the value itself.
    fn faults(value: &Value, shape: &Value, place: &str, found: &mut Vec<String>) {
        match shape {
            Value::Object(keys) => {
                for (key, inner) in keys {
                    match value.get(key) {
                        Some(value) => faults(value, inner, &format!("{place}.{key}"), found),
                        None => found.push(format!("{place}.{key} is missing")),
                    }
                }
            }
            Value::Array(items) => {
                for (index, inner) in items.iter().enumerate() {
                    match value.get(index) {
                        Some(value) => faults(value, inner, &format!("{place}[{index}]"), found),
                        None => found.push(format!("{place}[{index}] is missing")),
                    }
                }
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
                    found.push(format!("{place} is {value}, not {text}"));
                }
            }
            other if other != value => found.push(format!("{place} is {value}, not {other}")),
            _ => {}
        }
    }

    #[test]
    fn yaml_files_have_the_shape_of_their_schedulers() {
        let shapes: Value = serde_json::from_str(SHAPES).unwrap();
        for (name, scheduler) in [("kubernetes", Scheduler::Kubernetes), ("skypilot", Scheduler::SkyPilot)] {
            let text = emit(scheduler, &plan(), &options()).unwrap();
            let value = parse(&text);
            let mut found = Vec::new();
            faults(&value, &shapes[name], name, &mut found);
            assert!(found.is_empty(), "{}\n{text}", found.join("\n"));
            // The check itself finds mistakes.
            let wrong = parse(&text.replace("completions: 1", "completions: one").replace("cpus: 2+", "cpu: 2+"));
            faults(&wrong, &shapes[name], name, &mut found);
            assert_eq!(found.len(), 1, "{name}");
        }
    }

    #[test]
    fn indices_reach_the_program() {
        let text = emit(Scheduler::Kubernetes, &plan(), &options()).unwrap();
        let value = parse(&text);
        let container = &value["spec"]["template"]["spec"]["containers"][0];
        let arguments: Vec<&str> = container["args"].as_array().unwrap().iter().map(|a| a.as_str().unwrap()).collect();
        assert_eq!(arguments, ["--quiet", "--threads", "2", "sweep", "run", "/sweeps/it's a $(test)", "--index", "$(JOB_COMPLETION_INDEX)"]);
        let slurm = emit(Scheduler::Slurm, &plan(), &options()).unwrap();
        assert!(slurm.contains("#SBATCH --array=0-0%3\n") && slurm.contains("--index \"$SLURM_ARRAY_TASK_ID\""), "{slurm}");
    }

    /// The script as bash reads it, with a program that answers with its arguments and an exit code.
    #[cfg(unix)]
    #[test]
    fn the_slurm_script_is_bash_and_requeues_what_was_interrupted() {
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
        for (code, requeued) in [(0, ""), (6, ""), (i32::from(INTERRUPTED), "requeue 7_3\n")] {
            program("it's the program", &format!("printf '%s\\n' \"$@\" > {}\nexit {code}", at("arguments").display()));
            let options =
                EmitOptions { program: at("it's the program").display().to_string(), working_folder: folder.path().display().to_string(), ..options() };
            std::fs::write(at("array.sh"), emit(Scheduler::Slurm, &plan(), &options).unwrap()).unwrap();
            assert!(Command::new("bash").arg("-n").arg(at("array.sh")).status().unwrap().success());
            let status =
                Command::new("bash").arg(at("array.sh")).env("PATH", &path).env("SLURM_ARRAY_JOB_ID", "7").env("SLURM_ARRAY_TASK_ID", "3").status().unwrap();
            assert_eq!(status.code(), Some(code));
            let arguments = std::fs::read_to_string(at("arguments")).unwrap();
            assert_eq!(arguments.lines().collect::<Vec<_>>(), ["--quiet", "--threads", "2", "sweep", "run", "/sweeps/it's a $(test)", "--index", "3"]);
            assert_eq!(std::fs::read_to_string(at("requeued")).unwrap_or_default(), requeued);
        }
    }

    #[test]
    fn what_cannot_be_written_is_refused() {
        let empty = Plan { trainings: Vec::new(), ..plan() };
        assert!(emit(Scheduler::Slurm, &empty, &options()).unwrap_err().to_string().contains("no training"));
        let broken = EmitOptions { image: "a\nb".into(), ..options() };
        assert!(emit(Scheduler::Kubernetes, &plan(), &broken).unwrap_err().to_string().contains("--image"));
        assert!(emit(Scheduler::Slurm, &plan(), &EmitOptions { minutes: 0, ..options() }).is_err());
    }
}
