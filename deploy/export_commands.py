"""The commands `rlservo export`, `prune`, `inspect` and `verify`."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Literal

import typer

from rlservo.deploy import terminal
from rlservo.deploy.terminal import Json, needs_extra, note, print_json
from rlservo.export.contract.errors import UsageError


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
    metric: Annotated[
        str | None, typer.Option(help="Of a Tune trial or experiment, the checkpoint with the best of this metric.")
    ] = None,
    mode: Annotated[
        Literal["max", "min"], typer.Option(help="Whether the best is the largest or the smallest.")
    ] = "max",
    as_json: Json = False,
) -> None:
    """Turn an RLlib checkpoint into a policy bundle. It is proven equal to RLlib's own actions, or nothing is written.

    Examples: `rlservo export examples/checkpoints/ur5_positioning --out policies`,
    `rlservo export ~/ray_results/PPO_2026 --metric env_runners/episode_return_mean --out policies`
    """
    start = time.perf_counter()
    if all_modules and (module_id is not None or agent_id is not None):
        raise UsageError("--all-modules exports every module: leave --module-id and --agent-id out")
    with terminal.errors().status("importing") as status, ExitStack() as fetching:
        with needs_extra("train"):
            from rlservo.export.checkpoints.experiment import best_checkpoint
            from rlservo.export.checkpoints.remote import fetch
            from rlservo.export.commands.export import LOADING_RUNS_CODE, export_all_modules, export_checkpoint
            from rlservo.export.commands.report import export_report, peak_memory_mb

        if metric is not None:
            note(LOADING_RUNS_CODE.format(path=checkpoint))
            local = fetching.enter_context(fetch(checkpoint, status.update))
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
                notify=note,
                progress=status.update,
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
                notify=note,
                progress=status.update,
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
    with needs_extra("train"):
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
    checkpoint: Annotated[str, typer.Option(help="The RLlib checkpoint to compare with; a folder or a URI.")],
    env: Annotated[str | None, typer.Option(help="Environment id for a closed-loop comparison.")] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes of the closed loop.")] = 20,
    seed: Annotated[int, typer.Option(help="Seed of the first episode.")] = 0,
    app_dir: Annotated[Path, typer.Option(help="Folder of your own modules that the checkpoint refers to.")] = Path(),
    as_json: Json = False,
) -> None:
    """Prove a bundle against its checkpoint again. With --env also in closed loop, written into the contract.

    Example: `rlservo verify policies/ur5 --checkpoint runs/best --env rlservo/EndEffectorPositioningURSim-v0`
    """
    with needs_extra("train"):
        from rlservo.export.commands.report import verification_report
        from rlservo.export.commands.verify import verify_bundle

    with terminal.errors().status("reading the bundle") as status:
        result = verify_bundle(
            bundle,
            checkpoint,
            env_id=env,
            episodes=episodes,
            first_seed=seed,
            app_dir=app_dir,
            notify=note,
            progress=status.update,
        )
    if as_json:
        print_json(
            {
                "parity": result.parity.model_dump(mode="json"),
                "evaluation": result.evaluation.model_dump(mode="json") if result.evaluation else None,
                "same_checkpoint": result.same_checkpoint,
            }
        )
    else:
        terminal.output().print(verification_report(result.parity, result.evaluation))
