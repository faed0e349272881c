"""The actor of a run of rsl_rl 2, 3 or 4 as a module for `rlservo.export_policy`.

rsl_rl 5 does not load those checkpoints, so there is nothing to compare a graph with but this module. Export with

    actor = OlderActor("logs/rsl_rl/arm/model_1500.pt", torch.nn.ELU)
    rlservo.export_policy(actor, actor.observations(), actor.actions(), "policies", name="arm", scale=0.5)
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor


class OlderActor(torch.nn.Module):
    """The mean action of an actor without a memory: its normalizer, if it has one, and its layers.

    `activation` is agent.yaml's: nothing in a checkpoint says it.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, file: str | Path, activation: type[torch.nn.Module]) -> None:
        super().__init__()
        saved = torch.load(file, map_location="cpu", weights_only=True)
        weights = saved.get("actor_state_dict") or saved["model_state_dict"]
        if any("rnn" in name for name in weights):
            raise ValueError(f"{file} is of a recurrent actor")
        layers: list[torch.nn.Module] = []
        self.sizes: list[int] = []
        for name, weight in weights.items():
            if re.fullmatch(r"(actor|mlp)\.\d+\.weight", name):
                linear = torch.nn.Linear(weight.shape[1], weight.shape[0])
                self.sizes += weight.shape[::-1]
                linear.load_state_dict({"weight": weight, "bias": weights[name.replace("weight", "bias")]})
                layers += [linear, activation()]
        deviation = next((weights[name] for name in ("std", "log_std") if name in weights), None)
        if deviation is None or self.sizes[-1:] != [len(deviation)]:  # state_dependent_std, a student, images
            raise ValueError(f"{file} is not of an actor whose layers end in one mean for each action")
        self.layers = torch.nn.Sequential(*layers[:-1])
        own = {name: value for name, value in weights.items() if re.match(r"(actor_)?obs_normalizer\.", name)}
        # rsl_rl 2 saves it apart; its epsilon is 0.01 in all of them.
        normalizer = saved.get("obs_norm_state_dict") or {name.rpartition(".")[2]: own[name] for name in own}
        self.register_buffer("mean", normalizer.get("_mean", torch.zeros(1)))
        self.register_buffer("std", normalizer["_std"] + 0.01 if normalizer else torch.ones(1))

    def forward(self, obs: Tensor) -> Tensor:
        """Return actions for observations (batch, n)."""
        actions: Tensor = self.layers((obs - self.mean) / self.std)
        return actions

    def observations(self) -> Box:
        """Return the observation space; no file of the run has its bounds."""
        return Box(-np.inf, np.inf, (self.sizes[0],), np.float32)

    def actions(self) -> Box:
        """Return the action space; no file of the run has its bounds."""
        return Box(-np.inf, np.inf, (self.sizes[-1],), np.float32)
