"""The simulated arm: put it somewhere, command joint positions, let a control cycle pass, read where everything is.

It follows robo-gym's robot server: a command becomes a one-point joint trajectory, and the next command replaces it. It
knows nothing of observations, rewards or Gymnasium. Poses are in `base_link`, which stands unrotated on the table.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rlservo.envs.ur.model import BASE_HEIGHT, build_model
from rlservo.envs.ur.parameters import JOINTS, ur_parameters

MIN_TRAJECTORY_S = 0.5  # [s], the robot server never plans a shorter one

Vector = NDArray[np.float64]


class URSimulation:
    """One arm on its table, at 200 Hz physics.

    `max_velocity_scale` multiplies the arm's joint velocity limits, as the robot server's parameter of that name.
    """

    def __init__(self, ur_model: str = "ur5", *, max_velocity_scale: float = 0.1, cycle_s: float = 0.1) -> None:
        self.parameters = ur_parameters(ur_model)
        if not 0.0 < max_velocity_scale <= 1.0:
            raise ValueError(f"max_velocity_scale_factor is {max_velocity_scale:g}: expected more than 0, at most 1")
        self.model: mujoco.MjModel = build_model(self.parameters)
        self.data = mujoco.MjData(self.model)
        self.max_velocity = max_velocity_scale * np.array(self.parameters.velocity_limits)  # [rad/s], (6,)
        self._substeps = round(cycle_s / self.model.opt.timestep)
        if self._substeps < 1 or abs(self._substeps * self.model.opt.timestep - cycle_s) > 1e-9:
            raise ValueError(
                f"a control cycle of {cycle_s:g} s is not a multiple of the physics step of "
                f"{self.model.opt.timestep:g} s: expected a rate of 200/n Hz"
            )
        self._servo = np.array([self.data.actuator(name).id for name in JOINTS])
        self._feed_forward = np.array([self.data.actuator(f"{name}_velocity").id for name in JOINTS])
        self._tool = self.model.site("tool0").id
        self._forearm = self.model.body("forearm").id
        self._tool_xpos = self.data.site_xpos[self._tool]  # views that stay valid: MjData never moves
        self._tool_xmat = self.data.site_xmat[self._tool]
        self._target = self.model.body("target").mocapid[0]
        self._velocity: Vector = np.zeros(6)  # [rad/s], of the trajectory that is being executed
        self._remaining = 0  # substeps until that trajectory arrives
        self.in_collision = False

    # -- placing

    def place(self, joint_positions: ArrayLike) -> bool:
        """Put the arm at rest at `joint_positions` [rad] (6,). Return whether it collides there."""
        data = self.data
        mujoco.mj_resetData(self.model, data)
        data.qpos[:] = joint_positions
        data.act[:] = joint_positions
        self._velocity[:] = 0.0
        self._remaining = 0
        mujoco.mj_forward(self.model, data)
        self.in_collision = data.ncon > 0
        return self.in_collision

    def place_target(self, position: ArrayLike) -> None:
        """Move the target marker, which nothing collides with, to `position` [m] (3,) in base_link."""
        self.data.mocap_pos[self._target] = np.asarray(position) + (0.0, 0.0, BASE_HEIGHT)
        mujoco.mj_kinematics(self.model, self.data)

    # -- moving

    def command(self, joint_positions: ArrayLike) -> None:
        """Replace the trajectory: move to `joint_positions` [rad] (6,), all joints arriving together.

        It takes max(0.5 s, the slowest joint's way at its scaled velocity limit) and starts at the current setpoint.
        """
        goal = np.asarray(joint_positions, dtype=np.float64)
        way = goal - self.data.act
        duration = max(MIN_TRAJECTORY_S, float(np.max(np.abs(way) / self.max_velocity)))
        # Whole substeps, rounded up so that no joint exceeds its limit and the last substep ends at the goal.
        self._remaining = max(1, int(np.ceil(duration / self.model.opt.timestep - 1e-9)))
        np.divide(way, self._remaining * self.model.opt.timestep, out=self._velocity)

    def hold(self) -> None:
        """Stop where the arm is: the robot server does so when a cycle passes without a command."""
        self.data.act[:] = self.data.qpos
        self._velocity[:] = 0.0
        self._remaining = 0

    def advance(self) -> None:
        """Let one control cycle pass. A contact in any physics step sets `in_collision` until the next `place`."""
        model, data = self.model, self.data
        moving = min(self._substeps, self._remaining)
        if moving:
            data.ctrl[self._servo] = self._velocity
            data.ctrl[self._feed_forward] = self._velocity
            for _ in range(moving):
                mujoco.mj_step(model, data)
                if data.ncon:
                    self.in_collision = True
            self._remaining -= moving
        if moving < self._substeps:
            data.ctrl[:] = 0.0
            for _ in range(self._substeps - moving):
                mujoco.mj_step(model, data)
                if data.ncon:
                    self.in_collision = True
        # mj_step leaves the link poses of the last step's start: bring them up to the joints' final positions.
        mujoco.mj_kinematics(model, data)

    # -- reading

    @property
    def joint_positions(self) -> Vector:
        """Joint positions [rad] (6,), a view into the simulation."""
        return self.data.qpos  # type: ignore[no-any-return]  # mujoco's views are untyped

    @property
    def joint_velocities(self) -> Vector:
        """Joint velocities [rad/s] (6,), a view into the simulation."""
        return self.data.qvel  # type: ignore[no-any-return]

    @property
    def tool_position(self) -> Vector:
        """tool0's position in base_link [m] (3,)."""
        position: Vector = self._tool_xpos.copy()
        position[2] -= BASE_HEIGHT
        return position

    @property
    def tool_rotation(self) -> Vector:
        """The rotation matrix (3, 3) whose columns are tool0's axes in base_link."""
        return self._tool_xmat.reshape(3, 3)  # type: ignore[no-any-return]

    @property
    def target_position(self) -> Vector:
        """The target's position in base_link [m] (3,)."""
        position: Vector = self.data.mocap_pos[self._target].copy()
        position[2] -= BASE_HEIGHT
        return position

    def state(self) -> dict[str, float]:
        """Return the robot server's `state_dict` of the mode `1object`."""
        rotation = np.empty(4)
        mujoco.mju_mat2Quat(rotation, self._tool_xmat)  # w, x, y, z
        w, x, y, z = rotation.tolist()
        values: dict[str, float] = {}
        for axis, value in zip("xyz", self.target_position.tolist(), strict=True):
            values[f"object_0_to_ref_translation_{axis}"] = value
        values |= dict(zip(_OBJECT_ROTATION, (0.0, 0.0, 0.0, 1.0), strict=True))
        values |= dict(zip(_POSITIONS, self.data.qpos.tolist(), strict=True))
        values |= dict(zip(_VELOCITIES, self.data.qvel.tolist(), strict=True))
        for axis, value in zip("xyz", self.tool_position.tolist(), strict=True):
            values[f"ee_to_ref_translation_{axis}"] = value
        values |= dict(zip(_TOOL_ROTATION, (x, y, z, w), strict=True))
        values["in_collision"] = float(self.in_collision)
        return values

    def contacts(self) -> list[tuple[str, str]]:
        """Return the names of the bodies that touch now, for messages ('world' is the table and the ground)."""
        model: Any = self.model
        pairs = []
        for contact in self.data.contact[: self.data.ncon]:
            bodies = [model.body(model.geom_bodyid[geom]).name for geom in contact.geom]
            pairs.append((bodies[0], bodies[1]))
        return pairs


_POSITIONS = [f"{joint}_joint_position" for joint in JOINTS]
_VELOCITIES = [f"{joint}_joint_velocity" for joint in JOINTS]
_OBJECT_ROTATION = [f"object_0_to_ref_rotation_{axis}" for axis in "xyzw"]
_TOOL_ROTATION = [f"ee_to_ref_rotation_{axis}" for axis in "xyzw"]
