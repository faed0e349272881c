"""RLlib's own connector pipelines of the new API stack, run for one agent, alone or among several.

If an environment has several agents, the episode is one in which only the exported policy's agent acts: an agent's
action depends on its own observations alone, because a module that looks at others' is refused. It imports ray.rllib,
as policy.py does.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from ray.rllib.connectors.connector_pipeline_v2 import ConnectorPipelineV2
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModule
from ray.rllib.env.multi_agent_episode import MultiAgentEpisode
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from rlservo.export.checkpoints.location import CheckpointFiles
from rlservo.export.checkpoints.unpickle import unpickle
from rlservo.export.contract.contract import BakedStep
from rlservo.export.contract.errors import AgentsDifferError, CheckpointError, UnsupportedError
from rlservo.export.recipe.describe import observation_step
from rlservo.export.recipe.trees import Tree, build_like, map_tree, tree_leaves
from rlservo.export.rllib import private_names
from rlservo.export.rllib.new_stack.connectors import SINGLE_AGENT, AgentSlot, read_observation_steps

MAPPING = "AgentToModuleMapping"


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

    def to_module(self, episodes: list[Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return (the module's batch, the data that the pipelines share)."""
        shared: dict[str, Any] = {}
        with torch.no_grad():
            batch = self.env_to_module(
                rl_module=self.connector_module, batch={}, episodes=episodes, explore=False, shared_data=shared
            )
        return batch, shared

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

    def begin(self, obs: Any) -> Any:
        """Return an episode that has just been reset."""
        episode = SingleAgentEpisode(observation_space=self.observation_space, action_space=self.action_space)
        episode.add_env_reset(observation=obs)
        return episode

    def advance(self, episode: Any, obs: Any, action: Any, reward: float, extra: dict[str, Any]) -> None:
        """Add a step to an episode."""
        episode.add_env_step(observation=obs, action=action, reward=reward, extra_model_outputs=extra)


@dataclass(frozen=True)
class MultiAgentPipelines(Pipelines):
    """The same among several agents; only the slot's agent acts."""

    slot: AgentSlot

    def to_module(self, episodes: list[Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return (the module's batch, the data that the pipelines share)."""
        batch, shared = super().to_module(episodes)
        return batch[self.slot.module], shared

    def to_env(self, given: dict[str, Any], episodes: list[Any], shared: dict[str, Any]) -> dict[str, Any]:
        """Return the agent's outputs for the environment and for the episodes."""
        sent = super().to_env({self.slot.module: given}, episodes, shared)
        own = {name: [by_agent[self.slot.agent] for by_agent in rows] for name, rows in sent.items()}
        acting = (Columns.ACTIONS, Columns.ACTIONS_FOR_ENV)
        return {name: _stacked(rows) if name in acting else rows for name, rows in own.items()}

    def begin(self, obs: Any) -> Any:
        """Return an episode that has just been reset."""
        module = self.slot.module  # instead of the mapping: the slot's module is already known
        episode = MultiAgentEpisode(
            observation_space=self.env_to_module.input_observation_space,
            action_space=self.env_to_module.input_action_space,
            agent_to_module_mapping_fn=lambda _agent, _episode: module,
        )
        episode.add_env_reset(observations={self.slot.agent: obs})
        return episode

    def advance(self, episode: Any, obs: Any, action: Any, reward: float, extra: dict[str, Any]) -> None:
        """Add a step to an episode."""
        agent = self.slot.agent
        episode.add_env_step(
            observations={agent: obs},
            actions={agent: action},
            rewards={agent: reward},
            extra_model_outputs={agent: extra},
        )


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
    return dataclasses.replace(slots[0], agents=tuple(str(agent) for agent in agents))


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
