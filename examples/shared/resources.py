"""Resources of a training run: impossible requests are refused before anything starts, and waits are reported.

RLlib's processes are bundles of CPUs and GPUs, each of which must fit one machine. Ray waits indefinitely and silently
for those that fit nowhere (ray 2.60).
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import shared.ray_settings as ray_settings  # before Ray  # isort: skip
import ray
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.util import placement_group_table

from rlservo import errors

assert ray_settings
Bundle = Mapping[str, float]  # resource -> amount, of one process
SAID_AFTER_S, SAID_AGAIN_S, POLL_S = 10.0, 60.0, 1.0
# Set if Ray's autoscaler, its cluster launcher or KubeRay started a node: more may come.
NODE_GROUP = "ray.io/node-group"
ROUNDING = 1e-6


@dataclass(frozen=True)
class Room:
    """The machines that a run may use."""

    name: str  # in sentences: "this machine", "the cluster at ..."
    nodes: tuple[Bundle, ...]
    grows: bool = False  # an autoscaler may add nodes

    def total(self, resource: str) -> float:
        return sum(node.get(resource, 0.0) for node in self.nodes)


def ray_room(name: str) -> Room:
    """Return the room of the Ray that this process is connected to."""
    nodes = [node for node in ray.nodes() if node["Alive"]]
    return Room(
        name, tuple(node["Resources"] for node in nodes), any(NODE_GROUP in node.get("Labels", {}) for node in nodes)
    )


def request_of(config: AlgorithmConfig) -> list[dict[str, float]]:
    """Return the bundles of one trial: driver and learner first, then env runners, evaluation's, learners'.

    Raises UsageError for invalid amounts.
    """
    try:
        factory = cast(Any, config.algo_class).default_resource_request(config.copy(copy_frozen=False))
    except (TypeError, ValueError) as error:
        raise errors.UsageError(f"RLlib does not understand the requested resources: {error}") from error
    bundles = [{name: float(amount) for name, amount in bundle.items() if amount} for bundle in factory.bundles]
    if factory.strategy == "STRICT_PACK":
        return [{name: _total(bundles, name) for bundle in bundles for name in bundle}]
    return bundles


def size(request: Sequence[Bundle]) -> tuple[float, float]:
    """Return the CPUs and GPUs of a request."""
    return _total(request, "CPU"), _total(request, "GPU")


def check_room(
    request: Sequence[Bundle], room: Room, *, config: AlgorithmConfig | None = None, concurrent: int | None = None
) -> None:
    """Raise UsageError when a trial, or `concurrent` of them at once, cannot ever run there.

    `config` is the request's: with it the message has a number of env runners that fits. A cluster that may grow is not
    judged by what it has now; `waiting_is_said` reports what the run waits for.
    """
    if room.grows:
        return
    for name in sorted({name for bundle in request for name in bundle}):
        if _total(request, name) > room.total(name) + ROUNDING:
            raise errors.UsageError(
                f"{_amount(name, _total(request, name))} asked for ({_listing(request)}); {room.name} has "
                f"{_amount(name, room.total(name))}: {_advice(request, room, name, config)}"
            )
    fitting = _fitting(request, room, 1 if concurrent is None else concurrent)
    if fitting == 0:
        machines = ", ".join(_bundle({name: node.get(name, 0.0) for name in ("CPU", "GPU")}) for node in room.nodes)
        raise errors.UsageError(
            f"{_listing(request)} asked for, each on one machine; the machines of {room.name} have {machines}: ask for "
            "fewer or smaller processes"
        )
    if concurrent is not None and fitting < concurrent:
        raise errors.UsageError(
            f"{concurrent} trials at once asked for, each of {_listing(request)}; {room.name} has room for {fitting}: "
            "leave --max-concurrent-trials out, and as many run as fit"
        )


def _fitting(request: Sequence[Bundle], room: Room, at_most: int) -> int:
    """Return how many such requests fit at once, the largest bundles first: Ray packs no better."""
    free = [dict(node) for node in room.nodes]
    bundles = sorted(request, key=lambda bundle: (bundle.get("GPU", 0.0), sum(bundle.values())), reverse=True)
    for count in range(at_most):
        for bundle in bundles:
            for node in free:
                if all(amount <= node.get(name, 0.0) + ROUNDING for name, amount in bundle.items()):
                    node.update({name: node[name] - amount for name, amount in bundle.items()})
                    break
            else:
                return count
    return at_most


def _advice(request: Sequence[Bundle], room: Room, name: str, config: AlgorithmConfig | None) -> str:
    if config is None:
        return "resume on a machine that has as many, or start a new run"
    if name == "GPU":
        return "leave --num-gpus out to learn on the CPU"
    each: object = config.num_cpus_per_env_runner
    if not isinstance(each, int | float):
        return "leave out the values that ask for so many"  # it is swept
    rest = _total(request, name) - each * (config.num_env_runners or 0)
    if name != "CPU" or not each or rest > room.total(name) + ROUNDING:
        return "ask for fewer learners or evaluation runners, or for less in each process"
    return f"give --num-cpus {int((room.total(name) - rest + ROUNDING) / each)}"


def _total(bundles: Sequence[Bundle], name: str) -> float:
    return sum(bundle.get(name, 0.0) for bundle in bundles)


def _amount(name: str, amount: float) -> str:
    return f"{amount:g} {name}{'s' if name in ('CPU', 'GPU') and amount != 1 else ''}"


def _bundle(bundle: Bundle) -> str:
    return " and ".join(_amount(name, amount) for name, amount in bundle.items() if amount) or "0 CPUs"


def _listing(request: Sequence[Bundle]) -> str:
    """Return the bundles in words, equal ones together: `1 process with 1 CPU, 8 with 0.5 CPUs each`."""
    parts: list[str] = []
    for words, count in Counter(_bundle(bundle) for bundle in request).items():
        process = "process" + "es" * (count > 1) if not parts else ""
        parts.append(" ".join(filter(None, (str(count), process, "with", words, "each" * (count > 1)))))
    return ", ".join(parts)


@contextlib.contextmanager
def waiting_is_said() -> Iterator[None]:
    """Print a line when trials of this process have waited 10 s for resources, and again while none runs."""
    done = threading.Event()
    watcher = threading.Thread(target=_watch, args=(done,), name="watch-resources", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join(timeout=5.0)


def _watch(done: threading.Event) -> None:
    job = ray.get_runtime_context().get_job_id()
    since: dict[str, float] = {}  # placement group -> when it was first seen waiting
    printed_at: dict[str, float] = {}  # line -> when it was printed
    while not done.wait(POLL_S):
        try:
            # A group's id ends with its job's id; other jobs' groups are not ours to report.
            ours = {key: group for key, group in placement_group_table().items() if key.endswith(job)}
            pending = {key for key, group in ours.items() if group["state"] in ("PENDING", "RESCHEDULING")}
            now = time.monotonic()
            since = {key: since.get(key, now) for key in pending}
            long = [key for key in pending if now - since[key] >= SAID_AFTER_S]
            if not long:
                continue
            runs = any(group["state"] == "CREATED" for group in ours.values())
            line = _waiting_line(list(ours[long[0]]["bundles"].values()))
        except Exception:  # Ray is shutting down, or its head is unreachable: the training reports it
            continue
        if line not in printed_at or (not runs and now - printed_at[line] >= SAID_AGAIN_S):
            printed_at[line] = now
            print(line, file=sys.stderr, flush=True)


def _waiting_line(bundles: Sequence[Bundle]) -> str:
    total, free = ray.cluster_resources(), ray.available_resources()
    names = sorted({name for bundle in bundles for name in bundle})
    amounts = " and ".join(_amount(name, _total(bundles, name)) for name in names)
    there = " and ".join(
        f"{_amount(name, total.get(name, 0.0))}, {free.get(name, 0.0):g} of them free" for name in names
    )
    return f"waiting for {amounts} ({_listing(bundles)}): the cluster has {there}; Ctrl-C stops"
