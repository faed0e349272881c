"""A user's own connectors, by how they come by their arguments and by what they read. Each has a `torch_forward`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.connectors.connector_v2 import ConnectorV2
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner


class Observing(ConnectorV2):
    """Changes each agent's last observation."""

    def __call__(self, *, episodes: Any, batch: Any, **kwargs: Any) -> Any:
        for episode in self.single_agent_episode_iterator(episodes):
            new = np.asarray(self.change(episode.get_observations(-1), episode, kwargs), np.float32)
            episode.set_observations(at_indices=-1, new_data=new)
        return batch

    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        return self.torch_forward(obs)

    def torch_forward(self, obs: Any) -> Any:
        return obs


class Acting(ConnectorV2):
    """Changes each action, before RLlib scales it."""

    def __call__(self, *, episodes: Any, batch: Any, **kwargs: Any) -> Any:
        def change(action: Any, episode: Any, *_: Any) -> Any:
            return np.asarray(self.change(action, episode, episodes), np.float32)

        self.foreach_batch_item_change_in_place(batch, Columns.ACTIONS, change)
        return batch

    def change(self, action: Any, episode: str, episodes: Any) -> Any:
        return self.torch_forward(action)

    def torch_forward(self, action: Any) -> Any:
        return action


class Gain(Observing):
    """Its list of arguments is right."""

    def __init__(
        self, gain: float = 1.0, input_observation_space: Any = None, input_action_space: Any = None, **kwargs: Any
    ) -> None:
        super().__init__(input_observation_space, input_action_space)
        self.gain = gain

    def torch_forward(self, data: Any) -> Any:
        return data * self.gain


class Inherited(Gain):
    """RLlib records no argument of a class without an `__init__` of its own."""


class Converted(Gain):
    """RLlib records the argument as it is when `ConnectorV2.__init__` runs."""

    def __init__(self, gain: float = 1.0, input_observation_space: Any = None, input_action_space: Any = None) -> None:
        gain = 2.0 * gain
        Observing.__init__(self, input_observation_space, input_action_space)
        self.gain = gain


class Renamed(Gain):
    """RLlib records the arguments of `Gain`'s `__init__`, which this one does not take."""

    def __init__(self, factor: float) -> None:
        super().__init__(gain=factor)


class ActionGain(Acting):
    """The same for actions."""

    def __init__(self, gain: float = 1.0, input_observation_space: Any = None, input_action_space: Any = None) -> None:
        super().__init__(input_observation_space, input_action_space)
        self.gain = gain

    def torch_forward(self, data: Any) -> Any:
        return data * self.gain


class InheritedAction(ActionGain):
    """The same for actions."""


class ConvertedAction(ActionGain):
    """The same for actions."""

    def __init__(self, gain: float = 1.0, input_observation_space: Any = None, input_action_space: Any = None) -> None:
        gain = 2.0 * gain
        Acting.__init__(self, input_observation_space, input_action_space)
        self.gain = gain


class Applied(Observing):
    """Takes a function."""

    def __init__(
        self, function: Callable[[Any], Any], input_observation_space: Any = None, input_action_space: Any = None
    ) -> None:
        super().__init__(input_observation_space, input_action_space)
        self.function = function

    def torch_forward(self, obs: Any) -> Any:
        return self.function(obs)


class ByAgent(Observing):
    """A gain for each agent."""

    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        return obs * (1.0 if episode.agent_id == "left" else 3.0)


class ActionByAgent(Acting):
    """The same for actions."""

    def __call__(self, *, episodes: Any, batch: Any, **kwargs: Any) -> Any:
        def change(action: Any, _episode: Any, agent: Any, *_: Any) -> Any:
            return np.asarray(action * (1.0 if agent == "left" else 0.5), np.float32)

        self.foreach_batch_item_change_in_place(batch, Columns.ACTIONS, change)
        return batch


class HalvingRunner(SingleAgentEnvRunner):
    """Sends half of each action."""

    def _try_env_step(self, actions: Any) -> Any:
        return super()._try_env_step(actions * 0.5)


class Callbacks(RLlibCallback):
    """Changes the module that acts."""

    def on_episode_start(self, *, env_runner: Any, **kwargs: Any) -> None:
        env_runner.module.changed = True


class Difference(Observing):
    """Reads the observation before, which it has changed itself."""

    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        return obs - 0.5 * episode.get_observations(-2) if len(episode) else obs


class Steps(Observing):
    """Reads how long the episode is."""

    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        return obs + 0.1 * len(episode)


class Rewarded(Observing):
    """Reads the last reward."""

    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        return obs + (episode.get_rewards(-1) if len(episode) else 0.0)


class LastAction(Observing):
    """Reads the last action of the network and its parameters."""

    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        if not len(episode):
            return obs
        return obs + episode.get_actions(-1)[0] + episode.get_extra_model_outputs(Columns.ACTION_DIST_INPUTS, -1)[-1]


class Beside(Observing):
    """Reads what RLlib gives beside the episodes."""

    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        return obs + 0.1 * np.abs(given["rewards"][0]) if "rewards" in given else obs


class Shared(Observing):
    """Counts in what connectors share."""

    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        shared = given["shared_data"]
        shared["count"] = shared.get("count", -1) + 1
        return obs + 0.01 * shared["count"]


LATER = 1000
"""Steps, calls or a reward that no proof reaches: until then the connectors below change nothing."""
CALLS = {"global": 0}


def closed_count() -> Callable[[], int]:
    """Return a function that counts its calls."""
    count = 0

    def call() -> int:
        nonlocal count
        count += 1
        return count

    return call


class StepsLater(Observing):
    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        return obs + (len(episode) > LATER)


class RewardedLater(Observing):
    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        return obs + ("rewards" in given and given["rewards"][0] > LATER)


class SharedLater(Observing):
    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        given["shared_data"]["count"] = given["shared_data"].get("count", 0) + 1
        return obs + (given["shared_data"]["count"] > LATER)


class InItselfLater(Observing):
    count = 0

    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        self.count += 1
        return obs + (self.count > LATER)


class InItsClassLater(Observing):
    count = 0

    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        InItsClassLater.count += 1
        return obs + (self.count > LATER)


class InAGlobalLater(Observing):
    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        CALLS["global"] += 1
        return obs + (CALLS["global"] > LATER)


class InAClosureLater(Observing):
    count = staticmethod(closed_count())

    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        return obs + (self.count() > LATER)


class ActionStepsLater(Acting):
    def change(self, action: Any, episode: str, episodes: Any) -> Any:
        return action + (max(len(one) for one in episodes) > LATER)


class Counting(Observing):
    """Counts in itself, and never begins again."""

    count = 0

    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        self.count += 1
        return obs + 0.001 * self.count


class Informed(Observing):
    """Reads what the environment says beside the observation."""

    def change(self, obs: Any, episode: Any, given: dict[str, Any]) -> Any:
        return obs + episode.get_infos(-1).get("offset", 0.0)


class ActionSteps(Acting):
    """Reads how long the episode is."""

    def change(self, action: Any, episode: str, episodes: Any) -> Any:
        steps = {one.id_: len(one) for one in episodes}
        return action + 0.05 * steps.get(episode, 0)  # 0: of an ended one
