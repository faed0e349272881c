"""The trainer with unusual environments. All trainings are real."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.policy.policy import Policy

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]  # a dozen trainings, beside other tests


@pytest.fixture(scope="module")
def edges(trained: Any) -> tuple[Path, dict[str, Any]]:
    run = trained("edges")
    assert run.ended.code == 0, run.ended.out + run.ended.err
    found: dict[str, Any] = json.loads((run.folder / "edges.json").read_text())
    return run.folder, found


@pytest.mark.parametrize("name", ["Float64", "Promises32"])
def test_float64_trains_and_its_bundle_takes_what_the_environment_gives(name: str, edges: Any) -> None:
    with Policy.load(edges[1][name]["bundle"]) as policy:
        action = policy.act(np.array([0.1, -0.2, 0.3], np.float64))
    assert action.shape == ((1,) if name == "Float64" else ())


def test_dict_with_an_image_is_flattened_for_the_network_and_exported_as_a_dict(edges: Any) -> None:
    found = edges[1]["Camera"]
    assert "the network sees Dict observations as one vector" in found["said"]
    with Policy.load(found["bundle"]) as policy:
        seen = {"image": np.zeros((12, 10, 3), np.uint8), "speed": np.zeros(3, np.float32)}
        assert policy.act(seen) in (0, 1)


def test_episodes_longer_than_the_training_have_no_return_and_do_not_stop_it(edges: Any) -> None:
    found = edges[1]["Endless"]
    assert found["steps"] == 600
    assert re.search(r"^\w+_00000 +2 +600 +- +-", found["said"], re.MULTILINE)
    assert (Path(found["bundle"]) / "policy.onnx").is_file()


@pytest.mark.parametrize(("name", "log"), [("Crashing", "Crashing.txt"), ("Crashing runner", "Crashing_runner.txt")])
def test_crashes_are_survived_by_remaking_the_environment_or_the_runner(name: str, log: str, edges: Any) -> None:
    folder, found = edges
    assert (folder / log).read_text().count("crash") > 0
    assert "error" not in found[name], found[name]
    assert found[name]["steps"] >= 300  # the runner that died brought none meanwhile


def test_crash_in_the_driver_without_the_flag_ends_the_training_with_its_cause(edges: Any) -> None:
    found = edges[1]["Crashing for good"]
    assert re.search(r"training failed: .*error.txt, and --resume .* continues", found["error"])


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("Failing", "no step was sampled: RuntimeError: the gripper is not calibrated .*failures.txt"),
        ("Failing remade", "crashed 100 times without a sample: RuntimeError: the gripper is not calibrated"),
        ("Failing unmade", "training failed: .*RuntimeError: no licence for this process"),
        ("Failing evaluation", "no step was evaluated: RuntimeError: the gripper is not calibrated"),
        ("Float64 unlearned", "nothing was learned: .* the training stopped before the learner took any"),
    ],
)
def test_what_learned_nothing_is_not_exported_and_the_cause_is_told(name: str, sentence: str, edges: Any) -> None:
    folder, found = edges
    assert re.search(sentence, found[name].get("error", "")), found[name]
    assert not list((folder / "policies").glob(f"{name.replace(' ', '-')}*"))


def test_failure_is_printed_when_it_happens(edges: Any) -> None:
    said = edges[1]["Failing"]["said"]
    assert re.search(
        r"^failed while sampling, 1 so far: RuntimeError: the gripper is not calibrated", said, re.MULTILINE
    )
