"""The raylet's command as Ray makes it, and as it is started."""

from __future__ import annotations

import subprocess
import sys

import pytest

from rlservo.serve_app.ray_serve.cluster_process import without_agent

COMMAND = [
    "raylet",
    "--metrics-agent-port=0",
    "--metrics_export_port=0",
    "--runtime_env_agent_port=0",
    "--dashboard_agent_command=python agent.py --metrics-agent-port=0",
    "--runtime_env_agent_command=python main.py --runtime-env-agent-port=0 --gcs-address=127.0.0.1:6379",
    "--python_worker_command=python default_worker.py --runtime-env-agent-port=0 --webui=",
]


def test_raylet_waits_for_no_agents_ports() -> None:
    options = dict(word.split("=", 1) for word in without_agent(COMMAND)[1:])
    assert [options[f"--{name}"] for name in ("metrics-agent-port", "metrics_export_port")] == ["-1", "-1"]
    assert options["--dashboard_agent_listen_port"] == "-1" and options["--dashboard_agent_command"].endswith(
        "infinity"
    )
    port = options["--runtime_env_agent_port"]
    assert int(port) > 1024
    for started in ("--runtime_env_agent_command", "--python_worker_command"):
        assert f"--runtime-env-agent-port={port} " in options[started]


def test_port_that_was_given_stays() -> None:
    given = [word.replace("agent_port=0", "agent_port=52367") for word in COMMAND]
    assert "--runtime_env_agent_port=52367" in without_agent(given)


def test_other_command_ends_the_start() -> None:
    with pytest.raises(RuntimeError, match="starts its raylet with 0 of --runtime_env_agent_port"):
        without_agent([word for word in COMMAND if not word.startswith("--runtime_env_agent_port")])


def test_importing_the_module_leaves_pandas_alone() -> None:
    code = (
        "import sys; from rlservo.serve_app.ray_serve import cluster_process; "
        "assert sys.modules.get('pandas', '') is not None"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
