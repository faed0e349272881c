#!/usr/bin/env bash
# Train on one node: sbatch deploy/slurm/one_node.sh --run PPO --name-env CartPole-v1 --stop-reward 450
#
# Every argument goes to examples/simple_trainer.py; --num-cpus is one less than the node's cores, for the driver.
# Two minutes before the time is up Slurm sends SIGTERM, which the trainer takes as Ctrl-C; submit again with
# --resume runs/... (or with RLSERVO_RESUME=last) to continue.
#SBATCH --job-name=rlservo-train
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=36
#SBATCH --time=01:00:00
#SBATCH --signal=TERM@120
#SBATCH --output=%x-%j.out
set -euo pipefail

# Slurm runs a copy of this file from its spool: the checkout is where sbatch was called.
cd "${RLSERVO_CHECKOUT:-${SLURM_SUBMIT_DIR:?submit this with sbatch, from the checkout}}"
python="${RLSERVO_PYTHON:-.venv/bin/python}"
cores="${SLURM_CPUS_PER_TASK:?ask for the cores of the node with --cpus-per-task}"

if [ "${RLSERVO_RESUME:-}" = last ]; then
  # run.json is in every run's folder; the newest run is resumed.
  newest="$(find "${RLSERVO_STORAGE:-runs}" -mindepth 2 -maxdepth 2 -name run.json -printf '%T@ %h\n' | sort -n | tail -n 1)"
  set -- --resume "${newest#* }"
else
  set -- --num-cpus "$((cores - 1))" --storage "${RLSERVO_STORAGE:-runs}" "$@"
fi
exec srun --ntasks=1 --cpus-per-task="$cores" "$python" examples/simple_trainer.py "$@"
