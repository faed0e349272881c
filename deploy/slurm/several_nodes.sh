#!/usr/bin/env bash
# Train on several nodes: sbatch --nodes=3 deploy/slurm/several_nodes.sh --run PPO --name-env CartPole-v1
#
# Ray's head runs on the first node, a worker on each of the others, examples/simple_trainer.py next to the head. Every
# argument goes to the trainer; --num-cpus is all nodes' cores but one, for the driver. The folder for results must be
# one that all nodes see. RLSERVO_RESUME=last resumes the newest run. The cluster has a token of its own, and ends with the job.
#SBATCH --job-name=rlservo-train
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=36
#SBATCH --time=01:00:00
#SBATCH --signal=B:TERM@120
#SBATCH --output=%x-%j.out
set -euo pipefail

# Slurm runs a copy of this file from its spool: the checkout is where sbatch was called.
cd "${RLSERVO_CHECKOUT:-${SLURM_SUBMIT_DIR:?submit this with sbatch, from the checkout}}"
python="${RLSERVO_PYTHON:-.venv/bin/python}"
ray=("$python" -m ray.scripts.scripts) # the command 'ray', whatever the path
cores="${SLURM_CPUS_PER_TASK:?ask for the cores of each node with --cpus-per-task}"
gpus="${SLURM_GPUS_ON_NODE:-0}"

export RAY_AUTH_MODE=token RAY_USAGE_STATS_ENABLED=0
export RAY_enable_worker_prestart=0 RAY_prestart_worker_first_driver=0
# In the environment only: srun passes it on, and no file or command line shows it.
RAY_AUTH_TOKEN="$("$python" -c 'import secrets; print(secrets.token_hex(32))')"
export RAY_AUTH_TOKEN

mapfile -t nodes < <(scontrol show hostnames "${SLURM_JOB_NODELIST:?submit this with sbatch}")
head="${nodes[0]}"
port="${RLSERVO_RAY_PORT:-$((20000 + SLURM_JOB_ID % 10000))}"
# Sockets need a short path, and other jobs on the node a folder of their own.
folder="${RLSERVO_RAY_FOLDER:-/tmp/ray-$SLURM_JOB_ID}"

steps=()
on_node() { # on_node NODE COMMAND...: run it there in the background, as a job step
  srun --nodes=1 --ntasks=1 --overlap --nodelist="$1" --cpus-per-task="$cores" "${@:2}" &
  steps+=("$!")
}
# shellcheck disable=SC2329  # the trap calls it
finish() {
  trap - EXIT TERM INT
  [ "${#steps[@]}" = 0 ] || kill "${steps[@]}" 2>/dev/null || true
  wait || true
  for node in "${nodes[@]}"; do
    srun --nodes=1 --ntasks=1 --overlap --nodelist="$node" rm -rf "$folder" || true
  done
}
trap finish EXIT

address="$(srun --nodes=1 --ntasks=1 --overlap --nodelist="$head" hostname -I | awk '{print $1}')"
[ -n "$address" ] || { echo "several_nodes.sh: node $head has no address" >&2; exit 1; }
wait_for_nodes() { # wait_for_nodes COUNT: a trial that does not fit yet would wait silently
  "$python" - "$address:$port" "$1" <<'PYTHON'
import subprocess
import sys
import time

address, wanted = sys.argv[1], int(sys.argv[2])
# In a process of its own each time: Ray ends one that finds no cluster.
count = (
    "import ray, sys; ray.init(sys.argv[1], logging_level='ERROR', log_to_driver=False); "
    "print(sum(node['Alive'] for node in ray.nodes()))"
)
deadline, there = time.monotonic() + 300, "none"
while time.monotonic() < deadline:
    try:
        asked = subprocess.run([sys.executable, "-c", count, address], capture_output=True, text=True, timeout=60)
        there = asked.stdout.strip() or there
    except subprocess.TimeoutExpired:
        continue
    if there.isdigit() and int(there) >= wanted:
        sys.exit()
    time.sleep(1)
sys.exit(f"several_nodes.sh: of {wanted} Ray nodes at {address}, {there} answered within five minutes")
PYTHON
}

# The dashboard is off, but Ray still checks whether its port is free. The autoscaler is off as well.
on_node "$head" "${ray[@]}" start --head --block --node-ip-address="$address" --port="$port" --temp-dir="$folder" \
  --num-cpus="$cores" --num-gpus="$gpus" --include-dashboard=false --dashboard-port="$((port + 1))" --no-monitor
wait_for_nodes 1
for node in "${nodes[@]:1}"; do
  on_node "$node" "${ray[@]}" start --block --address="$address:$port" --num-cpus="$cores" --num-gpus="$gpus"
done
wait_for_nodes "${#nodes[@]}"

if [ "${RLSERVO_RESUME:-}" = last ]; then
  # run.json is in every run's folder; the newest run is resumed.
  newest="$(find "${RLSERVO_STORAGE:-runs}" -mindepth 2 -maxdepth 2 -name run.json -printf '%T@ %h\n' | sort -n | tail -n 1)"
  set -- --resume "${newest#* }"
else
  set -- --num-cpus "$((cores * ${#nodes[@]} - 1))" --storage "${RLSERVO_STORAGE:-runs}" --max-failures 3 "$@"
fi
trainer=0
"$python" examples/simple_trainer.py --address "$address:$port" "$@" &
training="$!"
# The batch script itself gets Slurm's warning before the time is up; the trainer stops as with Ctrl-C.
trap 'kill -TERM "$training" 2>/dev/null || true' TERM INT
while kill -0 "$training" 2>/dev/null; do wait "$training" && trainer=0 || trainer="$?"; done
exit "$trainer"
