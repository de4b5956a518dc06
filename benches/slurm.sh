#!/usr/bin/env bash
# Runs a tiny sweep through a real Slurm on this machine: the array through sbatch, one task requeued in the middle, then collected and compared with the same
# sweep run by the local pool. Another array gets the notice before a time limit, which must queue the task again, and is cancelled, which must not. Needs root
# and Debian's packages: apt-get install -y --no-install-recommends slurm-wlm munge
#   benches/slurm.sh OUT BIN [GRID] [ITERATIONS]
set -euo pipefail
[ $# -ge 2 ] || { echo "usage: benches/slurm.sh OUT BIN [GRID] [ITERATIONS]" >&2; exit 2; }
here=$(cd "$(dirname "$0")" && pwd)
out=$(realpath -m "$1")
bin=$(realpath "$2")
grid=$(realpath "${3:-$here/grids/tiny.toml}")
iterations=${4:-4000}
for tool in sbatch scontrol squeue slurmctld slurmd munged; do
    PATH=$PATH:/usr/sbin command -v "$tool" >/dev/null || { echo "$tool is missing: apt-get install -y --no-install-recommends slurm-wlm munge" >&2; exit 2; }
done
PATH=$PATH:/usr/sbin
rm -rf "$out"
mkdir -p "$out/slurm/state" "$out/slurm/spool"

# A controller and one node, both on this machine. Requeued tasks are held for two minutes by default; `scontrol release` lets them go at once.
node=$(hostname -s)
conf=$out/slurm/slurm.conf
{
    echo "ClusterName=bench"
    echo "SlurmctldHost=$node(127.0.0.1)"
    echo "SlurmUser=root"
    echo "SlurmdUser=root"
    echo "AuthType=auth/munge"
    echo "CredType=cred/munge"
    echo "StateSaveLocation=$out/slurm/state"
    echo "SlurmdSpoolDir=$out/slurm/spool"
    echo "SlurmctldPidFile=$out/slurm/controller.pid"
    echo "SlurmdPidFile=$out/slurm/node.pid"
    echo "SlurmctldLogFile=$out/slurm/controller.log"
    echo "SlurmdLogFile=$out/slurm/node.log"
    echo "SlurmctldPort=26817"
    echo "SlurmdPort=26818"
    echo "ProctrackType=proctrack/linuxproc"
    echo "TaskPlugin=task/none"
    echo "SelectType=select/cons_tres"
    echo "SelectTypeParameters=CR_CPU"
    echo "ReturnToService=2"
    echo "SchedulerParameters=batch_sched_delay=1"
    echo "KillWait=30"
    echo "NodeName=$node NodeAddr=127.0.0.1 CPUs=2 RealMemory=4000 State=UNKNOWN"
    echo "PartitionName=bench Nodes=$node Default=YES MaxTime=60 State=UP"
} >"$conf"
export SLURM_CONF=$conf
munge_pid=
if ! munge -n >/dev/null 2>&1; then
    mkdir -p /run/munge && chown munge: /run/munge
    runuser -u munge -- munged --foreground --force &
    munge_pid=$!
fi
stop() {
    scancel --user=root 2>/dev/null || true
    for file in node controller; do
        [ -f "$out/slurm/$file.pid" ] && kill "$(cat "$out/slurm/$file.pid")" 2>/dev/null || true
    done
    [ -n "$munge_pid" ] && kill "$munge_pid" 2>/dev/null || true
}
trap stop EXIT
for _ in $(seq 40); do munge -n >/dev/null 2>&1 && break; sleep 0.25; done
slurmctld -f "$conf"
sleep 2
slurmd -f "$conf" -N "$node"
for _ in $(seq 60); do sinfo -h -o %t 2>/dev/null | grep -q idle && break; sleep 0.5; done
sinfo -h -o %t | grep -q idle || { echo "the node did not come up; see $out/slurm" >&2; exit 5; }

"$bin" --quiet sweep plan "$grid" --iterations "$iterations" --out "$out/pool"
"$bin" --quiet sweep plan "$grid" --iterations "$iterations" --out "$out/array"
"$bin" --quiet --threads 1 sweep run "$out/pool" --jobs 2
"$bin" --quiet --threads 1 sweep emit slurm "$out/array" --program "$bin" --memory-gb 1 --time-limit 30 >"$out/array.sh"

job=$(sbatch --parsable "$out/array.sh")
echo "array job $job"
# The first task is requeued once it has a checkpoint and is still training.
first=$(python3 -c 'import json, sys; print(json.load(open(sys.argv[1]))["trainings"][0]["id"])' "$out/array/plan.json")
checkpoint() {
    for _ in $(seq 1200); do
        [ -f "$out/$1/trainings/$first/checkpoint" ] && return
        sleep 0.05
    done
    echo "no checkpoint to stop at; give more iterations" >&2
    exit 5
}
checkpoint array
scontrol requeue "${job}_0"
sleep 3
trained=no
[ -f "$out/array/trainings/$first/training.json" ] && trained=yes
[ "$trained" = no ] || { echo "the training was over before the requeue; give more iterations" >&2; exit 5; }
while [ -n "$(squeue -h -j "$job" 2>/dev/null)" ]; do
    # A requeued task waits for two minutes unless its begin time is moved.
    scontrol update JobId="${job}_0" StartTime=now 2>/dev/null || true
    sleep 2
done
"$bin" --quiet sweep collect "$out/array"

# The notice before the limit, which goes to the script alone: the task stops and is queued again. Then the array is cancelled while it trains, for good.
"$bin" --quiet sweep plan "$grid" --iterations "$iterations" --out "$out/cancelled"
"$bin" --quiet --threads 1 sweep emit slurm "$out/cancelled" --program "$bin" --memory-gb 1 --time-limit 30 >"$out/cancelled.sh"
cancelled=$(sbatch --parsable "$out/cancelled.sh")
checkpoint cancelled
state() { squeue -h -j "${cancelled}_0" -o %T 2>/dev/null || true; }
# scancel asks again and again where the task has stopped by then.
timeout 2 scancel --batch --signal=USR1 "${cancelled}_0" || true
for _ in $(seq 120); do [ "$(state)" = PENDING ] && break; sleep 0.25; done
[ "$(state)" = PENDING ] || { echo "the notice did not queue the task again" >&2; exit 5; }
for _ in $(seq 120); do
    scontrol update JobId="${cancelled}_0" StartTime=now 2>/dev/null || true
    [ "$(state)" = RUNNING ] && break
    sleep 0.5
done
[ "$(state)" = RUNNING ] || { echo "the task that was queued again does not run" >&2; exit 5; }
sleep 1
scancel "$cancelled"
for _ in $(seq 120); do [ -z "$(squeue -h -j "$cancelled" 2>/dev/null)" ] && break; sleep 0.5; done
sleep 3
[ -z "$(squeue -h -j "$cancelled" 2>/dev/null)" ] || { echo "the cancelled array is queued again" >&2; exit 5; }
[ ! -f "$out/cancelled/trainings/$first/training.json" ] || { echo "the training was over before it was cancelled; give more iterations" >&2; exit 5; }
"$bin" --quiet --threads 1 sweep run "$out/cancelled" --index 0
python3 - "$out" "$here" "$job" <<'PYTHON'
import json, pathlib, sys
out, here, job = pathlib.Path(sys.argv[1]), sys.argv[2], sys.argv[3]
sys.path.insert(0, here)
import kill_sweep
wrong = kill_sweep.compare(out / "pool", out / "array")
resumed = list((out / "cancelled" / "archives").iterdir())
wrong += [f"{file.name} of the cancelled array differs" for file in resumed if file.read_bytes() != (out / "pool" / "archives" / file.name).read_bytes()]
if not resumed:
    wrong.append("the cancelled array, run again, has no archive")
cells = [json.loads(file.read_text()) for file in (out / "array" / "results").iterdir()]
report = {**kill_sweep.program(out / "array"), "scheduler": "slurm", "cells": len(cells), "tasks": len({cell["training"] for cell in cells}),
          "requeued_tasks": 1, "queued_again_by_the_notice": 1, "cancelled_for_good": 1, "cells_of_resumed_trainings": sum(cell["cost"]["resumed"] > 0 for cell in cells), "wrong": wrong}
(out / "slurm.json").write_text(json.dumps(report, indent=1) + "\n")
print(json.dumps(report, indent=1))
sys.exit(1 if wrong or not report["cells_of_resumed_trainings"] else 0)
PYTHON
