"""The commands `rlservo export`, `prune`, `inspect` and `verify`."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from rlservo.deploy import disturbance_commands, terminal
from rlservo.deploy.serve_commands import parse_env_arguments
from rlservo.deploy.terminal import Json, note, print_json
from rlservo.export.contract.errors import UsageError
from rlservo.export.contract.extras import needs_extra


def export(
    checkpoint: Annotated[
        str, typer.Argument(help="RLlib checkpoint folder (of a Tune trial the newest), or a URI such as s3://...")
    ],
    out: Annotated[Path, typer.Option(help="Repository folder; the bundle goes to OUT/<name>/<version>/.")],
    name: Annotated[str | None, typer.Option(help="Policy name; the environment's by default.")] = None,
    version: Annotated[str | None, typer.Option(help="Integer or x.y.z; the next integer by default.")] = None,
    description: Annotated[str, typer.Option(help="A sentence for people, kept in the contract.")] = "",
    module_id: Annotated[
        str | None, typer.Option(help="Which RLModule (old API stack: policy); needed when there are several.")
    ] = None,
    all_modules: Annotated[
        bool, typer.Option("--all-modules", help="Export every module, each to OUT/<name>-<module>; all or none.")
    ] = False,
    agent_id: Annotated[
        str | None, typer.Option(help="For which agent, where a module serves several that are filtered differently.")
    ] = None,
    app_dir: Annotated[Path, typer.Option(help="Folder of your own modules that the checkpoint refers to.")] = Path(),
    value: Annotated[
        bool, typer.Option("--value/--no-value", help="Whether the bundle has the value head, too.")
    ] = True,
    untrained_filter: Annotated[
        bool,
        typer.Option(
            "--untrained-filter", help="Export even if the observation filter's statistics are empty or evaluation's."
        ),
    ] = False,
    metric: Annotated[
        str | None, typer.Option(help="Of a Tune trial or experiment, the checkpoint with the best of this metric.")
    ] = None,
    mode: Annotated[
        Literal["max", "min"], typer.Option(help="Whether the best is the largest or the smallest.")
    ] = "max",
    as_json: Json = False,
) -> None:
    """Turn an RLlib checkpoint into a policy bundle. It is proven equal to RLlib's own actions, or nothing is written.

    Examples: `rlservo export examples/checkpoints/ur_positioning --out policies`,
    `rlservo export ~/ray_results/PPO_2026 --metric env_runners/episode_return_mean --out policies`
    """
    start = time.perf_counter()
    if all_modules and (module_id is not None or agent_id is not None):
        raise UsageError("--all-modules exports every module: leave --module-id and --agent-id out")
    with terminal.status("importing") as show, ExitStack() as fetching:
        with needs_extra("train", "ray", "torch", "onnx", "onnxscript", "gymnasium"):
            from rlservo.export.rllib import quick_import

            quick_import.prepare()
            from rlservo.export.checkpoints.experiment import best_checkpoint
            from rlservo.export.checkpoints.remote import fetch
            from rlservo.export.commands.export import LOADING_RUNS_CODE, export_all_modules, export_checkpoint
            from rlservo.export.commands.report import export_report, peak_memory_mb

        if metric is not None:
            note(LOADING_RUNS_CODE.format(path=checkpoint))
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


def prune(
    checkpoint: Annotated[str, typer.Argument(help="RLlib checkpoint folder or URI.")],
    out: Annotated[Path, typer.Option(help="Folder to make; it must not exist.")],
    module_id: Annotated[str | None, typer.Option(help="Which RLModule; needed when there are several.")] = None,
    app_dir: Annotated[Path, typer.Option(help="Folder of your own modules that the checkpoint refers to.")] = Path(),
) -> None:
    """Copy only what export needs out of a checkpoint. The copy is small enough to commit or to mail.

    Example: `rlservo prune runs/PPO-.../checkpoint_000015 --out examples/checkpoints/mine`
    """
    with needs_extra("train", "ray", "torch", "onnx", "onnxscript", "gymnasium"):
        from rlservo.export.commands.prune import prune_checkpoint

    prune_checkpoint(checkpoint, out, module_id=module_id, app_dir=app_dir, notify=note)


def inspect(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder, or a policy folder: its newest version.")],
    as_json: Json = False,
) -> None:
    """Show a bundle's contract. It says what goes in, what comes out, what is baked in and how it was proven.

    Example: `rlservo inspect policies/ur5`
    """
    from rlservo.export.contract.bundle import load_bundle

    contents = load_bundle(bundle)
    if as_json:
        print_json(contents.contract.model_dump(mode="json"))
    else:
        from rlservo.export.commands.report import contract_report

        terminal.output().print(contract_report(contents.contract))
        terminal.output().print(f"{contents.path}: all hashes match", markup=False, highlight=False, soft_wrap=True)


def verify(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder, or a policy folder: its newest version.")],
    disturbances: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[KIND=SIZE]...",
            help="With --disturb, the rows of the table, such as latency=3 or noise=real,payload=2; the standard ones "
            "by default. Kinds: latency, observation_latency, late [cycles], drop [share], noise, bias (real, 2*real), "
            "stuck (any or an element), payload [kg], model [share], base [m], target=outside, start=corner.",
        ),
    ] = None,
    checkpoint: Annotated[
        str | None, typer.Option(help="The RLlib checkpoint to compare with; a folder or a URI.")
    ] = None,
    env: Annotated[str | None, typer.Option(help="Environment id for a closed-loop comparison.")] = None,
    disturb: Annotated[
        bool, typer.Option("--disturb", help="Drive --env under disturbances: noise, latency, payload and others.")
    ] = False,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="Episodes of the closed loop (20), of each row under --disturb (100).")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the first episode.")] = 0,
    env_arg: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="With --disturb, environment constructor argument (JSON value)."),
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="With --disturb, draw the table into this file.")] = None,
    write: Annotated[
        bool, typer.Option("--write", help="With --disturb, write the rows into the contract as evaluations.")
    ] = False,
    app_dir: Annotated[Path, typer.Option(help="Folder of your own modules that the checkpoint refers to.")] = Path(),
    as_json: Json = False,
) -> None:
    """Prove a bundle against its checkpoint again. With --env also in closed loop, written into the contract.

    With --disturb it is driven as a real robot would have it, with no checkpoint needed: success, return and endings
    under each disturbance, over the same seeds.

    Examples: `rlservo verify policies/ur5 --checkpoint runs/best --env rlservo/EndEffectorPositioningURSim-v0`,
    `rlservo verify policies/ur5 --env rlservo/EndEffectorPositioningURSim-v0 --disturb`
    """
    if not disturb and (disturbances or plot or write or env_arg):
        raise UsageError("disturbances, --plot, --write and --env-arg go with --disturb")
    if checkpoint is None and not disturb:
        raise UsageError("give --checkpoint to compare the bundle with, or --disturb with --env, or both")
    document: dict[str, Any] = {}
    if checkpoint is not None:
        document |= _verify_against(checkpoint, bundle, env, episodes or 20, seed, app_dir, as_json)
    if disturb:
        table = disturbance_commands.measure(
            bundle,
            env,
            disturbances or [],
            episodes=episodes,
            seed=seed,
            env_arguments=parse_env_arguments(env_arg or []),
            plot=plot,
            write=write,
        )
        document["disturbances"] = table.as_dict()
        if not as_json:
            disturbance_commands.show(table)
    if as_json:
        print_json(document)


def _verify_against(
    checkpoint: str, bundle: Path, env: str | None, episodes: int, seed: int, app_dir: Path, as_json: bool
) -> dict[str, Any]:
    """Compare a bundle with its checkpoint; return the document for programs, and print it for people otherwise."""
    with needs_extra("train", "ray", "torch", "onnx", "onnxscript", "gymnasium"):
        from rlservo.export.commands.report import verification_report
        from rlservo.export.commands.verify import verify_bundle

    env_config = None
    if env is not None:  # the policy may have been trained with disturbances around this environment
        from rlservo.envs.randomization import wrapped_env
        from rlservo.export.contract.bundle import load_bundle

        trained = load_bundle(bundle).contract.provenance
        if env != trained.env_id:
            env_config = wrapped_env(trained.env_id or "", trained.env_config)[1]
    with terminal.status("reading the bundle") as show:
        result = verify_bundle(
            bundle,
            checkpoint,
            env_id=env,
            env_config=env_config,
            episodes=episodes,
            first_seed=seed,
            app_dir=app_dir,
            notify=note,
            progress=show,
        )
    if not as_json:
        terminal.output().print(verification_report(result.parity, result.evaluation))
    return {
        "parity": result.parity.model_dump(mode="json"),
        "evaluation": result.evaluation.model_dump(mode="json") if result.evaluation else None,
        "same_checkpoint": result.same_checkpoint,
    }
