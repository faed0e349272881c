"""The README does what it says: its commands run in order, as written, against a real server."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bundles import SHIPPED
from command_line import rlservo_here
from rlservo.deploy.demo.demo import ROBOTS
from servers import free_ports

ROOT = Path(__file__).resolve().parents[2]


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)


def test_readme_and_demo_have_the_same_policies_under_the_same_names() -> None:
    documents = "".join((ROOT / name).read_text() for name in ("README.md", "examples/robo_gym.md", "docs/bundle.md"))
    exports = re.findall(r"rlservo export examples/checkpoints/(\w+) --out policies --name (\w+)", documents)
    demo = {robot.policy: robot.checkpoint for robot in ROBOTS}
    assert ("ur_positioning", "ur5") in exports
    assert {checkpoint for checkpoint, name in exports if name in demo} <= set(demo.values())
    assert {name: SHIPPED[name] for name in demo} == demo  # what the tests take for it


def test_readmes_policy_bears_readmes_disturbance(shipped: Path) -> None:
    disturbance = re.search(r"`--disturb\s+(\S+)`", (ROOT / "README.md").read_text())
    assert disturbance is not None
    done = rlservo_here(
        "rollout", "rlservo/EndEffectorPositioningURSim-v0", "--bundle", shipped / "ur5",
        "--disturb", disturbance[1], "--episodes", 20, "--json",
    )  # fmt: skip
    assert json.loads(done.stdout)["successes"] >= 18, done


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder that looks like the checkout, for the commands to write into."""
    for name in ("examples", "deploy"):
        (tmp_path / name).symlink_to(ROOT / name)
    return tmp_path


@pytest.mark.serve
@pytest.mark.slow
def test_commands_run_as_written(checkout: Path) -> None:
    (port,) = free_ports(1)
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "HOME": str(checkout)}
    environment |= {"RLSERVO_URL": f"http://127.0.0.1:{port}", "XDG_RUNTIME_DIR": str(checkout)}

    def as_written(command: str) -> str:
        return command.replace("127.0.0.1:8000", f"127.0.0.1:{port}")

    def run(command: str) -> str:
        done = subprocess.run(
            ["bash", "-c", as_written(command)],
            cwd=checkout,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        return done.stdout

    commands = blocks("sh")
    train, export, serve, curl, policy, on_ray, rollout = commands[1:8]
    assert "training_inference_ur.py" in train  # run by tests/examples
    assert "serve run deploy/serve.yaml" in on_ray  # run by tests/system/test_demo.py, on a port of its own
    run(export)
    assert serve.strip() == "rlservo serve policies"
    server = subprocess.Popen(
        ["rlservo", "serve", "policies", "--port", str(port)], cwd=checkout, env=environment, start_new_session=True
    )
    try:
        deadline = time.monotonic() + 120
        while subprocess.run(["curl", "-sf", f"http://127.0.0.1:{port}/v1/policies"], capture_output=True).returncode:
            assert server.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.5)
        answer = run(curl)
        assert re.search(r'"action":\[(-?[\d.e-]+,){4}-?[\d.e-]+\].*"policy":"ur5"', answer)
        assert "production=1" in run(policy)
        # Random targets, of which the policy reaches 99.4 %: fewer than 18 of 20 would be one run in thousands.
        found = re.search(r"success: (\d+)", run(rollout))
        assert found is not None
        assert int(found.group(1)) >= 18
        for block in blocks("python"):
            code = as_written(block).replace("action = policy.act(obs)", "print(policy.act([0.5] * 27).shape)")
            script = checkout / "block.py"
            script.write_text(code)
            out = run(f"python {script}")
            assert "PolicyClient" not in block or out.strip() == "(5,)"
        out = run(f"python examples/ur5_client.py --url http://127.0.0.1:{port} --episodes 2")
        assert out.count("return") == 2
    finally:
        server.send_signal(signal.SIGINT)
        assert server.wait(60) in (0, 130)
