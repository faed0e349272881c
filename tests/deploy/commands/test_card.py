"""`rlservo inspect --card`: the README.md of a bundle on a hub."""

from __future__ import annotations

import shutil
from pathlib import Path

import yaml

from bundles import rewrite_contract
from command_line import rlservo_here
from rlservo.bundle.bundle import read_contract
from rlservo.bundle.contract import Evaluation
from rlservo.bundle.spaces import BoxSpec, MultiDiscreteSpec
from rlservo.export.card import card


def test_a_card_says_what_the_policy_sees_does_and_reaches(ur5: Path, tmp_path: Path) -> None:
    bundle = shutil.copytree(ur5, tmp_path / "ur5" / "1")
    evaluation = Evaluation(
        env_id="rlservo/EndEffectorPositioningURSim-v0", episodes=200, first_seed=0, return_bundle=1.83,
        return_interval=(1.8, 1.86), success_rate_bundle=0.985, success_interval=(0.957, 0.995),
        disturbance="latency=3|noise=real", evaluated_at="2026-11-29T00:00:00+00:00",
    )  # fmt: skip
    rewrite_contract(bundle, evaluations=(evaluation,), description="Reaches: a | b")
    said = rlservo_here("inspect", bundle, "--card", tmp_path / "README.md", "--license", "apache-2.0")
    assert said.returncode == 0, said.stderr
    text = (tmp_path / "README.md").read_text()
    _, front, body = text.split("---\n", 2)
    data = yaml.safe_load(front)
    assert data["license"] == "apache-2.0" and data["library_name"] == "rlservo"
    (result,) = data["model-index"][0]["results"]
    assert result["metrics"][0] == {"type": "success_rate", "name": "success", "value": 0.985}
    assert "latency=3\\|noise=real | 200 | 98.5% | 95.7% to 99.5% | 1.83 (1.8 to 1.86) |" in body
    contract = read_contract(bundle)
    for element in (*contract.observation_space.elements, *contract.action_space.elements):  # type: ignore[union-attr]
        assert f"| {element.name} | {element.unit or '-'} |" in body
    assert 'rlservo.Policy.load("policies/ur5")' in body
    for line in body.splitlines():  # a table is whole: as many cells as its head
        if line.startswith("|"):
            assert line.endswith("|")


def test_a_card_that_cannot_be_written_is_refused_by_its_place(ur5: Path, tmp_path: Path) -> None:
    said = rlservo_here("inspect", ur5, "--card", tmp_path / "no" / "README.md")
    assert said.returncode == 2 and "README.md cannot be written: No such file" in said.stderr


def test_a_card_gives_no_element_the_range_of_another(ur5: Path) -> None:
    contract = read_contract(ur5)
    low = (-1.0, -8.0, *[None] * 25)
    space = BoxSpec(shape=(27,), dtype="float32", low=low, high=(1.0, 8.0, *[None] * 25))
    text = card(contract.model_copy(update={"observation_space": space}))
    assert "27 numbers (float32), their ranges -1 to 1, -8 to 8, not bounded; they are not named one by one." in text
    choices = MultiDiscreteSpec(shape=(2,), nvec=(3, 2), start=(0, 0), dtype="int64")
    text = card(contract.model_copy(update={"action_space": choices}))
    assert "2 numbers (int64), their ranges 0 to 2, 0 to 1; they are not named one by one." in text
