"""`rlservo verify --disturb`: the table of disturbances on the terminal, as JSON, as a plot and in the contract."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlservo.deploy import terminal
from rlservo.deploy.terminal import note
from rlservo.export.contract.errors import UsageError
from rlservo.export.contract.extras import needs_extra

if TYPE_CHECKING:
    from rlservo.serve_app.rollout.disturbance_table import DisturbanceTable

EPISODES = 100  # of each row, where the caller does not say
WIDTH = 140  # [characters], of the table at least: narrower its figures fall apart


def measure(
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
    """Measure a bundle under disturbances; draw and keep the table where asked for.

    The environment is made with the `env_config` the policy was trained with, without the disturbances it was trained
    under, and with `env_arguments`. Raises UsageError for a disturbance that does not exist or cannot be had.
    """
    if env_id is None:
        raise UsageError("--disturb needs --env: the environment to disturb")
    if seed < 0:
        raise UsageError(f"--seed is {seed}: expected 0 or more")
    with needs_extra("sim"):
        from rlservo.envs.randomization import wrapped_env
        from rlservo.export.contract.bundle import load_bundle, write_contract
        from rlservo.serve_app.rollout.disturbance_table import (
            check_plot,
            evaluations_of,
            measure_disturbances,
            plot_table,
        )
        from rlservo.serve_app.runtime.policy import Policy

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
        write_contract(loaded.path, loaded.contract.model_copy(update={"evaluations": evaluations}))
        note(f"written into {loaded.path / 'contract.json'}")
    return table


def show(table: DisturbanceTable) -> None:
    """Print the table."""
    from rlservo.serve_app.rollout.disturbance_table import render_table

    console = terminal.output()
    console.print(render_table(table), width=max(console.width, WIDTH), soft_wrap=True)
