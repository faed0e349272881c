"""Contract of a policy bundle: inputs, outputs, baked-in steps, provenance and proof, as pydantic models."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, field_validator

from rlservo.bundle.spaces import FrozenModel, Shape, Size, SpaceSpec
from rlservo.errors import BundleError

VALUE = "value"  # the graph's output of the value head, if it was exported
REWARD = "reward"  # the graph's input for the last action's reward, if the policy was trained to see it
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
REWARD_PATTERN = r"^([A-Za-z_][A-Za-z0-9_.]*:[A-Za-z_][A-Za-z0-9_]*)?$"
VERSION_PATTERN = r"^([1-9][0-9]{0,8}|(0|[1-9][0-9]{0,8})\.(0|[1-9][0-9]{0,8})\.(0|[1-9][0-9]{0,8}))$"
PATTERNS = {  # for a person
    NAME_PATTERN: "a name of letters, digits, '.', '_' and '-', which begins with a letter or digit",
    REWARD_PATTERN: "module:function",
    VERSION_PATTERN: "a version such as 3 or 1.2.0",
}
Tolerance: TypeAlias = Annotated[float, Field(ge=0.0, le=1e-2)]
"""A larger difference is never rounding."""


class TensorSpec(FrozenModel):
    """A named input or output of the graph. The first axis is the batch, -1."""

    name: str
    dtype: str
    shape: tuple[int, ...]

    @field_validator("shape")
    @classmethod
    def _has_a_batch_axis(cls, shape: tuple[int, ...]) -> tuple[int, ...]:
        if not shape or shape[0] != -1 or any(size < 1 for size in shape[1:]):
            raise ValueError(f"expected -1 for the batch, then positive sizes, got {list(shape)}")
        return shape


class StateSpec(FrozenModel):
    """A policy's memory: graph input `state_in.<name>`, output `state_out.<name>`; `initial` starts an episode."""

    name: str
    dtype: str
    shape: Shape = Field(description="Without the batch axis")
    initial: float | tuple[float, ...] = Field(0.0, description="One number, or one per element in row-major order")
    kind: Literal["recurrent", "frames", "previous_actions", "previous_rewards"] = Field(
        "recurrent",
        description="'previous_actions' holds the last actions' one-hot codes, oldest first: a caller that sends "
        "an action other than the graph's `action` (exploring) overwrites the last code with that action's",
    )

    def initial_value(self, batch: int) -> NDArray[Any]:
        """Return the state at an episode's start, `[batch, *shape]`."""
        one = np.asarray(self.initial, self.dtype)
        one = one.reshape(self.shape) if one.ndim else np.full(self.shape, one)
        return np.repeat(one[None], batch, axis=0)


class Distribution(FrozenModel):
    """Rule that makes an exploratory action from `action_dist_inputs`; the graph's `action` is deterministic."""

    kind: Literal["diag_gaussian", "squashed_gaussian", "categorical", "multi_categorical", "multi"] = Field(
        description="'multi' has one part for each leaf of a nested action space, in the order of the graph's outputs: "
        "diag_gaussian for a box, categorical or multi_categorical for the others"
    )
    transform: Literal["none", "unsquash", "clip"] = Field(
        description="Transform of a sample before env.step: 'unsquash' maps [-1, 1] to the bounds and clips, "
        "'clip' only clips, 'none' sends it as it is (discrete actions: adds the space's start). Box leaves that are "
        "not bounded on all sides are never unsquashed"
    )


class BakedStep(FrozenModel):
    """One processing step inside the graph, in the order it is applied."""

    step: str = Field(description="For example 'mean_std_filter', 'one_hot', 'network', 'mode', 'unsquash', 'clip'")
    detail: str = Field("", description="Explanation in a sentence")
    values: dict[str, Any] = Field(default_factory=dict, description="For example count, mean and std of a filter")


class Provenance(FrozenModel):
    """Origin of the policy."""

    algorithm: str
    source: str = Field("rllib", description="Source that read the checkpoint: 'rllib', 'sb3', ...")
    framework: str = Field("", description="Framework that restored the checkpoint, with its version")
    api_stack: Literal["new", "old"] | None = Field(None, description="RLlib's API stack")
    module_id: str
    agents: tuple[str, ...] = Field(
        default=(), description="Agents that the policy acts for in a multi-agent environment"
    )
    module_class: str
    checkpoint_sha256: str = Field(description="Hash over the checkpoint files that were read")
    options: dict[str, Any] = Field(
        default_factory=dict, description="Options of the export that `rlservo verify` needs again"
    )
    training_iterations: int | None = None
    env_steps: int | None = None
    env_id: str | None = None
    env_config: dict[str, Any] = Field(default_factory=dict)
    ray_version: str | None = Field(None, description="Version of Ray that wrote the checkpoint")
    torch_version: str
    rlservo_version: str
    exported_at: str = Field(description="UTC, ISO 8601")


class FormatParity(FrozenModel):
    """The largest differences between one written format and the framework's own pipeline."""

    max_abs: float = Field(ge=0.0)
    max_rel: float = Field(ge=0.0, description="Relative to the gate's scale")


class Parity(FrozenModel):
    """Proof that the export equals what the framework itself would send to env.step."""

    reference: str
    samples: int = Field(ge=0)
    batch_sizes: tuple[Size, ...]
    rtol: Tolerance
    atol: Tolerance
    rule: str = Field(default="", description="How the two tolerances are applied")
    formats: dict[str, FormatParity]
    unreached: tuple[str, ...] = Field(
        default=(), description="Bounds and clips that no sample reached: there the export rests on its recipe alone"
    )


class Evaluation(FrozenModel):
    """One closed-loop run of the exported policy: with its checkpoint on the same seeds, or under a disturbance."""

    env_id: str
    episodes: Size
    first_seed: int
    return_bundle: float
    return_checkpoint: float | None = None
    return_interval: tuple[float, float] | None = Field(default=None, description="95% interval of the mean (normal)")
    success_rate_bundle: float | None
    success_rate_checkpoint: float | None = None
    success_interval: tuple[float, float] | None = Field(default=None, description="95% interval (Wilson)")
    disturbance: str | None = Field(
        default=None, description="Argument of `rlservo verify --disturb`; 'none' in the first row"
    )
    endings: dict[str, int] = Field(default_factory=dict, description="Number of episodes by ending")
    robot: dict[str, Any] = Field(
        default_factory=dict, description="Robot that was simulated: model, control rate, share of its velocity limits"
    )
    evaluated_at: str


class Contract(FrozenModel):
    """`contract.json`: everything a client, a server or a person needs to know about a policy."""

    schema_version: Literal[1] = 1
    name: str = Field(pattern=NAME_PATTERN)
    version: str = Field(pattern=VERSION_PATTERN)
    description: str = ""
    observation_space: SpaceSpec
    action_space: SpaceSpec
    inputs: tuple[TensorSpec, ...]
    outputs: tuple[TensorSpec, ...]
    state: tuple[StateSpec, ...] = ()
    distribution: Distribution | None
    baked_in: tuple[BakedStep, ...]
    control_rate_hz: float | None = Field(None, gt=0.0, description="Control rate of the environment [Hz]")
    reward: str = Field("", pattern=REWARD_PATTERN, description="Reward function for learning online, module:function")
    provenance: Provenance
    parity: Parity
    evaluations: tuple[Evaluation, ...] = ()

    @property
    def has_reward(self) -> bool:
        """Whether the policy was trained to see the last action's reward."""
        return any(tensor.name == REWARD for tensor in self.inputs)


def version_key(version: str) -> tuple[int, ...]:
    """Return a sort key: '3' counts as 3.0.0."""
    parts = tuple(int(part) for part in version.split("."))
    return parts + (0,) * (3 - len(parts))


def first_fault(error: ValidationError, *, shows_input: bool = False) -> str:
    """Return the first error in a document: `field: message`, and the input."""
    first = error.errors(include_url=False)[0]
    given = f" (given: {first['input']!r:.80})" if shows_input else ""
    reason = first["msg"].removeprefix("Value error, ")  # pydantic's, before our own sentence
    if (pattern := first.get("ctx", {}).get("pattern")) in PATTERNS:
        reason = f"expected {PATTERNS[pattern]}"
    return f"{'.'.join(str(part)[:80] for part in first['loc']) or 'the document'}: {reason}{given}"


def parse_contract(text: str, source: str) -> Contract:
    """Parse contract.json, or the copy of it in the graph's metadata. Raises BundleError naming `source` and field."""
    try:
        return Contract.model_validate_json(text)
    except ValidationError as error:
        raise BundleError(f"{source}: {first_fault(error)}") from error


def contract_json(contract: Contract) -> str:
    """Return the contract as the indented JSON that goes into the bundle and the ONNX metadata."""
    return json.dumps(contract.model_dump(mode="json"), indent=2)
