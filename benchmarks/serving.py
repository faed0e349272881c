"""Serving speed compared with other servers: start, memory, latency, throughput, robots at a fixed rate, WebSocket.

    python benchmarks/serving.py --install     # once: the peers' environments; servers without one are left out
    python benchmarks/serving.py               # six minutes; a second run continues
    python benchmarks/serving.py --publish     # the same, and writes benchmarks/results/serving.md

One server runs at a time. Rounds alternate between all servers, and each is compared with bare uvicorn within one
round: a machine's speed drifts by more than servers differ.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import http.client
import json
import os
import platform
import secrets
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from serving_load import Plan
from serving_peers import BARE, BARE_ON_RAY, MAKERS, OURS, OURS_ON_RAY, Case, MissingError, Peer, case_of, install

ROOT = Path(__file__).resolve().parent.parent
LOAD = Path(__file__).resolve().parent / "serving_load.py"
PUBLISHED = ROOT / "benchmarks" / "results" / "serving.md"
CHECKPOINT = ROOT / "examples" / "checkpoints" / "ur5_positioning_disturbed"
POLICY = "ur5_positioning_disturbed"
MINUTES = 6.0
END_S = 20.0  # [s] for a server to end
QUIET = 0.5  # load average above which the machine counts as busy

Row = dict[str, Any]
# Our goals compared with bare uvicorn: at most, or at least, this ratio.
GOALS = {
    "one.p50": ("1 connection, p50", 1.2),
    "sixteen.per_second": ("16 connections, requests/s", 0.65),
    "robots16.p50": ("16 robots at 50 Hz, p50", 1.0),
    "robots16.p99": ("16 robots at 50 Hz, p99", 1.0),
    "robots16.p999": ("16 robots at 50 Hz, p99.9", 1.0),
    "robots64.p50": ("64 robots at 20 Hz, p50", 1.0),
    "robots64.p99": ("64 robots at 20 Hz, p99", 1.0),
    "robots64.p999": ("64 robots at 20 Hz, p99.9", 1.0),
    "crowd64.p99": ("64 connections, p99", 1.5),
    "stream.p50": ("WebSocket, p50", 1.2),
}
FIRST_ANSWER_S, MEMORY_MB, ADDED_ON_RAY_MS = 1.0, 120.0, 0.15


def measured(name: str, peer: Peer, case: Case, port: int, scale: float) -> Row:
    """Start a server, measure it, end it. Raises RuntimeError."""
    row: Row = {"server": name}
    with started(peer) as server:
        row["first_s"] = wait_for_answer(server, peer, case, port)
        request = base64.b64encode(peer.request(case, port)).decode()
        one = Plan(port, request, 1.0 * scale)
        plans = {
            "one": one,
            "sixteen": replace(one, connections=16),
            "robots16": replace(one, connections=16, rate_hz=50, seconds=3 * scale),
            "robots64": replace(one, connections=64, rate_hz=20, seconds=3 * scale),
            "crowd64": replace(one, connections=64),
        }
        if peer.stream:
            message = base64.b64encode(peer.message).decode()
            plans["stream"] = replace(one, request=message, stream=peer.stream, greets=peer.greets)
        for kind, plan in plans.items():
            row[kind] = under(plan)
        row["rss_mb"], row["pss_mb"] = memory_mb(server.pid)
    return row


@contextlib.contextmanager
def started(peer: Peer) -> Iterator[subprocess.Popen[bytes]]:
    """Start a server in a session of its own, which ends when we do."""
    bound = ["setpriv", "--pdeathsig", "TERM"] if shutil.which("setpriv") else []
    with tempfile.TemporaryFile() as output:
        server = subprocess.Popen(
            [*bound, *peer.command],
            stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True,
            env={**os.environ, **peer.environment}, cwd=tempfile.gettempdir(),
        )  # fmt: skip
        try:
            yield server
        except Exception as error:
            output.seek(0, os.SEEK_END)
            output.seek(max(0, output.tell() - 400))
            raise RuntimeError(f"{error}; its last output: {output.read().decode(errors='replace')}") from error
        finally:
            end(server)


def end(server: subprocess.Popen[bytes]) -> None:
    """End a server and all that it started."""
    family = [server.pid]
    with contextlib.suppress(psutil.Error):
        family += [child.pid for child in psutil.Process(server.pid).children(recursive=True)]
    server.terminate()
    with contextlib.suppress(subprocess.TimeoutExpired):
        server.wait(END_S)
    for pid in family[::-1]:
        with contextlib.suppress(psutil.Error):
            process = psutil.Process(pid)
            if process.ppid() in (1, server.pid, os.getpid()):  # not another process that has reused the number
                process.kill()
    server.wait()


def wait_for_answer(server: subprocess.Popen[bytes], peer: Peer, case: Case, port: int) -> float:
    """Return the seconds until the policy's action arrived. Raises RuntimeError."""
    began = time.perf_counter()
    request = peer.request(case, port)
    head, _, body = request.partition(b"\r\n\r\n")
    path = head.split(b" ")[1].decode()
    answer = b""
    while time.perf_counter() - began < peer.starts_in_s:
        if server.poll() is not None:
            raise RuntimeError(f"it ended with {server.returncode}")
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        with contextlib.suppress(OSError, http.client.HTTPException):
            connection.request("POST", path, body, {"Content-Type": "application/json"})
            reply = connection.getresponse()
            answer = reply.read()
            if reply.status == 200:
                took = time.perf_counter() - began
                check(answer, peer, case)
                return round(took, 3)
        connection.close()
        time.sleep(0.01)
    raise RuntimeError(f"no answer within {peer.starts_in_s:g} s: {answer[:200]!r}")


def check(answer: bytes, peer: Peer, case: Case) -> None:
    """Raise RuntimeError unless this is the policy's action."""
    if not peer.checks:
        return
    document = json.loads(answer)
    action = document["outputs"][0]["data"] if "outputs" in document else document["action"]
    if not np.allclose(np.ravel(action), case.action, rtol=1e-4, atol=1e-5):
        raise RuntimeError(f"it answers {action}, the policy's action is {case.action.tolist()}")


def under(plan: Plan) -> dict[str, float]:
    command = [sys.executable, str(LOAD), json.dumps(asdict(plan))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60 + 4 * plan.seconds)
    if done.returncode != 0:
        raise RuntimeError(f"the load ended with {done.stderr[-300:]}")
    found: dict[str, float] = json.loads(done.stdout)
    if found["failed"] or not found["requests"]:
        raise RuntimeError(f"{found['failed']:g} requests failed, {found['requests']:g} were answered")
    return found


def memory_mb(pid: int) -> tuple[float, float]:
    """Return resident memory of a process and its children, and the same with shared memory divided among them."""
    family = [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
    found = []
    for process in family:
        with contextlib.suppress(psutil.Error):
            found.append(process.memory_full_info())
    return round(sum(each.rss for each in found) / 1e6, 1), round(sum(each.pss for each in found) / 1e6, 1)


def free_port() -> int:
    """Return a port that is free, as is the next one."""
    while True:
        port = 20_000 + secrets.randbelow(10_000)
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            socket.create_server(("127.0.0.1", port + 1)).close()
            return port


def exported(folder: Path) -> Path:
    """Return the folder of the shipped policy, exported once."""
    policies = folder / "policies"
    if not (policies / POLICY / "1").exists():
        # Without the value head: ours would leave it out, and the others would compute it.
        command = [sys.executable, "-m", "rlservo.deploy.cli", "export", str(CHECKPOINT), "--out", str(policies)]
        subprocess.run(
            [*command, "--no-value", "--name", POLICY, "--version", "1"], check=True, stdout=subprocess.DEVNULL
        )
    return policies


def run(case: Case, names: list[str], file: Path, *, scale: float, rounds: int, minutes: float) -> bool:
    """Measure what `file` does not hold yet, until the time is over; return whether all was measured."""
    deadline = time.monotonic() + 60 * minutes
    rows = read(file)
    counts = {name: sum(row["server"] == name for row in rows) for name in names}
    failed: set[str] = set()
    for number in range(rounds):
        for name in names:
            with tempfile.TemporaryDirectory(prefix="b") as folder:
                port = free_port()
                try:
                    peer = MAKERS[name](case, port, Path(folder))
                except MissingError:
                    continue
                if name in failed or number >= peer.rounds or counts[name] > number:
                    continue
                if time.monotonic() > deadline:
                    return False
                print(f"round {number + 1}: {name}", file=sys.stderr, flush=True)
                try:
                    row = measured(name, peer, case, port, scale)
                except (RuntimeError, subprocess.TimeoutExpired) as error:
                    print(f"{name} is left out: {error}", file=sys.stderr)
                    failed.add(name)
                    continue
            with file.open("a") as stream:
                stream.write(json.dumps({**row, "round": number}) + "\n")
    return True


def read(file: Path) -> list[Row]:
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def pick(row: Row, key: str) -> float | None:
    """Return `a.b` of a row."""
    kind, _, what = key.partition(".")
    found = row.get(kind)
    return None if found is None else float(found[what] if what else found)


def median(rows: list[Row], key: str) -> float | None:
    values = [value for row in rows if (value := pick(row, key)) is not None]
    return statistics.median(values) if values else None


def ratio(rows: list[Row], name: str, key: str) -> float | None:
    """Return the median over the rounds of a server's figure divided by bare uvicorn's in the same round."""
    bare = {row["round"]: pick(row, key) for row in rows if row["server"] == BARE}
    found = [
        value / other
        for row in rows
        if row["server"] == name and (value := pick(row, key)) is not None and (other := bare.get(row["round"]))
    ]
    return statistics.median(found) if found else None


def report(rows: list[Row]) -> str:
    """Return the tables, in Markdown."""
    lines = [
        "| server | first | memory | 1 | 16 | 16 x 50 Hz | 64 x 20 Hz | WebSocket | rounds |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in MAKERS:
        own = [row for row in rows if row["server"] == name]
        if not own:
            continue
        cells = [
            name,
            shown(own, "first_s", ".2f"),
            f"{shown(own, 'rss_mb', '.0f')} ({shown(own, 'pss_mb', '.0f')})",
            shown(own, "one.p50", ".3f"),
            shown(own, "sixteen.per_second", ",.0f"),
            *(", ".join(shown(own, f"{kind}.{p}", ".2f") for p in ("p50", "p99", "p999"))
              for kind in ("robots16", "robots64")),
            shown(own, "stream.p50", ".3f"),
            str(len(own)),
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    if ratio(rows, OURS, "one.p50") is None:
        return "\n".join(lines) + "\n"
    lines += [
        "",
        f"`{OURS}` against {BARE}, medians of the ratios within a round:",
        "",
        "| | ratio | goal |",
        "|---|---|---|",
    ]
    for key, (title, goal) in GOALS.items():
        value = ratio(rows, OURS, key)
        side = "at least" if key.endswith("per_second") else "at most"
        lines.append(f"| {title} | {'-' if value is None else f'{value:.2f}'} | {side} {goal:g} |")
    own = [row for row in rows if row["server"] == OURS]
    lines.append(f"| first answer, s | {shown(own, 'first_s', '.2f')} | at most {FIRST_ANSWER_S:g} |")
    lines.append(f"| memory, MB | {shown(own, 'rss_mb', '.0f')} | at most {MEMORY_MB:g} |")
    on_ray, empty = (
        median([row for row in rows if row["server"] == name], "one.p50") for name in (OURS_ON_RAY, BARE_ON_RAY)
    )
    if on_ray is not None and empty is not None:
        lines.append(f"| added on Ray Serve, 1 connection, ms | {on_ray - empty:.3f} | at most {ADDED_ON_RAY_MS:g} |")
    return "\n".join(lines) + "\n"


def shown(rows: list[Row], key: str, form: str) -> str:
    value = median(rows, key)
    return "-" if value is None else format(value, form)


def heading(loads: list[float]) -> str:
    """Return the published page's introduction."""
    busy = f"load average {loads[0]:.1f} before the start"
    text = f"""
        `python benchmarks/serving.py --install`, then `--publish`, on a quiet machine: this page.
        {os.cpu_count()} cores ({processor()}), Python {platform.python_version()}, {busy}; client and server share the
        cores. A request is one observation as JSON, the policy `examples/checkpoints/{POLICY}`. Medians of the rounds:
        the first answer [s], resident memory of all processes [MB] (in brackets with what they share counted once),
        1 connection [ms], 16 connections [requests/s], 16 robots at 50 Hz, 64 at 20 Hz (p50, p99, p99.9 [ms]), a
        WebSocket [ms]. The two peers with "bare" in their name check nothing: they are what serving costs at least."""
    return "# Serving speed\n\n" + textwrap.fill(" ".join(text.split()), 118, break_on_hyphens=False) + "\n\n"


def processor() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.machine()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--install", action="store_true", help="make the peers' environments and exit")
    parser.add_argument(
        "--publish", action="store_true", help=f"write {PUBLISHED.relative_to(ROOT)} when all is measured"
    )
    parser.add_argument("--quick", action="store_true", help="one short round, to see that it works")
    parser.add_argument("--again", action="store_true", help="forget what an earlier run has measured")
    parser.add_argument("--minutes", type=float, default=MINUTES, help="stop after this time; the next run continues")
    parser.add_argument("--only", nargs="+", choices=list(MAKERS), default=list(MAKERS), help="these servers")
    parser.add_argument("--out", type=Path, default=ROOT / "bench", help="folder of the policy and the raw figures")
    given = parser.parse_args()
    if given.install:
        install()
        return
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that servers end
    given.out.mkdir(parents=True, exist_ok=True)
    file = given.out / ("serving-quick.jsonl" if given.quick else "serving.jsonl")
    if given.again or given.quick:
        file.unlink(missing_ok=True)
    loads = list(os.getloadavg())
    if loads[0] > QUIET:
        print(
            f"the load average is {loads[0]:.1f}: figures of a busy machine are not worth publishing", file=sys.stderr
        )
    case = case_of(exported(given.out), POLICY, CHECKPOINT / "learner_group/learner/rl_module/default_policy")
    is_complete = run(
        case, given.only, file, scale=0.2 if given.quick else 1.0, rounds=1 if given.quick else 5, minutes=given.minutes
    )
    tables = report(read(file))
    print(tables)
    if not is_complete:
        print("time is up: run it again to continue", file=sys.stderr)
        sys.exit(2)
    if given.publish:
        PUBLISHED.parent.mkdir(exist_ok=True)
        PUBLISHED.write_text(heading(loads) + tables)
        print(f"written to {PUBLISHED.relative_to(ROOT)}", file=sys.stderr)


if __name__ == "__main__":
    main()
