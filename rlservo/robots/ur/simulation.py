"""Simulated arms: place one, command joint positions, let a control cycle pass, read positions.

They follow robo-gym's robot server: a command becomes a one-point joint trajectory, and the next command replaces it;
objects stand or move along paths. The Gymnasium environments and the robot server both run on it. Poses are in
the frame of the arm's base, which stands unrotated: `base_link` of a UR.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, Protocol

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from rlservo.robots.arm_interface import Vector
from rlservo.robots.disturbable import MAX_MODEL_ERROR
from rlservo.robots.robot_port import Robot
from rlservo.robots.ur.model import BASE_HEIGHT, TIMESTEP, Table, model_xml
from rlservo.robots.ur.object_paths import UPDATE_RATE_HZ, Path
from rlservo.robots.ur.parameters import JOINTS, ur_parameters

MIN_TRAJECTORY_S = 0.5  # [s], the robot server never plans a shorter one
SETTLE_CYCLES = 20  # the robot server lets this many pass after it has set a state

# Of a camera.
VIEW: dict[str, Any] = {"lookat": (0.0, 0.05, 0.42), "distance": 2.3, "azimuth": 145.0, "elevation": -18.0}

# Of `joints_towards`.
REACH_STEPS = 60
REACH_STEP = 0.05  # [m], of the tool at once
REACH_TURN = 0.2  # [rad]
REACHED = 1e-6  # [m], and [rad]
REACH_DAMPING = 0.05  # [m], keeps the joints calm when the arm is stretched

LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")  # the moving links
MAX_PAYLOAD = 35.0  # [kg], what the strongest arm carries, a ur30


class _DataSheet(NamedTuple):
    """The model's figures as built, from which a model error is drawn."""

    max_velocity: Vector  # [rad/s], (joints,)
    masses: Vector  # [kg], LINKS
    inertias: Vector  # [kg m^2], (6, 3)
    gains: Vector  # of the actuators, by MuJoCo's parameters
    biases: Vector


class _Limits(Protocol):
    @property
    def velocity_limits(self) -> tuple[float, ...]: ...
    @property
    def effort_limits(self) -> tuple[float, ...]: ...


class ArmSimulation(Robot):
    """One arm and its scene, at 200 Hz physics, or the next higher rate with a whole number of steps per control cycle.

    `max_velocity_scale` multiplies the arm's joint velocity limits, as the robot server's parameter of that name.
    `xml` is the model, with an actuator and a `<joint>_velocity` for each of JOINTS, bodies LINKS, payload and
    `object_<i>`, and a site `tool`, which is the end effector.
    """

    JOINTS: ClassVar[tuple[str, ...]]
    LINKS: ClassVar[tuple[str, ...]]  # bodies that move
    BASE_HEIGHT: ClassVar[float]  # [m], of the arm's base in MuJoCo's world

    def __init__(
        self,
        parameters: _Limits,
        xml: str,
        *,
        tool: str,
        max_velocity_scale: float,
        cycle_s: float,
        object_count: int,
        min_trajectory_s: float = MIN_TRAJECTORY_S,
    ) -> None:
        if not 0.0 < max_velocity_scale <= 1.0:
            raise ValueError(f"max_velocity_scale_factor is {max_velocity_scale:g}: expected more than 0, at most 1")
        self.xml = xml
        self.model: mujoco.MjModel = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)
        self._effort_limits = parameters.effort_limits
        self.velocity_scale, self.cycle_s, self._min_trajectory_s = max_velocity_scale, cycle_s, min_trajectory_s
        self.max_velocity = max_velocity_scale * np.array(parameters.velocity_limits)  # [rad/s], (joints,)
        self._substeps = math.ceil(cycle_s / TIMESTEP - 1e-9)
        if abs(self._substeps * TIMESTEP - cycle_s) > 1e-9:
            self.model.opt.timestep = cycle_s / self._substeps
        self._servo = np.array([self.data.actuator(name).id for name in self.JOINTS])
        self._feed_forward = np.array([self.data.actuator(f"{name}_velocity").id for name in self.JOINTS])
        self.tool = tool
        self._tool = self.model.site(tool).id
        self._tool_xpos = self.data.site_xpos[self._tool]  # views that stay valid: MjData never moves
        self._tool_xmat = self.data.site_xmat[self._tool]
        self._objects = [int(self.model.body(f"object_{index}").mocapid[0]) for index in range(object_count)]
        self._moving: dict[int, Path] = {}  # by mocap index, in the world
        self._tick = 0  # substeps since the objects' paths began
        self._payload = self.model.body("payload").id
        self._links = np.array([self.model.body(name).id for name in self.LINKS])
        self._data_sheet = _DataSheet(
            self.max_velocity.copy(),
            self.model.body_mass[self._links].copy(),
            self.model.body_inertia[self._links].copy(),
            self.model.actuator_gainprm.copy(),
            self.model.actuator_biasprm.copy(),
        )
        self._trial: Any = None  # MjData for what nothing of the scene may move
        self._velocity: Vector = np.zeros(len(self.JOINTS))  # [rad/s], of the trajectory that is being executed
        self._remaining = 0  # substeps until that trajectory arrives
        self.in_collision = False

    # -- placing

    def place(self, joint_positions: ArrayLike) -> bool:
        """Put the arm at rest at positions [rad] (joints,), objects out of the way; return whether it collides."""
        data = self.data
        self._moving = {}
        mujoco.mj_resetData(self.model, data)
        data.qpos[:] = joint_positions
        data.act[:] = joint_positions
        self._velocity[:] = 0.0
        self._remaining = 0
        mujoco.mj_forward(self.model, data)
        self.in_collision = data.ncon > 0
        return self.in_collision

    def place_object(self, index: int, position: ArrayLike) -> None:
        """Put an object at `position` [m] (3,) in the base's frame and leave it there."""
        self.move_objects({index: np.asarray(position, dtype=np.float64)[None, :]})

    def move_objects(self, paths: dict[int, Path]) -> None:
        """Let objects move along `paths` ((n, 3) [m] in the base's frame, 100 positions a second, repeated) from now.

        Call it after `place`, which ends all paths.
        """
        self._tick = 0
        for index, path in paths.items():
            in_world = path + (0.0, 0.0, self.BASE_HEIGHT)
            mocap = self._objects[index]
            self.data.mocap_pos[mocap] = in_world[0]
            self._moving.pop(mocap, None)
            if len(path) > 1:
                self._moving[mocap] = in_world
        mujoco.mj_kinematics(self.model, self.data)

    def settle(self) -> None:
        """Let 20 cycles pass with the arm at rest: the robot server does so at the end of a reset."""
        self.hold()
        for _ in range(SETTLE_CYCLES):
            self.advance()

    def set_payload(self, mass: float) -> None:
        """Fasten a point mass [kg] to the tool, unknown to the arm's gravity compensation; 0 removes it."""
        if not 0.0 <= mass <= MAX_PAYLOAD:
            raise ValueError(f"the payload is {mass:g} kg: expected 0 to {MAX_PAYLOAD:g} kg")
        self.model.body_mass[self._payload] = mass
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    def draw_model_error(self, size: float, rng: np.random.Generator) -> dict[str, Any]:
        """Let the arm differ from its data sheet by up to `size` (0.05: 5%) and return what was drawn.

        Factors of each link's mass and inertia and of each joint's servo gains, and one of the velocity limits, are
        uniform in 1 +- size. Friction is that of a joint without motion [Nm], uniform from 0 to size times its effort
        limit: 5% are 7.5 Nm at a UR5's base, of the order that is identified for these drives. The arm compensates
        for the gravity of the masses in the data sheet.
        """
        if not 0.0 <= size <= MAX_MODEL_ERROR:
            raise ValueError(f"the model error is {size:g}: expected 0 to {MAX_MODEL_ERROR:g} of the model's values")
        model, sheet = self.model, self._data_sheet
        masses, inertias = rng.uniform(1.0 - size, 1.0 + size, (2, len(self.LINKS)))
        gains = rng.uniform(1.0 - size, 1.0 + size, len(self.JOINTS))
        friction = rng.uniform(0.0, size, len(self.JOINTS)) * self._effort_limits
        speed = float(rng.uniform(1.0 - size, 1.0 + size))
        model.body_mass[self._links] = sheet.masses * masses
        model.body_gravcomp[self._links] = 1.0 / masses
        model.body_inertia[self._links] = sheet.inertias * inertias[:, None]
        for actuators in (self._servo, self._feed_forward):
            model.actuator_gainprm[actuators] = sheet.gains[actuators] * gains[:, None]
            model.actuator_biasprm[actuators] = sheet.biases[actuators] * gains[:, None]
        model.dof_frictionloss[:] = friction
        self.max_velocity = sheet.max_velocity * speed
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return {
            "masses": masses.tolist(),
            "inertias": inertias.tolist(),
            "gains": gains.tolist(),
            "friction": friction.tolist(),
            "velocity_limit": speed,
        }

    # -- moving

    def command(self, joint_positions: ArrayLike) -> float:
        """Replace the trajectory: move to `joint_positions` [rad] (joints,), all joints arriving together.

        It takes max(`min_trajectory_s`, the slowest joint's travel at its scaled velocity limit), from the setpoint.
        Return how long it takes [s].
        """
        goal = np.asarray(joint_positions, dtype=np.float64)
        way = goal - self.data.act
        duration = max(self._min_trajectory_s, float((np.abs(way) / self.max_velocity).max()))
        timestep = float(self.model.opt.timestep)
        # Whole substeps, rounded up so that no joint exceeds its limit and the last substep ends at the goal.
        self._remaining = max(1, math.ceil(duration / timestep - 1e-9))
        duration = self._remaining * timestep
        np.divide(way, duration, out=self._velocity)
        return duration

    def hold(self) -> None:
        """Stop in place: the robot server does so when a cycle passes without a command."""
        self.data.act[:] = self.data.qpos
        self._velocity[:] = 0.0
        self._remaining = 0

    def drive(self, velocity: ArrayLike) -> None:
        """Let one control cycle pass in which the setpoint moves at a velocity [rad/s] (joints,)."""
        self._velocity[:] = velocity
        self._remaining = self._substeps
        self.advance()

    def advance(self) -> None:
        """Let one control cycle pass. A contact in any physics step sets `in_collision` until the next `place`."""
        data = self.data
        travelling = min(self._substeps, self._remaining)
        if travelling:
            data.ctrl[self._servo] = self._velocity
            data.ctrl[self._feed_forward] = self._velocity
            self._step(travelling)
            self._remaining -= travelling
        if travelling < self._substeps:
            data.ctrl[:] = 0.0
            self._step(self._substeps - travelling)
        # mj_step leaves the link poses of the last step's start: bring them up to the joints' final positions.
        if self._moving:
            self._move_objects()
        mujoco.mj_kinematics(self.model, data)

    def _step(self, count: int) -> None:
        model, data, moving, step = self.model, self.data, self._moving, mujoco.mj_step
        for _ in range(count):
            if moving:
                self._move_objects()
                self._tick += 1
            step(model, data)
            if data.ncon:
                self.in_collision = True

    def _move_objects(self) -> None:
        update = int(self._tick * self.model.opt.timestep * UPDATE_RATE_HZ + 1e-6)
        for mocap, path in self._moving.items():
            self.data.mocap_pos[mocap] = path[update % len(path)]

    # -- reading

    @property
    def commanded_velocity(self) -> Vector:
        """Joint velocities [rad/s] (joints,) of the trajectory that is being executed; zero once it has arrived."""
        return self._velocity.copy() if self._remaining else np.zeros(len(self.JOINTS))

    @property
    def joint_positions(self) -> Vector:
        """Joint positions [rad] (joints,), a view into the simulation."""
        return self.data.qpos  # type: ignore[no-any-return]  # mujoco's views are untyped

    @property
    def joint_velocities(self) -> Vector:
        """Joint velocities [rad/s] (joints,), a view into the simulation."""
        return self.data.qvel  # type: ignore[no-any-return]

    @property
    def joint_torques(self) -> Vector:
        """Torques of the actuators [Nm] (joints,), gravity compensation included; a view into the simulation."""
        return self.data.qfrc_actuator  # type: ignore[no-any-return]

    @property
    def tool_position(self) -> Vector:
        """The tool's position in the base's frame [m] (3,)."""
        position: Vector = self._tool_xpos.copy()
        position[2] -= self.BASE_HEIGHT
        return position

    def joints_towards(
        self, position: ArrayLike, rotation: Vector | None = None, *, start: ArrayLike | None = None
    ) -> Vector:
        """Return joint positions [rad] (joints,) that bring the tool to a position of the base's frame [m] (3,).

        The tool may only come near it; with `rotation` (3, 3) its axes are turned too. Damped least squares from
        `start`, by default from the arm's present posture, so that it is kept; nothing moves.
        """
        goal = np.asarray(position, dtype=np.float64)
        joints: Vector = np.array(self.joint_positions if start is None else start, dtype=np.float64)
        for _ in range(REACH_STEPS):
            tool, axes, jacobian = self.tool_frame_at(joints)
            way = goal - tool
            way *= min(1.0, REACH_STEP / max(float(np.linalg.norm(way)), 1e-9))
            if rotation is None:
                jacobian = jacobian[:3]
            else:  # the axes' errors, as a rotation vector
                turn = 0.5 * np.cross(axes.T, rotation.T).sum(axis=0)
                turn *= min(1.0, REACH_TURN / max(float(np.linalg.norm(turn)), 1e-9))
                way = np.concatenate([way, turn])
            if float(np.linalg.norm(way)) < REACHED:
                break
            damping = REACH_DAMPING * min(1.0, float(np.linalg.norm(way)) / REACH_STEP)
            damped = jacobian @ jacobian.T + max(damping, 1e-3) ** 2 * np.eye(len(way))
            joints += jacobian.T @ np.linalg.solve(damped, way)
        return joints

    def tool_at(self, joint_positions: ArrayLike) -> tuple[Vector, Vector]:
        """Return the tool's position at given joints in the base's frame [m] (3,) and its Jacobian [m/rad]."""
        position, _, jacobian = self.tool_frame_at(joint_positions)
        return position, jacobian[:3]

    def tool_frame_at(self, joint_positions: ArrayLike) -> tuple[Vector, Vector, Vector]:
        """Return the tool's position, its axes as columns (3, 3), and the Jacobian of both (6, joints)."""
        if self._trial is None:
            self._trial = mujoco.MjData(self.model)
        trial, jacobian = self._trial, np.zeros((6, self.model.nv))
        trial.qpos[:] = joint_positions
        mujoco.mj_kinematics(self.model, trial)
        mujoco.mj_comPos(self.model, trial)
        mujoco.mj_jacSite(self.model, trial, jacobian[:3], jacobian[3:], self._tool)
        axes = trial.site_xmat[self._tool].reshape(3, 3)
        return trial.site_xpos[self._tool] - (0.0, 0.0, self.BASE_HEIGHT), axes, jacobian

    @property
    def tool_rotation(self) -> Vector:
        """The rotation matrix (3, 3) whose columns are the tool's axes in the base's frame."""
        return self._tool_xmat.reshape(3, 3)  # type: ignore[no-any-return]

    def object_position(self, index: int) -> Vector:
        """Position of an object in the base's frame [m] (3,)."""
        position: Vector = self.data.mocap_pos[self._objects[index]].copy()
        position[2] -= self.BASE_HEIGHT
        return position

    @property
    def object_count(self) -> int:
        """Number of objects the scene holds."""
        return len(self._objects)

    def contacts(self) -> list[tuple[str, str]]:
        """Return the names of the bodies that touch now, for messages ('world' is the table and the ground)."""
        model: Any = self.model
        pairs = []
        for contact in self.data.contact[: self.data.ncon]:
            bodies = [model.body(model.geom_bodyid[geom]).name for geom in contact.geom]
            pairs.append((bodies[0], bodies[1]))
        return pairs


class URSimulation(ArmSimulation):
    """A UR arm on its table.

    `objects` are names of `OBJECT_MODELS`. Without `table` the arm stands 0.1 m above bare ground. `tool` is the end
    effector: tool0, or tool1, whose x axis is tool0's z.
    """

    JOINTS = JOINTS
    LINKS = LINKS
    BASE_HEIGHT = BASE_HEIGHT

    def __init__(
        self,
        ur_model: str = "ur5",
        *,
        max_velocity_scale: float = 0.1,
        cycle_s: float = 0.1,
        objects: Sequence[str] = ("sphere50_no_collision",),
        table: Table = True,
        tool: str = "tool0",
        min_trajectory_s: float = MIN_TRAJECTORY_S,
    ) -> None:
        self.ur_model, self.parameters = ur_model, ur_parameters(ur_model)
        super().__init__(
            self.parameters,
            model_xml(self.parameters, objects=objects, table=table),
            tool=tool,
            max_velocity_scale=max_velocity_scale,
            cycle_s=cycle_s,
            object_count=len(objects),
            min_trajectory_s=min_trajectory_s,
        )
        forearm = self.model.body("forearm").id
        self._forearm_xpos = self.data.xpos[forearm]
        self._forearm_xmat = self.data.xmat[forearm]

    def calibrate(self, frames: Vector) -> None:
        """Give the model a real arm's kinematics: joints' axes and flange as in `calibration.py`'s frames (7, 4, 4).

        A link keeps its place along its joint's axis and about it, which an axis does not tell.
        """
        model, data = self.model, mujoco.MjData(self.model)
        mujoco.mj_kinematics(model, data)
        base = _pose(data.body("base"))
        flange = base @ frames[6] @ np.linalg.inv(_pose(data.site("tool0")))
        sites = [(model.site(name), flange @ _pose(data.site(name))) for name in ("tool0", "tool1")]
        parent = base
        for link, frame in zip(self.LINKS, base @ frames[:6], strict=True):
            pose, axis = _pose(data.body(link)), frame[:3, 2]
            across = np.cross(pose[:3, 2], axis)
            cross = np.cross(across, np.eye(3)).T
            pose[:3, :3] = (np.eye(3) + cross + cross @ cross / (1.0 + pose[:3, 2] @ axis)) @ pose[:3, :3]
            pose[:3, 3] = frame[:3, 3] + axis * (axis @ (pose[:3, 3] - frame[:3, 3]))
            _place(model.body(link), np.linalg.inv(parent) @ pose)
            parent = pose
        for site, pose in sites:
            _place(site, np.linalg.inv(parent) @ pose)
        mujoco.mj_setConst(model, data)

    @property
    def forearm_position(self) -> Vector:
        """The forearm link's origin, the elbow, in base_link [m] (3,)."""
        position: Vector = self._forearm_xpos.copy()
        position[2] -= self.BASE_HEIGHT
        return position

    @property
    def forearm_rotation(self) -> Vector:
        """The rotation matrix (3, 3) whose columns are the forearm link's axes in base_link."""
        return self._forearm_xmat.reshape(3, 3)  # type: ignore[no-any-return]


def _pose(view: Any) -> Vector:
    """Return the pose in the world (4, 4) of a body or site."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = view.xmat.reshape(3, 3), view.xpos
    return pose


def _place(view: Any, pose: Vector) -> None:
    """Put a body, or a site, at a pose (4, 4) in its parent's frame."""
    view.pos[:] = pose[:3, 3]
    mujoco.mju_mat2Quat(view.quat, pose[:3, :3].flatten())
