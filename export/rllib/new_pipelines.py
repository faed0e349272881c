"""Run RLlib's own connector pipelines of the new API stack for one agent, alone or among several.

Where an environment has several agents, an episode is begun in which only the one whose policy is exported acts: an
agent's action depends on its own observations alone, because a module that looks at others' is refused. It imports
ray.rllib, as new_stack.py.
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
from rlservo.export.contract.errors import CheckpointError, UnsupportedError
from rlservo.export.recipe.describe import observation_step
from rlservo.export.recipe.trees import Tree, build_like, map_tree, tree_leaves
from rlservo.export.rllib.new_connectors import ALONE, Seat, read_observation_steps

MAPPING = "AgentToModuleMapping"


@dataclass(frozen=True)
class Pipelines:
    """RLlib's connectors around a module, for an environment with one agent."""

    module: Any
    env_to_module: ConnectorPipelineV2
    module_to_env: ConnectorPipelineV2
    observation_space: Any
    action_space: Any

    def to_module(self, episodes: list[Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return (the module's batch, what the pipelines tell each other)."""
        shared: dict[str, Any] = {}
        with torch.no_grad():
            batch = self.env_to_module(
                rl_module=self.module, batch={}, episodes=episodes, explore=False, shared_data=shared
            )
        return batch, shared

    def forward(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Return what the module gives for its batch, which it may change."""
        with torch.no_grad():
            given: dict[str, Any] = self.module.forward_inference(own_copy(batch))
        return given

    def to_env(self, given: dict[str, Any], episodes: list[Any], shared: dict[str, Any]) -> dict[str, Any]:
        """Return what comes out for the environment and for the episodes."""
        with torch.no_grad():
            sent: dict[str, Any] = self.module_to_env(
                rl_module=self.module, batch=given, episodes=episodes, explore=False, shared_data=shared
            )
        return sent

    def begin(self, obs: Any) -> Any:
        """Return an episode that has just been reset."""
        episode = SingleAgentEpisode(observation_space=self.observation_space, action_space=self.action_space)
        episode.add_env_reset(observation=obs)
        return episode

    def advance(self, episode: Any, obs: Any, action: Any, reward: float, extra: dict[str, Any]) -> None:
        """Tell an episode of one more step."""
        episode.add_env_step(observation=obs, action=action, reward=reward, extra_model_outputs=extra)


@dataclass(frozen=True)
class SeatPipelines(Pipelines):
    """The same among several agents, of which only the one in the seat acts."""

    seat: Seat
    together: MultiRLModule
    """What RLlib hands to its connectors; it holds the one module."""

    def to_module(self, episodes: list[Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return (the module's batch, what the pipelines tell each other)."""
        shared: dict[str, Any] = {}
        with torch.no_grad():
            batch = self.env_to_module(
                rl_module=self.together, batch={}, episodes=episodes, explore=False, shared_data=shared
            )
        return batch[self.seat.module], shared

    def to_env(self, given: dict[str, Any], episodes: list[Any], shared: dict[str, Any]) -> dict[str, Any]:
        """Return what comes out for the environment and for the episodes, of the one agent."""
        with torch.no_grad():
            sent = self.module_to_env(
                rl_module=self.together,
                batch={self.seat.module: given},
                episodes=episodes,
                explore=False,
                shared_data=shared,
            )
        own = {name: [by_agent[self.seat.agent] for by_agent in rows] for name, rows in sent.items()}
        acting = (Columns.ACTIONS, Columns.ACTIONS_FOR_ENV)
        return {name: _stacked(rows) if name in acting else rows for name, rows in own.items()}

    def begin(self, obs: Any) -> Any:
        """Return an episode that has just been reset."""
        module = self.seat.module  # whatever the mapping says: it decides who sits here, which has been decided
        episode = MultiAgentEpisode(
            observation_space=self.env_to_module.input_observation_space,
            action_space=self.env_to_module.input_action_space,
            agent_to_module_mapping_fn=lambda _agent, _episode: module,
        )
        episode.add_env_reset(observations={self.seat.agent: obs})
        return episode

    def advance(self, episode: Any, obs: Any, action: Any, reward: float, extra: dict[str, Any]) -> None:
        """Tell an episode of one more step."""
        agent = self.seat.agent
        episode.add_env_step(
            observations={agent: obs},
            actions={agent: action},
            rewards={agent: reward},
            extra_model_outputs={agent: extra},
        )


def pipelines_of(
    seat: Seat, module: Any, env_to_module: Any, module_to_env: Any, observation_space: Any, action_space: Any
) -> Pipelines:
    """Return RLlib's way to act for the seat, whose own the spaces are."""
    if seat is ALONE:
        return Pipelines(module, env_to_module, module_to_env, observation_space, action_space)
    together = MultiRLModule()
    together.add_module(seat.module, module)
    return SeatPipelines(module, env_to_module, module_to_env, observation_space, action_space, seat, together)


def find_seat(files: CheckpointFiles, env_to_module: Any, module_to_env: Any) -> Seat:
    """Return for which agent a module is exported; ALONE where the environment has only one.

    A module may serve several: any stands for all where their spaces and the steps before the network are the same.
    Raises CheckpointError when there is no such agent, or they differ and none was named: `details["agents"]` lists
    them then. Raises UnsupportedError for modules that compute together.
    """
    mapping = next((piece for piece in env_to_module.connectors if type(piece).__name__ == MAPPING), None)
    if mapping is None:
        if files.agent_id is not None:
            raise CheckpointError(f"{files.root} was trained with one agent: leave --agent-id out")
        return ALONE
    _check_separate(files)
    agents = _served(mapping, files.module_id)
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
    seats = [Seat(agent, files.module_id) for agent in agents]
    told = [_treatment(seat, files, env_to_module, module_to_env) for seat in seats]
    if any(one != told[0] for one in told[1:]):
        raise CheckpointError(
            f"{files.root}: module '{files.module_id}' serves the agents {_listed(agents)}, whose spaces or "
            "observation filters differ: name the one to export for with --agent-id",
            {"agents": [str(agent) for agent in agents]},
        )
    return dataclasses.replace(seats[0], agents=tuple(str(agent) for agent in agents))


def _served(mapping: Any, module_id: str) -> list[Any]:
    """Return the agents that a module serves, as RLlib asks it; all that it could serve where that is drawn anew."""
    agents = list(mapping.input_observation_space.spaces)
    try:
        named = [
            agent for agent in agents if mapping._agent_to_module_mapping_fn(agent, MultiAgentEpisode()) == module_id
        ]
    except Exception:  # the user's own function may want more of an episode than a new one has
        named = []
    if named:
        return named
    wanted = (mapping.observation_space[module_id], mapping.action_space[module_id])
    return [
        agent
        for agent in agents
        if (mapping.input_observation_space[agent], mapping.input_action_space[agent]) == wanted
    ]


def _treatment(seat: Seat, files: CheckpointFiles, env_to_module: Any, module_to_env: Any) -> tuple[Any, ...]:
    """Return all that may differ between agents that share a module."""
    steps: list[BakedStep] = [observation_step(step) for step in read_observation_steps(env_to_module, files, seat)]
    return seat.part(env_to_module.input_observation_space), seat.part(module_to_env.input_action_space), steps


def _check_separate(files: CheckpointFiles) -> None:
    """Raise UnsupportedError where the modules are parts of something of the user's own, which may mix them."""
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
