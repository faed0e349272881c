"""The command `rlservo robot-check`: options here, work in rlservo.robots.readiness."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from rlservo.deploy import terminal
from rlservo.deploy.commands.bundle_folder import bundle_of
from rlservo.deploy.commands.environment_options import parse_env_arguments, require_robot
from rlservo.deploy.commands.robot_server import Limit, one_sentence_errors
from rlservo.deploy.terminal import Json, print_json
from rlservo.errors import UsageError


def robot_check(
    robot: Annotated[
        str, typer.Argument(metavar="ADDRESS", help="rtde://HOST, ros2:... (an arm) or rosbridge://HOST:PORT (a base).")
    ],
    ur_model: Annotated[str | None, typer.Option(help="Expected robot model, such as ur5e.")] = None,
    bundle: Annotated[Path | None, typer.Option(help="Also check whether this bundle may drive it.")] = None,
    limit: Limit = None,
    as_json: Json = False,
) -> None:
    """Check whether a real robot may be driven.

    Nothing moves. It says what is missing, with exit code 1 if the robot may not be driven.

    Example: `rlservo robot-check rtde://192.168.0.2 --bundle policies/ur5`
    """
    require_robot(robot)
    with one_sentence_errors():
        from rlservo.robots.readiness import Finding, look_at

        model, findings, _ = look_at(robot, ur_model, parse_env_arguments(limit or []))
        if bundle is not None:
            problem = _bundle_problem(bundle, robot, model)
            findings.append(Finding("bundle", "refused" if problem else "may drive it", problem))
    problems = [one for one in findings if one.problem]
    if as_json:
        print_json({"may_be_driven": not problems, "findings": [one._asdict() for one in findings]})
    else:
        from rich.table import Table

        table = Table(title=f"{robot}: {'must not' if problems else 'may'} be driven", title_justify="left")
        for column in ("", "found", "what is missing"):
            table.add_column(column, overflow="fold")
        for one in findings:
            table.add_row(one.what, one.found, one.problem)
        terminal.output().print(table)
    if problems:
        raise typer.Exit(1)


def _bundle_problem(folder: Path, robot: str, model: str) -> str:
    """Return why the gate of real robots refuses a bundle; empty if it does not."""
    from rlservo.bundle.bundle import load_bundle
    from rlservo.bundle.environment_id import plain_id
    from rlservo.drive.environment_fit import check_fit
    from rlservo.drive.make_environment import make_env
    from rlservo.drive.real_robot_gate import check_proven
    from rlservo.envs.randomization import wrapped_env

    contract = load_bundle(bundle_of(folder, None)).contract
    if contract.provenance.env_id is None:
        return "it does not name a training environment of rlservo, so it cannot be compared with this robot"
    trained_in, arguments = wrapped_env(contract.provenance.env_id, contract.provenance.env_config)
    env_id = plain_id(trained_in)
    arguments |= {"ur_model": model} if model else {}
    try:
        env = make_env(env_id, arguments, render=False)
    except UsageError as error:
        return error.message
    own: Any = env.unwrapped
    own.is_real, own.robot_address = True, robot  # the simulated twin stands for the robot
    try:
        check_fit(contract, env, arguments)
        check_proven(contract, env)
    except UsageError as error:
        return error.message
    finally:
        env.close()
    return ""
