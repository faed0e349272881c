"""The simulated Panda: `ArmSimulation` with seven joints; poses are in robo-gym's `world`, the base's frame.

robo-gym's Panda sends positions straight to Gazebo's controllers, which know the velocity limits only as a scale; here
a command is a trajectory within the scaled limits, as a UR's is.
"""

from __future__ import annotations

from collections.abc import Sequence

from rlservo.robots.panda.model import JOINTS, LINKS, PandaParameters, model_xml
from rlservo.robots.ur.model import Table
from rlservo.robots.ur.simulation import ArmSimulation


class PandaSimulation(ArmSimulation):
    """The arm with its hand, whose frame `panda_hand` is the end effector."""

    JOINTS = JOINTS
    LINKS = LINKS
    BASE_HEIGHT = 0.0

    def __init__(
        self,
        *,
        max_velocity_scale: float = 0.2,
        cycle_s: float = 1 / 30,
        objects: Sequence[str] = (),
        table: Table = True,
    ) -> None:
        parameters = PandaParameters()
        super().__init__(
            parameters,
            model_xml(parameters, objects=objects, table=table),
            tool="panda_hand",
            max_velocity_scale=max_velocity_scale,
            cycle_s=cycle_s,
            object_count=len(objects),
        )
