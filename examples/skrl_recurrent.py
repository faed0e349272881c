"""A recurrent agent of skrl as a module for `rlservo.export_policy`.

skrl's Runner makes no recurrent models, so no file of a run describes the network: make the agent as your training
does, load the checkpoint (`agent.load`), and export

    policy = RecurrentPolicy(agent)
    rlservo.export_policy(policy, observations, actions, "policies", name="arm", state=policy.initial_state())
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class RecurrentPolicy(torch.nn.Module):
    """The mean action of an agent's policy: its preprocessor, its model, and the memory that the model declares."""

    def __init__(self, agent: Any) -> None:
        super().__init__()
        self.model = copy.deepcopy(agent.models["policy"])
        self.preprocessor = copy.deepcopy(agent.checkpoint_modules.get("observation_preprocessor"))
        self.sizes: list[tuple[int, int, int]] = self.model.get_specification()["rnn"]["sizes"]

    def initial_state(self) -> dict[str, NDArray[np.float32]]:
        """Return zeros for each part of the memory, (layers, cells), as an episode starts."""
        return {f"h{number}": np.zeros((size[0], size[2]), np.float32) for number, size in enumerate(self.sizes)}

    def forward(self, obs: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Return the action and the next memory, given observations (batch, n) and memory (batch, layers, cells)."""
        seen = obs if self.preprocessor is None else self.preprocessor(obs)
        memory = [part.transpose(0, 1).contiguous() for part in state]
        mean, outputs = self.model.compute({"observations": seen, "states": None, "rnn": memory}, role="policy")
        return (mean, *(part.transpose(0, 1) for part in outputs["rnn"]))
