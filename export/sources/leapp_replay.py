"""LEAPP's own InferenceManager acting step after step: the reference of a bundle's export.

It is given the pipeline's inputs and nothing else: order, first values and what is carried from step to step are its.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rlservo.export.recipe.runners import Inputs, Outputs
from rlservo.export.sources.leapp_description import StageTensor


class StageReplay:
    """One InferenceManager that keeps every row's values apart."""

    def __init__(
        self,
        start: Callable[[], Any],
        given: Mapping[str, StageTensor],
        results: Mapping[str, StageTensor],
        state: Mapping[str, StageTensor],
    ) -> None:
        """`start` makes the InferenceManager; the rest are LEAPP's tensors by the graph's names."""
        self._manager = start()
        self._given, self._results, self._state = given, results, state
        self._like = self._manager.get_mock_input()
        self._begin = copy.deepcopy(self._manager.value_dict)
        self._rows: list[Any] = []

    def step(self, inputs: Inputs, restart: NDArray[np.bool_]) -> Outputs:
        """Return LEAPP's outputs for one step of every row, by name."""
        self._rows = self._rows or [None] * len(restart)
        rows = []
        for row, begins in enumerate(restart.tolist()):
            if begins or self._rows[row] is None:
                self._rows[row] = copy.deepcopy(self._begin)
            self._manager.value_dict = self._rows[row]
            rows.append(self._act({name: values[row] for name, values in inputs.items()}))
        return {name: np.stack([each[name] for each in rows]) for name in rows[0]}

    def _act(self, row: Inputs) -> Outputs:
        given = {tensor.key: self._tensor(tensor.key, row[name]) for name, tensor in self._given.items()}
        with torch.no_grad():
            answered = self._manager.run_policy(given)
        values = {name: (answered[tensor.key], tensor) for name, tensor in self._results.items()}
        for name, tensor in self._state.items():
            stage, _, key = tensor.key.partition("/")
            values[name] = self._manager.value_dict[stage][key], tensor
        return {name: value.reshape(tensor.row).cpu().numpy().copy() for name, (value, tensor) in values.items()}

    def _tensor(self, key: str, row: NDArray[Any]) -> Any:
        like = self._like[key]
        return torch.from_numpy(row.copy()).reshape(like.shape).to(like.device)
