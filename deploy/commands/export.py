"""The commands `rlservo export` and `rlservo prune`."""

from __future__ import annotations

import re
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Literal

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.environment_options import parse_env_arguments
from rlservo.deploy.terminal import Json, note, print_json
from rlservo.errors import UsageError
from rlservo.extras import needs_extra


def export(
    checkpoint: Annotated[
        str,
        typer.Argument(
            help="Checkpoint file or folder, a Tune trial (its newest checkpoint), or a URI such as s3://..."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Repository folder; the bundle goes to OUT/<name>/<version>/.")],
    name: Annotated[str | None, typer.Option(help="Policy name; by default the environment's.")] = None,
    version: Annotated[str | None, typer.Option(help="An integer or x.y.z; the next integer by default.")] = None,
    description: Annotated[str, typer.Option(help="Description of the policy, stored in the contract.")] = "",
    module_id: Annotated[
        str | None, typer.Option(help="RLModule (old API stack: policy) to export; required if there are several.")
    ] = None,
    all_modules: Annotated[
        bool, typer.Option("--all-modules", help="Export every module to OUT/<name>-<module>, or none of them.")
    ] = False,
    agent_id: Annotated[
        str | None, typer.Option(help="Agent whose filter to use, if agents share a module but not its filter.")
    ] = None,
    app_dir: Annotated[Path, typer.Option(help="Folder of the Python modules that the checkpoint refers to.")] = Path(),
    value: Annotated[bool, typer.Option("--value/--no-value", help="Include the value head.")] = True,
    untrained_filter: Annotated[
        bool,
        typer.Option(
            "--untrained-filter",
            help="Export even if the observation filter's statistics are empty or come from evaluation.",
        ),
    ] = False,
    source: Annotated[
        str | None,
        typer.Option(help="Checkpoint's trainer (rllib, sb3, rsl_rl, skrl, leapp, onnx); detected by default."),
    ] = None,
    vecnormalize: Annotated[
        Path | None,
        typer.Option(
            help="Stable-Baselines3: path of vecnormalize.pkl, if it is not beside the model; `none`: "
            "observations were not normalized."
        ),
    ] = None,
    frame_stack: Annotated[
        int, typer.Option(min=1, help="Stable-Baselines3: number of frames that VecFrameStack stacked.")
    ] = 1,
    joint_order: Annotated[
        str,
        typer.Option(
            metavar="JOINT,JOINT,...",
            help="Isaac Lab, mjlab: the robot's joints in its own order, if no file of the run has them.",
        ),
    ] = "",
    control_rate: Annotated[
        float | None, typer.Option(min=1e-3, metavar="HZ", help="Control rate [Hz], if no file has it.")
    ] = None,
    action_range: Annotated[
        str,
        typer.Option(
            metavar="LOW,HIGH", help="ONNX: bounds to clip every element of the action to, after scale and offset."
        ),
    ] = "",
    output: Annotated[
        list[str] | None,
        typer.Option(
            metavar="OUTPUT=USE",
            help="ONNX: use of an output whose name does not show it: `action`, `none`, or the input that gets it at "
            "the next step (a recurrent state).",
        ),
    ] = None,
    env: Annotated[
        str | None, typer.Option(help="Environment whose describe() says what the elements are, if no file does.")
    ] = None,
    env_arg: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="With --env: its constructor argument (JSON value).")
    ] = None,
    convention: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="Conventions that no file states: quaternion=wxyz or xyzw, frame=NAME (of poses and "
            "velocities), action=absolute, "
            "relative, velocity or effort.",
        ),
    ] = None,
    reward: Annotated[
        str, typer.Option(metavar="MODULE:FUNCTION", help="Reward function for `rlservo learn`, named in the contract.")
    ] = "",
    metric: Annotated[
        str | None, typer.Option(help="Metric that picks the best checkpoint of a Tune trial or experiment.")
    ] = None,
    mode: Annotated[
        Literal["max", "min"], typer.Option(help="Whether the largest or the smallest value of the metric is best.")
    ] = "max",
    as_json: Json = False,
) -> None:
    """Convert a checkpoint to a policy bundle. It is proven equal to the trainer's own actions, or nothing is written.

    An ONNX file is taken as given, and compared only with itself in onnxruntime.

    Examples: `rlservo export examples/checkpoints/ur_positioning --out policies`,
    `rlservo export model.zip --out policies`,
    `rlservo export ~/ray_results/PPO_2026 --metric env_runners/episode_return_mean --out policies`
    """
    start = time.perf_counter()
    from rlservo.bundle.contract import REWARD_PATTERN  # not needed for `--help`

    if re.fullmatch(REWARD_PATTERN, reward) is None:
        raise UsageError(f"--reward {reward[:80]!r}: expected MODULE:FUNCTION, such as my_rewards:reach")
    of_one = {
        "--module-id": module_id, "--agent-id": agent_id, "--env": env, "--convention": convention, "--reward": reward,
        "--vecnormalize": vecnormalize, "--frame-stack": frame_stack > 1, "--joint-order": joint_order,
        "--control-rate": control_rate, "--action-range": action_range, "--output": output,
    }  # fmt: skip
    if all_modules and (given := [option for option, value in of_one.items() if value]):
        raise UsageError(f"--all-modules exports every module: leave {' and '.join(given)} out")
    if env_arg and env is None:
        raise UsageError("--env-arg needs --env")
    conventions = dict(_pair("--convention", text, "quaternion=xyzw") for text in convention or ())
    outputs = dict(_pair("--output", text, "h_out=h_in") for text in output or ())
    with terminal.status("importing") as show, terminal.writing(out), ExitStack() as fetching:
        with needs_extra("train", "gymnasium"):
            from rlservo.export.rllib import quick_import

            quick_import.prepare()
            from rlservo.export.checkpoints.experiment import best_checkpoint
            from rlservo.export.checkpoints.remote import fetch
            from rlservo.export.export_checkpoint import export_all_modules, export_checkpoint
            from rlservo.export.reports import export_report, peak_memory_mb
            from rlservo.export.sources.source import PICKLES

        if metric is not None:
            note(f"loading {checkpoint}: {PICKLES}")
            local = fetching.enter_context(fetch(checkpoint, show))
            best = best_checkpoint(local, metric, mode, app_dir=app_dir, notify=note)
            note(f"{best.path} has the {mode} {metric}: {best.score:g}")
            checkpoint = str(best.path)
        if all_modules:
            results = export_all_modules(
                checkpoint,
                out,
                name=name,
                version=version,
                description=description,
                app_dir=app_dir,
                value=value,
                untrained_filter=untrained_filter,
                source=source,
                notify=note,
                progress=show,
            )
        else:
            one = export_checkpoint(
                checkpoint,
                out,
                name=name,
                version=version,
                description=description,
                module_id=module_id,
                agent_id=agent_id,
                app_dir=app_dir,
                value=value,
                untrained_filter=untrained_filter,
                source=source,
                vecnormalize=vecnormalize,
                frame_stack=frame_stack,
                joint_order=[joint.strip() for joint in joint_order.split(",") if joint.strip()],
                control_rate_hz=control_rate,
                action_range=_range(action_range),
                outputs=outputs,
                env=env,
                env_kwargs=parse_env_arguments(env_arg or []),
                conventions=conventions,
                reward=reward,
                notify=note,
                progress=show,
            )
            results = [one]
    cost = {"seconds": round(time.perf_counter() - start, 2), "peak_memory_mb": round(peak_memory_mb())}
    if as_json:
        documents = [
            {"path": str(result.path), "contract": result.contract.model_dump(mode="json"), **cost}
            for result in results
        ]
        print_json(documents if all_modules else documents[0])
        return
    for result in results:
        terminal.output().print(export_report(result.contract), soft_wrap=True)
        terminal.output().print(f"written   {result.path}", markup=False, highlight=False, soft_wrap=True)
    terminal.output().print(
        f"cost      {cost['seconds']:.1f} s, {cost['peak_memory_mb']} MB at the peak", highlight=False
    )


def _pair(option: str, text: str, example: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals:
        raise UsageError(f"{option} {text!r}: expected NAME=VALUE, such as {example}")
    return name, value


def _range(text: str) -> tuple[float, float] | None:
    if not text:
        return None
    try:
        low, high = (float(side) for side in text.split(","))
    except ValueError:
        low, high = 0.0, 0.0
    if not low < high:
        raise UsageError(f"--action-range {text!r}: expected LOW,HIGH, such as -1,1")
    return low, high


def prune(
    checkpoint: Annotated[str, typer.Argument(help="RLlib checkpoint folder or URI.")],
    out: Annotated[Path, typer.Option(help="Folder to create; it must not exist yet.")],
    module_id: Annotated[str | None, typer.Option(help="RLModule to keep; required if there are several.")] = None,
    app_dir: Annotated[Path, typer.Option(help="Folder of the Python modules that the checkpoint refers to.")] = Path(),
) -> None:
    """Copy only the parts of a checkpoint that export needs. The copy is small enough to commit or mail.

    Example: `rlservo prune runs/PPO-.../checkpoint_000015 --out examples/checkpoints/mine`
    """
    with needs_extra("train", "ray", "torch", "onnx", "onnxscript", "gymnasium"):
        from rlservo.export.prune_checkpoint import prune_checkpoint

    prune_checkpoint(checkpoint, out, module_id=module_id, app_dir=app_dir, notify=note)
