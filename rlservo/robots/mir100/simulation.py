"""The simulated robot: place it, command velocities, let a control cycle pass, read pose, lasers and contacts.

It follows robo-gym's robot server and the diff_drive_controller below it. Poses are x, y [m] and yaw [rad] of base_link
in the map frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from rlservo.robots.arm_interface import Vector
from rlservo.robots.disturbable import MAX_MODEL_ERROR
from rlservo.robots.mir100.lasers import LaserScanners
from rlservo.robots.mir100.model import TIMESTEP, model_xml
from rlservo.robots.mir100.parameters import (
    BEAM_COUNT,
    COMMAND_TIMEOUT_S,
    CYCLE_S,
    LASER_NOISE,
    MASS,
    MAX_ANGULAR_ACCELERATION,
    MAX_ANGULAR_VELOCITY,
    MAX_LINEAR_ACCELERATION,
    MAX_LINEAR_VELOCITY,
    SAFETY_DISTANCE,
    WHEEL_SEPARATION,
)
from rlservo.robots.mir100.worlds import Pose, find_world
from rlservo.robots.robot_port import Robot

GRAVITY = 9.81  # [m/s^2]
SUBSTEPS = round(CYCLE_S / TIMESTEP)
TIMEOUT_SUBSTEPS = round(COMMAND_TIMEOUT_S / TIMESTEP)
LINEAR_INCREMENT = MAX_LINEAR_ACCELERATION * TIMESTEP  # [m/s] a substep
HALF_STEP = TIMESTEP / 2  # [s]
ANGULAR_INCREMENT = MAX_ANGULAR_ACCELERATION * TIMESTEP  # [rad/s] a substep
# Of a camera: the whole room from above.
ROOM_VIEW: dict[str, Any] = {"lookat": (0.0, 0.0, 0.0), "distance": 9.5, "azimuth": 180.0, "elevation": -55.0}


class Mir100Simulation(Robot):
    """One robot in one world ("empty" or "lab_6x8"), at 100 Hz physics.

    `laser_noise` is the standard deviation of a reading [m]; 0 gives exact distances. The noise is drawn from `rng`,
    which may be replaced at any time; without one it differs from run to run.
    """

    def __init__(
        self, world: str = "empty", *, laser_noise: float = LASER_NOISE, rng: np.random.Generator | None = None
    ) -> None:
        if not 0.0 <= laser_noise < math.inf:
            raise ValueError(f"laser_noise is {laser_noise:g}: expected a standard deviation in m, 0 for none")
        self.world = find_world(world)
        self.xml = model_xml(self.world)
        self.model: mujoco.MjModel = mujoco.MjModel.from_xml_string(self.xml)
        self.data = mujoco.MjData(self.model)
        self.rng = np.random.default_rng() if rng is None else rng
        self.in_collision = False
        self._lasers = LaserScanners(self.model, self.data, laser_noise)
        self._sees_something = bool(self.world.walls or self.world.cubes)
        self._scan_is_fresh = False
        self._target_mocap = int(self.model.body("target").mocapid[0])
        self._cube_mocaps = [int(self.model.body(f"cube_{i}").mocapid[0]) for i in range(len(self.world.cubes))]
        self._target: Pose = (0.0, 0.0, 0.0)
        self._cubes = list(self.world.cubes)
        self._command = (0.0, 0.0)  # [m/s], [rad/s], the last one, within the velocity limits
        self._command_age = 0  # substeps
        self._setpoint = (0.0, 0.0)  # [m/s], [rad/s], the wheels' setpoint: follows within the acceleration limits
        self._velocity_factors = (1.0, 1.0)  # the wheels' error in a command, ahead and turning
        self._body = self.model.body("base_link").id
        self._data_sheet = (
            float(self.model.body_mass[self._body]),
            self.model.body_inertia[self._body].copy(),
            self.model.actuator_gainprm.copy(),
            self.model.actuator_biasprm.copy(),
        )
        self.place((0.0, 0.0, 0.0))

    # -- placing

    def place(
        self, pose: ArrayLike, *, target: ArrayLike | None = None, cubes: Sequence[ArrayLike] | Vector | None = None
    ) -> bool:
        """Put the robot at rest at `pose`, and target and cubes where given. Return whether the robot touches anything.

        Raises ValueError for a pose that is not three finite numbers, or for more or fewer cubes than the world has.
        """
        x, y, yaw = _pose("robot", pose)
        target_pose = self._target if target is None else _pose("target", target)
        cube_poses = self._cubes if cubes is None else [_pose(f"cube {i}", cube) for i, cube in enumerate(cubes)]
        if len(cube_poses) != len(self._cubes):
            raise ValueError(f"{len(cube_poses)} cubes were given; world {self.world.name!r} has {len(self._cubes)}")
        self._target, self._cubes = target_pose, cube_poses

        data = self.data
        mujoco.mj_resetData(self.model, data)
        data.qpos[:] = x, y, yaw
        _place_mocap(data, self._target_mocap, self._target)
        for mocap, cube in zip(self._cube_mocaps, self._cubes, strict=True):
            _place_mocap(data, mocap, cube)
        mujoco.mj_forward(self.model, data)
        self._command = self._setpoint = (0.0, 0.0)
        self._command_age = 0
        self._scan_is_fresh = False
        self.in_collision = data.ncon > 0
        return self.in_collision

    def move_target(self, pose: ArrayLike) -> None:
        """Move the target while the robot continues. Raises ValueError for an invalid pose."""
        self._target = _pose("target", pose)
        _place_mocap(self.data, self._target_mocap, self._target)
        mujoco.mj_kinematics(self.model, self.data)

    def move_cube(self, index: int, pose: ArrayLike) -> None:
        """Move a cube while the robot continues. Raises ValueError for an invalid pose or cube."""
        if not 0 <= index < len(self._cubes):
            raise ValueError(f"cube {index} does not exist: world {self.world.name!r} has {len(self._cubes)}")
        self._cubes[index] = _pose(f"cube {index}", pose)
        _place_mocap(self.data, self._cube_mocaps[index], self._cubes[index])
        mujoco.mj_kinematics(self.model, self.data)
        self._scan_is_fresh = False

    def draw_model_error(self, size: float, rng: np.random.Generator) -> dict[str, Any]:
        """Let the robot differ from its data sheet by up to `size` (0.05: 5%) and return what was drawn.

        Factors of mass, inertia and of the drive's gains are uniform in 1 +- size, and so are those of the velocities
        that the wheels make of a command (worn wheels; the limits with them), ahead and turning. Friction of the
        floor [N] is uniform from 0 to size times the weight, for turning [Nm] at half the wheels' separation.
        """
        if not 0.0 <= size <= MAX_MODEL_ERROR:
            raise ValueError(f"the model error is {size:g}: expected 0 to {MAX_MODEL_ERROR:g} of the model's values")
        model, (mass, inertia, gains, biases) = self.model, self._data_sheet
        mass_factor, inertia_factor = rng.uniform(1.0 - size, 1.0 + size, 2).tolist()
        gain_factors = rng.uniform(1.0 - size, 1.0 + size, len(gains))
        velocities = rng.uniform(1.0 - size, 1.0 + size, 2).tolist()
        drag = float(rng.uniform(0.0, size)) * MASS * GRAVITY
        model.body_mass[self._body] = mass * mass_factor
        model.body_inertia[self._body] = inertia * inertia_factor
        model.actuator_gainprm[:] = gains * gain_factors[:, None]
        model.actuator_biasprm[:] = biases * gain_factors[:, None]
        model.dof_frictionloss[:] = drag, drag, drag * WHEEL_SEPARATION / 2
        mujoco.mj_setConst(model, mujoco.MjData(model))
        self._velocity_factors = (velocities[0], velocities[1])
        return {
            "mass": mass_factor,
            "inertia": inertia_factor,
            "gains": gain_factors.tolist(),
            "friction": drag,
            "velocities": velocities,
        }

    # -- moving

    def command(self, linear: float, angular: float) -> bool:
        """Ask for velocities [m/s], [rad/s]; they are clipped to the robot's limits and hold for 0.5 s.

        Return False, and stop the robot, while anything is within 0.04 m of a scanner: the server refuses to move.
        """
        if not (math.isfinite(linear) and math.isfinite(angular)):
            raise ValueError(f"the velocity command is ({linear:g} m/s, {angular:g} rad/s): expected finite numbers")
        is_accepted = not self.is_blocked
        self._command = (
            (
                max(-MAX_LINEAR_VELOCITY, min(MAX_LINEAR_VELOCITY, linear)),
                max(-MAX_ANGULAR_VELOCITY, min(MAX_ANGULAR_VELOCITY, angular)),
            )
            if is_accepted
            else (0.0, 0.0)
        )
        self._command_age = 0
        return is_accepted

    def advance(self, substeps: int = SUBSTEPS) -> None:
        """Let one control cycle of 0.1 s pass, or `substeps` of 0.01 s. `in_collision` reports any contact in it."""
        model, data, step = self.model, self.data, mujoco.mj_step
        ctrl = data.ctrl
        linear, angular = self._setpoint
        linear_factor, angular_factor = self._velocity_factors
        in_contact = False
        for _ in range(substeps):
            if self._command_age >= TIMEOUT_SUBSTEPS:
                self._command = (0.0, 0.0)
            self._command_age += 1
            target_linear, target_angular = self._command[0] * linear_factor, self._command[1] * angular_factor
            linear += max(-LINEAR_INCREMENT, min(LINEAR_INCREMENT, target_linear - linear))
            angular += max(-ANGULAR_INCREMENT, min(ANGULAR_INCREMENT, target_angular - angular))
            ctrl[0] = linear
            ctrl[1] = linear * angular * HALF_STEP  # the motors act along the heading at the step's start, and a chord
            ctrl[2] = angular  # of the arc points half a step's turn to the left of that
            step(model, data)
            if data.ncon:
                in_contact = True
        self._setpoint = (linear, angular)
        # mj_step leaves the poses and contacts of its start: update them to the present state.
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        self.in_collision = in_contact or data.ncon > 0
        self._scan_is_fresh = False

    # -- state

    @property
    def commanded_velocity(self) -> tuple[float, float]:
        """Current command to the robot [m/s], [rad/s]."""
        return self._command

    @property
    def pose(self) -> Pose:
        """The robot's x, y [m] and yaw [rad, -pi .. pi]."""
        x, y, yaw = self.data.qpos.tolist()
        return x, y, wrap_angle(yaw)

    @property
    def velocity(self) -> tuple[float, float]:
        """Linear [m/s], along the robot's x, and angular velocity [rad/s], as its odometry gives them."""
        vx, vy, angular = self.data.qvel.tolist()
        yaw = float(self.data.qpos[2])
        return vx * math.cos(yaw) + vy * math.sin(yaw), angular

    @property
    def target(self) -> Pose:
        """Pose of the target."""
        return self._target

    @property
    def cubes(self) -> list[Pose]:
        """Poses of the cubes."""
        return list(self._cubes)

    @property
    def scan(self) -> Vector:
        """All readings [m], (1012,): the front scanner's 501, then the back scanner's 511, each counter-clockwise.

        0.05 .. 29.0; a beam that meets nothing also reads 29.0. The array is reused for the next cycle.
        """
        self._bring_scan_up_to_date()
        return self._lasers.readings

    def beams(self, readings: ArrayLike | None = None) -> Vector:
        """Return both ends of the laser beams in the map frame [m] (n, 2, 3), as the scan has them.

        Of `readings` (n,) of beams picked evenly from all, as an observation has them, where given. None if the
        world has nothing that a beam could meet.
        """
        if readings is not None:
            return self._lasers.ends(np.asarray(readings, dtype=np.float64))
        return self._lasers.ends(self.scan) if self._sees_something else np.zeros((0, 2, 3))

    @property
    def is_blocked(self) -> bool:
        """Whether anything is within 0.04 m of a scanner, noise aside. (A reading itself is never below 0.05 m.)"""
        self._bring_scan_up_to_date()
        return self._lasers.nearest < SAFETY_DISTANCE

    def state(self) -> Vector:
        """Return the robot server's `state`, (1030,).

        Target pose (3), robot pose (3), linear and angular velocity (2), front scan (501), back scan (511),
        collision (1), cube poses (9; zeros if there are no cubes).
        """
        state = np.zeros(8 + BEAM_COUNT + 1 + 9)
        state[0:3] = self._target
        state[3:6] = self.pose
        state[6:8] = self.velocity
        state[8 : 8 + BEAM_COUNT] = self.scan
        state[8 + BEAM_COUNT] = self.in_collision
        for index, cube in enumerate(self._cubes):
            start = 9 + BEAM_COUNT + 3 * index
            state[start : start + 3] = cube
        return state

    def contacts(self) -> list[str]:
        """Return the names of the walls and cubes the robot touches now, for messages."""
        model: Any = self.model
        names = {model.geom(geom).name for contact in self.data.contact[: self.data.ncon] for geom in contact.geom}
        return sorted(names - {"body"})

    def _bring_scan_up_to_date(self) -> None:
        if not self._scan_is_fresh:
            if self._sees_something:
                self._lasers.measure(self.rng)
            self._scan_is_fresh = True


def wrap_angle(angle: float) -> float:
    """Return the same direction within -pi .. pi [rad]."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def _pose(what: str, pose: ArrayLike) -> Pose:
    values = np.asarray(pose, dtype=np.float64)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ValueError(f"the pose of the {what} is {values.tolist()}: expected three finite numbers, x, y and yaw")
    x, y, yaw = values.tolist()
    return x, y, yaw


def _place_mocap(data: mujoco.MjData, index: int, pose: Pose) -> None:
    x, y, yaw = pose
    data.mocap_pos[index, :2] = x, y
    data.mocap_quat[index] = math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)
