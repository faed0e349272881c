"""Environment of a rollout."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rlservo.bundle.environment_id import importing_id
from rlservo.errors import UsageError
from rlservo.extras import install, needs_extra

if TYPE_CHECKING:
    import gymnasium as gym


def make_env(env_id: str, arguments: Mapping[str, Any], *, render: bool) -> gym.Env[Any, Any]:
    """Return the environment, or raise UsageError: no such id (with close matches), a missing extra, bad arguments."""
    with needs_extra("sim", what="a rollout"):
        import gymnasium as gym
    mode = {"render_mode": "rgb_array"} if render else {}
    try:
        # Gymnasium's checker inspects every step and warns on the terminal, which is meant for environment authors.
        return gym.make(importing_id(env_id), disable_env_checker=True, **{**arguments, **mode})
    except gym.error.UnregisteredEnv as error:
        close = difflib.get_close_matches(env_id, list(gym.registry), n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(close)}?" if close else ""
        if not env_id.startswith("rlservo/") and ":" not in env_id:
            hint = f"{hint} Your own is 'module:{env_id}', with the module that registers it".lstrip()
        raise UsageError(f"environment {env_id!r} is not registered: {hint}", {"close_matches": close}) from error
    except (ModuleNotFoundError, gym.error.DependencyNotInstalled) as error:
        hint = install("sim") if env_id.startswith("rlservo/") else "install it, or name its folder with --app-dir"
        raise UsageError(f"environment {env_id!r} cannot be made: {error.__cause__ or error}: {hint}") from error
    except Exception as error:  # a constructor is third-party code
        reason = str(error).partition(" was raised from the environment creator")[0]  # Gymnasium repeats the call
        raise UsageError(f"environment {env_id!r} cannot be made with {arguments}: {reason}") from error
