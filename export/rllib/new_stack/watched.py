"""A user's own connectors under watch: what they read beyond the last observation, and what they remember, is refused.

A comparison of actions shows a memory only if it acts within the samples' steps. A connector that reads an episode's
length, or counts its calls, may act much later.
"""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
from ray.rllib.core.columns import Columns
from ray.rllib.env.multi_agent_episode import MultiAgentEpisode
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from rlservo.errors import UnsupportedError
from rlservo.export.recipe.kept_values import changed, kept_values

OF_NO_STEP = frozenset({
    "id_", "agent_id", "module_id", "multi_agent_episode_id", "observation_space", "action_space", "agent_ids",
    "agent_episodes", "get_agents_that_stepped", "get_agents_to_act", "get_infos", "__class__",
})  # fmt: skip
"""What an episode has that is the same at every step; infos refuse to be read by themselves."""
OF_THE_LAST = frozenset({"get_observations", "set_observations"})
"""Methods that are used for the last observation."""
LAST_STEP = (Columns.ACTIONS, Columns.REWARDS, Columns.TERMINATEDS, Columns.TRUNCATEDS)
"""Columns of the last step that RLlib gives to connectors beside the episodes."""


class Watched:
    """A user's connector, called as RLlib calls it."""

    def __init__(self, piece: Any) -> None:
        self._piece = piece
        self._name = f"the connector {type(piece).__name__} ({type(piece).__module__})"
        self._calls = 0

    def __call__(self, *, shared_data: Any, **given: Any) -> Any:  # noqa: ARG002  # what others keep
        given["shared_data"] = NotServed(f"{self._name} uses 'shared_data'")
        for name in LAST_STEP:
            if name in given:
                given[name] = NotServed(f"{self._name} reads the last step's {name}")
        self._calls += 1
        if self._calls != 2:  # the first may have something to set up
            return self._piece(**given)
        before = dict(kept_values(self._piece))
        batch = self._piece(**given)
        if kept := changed(before, dict(kept_values(self._piece))).removeprefix("."):
            raise _refusal(f"{self._name} changes its '{kept}' each time it acts")
        return batch


def watch(episode: Any) -> Any:
    """Return the episode, which from now on refuses users' code that reads more of it than the last observation."""
    several: list[Any] = [episode]
    if isinstance(episode, MultiAgentEpisode):
        several += episode.agent_episodes.values()
    for one in several:
        kind: Any = _MultiAgent if isinstance(one, MultiAgentEpisode) else _SingleAgent
        one.__class__ = kind
    return episode


class NotServed:
    """Something that no client sends: to use it raises UnsupportedError."""

    def __init__(self, what: str) -> None:
        self._what = what

    def _use(self, *_args: Any, **_kwargs: Any) -> Any:
        raise _refusal(self._what)

    __getattr__ = __getitem__ = __setitem__ = __contains__ = __iter__ = __len__ = __bool__ = __array__ = _use


class _Last:
    """A method of an episode for the last observation alone."""

    def __init__(self, name: str, method: Any) -> None:
        self._name, self._method = name, method

    def __call__(self, indices: Any = None, **how: Any) -> Any:
        given = how.get("at_indices", indices)
        if given is None or not np.array_equal(np.ravel(given), [-1]) or "neg_index_as_lookback" in how:
            raise _refusal(f"a connector uses the episode's '{self._name}' of {given}, and not of -1")
        return self._method(**how) if "at_indices" in how else self._method(indices, **how)


class _SingleAgent(SingleAgentEpisode):
    __slots__ = ()

    def __getattribute__(self, name: str) -> Any:  # no more calls than needed: RLlib reads ids millions of times
        value = super().__getattribute__(name)
        return value if name in OF_NO_STEP else _attribute(name, value)

    def __len__(self) -> int:
        _attribute("__len__", None)
        return super().__len__()


class _MultiAgent(MultiAgentEpisode):
    __slots__ = ()

    def __getattribute__(self, name: str) -> Any:
        value = super().__getattribute__(name)
        return value if name in OF_NO_STEP else _attribute(name, value)

    def __len__(self) -> int:
        _attribute("__len__", None)
        return int(super().__len__())  # type: ignore[no-untyped-call]  # RLlib's has no types


def _attribute(name: str, value: Any) -> Any:
    """Return an attribute of an episode for the code that reads it, two frames above; RLlib's own may read all."""
    frame: Any = inspect.currentframe()
    reader = frame.f_back.f_back
    if str(reader.f_globals.get("__name__")).partition(".")[0] in ("ray", "rlservo"):
        return value
    if name in OF_THE_LAST:
        return _Last(name, value)
    what = "length" if name == "__len__" else f"'{name}'"
    raise _refusal(f"a connector reads the episode's {what} at {reader.f_code.co_filename}:{reader.f_lineno}")


def _refusal(what: str) -> UnsupportedError:
    return UnsupportedError(
        f"{what}, and a served policy's action depends on the current observation alone: use get_observations(-1) "
        "only, or give the network a recurrent state"
    )
