//! The trainings of a plan as jobs of schedulers. Each index runs `cc4dgs sweep run DIR --plan ID --index I`: the training and the cells it lacks.

mod slurm;

use super::location::variable_of;
use super::plan::Plan;
use cc4dgs_core::{Error, Result, plural};
use std::collections::BTreeMap;
use std::env::VarError;

/// Exit code of a process that was asked to stop and left a checkpoint.
pub const INTERRUPTED: u8 = 130;
/// Exit codes after which the same command would fail again: wrong request, wrong data, hopeless training.
const FINAL: [u8; 3] = [2, 3, 6];
/// Variables that tell a job which training it is.
const INDEX_VARIABLES: [&str; 4] = ["SLURM_ARRAY_JOB_ID", "SLURM_ARRAY_TASK_ID", "JOB_COMPLETION_INDEX", "INDEX"];
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
    /// Limits of the machines that jobs run on, each `KEY=VALUE`; see [`super::Worker::limits`].
    pub limits: Vec<String>,
    /// Environment variables of the jobs, each `NAME=VALUE`. Those that scenes of the plan start from are needed. Jobs of Slurm, which see the folders of this
    /// machine, get its values of these where none are stated.
    pub variables: Vec<String>,
    /// Memory of a job in GB (10^9 bytes).
    pub memory_gb: u32,
    /// Time limit of a job in minutes, for Slurm at least four. A job that reaches it leaves a checkpoint and is run again: SkyPilot does so three times, the
    /// others as often as needed.
    pub minutes: u32,
    /// Jobs at a time; 0 is as many as the scheduler starts. SkyPilot has no such number.
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
/// [`Error::Parameter`] for a plan without trainings, for texts that no quoting makes safe, for wrong or missing variables, for a time limit that leaves jobs
/// of Slurm no time to work, and for a number of jobs that SkyPilot would not keep to.
pub fn emit(scheduler: Scheduler, plan: &Plan, options: &EmitOptions) -> Result<String> {
    if plan.trainings.is_empty() {
        return Err(Error::parameter(format!("sweep {}", plan.name), "it has no training", "Make the plan again from a grid with at least one cell"));
    }
    let o = options;
    let variables = variables(scheduler, plan, &o.variables)?;
    let texts =
        [("folder", &o.folder), ("--cd", &o.working_folder), ("--program", &o.program), ("--image", &o.image), ("--claim", &o.claim), ("--bucket", &o.bucket)];
    let more = o.limits.iter().map(|limit| ("--limit", limit)).chain(variables.values().map(|value| ("--env", value)));
    for (option, text) in texts.into_iter().chain(more) {
        if text.chars().any(char::is_control) {
            return Err(Error::parameter(option, "it has a line break or another control character", "Use another name"));
        }
    }
    if o.threads == 0 || o.memory_gb == 0 || o.minutes == 0 {
        return Err(Error::parameter("sweep emit", "threads, memory and minutes are positive", "Give --threads, --memory-gb and --time-limit"));
    }
    if scheduler == Scheduler::Slurm && slurm::folder_of_logs(o).contains('\\') {
        let problem = format!("'{}' has a backslash, and names of Slurm's logs would then not get the index of their task", slurm::folder_of_logs(o));
        return Err(Error::parameter("folder", problem, "Use another folder, or name it by a link without a backslash (--job-dir)"));
    }
    if scheduler == Scheduler::Slurm && o.minutes < slurm::LEAST_MINUTES {
        let problem = format!("{} minutes: Slurm asks a task to stop up to three minutes before its limit, so it would be queued again without end", o.minutes);
        return Err(Error::parameter("--time-limit", problem, format!("Give at least {} minutes", slurm::LEAST_MINUTES)));
    }
    if scheduler == Scheduler::SkyPilot && o.parallel > 0 {
        let problem = format!("{}: SkyPilot itself decides how many managed jobs run at a time", o.parallel);
        return Err(Error::parameter("--parallel", problem, "Leave it out, and launch the indices in parts"));
    }
    Ok(match scheduler {
        Scheduler::Slurm => slurm::script(plan, o, &variables),
        Scheduler::Kubernetes => kubernetes(plan, o, &variables),
        Scheduler::SkyPilot => skypilot(plan, o, &variables),
    })
}

/// The environment variables of the jobs: those that are `stated`, and of Slurm's jobs those of this machine that scenes start from.
fn variables(scheduler: Scheduler, plan: &Plan, stated: &[String]) -> Result<BTreeMap<String, String>> {
    let mut found = BTreeMap::new();
    for text in stated {
        let object = format!("--env {text}");
        let Some((name, value)) = text.split_once('=').filter(|(_, value)| !value.is_empty()) else {
            return Err(Error::parameter(object, "it is not NAME=VALUE with a value", "Write for instance --env CC4DGS_DATA=/data"));
        };
        if INDEX_VARIABLES.contains(&name) {
            return Err(Error::parameter(object, "jobs read the index of their training from this variable", "Leave it out"));
        }
        if found.insert(name.to_string(), value.to_string()).is_some() {
            return Err(Error::parameter(object, format!("{name} is given twice"), "Give it once"));
        }
    }
    for path in plan.trainings.iter().map(|training| &training.data.path) {
        let Some(name) = variable_of(path).filter(|name| !found.contains_key(*name)) else { continue };
        let value = match scheduler {
            Scheduler::Slurm => value_here(name, std::env::var(name)),
            _ => Err(format!("jobs of Kubernetes and SkyPilot do not have the environment variable {name} of this machine")),
        };
        let problem = match value {
            Ok(value) => {
                found.insert(name.to_string(), value);
                continue;
            }
            Err(problem) => problem,
        };
        let remedy = format!("Give --env {name}=DIR, the folder that the path starts from as the jobs see it");
        return Err(Error::parameter(format!("scene {path}"), problem, remedy));
    }
    let is_name = |name: &str| !name.starts_with(|c: char| c.is_ascii_digit()) && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
    if let Some(name) = found.keys().find(|name| name.is_empty() || !is_name(name)) {
        let problem = "names of variables have ASCII letters, digits and '_', and do not begin with a digit";
        return Err(Error::parameter(format!("variable '{name}'"), problem, "Use another name"));
    }
    Ok(found)
}

/// The value of the environment variable `name`, which was `found` on this machine, for jobs; or why they cannot have it.
fn value_here(name: &str, found: std::result::Result<String, VarError>) -> std::result::Result<String, String> {
    match found {
        Ok(value) if !value.is_empty() => Ok(value),
        Err(VarError::NotUnicode(value)) => Err(format!("the environment variable {name} is not Unicode here ({value:?}), and job files are")),
        _ => Err(format!("the environment variable {name} is not set here, so jobs would not get it")),
    }
}

/// `text` as one word of a shell.
fn quoted(text: &str) -> String {
    format!("'{}'", text.replace('\'', "'\\''"))
}

/// The limits of `o` as options of a shell's command.
fn limit_options(o: &EmitOptions) -> String {
    o.limits.iter().map(|limit| format!("--limit {} ", quoted(limit))).collect()
}

/// Seconds after which a job is asked to stop, so that it leaves its checkpoint before its time limit of so many minutes.
fn stop_after(minutes: u32) -> u64 {
    // Limits of two minutes or less have no time for a notice. Kubernetes takes at most 2^31 - 1.
    (60 * u64::from(minutes)).saturating_sub(u64::from(NOTICE_SECONDS)).clamp(60, i32::MAX as u64)
}

/// `text` as a YAML string: JSON strings are.
fn yaml(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

/// The grid's name as schedulers accept it: lower case, digits and '-'.
fn job_name(plan: &Plan) -> String {
    let name: String = plan.name.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' }).take(40).collect();
    format!("cc4dgs-{}", name.trim_matches('-')).trim_end_matches('-').to_string()
}

/// How much there is to do, such as `1 training, 3 cells`.
fn extent(plan: &Plan) -> String {
    let (trainings, cells) = (plan.trainings.len(), plan.cells.len());
    format!("{trainings} {}, {cells} {}", plural(trainings, "training", "trainings"), plural(cells, "cell", "cells"))
}

fn kubernetes(plan: &Plan, o: &EmitOptions, variables: &BTreeMap<String, String>) -> String {
    let parallel = if o.parallel > 0 { o.parallel } else { plan.trainings.len() };
    // Kubernetes replaces $(NAME) in commands, their arguments and values of variables, and $$ by $.
    let literal = |text: &str| yaml(&text.replace('$', "$$"));
    let variable = |(name, value): (&String, &String)| format!("        - name: {}\n          value: {}\n", yaml(name), literal(value));
    format!(
        r#"# {extent}. Submit with: kubectl apply -f FILE. Interrupted and evicted pods, and pods at their time limit, are replaced
# and go on from the checkpoint; codes after which the same command would fail again end their index only. Needs Kubernetes 1.33, or 1.29 with its defaults.
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
      activeDeadlineSeconds: {stop_after}
      terminationGracePeriodSeconds: {NOTICE_SECONDS}
      containers:
      - name: cell
        image: {image}
        workingDir: {cd}
        command: [{program}]
        args: ["--quiet", "--threads", "{threads}", {limits}"sweep", "run", {folder}, "--plan", "{plan}", "--index", "$(JOB_COMPLETION_INDEX)"]
        env:
        - name: JOB_COMPLETION_INDEX
          valueFrom:
            fieldRef:
              fieldPath: metadata.annotations['batch.kubernetes.io/job-completion-index']
{variables}        resources:
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
        extent = extent(plan),
        name = job_name(plan),
        finals = FINAL.map(|code| code.to_string()).join(", "),
        image = yaml(&o.image),
        cd = yaml(&o.working_folder),
        program = literal(&o.program),
        limits = o.limits.iter().map(|limit| format!("\"--limit\", {}, ", literal(limit))).collect::<String>(),
        folder = literal(&o.folder),
        variables = variables.iter().map(variable).collect::<String>(),
        threads = o.threads,
        memory = u64::from(o.memory_gb) * 1000,
        stop_after = stop_after(o.minutes),
        claim = yaml(&o.claim),
        plan = plan.id(),
    )
}

fn skypilot(plan: &Plan, o: &EmitOptions, variables: &BTreeMap<String, String>) -> String {
    let name = job_name(plan);
    let last = plan.trainings.len() - 1;
    // SkyPilot has no time limit. `timeout` asks the program to stop and ends with the program's own code.
    let limit = format!("timeout --preserve-status --kill-after={NOTICE_SECONDS} {}", stop_after(o.minutes));
    let (program, folder, limits) = (quoted(&o.program), quoted(&o.folder), limit_options(o));
    let command = format!("{limit} {program} --quiet --threads {} {limits}sweep run {folder} --plan {} --index \"$INDEX\"", o.threads, plan.id());
    format!(
        r#"# {extent}. Launch one managed job per index:
#   for index in $(seq 0 {last}); do sky jobs launch --yes --detach-run --name "{name}-$index" --env INDEX="$index" FILE; done
# A machine that is taken away is replaced, and the training goes on from its checkpoint in the bucket. A job that reaches its time limit is restarted
# up to three times, as after an error.
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
{variables}file_mounts:
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
        extent = extent(plan),
        threads = o.threads,
        memory = o.memory_gb,
        variables = variables.iter().map(|(name, value)| format!("  {}: {}\n", yaml(name), yaml(value))).collect::<String>(),
        cd = yaml(&o.working_folder),
        cd_shell = quoted(&o.working_folder),
        bucket = yaml(&o.bucket),
        finals = FINAL.map(|code| code.to_string()).join("|"),
    )
}

#[cfg(test)]
mod tests;
