"""The whole policy as one torch graph: a raw observation in, an action ready for `env.step` out.

It puts a `Recipe` around a network. It knows torch and numbers; nothing of RLlib, of files or of formats.

Every node costs a third of a microsecond in onnxruntime, the network itself nine, so constants are folded as far as
single precision allows.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from torch import Tensor, nn

from rlservo.export.recipe import Flatten, ObservationFilter, ObservationStep, Recipe, Rescale

# What may be left out of the filter's mean, in units of the filtered observation: below float32's step near 1.
NEGLIGIBLE = 1e-7


class TracedNetwork(Protocol):
    """A module from the network's input to one tensor for each name."""

    names: tuple[str, ...]

    def __call__(self, obs: Tensor) -> tuple[Tensor, ...]: ...


class PolicyGraph(nn.Module):
    """Observation steps, network, action rule. Outputs are `output_names`, in that order."""

    def __init__(self, recipe: Recipe, network: TracedNetwork) -> None:
        super().__init__()
        self.steps = nn.ModuleList()
        dtype = _dtype(recipe.observation_space)
        for step in recipe.steps:
            if isinstance(step, Flatten | Rescale):
                dtype = torch.float32
            self.steps.append(_node(step, dtype))
        self.network = network
        self.action = ActionNode(recipe)
        self.output_names = ("action", *network.names)
        self.eval()

    def forward(self, obs: Tensor) -> tuple[Tensor, ...]:
        """Return (action, ...) for raw observations `[batch, *obs_shape]` of the space's dtype."""
        for step in self.steps:
            obs = step(obs)
        outputs = self.network(_cast(obs, torch.float32))
        return (self.action(outputs[0]), *outputs)


class FlattenNode(nn.Module):
    """`[batch, ...]` to `[batch, elements]`, float32 as RLlib makes it."""

    def forward(self, obs: Tensor) -> Tensor:
        return _cast(obs.flatten(1), torch.float32)


class RescaleNode(nn.Module):
    """`(x - offset) / divisor`, in float32 from the start as RLlib's preprocessor does it."""

    def __init__(self, step: Rescale) -> None:
        super().__init__()
        self.offset, self.divisor = step.offset, step.divisor

    def forward(self, obs: Tensor) -> Tensor:
        return (_cast(obs, torch.float32) - self.offset) / self.divisor


class FilterNode(nn.Module):
    """RLlib's frozen MeanStdFilter.

    RLlib subtracts in double precision. With single-precision observations the same is reached by subtracting the mean
    in two parts: the nearest float32, then what that left over (Dekker 1971), where the rest matters at all.
    """

    offset: Tensor
    rest: Tensor
    scale: Tensor

    def __init__(self, frozen: ObservationFilter, dtype: torch.dtype) -> None:
        super().__init__()
        self.clip = frozen.clip
        offset, scale = frozen.offset(), 1.0 / frozen.divisor().astype(np.float64)
        rest = offset - offset.astype(np.float32)
        self.has_rest = dtype == torch.float32 and bool(np.max(np.abs(rest) * scale, initial=0.0) > NEGLIGIBLE)
        self.register_buffer("offset", torch.tensor(offset, dtype=dtype))
        self.register_buffer("rest", torch.tensor(rest, dtype=dtype))
        self.register_buffer("scale", torch.tensor(scale, dtype=dtype))

    def forward(self, obs: Tensor) -> Tensor:
        obs = obs - self.offset
        if self.has_rest:
            obs = obs - self.rest
        obs = obs * self.scale
        if self.clip is not None:
            obs = torch.clamp(obs, -self.clip, self.clip)
        return obs


class ActionNode(nn.Module):
    """The distribution's mode, then what RLlib does to it before `env.step`.

    Unsquashing is `low + (a + 1) * (high - low) / 2`, clipped (`unsquash_action`, ray 2.60), here as
    `a * half_range + middle`.
    """

    half_range: Tensor
    middle: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, recipe: Recipe) -> None:
        super().__init__()
        self.mode, self.transform = recipe.mode, recipe.transform
        space = recipe.action_space
        self.box = isinstance(space, Box)
        if isinstance(space, Discrete):
            return
        self.dtype = _dtype(space)
        self.width = int(np.prod(space.shape))
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        with np.errstate(invalid="ignore"):  # infinite bounds are never unsquashed
            half, middle = (high - low) / 2, (high + low) / 2
        self.is_scaled, self.is_moved = bool((half != 1).any()), bool((middle != 0).any())
        self.limits = _same_everywhere(low, high)
        for name, values in (("half_range", half), ("middle", middle), ("low", low), ("high", high)):
            self.register_buffer(name, torch.tensor(values, dtype=self.dtype))

    def forward(self, parameters: Tensor) -> Tensor:
        if not self.box:
            return torch.argmax(parameters, dim=-1)
        action = torch.split(parameters, [self.width, self.width], dim=-1)[0]
        if self.mode == "tanh_mean":
            action = torch.tanh(action)
        action = _cast(action, self.dtype)
        if self.transform == "unsquash" and self.is_scaled:
            action = action * self.half_range
        if self.transform == "unsquash" and self.is_moved:
            action = action + self.middle
        return action if self.transform == "none" else self._clip(action)

    def _clip(self, action: Tensor) -> Tensor:
        if self.limits is not None:
            return torch.clamp(action, *self.limits)
        return torch.minimum(torch.maximum(action, self.low), self.high)


def _node(step: ObservationStep, dtype: torch.dtype) -> nn.Module:
    if isinstance(step, Flatten):
        return FlattenNode()
    return RescaleNode(step) if isinstance(step, Rescale) else FilterNode(step, dtype)


def _same_everywhere(low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[float, float] | None:
    """Return the bounds as two numbers where all elements share finite ones: one node instead of two."""
    first_low, first_high = float(low.flat[0]), float(high.flat[0])
    shared = bool(
        (low == first_low).all() and (high == first_high).all() and np.isfinite([first_low, first_high]).all()
    )
    return (first_low, first_high) if shared else None


def _cast(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    """Return `tensor` as `dtype`, without a node where it is so already."""
    return tensor if tensor.dtype == dtype else tensor.to(dtype)


def _dtype(space: Box) -> torch.dtype:
    return torch.float64 if space.dtype == np.float64 else torch.float32
