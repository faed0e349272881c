"""RLlib's own connector pipelines of the new API stack, run for one agent, alone or among several.

If an environment has several agents, the episode is one in which only the exported policy's agent acts: an agent's
action depends on its own observations alone, because a module that looks at others' is refused. It imports ray.rllib,
as policy.py does.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space
from ray.rllib.connectors.connector_pipeline_v2 import ConnectorPipelineV2
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModule
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env.multi_agent_episode import MultiAgentEpisode
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from rlservo.bundle.contract import BakedStep
from rlservo.errors import AgentsDifferError, CheckpointError, UnsupportedError, first_line
from rlservo.export.checkpoints.location import CheckpointFiles
from rlservo.export.checkpoints.unpickle import unpickle
from rlservo.export.recipe.describe import observation_step
from rlservo.export.recipe.trees import Tree, build, build_in_order, build_like, map_tree, space_leaves, tree_leaves
from rlservo.export.rllib import private_names
from rlservo.export.rllib.new_stack.connectors import SINGLE_AGENT, AgentSlot, comes_from_rllib, read_observation_steps
from rlservo.export.rllib.new_stack.watched import Watched, watch

MAPPING = "AgentToModuleMapping"
COMPANY = 8  # other agents that act beside the exported one's


class NoInfo(dict[str, Any]):
    """An environment's info, which no client sends: reading it raises UnsupportedError."""

    def __init__(self) -> None:
        super().__init__(info=None)  # RLlib replaces an empty one

    def _refuse(self, *_args: Any, **_kwargs: Any) -> Any:
        raise UnsupportedError("a connector reads the environment's info, which a served policy is not given")

    __getitem__ = __contains__ = __iter__ = get = keys = values = items = _refuse


@dataclass(frozen=True)
class Pipelines:
    """RLlib's connectors around a module, for an environment with one agent."""

    module: Any
    env_to_module: ConnectorPipelineV2
    module_to_env: ConnectorPipelineV2
    observation_space: Any
    action_space: Any
    connector_module: Any
    """Argument of RLlib's connectors: the module, or a MultiRLModule that holds it alone."""

    def fresh(self) -> Pipelines:
        """Return the same with connectors that remember nothing of what these are given."""
        pipelines = (self.env_to_module, self.module_to_env)
        pieces = [*pipelines, *(piece for pipeline in pipelines for piece in pipeline.connectors)]
        spaces = [value for piece in pieces for value in vars(piece).values() if isinstance(value, Space)]
        try:  # most of the time would go to the spaces, which nothing changes
            env_to_module, module_to_env = copy.deepcopy(pipelines, {id(space): space for space in spaces})
        except Exception as error:  # the user's own connectors may hold anything
            raise UnsupportedError(
                f"the connectors cannot be copied ({first_line(error)}), so a rollout cannot be repeated with them: "
                "keep only data in them"
            ) from error
        for pipeline in (env_to_module, module_to_env):
            called: list[Any] = [
                piece if comes_from_rllib(type(piece)) else Watched(piece) for piece in pipeline.connectors
            ]
            pipeline.connectors = called
        return dataclasses.replace(self, env_to_module=env_to_module, module_to_env=module_to_env)

    @property
    def has_own(self) -> bool:
        """Whether there are connectors of the user's own."""
        pieces = (*self.env_to_module.connectors, *self.module_to_env.connectors)
        return not all(comes_from_rllib(type(piece)) for piece in pieces)

    def to_module(self, episodes: list[Any], shared: dict[str, Any], **last: Any) -> dict[str, Any]:
        """Return the module's batch.

        `shared` is what connectors share in all steps of a rollout, `last` the last step's columns, a row an episode.
        """
        with torch.no_grad():
            batch: dict[str, Any] = self.env_to_module(
                rl_module=self.connector_module, batch={}, episodes=episodes, explore=False, shared_data=shared, **last
            )
        return batch

    def forward(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Return the module's output for its batch, which it may change."""
        with torch.no_grad():
            given: dict[str, Any] = self.module.forward_inference(own_copy(batch))
        return given

    def to_env(self, given: dict[str, Any], episodes: list[Any], shared: dict[str, Any]) -> dict[str, Any]:
        """Return the outputs for the environment and for the episodes."""
        with torch.no_grad():
            sent: dict[str, Any] = self.module_to_env(
                rl_module=self.connector_module, batch=given, episodes=episodes, explore=False, shared_data=shared
            )
        return sent

    def observation(self, leaves: Mapping[str, Any]) -> Any:
        """Return an observation: Gymnasium's vector environments order its keys as the space does."""
        return build(self.observation_space, [leaves[name] for name in space_leaves(self.observation_space, "obs")])

    def begin(self, obs: Any) -> Any:
        """Return an episode that has just been reset."""
        episode = SingleAgentEpisode(observation_space=self.observation_space, action_space=self.action_space)
        episode.add_env_reset(observation=obs, infos=NoInfo())
        return watch(episode) if self.has_own else episode

    def advance(self, episode: Any, obs: Any, action: Any, reward: float, extra: dict[str, Any]) -> None:
        """Add a step to an episode."""
        episode.add_env_step(observation=obs, action=action, reward=reward, infos=NoInfo(), extra_model_outputs=extra)

    def column(self, values: list[Any]) -> list[Any]:
        """Return one value for each environment in the form that an environment gives it."""
        return values


@dataclass(frozen=True)
class MultiAgentPipelines(Pipelines):
    """The same among several agents; only the slot's agent acts."""

    slot: AgentSlot
    company: tuple[Any, ...] = ()
    """Other agents, which act beside the slot's, each at random and for a module of its own."""

    def in_company(self) -> MultiAgentPipelines:
        """Return the same with some of the environment's other agents acting too."""
        spaces: Any = self.env_to_module.input_observation_space
        others = [agent for agent in spaces.spaces if agent != self.slot.agent][:COMPANY]
        among = dataclasses.replace(self, company=tuple(others), connector_module=MultiRLModule())
        among.connector_module.add_module(self.slot.module, self.module)
        for agent in others:
            spaces[agent].seed(0)
            other = TorchRLModule(observation_space=spaces[agent], model_config={})
            among.connector_module.add_module(among.module_of(agent), other)
        return among

    def module_of(self, agent: Any) -> str:
        """Return the id of an agent's module."""
        module = self.slot.module  # instead of the mapping: the slot's module is already known
        return module if agent == self.slot.agent else f"{module}_{self.company.index(agent)}"

    def to_module(self, episodes: list[Any], shared: dict[str, Any], **last: Any) -> dict[str, Any]:
        """Return the module's batch."""
        shared.setdefault("vector_env_episodes_map", {})
        batch: dict[str, Any] = super().to_module(episodes, shared, **last)[self.slot.module]
        return batch

    def to_env(self, given: dict[str, Any], episodes: list[Any], shared: dict[str, Any]) -> dict[str, Any]:
        """Return the agent's outputs for the environment and for the episodes."""
        sent = super().to_env({self.slot.module: given}, episodes, shared)
        own = {name: [by_agent[self.slot.agent] for by_agent in rows] for name, rows in sent.items()}
        acting = (Columns.ACTIONS, Columns.ACTIONS_FOR_ENV)
        return {name: _stacked(rows) if name in acting else rows for name, rows in own.items()}

    def observation(self, leaves: Mapping[str, Any]) -> Any:
        """Return an observation with its keys in the order of `leaves`: RLlib leaves the environment's as it is."""
        return build_in_order(self.observation_space, leaves)

    def begin(self, obs: Any) -> Any:
        """Return an episode that has just been reset."""
        episode = MultiAgentEpisode(
            observation_space=self.env_to_module.input_observation_space,
            action_space=self.env_to_module.input_action_space,
            agent_to_module_mapping_fn=lambda agent, _episode: self.module_of(agent),
        )
        observations = {self.slot.agent: obs, **self._drawn(episode.observation_space)}
        episode.add_env_reset(observations=observations, infos={agent: NoInfo() for agent in observations})
        return watch(episode) if self.has_own else episode

    def advance(self, episode: Any, obs: Any, action: Any, reward: float, extra: dict[str, Any]) -> None:
        """Add a step to an episode."""
        agent = self.slot.agent
        observations = {agent: obs, **self._drawn(episode.observation_space)}
        episode.add_env_step(
            observations=observations,
            actions={agent: action, **self._drawn(episode.action_space)},
            rewards={agent: reward, **dict.fromkeys(self.company, 0.0)},
            infos={agent: NoInfo() for agent in observations},
            extra_model_outputs={agent: extra},
        )

    def _drawn(self, spaces: Any) -> dict[Any, Any]:
        return {agent: spaces[agent].sample() for agent in self.company}

    def column(self, values: list[Any]) -> list[Any]:
        """Return one value for each environment in the form that an environment gives it."""
        return [{self.slot.agent: value} for value in values]


def pipelines_of(
    slot: AgentSlot, module: Any, env_to_module: Any, module_to_env: Any, observation_space: Any, action_space: Any
) -> Pipelines:
    """Return RLlib's way to act for the slot's agent, with the agent's own spaces."""
    if slot is SINGLE_AGENT:
        return Pipelines(module, env_to_module, module_to_env, observation_space, action_space, module)
    together = MultiRLModule()
    together.add_module(slot.module, module)
    return MultiAgentPipelines(module, env_to_module, module_to_env, observation_space, action_space, together, slot)


def find_agent_slot(files: CheckpointFiles, module: Any, env_to_module: Any, module_to_env: Any) -> AgentSlot:
    """Return the agent that a module is exported for; SINGLE_AGENT if the environment has only one.

    A module may serve several: any stands for all if their spaces and the steps before the network are the same. Raises
    CheckpointError when there is no such agent, AgentsDifferError if they differ and none was named, and
    UnsupportedError for modules that compute together.
    """
    mapping = next((piece for piece in env_to_module.connectors if type(piece).__name__ == MAPPING), None)
    if mapping is None:
        if files.agent_id is not None:
            raise CheckpointError(f"{files.root} was trained with one agent: leave --agent-id out")
        return SINGLE_AGENT
    _check_separate(files)
    agents = _served(mapping, files.module_id, module)
    if files.agent_id is not None:
        chosen = [agent for agent in agents if str(agent) == files.agent_id]
        if not chosen:
            raise CheckpointError(
                f"{files.root}: module '{files.module_id}' serves no agent '{files.agent_id}': it serves "
                f"{_listed(agents)}"
            )
        agents = chosen
    if not agents:
        raise CheckpointError(f"{files.root}: no agent of the environment is served by module '{files.module_id}'")
    slots = [AgentSlot(agent, files.module_id) for agent in agents]
    treatments = [_treatment(slot, files, env_to_module, module_to_env) for slot in slots]
    if any(treatment != treatments[0] for treatment in treatments[1:]):
        raise AgentsDifferError(
            f"{files.root}: module '{files.module_id}' serves the agents {_listed(agents)}, whose spaces or "
            "observation filters differ: name the one to export for with --agent-id",
            [str(agent) for agent in agents],
        )
    return dataclasses.replace(slots[0], agents=tuple(str(agent) for agent in agents), others=tuple(agents[1:]))


def _served(mapping: Any, module_id: str, module: Any) -> list[Any]:
    """Return the agents that a module serves, by RLlib's mapping.

    All that it could serve if that is drawn in each episode, or if the module was added in training.
    """
    agents = list(mapping.input_observation_space.spaces)
    module_of = private_names.get(mapping, "_agent_to_module_mapping_fn")
    try:
        served = [agent for agent in agents if module_of(agent, MultiAgentEpisode()) == module_id]
    except Exception:  # the user's own function may want more of an episode than a new one has
        served = []
    if served:
        return served
    observations, actions = mapping.observation_space.spaces, mapping.action_space.spaces
    wanted = (observations.get(module_id, module.observation_space), actions.get(module_id, module.action_space))
    return [
        agent
        for agent in agents
        if (mapping.input_observation_space[agent], mapping.input_action_space[agent]) == wanted
    ]


def _treatment(slot: AgentSlot, files: CheckpointFiles, env_to_module: Any, module_to_env: Any) -> tuple[Any, ...]:
    """Return everything that may differ between agents that share a module."""
    steps: list[BakedStep] = [observation_step(step) for step in read_observation_steps(env_to_module, files, slot)]
    return slot.part(env_to_module.input_observation_space), slot.part(module_to_env.input_action_space), steps


def _check_separate(files: CheckpointFiles) -> None:
    """Raise UnsupportedError if the modules are parts of something of the user's own, which may mix them."""
    if not files.together.is_file():
        return
    kind = unpickle(files.together).get("class")
    if kind is not MultiRLModule:
        name = getattr(kind, "__name__", str(kind))
        raise UnsupportedError(
            f"{files.root}: its modules are parts of a {name}, whose forward pass may mix them: only modules of "
            "RLlib's own MultiRLModule, each of which decides alone, are exported"
        )


def own_copy(batch: dict[str, Any]) -> dict[str, Any]:
    """Return the same tensors in dicts that a user's forward may change."""
    return {key: map_tree(lambda leaf: leaf, value) for key, value in batch.items()}


def _stacked(rows: list[Tree]) -> Tree:
    """Return one tree with a batch axis from one tree a row."""
    columns = zip(*(tree_leaves(row) for row in rows), strict=True)
    return build_like(rows[0], [np.stack([np.asarray(leaf) for leaf in column]) for column in columns])


def _listed(agents: list[Any]) -> str:
    return ", ".join(str(agent) for agent in agents[:8]) + (f" and {len(agents) - 8} more" if len(agents) > 8 else "")
