"""Plain torch modules by `rlservo.export_policy`."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import rlservo
from rlservo.export.contract.errors import CheckpointError, ParityError, UnsupportedError, UsageError
from rlservo.serve_app.runtime.policy import Policy

torch = pytest.importorskip("torch")
nn = torch.nn

pytestmark = pytest.mark.skipif(find_spec("onnxscript") is None, reason="torch exports with onnxscript")

ARM = spaces.Box(np.array([-1.0, -2.0], np.float32), np.array([1.0, 2.0], np.float32))
SEEN = spaces.Box(-np.inf, np.inf, (3,), np.float32)


def network(outputs: int = 2) -> Any:
    torch.manual_seed(1)
    return nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Dropout(), nn.Linear(8, outputs))


def test_names_units_scale_and_clip_are_arguments(tmp_path: Path, notices: list[str]) -> None:
    module = network().train()
    result = rlservo.export_policy(
        module, SEEN, ARM, tmp_path, name="arm", scale=[3.0, 4.0], offset=0.1, action_names=["pan", "lift"],
        action_units=["rad", "rad"], observation_names=["x", "y", "z"], control_rate_hz=50.0, notify=notices.append,
    )  # fmt: skip
    assert module.training, "the caller's module was changed"
    contract = result.contract
    assert [(e.name, e.unit) for e in contract.action_space.elements] == [("pan", "rad"), ("lift", "rad")]
    assert contract.control_rate_hz == 50.0 and contract.provenance.source == "torch"
    assert [step.step for step in contract.baked_in] == ["network", "mode", "scale", "clip"]
    obs = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    with Policy.load(result.path) as policy:
        found = [policy.act(one) for one in obs]
    with torch.no_grad():
        raw = module.eval()(torch.from_numpy(obs)).numpy()
    wanted = np.clip(raw * np.array([3.0, 4.0]) + 0.1, ARM.low, ARM.high)
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=2e-6)
    assert (np.abs(wanted) == ARM.high).any(), "nothing was clipped"


@pytest.mark.parametrize("space", [spaces.Discrete(4), spaces.MultiDiscrete([3, 2])], ids=["one", "several"])
def test_scores_choose_the_largest(space: Any, tmp_path: Path, notices: list[str]) -> None:
    count = 4 if isinstance(space, spaces.Discrete) else 5
    module = network(count)
    result = rlservo.export_policy(module, SEEN, space, tmp_path, name="chooser", notify=notices.append)
    obs = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    with torch.no_grad():
        scores = module.eval()(torch.from_numpy(obs)).numpy()
    wanted = scores.argmax(1) if count == 4 else np.stack([scores[:, :3].argmax(1), scores[:, 3:].argmax(1)], 1)
    with Policy.load(result.path) as policy:
        np.testing.assert_array_equal([policy.act(one) for one in obs], wanted)


class Remembering(nn.Module):
    """A GRU cell over the parts of an observation."""

    def __init__(self) -> None:
        super().__init__()
        self.cell = nn.GRUCell(4, 5)
        self.head = nn.Linear(5, 2)

    def forward(self, obs: Any, hidden: Any) -> Any:
        parts = torch.cat([obs["joints"], nn.functional.one_hot(obs["mode"], 2).float()], dim=-1)
        hidden = self.cell(parts, hidden)
        return self.head(hidden), hidden


def test_a_recurrent_module_of_parts_starts_with_the_state_that_was_given(tmp_path: Path, notices: list[str]) -> None:
    torch.manual_seed(2)
    module = Remembering()
    space = spaces.Dict({"joints": spaces.Box(-1, 1, (2,), np.float32), "mode": spaces.Discrete(2)})
    start = np.full(5, 0.5, np.float32)
    result = rlservo.export_policy(
        module, space, ARM, tmp_path, name="memory", clip=False, state={"hidden": start}, notify=notices.append
    )
    space.seed(0)
    with Policy.load(result.path) as policy, torch.no_grad():
        for _ in range(2):
            policy.reset()
            hidden = torch.from_numpy(start)[None]
            for _ in range(5):
                obs = space.sample()
                given = {"joints": torch.from_numpy(obs["joints"])[None], "mode": torch.tensor([int(obs["mode"])])}
                action, hidden = module(given, hidden)
                np.testing.assert_allclose(policy.act(obs), action[0].numpy(), rtol=1e-5, atol=2e-6)


class Branching(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 2)

    def forward(self, obs: Any) -> Any:
        return self.layer(obs) if float(obs.sum()) > 0 else -self.layer(obs)


@pytest.mark.parametrize(
    ("module", "options", "kind", "words"),
    [
        (network(3), {}, UnsupportedError, r"action of shape \(2, 3\), the action space .* expects \(2, 2\)"),
        (nn.Linear(5, 2), {}, UnsupportedError, "Linear does not run on an observation of Box"),
        (network(), {"scale": [1, 2, 3]}, UsageError, r"scale has shape \(3,\), the action \(2,\)"),
        (network(), {"scale": np.nan}, UsageError, "scale is not finite"),
        (network(), {"action_names": ["pan"]}, UsageError, "1 action names were given, the space has 2 elements"),
        (network(), {"action_units": ["rad"]}, UsageError, "0 action names and 1 units were given"),
        (network(), {"state": {"h": np.zeros(2)}}, UnsupportedError, "does not run on an observation"),
        (network(), {"name": "a/b"}, UsageError, "'a/b' cannot be a policy's name"),
        (Branching(), {}, ParityError, "depends on the other observations of the batch|tracing froze"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_one_sentence(
    module: Any, options: dict[str, Any], kind: type[Exception], words: str, tmp_path: Path, notices: list[str]
) -> None:
    with pytest.raises(kind, match=words):
        rlservo.export_policy(module, SEEN, ARM, tmp_path / "out", **{"name": "x", "notify": notices.append, **options})
    assert not (tmp_path / "out").exists()


def test_weights_that_are_not_finite_are_refused(tmp_path: Path, notices: list[str]) -> None:
    module = network()
    with torch.no_grad():
        module[0].bias[0] = float("inf")
    with pytest.raises(CheckpointError, match=r"'0\.bias' are not all finite"):
        rlservo.export_policy(module, SEEN, ARM, tmp_path, name="x", notify=notices.append)
