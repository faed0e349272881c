"""Train on edge environments for a moment, as the trainer would, in one Ray; print one JSON document.

python train_edges.py FOLDER NAME [NAME ...]      NAME is one of RUNS
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
sys.path[:0] = [str(EXAMPLES), str(Path(__file__).parent / "app")]

import shared.episode_traces as episode_traces  # noqa: E402
import shared.training_run as training_run  # noqa: E402
import simple_trainer  # noqa: E402

RUNS = {
    "Float64": ["--set", "vf_clip_param=100.0", "--observation-filter", "MeanStdFilter"],
    "Promises32": ["--run", "DQN", "--stop-timesteps", "1000"],
    "Camera": [],
    "Endless": [],
    "Crashing": ["--restart-failed-sub-environments", "--set", "rollout_fragment_length=25"],
    "Crashing runner": [
        "--num-cpus",
        "1",
        "--set",
        "rollout_fragment_length=25",
        "--env-arg",
        "crashes=1",
        "--stop-iters",
        "100000",
        "--stop-timesteps",
        "300",
    ],
    "Crashing for good": ["--stop-iters", "50"],
}


def main(folder: Path, names: list[str]) -> None:
    training_run.pickle_by_value(simple_trainer, episode_traces)
    found = {}
    with training_run.ray_session(num_cpus=2, app_dir=Path(__file__).parent / "app"):
        for name in names:
            more = RUNS[name]
            env = f"edge_environments:edge/{name.split()[0]}-v0"
            common = ["--num-cpus", "0", "--name-env", env, "--stop-iters", "2", "--hidden", "16"]
            if name.startswith("Crashing"):  # an absolute path: Tune's workers run in the trial's folder
                common += ["--env-arg", f"log={folder / name.replace(' ', '_')}.txt"]
            own = (
                more if "DQN" in more else [*more, "--set", "train_batch_size_per_learner=300", "--set", "num_epochs=2"]
            )
            parser = simple_trainer.argument_parser()
            args = parser.parse_args([*common, *own])
            simple_trainer.check_arguments(parser, args)
            said = io.StringIO()
            with contextlib.redirect_stdout(said):
                try:
                    config, run, _ = simple_trainer.set_up(args)
                    outcome = training_run.train(
                        config,
                        run,
                        storage=folder / "runs",
                        stop={"training_iteration": args.stop_iters, training_run.STEPS: args.stop_timesteps},
                        checkpoint_frequency=1,
                    )
                    training_run.report(outcome, run)
                    bundle = training_run.export_and_run(
                        training_run.best_checkpoint_of(outcome),
                        folder / "policies" / name.replace(" ", "-"),
                        env_id=run.env_id,
                        env_config=run.env_config,
                        episodes=0 if name.startswith(("Endless", "Crashing")) else 1,
                    )
                    found[name] = {"bundle": str(bundle), "steps": outcome.best.env_steps}
                except training_run.RlservoError as error:
                    found[name] = {"error": error.message}
            found[name]["said"] = said.getvalue()
    print(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
