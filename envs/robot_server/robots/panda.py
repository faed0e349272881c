"""The Panda behind a robot server."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rlservo.envs.panda.arm_env import PandaArmEnv
from rlservo.envs.panda.server_state import STATE_JOINTS, state_dict, state_names
from rlservo.envs.robot_server.robot_server_settings import PandaSettings
from rlservo.envs.robot_server.robots.arm import ArmRobot
from rlservo.robots.panda.model import HIGH, LOW
from rlservo.robots.panda.simulation import PandaSimulation
from rlservo.robots.ur.parameters import cycle_of


class PandaRobot(ArmRobot[PandaSimulation]):
    """The arm; every reference frame of `PandaSettings` is its base."""

    ORDER = (0, 1, 2, 3, 4, 5, 6)
    POSITION_NAMES = tuple(f"{joint}_position" for joint in STATE_JOINTS)
    LOW, HIGH = np.array(LOW), np.array(HIGH)

    def __init__(self, settings: PandaSettings) -> None:
        simulation = PandaSimulation(
            max_velocity_scale=settings.max_velocity_scale_factor,
            cycle_s=cycle_of(settings.action_cycle_rate),
            objects=settings.object_names,
            table=settings.table,
        )
        super().__init__(settings, simulation, simulation, PandaArmEnv.START_JOINTS)

    def _names(self) -> dict[str, float]:
        return state_dict(self.simulation, self._settings.rs_mode)

    def _list_names(self, count: int) -> Sequence[str]:
        names = state_names(self._settings.rs_mode)
        return names if count == len(names) else ()
