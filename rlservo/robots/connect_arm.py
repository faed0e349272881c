"""Arms by address: the simulation itself for `mujoco`, a real arm for `rtde://HOST`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rlservo.robots.arm_interface import host_of
from rlservo.robots.robot_port import Arm
from rlservo.robots.ur.simulation import URSimulation

if TYPE_CHECKING:
    from rlservo.robots.arm_process import ArmProcess
    from rlservo.robots.real_arm import Aim


def connect_arm(
    robot: str,
    simulation: URSimulation,
    *,
    limits: Mapping[str, Any] | None = None,
    confirm: bool = True,
    metrics: str | None = None,
    dry_run: bool = False,
    aim: Aim | None = None,
) -> Arm:
    """Return the arm that the simulation is of. Raises RobotError if it cannot be reached.

    `dry_run` rehearses a real arm from its present pose, and sends it nothing. `aim` is `RealArm`'s.
    """
    host = host_of(robot)
    if host is None:
        return simulation
    from rlservo.robots.arm_process import ArmProcess
    from rlservo.robots.limits import Limits
    from rlservo.robots.operator_terminal import Operator
    from rlservo.robots.real_arm import RealArm

    checked = Limits.of({} if limits is None else limits)
    model, scale = simulation.ur_model, simulation.velocity_scale

    if dry_run:
        from rlservo.robots.rehearsed_arm import Rehearsal, RehearsedArm

        return Rehearsal(simulation, RehearsedArm(host, model, velocity_scale=scale, limits=checked), aim)

    def connect(timeout_s: float) -> ArmProcess:
        return ArmProcess(host, model, velocity_scale=scale, setpoint_timeout_s=timeout_s, limits=checked)

    return RealArm(simulation, connect=connect, operator=Operator(is_asked=confirm), aim=aim, metrics=metrics)
