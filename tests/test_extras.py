"""Extras one at a time, with nothing else installed: a command first says in one sentence what it lacks."""

from __future__ import annotations

import json
import re
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from environments import environment_with, required_by

# The extras that a command needs (torch and onnx are in several, and so is Gymnasium), any of which it may name first.
TRAINERS = ("export", "sb3", "rsl-rl", "skrl", "leapp")  # each has what exporting and publishing need, as train has
NEEDS: dict[str, tuple[str, ...]] = {
    "inspect {bundle}": (),
    "key robot": (),
    "verify {bundle}": (),
    "export nowhere --out out": ("train",),
    "prune nowhere --out out": ("train",),
    "verify {bundle} --checkpoint nowhere": ("train",),
    "publish {bundle} bucket --version 7": ("train",),
    "verify {bundle} --env CartPole-v1 --disturb": ("gymnasium",),
    "rollout CartPole-v1 --bundle {bundle}": ("gymnasium",),
    "rollout CartPole-v1 --bundle {bundle} --video out.mp4": ("sim",),
    "rollout rlservo/EndEffectorPositioningURSim-v0 --bundle {bundle} --episodes 1": ("sim",),
    "rollout CartPole-v1 --bundle {bundle} --record out.mcap": ("gymnasium", "record"),
    "rollout CartPole-v1 --url http://127.0.0.1:1 --policy ur5": ("gymnasium", "client"),
    "rollout CartPole-v1 --url http://127.0.0.1:1 --policy ur5 --transport ws": ("gymnasium", "client"),
    "policy list --url http://127.0.0.1:1": ("client",),
    "policy promote ur5 2 --canary 10% --for 1s --max-error-rate 1% --url http://127.0.0.1:1": ("client",),
    "log info nowhere.mcap": ("record",),
    "log plot nowhere.mcap --out out.png": ("record",),
    "log export nowhere.mcap --to parquet --out out.parquet": ("record",),
    "replay nowhere.mcap --bundle {bundle}": ("record",),
    "estimate nowhere.mcap --bundle {bundle}": ("record",),
    "learn nowhere --policy ur5 --repository r --recordings r --out o": ("train", "client", "record"),
    "publish {bundle} s3://127.0.0.1/bucket": ("remote",),
    "publish {bundle} hf://owner/name": ("hub",),
    "sign {bundle} --key {bundle}/contract.json": ("sign",),
    "RLSERVO_TRACING=1 RLSERVO_PLAN=plan serve {bundle} --port 0": ("serve", "tracing"),
    "cockpit --robot-server 127.0.0.1:1": ("cockpit",),
    "rollout rlservo/EndEffectorPositioningURRob-v0 --bundle {bundle} --env-arg robot=rtde://127.0.0.1": ("ur", "sim"),
    "rollout rlservo/NoObstacleNavigationMir100Rob-v0 --bundle {bundle} --env-arg robot=rosbridge://127.0.0.1": (
        "rosbridge",
        "sim",
    ),
    "ros2 --bundle {bundle}": ("sim",),
    "ros2-sim ur5": ("sim",),
    "robot-latency rtde://127.0.0.1 --yes": ("ur", "sim"),
    "robot-check rtde://127.0.0.1": ("ur", "sim"),
    "ur-controller --host 203.0.113.7": ("sim",),
    "server-manager --host 203.0.113.7": ("sim",),
    "robot-server ur --host 203.0.113.7": ("sim",),
    "demo --out out": ("all", "client", "serve", "train", "sim"),
}
EXTRAS = sorted(set(metadata.metadata("rlservo").get_all("Provides-Extra") or ()) - {"dev", "docs", "all"})

# Each command in a process forked from one that has run a command, and imported what is installed of the packages that
# take long: a twentieth of the time of a start.
PROGRAM = """
import contextlib, importlib, io, json, os, sys, tempfile
import typer
from rlservo.deploy import cli, terminal
cli.app = typer.main.get_command(cli.app)
for slow in ("onnxruntime", "gymnasium", "torch", "mujoco"):
    with contextlib.suppress(ImportError):
        importlib.import_module(slow)
sys.argv = ["rlservo", "key", "robot"]
with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    with contextlib.suppress(SystemExit):
        cli.main()
for console in (terminal.output, terminal.errors):
    console.cache_clear()  # the children's write to their own streams
ends = []
for words in json.load(sys.stdin):
    with tempfile.TemporaryFile("w+") as out:
        child = os.fork()
        if child == 0:
            os.dup2(out.fileno(), 1)
            os.dup2(out.fileno(), 2)
            while "=" in words[0]:
                name, _, os.environ[name] = words.pop(0).partition("=")
            sys.argv = ["rlservo", *words]
            code = 70
            try:
                cli.main()
                code = 0
            except SystemExit as end:
                code = end.code or 0
            except BaseException:
                import traceback
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        out.seek(0)
        ends.append((code, out.read()))
json.dump(ends, sys.stdout)
"""


def lacking(command: str, *extras: str) -> list[str]:
    """Return the extras that a command lacks where these are installed."""
    packages = required_by(*extras)
    has = {other for other in EXTRAS if required_by(other) <= packages} | packages
    lacks = ["sim" if need == "gymnasium" else need for need in NEEDS[command] if need not in has]
    if command.split()[0] not in ("learn", "prune") and has & set(TRAINERS):
        lacks = [need for need in lacks if need != "train"]
    return lacks


@pytest.mark.slow
@pytest.mark.parametrize("extra", ["", *EXTRAS])
def test_every_command_says_at_once_which_extra_it_lacks(extra: str, wheel: Path, ur5: Path, tmp_path: Path) -> None:
    extras = [extra] if extra else []
    # With an extra those for which it makes a difference, if only that it is one of what they need.
    concerned = [command for command in NEEDS if not extra or lacking(command, extra) != lacking(command)]
    assert concerned
    environment = environment_with(wheel, tmp_path / "environment", *extras)
    done = subprocess.run(
        [environment / "bin" / "python", "-I", "-c", PROGRAM],
        input=json.dumps([command.format(bundle=ur5).split() for command in concerned]),
        capture_output=True, text=True, timeout=500, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    wrong: list[Any] = []
    for command, (code, text) in zip(concerned, json.loads(done.stdout), strict=True):
        lacks = lacking(command, *extras)
        said = re.findall(r"pip install '\.\[([\w-]+)\]' in the checkout", " ".join(text.split()))
        if (
            "Traceback" in text
            or (lacks and (code != 2 or len(said) != 1 or said[0] not in lacks))
            or set(said) - set(lacks)
        ):
            wrong.append((command, lacks, code, text[-600:]))
    assert wrong == [], json.dumps(wrong, indent=1)
