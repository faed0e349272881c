"""A simulated robot on show: its environment, disturbances, and the drawn positions."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlservo.bundle.contract import Contract
from rlservo.bundle.environment_id import NAMESPACE
from rlservo.drive.environment_fit import check_fit, control_rate_of
from rlservo.drive.make_environment import make_env
from rlservo.drive.real_robot_gate import check_proven
from rlservo.envs.randomization import DomainRandomization, wrapped_env
from rlservo.envs.rendering import RenderedEnv, Start
from rlservo.envs.shapes import Poses, body_poses, moving_bodies
from rlservo.errors import UsageError
from rlservo.robots.argument_checks import InvalidResetError

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class StageDisturbance:
    """Disturbances of `DomainRandomization`, the same in every episode."""

    action_latency: int = 0  # control cycles
    observation_latency: int = 0  # control cycles
    noise: float = 0.0  # standard deviation, of every observed element in its own unit
    payload: float = 0.0  # [kg]


@dataclass(frozen=True)
class Scene:
    """Positions of all things at one moment."""

    poses: Poses  # of `moving_bodies`
    robot: Vector  # [m], (3,), what is to reach the target
    target: Vector | None
    obstacles: Vector  # [m], (n, 3)
    beams: Vector  # [m], (n, 2, 3)


class Stage:
    """One robot in one environment."""

    def __init__(
        self, env_id: str, arguments: Mapping[str, Any], contract: Contract | None = None, *, unproven: bool = False
    ) -> None:
        """Raise UsageError if there is no such environment, it is none of ours, or the policy does not fit it.

        `unproven`: a real robot takes any policy.
        """
        self.env_id, self.arguments = env_id, dict(arguments)
        foreign = f"the cockpit draws only rlservo's own simulators (rlservo/...): {env_id} is not one of them"
        if f"{NAMESPACE}/" not in env_id:  # its module may be elsewhere, and the cockpit has no --app-dir
            raise UsageError(foreign)
        self._made = make_env(env_id, self.arguments, render=False)
        env = self._made.unwrapped
        if not isinstance(env, RenderedEnv):
            self._made.close()
            raise UsageError(foreign)
        self.env = env
        self._bodies = moving_bodies(env.model)
        self._disturbed: DomainRandomization = DomainRandomization(self._made)
        self.cycle_s, self._unproven = 0.1, unproven
        if contract is not None:
            try:
                self.check(contract)
            except UsageError:
                self._made.close()
                raise
            self.cycle_s = 1.0 / (control_rate_of(self._made, self.arguments, contract) or 10.0)

    def check(self, contract: Contract) -> None:
        """Raise UsageError if a policy's spaces are others than the environment's, or a real robot may not take it."""
        check_fit(contract, self._made, self.arguments)
        if not self._unproven:
            check_proven(contract, self._made)

    def disturb(self, disturbance: StageDisturbance) -> None:
        """Change the disturbances, from the next episode on. Raises ValueError for an unsupported one."""
        self._disturbed = DomainRandomization(
            self._made,
            action_latency=(disturbance.action_latency, disturbance.action_latency),
            observation_latency=(disturbance.observation_latency, disturbance.observation_latency),
            observation_noise=disturbance.noise,
            payload=(disturbance.payload, disturbance.payload),
        )

    def begin(
        self,
        *,
        start: Start = "own",
        position: Vector | None = None,
        keep_target: bool = False,
        seed: int | None = None,
    ) -> Any:
        """Begin an episode, with the robot at `position` if that is given, and return its first observation.

        An episode that cannot start there starts as `start` says, else as the task does.
        """
        options = self.env.reset_options(start=start, keep_target=keep_target)
        own = self.env.reset_options(keep_target=keep_target)
        pushed = {} if position is None else self.env.start_at(position)
        for tried in ({**options, **pushed}, options):
            with contextlib.suppress(InvalidResetError):
                return self._disturbed.reset(seed=seed, options=tried)[0]
        return self._disturbed.reset(options=own)[0]

    def begin_like(self, other: Stage) -> Any:
        """Begin an episode at the pose of another robot of the same kind, with the same target."""
        options = other.env.reset_options(start="here", keep_target=True)
        return self._disturbed.reset(options=options)[0]

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Let one control cycle pass; return observation, reward, terminated, truncated, info."""
        obs, reward, terminated, truncated, info = self._disturbed.step(action)
        return obs, float(reward), terminated, truncated, info

    def scene(self) -> Scene:
        """Return all positions."""
        env = self.env
        return Scene(
            poses=body_poses(env.data, self._bodies),
            robot=env.robot_position(),
            target=env.target_position(),
            obstacles=env.obstacle_positions(),
            beams=env.beams(),
        )

    def close(self) -> None:
        self._made.close()


def home_of(contract: Contract) -> str:
    """Return the environment that a policy was trained in, undisturbed. Raises UsageError if it is not one of ours."""
    trained = contract.provenance
    env_id = trained.env_id and wrapped_env(trained.env_id, trained.env_config)[0]
    if env_id is None or not env_id.startswith(f"{NAMESPACE}/"):
        raise UsageError(
            f"policy '{contract.name}' was trained in {env_id or 'an environment it does not name'}, but the cockpit "
            "draws only rlservo's simulators: choose a matching one with --env, or use 'rlservo log plot' or "
            "'rollout --video'"
        )
    return env_id


def home_arguments(contract: Contract) -> dict[str, Any]:
    """Return those of the environment's arguments that decide the robot's appearance."""
    return {name: value for name, value in contract.provenance.env_config.items() if name == "ur_model"}
