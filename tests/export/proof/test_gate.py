"""Modules that no graph can stand for are refused, each by its own true reason, before anything is compared."""

from __future__ import annotations

import importlib
import io
import itertools
import logging
import random
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from ray.rllib.utils.numpy import convert_to_numpy
from torch import Tensor, nn

import rlservo
from rlservo.errors import ParityError, UnsupportedError, UsageError
from rlservo.export.export_checkpoint import comparer_of
from rlservo.export.graph.last_bits import run_eager
from rlservo.export.graph.policy_graph import PolicyGraph
from rlservo.export.proof.parity import prove
from rlservo.export.proof.reaching import reaching_batches
from rlservo.export.proof.reference_checks import check_reference
from rlservo.export.proof.references import record
from rlservo.export.recipe.recipe import ObservationFilter, Recipe, StateLeaf, UserStep
from rlservo.export.recipe.runners import Inputs, Outputs
from rlservo.export.recipe.samples import Batch, draw_batches
from rlservo.export.sources.restored_policy import RestoredPolicy
from rlservo.export.sources.torch_policy import TorchPolicy, restored

SEEN = Box(-np.inf, np.inf, (3,), np.float32)
ARM = Box(-1.0, 1.0, (2,), np.float32)
BOX = Box(1e7, 2e7, (3,), np.float32)


class Honest(nn.Module):
    """A small network; the classes below change what it does."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(7)
        self.layer = nn.Linear(3, 2)

    def forward(self, obs: Tensor) -> Tensor:
        return torch.tanh(self.layer(obs))


class CountsInABuffer(Honest):
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros(()))

    def forward(self, obs: Tensor) -> Tensor:
        self.count += 1
        return super().forward(obs) * (1 - 1e-3 * self.count)


class CountsInANumber(Honest):
    count = 0

    def forward(self, obs: Tensor) -> Tensor:
        self.count += 1
        return super().forward(obs) * (1 - 1e-3 * self.count)


class ActsOtherwiseLater(Honest):
    """Its first thousand actions are honest, so no comparison of actions shows it."""

    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.long))

    def forward(self, obs: Tensor) -> Tensor:
        self.count += 1
        return torch.where(self.count > 1000, -super().forward(obs), super().forward(obs))


CALLS = {"global": 0}
DRAWS = random.Random(3)


class CountsInAGlobal(Honest):
    """As all below, honest for a thousand actions."""

    def forward(self, obs: Tensor) -> Tensor:
        CALLS["global"] += 1
        return super().forward(obs) * (-1.0 if CALLS["global"] > 1000 else 1.0)


class CountsInItsClass(Honest):
    calls = 0

    def forward(self, obs: Tensor) -> Tensor:
        CountsInItsClass.calls += 1
        return super().forward(obs) * (-1.0 if self.calls > 1000 else 1.0)


class CountsInAClosure(Honest):
    def __init__(self) -> None:
        super().__init__()
        self.sign = closed_count()

    def forward(self, obs: Tensor) -> Tensor:
        return super().forward(obs) * self.sign()


def closed_count() -> Callable[[], float]:
    closed = 0

    def call() -> float:
        nonlocal closed
        closed += 1
        return -1.0 if closed > 1000 else 1.0

    return call


def counting(scale: float, calls: list[int] = []) -> float:  # noqa: B006  # the fault under test
    calls.append(1)
    return -scale if len(calls) > 1000 else scale


class CountsInADefault(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        return super().forward(obs) * counting(1.0)


class CountsByAnIterator(Honest):
    def __init__(self) -> None:
        super().__init__()
        self.calls = itertools.count()

    def forward(self, obs: Tensor) -> Tensor:
        return super().forward(obs) * (-1.0 if next(self.calls) > 1000 else 1.0)


@dataclass(slots=True)
class Slots:
    calls: int = 0


class Numbers(list[int]):
    """A list with an attribute."""


def numbers_from_zero() -> Iterator[int]:
    number = 0
    while True:
        number += 1
        yield number


ENDLESS, EXPRESSION = numbers_from_zero(), (number for number in range(9999))


@cache
def remembered(number: int) -> int:
    return number


ELSEWHERE: ContextVar[int] = ContextVar("ELSEWHERE", default=0)


class CountsWith(Honest):
    """Counts its calls by what `count` returns for what it keeps."""

    def __init__(self, kept: Any, count: Callable[[Any], float]) -> None:
        super().__init__()
        self.kept, self.count = kept, count

    def forward(self, obs: Tensor) -> Tensor:
        return super().forward(obs) * (-1.0 if self.count(self.kept) > 1000 else 1.0)


def count_attribute(kept: Any) -> int:
    kept.calls = getattr(kept, "calls", 0) + 1
    return int(kept.calls)


def count_in_torch(_: Any) -> int:
    torch.calls_of_a_test = getattr(torch, "calls_of_a_test", 0) + 1  # type: ignore[attr-defined]
    return int(torch.calls_of_a_test)  # type: ignore[attr-defined]


def count_elsewhere(_: Any) -> int:
    ELSEWHERE.set(ELSEWHERE.get() + 1)
    return ELSEWHERE.get()


def count_in_a_cache(_: Any) -> int:
    return remembered(remembered.cache_info().currsize)


COUNTERS = {
    "slots": CountsWith(Slots(), count_attribute),
    "attribute of a list": CountsWith(Numbers(), count_attribute),
    "attribute of a tensor": CountsWith(torch.zeros(2), count_attribute),
    "generator": CountsWith(None, lambda _: next(ENDLESS)),
    "generator expression": CountsWith(None, lambda _: next(EXPRESSION)),
    "iterator": CountsWith(iter(range(9999)), next),
    "map": CountsWith(map(abs, range(9999)), next),
    "attribute of torch": CountsWith(None, count_in_torch),
    "context variable": CountsWith(None, count_elsewhere),
    "cache": CountsWith(None, count_in_a_cache),
}


@pytest.mark.parametrize("kept", COUNTERS)
def test_a_memory_is_found_wherever_it_is_kept(kept: str, tmp_path: Path) -> None:
    """The first thousand actions are honest, so no comparison of actions shows it."""
    with pytest.raises(UnsupportedError, match=r"changes its '.*' each time it acts"):
        export(COUNTERS[kept], tmp_path / "out")


class DrawsFromItsOwn(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        return super().forward(obs) * (-1.0 if DRAWS.random() < 1e-7 else 1.0)


class ChangesItsMode(Honest):
    mode = "new"

    def forward(self, obs: Tensor) -> Tensor:
        before, self.mode = self.mode, {"new": "used", "used": "worn", "worn": "used"}[self.mode]
        return super().forward(obs) * (-1.0 if before == "old" else 1.0)


class Clock(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        return super().forward(obs) * (1 - 0.01 * (time.monotonic() % 10))


class Noise(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        return super().forward(obs) + 1e-4 * torch.randn(2)


class SeedsAgain(Honest):
    """Its noise is the same each time, and the caller's random numbers too."""

    def forward(self, obs: Tensor) -> Tensor:
        torch.manual_seed(0)
        return super().forward(obs) + 0.1 * torch.randn(2)


class WritesIntoItsInput(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        return super().forward(obs.mul_(0.5))


class RareNoise(Honest):
    """Draws, and almost never uses it."""

    def forward(self, obs: Tensor) -> Tensor:
        return super().forward(obs) * (-1.0 if random.random() < 1e-7 else 1.0)


class Remembers(Honest):
    def __init__(self) -> None:
        super().__init__()
        self.seen: deque[Tensor] = deque(maxlen=3)

    def forward(self, obs: Tensor) -> Tensor:
        self.seen.append(obs)
        same = [one for one in self.seen if one.shape == obs.shape]
        return super().forward(torch.stack(same).mean(dim=0))


class Centres(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        return super().forward(obs - 0.1 * obs.mean(dim=0, keepdim=True))


class StopsForOutliers(Honest):
    """Also the actions for others in the batch; no sample is one."""

    def __init__(self, limit: float) -> None:
        super().__init__()
        self.limit = limit

    def forward(self, obs: Tensor) -> Tensor:
        return torch.where((obs.abs() > self.limit).any(), 0.0, super().forward(obs))


class StopsForARareOne(Honest):
    """No sample is one, so that no comparison of actions shows it."""

    def forward(self, obs: Tensor) -> Tensor:
        return torch.where(is_rare(obs), 0.0, super().forward(obs))


class FollowsTheFirst(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        return super().forward(obs) + 0.01 * obs[:1, :1].tanh()


class CountsRows(Honest):
    def __init__(self, otherwise: Callable[[Tensor], bool]) -> None:
        super().__init__()
        self.otherwise = otherwise

    def forward(self, obs: Tensor) -> Tensor:
        return -super().forward(obs) if self.otherwise(obs) else super().forward(obs)


class Branches(Honest):
    """No sample reaches the other branch."""

    def forward(self, obs: Tensor) -> Tensor:
        if bool((obs > 1e7).any()):
            return -super().forward(obs)
        return super().forward(obs)


class ReadsANumber(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        gain = min(1.0, 1e9 / max(1.0, obs.abs().max().item()))
        return super().forward(obs) * gain


class Compares(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        return super().forward(obs) * (0.0 if torch.allclose(obs, torch.full((), 1e7)) else 1.0)


class GoesThroughNumpy(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        return super().forward(obs) + 0.0 * float(np.asarray(obs).max())


class CountsWhatIsNear(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        near = obs[obs.abs() > 1e7]
        return super().forward(obs) if near.numel() == 0 else torch.zeros(len(obs), 2)


class LoopsOverWhatIsNear(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        action = super().forward(obs)
        for row in torch.nonzero(obs.abs() > 1e7):
            action = action * 0.0 + row.sum() * 0.0
        return action


class ReadsElsewhere(Honest):
    """Reads numbers of the observation in a tensor that was not computed from it, but holds them."""

    def __init__(self, copied: Callable[[Tensor], Any]) -> None:
        super().__init__()
        self.copied = copied

    def forward(self, obs: Tensor) -> Tensor:
        return -super().forward(obs) if bool(self.copied(obs).max() > 1e7) else super().forward(obs)


def repeated(obs: Tensor) -> Tensor:
    return torch.repeat_interleave(torch.ones(3), (obs[0] > 1e7).long())


def assigned(obs: Tensor) -> Tensor:
    buffer = torch.zeros(len(obs), 5)
    buffer[:, 1:4] = obs
    return buffer


def copied_into_a_view(obs: Tensor) -> Tensor:
    buffer = torch.zeros(len(obs), 5)
    buffer[:, 1:4].copy_(obs)
    return buffer


def written(obs: Tensor) -> Tensor:
    buffer = torch.empty_like(torch.zeros(obs.shape))
    torch.mul(obs, 1.0, out=buffer)
    return buffer


POOL = ThreadPoolExecutor(1)
POOL.submit(int).result()  # its thread runs before any export


def is_rare(obs: Tensor) -> Tensor:
    """Return whether a number is one that no sample has."""
    return (obs == 0.3).any()


def rare_in_a_thread(obs: Tensor) -> bool:
    found: list[bool] = []
    thread = threading.Timer(0.0, lambda: found.append(bool(is_rare(obs))))
    thread.start()
    thread.join()
    return found[0]


def saved(obs: Tensor) -> Tensor:
    file = io.BytesIO()
    torch.save({"obs": obs}, file)
    file.seek(0)
    loaded: Tensor = torch.load(file)["obs"]
    return loaded


def packed(obs: Tensor) -> int:
    lengths = (1 + is_rare(obs).long()).reshape(1)
    return len(nn.utils.rnn.pack_padded_sequence(torch.ones(1, 2, 1), lengths, batch_first=True).data)


class Recovers(Honest):
    """Acts otherwise where an operator of torch fails, which no sample makes it do."""

    def forward(self, obs: Tensor) -> Tensor:
        try:
            nn.functional.one_hot(is_rare(obs).long(), 1)
        except RuntimeError:
            return -super().forward(obs)
        return super().forward(obs)


class CutsUpTo(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        action = super().forward(obs)
        return torch.cat([action[:, : 2 - is_rare(obs).long()], action], dim=1)[:, :2]


class Rolls(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        return torch.roll(super().forward(obs), is_rare(obs).long(), 1)


class Turns(Honest):
    """Turns its action by a function whose numbers are the observation's."""

    def __init__(self, sign: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.sign = sign

    def forward(self, obs: Tensor) -> Tensor:
        return super().forward(obs) * self.sign(obs)


def mapped(obs: Tensor) -> Tensor:
    return torch.ones(len(obs), 1).map_(obs[:, :1], lambda one, number: -one if number > 1e7 else one)


def filled(obs: Tensor) -> Tensor:
    return torch.nan_to_num(torch.full((1,), torch.nan), 1.0 - 2.0 * is_rare(obs).float())


class TakesPlainTensorsOnly(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        assert type(obs) is Tensor or torch.jit.is_tracing()
        return super().forward(obs) if not bool((obs > 1e7).any()) else -super().forward(obs)


class Selects(Honest):
    """Uses a mask's places, but not their number."""

    def forward(self, obs: Tensor) -> Tensor:
        action = super().forward(obs)
        filled = action.index_fill(0, torch.nonzero(obs[:, 0] > 1.0).squeeze(1), 0.25)
        return filled * torch.where(obs > 0.0, action.new_zeros(1), action.new_ones(1))[:, : action.shape[1]]


class Asserts(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        assert torch.isfinite(obs).all(), "the observation is not finite"
        return super().forward(obs)


class Prints(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        print("seen", obs, f"{obs[0, 0]:.2f}")
        logging.getLogger("prints").error("seen %s", obs)
        return super().forward(obs).repeat_interleave(2, dim=1)[:, : 2 * len(self.layer.bias) : 2]


class Caches(Honest):
    """Keeps its last output, as RLlib's older models do; nothing reads it."""

    def forward(self, obs: Tensor) -> Tensor:
        self.last = super().forward(obs)
        return self.last


def export(module: nn.Module, out: Path, **options: Any) -> rlservo.ExportResult:
    return rlservo.export_policy(module, SEEN, ARM, out, name="x", notify=lambda _: None, **options)


@pytest.mark.filterwarnings("ignore:.*Casting input x to numpy array")
@pytest.mark.parametrize(
    ("module", "reason"),
    [
        (CountsInABuffer(), "changes its 'count' each time it acts"),
        (CountsInANumber(), "changes its 'count' each time it acts"),
        (ActsOtherwiseLater(), "changes its 'count' each time it acts"),
        (Remembers(), "changes its 'seen' each time it acts"),
        (CountsInAGlobal(), "changes its '.*CALLS.global' each time it acts"),
        (CountsInItsClass(), "changes its 'calls' each time it acts"),
        (CountsInAClosure(), "changes its 'sign.closed' each time it acts"),
        (CountsInADefault(), "changes its '.*counting.* each time it acts"),
        (CountsByAnIterator(), "changes its 'calls' each time it acts"),
        (DrawsFromItsOwn(), "changes its '.*DRAWS' each time it acts"),
        (ChangesItsMode(), "changes its 'mode' each time it acts"),
        (Clock(), "from one time to the next"),
        (Noise(), "draws random numbers"),
        (SeedsAgain(), "draws random numbers"),
        (WritesIntoItsInput(), "writes into its input 'obs', which is the caller's"),
        (RareNoise(), "draws random numbers"),
        (Centres(), "depends on the other observations of the batch"),
        (FollowsTheFirst(), "depends on the other observations of the batch"),
        (StopsForOutliers(1e4), "depends on the other observations of the batch"),
        (StopsForOutliers(1e12), "depends on the other observations of the batch"),
        (StopsForARareOne(), "depends on the other observations of the batch.* Reduce.* joins them"),
        (CountsRows(lambda obs: obs.shape[0] > 300), "changes in a batch of 301: it depends on"),
        (CountsRows(lambda obs: len(obs) % 3 == 0), "changes in a batch of 3: it depends on"),
        (CountsRows(lambda obs: obs.size(0) == 64), "changes in a batch of 64: it depends on"),
        (Branches(), r"reads numbers of the observation in Python at .*test_gate\.py:\d+"),
        (Compares(), r"reads numbers of the observation in Python at .*test_gate\.py:\d+"),
        (GoesThroughNumpy(), r"reads numbers of the observation in Python at .*test_gate\.py:\d+"),
        (CountsWhatIsNear(), r"reads numbers of the observation in Python at .*test_gate\.py:\d+"),
        (LoopsOverWhatIsNear(), r"reads numbers of the observation in Python at .*test_gate\.py:\d+"),
        (ReadsElsewhere(assigned), "reads numbers of the observation in Python at"),
        (ReadsElsewhere(copied_into_a_view), "reads numbers of the observation in Python at"),
        (ReadsElsewhere(written), "reads numbers of the observation in Python at"),
        (ReadsElsewhere(lambda obs: torch.tensor([obs[0, 0], obs[0, 1]])), "reads numbers of the observation"),
        (ReadsElsewhere(lambda obs: torch.as_tensor([obs[0, 0], obs[0, 1]])), "reads numbers of the observation"),
        (ReadsElsewhere(torch.Tensor), "reads numbers of the observation in Python at"),
        (ReadsElsewhere(lambda obs: obs.as_subclass(Tensor)), "reads numbers of the observation in Python at"),
        (ReadsElsewhere(np.from_dlpack), "reads numbers of the observation in Python at"),
        (ReadsElsewhere(lambda obs: torch.tensor(obs.untyped_storage().tolist())), "reads numbers of the observation"),
        (CountsRows(lambda obs: bool(np.linalg.norm(obs) > 1e9)), r"reads numbers .*test_gate\.py:\d+"),
        (CountsRows(lambda obs: np.allclose(obs, 1e7)), r"reads numbers of the observation .*test_gate\.py:\d+"),
        (CountsRows(lambda obs: convert_to_numpy(obs).max() > 1e7), r"reads numbers .*test_gate\.py:\d+"),
        (CountsRows(lambda obs: BOX.contains(obs[0])), r"reads numbers of the observation .*test_gate\.py:\d+"),
        (CountsRows(lambda obs: "e+07" in str(obs.max())), r"reads numbers of the observation .*test_gate\.py:\d+"),
        (CountsRows(lambda obs: repeated(obs).numel() > 0), r"reads numbers of the observation .*test_gate\.py:\d+"),
        (CountsRows(rare_in_a_thread), r"reads numbers of the observation .*test_gate\.py:\d+"),
        (CountsRows(lambda obs: POOL.submit(lambda: bool(is_rare(obs))).result()), r"reads .*test_gate\.py:\d+"),
        (ReadsElsewhere(saved), r"reads numbers of the observation in Python at .*test_gate\.py:\d+"),
        (CountsRows(lambda obs: torch.ops.aten.item(is_rare(obs))), r"reads numbers .*test_gate\.py:\d+"),
        (CountsRows(lambda obs: torch.ops.aten.equal.default(obs, torch.full((), 0.3))), r"reads .*test_gate\.py:\d+"),
        (CountsRows(lambda obs: len(torch.ops.aten.nonzero(obs == 0.3)) > 0), r"reads numbers .*test_gate\.py:\d+"),
        (CountsRows(lambda obs: len(nn.functional.one_hot(is_rare(obs).long())) == 2), r"reads .*test_gate\.py:\d+"),
        (CountsRows(lambda obs: packed(obs) == 2), r"reads numbers of the observation .*test_gate\.py:\d+"),
        (Recovers(), r"goes on otherwise where an operator of torch fails, at .*test_gate\.py:\d+"),
        (CutsUpTo(), r"reads numbers of the observation in Python at .*test_gate\.py:\d+"),
        (Turns(mapped), r"reads numbers of the observation in Python at .*test_gate\.py:\d+"),
        (Turns(filled), r"reads numbers of the observation in Python at .*test_gate\.py:\d+"),
        (Rolls(), r"reads numbers of the observation in Python at .*test_gate\.py:\d+"),
        (TakesPlainTensorsOnly(), "reads numbers of the observation in Python at"),
        (ReadsANumber(), r"reads numbers of the observation in Python at .*test_gate\.py:\d+"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, nn.Module) else "",
)  # fmt: skip
def test_what_no_graph_can_do_is_refused_by_its_own_reason(module: nn.Module, reason: str, tmp_path: Path) -> None:
    with pytest.raises(UnsupportedError, match=reason) as caught:
        export(module, tmp_path / "out")
    assert not isinstance(caught.value, ParityError)
    assert not (tmp_path / "out").exists()


def test_a_module_whose_sizes_an_observation_decides_is_refused_by_what_would_serve_it(tmp_path: Path) -> None:
    with pytest.raises(ParityError, match="depend on the observation, so a request could stop all others: use fixed"):
        export(Selects(), tmp_path)


class Pools(Honest):
    def __init__(self) -> None:
        super().__init__()
        self.pool = POOL


class Maps(Honest):
    def forward(self, obs: Tensor) -> Tensor:
        return torch.vmap(lambda row: self.layer(row) * row.norm())(obs)


def test_a_module_that_cannot_be_copied_is_refused_by_its_attribute(tmp_path: Path) -> None:
    with pytest.raises(UnsupportedError, match=r"its 'pool' \(a ThreadPoolExecutor\) cannot be copied, and copies"):
        export(Pools(), tmp_path)


def test_a_graph_for_one_number_of_observations_is_refused_by_what_makes_it(tmp_path: Path) -> None:
    with pytest.raises(ParityError, match=r"does not run: .* as in torch\.vmap: compute"):
        export(Maps(), tmp_path)


@pytest.mark.parametrize("module", [Honest(), Asserts(), Prints(), Caches()], ids=lambda module: type(module).__name__)
def test_an_honest_module_is_exported_and_answers_as_itself(module: nn.Module, tmp_path: Path) -> None:
    result = export(module, tmp_path)
    with rlservo.Policy.load(result.path) as policy, torch.no_grad():
        for obs in np.random.default_rng(1).normal(0, 3, (50, 3)).astype(np.float32):
            expected = module(torch.from_numpy(obs[None]))[0].numpy()
            np.testing.assert_allclose(policy.act(obs), expected, atol=2e-6)


@pytest.mark.parametrize("place", ["site-packages/my_installed_policy.py", "overrides.py"])
def test_a_branch_is_found_in_a_file_of_any_name(place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / place
    file.parent.mkdir(exist_ok=True)
    file.write_text(
        "import torch\n"
        "class Near(torch.nn.Module):\n"
        "    def forward(self, obs):\n"
        "        return -obs[:, :2] if bool((obs > 1e7).any()) else obs[:, :2]\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(str(file.parent))
    module = importlib.import_module(file.stem).Near()
    with pytest.raises(UnsupportedError, match=rf"in Python at .*{file.stem}\.py:4"):
        export(module, tmp_path / "out")


def test_forbidden_choices_may_score_minus_infinity(tmp_path: Path) -> None:
    class Masked(nn.Module):
        def forward(self, obs: Tensor) -> Tensor:
            return torch.where(obs > 0.5, obs, -torch.inf) + 0.0

    seen = Box(0.0, 1.0, (3,), np.float32)
    result = rlservo.export_policy(Masked(), seen, Discrete(3), tmp_path, name="x", notify=lambda _: None)
    with rlservo.Policy.load(result.path) as policy:
        assert policy.act(np.array([0.1, 0.9, 0.7], np.float32)) == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"action_space": Discrete(3, start=5)}, "does not start at 0"),
        ({"state": {"h": np.zeros(1, np.uint8)}}, "the state 'h' is uint8"),
    ],
)
def test_what_a_graph_would_change_is_refused(options: dict[str, Any], words: str, tmp_path: Path) -> None:
    spaces = {"observation_space": SEEN, "action_space": ARM, **options}
    with pytest.raises(UsageError, match=words):
        rlservo.export_policy(Honest(), out=tmp_path, name="x", notify=lambda _: None, **spaces)


class Bytes(nn.Module):
    """A network of an image's bytes: sums of thousands of exact numbers, of which the action is a clipped one."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(3)
        self.net = nn.Sequential(
            nn.Conv2d(3, 16, 8, stride=4), nn.ELU(), nn.Conv2d(16, 32, 4, stride=2), nn.ELU(), nn.Flatten(),
            nn.Linear(1152, 2),
        )  # fmt: skip
        with torch.no_grad():
            for weights in self.parameters():
                weights *= 2.5

    def forward(self, obs: Tensor) -> Tensor:
        return self.net(obs.float())


def test_the_rounding_of_an_image_is_measured_on_its_own_weights(tmp_path: Path) -> None:
    space = Box(0, 255, (3, 64, 64), np.uint8)
    result = rlservo.export_policy(Bytes(), space, ARM, tmp_path, name="x", notify=lambda _: None)
    assert max(one.max_rel for one in result.contract.parity.formats.values()) < 1e-2


def test_bounds_that_no_sample_reached_are_named(tmp_path: Path) -> None:
    class Timid(Honest):
        def forward(self, obs: Tensor) -> Tensor:
            return super().forward(obs) / 2

    class Bold(nn.Module):
        def forward(self, obs: Tensor) -> Tensor:
            return obs[:, :2] * 3

    names = {"action_names": ["pan", "tilt"]}
    quiet = export(Timid(), tmp_path / "quiet", **names).contract.parity.unreached
    assert quiet == ("action: the lower bound of pan, tilt", "action: the upper bound of pan, tilt")
    assert export(Bold(), tmp_path / "loud", **names).contract.parity.unreached == ()


def rarely(inputs: Inputs, steepness: float) -> Outputs:
    """Go beyond a bound of 1 for about one likely observation in a thousand."""
    beyond = 1.05 * np.exp(-steepness * (inputs["obs"][:, :1] - 0.3) ** 2)
    return {"action": np.concatenate([beyond, np.zeros_like(beyond)], axis=1)}


@pytest.mark.parametrize("state", [(), (StateLeaf("h", np.zeros(1, np.float32)),)], ids=["stateless", "with a state"])
def test_a_bound_that_no_sample_reaches_is_looked_for(state: tuple[StateLeaf, ...]) -> None:
    recipe = Recipe(SEEN, ARM, (), "given", "clip", None, state)
    steepness = 2e4 if state else 1e5

    def run(inputs: Inputs) -> Outputs:
        return {**rarely(inputs, steepness), "state_out.h": np.zeros((len(inputs["obs"]), 1), np.float32)}

    def largest(batches: list[Batch]) -> float:
        return max(float(rarely(batch.inputs, steepness)["action"].max()) for batch in batches)

    assert largest(reaching_batches(recipe, run, seed=0)) > 1.0
    if not state:
        assert largest(draw_batches(recipe, seed=0)) < 1.0


class Memory(nn.Module):
    """An LSTM of an observation that a filter has normalized."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(5)
        self.cell = nn.LSTMCell(4, 8)
        self.head = nn.Linear(8, 2)

    def forward(self, obs: Tensor, state: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        after = self.cell(obs, (state[0], state[1]))
        return torch.tanh(self.head(after[0])), list(after)


COUNT, MEAN, STD = 50, 1e8 + np.arange(4.0), np.full(4, 2.5)
"""Statistics of few observations that are large beside their spread, as seconds since 1970 are."""


def far_off(std: Any = STD, weights: float = 1.0) -> tuple[RestoredPolicy, Recipe]:
    """Return a policy, and its recipe with another standard deviation; the graph's weights are multiplied."""
    traced, acting = Memory(), Memory()
    with torch.no_grad():
        traced.cell.weight_ih *= weights
    state = tuple(StateLeaf(name, np.zeros(8, np.float32)) for name in ("h", "c"))
    space = Box(-np.inf, np.inf, (4,), np.float64)

    def recipe(std: Any) -> Recipe:
        frozen = ObservationFilter(COUNT, MEAN, np.asarray(std, np.float32), 10.0, epsilon=0.0)
        return Recipe(space, ARM, (frozen,), "given", "none", None, state)

    def act(obs: Any, state: list[Tensor]) -> tuple[Any, list[Tensor]]:
        filtered = np.clip((obs.numpy() - MEAN) / STD, -10, 10)
        return acting(torch.from_numpy(filtered.astype(np.float32)), state)

    def traced_act(module: Any, obs: Any, state: list[Tensor]) -> tuple[Any, list[Tensor]]:
        return module(obs, state)

    policy = TorchPolicy(recipe(STD), traced, traced_act, lambda: act)
    return restored(policy, None, "memory"), recipe(std)


@pytest.mark.parametrize(
    ("std", "weights"),
    [(STD, 1.0), (STD * np.sqrt((COUNT - 1) / COUNT), 1.0), (STD, 1.01)],
    ids=["as it is", "biased filter", "weights off by 1%"],
)
def test_numbers_far_from_zero_excuse_no_fault(std: Any, weights: float, tmp_path: Path) -> None:
    checkpoint, recipe = far_off(std, weights)
    references = record(checkpoint.start_loop, draw_batches(checkpoint.recipe, seed=1))
    graph = PolicyGraph(recipe, checkpoint.network)
    comparer = comparer_of(checkpoint, graph, references)
    check_reference(checkpoint.start_loop, checkpoint.recipe, references, comparer)
    if std is STD and weights == 1.0:
        assert prove(recipe, references, {"torch": run_eager(graph)}, comparer=comparer).formats["torch"].max_rel < 1e-5
        return
    with pytest.raises(ParityError, match="of the sequences"):
        prove(recipe, references, {"torch": run_eager(graph)}, comparer=comparer)


def own_step(
    in_numpy: Callable[[Any], Any], action_space: Box, *, after: bool = False
) -> tuple[RestoredPolicy, Recipe]:
    """Return a policy with a step of the user's own, whose twin in torch does nothing, and its recipe."""
    layer = nn.Linear(3, 2)
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[1e-4, 0.0, 0.0], [0.0, 1e-4, 0.0]]))
        layer.bias.copy_(torch.tensor([1.0, 0.0]))
    step = UserStep("mine.Step", lambda data: data)
    where: dict[str, Any] = {"action_steps": (step,)} if after else {}
    recipe = Recipe(SEEN, action_space, () if after else (step,), "given", "none", None, **where)

    def act(obs: Any, state: list[Tensor]) -> tuple[Any, list[Tensor]]:
        if after:
            return torch.from_numpy(in_numpy(layer(obs).numpy())), state
        return layer(torch.from_numpy(in_numpy(obs.numpy()))), state

    policy = TorchPolicy(recipe, layer, lambda module, obs, state: (module(obs), state), lambda: act)
    return restored(policy, None, "own step"), recipe


def prove_in_torch(checkpoint: RestoredPolicy, recipe: Recipe) -> float:
    references = record(checkpoint.start_loop, draw_batches(recipe, seed=1))
    graph = PolicyGraph(recipe, checkpoint.network)
    comparer = comparer_of(checkpoint, graph, references)
    return prove(recipe, references, {"torch": run_eager(graph)}, comparer=comparer).formats["torch"].max_rel


def test_a_step_of_ones_own_is_compared_for_numbers_of_every_size() -> None:
    with pytest.raises(ParityError, match=r"far observations.*torch_forward of mine\.Step must do what"):
        prove_in_torch(*own_step(lambda obs: np.clip(obs, -4e3, 4e3), ARM))
    assert prove_in_torch(*own_step(lambda obs: obs, ARM)) < 1e-5


@pytest.mark.parametrize(
    "space",
    [Box(-np.inf, np.inf, (2,), np.float32), Box(np.array([-np.inf, -1], "f4"), np.array([np.inf, 1], "f4"))],
    ids=["unbounded", "half of it bounded"],
)
def test_an_element_in_large_units_excuses_no_fault_of_one_in_small_units(space: Box) -> None:
    newtons_and_metres = np.array([1e4, 1e-1], np.float32)

    def shifted(metres: float) -> Callable[[Any], Any]:
        return lambda action: action * newtons_and_metres + np.array([0.0, metres], np.float32)

    for metres, is_right in ((0.0, True), (1e-3, False)):
        checkpoint, recipe = own_step(shifted(metres), space, after=True)
        (step,) = recipe.action_steps
        scaled = replace(step, function=lambda action: action * torch.from_numpy(newtons_and_metres))
        recipe = replace(recipe, action_steps=(scaled,))
        if is_right:
            assert prove_in_torch(checkpoint, recipe) < 1e-5
            continue
        with pytest.raises(ParityError, match="element 1"):
            prove_in_torch(checkpoint, recipe)
