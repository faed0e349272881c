"""README, tutorial and how-to guides do what they say: their blocks run in order, as printed, against real servers."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from bundles import SHIPPED
from command_line import rlservo_here
from documents import ROOT, blocks, commands, pages, shell, unknown_options
from rlservo.deploy.demo.demo import ROBOTS

README = ROOT / "README.md"
CARTPOLE = ROOT / "examples" / "checkpoints" / "cartpole_dqn"
TUTORIAL = ROOT / "docs" / "tutorial" / "first-robot.md"
# Their client is robo-gym's Python: tests/system/test_robo_gym_client.py runs them.
WITH_ROBO_GYM = {"robo-gym.md", "real-arm.md"}
GUIDES = [page for page in pages() if page not in (README, TUTORIAL) and page.name not in WITH_ROBO_GYM]


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


def ran(page: Path, folder: Path) -> str:
    """Run a page's blocks; return what they printed."""
    with shell(folder) as opened:
        return "".join(
            opened.run(block) for block in blocks(page) if block.language in ("sh", "python") and not block.reason
        )


@pytest.mark.slow
def test_readme_runs_as_printed(tmp_path: Path) -> None:
    printed = ran(README, tmp_path)
    assert re.search(r'"action":\[(-?[\d.e-]+,){4}-?[\d.e-]+\].*"policy":"ur5"', printed)
    found = re.search(r"success: (\d+)", printed)
    assert found is not None
    # Random targets, of which the policy reaches 99.4 %: fewer than 18 of 20 would be one run in thousands.
    assert int(found[1]) >= 18


@pytest.mark.slow
def test_tutorial_runs_as_printed(tmp_path: Path) -> None:
    printed = ran(TUTORIAL, tmp_path)
    assert "production=2" in printed
    assert re.search(r"^success$", printed, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.stem)
def test_guide_runs_as_printed(page: Path, shipped: Path, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    if not any(block.language in ("sh", "python") and not block.reason for block in blocks(page)):
        pytest.skip("none of its blocks can run here; the next test checks them")
    shutil.copytree(shipped / "ur5", tmp_path / "policies" / "ur5")
    text = page.read_text(encoding="utf-8")
    if "s3://bucket/" in text:
        request.getfixturevalue("storage").make("bucket")
    if "~/ray_results/PPO_2026" in text:  # HOME is this folder
        trial = tmp_path / "ray_results" / "PPO_2026" / "trial"
        shutil.copytree(CARTPOLE, trial / "checkpoint_000000")
        iteration = json.loads((CARTPOLE / "rlservo_facts.json").read_text())["training_iterations"]
        result = {"training_iteration": iteration, "env_runners": {"episode_return_mean": 450.0}}
        (trial / "result.json").write_text(json.dumps(result))
        shutil.copytree(CARTPOLE, tmp_path / "runs" / "mine" / "checkpoint_000010")
        (tmp_path / "my_project").mkdir()
    ran(page, tmp_path)


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
