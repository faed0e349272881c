"""Robot behind a robot server: put it somewhere, command it for one cycle, look at it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:  # MuJoCo is imported where a robot is made
    from rlservo.envs.robot_server.mir100_robot import Mir100Robot
    from rlservo.envs.robot_server.ur_robot import URRobot

CLOCKS = ("fast", "real")


@dataclass(frozen=True)
class RobotState:
    """robo-gym's State message, both ways."""

    values: Sequence[float] = ()
    names: Mapping[str, float] = field(default_factory=dict)  # state_dict
    float_params: Mapping[str, float] = field(default_factory=dict)
    string_params: Mapping[str, str] = field(default_factory=dict)


Robot: TypeAlias = "URRobot | Mir100Robot"
"""A simulated robot with the server's vocabulary. Every method raises ValueError for what it cannot honour."""
