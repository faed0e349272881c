"""Conventions from an environment that the user names, and between two versions of a policy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rlservo.bundle.compatibility import interface_differences
from rlservo.bundle.contract import Contract
from rlservo.bundle.spaces import BoxSpec, Element
from rlservo.errors import UsageError
from rlservo.export.element_names import described_by, open_conventions, with_conventions
from rlservo.export.sources.restored_policy import ElementNames

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("torch")

ARM = """
class Arm:
    @classmethod
    def describe(cls, order="wxyz"):
        turn = [{{"name": f"q{{axis}}", "quantity": "quaternion", "axis": axis, "frame": "base"}} for axis in order]
        return {{"observation": turn, "action": [{{"name": "elbow", "quantity": "{quantity}", "scale": 0.5}}]}}
"""


class Recipe:
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (4,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))


RECIPE: Any = Recipe()


@pytest.fixture
def env_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Callable[[str], str]:
    monkeypatch.syspath_prepend(tmp_path)

    def write(quantity: str) -> str:
        name = f"arm_{abs(hash(request.node.name))}_{len(quantity)}"
        (tmp_path / f"{name}.py").write_text(ARM.format(quantity=quantity))
        return f"{name}:Arm"

    return write


def test_environment_that_is_named_says_what_the_checkpoint_does_not(env_id: Callable[[str], str]) -> None:
    arm = env_id("joint position")
    for known in (None, ElementNames((), (Element(name="action_0", quantity="raw"),), 20.0)):
        elements = described_by(arm, {"order": "xyzw"}, known, RECIPE)
        assert [element.axis for element in elements.observation] == list("xyzw")  # type: ignore[union-attr]
        assert elements.action == (Element(name="elbow", quantity="joint position", scale=0.5),)
    assert open_conventions(elements) == ""


@pytest.mark.parametrize(
    ("quantity", "known", "words"),
    [
        (
            "joint position",
            "joint velocity",
            "element 0 .* is a joint position there, the checkpoint has joint v",
        ),
        ("joint angle", "joint position", "Input should be 'joint position'"),
    ],
)
def test_environment_that_contradicts_or_is_not_understood_is_refused(
    quantity: str, known: Any, words: str, env_id: Callable[[str], str]
) -> None:
    checkpoint = ElementNames((), (Element(name="a", quantity=known),))
    with pytest.raises(UsageError, match=f"--env arm_.*{words}"):
        described_by(env_id(quantity), {}, checkpoint, RECIPE)
    with pytest.raises(UsageError, match="--env CartPole-v1: it has no describe"):
        described_by("CartPole-v1", {}, checkpoint, RECIPE)
    with pytest.raises(UsageError, match="--env crane:Crane-v0 cannot be found: No module named 'crane': give"):
        described_by("crane:Crane-v0", {}, checkpoint, RECIPE)


def test_convention_that_no_element_needs_is_refused() -> None:
    named = ElementNames((Element(name="x", quantity="joint position"),) * 4, (Element(name="a"),))
    for name, value in (("quaternion", "wxyz"), ("frame", "base")):
        with pytest.raises(UsageError, match=f"--convention {name}: no element needs it"):
            with_conventions(named, {name: value}, RECIPE)
    unnamed = with_conventions(ElementNames(), {"action": "relative"}, RECIPE)
    assert unnamed.action == (Element(name="action_0", quantity="relative joint position"),)


def test_next_version_may_not_swap_a_convention(shipped: Path) -> None:
    from rlservo.bundle.bundle import load_bundle

    contract = load_bundle(shipped / "ur5" / "1").contract
    space = contract.observation_space
    assert isinstance(space, BoxSpec)

    def with_target(**change: Any) -> Contract:
        elements = list(space.elements)
        elements[15] = elements[15].model_copy(update=change)
        return contract.model_copy(update={"observation_space": space.model_copy(update={"elements": tuple(elements)})})

    assert interface_differences(contract, contract) == ""
    assert interface_differences(with_target(frame="base"), contract) == (
        "obs element 15 (target_x) is in frame base instead of base_link"
    )
    assert "has unit mm instead of m" in interface_differences(with_target(unit="mm"), contract)
    assert interface_differences(with_target(frame="", quantity=None), contract) == ""  # an old one says nothing
