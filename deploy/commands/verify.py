"""The command `rlservo verify`: compare with the checkpoint, or with `--disturb` drive the simulator.

The table of disturbances goes to the terminal, as JSON, as a plot and into the contract.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlservo.bundle.environment_id import plain_id
from rlservo.deploy import terminal
from rlservo.deploy.commands.bundle_folder import FOLDER, Version, bundle_of
from rlservo.deploy.commands.environment_options import parse_env_arguments
from rlservo.deploy.terminal import Json, note, print_json
from rlservo.errors import ParityError, UsageError
from rlservo.extras import needs_extra

if TYPE_CHECKING:
    from rlservo.drive.disturbance_table import DisturbanceTable

EPISODES = 100  # of each row by default
WIDTH = 140  # [characters], smallest width of the table: in a narrower one the figures wrap


def verify(
    bundle: Annotated[Path, typer.Argument(help=FOLDER)],
    disturbances: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[KIND=SIZE]...",
            help="With --disturb: rows of the table, such as latency=3 or noise=real,payload=2; standard rows by "
            "default. Kinds: latency, observation_latency, late [cycles], drop [share], noise, bias (real, "
            "2*real), stuck (any or an element), payload [kg], model [share], base [m], target=outside, "
            "start=corner.",
        ),
    ] = None,
    checkpoint: Annotated[str | None, typer.Option(help="Checkpoint to compare with; a path or a URI.")] = None,
    source: Annotated[str | None, typer.Option(help="Trainer that wrote --checkpoint; detected by default.")] = None,
    vecnormalize: Annotated[
        Path | None,
        typer.Option(help="Stable-Baselines3: path of vecnormalize.pkl or `none`, as given to `rlservo export`."),
    ] = None,
    env: Annotated[str | None, typer.Option(help="Environment id for a closed-loop comparison.")] = None,
    disturb: Annotated[
        bool, typer.Option("--disturb", help="Drive --env under disturbances such as noise, latency and payload.")
    ] = False,
    episodes: Annotated[
        int | None,
        typer.Option(min=1, help="Episodes in the closed loop (default 20), or per row of --disturb (default 100)."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the first episode.")] = 0,
    env_arg: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE", help="With --disturb or --compiled: environment constructor argument (JSON)."
        ),
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="With --disturb: plot the table to this file.")] = None,
    compiled: Annotated[
        Path | None,
        typer.Option(
            help="Folder from `rlservo compile`: also drive --env with it; the same seed must end the same way."
        ),
    ] = None,
    write: Annotated[
        bool, typer.Option("--write", help="With --disturb: write the rows to the contract as evaluations.")
    ] = False,
    app_dir: Annotated[Path, typer.Option(help="Folder of the modules that the checkpoint and --env need.")] = Path(),
    version: Version = None,
    as_json: Json = False,
) -> None:
    """Prove a bundle against its checkpoint again. With --env, also drive episodes and add them to the contract.

    With --disturb, drive the simulator with latency, noise and more, without a checkpoint: success, return and endings
    under each disturbance, over the same seeds.

    Examples: `rlservo verify policies/ur5 --checkpoint runs/best --env rlservo/EndEffectorPositioningURSim-v0`,
    `rlservo verify policies/ur5 --env rlservo/EndEffectorPositioningURSim-v0 --disturb`,
    `rlservo verify policies/ur5 --compiled build --env rlservo/EndEffectorPositioningURSim-v0`
    """
    if not disturb and (disturbances or plot or write):
        raise UsageError("disturbances, --plot and --write need --disturb")
    if checkpoint is None and (source is not None or vecnormalize is not None):
        raise UsageError("--source and --vecnormalize need --checkpoint")
    if env_arg and not disturb and compiled is None:
        raise UsageError("--env-arg needs --disturb or --compiled")
    env = env and plain_id(env)
    if checkpoint is None and not disturb and compiled is None:
        raise UsageError("expected --checkpoint to compare the bundle with, or --env with --disturb or --compiled")
    from rlservo.bundle.bundle import digest_of
    from rlservo.export.checkpoints.unpickle import user_code
    from rlservo.serve_app.repository.signature import remove_signature

    bundle, document = bundle_of(bundle, version), dict[str, Any]()
    before = digest_of(bundle)
    if compiled is not None:
        with user_code(app_dir):
            document |= _verify_compiled(compiled, bundle, env, episodes or 20, seed, env_arg or [], as_json)
    if checkpoint is not None:
        files = {"app_dir": app_dir, "source": source, "vecnormalize": vecnormalize}
        document |= _verify_against(checkpoint, bundle, env, episodes or 20, seed, files, as_json)
    if disturb:
        with user_code(app_dir):
            table = _measure(
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
            _show(table)
    if digest_of(bundle) != before:
        if remove_signature(bundle):
            note(f"the signature was of the bundle without its new evaluations and is removed: `rlservo sign {bundle}`")
        _accept(bundle, before)
    if as_json:
        print_json(document)


def _accept(bundle: Path, before: str) -> None:
    """Have the plans that name the bundle's hash name the one with its new evaluations."""
    from rlservo.serve_app.server.offline_commands import accept_evaluation

    for place in accept_evaluation(bundle, before):
        note(f"the plan in {place} has the bundle's new hash: servers start with it, running ones take it")


def _verify_against(
    checkpoint: str, bundle: Path, env: str | None, episodes: int, seed: int, files: dict[str, Any], as_json: bool
) -> dict[str, Any]:
    """Compare a bundle with its checkpoint; return the JSON document, or print a report."""
    with needs_extra("train", "gymnasium"):
        from rlservo.export.reports import verification_report
        from rlservo.export.verify_bundle import verify_bundle

    env_config = None
    if env is not None:  # the policy may have been trained with disturbances of this environment
        from rlservo.bundle.bundle import load_bundle
        from rlservo.envs.randomization import wrapped_env

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
            **files,
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


def _verify_compiled(
    compiled: Path, bundle: Path, env_id: str | None, episodes: int, seed: int, env_arg: list[str], as_json: bool
) -> dict[str, Any]:
    """Drive the environment with the bundle and its C code. Raises ParityError if an episode ends differently."""
    if env_id is None:
        raise UsageError("--compiled needs --env, the environment to drive")
    with needs_extra("sim", "gymnasium"):
        from rlservo.drive.control_loop import rollout
        from rlservo.envs.randomization import wrapped_env
        from rlservo.policy.compiled_policy import CompiledPolicy
        from rlservo.policy.policy import Policy

    with Policy.load(bundle) as ours, CompiledPolicy(compiled) as theirs, terminal.status("driving both") as show:
        if ours.digest != theirs.digest:
            raise UsageError(f"{compiled} was not compiled from {ours.path}")
        trained = ours.contract.provenance
        arguments = {**wrapped_env(trained.env_id or "", trained.env_config)[1], **parse_env_arguments(env_arg)}
        reports = []
        for policy, name in ((ours, "the bundle"), (theirs, "its C")):
            show(f"driving {env_id} with {name}")
            report = rollout(policy, env_id, episodes=episodes, seed=seed, env_kwargs=arguments)
            if report.interrupted:  # half a comparison is useless
                raise KeyboardInterrupt
            reports.append(report)
    pairs = list(zip(reports[0].episodes, reports[1].episodes, strict=True))
    for a, b in pairs:
        if (a.final_status, a.steps) != (b.final_status, b.steps):
            raise ParityError(
                f"episode {a.index} (seed {a.seed}) ends differently: with the bundle '{a.final_status}' after "
                f"{a.steps}"
                f" steps, with its C code '{b.final_status}' after {b.steps}"
            )
    apart = max(abs(a.episode_return - b.episode_return) for a, b in pairs)
    if not as_json:
        endings = ", ".join(f"{name}: {count}" for name, count in reports[0].final_status.items())
        terminal.output().print(
            f"compiled  {episodes} episodes of {env_id} end the same way ({endings}); returns differ by "
            f"at most {apart:.2g}",
            markup=False, highlight=False, soft_wrap=True,
        )  # fmt: skip
    return {"compiled": {"episodes": episodes, "endings": reports[0].final_status, "max_return_difference": apart}}


def _measure(
    bundle: Path,
    env_id: str | None,
    disturbances: Sequence[str],
    *,
    episodes: int | None,
    seed: int,
    env_arguments: Mapping[str, Any],
    plot: Path | None,
    write: bool,
) -> DisturbanceTable:
    """Measure a bundle under disturbances; draw and store the table if requested.

    The environment is made with the policy's training `env_config` but without its disturbances, and with
    `env_arguments`. Raises UsageError for an unknown or unsupported disturbance.
    """
    if env_id is None:
        raise UsageError("--disturb needs --env, the environment to disturb")
    if seed < 0:
        raise UsageError(f"--seed is {seed}: expected 0 or more")
    with needs_extra("sim"):
        from rlservo.bundle.bundle import load_bundle, write_contract
        from rlservo.drive.disturbance_table import (
            check_plot,
            evaluations_of,
            measure_disturbances,
            plot_table,
        )
        from rlservo.envs.randomization import wrapped_env
        from rlservo.policy.policy import Policy

    if plot is not None:
        check_plot(plot)
    loaded = load_bundle(bundle)
    trained = loaded.contract.provenance
    arguments = {**wrapped_env(trained.env_id or "", trained.env_config)[1], **env_arguments}
    with Policy.load(bundle) as policy:
        table = measure_disturbances(
            policy,
            env_id,
            disturbances,
            episodes=EPISODES if episodes is None else episodes,
            seed=seed,
            env_kwargs=arguments,
            progress=note,
        )
    for text, why in table.skipped.items():
        note(f"left out {text}: {why}")
    if plot is not None:
        plot_table(table, plot)
        note(f"written {plot}")
    if write:
        now = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
        evaluations = (*loaded.contract.evaluations, *evaluations_of(table, now))
        with terminal.writing(loaded.path):
            write_contract(loaded.path, loaded.contract.model_copy(update={"evaluations": evaluations}))
        note(f"written into {loaded.path / 'contract.json'}")
    return table


def _show(table: DisturbanceTable) -> None:
    """Print the table."""
    from rlservo.drive.disturbance_table import render_table

    console = terminal.output()
    console.print(render_table(table), width=max(console.width, WIDTH), soft_wrap=True)
