"""For which networks micro-batching pays: 16 robots at once, each observation by itself against those there together.

    python benchmarks/batching.py             # about eight minutes; needs wrk
    python benchmarks/batching.py --no-serve  # the networks alone, half a minute

Policies of growing size, made by RLlib (untrained: the numbers in the weights cost the same) and exported. First
onnxruntime alone, one thread, in this process: 16 runs of one observation against one run of 16. Then each policy
behind `rlservo serve`, twice, without and with `micro_batch`: requests per second over 16 connections, and the median
of one connection, which a wait for others would show in. The two servers of a policy take turns; medians of the rounds,
and the ratio of the two. Written to `bench/batching.json`.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import re
import secrets
import statistics
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

# Said before Ray is imported, so that it holds for every process of the cluster that is started here.
os.environ.setdefault("RAY_AUTH_MODE", "token")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

import gymnasium as gym
import httpx
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from rlservo.export.commands.export import export_checkpoint
from rlservo.export.contract.bundle import ONNX_FILE, Bundle, load_bundle
from rlservo.export.contract.ort_session import open_ort_session
from rlservo.serve_app.ray_serve.ports import free_ports
from speed.loads import wrk
from speed.servers import Exchange, Server, running

ROBOTS = 16
NETWORKS: dict[str, dict[str, Any]] = {
    "27-256-256-6": {"fcnet_hiddens": [256, 256]},
    "27-1024-1024-6": {"fcnet_hiddens": [1024, 1024]},
    "27-2048-2048-6": {"fcnet_hiddens": [2048, 2048]},
    "CNN on 84x84x4": {"conv_filters": [[16, 8, 4], [32, 4, 2], [64, 3, 1]], "head_fcnet_hiddens": [256]},
}


class Anything(gym.Env[NDArray[Any], NDArray[np.float32]]):
    """Spaces for RLlib to build a network for; nobody steps it."""

    def __init__(self, config: dict[str, Any]) -> None:
        self.observation_space = (
            Box(0.0, 1.0, (84, 84, 4), np.float32) if config["image"] else Box(-1.0, 1.0, (27,), np.float32)
        )
        self.action_space = Box(-1.0, 1.0, (6,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[NDArray[Any], Any]:
        super().reset(seed=seed, options=options)
        return np.zeros(self.observation_space.shape or (), self.observation_space.dtype), {}

    def step(self, action: NDArray[np.float32]) -> Any:
        raise NotImplementedError


@dataclass(frozen=True)
class Alone:
    """onnxruntime in this process, one thread."""

    one_ms: float
    sixteen_ms: float  # one run of 16

    @property
    def gain(self) -> float:
        """How many times less the 16 cost together."""
        return ROBOTS * self.one_ms / self.sixteen_ms


@dataclass(frozen=True)
class Served:
    """A server over HTTP; medians of the rounds."""

    per_s: float  # requests per second, 16 connections
    one_ms: float  # median over one connection
    together: float  # observations in a run, as the server counted them; 1 where it does not gather


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--no-serve", action="store_true", help="onnxruntime alone")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=int, default=4, help="of each measurement")
    parser.add_argument("--out", type=Path, default=Path("bench"))
    args = parser.parse_args()
    console = Console(width=120)
    table = Table(title=f"Micro-batching, {ROBOTS} robots")
    for column in (
        "network",
        "1 run",
        f"{ROBOTS} in a run",
        "saved",
        "served singly",
        "together",
        "gain",
        "in a run",
        "p50 of one",
    ):
        table.add_column(column, justify="right")
    results: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="rlservo-") as name:
        folder = Path(name)
        for network, bundle in made(folder).items():
            console.print(f"{network} ...")
            alone = measure_alone(bundle)
            results[network] = {"alone": asdict(alone)}
            cells = [f"{alone.one_ms:.3f} ms", f"{alone.sixteen_ms:.3f} ms", f"{alone.gain:.1f}x"]
            if not args.no_serve:
                singly, together = measure_served(bundle, folder, args.rounds, args.seconds)
                results[network] |= {"singly": asdict(singly), "together": asdict(together)}
                cells += [f"{singly.per_s:,.0f}/s", f"{together.per_s:,.0f}/s", f"{together.per_s / singly.per_s:.2f}"]
                cells += [f"{together.together:.1f}", f"{together.one_ms / singly.one_ms:.2f}"]
            table.add_row(network, *cells)
            args.out.mkdir(parents=True, exist_ok=True)
            (args.out / "batching.json").write_text(json.dumps(results, indent=2) + "\n")
    console.print(table)


def made(folder: Path) -> dict[str, Bundle]:
    """Build the policies with RLlib and export them; Ray has ended when this returns."""
    import ray
    from ray.rllib.algorithms.ppo import PPOConfig

    bundles: dict[str, Bundle] = {}
    ray.init("local", num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    try:
        for number, (network, model) in enumerate(NETWORKS.items()):
            config = PPOConfig().environment(Anything, env_config={"image": "conv_filters" in model})
            config.env_runners(num_env_runners=0).rl_module(model_config={"vf_share_layers": False, **model})
            algorithm = config.debugging(log_level="ERROR").build_algo()
            checkpoint = folder / f"checkpoint{number}"
            algorithm.save_to_path(str(checkpoint))
            algorithm.stop()
            exported = export_checkpoint(checkpoint, folder, name=f"net{number}", notify=quiet)
            bundles[network] = load_bundle(exported.path)
    finally:
        ray.shutdown()
    return bundles


def quiet(_line: str) -> None:
    """Take what the export says."""


def measure_alone(bundle: Bundle) -> Alone:
    """Take turns, so that a busy moment meets both."""
    session = open_ort_session(bundle.path / ONNX_FILE, 1)
    recorded, _ = bundle.golden()
    one = {name: array[:1] for name, array in recorded.items()}
    sixteen = {name: np.resize(array, (ROBOTS, *array.shape[1:])) for name, array in recorded.items()}
    taken: dict[int, list[float]] = {1: [], ROBOTS: []}
    for _ in range(300):
        for number, feed in ((1, one), (ROBOTS, sixteen)):
            began = time.perf_counter()
            session.run(["action"], feed)
            taken[number].append((time.perf_counter() - began) * 1e3)
    return Alone(statistics.median(taken[1]), statistics.median(taken[ROBOTS]))


def measure_served(bundle: Bundle, folder: Path, rounds: int, seconds: int) -> tuple[Served, Served]:
    """Serve the policy without and with micro-batching, in turns."""
    exchange = asked(bundle)
    loads: dict[int, tuple[list[float], ...]] = {0: ([], [], []), ROBOTS: ([], [], [])}
    mark = secrets.token_hex(8)
    for turn in range(rounds):
        for most in sorted(loads, reverse=turn % 2 == 1):
            rates, medians, sizes = loads[most]
            (port,) = free_ports(1)
            command = [sys.executable, "-m", "rlservo.deploy.cli", "serve", str(bundle.path), "--port", str(port)]
            options = {"RLSERVO_POLICY_OPTIONS": json.dumps({"*": {"micro_batch": most}})}
            with running(Server(f"micro_batch {most}", command, port, exchange, options), folder, mark):
                wrk(port, exchange, folder, connections=ROBOTS, seconds=1)
                rates.append(wrk(port, exchange, folder, connections=ROBOTS, seconds=seconds).per_s)
                sizes.append(gathered(port))
                medians.append(wrk(port, exchange, folder, connections=1, seconds=seconds).p50_ms)
    singly, together = (Served(*map(statistics.median, measured)) for measured in loads.values())
    return singly, together


def gathered(port: int) -> float:
    """Return how many observations a run of the network had so far, on average."""
    told = httpx.get(f"http://127.0.0.1:{port}/metrics").text
    counts = re.findall(r"^rlservo_micro_batch_(runs|observations)_total{.*} (.*)$", told, re.MULTILINE)
    sums = {what: sum(float(value) for name, value in counts if name == what) for what in ("runs", "observations")}
    return sums["observations"] / sums["runs"] if sums["runs"] else 1.0


def asked(bundle: Bundle) -> Exchange:
    """One observation as the Open Inference Protocol's binary form has it: parsing numbers would hide the network."""
    obs = bundle.golden()[0]["obs"][:1]
    tensor = {
        "name": "obs", "shape": list(obs.shape), "datatype": "FP32",
        "parameters": {"binary_data_size": obs.nbytes},
    }  # fmt: skip
    outputs = [{"name": "action", "parameters": {"binary_data": True}}]
    head = json.dumps({"inputs": [tensor], "outputs": outputs}).encode()
    headers = (("Content-Type", "application/octet-stream"), ("Inference-Header-Content-Length", str(len(head))))
    return Exchange("POST", f"/v2/models/{bundle.contract.name}/infer", head + obs.tobytes(), headers)


if __name__ == "__main__":
    main()
