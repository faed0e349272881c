"""Learning from served robots: eight UR5 arms over HTTP, their policy half trained, with injected faults.

    python examples/train_shipped.py ur5_positioning --set stop.metric=success --set stop.value=0.5   # half trained
    python benchmarks/learn_online.py runs/ur5_positioning/checkpoint --minutes 30
    python benchmarks/learn_online.py --disturb payload=5,latency=10 --canary --no-faults --every 5      # adaptation

Every robot is a process of its own that acts at eight times its control rate, or as fast as the server answers; the
last one is a ur5e with a real arm's noise. `rlservo serve` records, `rlservo learn` learns. It ends when 95 of the
robots' last 100 episodes (as they explore) succeed, or when the time is over. Faults: a robot killed, the learner
killed, the server restarted, and episodes that must not be learned from (NaN, an end that another key claims, another
graph's). With `--disturb` all robots are disturbed, and the first and the last version are compared over `--seeds`
episodes without exploration. Without CHECKPOINT it begins with the shipped ur5_positioning. Figures, log and plot are
written to bench/learn_online.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import yaml

import rlservo
from rlservo import errors
from rlservo.drive.disturbance import disturb_env, parse_disturbance
from rlservo.serve_app.server.api_keys import new_key

ENV = "rlservo.envs:rlservo/EndEffectorPositioningURSim-v0"
NAME, ALIAS = "ur5", "learning"
ROBOTS, SPEED = 8, 8.0
CONTROL_RATE_HZ = 10.0  # the environment's
WINDOW, GOAL = 100, 0.95
LEARNING_RATE = 1.5e-4  # of the adaptation
SHIPPED = Path(__file__).resolve().parent.parent / "examples/checkpoints/ur5_positioning"
RLSERVO = [sys.executable, "-m", "rlservo.deploy.cli"]


# A robot.


def make_env(model: str, disturbance: str | None) -> gymnasium.Env[Any, Any]:
    env = gymnasium.make(ENV, disable_env_checker=True, ur_model=model, rs_state_to_info=False, randomize_start=True)
    return env if disturbance is None else disturb_env(env, parse_disturbance(disturbance))


def drive(url: str, log: Path, seed: int, model: str, disturbance: str | None, version: str | None) -> None:
    """Act episode after episode, exploring, until the process is ended; write a line for each episode."""
    env = make_env(model, disturbance)
    period = 1.0 / (CONTROL_RATE_HZ * SPEED)
    key = os.environ["ROBOT_KEY"]
    policy = rlservo.PolicyClient(url, NAME, version=version, api_key=key, timeout_s=20, label=f"robot-{seed}")
    with log.open("a", buffering=1) as file:
        while True:
            try:
                obs, info = env.reset(seed=seed)
                policy.reset()
                total, steps, ended, status = 0.0, 0, False, None
                due = time.monotonic()
                while not ended:
                    action = policy.act(obs, explore=True)
                    due = max(due + period, time.monotonic())
                    time.sleep(max(0.0, due - time.monotonic()))
                    obs, reward, terminated, truncated, info = env.step(action)
                    total, steps, ended = total + float(reward), steps + 1, terminated or truncated
                    status = str(info.get("final_status") or "ended") if ended else None
                    policy.outcome(
                        float(reward), terminated=terminated, truncated=truncated, final_status=status,
                        final_obs=obs if ended else None,
                    )  # fmt: skip
                line = {
                    "at": time.time(), "version": policy.contract.version, "steps": steps, "return": total,
                    "success": status == "success",
                }  # fmt: skip
                file.write(json.dumps(line) + "\n")
            except errors.RlservoError as error:  # the server restarts: the arm waits until it is back
                print(f"robot {seed}: {error}", flush=True)
                time.sleep(1.0)
            seed += ROBOTS


# The cell: a server, a learner and robots as processes.


@dataclass
class Cell:
    """All processes of the demonstration, in one folder; they end with it."""

    folder: Path
    checkpoint: Path
    minutes: float
    every: int
    disturbance: str | None
    with_canary: bool
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    events: list[tuple[float, str]] = field(default_factory=list)
    began: float = field(default_factory=time.time)

    def __post_init__(self) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        robot, line = new_key("robots", explore=True)
        other, other_line = new_key("other", explore=False)
        admin, admin_line = new_key("learner", admin=True)
        self.folder.mkdir(parents=True)
        (self.folder / "keys").write_text("\n".join((line, other_line, admin_line)) + "\n")
        (self.folder / "keys").chmod(0o600)
        self.robot_key, self.other_key = robot, other
        self._env = {
            **os.environ, "RLSERVO_API_KEYS_FILE": str(self.folder / "keys"), "RLSERVO_ADMIN_KEY": admin,
            "ROBOT_KEY": robot, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MUJOCO_GL": "disabled",
        }  # fmt: skip

    def start(self, name: str, command: list[str]) -> None:
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(command, stdout=log, stderr=log, env=self._env)

    def start_server(self) -> None:
        self.start("server", [*RLSERVO, "serve", self.path("policies"), "--record", self.path("recorded"),
                              "--port", str(self.port)])  # fmt: skip
        self.wait(self.is_ready, "the server")

    def start_learner(self) -> None:
        more = ["--promote", "90s", "--canary", "50%", "--max-success-drop", "10%"] if self.with_canary else []
        self.start("learner", [*RLSERVO, "learn", str(self.checkpoint), "--policy", NAME, "--server", self.url,
                               "--repository", self.path("policies"), "--follow", self.url, "--every", str(self.every),
                               "--alias", ALIAS, "--out", self.path("run"), *more])  # fmt: skip

    def start_robot(self, index: int) -> None:
        model, own = ("ur5e", "noise=real") if index == ROBOTS - 1 and self.disturbance is None else ("ur5", None)
        disturbed = self.disturbance or own
        self.start(f"robot{index}", [sys.executable, __file__, "--robot", self.url, self.path(f"robot{index}.jsonl"),
                                     str(index + 100_000 * len(self.events)), model, disturbed or "",
                                     "" if self.with_canary else ALIAS])  # fmt: skip

    def end(self, name: str, number: int) -> None:
        self.processes[name].send_signal(number)
        self.processes[name].wait(60)

    def note(self, what: str) -> None:
        self.events.append((time.time() - self.began, what))
        print(f"{self.events[-1][0]:7.0f} s  {what}", flush=True)

    def path(self, name: str) -> str:
        return str(self.folder / name)

    def is_ready(self) -> bool:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1):
            return True
        return False

    def wait(self, condition: Callable[[], bool], what: str, limit_s: float = 600.0) -> None:
        deadline = time.monotonic() + limit_s
        while not condition():
            dead = [name for name, process in self.processes.items() if process.poll() is not None]
            if dead or time.monotonic() > deadline:
                raise SystemExit(f"waited for {what}: {dead or 'time is over'}; see {self.folder}/*.log")
            time.sleep(1.0)

    def close(self) -> None:
        for process in self.processes.values():
            with contextlib.suppress(ProcessLookupError):
                process.terminate()  # a shell lets its background jobs ignore Ctrl-C
        for process in self.processes.values():
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def state(self) -> dict[str, Any]:
        with contextlib.suppress(OSError, ValueError):
            state: dict[str, Any] = json.loads((self.folder / "run" / "learn.json").read_text())
            return state
        return {}

    def episodes(self) -> list[dict[str, Any]]:
        """Return the episodes that robots noted, in the order of their ends."""
        lines: list[dict[str, Any]] = []
        for path in self.folder.glob("robot*.jsonl"):
            for text in path.read_text().splitlines():
                with contextlib.suppress(ValueError):  # the last line of a robot that was killed
                    lines.append(json.loads(text))
        return sorted(lines, key=lambda line: line["at"])


def poison(cell: Cell) -> None:
    """Report episodes that must not be learned from, and put another graph's recording beside the server's own."""
    newest = cell.state()["versions"][-1]["version"]

    def ask(key: str, label: str, **more: Any) -> None:
        request = urllib.request.Request(
            f"{cell.url}/v1/policies/{NAME}/versions/{newest}/act",
            data=json.dumps({"obs": [0.0] * 27, **more}).encode(),
            headers={"content-type": "application/json", "authorization": f"Bearer {key}", "x-session-id": label},
        )
        with contextlib.suppress(urllib.error.HTTPError), urllib.request.urlopen(request, timeout=20) as reply:
            reply.read()

    for label, reward, reporter in (("nan", float("nan"), cell.robot_key), ("claimed", 0.0, cell.other_key)):
        ask(cell.robot_key, label, explore=True)
        ask(cell.robot_key, label, explore=True, reward=reward)  # NaN is not JSON: the request is refused
        ask(reporter, label, final_status="success", **({} if reward else {"reward": 1e6}))
    rollout = [*RLSERVO, "rollout", ENV.partition(":")[2], "--bundle", cell.path(f"foreign/{NAME}/{newest}")]
    export = [*RLSERVO, "export", str(SHIPPED), "--name", NAME, "--version", newest, "--out", cell.path("foreign")]
    for command in (export, [*rollout, "--explore", "--episodes", "2", "--record", cell.path("foreign.mcap")]):
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    there = next(Path(cell.path("recorded")).glob("*.mcap"))
    shutil.copy2(cell.path("foreign.mcap"), there.with_name(f"{there.stem[:-6]}999999.mcap"))


def faults(cell: Cell) -> Iterator[tuple[float, Callable[[], None]]]:
    """Yield each fault and the share of the time at which it happens."""

    def kill_a_robot() -> None:
        cell.end("robot3", signal.SIGKILL)
        cell.note("robot 3 killed in its episode, and started again")
        cell.start_robot(3)

    def kill_the_learner() -> None:
        cell.end("learner", signal.SIGKILL)
        cell.note("the learner killed, and started again with the same command")
        cell.start_learner()

    def restart_the_server() -> None:
        cell.end("server", signal.SIGTERM)
        cell.note("the server stopped and started again")
        cell.start_server()

    def poisoned() -> None:
        cell.note("episodes with NaN rewards, with an end that another key claims, and of another graph")
        poison(cell)

    yield from ((0.15, poisoned), (0.3, kill_a_robot), (0.45, kill_the_learner), (0.6, restart_the_server))


def run(cell: Cell, with_faults: bool) -> dict[str, Any]:
    export = [*RLSERVO, "export", str(cell.checkpoint), "--name", NAME]
    subprocess.run([*export, "--out", cell.path("policies")], check=True, stdout=subprocess.DEVNULL)
    cell.start_server()
    cell.start_learner()
    first = cell.folder / "run" / "learn.json"
    cell.wait(lambda: first.exists() and bool(cell.state().get("versions")), "the first version")
    time.sleep(5.0)  # the alias is moved after it is noted
    for index in range(ROBOTS):
        cell.start_robot(index)
    cell.began = time.time()
    todo = collections.deque(faults(cell) if with_faults else ())
    reached, shown = None, 0.0
    while (elapsed := time.time() - cell.began) < 60 * cell.minutes and reached is None:
        if todo and elapsed >= 60 * cell.minutes * todo[0][0]:
            todo.popleft()[1]()
        time.sleep(2.0)
        done = cell.episodes()
        recent = [line["success"] for line in done[-WINDOW:]]
        share = float(np.mean(recent)) if recent else 0.0
        if elapsed - shown > 30:
            shown = elapsed
            state = cell.state()
            print(
                f"{elapsed:7.0f} s  steps {sum(line['steps'] for line in done):>8,}  episodes {len(done):>6,}  "
                f"success of the last {len(recent)} {share:6.1%}  updates {state.get('updates', 0)}  "
                f"versions {len(state.get('versions', []))}",
                flush=True,
            )
        if not todo and len(recent) == WINDOW and share >= GOAL and cell.disturbance is None:
            reached = elapsed
        dead = [name for name, process in cell.processes.items() if process.poll() is not None]
        if dead:
            raise SystemExit(f"{dead} ended: see {cell.folder}/*.log")
    return figures(cell, reached)


def figures(cell: Cell, reached: float | None) -> dict[str, Any]:
    done, state = cell.episodes(), cell.state()
    success = [bool(line["success"]) for line in done]
    first = next((i + 1 for i in range(WINDOW, len(done) + 1) if sum(success[i - WINDOW : i]) >= GOAL * WINDOW), None)
    return {
        "minutes": (time.time() - cell.began) / 60,
        "episodes": len(done),
        "steps": sum(line["steps"] for line in done),
        "reached_goal": reached is not None or first is not None,
        "steps_to_goal": None if first is None else sum(line["steps"] for line in done[: first - 1]),
        "first_success": sum(success[:WINDOW]) / WINDOW,
        "last_success": sum(success[-WINDOW:]) / WINDOW,
        "updates": state.get("updates"),
        "steps_learned_from": state.get("steps"),
        "dropped": state.get("dropped"),
        "refused": state.get("refused"),
        "versions": [known["version"] for known in state.get("versions", [])],
        "events": cell.events,
    }


def plot(cell: Cell, result: dict[str, Any]) -> None:
    """Draw success of the last 100 episodes and the versions that acted, over time."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    done = cell.episodes()
    at = [(line["at"] - cell.began) / 60 for line in done]
    success = np.convolve([line["success"] for line in done], np.ones(WINDOW) / WINDOW, "valid") * 100
    figure, left = pyplot.subplots(figsize=(6, 3), layout="constrained")
    if len(done) >= WINDOW:
        left.plot(at[WINDOW - 1 :], success, color="tab:orange", linewidth=1.2)
    left.set_xlabel("time [min]")
    left.set_ylabel(f"success of the last {WINDOW} episodes [%]")
    left.set_ylim(0, 102)
    right = left.twinx()
    right.plot(at, [int(line["version"]) for line in done], ".", color="tab:blue", markersize=1.5)
    right.set_ylabel("version that acted", color="tab:blue")
    for seconds, what in result["events"]:
        left.axvline(seconds / 60, color="grey", linewidth=0.7, linestyle=":")
        left.text(seconds / 60, 3, what.partition(",")[0][:40], rotation=90, fontsize=5, color="grey")
    figure.savefig(cell.folder / "learn_online.png", dpi=110)
    pyplot.close(figure)


def whole_checkpoint(folder: Path) -> Path:
    """Return a checkpoint of the shipped policy that can be trained: its weights after an iteration without change.

    The learner continues with the checkpoint's settings, so the learning rate rises after that iteration.
    """
    settings = yaml.safe_load((SHIPPED / "training.yaml").read_text())
    settings |= {"begin": {"with": SHIPPED.name}, "stop": {**settings["stop"], "env_steps": 1, "episodes": 1}}
    settings["training"] |= {"lr": [[0, 1e-7], [10_000, 1e-7], [10_001, LEARNING_RATE], [1e9, LEARNING_RATE]]}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "settings.yaml").write_text(yaml.safe_dump(settings))
    script = SHIPPED.parent.parent / "train_shipped.py"
    command = [sys.executable, str(script), SHIPPED.name, "--settings", str(folder / "settings.yaml")]
    subprocess.run([*command, "--storage", str(folder)], check=True)
    return folder / SHIPPED.name / "checkpoint"


def verdicts(cell: Cell) -> dict[str, str]:
    found = {}
    for path in sorted((cell.folder / "run" / "promotions").glob("*.jsonl"), key=lambda path: int(path.stem)):
        ends = [entry for entry in map(json.loads, path.read_text().splitlines()) if entry["event"] == "end"]
        found[path.stem] = ": ".join(ends[-1]["decided"][:2]) if ends else "not finished"
    return found


def compare(cell: Cell, seeds: int) -> dict[str, Any]:
    """Return the results of the first and last version, without exploration, on the same seeds that no robot saw.

    With canaries the last version is the last one that was promoted.
    """
    wins: dict[str, list[bool]] = {}
    refused = {version for version, verdict in verdicts(cell).items() if not verdict.startswith("promoted")}
    versions = [known["version"] for known in cell.state()["versions"] if known["version"] not in refused]
    for version in (versions[0], versions[-1]):
        with rlservo.Policy.load(cell.folder / "policies" / NAME / version) as policy:
            env, wins[version] = make_env("ur5", cell.disturbance), []
            for seed in range(seeds):
                obs, info = env.reset(seed=5_000_000 + seed)
                policy.reset()
                ended = False
                while not ended:
                    obs, _, terminated, truncated, info = env.step(policy.act(obs))
                    ended = terminated or truncated
                wins[version].append(info.get("final_status") == "success")
            env.close()
    before, after = wins[versions[0]], wins[versions[-1]]
    pairs = list(zip(before, after, strict=True))
    return {
        "episodes": seeds, "versions": [versions[0], versions[-1]], "before": sum(before), "after": sum(after),
        "won": sum(b > a for a, b in pairs), "lost": sum(b < a for a, b in pairs),
    }  # fmt: skip


def main() -> None:
    if sys.argv[1:2] == ["--robot"]:
        url, log, seed, model, disturbance, version = sys.argv[2:]
        drive(url, Path(log), int(seed), model, disturbance or None, version or None)
        return
    parser = argparse.ArgumentParser(description="Learn from eight served UR5 simulators.")
    parser.add_argument("checkpoint", type=Path, nargs="?", help="whole checkpoint of train_shipped.py")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--every", type=int, default=1, help="updates between two versions")
    parser.add_argument("--disturb", help="of all robots, say payload=3,latency=4")
    parser.add_argument("--canary", action="store_true", help="promote versions by a canary instead of an alias")
    parser.add_argument("--seeds", type=int, default=500, help="episodes before and after, with --disturb")
    parser.add_argument("--no-faults", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("bench/learn_online"))
    args = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the cell's processes end with this one
    checkpoint = args.checkpoint or whole_checkpoint(args.out.with_name(f"{args.out.name}_start"))
    cell = Cell(args.out, checkpoint, args.minutes, args.every, args.disturb, args.canary)
    try:
        result = run(cell, not args.no_faults)
    finally:
        cell.close()
    if args.disturb:
        result |= {"comparison": compare(cell, args.seeds), "canary": verdicts(cell)}
    (args.out / "learn_online.json").write_text(json.dumps(result, indent=1))
    plot(cell, result)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
