"""Arms by address: a simulated scene for `mujoco`, a real arm's mirror for `rtde://HOST`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rlservo.envs.robots.arm import host_of
from rlservo.envs.ur.simulation import URSimulation


def make_arm(
    robot: str,
    ur_model: str,
    *,
    limits: Mapping[str, Any] | None = None,
    confirm: bool = True,
    metrics: str | None = None,
    **scene: Any,
) -> URSimulation:
    """Return the arm and its scene; `scene` is `URSimulation`'s. Raises RobotError if it cannot be reached."""
    host = host_of(robot)
    if host is None:
        return URSimulation(ur_model, **scene)
    from rlservo.envs.robots.limits import Limits
    from rlservo.envs.robots.mirrored_arm import MirroredArm
    from rlservo.envs.robots.operator_terminal import Operator
    from rlservo.envs.robots.rtde_arm import RtdeArm

    checked = Limits.of(dict(limits or {}))

    def connect(setpoint_timeout_s: float) -> RtdeArm:
        return RtdeArm(
            host,
            ur_model,
            velocity_scale=scene["max_velocity_scale"],
            setpoint_timeout_s=setpoint_timeout_s,
            limits=checked,
        )

    operator = Operator(is_asked=confirm)
    return MirroredArm(ur_model, connect=connect, operator=operator, metrics=metrics, **scene)
