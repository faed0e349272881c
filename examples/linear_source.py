"""Source of linear policies: NAME.linear.npy holds the weights [actions, observations]."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from gymnasium.spaces import Box

from rlservo import errors
from rlservo.export.recipe.recipe import Recipe
from rlservo.export.sources.restored_policy import RestoredPolicy
from rlservo.export.sources.source import Notify, PolicyFiles, RestoreOptions, Source, one_policy
from rlservo.export.sources.torch_policy import Act, TorchPolicy, restored


class Linear(Source):
    name = "linear"
    framework = "numpy"
    distribution = "numpy"  # its version goes into the contract
    extra = "train"
    expects = "a file NAME.linear.npy"
    reference = "the matrix product in numpy, clipped to [-1, 1]"

    def detects(self, path: Path) -> bool:
        return path.name.endswith(".linear.npy")

    def locate(self, path: Path, module_id: str | None, agent_id: str | None) -> PolicyFiles:
        return one_policy(path, [path], module_id, agent_id)

    def loads(self, files: PolicyFiles) -> str:
        return ""  # numpy reads the file without pickle, so there is nothing to warn of

    def restore(self, files: PolicyFiles, options: RestoreOptions, notify: Notify) -> RestoredPolicy:
        weights = np.load(files.root, allow_pickle=False)
        if weights.ndim != 2:
            raise errors.CheckpointError(f"{files.root}: expected a matrix, got an array of shape {weights.shape}")
        actions, observations = weights.shape
        recipe = Recipe(
            observation_space=Box(-np.inf, np.inf, (observations,), np.float32),
            action_space=Box(-1.0, 1.0, (actions,), np.float32),
            steps=(),  # for example ObservationFilter(...)
            mode="given",  # the network gives the action itself
            transform="clip",  # the transform of a drawn action
            distribution=None,
        )
        module = torch.nn.Linear(observations, actions, bias=False)
        module.weight.data = torch.from_numpy(weights.astype(np.float32))

        def reference() -> Act:
            return lambda obs, state: (torch.from_numpy(np.clip(obs.numpy() @ weights.T, -1, 1)), [])

        policy = TorchPolicy(recipe, module, lambda net, obs, state: (net(obs), []), reference)
        return restored(policy, None, str(files.root))
