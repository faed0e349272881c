"""Arms by address: a simulated scene for `mujoco`, a real arm's mirror for `rtde://HOST`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rlservo.robots.arm_interface import host_of
from rlservo.robots.ur.simulation import URSimulation


def make_arm(
    robot: str,
    ur_model: str,
    *,
    limits: Mapping[str, Any] | None = None,
    confirm: bool = True,
    metrics: str | None = None,
    dry_run: bool = False,
    **scene: Any,
) -> URSimulation:
    """Return the arm and its scene; `scene` is `URSimulation`'s. Raises RobotError if it cannot be reached.

    `dry_run` rehearses a real arm from its present pose, and sends it nothing.
    """
    host = host_of(robot)
    if host is None:
        return URSimulation(ur_model, **scene)
    from rlservo.robots.arm_process import ArmProcess
    from rlservo.robots.limits import Limits
    from rlservo.robots.operator_terminal import Operator
    from rlservo.robots.real_arm import RealArm

    checked = Limits.of({} if limits is None else limits)

    if dry_run:
        from rlservo.robots.rehearsed_arm import Rehearsal, RehearsedArm

        def rehearsed(_timeout_s: float) -> Any:
            return RehearsedArm(host, ur_model, velocity_scale=scene["max_velocity_scale"], limits=checked)

        return Rehearsal(ur_model, connect=rehearsed, operator=Operator(is_asked=False), **scene)

    def connect(setpoint_timeout_s: float) -> ArmProcess:
        return ArmProcess(
            host,
            ur_model,
            velocity_scale=scene["max_velocity_scale"],
            setpoint_timeout_s=setpoint_timeout_s,
            limits=checked,
        )

    operator = Operator(is_asked=confirm)
    return RealArm(ur_model, connect=connect, operator=operator, metrics=metrics, **scene)
