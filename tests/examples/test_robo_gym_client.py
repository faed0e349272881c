"""The loop across both: a served policy drives robo-gym's own environment, from robo-gym's own Python."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rlservo.envs.robot_server.manager import RobotServers, ServerManager
from rlservo.export.exporter import export_checkpoint
from rlservo.serve_app.client import PolicyClient
from rlservo.serve_app.processes import free_ports

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "robo_gym_client.py"

pytestmark = [pytest.mark.serve, pytest.mark.slow]


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The shipped policies for robo-gym's tasks behind `rlservo serve`."""
    out = tmp_path_factory.mktemp("served")
    for folder, name in (
        ("ur5_positioning", "ur5"),
        ("mir100_navigation", "mir100"),
        ("mir100_obstacle_avoidance", "mir100_obstacle_avoidance"),
    ):
        export_checkpoint(ROOT / "examples/checkpoints" / folder, out, name=name, notify=lambda line: None)
    (port,) = free_ports(1)
    server = subprocess.Popen(
        [sys.executable, "-m", "rlservo.deploy.cli", "serve", str(out), "--port", str(port)],
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        with PolicyClient(f"http://127.0.0.1:{port}", "ur5") as waiting:
            waiting.wait_until_ready(120.0)
        yield f"http://127.0.0.1:{port}"
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(60)


@pytest.fixture(scope="module")
def light_client(robo_gym_python: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """rlservo as `pip install --no-deps` puts it into robo-gym's environment; in a folder of its own."""
    source, installed = tmp_path_factory.mktemp("source") / "tree", tmp_path_factory.mktemp("installed")
    for folder in ("envs", "export", "serve_app", "deploy"):
        (source / folder).parent.mkdir(exist_ok=True)
        subprocess.run(["cp", "-r", str(ROOT / folder), str(source)], check=True)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        subprocess.run(["cp", str(ROOT / name), str(source)], check=True)
    install = [str(robo_gym_python), "-m", "pip", "install", "-q", "--no-deps", "--target", str(installed), str(source)]
    done = subprocess.run(install, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return installed


def run(python: Path, installed: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    return subprocess.run(
        [str(python), str(EXAMPLE), *arguments], capture_output=True, text=True, timeout=300, env=environment
    )


@pytest.mark.parametrize(
    ("task", "episodes", "expected"),
    [
        ("EndEffectorPositioningUR", 100, 95),
        ("NoObstacleNavigationMir100", 20, 18),
        # 93.8% over 500 episodes: fewer than 13 of 20 come once in seventy thousand times.
        ("ObstacleAvoidanceMir100", 20, 13),
    ],
)
def test_served_policies_arrive_in_robo_gyms_environments(
    robo_gym_python: Path, light_client: Path, url: str, task: str, episodes: int, expected: int
) -> None:
    manager = ServerManager(port=0, servers=RobotServers())
    try:
        line = ("--url", url, "--manager-port", str(manager.port), "--episodes", str(episodes), "--json")
        done = run(robo_gym_python, light_client, "--task", task, *line)
        assert done.returncode == 0, done.stderr
        report = json.loads(done.stdout[done.stdout.index("{") : done.stdout.rindex("}") + 1])
        assert report["environment"] == f"{task}Sim-v0"
        assert report["episodes"] == episodes
        assert report["successes"] >= expected, report["endings"]
        assert sum(report["endings"].values()) == episodes
        assert 0.0 < report["latency_ms"]["p50"] <= report["latency_ms"]["p95"] <= report["latency_ms"]["p99"]
        assert manager.servers.running == {}
    finally:
        manager.close()


def test_client_needs_neither_ray_nor_a_new_protobuf(robo_gym_python: Path, light_client: Path) -> None:
    code = (
        "import sys, robo_gym, rlservo.serve_app.client, google.protobuf as p; "
        "print(p.__version__, sorted({m.split('.')[0] for m in sys.modules} & {'ray', 'torch', 'onnxruntime'}))"
    )
    environment = {**os.environ, "PYTHONPATH": str(light_client)}
    done = subprocess.run([str(robo_gym_python), "-c", code], capture_output=True, text=True, env=environment)
    assert done.stdout.startswith("3.20."), done.stderr
    assert done.stdout.strip().endswith("[]")


def test_an_arms_model_for_the_mobile_robot_is_refused(robo_gym_python: Path, light_client: Path) -> None:
    done = run(robo_gym_python, light_client, "--task", "ObstacleAvoidanceMir100", "--ur-model", "ur10")
    assert done.returncode == 2
    assert done.stderr.strip().endswith("--ur-model is for UR tasks, and ObstacleAvoidanceMir100 has a MiR100")


def test_missing_server_is_one_sentence(robo_gym_python: Path, light_client: Path) -> None:
    manager = ServerManager(port=0, servers=RobotServers())
    try:
        done = run(
            robo_gym_python, light_client, "--url", "http://127.0.0.1:1", "--manager-port", str(manager.port),
            "--episodes", "1",
        )  # fmt: skip
    finally:
        manager.close()
    assert done.returncode == 1
    assert "error: " in done.stderr
    assert "Traceback" not in done.stderr
