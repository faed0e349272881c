"""Reader of a robot server's state while a client drives it, shown on an environment's simulator."""

from __future__ import annotations

import math

import grpc
import numpy as np

from rlservo.envs.mir100.navigation import Mir100Navigation
from rlservo.envs.panda.arm_env import PandaArmEnv
from rlservo.envs.panda.server_state import STATE_JOINTS
from rlservo.envs.rendering import RenderedEnv
from rlservo.envs.robot_server.robo_gym_messages import ROBOT_SERVER, Empty, State
from rlservo.envs.robot_server.robots.mir100 import CUBES, ROBOT, STATE_LENGTH, TARGET
from rlservo.envs.robot_server.robots.robot import RobotState
from rlservo.envs.ur.arm_env import BASE, LIMITS, URArmEnv
from rlservo.robots.mir100.parameters import BEAM_COUNT
from rlservo.robots.ur.parameters import JOINTS

SCAN = slice(8, 8 + BEAM_COUNT)
PANDA = [f"{joint}_position" for joint in STATE_JOINTS]
OBJECT = [f"object_0_to_ref_translation_{axis}" for axis in "xyz"]


class RobotServerError(ConnectionError):
    """The robot server does not answer, or not with a state."""


class StateReader:
    """A read-only connection to a robot server: GetState changes nothing.

    A robot server that waits for a client's end (`--orphan-timeout`) waits for this one's too.
    """

    def __init__(self, address: str) -> None:
        """`address` is HOST:PORT; nothing is sent before the first `read`."""
        self.address = address
        # Without the proxy of `http_proxy`, which gRPC would use even for this machine.
        options = [("grpc.max_reconnect_backoff_ms", 1000), ("grpc.enable_http_proxy", 0)]
        self._channel = grpc.insecure_channel(address, options=options)
        self._call = self._channel.unary_unary(f"/{ROBOT_SERVER}/GetState")

    def read(self, timeout_s: float = 1.0) -> RobotState:
        """Return the state of this moment. Raises RobotServerError."""
        try:
            message = State.FromString(self._call(Empty().SerializeToString(), timeout=timeout_s))
        except grpc.RpcError as error:
            raise RobotServerError(f"no robot server answers at {self.address}: {error.code().name.lower()}") from error
        if not message.success:
            raise RobotServerError(f"the robot server at {self.address} could not report its state: see its log")
        return RobotState(values=list(message.state), names=dict(message.state_dict))

    def close(self) -> None:
        """Close the connection."""
        self._channel.close()


def env_of(state: RobotState) -> str:
    """Return the environment with a state's robot and world. Raises RobotServerError."""
    if f"{JOINTS[0]}_joint_position" in state.names:
        has_object = OBJECT[0] in state.names
        return f"rlservo/{'EndEffectorPositioning' if has_object else 'EmptyEnvironment'}URSim-v0"
    if PANDA[0] in state.names:
        has_object = OBJECT[0] in state.names
        return f"rlservo/{'EndEffectorPositioning' if has_object else 'EmptyEnvironment'}PandaSim-v0"
    if len(state.values) == STATE_LENGTH:
        has_cubes = any(state.values[CUBES])
        return f"rlservo/{'ObstacleAvoidance' if has_cubes else 'NoObstacleNavigation'}Mir100Sim-v0"
    raise RobotServerError(
        f"the state has {len(state.values)} numbers: expected the named state of a UR arm or a Panda, or the "
        f"{STATE_LENGTH} numbers of a MiR100"
    )


def show_state(env: RenderedEnv, state: RobotState) -> None:
    """Show the state: to look at, not to act. Raises RobotServerError for another robot's state."""
    if isinstance(env, URArmEnv) and f"{JOINTS[0]}_joint_position" in state.names:
        joints = np.array([state.names[f"{joint}_joint_position"] for joint in JOINTS])
        env.simulation.place(np.clip(joints, -LIMITS, LIMITS))
        if env.target_position() is not None and OBJECT[0] in state.names:
            env.move_target(BASE + [state.names[name] for name in OBJECT])
    elif isinstance(env, PandaArmEnv) and PANDA[0] in state.names:
        env.simulation.place(np.clip([state.names[name] for name in PANDA], env.LOW, env.HIGH))
        if env.target_position() is not None and OBJECT[0] in state.names:
            env.move_target([state.names[name] for name in OBJECT])
    elif isinstance(env, Mir100Navigation) and len(state.values) == STATE_LENGTH:
        values = np.array(state.values)
        cubes = values[CUBES].reshape(-1, 3) if len(env.simulation.cubes) else None
        env.simulation.place(values[ROBOT], target=values[TARGET], cubes=cubes)
        env.show_readings(values[SCAN] if cubes is not None else np.zeros(0))
    else:
        raise RobotServerError("the robot server now has another robot")


def quantities(state: RobotState) -> dict[str, tuple[float, str]]:
    """Return a state's main values: value and unit by name."""
    if state.names:
        return {name: (value, _unit(name)) for name, value in sorted(state.names.items())}
    names = ("target_x", "target_y", "target_yaw", "x", "y", "yaw", "linear_velocity", "angular_velocity")
    units = ("m", "m", "rad", "m", "m", "rad", "m/s", "rad/s")
    found: dict[str, tuple[float, str]] = {
        name: (value, unit) for name, value, unit in zip(names, state.values, units, strict=False)
    }
    found["nearest_beam"] = (min(state.values[SCAN], default=math.nan), "m")
    found["in_collision"] = (state.values[SCAN.stop], "1")
    return found


def _unit(name: str) -> str:
    for suffix, unit in (("_velocity", "rad/s"), ("_position", "rad"), ("_effort", "Nm")):
        if name.endswith(suffix):
            return unit
    return "m" if "translation" in name else "1"
