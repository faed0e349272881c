"""State of the Panda as robo-gym's robot server reports it: one number for each name in its rs_mode.

Source: jr-robotics/robo-gym-robot-servers, panda_robot_server. Joints are `joint1` to `joint7` there.
"""

from __future__ import annotations

from rlservo.envs.ur.rs_modes import transform_names
from rlservo.envs.ur.server_state import object_transform, transform
from rlservo.robots.panda.simulation import PandaSimulation

RS_MODES = {"only_robot": 0, "1object": 1}  # objects in the state
STATE_JOINTS = tuple(f"joint{number}" for number in range(1, 8))


def state_names(rs_mode: str) -> list[str]:
    """Return the names of a mode's numbers, in the order of its list."""
    return [
        *(name for index in range(RS_MODES[rs_mode]) for name in transform_names(f"object_{index}")),
        *(f"{joint}_{quantity}" for quantity in ("position", "velocity", "effort") for joint in STATE_JOINTS),
        *transform_names("ee"),
        "in_collision",
    ]


def state_dict(arm: PandaSimulation, rs_mode: str) -> dict[str, float]:
    """Return the state by names; efforts are the actuators' torques [Nm]."""
    values: list[float] = []
    for index in range(RS_MODES[rs_mode]):
        values += object_transform(arm, index)
    for joints in (arm.joint_positions, arm.joint_velocities, arm.joint_torques):
        values += joints.tolist()
    values += transform(arm.tool_position, arm.tool_rotation)
    values.append(float(arm.in_collision))
    return dict(zip(state_names(rs_mode), values, strict=True))
