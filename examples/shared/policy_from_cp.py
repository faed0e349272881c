"""Run episodes with the policy of a checkpoint: the library of `policy_from_cp_ur.py` and `_mir.py`.

The policy acts from the checkpoint, through RLlib's own connector pipelines (filter, scaling and clipping included,
which `Policy.compute_single_action` leaves out), or with `--bundle` from its export. Nothing but the environment is
started: no Ray, no worker.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray

from rlservo import Policy, errors
from rlservo.drive.environment_fit import check_fit
from rlservo.drive.make_environment import make_env
from rlservo.drive.success import success_of, success_rates
from rlservo.export.sources.source import PICKLES
from shared.help_text import DefaultsFormatter

Act = Callable[[Any, bool], tuple[NDArray[Any], bool]]
"""(observation, whether an episode begins) -> (action for `env.step`, whether it had to be clipped)."""


@dataclass
class Count:
    """Number of actions, and of those that the policy itself put outside the action space."""

    actions: int = 0
    clipped: int = 0


def main(env_id: str, env_kwargs: Mapping[str, Any], description: str) -> None:
    parser = argparse.ArgumentParser(description=description, formatter_class=DefaultsFormatter)
    parser.add_argument(
        "checkpoint", type=Path, nargs="?",
        help="algorithm checkpoint, policy (.../policies/default_policy) or RLModule checkpoint, or Tune trial",
    )  # fmt: skip
    parser.add_argument("--bundle", type=Path, help="act from this exported bundle instead of a checkpoint")
    parser.add_argument("--num-episodes", type=int, default=5, help="episodes to run")
    parser.add_argument("--seed", type=int, default=10_000, help="episode i is reset with seed + i")
    parser.add_argument("--app-dir", type=Path, default=Path(), help="folder of your modules the checkpoint refers to")
    parser.add_argument("--gui", action="store_true", help="show the simulator (needs a display)")
    args = parser.parse_args()
    if (args.checkpoint is None) == (args.bundle is None):
        parser.error("give either a checkpoint's path or --bundle BUNDLE")
    if args.num_episodes < 1 or args.seed < 0:
        parser.error(f"--num-episodes {args.num_episodes} --seed {args.seed}: expected at least 1, and 0 or more")

    arguments = {**env_kwargs, **({"render_mode": "human"} if args.gui else {})}
    env = make_env(env_id, arguments, render=False)
    try:
        if args.bundle is not None:
            policy = Policy.load(args.bundle)
            check_fit(policy.contract, env, arguments)
            act = from_bundle(policy, env.action_space)
        else:
            print(f"loading {args.checkpoint}: {PICKLES}")
            act = from_checkpoint(args.checkpoint, args.app_dir, env)
        run_episodes(env, act, args.num_episodes, args.seed)
    finally:
        env.close()


def from_bundle(policy: Policy, space: Any) -> Act:
    """Return the exported policy; its actions are ready for `env.step`, which is checked."""

    def act(obs: Any, first: bool) -> tuple[NDArray[Any], bool]:
        if first:
            policy.reset()
        action = policy.act(obs)
        return action, not space.contains(action)

    return act


def from_checkpoint(path: Path, app_dir: Path, env: Any) -> Act:
    """Return the checkpoint's policy, acting step after step through RLlib's own pipelines, exploration off.

    Raises CheckpointError or UnsupportedError when it cannot be restored, UsageError when it is another robot's.
    """
    from rlservo.export.checkpoints.location import locate_checkpoint
    from rlservo.export.checkpoints.unpickle import user_code
    from rlservo.export.recipe.recipe import leaf_transform
    from rlservo.export.rllib.filter_statistics import why_untrained
    from rlservo.export.rllib.restore import restore

    files = locate_checkpoint(path, None)
    with user_code(app_dir) as folder:
        restored = restore(files, folder, print)
    recipe = restored.recipe
    if why := why_untrained(files, recipe):
        print(why)
    for side, ours, theirs in (
        ("observation", recipe.observation_space, env.observation_space),
        ("action", recipe.action_space, env.action_space),
    ):
        if not isinstance(ours, Box) or ours.shape != theirs.shape:
            raise errors.UsageError(
                f"the policy in {path} has {_space_name(ours)} for its {side} space, {env.spec.id} has "
                f"{_space_name(theirs)}: it was trained for another environment"
            )
    loop = restored.start_loop()
    low, high = (np.asarray(side, np.float64) for side in (env.action_space.low, env.action_space.high))
    transform = leaf_transform(recipe.action_space, recipe.transform)

    def act(obs: Any, first: bool) -> tuple[NDArray[Any], bool]:
        out = loop.step({"obs": np.asarray(obs, np.float32)[None]}, np.array([first]))
        action = out["action"][0]
        # A Gaussian's or tanh's mean is the first half of its inputs: that is what RLlib scales and then clips.
        mean = np.asarray(out["action_dist_inputs"][0], np.float64)[: action.size].reshape(action.shape)
        unclipped = low + (mean + 1.0) * (high - low) / 2.0 if transform == "unsquash" else mean
        outside = bool(((unclipped < low - 1e-6) | (unclipped > high + 1e-6)).any())
        return action, outside and recipe.distribution == "diag_gaussian"

    return act


def _space_name(space: Space[Any]) -> str:
    """Name a space without its bounds, which fill a screen."""
    return f"a Box of shape {space.shape}" if isinstance(space, Box) else str(space)


def run_episodes(env: Any, act: Act, episodes: int, seed: int) -> Count:
    """Run the episodes, a line for each, and print how many actions had to be clipped."""
    count = Count()
    outcomes: list[bool | None] = []
    for episode in range(episodes):
        obs, info = env.reset(seed=seed + episode)
        total, steps, is_over = 0.0, 0, False
        while not is_over:
            action, clipped = act(obs, steps == 0)
            count.actions += 1
            count.clipped += clipped
            obs, reward, terminated, truncated, info = env.step(action)
            total, steps, is_over = total + float(reward), steps + 1, terminated or truncated
        outcomes.append(success_of(info))
        print(f"episode {episode}: return {total:.3f}, {steps} steps, {info.get('final_status', '')}", flush=True)
    (success,) = success_rates(outcomes)
    rate = "no success rate" if success is None else f"{success.successes} of {episodes} episodes succeeded"
    print(rate)
    print(f"clipped {count.clipped} of {count.actions} actions")
    return count
