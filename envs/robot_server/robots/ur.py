"""A UR arm, simulated or real, behind a robot server. On the wire joints come in ROS order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rlservo.envs.robot_server.robot_server_settings import URSettings
from rlservo.envs.robot_server.robots.arm import ArmRobot
from rlservo.envs.ur.rs_modes import ROS_ORDER, state_names
from rlservo.envs.ur.server_state import state_dict
from rlservo.robots.connect_arm import connect_arm
from rlservo.robots.ur.parameters import JOINTS, POSITION_LIMITS, cycle_of
from rlservo.robots.ur.simulation import URSimulation

INITIAL_JOINTS = (0.0, -2.5, 1.5, -1.5, -1.4, 0.0)  # [rad]
# A list that is not one of our states has the positions after six other numbers, as in robo-gym's first versions.
OLD_LIST = ("0", "1", "2", "3", "4", "5", *(f"{JOINTS[index]}_joint_position" for index in ROS_ORDER))


class URRobot(ArmRobot[URSimulation]):
    """A UR arm; a reference frame `base` is turned by pi against base_link."""

    ORDER = ROS_ORDER
    POSITION_NAMES = tuple(f"{joint}_joint_position" for joint in JOINTS)
    LOW, HIGH = -np.array(POSITION_LIMITS), np.array(POSITION_LIMITS)

    def __init__(self, settings: URSettings) -> None:
        simulation = URSimulation(
            settings.ur_model,
            max_velocity_scale=settings.max_velocity_scale_factor,
            cycle_s=cycle_of(settings.action_cycle_rate),
            objects=settings.object_names,
            table=settings.table,
            tool=settings.ee_frame or "tool0",
        )
        robot = connect_arm(
            settings.robot, simulation, limits=settings.limits, confirm=settings.confirm, metrics=settings.metrics
        )
        super().__init__(settings, simulation, robot, INITIAL_JOINTS)
        self._is_turned = settings.reference_frame == "base"
        if self._is_turned:
            self._to_base = np.array([-1.0, -1.0, 1.0])

    def _names(self) -> dict[str, float]:
        return state_dict(self.simulation, self._settings.rs_mode, is_turned=self._is_turned)

    def _list_names(self, count: int) -> Sequence[str]:
        in_list = state_names(self._settings.rs_mode)
        return in_list if count == len(in_list) else OLD_LIST
