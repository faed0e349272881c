"""Fields of ROS messages against what a policy says of its elements, and relative positions as targets; no ROS."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rlservo.bundle.spaces import BoxSpec, Element
from rlservo.deploy.ros2.mapped_elements import PresentPositions, check_conventions, places
from rlservo.errors import UsageError

POSITIONS, VELOCITIES = "/forward_position_controller/commands", "/forward_velocity_controller/commands"
ARRAY, STATES = "std_msgs/msg/Float64MultiArray", "/joint_states sensor_msgs/msg/JointState"
POSE = "/target geometry_msgs/msg/PoseStamped pose"


def contract_of(observation: list[dict[str, Any]], action: list[dict[str, Any]]) -> Any:
    sides = [
        BoxSpec(
            shape=(len(side),), dtype="float32", low=None, high=None, elements=tuple(Element(**one) for one in side)
        )
        for side in (observation, action)
    ]
    return SimpleNamespace(name="p", observation_space=sides[0], action_space=sides[1])


def check(contract: Any, mapped: dict[str, str], command: str = "/p/action") -> None:
    observed, acted = places(contract, mapped)
    check_conventions(contract, observed, acted, lambda topic: command if topic == "~/action" else topic)
    PresentPositions.of(contract, observed)


def joint(of: str, quantity: str = "joint position", **more: Any) -> dict[str, Any]:
    return {"name": of, "joint": of, "quantity": quantity, "unit": "rad", **more}


SEEN = [joint("pan"), joint("lift")]
TURN = [{"name": f"q{axis}", "quantity": "quaternion", "axis": axis} for axis in "wxyz"]


@pytest.mark.parametrize(
    ("observation", "action", "mapped", "command", "words"),
    [
        (SEEN, [{"name": "pan"}], {}, POSITIONS, "does not say which command its action 'pan' is: .*action=absolute"),
        (SEEN, [{"name": "pan", "quantity": "raw"}], {}, POSITIONS, "does not say which command its action 'pan' is"),
        (SEEN, [joint("pan")], {}, VELOCITIES,
         r"action element 'pan' is a joint position, but ~/action data\[0\] is a joint velocity"),
        (SEEN, [joint("wrist", "relative joint position")], {}, POSITIONS,
         "'wrist' is relative to the position of joint 'wrist', which no observation element is mapped to"),
        (SEEN, [joint("pan", "relative joint position")], {}, VELOCITIES, "is a joint position, but .* joint velocity"),
        (SEEN, [joint("pan")], {"observation.pan": f"{STATES} position[lift]"}, POSITIONS,
         r"observation element 'pan' is of pan, but /joint_states position\[lift\] is of lift"),
        (SEEN, [joint("pan")], {"observation.pan": f"{STATES} velocity[pan]"}, POSITIONS,
         "is a joint position, but /joint_states velocity.pan. is a joint velocity"),
        (SEEN, [joint("pan")], {"observation.pan": f"{STATES} position[pan] * 57.29577951308232"}, POSITIONS,
         "'pan' has scale 1, but .* has scale 0.01745"),
        ([joint("pan", unit="deg")], [joint("pan")], {"observation.pan": f"{STATES} position[pan]"}, POSITIONS,
         "'pan' has scale 0.01745, but .* has scale 1"),
        ([joint("pan", offset=-1.712)], [joint("pan")], {"observation.pan": f"{STATES} position[pan]"}, POSITIONS,
         "'pan' has offset -1.712, but .* has offset 0"),
        (TURN, [joint("pan")],
         {f"observation.{one['name']}": f"{POSE}.orientation.{axis}" for one, axis in zip(TURN, "xyzw", strict=True)},
         POSITIONS, "observation element 'qw' is the quaternion's part w, but /target pose.orientation.x .* part x"),
        (SEEN, [{"name": "v", "quantity": "linear velocity", "axis": "x", "scale": 0.5}],
         {"action.v": "/cmd_vel geometry_msgs/msg/Twist linear.x"}, "", "'v' has scale 0.5, but .* has scale 1"),
        (SEEN, [{"name": "v", "quantity": "linear velocity", "axis": "x"}],
         {"action.v": "/cmd_vel geometry_msgs/msg/Twist angular.z"}, "", "linear velocity, but .* angular velocity"),
    ],
)  # fmt: skip
def test_field_that_is_not_what_the_policy_says_is_refused(
    observation: list[dict[str, Any]], action: list[dict[str, Any]], mapped: dict[str, str], command: str, words: str
) -> None:
    with pytest.raises(UsageError, match=words):
        check(contract_of(observation, action), mapped, command)


def test_joints_are_found_by_the_contract_in_its_units_and_offsets() -> None:
    observation = [
        joint("pan", offset=-1.5, scale=1.0, name="pos_0"), joint("lift", unit="deg", scale=math.pi / 180),
        joint("pan", "joint velocity", unit="rad/s", scale=10.0, name="vel_0"),
    ]  # fmt: skip
    contract = contract_of(observation, [joint("pan")])
    check(contract, {}, POSITIONS)
    message = SimpleNamespace(name=["lift", "pan"], position=[math.pi / 2, 0.25], velocity=[0.0, 3.0])
    observed, _ = places(contract, {})
    assert [place.read(message) for place in observed] == pytest.approx([1.75, 90.0, 0.3])


def test_relative_position_becomes_the_present_one_and_the_scaled_action() -> None:
    contract = contract_of(
        [joint("lift", name="a"), joint("pan", name="b", offset=1.0, scale=0.5)],
        [joint("pan", "relative joint position", scale=0.0625, unit="1"), joint("lift", "joint position")],
    )
    check(contract, {}, POSITIONS)
    observed, _ = places(contract, {})
    present = PresentPositions.of(contract, observed)
    message = SimpleNamespace(name=["pan", "lift"], position=[-0.7, 0.2])
    observation = np.array([place.read(message) for place in observed], np.float32)
    targets = present.targets(np.array([2.0, 0.3], np.float32), observation)
    assert targets.tolist() == pytest.approx([-0.7 + 0.0625 * 2.0, 0.3], abs=1e-6)


def test_velocities_stop_at_the_number_that_is_no_velocity() -> None:
    speed = {"name": "v", "quantity": "joint velocity", "scale": 0.5, "offset": 0.1}
    contract = contract_of(SEEN, [speed, joint("pan"), joint("lift", "joint effort")])
    at = [place.stop for place in places(contract, {})[1]]
    assert at == [pytest.approx(-0.2), None, None]  # -0.2 * 0.5 + 0.1 = 0 rad/s
    assert [place.stop for place in places(contract, {"stop.v": "1.0", "stop.pan": "0.5"})[1]] == [1.0, 0.5, None]
    in_si = {"action.v": "/base std_msgs/msg/Float64 data * 0.5 + 0.1"}
    assert places(contract, in_si)[1][0].stop == pytest.approx(0.0)
