//! The array script of Slurm.

use super::{EmitOptions, INTERRUPTED, NOTICE_SECONDS, extent, job_name, limit_options, quoted};
use crate::sweep::plan::Plan;
use std::collections::BTreeMap;

/// Least time limit of a job of Slurm, minutes. Slurm may give the notice a minute earlier, and a task that is stopped at once is queued again without end.
pub const LEAST_MINUTES: u32 = 4;
/// Most tasks of an array of Slurm, whose `MaxArraySize` is 1001 by default: indices are below it.
const MOST_TASKS: usize = 1001;

/// The folder of Slurm's logs. Slurm looks for a relative one where `sbatch` is called, and the program in its working folder, where it has to be.
pub fn folder_of_logs(o: &EmitOptions) -> String {
    let root = if o.folder.starts_with('/') { String::new() } else { format!("{}/", o.working_folder.trim_end_matches('/')) };
    format!("{root}{}/logs", o.folder)
}

/// `text`, which has no backslash, as one word of an `#SBATCH` line. sbatch reads these lines by rules of its own: a backslash escapes within quotes, too.
fn sbatch_quoted(text: &str) -> String {
    format!("\"{}\"", text.replace('"', "\\\""))
}

/// What a task of Slurm does: it runs `command` with the index of its training, and `code` is then the exit code. With more than [`MOST_TASKS`] trainings it
/// runs every so many, one after the other: an error of one does not end the others, and a task that is queued again goes on where it was.
fn task(command: &str, trainings: usize) -> String {
    let one = |index: &str| {
        format!(
            r#"{command} --index "${index}" &
work=$!
# A signal ends a wait. The last one finds the program ended, and has its exit code.
while kill -0 "$work" 2>/dev/null; do
    wait "$work"
done
wait "$work"
code=$?
"#
        )
    };
    if trainings <= MOST_TASKS {
        return one("SLURM_ARRAY_TASK_ID");
    }
    format!(
        r#"# Slurm takes {MOST_TASKS} tasks by default (MaxArraySize), so a task has several trainings, one after the other.
code=0 failed=0
for ((index = SLURM_ARRAY_TASK_ID; index < {trainings}; index += {MOST_TASKS})); do
{}if [ "$code" -ne 0 ] && [ "$code" -ne {INTERRUPTED} ]; then failed=$code; fi
if [ "$notice" ]; then code={INTERRUPTED}; fi
if [ "$code" -eq {INTERRUPTED} ]; then break; fi
done
if [ "$code" -ne {INTERRUPTED} ]; then code=$failed; fi
"#,
        one("index")
    )
}

/// The array script.
pub fn script(plan: &Plan, o: &EmitOptions, variables: &BTreeMap<String, String>) -> String {
    let trainings = plan.trainings.len();
    let last = trainings.min(MOST_TASKS) - 1;
    let (program, limits, folder) = (quoted(&o.program), limit_options(o), quoted(&o.folder));
    let command = format!("{program} --quiet --threads {} {limits}sweep run {folder} --plan {}", o.threads, plan.id());
    let throttle = if o.parallel > 0 { format!("%{}", o.parallel) } else { String::new() };
    let output = sbatch_quoted(&format!("{}/slurm-%a.log", folder_of_logs(o).replace('%', "%%")));
    format!(
        r#"#!/bin/bash
# {extent}. Submit with: sbatch FILE. A task that is stopped before its time limit, or preempted, leaves a checkpoint and
# is queued again; finished cells are never run twice. A task that is cancelled leaves a checkpoint, too, and is not queued again.
#SBATCH --job-name={name}
#SBATCH --array=0-{last}{throttle}
#SBATCH --cpus-per-task={threads}
#SBATCH --mem={memory}M
#SBATCH --time={minutes}
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=B:USR1@{NOTICE_SECONDS}
#SBATCH --output={output}
set -u
{variables}cd {cd} || exit 2
# The notice before the time limit comes to this shell alone. Cancelling and preemption signal every process, the program too, and Slurm itself queues preempted
# tasks again.
work= notice=
trap 'notice=yes; kill -TERM "$work" 2>/dev/null' USR1
trap : TERM INT
{work}if [ "$notice" ] && [ "$code" -eq {INTERRUPTED} ]; then
    scontrol requeue "${{SLURM_ARRAY_JOB_ID}}_${{SLURM_ARRAY_TASK_ID}}" || true
fi
exit "$code"
"#,
        extent = extent(plan),
        name = job_name(plan),
        threads = o.threads,
        memory = u64::from(o.memory_gb) * 1_000_000_000 / (1 << 20),
        minutes = o.minutes,
        variables = variables.iter().map(|(name, value)| format!("export {name}={}\n", quoted(value))).collect::<String>(),
        cd = quoted(&o.working_folder),
        work = task(&command, trainings),
    )
}
