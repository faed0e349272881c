"""README, tutorial and how-to guides do what they say: their blocks run in order, as printed, against real servers."""

from __future__ import annotations

import importlib
import json
import re
import shutil
from pathlib import Path

import gymnasium as gym
import pytest

from bundles import SHIPPED
from command_line import rlservo_here
from documents import HOW_TO, README, ROOT, TUTORIAL, blocks, commands, pages, ran, unknown_options
from namespaces import own_machine
from rlservo.deploy.demo.demo import ROBOTS
from ros import PYTHON, Ros

RAY = HOW_TO / "ray-and-kubernetes.md"
CARTPOLE = ROOT / "examples" / "checkpoints" / "cartpole_dqn"
# The first is run by robo-gym's Python, in tests/system/test_robo_gym_client.py, the four that train in
# tests/examples/test_training_guides.py. The others need more than a folder with policies.
ELSEWHERE = {"robo-gym", "train", "learn", "learn-online", "export", "sources", "ur-arm", "ros2",
             "your-own-environment", RAY.stem}  # fmt: skip
REAL_ARM = """
(echo slider 0.1; exec sleep 100000) | rlservo ur-controller --model ur5e --host 192.168.0.2 > arm.txt 2>&1 &
until grep -q Ctrl-C arm.txt; do sleep 0.2; done
python -c '
import rtde_control
arm = rtde_control.RTDEControlInterface("192.168.0.2")
arm.moveJ([0.5, -2.2, 1.5, -1.2, -1.4, 0.3], 3.0, 3.0)  # away from the start pose
arm.stopScript()
arm.disconnect()
'
"""
READY = "curl -sf --retry 300 --retry-delay 1 --retry-all-errors http://127.0.0.1:8000/v2/health/ready\n"
GUIDES = [page for page in pages() if page not in (README, TUTORIAL) and page.stem not in ELSEWHERE]


def test_readme_and_demo_have_the_same_policies_under_the_same_names() -> None:
    documents = "".join(page.read_text() for page in pages())
    exports = re.findall(r"rlservo export examples/checkpoints/(\w+) --out policies --name (\w+)", documents)
    demo = {robot.policy: robot.checkpoint for robot in ROBOTS}
    assert ("ur_positioning", "ur5") in exports
    assert {checkpoint for checkpoint, name in exports if name in demo} >= set(demo.values())
    assert {name: SHIPPED[name] for name in demo} == demo  # what the tests take for it


def test_readmes_policy_bears_readmes_disturbance(shipped: Path) -> None:
    disturbance = re.search(r"`--disturb\s+(\S+)`", README.read_text())
    assert disturbance is not None
    done = rlservo_here(
        "rollout", "rlservo/EndEffectorPositioningURSim-v0", "--bundle", shipped / "ur5",
        "--disturb", disturbance[1], "--episodes", 20, "--json",
    )  # fmt: skip
    assert json.loads(done.stdout)["successes"] >= 18, done


@pytest.mark.serve
@pytest.mark.slow
def test_readme_runs_as_printed(tmp_path: Path) -> None:
    """Its curl is answered by both engines."""
    (curl,) = [block.text for block in blocks(README) if block.text.startswith("curl ")]
    with own_machine(tmp_path) as machine:
        printed = ran(README, tmp_path, machine, after=READY + curl)
    assert len(re.findall(r'"action":\[(?:-?[\d.e-]+,){4}-?[\d.e-]+\].*"policy":"ur5"', printed)) == 2
    found = re.search(r"success: (\d+)", printed)
    assert found is not None
    # Random targets, of which the policy reaches 99.4 %: fewer than 18 of 20 would be one run in thousands.
    assert int(found[1]) >= 18


@pytest.fixture
def folder(shipped: Path, tmp_path: Path) -> Path:
    """What every guide begins with: a folder with the policies of the README."""
    for name in ("ur5", "mir100"):
        shutil.copytree(shipped / name, tmp_path / "policies" / name)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.stem)
def test_guide_runs_as_printed(page: Path, folder: Path, request: pytest.FixtureRequest) -> None:
    if not any(block.language in ("sh", "python") and not block.reason for block in blocks(page)):
        pytest.skip("none of its blocks can run here; the last test checks them")
    text = page.read_text(encoding="utf-8")
    if "s3://bucket/" in text:
        request.getfixturevalue("storage").make("bucket")
    if "--bundle runs/policies/cart-pole" in text:
        trained = request.getfixturevalue("exported")(request.getfixturevalue("zoo") / "cart_pole").path
        shutil.copytree(trained.parent, folder / "runs" / "policies" / "cart-pole")
    ran(page, folder)


@pytest.mark.serve
@pytest.mark.slow
def test_guide_to_ray_runs_as_printed(folder: Path) -> None:
    with own_machine(folder) as machine:
        printed = ran(RAY, folder, machine)
    assert "status: RUNNING" in printed


@pytest.mark.slow
def test_guide_to_export_runs_as_printed(folder: Path) -> None:
    trial = folder / "ray_results" / "PPO_2026" / "trial"  # HOME is this folder
    shutil.copytree(CARTPOLE, trial / "checkpoint_000000")
    iteration = json.loads((CARTPOLE / "rlservo_facts.json").read_text())["training_iterations"]
    result = {"training_iteration": iteration, "env_runners": {"episode_return_mean": 450.0}}
    (trial / "result.json").write_text(json.dumps(result))
    shutil.copytree(CARTPOLE, folder / "runs" / "mine" / "checkpoint_000010")
    (folder / "my_project").mkdir()
    ran(HOW_TO / "export.md", folder)


@pytest.mark.slow
def test_guide_to_sources_runs_as_printed(folder: Path) -> None:
    """On what Stable-Baselines3 leaves of normalized observations, and of stacked frames."""
    sb3 = pytest.importorskip("stable_baselines3")
    vec_env = importlib.import_module("stable_baselines3.common.vec_env")
    (folder / "logs").mkdir()
    for model, statistics, frames in (("logs/best_model", "logs/vecnormalize.pkl", 1), ("arm", "stats.pkl", 4)):
        env = vec_env.VecNormalize(vec_env.DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
        stacked = vec_env.VecFrameStack(env, frames) if frames > 1 else env
        trained = sb3.PPO("MlpPolicy", stacked, n_steps=8, batch_size=8, n_epochs=1, device="cpu").learn(8)
        trained.save(folder / model)
        env.save(folder / statistics)
    ran(HOW_TO / "sources.md", folder)


@pytest.mark.slow
def test_guide_to_a_real_arm_runs_as_printed(folder: Path) -> None:
    """The arm at the page's address is simulated, its slider at 10%; it stands 0.5 rad away from the start pose."""
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")
    with own_machine(folder, "192.168.0.2") as machine:
        printed = ran(HOW_TO / "ur-arm.md", folder, machine, before=REAL_ARM)
    assert "The policy must pass:" in printed
    assert "at the present speed scaling of 10%" in printed
    assert re.search(r"success: 1\b", printed), printed


@pytest.mark.slow
def test_guide_to_ros_runs_as_printed(ros: Ros, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`rlservo` is the one of the Python that has rclpy."""
    for name, value in ros.environment.items():
        monkeypatch.setenv(name, value)
    command = folder / "bin" / "rlservo"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec {PYTHON} -m rlservo.deploy.cli "$@"\n')
    command.chmod(0o755)
    ran(HOW_TO / "ros2.md", folder)


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_every_option_of_a_page_exists(page: Path) -> None:
    lines = [line for block in blocks(page) if block.language in ("sh", "text") for line in commands(block.text)]
    for line in lines:
        if line.startswith("rlservo "):
            assert unknown_options(line) == [], line
        for script in re.findall(r"\b(examples/\w+\.py)", line):
            text = (ROOT / script).read_text() + "".join(file.read_text() for file in ROOT.glob("examples/shared/*.py"))
            options = re.findall(r" (--[\w-]+)", line.partition(script)[2])
            assert [option for option in options if f'"{option}"' not in text] == [], line
