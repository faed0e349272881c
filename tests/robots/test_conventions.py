"""A real arm takes only a policy whose conventions are its own: each is swapped by itself, by its public commands."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from arms import LIMITS, RunningArm, run_arm
from rlservo.drive.control_loop import rollout
from rlservo.envs.ur.isaac_reach import IsaacReachURSim
from rlservo.errors import UsageError
from rlservo.policy.policy import Policy

pytest.importorskip("rtde_control")
torch = pytest.importorskip("torch")

ENV = "rlservo/IsaacReachURSim-v0"
Side = list[dict[str, Any]]


@pytest.fixture(scope="module")
def ur10() -> Iterator[RunningArm]:
    yield from run_arm("ur10")


@pytest.fixture(scope="module")
def trained() -> Any:
    """A module of the task's 25 numbers and 6 joints."""
    torch.manual_seed(0)
    return torch.nn.Sequential(torch.nn.Linear(25, 16), torch.nn.ELU(), torch.nn.Linear(16, 6))


@pytest.fixture(scope="module")
def spaces() -> tuple[Any, Any]:
    env = IsaacReachURSim()
    env.close()
    return env.observation_space, env.action_space


@pytest.fixture
def exported(trained: Any, spaces: tuple[Any, Any], tmp_path: Path) -> Callable[[Side, Side], Path]:
    """Return a function that exports the module as a policy of these elements."""
    from rlservo.export.export_policy import export_policy

    def export(observation: Side, action: Side) -> Path:
        return export_policy(
            trained, *spaces, tmp_path, name="reach", observation_names=observation, action_names=action,
            control_rate_hz=30,
        ).path  # fmt: skip

    return export


def described() -> tuple[Side, Side]:
    told = json.loads(json.dumps(IsaacReachURSim.describe()))
    return told["observation"], told["action"]


def drive(bundle: Path, arm: RunningArm | None, *, unproven: bool = False) -> Any:
    robot = {"robot": f"rtde://{arm.host}", "confirm": False, "limits": LIMITS} if arm else {}
    with Policy.load(bundle) as policy:
        return rollout(policy, ENV, episodes=1, seed=1, env_kwargs={"ur_model": "ur10", **robot}, unproven=unproven)


def refused(bundle: Path, arm: RunningArm | None, words: str) -> None:
    """The arm has not moved when the policy is refused, though it needs no proof."""
    with pytest.raises(UsageError, match=words):
        drive(bundle, arm, unproven=True)
    if arm is not None:
        assert not abs(arm.controller.target_velocity).any()


def last_first(observation: Side, _: Side) -> None:
    for element, axis in zip(observation[15:19], "xyzw", strict=True):
        element |= {"axis": axis, "name": f"target_q{axis}"}


def degrees(observation: Side, _: Side) -> None:
    for element in observation[:6]:
        element["unit"] = "deg"
        del element["scale"]


def scaled_degrees(_: Side, action: Side) -> None:
    action[0]["scale"] *= 0.017453


def of_base(observation: Side, _: Side) -> None:
    for element in observation[12:19]:
        element["frame"] = "base"


def other_joints(observation: Side, action: Side) -> None:
    for side, index in ((observation, 0), (observation, 6), (action, 0)):
        side[index], side[index + 1] = side[index + 1], side[index]


def other_names(_: Side, action: Side) -> None:
    """Joints in another order under names that hide it, as a policy of another trainer may have."""
    action[0]["joint"], action[1]["joint"] = action[1]["joint"], action[0]["joint"]
    action[0]["offset"], action[1]["offset"] = action[1]["offset"], action[0]["offset"]


def relative(_: Side, action: Side) -> None:
    for element in action:
        element |= {"quantity": "relative joint position"}


def velocities(_: Side, action: Side) -> None:
    for element in action:
        element |= {"quantity": "joint velocity", "unit": "rad/s"}


SWAPS: dict[Callable[[Side, Side], None], str] = {
    last_first: "the observation elements 15 to 18 are a quaternion w, x, y, z there, but the policy has x, y, z, w",
    degrees: r"the observation element 0 \(base_position_offset\) has unit rad there, but the policy has deg",
    scaled_degrees: r"the action element 0 \(base_position_offset\) has scale 0.5 there, but the policy has 0.008726",
    of_base: r"the observation element 12 \(target_x\) is in frame base_link there, but the policy has base",
    other_joints: r"element 0 \(base_position_offset\) is of shoulder_pan_joint there, but the policy has "
    "shoulder_lift_",
    other_names: r"the action element 0 .* is of shoulder_pan_joint there, but the policy has shoulder_lift_joint",
    relative: r"the action element 0 .* is a joint position there, but the policy has relative joint position",
    velocities: r"the action element 0 .* is a joint position there, but the policy has joint velocity",
}


@pytest.mark.parametrize("swap", SWAPS, ids=lambda swap: swap.__name__)
def test_swapped_convention_is_refused_by_the_arm_and_by_the_simulator(
    swap: Callable[[Side, Side], None], ur10: RunningArm, exported: Callable[[Side, Side], Path]
) -> None:
    observation, action = described()
    swap(observation, action)
    bundle = exported(observation, action)
    refused(bundle, ur10, SWAPS[swap])
    refused(bundle, None, SWAPS[swap])


def without(key: str, side: Side) -> Side:
    return [{name: value for name, value in element.items() if name != key} for element in copy.deepcopy(side)]


OPEN = {
    "axis": (
        r"its observation does not state the order of the quaternion that element 15 \(target_qw\) is in; the robot's "
        r"is w, x, y, z: export it again, .* or with --convention quaternion=",
        {"quaternion": "wxyz"},
    ),
    "frame": (
        r"its observation does not state the frame of element 12 \(target_x\); the robot's is base_link: .*"
        "--convention frame=",
        {"frame": "base_link"},
    ),
    "quantity": (
        r"its action does not state which command element 0 .* is; the robot takes a joint position: .*action=",
        None,
    ),
}


@pytest.mark.parametrize("key", OPEN)
def test_open_convention_is_asked_for_by_the_arm_and_accepted_by_the_simulator(
    key: str, ur10: RunningArm, exported: Callable[[Side, Side], Path]
) -> None:
    words, _ = OPEN[key]
    observation, action = described()
    sides = (observation, without(key, action)) if key == "quantity" else (without(key, observation), action)
    bundle = exported(*sides)
    refused(bundle, ur10, words)
    assert drive(bundle, None).steps > 0


def test_policy_without_any_name_drives_the_simulator_and_no_arm(
    ur10: RunningArm, exported: Callable[[Side, Side], Path]
) -> None:
    bundle = exported([], [])
    assert drive(bundle, None).steps > 0
    refused(bundle, ur10, "its observation does not state")


def test_same_conventions_come_to_the_next_question(ur10: RunningArm, exported: Callable[[Side, Side], Path]) -> None:
    bundle = exported(*described())
    with pytest.raises(UsageError, match="was never evaluated under latency"):
        drive(bundle, ur10)
    assert drive(bundle, None).steps > 0
