"""Plain torch modules by `rlservo.export_policy`."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import rlservo
from rlservo.errors import CheckpointError, ParityError, RlservoError, UnsupportedError, UsageError
from rlservo.policy.policy import Policy

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


def test_normalized_weights_are_exported(tmp_path: Path, notices: list[str]) -> None:
    """A copy of torch's weight_norm loses the docstring of a hook, and was refused for it."""
    normalized = torch.nn.utils.parametrizations.weight_norm(nn.Linear(3, 8))
    module = nn.Sequential(normalized, nn.Tanh(), nn.Linear(8, 2))
    result = rlservo.export_policy(module.eval(), SEEN, ARM, tmp_path, name="arm", notify=notices.append)
    obs = torch.randn(5, 3)
    with Policy.load(result.path) as policy, torch.no_grad():
        np.testing.assert_allclose(
            [policy.act(one.numpy()) for one in obs], module(obs).clamp(torch.tensor(ARM.low), torch.tensor(ARM.high)),
            rtol=1e-5, atol=2e-6,
        )  # fmt: skip


class Parts(nn.Module):
    """A layer over two parts of an observation."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 2)

    def forward(self, obs: Any) -> Any:
        return self.layer(torch.cat([obs["pose"], obs["count"].float()], dim=-1))


POSE = {"pose": spaces.Box(-np.inf, np.inf, (2,), np.float64), "count": spaces.Box(-9, 9, (1,), np.int32)}


@pytest.mark.parametrize("observation", [spaces.Box(-np.inf, np.inf, (3,), np.float64), spaces.Dict(POSE)])
def test_double_precision_goes_to_the_module_in_single(observation: Any, tmp_path: Path, notices: list[str]) -> None:
    torch.manual_seed(3)
    module = Parts() if isinstance(observation, spaces.Dict) else network()
    action = spaces.Box(-1, 1, (2,), np.float64)
    given = {"scale": 1.5, "offset": [0.1, -0.2]}
    result = rlservo.export_policy(module, observation, action, tmp_path, name="x", notify=notices.append, **given)
    observation.seed(0)
    with Policy.load(result.path) as policy, torch.no_grad():
        for _ in range(9):
            obs = observation.sample()
            batch = {key: torch.from_numpy(part)[None] for key, part in obs.items()} if isinstance(obs, dict) else None
            if batch is not None:
                batch["pose"] = batch["pose"].float()
            raw = module.eval()(torch.from_numpy(obs)[None].float() if batch is None else batch)[0].double().numpy()
            acted = policy.act(obs)
            np.testing.assert_allclose(acted, np.clip(raw * 1.5 + [0.1, -0.2], -1, 1), rtol=1e-5, atol=2e-6)
            assert np.asarray(acted).dtype == np.float64


class InOrder(nn.Module):
    """Reads the parts of an observation in the order in which they come."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(4, 2)

    def forward(self, obs: Any) -> Any:
        return self.layer(torch.cat(list(obs.values()), dim=-1))


def test_a_module_that_reads_parts_in_their_order_is_refused(tmp_path: Path, notices: list[str]) -> None:
    space = spaces.Dict([("wheels", spaces.Box(-1, 1, (2,))), ("arm", spaces.Box(-1, 1, (2,)))])
    with pytest.raises(UnsupportedError, match=r"when its keys come in the opposite order: .* read the parts by their"):
        rlservo.export_policy(InOrder(), space, ARM, tmp_path / "out", name="x", notify=notices.append)


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
        (network(), {"scale": [1, 2, 3]}, UsageError, r"scale has shape \(3,\), but the action has \(2,\)"),
        (network(), {"scale": np.nan}, UsageError, "scale is not finite"),
        (network(), {"action_names": ["pan"]}, UsageError, "1 action names were given, but the space has 2 elements"),
        (network(), {"action_units": ["rad"]}, UsageError, "0 action names and 1 units were given"),
        (network(), {"state": {"h": np.zeros(2, np.float32)}}, UnsupportedError, "does not run on an observation"),
        (network().state_dict(), {}, UsageError, "a OrderedDict is not a torch module"),
        (network(), {"name": "a/b"}, UsageError, "'a/b' cannot be a policy's name"),
        (Branching(), {}, UnsupportedError, "reads numbers of the observation in Python at"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_one_sentence(
    module: Any, options: dict[str, Any], kind: type[Exception], words: str, tmp_path: Path, notices: list[str]
) -> None:
    with pytest.raises(kind, match=words):
        rlservo.export_policy(module, SEEN, ARM, tmp_path / "out", **{"name": "x", "notify": notices.append, **options})
    assert not (tmp_path / "out").exists()


class Flags(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 2)

    def forward(self, obs: Any, seen: Any) -> Any:
        return self.layer(obs), seen > 0.5


@pytest.mark.parametrize(
    ("module", "options", "kind", "words"),
    [
        (Flags(), {"state": {"seen": np.zeros(2, np.bool_)}}, UsageError, "'seen' is bool: a bundle carries states as"),
        (Flags(), {"state": {"seen": [0.0, 0.0]}}, UnsupportedError, r"state 'seen' as torch.bool .* torch.float32"),
        (network(10), {"action_space": spaces.MultiDiscrete([[3, 2], [2, 3]])}, UsageError, "only one-dimensional"),
    ],
)
def test_what_no_bundle_carries_is_refused_in_one_sentence(
    module: Any, options: dict[str, Any], kind: type[Exception], words: str, tmp_path: Path, notices: list[str]
) -> None:
    given = {"observation_space": SEEN, "action_space": ARM, "name": "x", "notify": notices.append, **options}
    with pytest.raises(kind, match=words):
        rlservo.export_policy(module, out=tmp_path / "out", **given)


@pytest.mark.filterwarnings("ignore:.*quantiz")
def test_a_quantized_module_is_refused_by_that_name(tmp_path: Path, notices: list[str]) -> None:
    module = torch.ao.quantization.quantize_dynamic(network(), {nn.Linear}, torch.qint8)
    with pytest.raises(UnsupportedError, match="is of a quantized layer, which is not exported"):
        rlservo.export_policy(module, SEEN, ARM, tmp_path / "out", name="x", notify=notices.append)


def test_counted_actions_are_clipped_to_their_bounds(tmp_path: Path, notices: list[str]) -> None:
    class Counts(nn.Module):
        def forward(self, obs: Any) -> Any:
            return obs[:, :2] * 3

    action = spaces.Box(np.array([-3, 0]), np.array([3, 5]), dtype=np.int64)
    result = rlservo.export_policy(Counts(), SEEN, action, tmp_path, name="x", notify=notices.append)
    with Policy.load(result.path) as policy:
        for obs in ([0.5, 0.5, 0], [-9, -9, 0], [9, 9, 0], [-0.9, 1.4, 0]):
            wanted = np.clip(np.float32(obs[:2]) * 3, action.low, action.high).astype(np.int64)
            np.testing.assert_array_equal(policy.act(np.float32(obs)), wanted)


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
@pytest.mark.parametrize("inside", [False, True], ids=["alone", "inside another"])
def test_a_torchscript_module_is_refused_by_that_name(inside: bool, tmp_path: Path, notices: list[str]) -> None:
    script = torch.jit.trace(network().eval(), torch.zeros(1, 3))
    module = nn.Sequential(script) if inside else script
    with pytest.raises(UnsupportedError, match="holds a TorchScript module, which is not exported again: give the"):
        rlservo.export_policy(module, SEEN, ARM, tmp_path / "out", name="x", notify=notices.append)
    assert not (tmp_path / "out").exists()


def test_weights_that_are_not_finite_are_refused(tmp_path: Path, notices: list[str]) -> None:
    module = network()
    with torch.no_grad():
        module[0].bias[0] = float("inf")
    with pytest.raises(CheckpointError, match=r"'0\.bias' are not all finite"):
        rlservo.export_policy(module, SEEN, ARM, tmp_path, name="x", notify=notices.append)


class Forgetful(nn.Module):
    """Its copy is the class's own, with its weights."""

    def __init__(self) -> None:
        super().__init__()
        self.layer, self.gain = nn.Linear(3, 2), 1.0

    def forward(self, obs: Any) -> Any:
        return self.gain * self.layer(obs)

    def __deepcopy__(self, memo: Any) -> Forgetful:
        copied = Forgetful()
        copied.load_state_dict(self.state_dict())
        return copied


def test_a_module_whose_copy_is_another_is_refused(tmp_path: Path, notices: list[str]) -> None:
    module = Forgetful()
    rlservo.export_policy(module, SEEN, ARM, tmp_path / "out", name="x", notify=notices.append)
    module.gain = -2.0
    with pytest.raises(UnsupportedError, match="has a different 'gain'"):
        rlservo.export_policy(module, SEEN, ARM, tmp_path / "out", name="x", notify=notices.append)


class Renamed(nn.Module):
    """Its part is called as a global of this file is, which it does not read."""

    def __init__(self) -> None:
        super().__init__()
        self.attention = nn.TransformerEncoderLayer(3, 1, 8, batch_first=True, dropout=0.0)
        self.layer = nn.Linear(3, 2)

    def forward(self, obs: Any) -> Any:
        return self.layer(self.attention(obs[:, None])[:, 0])


def test_a_global_of_an_attributes_name_is_not_the_modules(
    tmp_path: Path, notices: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = Renamed().eval()
    monkeypatch.setitem(globals(), "attention", module)
    rlservo.export_policy(module, SEEN, ARM, tmp_path / "out", name="x", notify=notices.append)


class ShapeBakedIn(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 2)

    def forward(self, obs: Any) -> Any:
        return self.layer(torch.vmap(lambda row: torch.where(row.sum() > 0, row, -row))(obs))


def test_a_graph_that_does_not_run_is_refused_with_the_reason(tmp_path: Path, notices: list[str]) -> None:
    with pytest.raises(ParityError, match=r"a batch of \d+ observations: the exported graph does not run: "):
        rlservo.export_policy(ShapeBakedIn(), SEEN, ARM, tmp_path / "out", name="x", notify=notices.append)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "layer", [nn.Dropout(0.5), nn.BatchNorm1d(8), nn.Tanh()], ids=lambda layer: type(layer).__name__
)
def test_a_module_that_acts_otherwise_in_training_is_pointed_out(
    layer: nn.Module, tmp_path: Path, notices: list[str]
) -> None:
    module = nn.Sequential(nn.Linear(3, 8), layer, nn.Linear(8, 2))
    module.train()
    drawn = torch.get_rng_state()
    rlservo.export_policy(module, SEEN, ARM, tmp_path, name="x", notify=notices.append)
    assert torch.equal(torch.get_rng_state(), drawn) and module.training
    said = [notice for notice in notices if "is in training mode, in which it acts otherwise" in notice]
    assert bool(said) == (not isinstance(layer, nn.Tanh))
    module.eval()
    rlservo.export_policy(module, SEEN, ARM, tmp_path, name="x", notify=notices.append)
    assert [notice for notice in notices if "is in training mode" in notice] == said


class Drifting(nn.Module):
    """A layer whose running mean moves with every observation, in evaluation too."""

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 2)
        self.rate = rate
        self.register_buffer("mean", torch.zeros(3))

    def forward(self, obs: Any) -> Any:
        self.mean += self.rate * (obs.mean(0) - self.mean)
        return self.layer(obs - self.mean)


@pytest.mark.parametrize("rate", [1e-1, 1e-3])
def test_a_module_that_changes_as_it_acts_is_refused(rate: float, tmp_path: Path, notices: list[str]) -> None:
    torch.manual_seed(0)
    with pytest.raises(RlservoError, match="changes its 'mean' each time it acts"):
        rlservo.export_policy(Drifting(rate), SEEN, ARM, tmp_path / "out", name="x", notify=notices.append)
    assert not (tmp_path / "out").exists()
