"""Blocks of commands in the documents: found, run in order as printed, or checked where they cannot run."""

from __future__ import annotations

import functools
import os
import pty
import re
import shlex
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import typer

from rlservo.deploy.cli import app
from servers import free_ports
from trainings import OneRay

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
TUTORIAL = ROOT / "docs" / "tutorial" / "first-robot.md"
HOW_TO = ROOT / "docs" / "how-to"
BLOCK = re.compile(
    r"^(<!-- not run: [^\n]+ -->\n)?( *)(?:<!-- not run: ([^\n]+) -->\n *)?```(\w+)\n(.*?)^ *```$", re.M | re.S
)
STAYS = re.compile(  # until Ctrl-C
    r"^(?:\w+=\S+ )*(?:(?=serve run)|rlservo )"
    r"(serve|cockpit|server-manager|robot-server|ur-controller|ros2-sim|ros2|learn|policy promote)\b(?!.*&\s*$)"
)
BEGUN = {
    "serve": "Ctrl-C|Submitted deploy config",
    "learn": "loaded after 0 updates",
    "policy promote": "watching version",
    "ros2": " -> stopped",
}
"""What such a command prints when it has begun; the others invite to press Ctrl-C."""
RAY_GAVE_UP = "The current node timed out during startup"  # on a busy machine, after its 30 s (ray 2.60): tried again
WATCHDOG = "the controller's watchdog (no command for 0.1 s)"  # on a busy machine: begun again, once
QUESTION = "[y/N] "
NOT_HERE = re.compile(r"^(pip install|make) ")  # tests/test_wheel.py installs, tests/system/test_demo.py makes
PORTS = ("8000", "8080", "8090", "6379", "9090", "50051")
PATIENCE_S = 300.0


@dataclass
class Block:
    """A block of a document."""

    language: str
    text: str
    reason: str = ""
    """Why it is not run; empty for one that is."""


def pages() -> list[Path]:
    """Return the documents whose blocks are run: README, tutorial and how-to guides."""
    return [README, *sorted((ROOT / "docs").glob("tutorial/*.md")), *sorted(HOW_TO.glob("*.md"))]


def blocks(page: Path) -> list[Block]:
    """Return the blocks of a page in order."""
    found = []
    for outer, _, inner, language, text in BLOCK.findall(page.read_text(encoding="utf-8")):
        reason = inner or re.sub(r"^<!-- not run: | -->\n$", "", outer)
        found.append(Block(language, textwrap.dedent(text), reason))
    return found


def commands(text: str) -> list[str]:
    """Return a block's lines, those that continue one joined."""
    return [line for line in re.sub(r"\\\n\s*", "", text).splitlines() if line and not line.startswith("#")]


@functools.cache
def command_line() -> Any:
    """Return the definition of `rlservo`, which takes a while to make of its functions."""
    return typer.main.get_command(app)


def unknown_options(line: str) -> list[str]:
    """Return what `rlservo` does not know of a line's words, by its own definition of the command."""
    words = line.split("#")[0].split()
    command = command_line()
    for word in words[1:]:
        part = getattr(command, "commands", {}).get(word)
        if part is None:
            break
        command = part
    if hasattr(command, "commands"):
        return words[1:2]
    known = {name for each in command.params for name in (*each.opts, *each.secondary_opts)}
    return [word for word in words if word.startswith("--") and word.partition("=")[0] not in known]


@dataclass
class Shell:
    """A folder that looks like the checkout, in which the blocks of a page run."""

    folder: Path
    machine: tuple[str, ...] = ()
    """The words that run a command on a machine of its own (`namespaces.own_machine`)."""
    one_ray: OneRay | None = None
    """Runs Python blocks, scripts of `examples/` and exports: to import RLlib takes longer than most of them."""
    ports: dict[str, str] = field(init=False)
    """Free ports for the printed ones, which are free on a machine of its own."""
    terminals: dict[subprocess.Popen[bytes], int] = field(default_factory=dict)
    """The keyboard of each process that was started."""
    staying: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)
    """Commands that run until Ctrl-C, each in a terminal of its own: one of a kind."""

    def __post_init__(self) -> None:
        ports = PORTS if self.machine else free_ports(len(PORTS))
        self.ports = dict(zip(PORTS, map(str, ports), strict=True))
        self.runtime.mkdir()
        self.variables.touch()

    def run(self, block: Block) -> str:
        """Run a block; return its output. Its last command may stay: it is waited for until it has begun."""
        if block.language == "python":
            (self.folder / "block.py").write_text(self._with_ports(block.text))
            line = f"python {self.folder / 'block.py'}"
            return self._run_in_one_ray(line) if self.one_ray else self._finish(line)
        lines = re.sub(r" *\\\n *", " ", block.text).splitlines(keepends=True)
        stays = STAYS.match(lines[-1]) if lines else None
        done = lines[:-1] if stays else lines
        assert not any(map(STAYS.match, done)), f"pasted, the first command keeps the terminal:\n{block.text}"
        out = ""
        for shared, part in groupby(done, self._is_for_one_ray):
            script = "".join(line for line in part if not NOT_HERE.match(line))
            out += "".join(map(self._run_in_one_ray, script.splitlines())) if shared else self._finish(script)
        if stays:
            self._stay(stays[1], lines[-1].partition(" #")[0].strip())
        return out

    def stop(self) -> None:
        """End what the blocks have started and left running."""
        with ExitStack() as ends:  # of all, even if one does not end as it should
            for started in self.terminals:
                ends.callback(self._end, started)
            self._press_ctrl_c(*self.staying)

    def _stay(self, kind: str, line: str) -> None:
        if kind in self.staying:
            kinds = list(self.staying)  # what began after a server or robot may use it; nothing uses a cockpit
            self._press_ctrl_c(*([kind] if kind == "cockpit" else kinds[kinds.index(kind) :]))
        if kind in ("serve", "cockpit") and not self.machine:
            line += f" --port {self.ports['8000' if kind == 'serve' else '8090']}"
        script = f". {self.variables}\nexec env {line}"
        started = self.staying[kind] = self._start(script, kind)
        deadline = time.monotonic() + PATIENCE_S
        while not re.search(BEGUN.get(kind, "Ctrl-C"), printed := self._printed(kind)):
            if started.poll() is not None:
                assert RAY_GAVE_UP in printed, printed
                self._wait(started)
                started = self.staying[kind] = self._start(script, kind)
            assert time.monotonic() < deadline, f"{line} has not begun:\n{printed}"
            time.sleep(0.1)

    def _press_ctrl_c(self, *kinds: str) -> None:
        for kind in reversed(kinds):  # a server or robot goes after what uses it
            started = self.staying.pop(kind)
            assert started.poll() is None, self._printed(kind)
            os.killpg(started.pid, signal.SIGINT)
            code = self._wait(started)
            assert code in (0, 130), f"{kind} ended with {code}:\n{self._printed(kind)}"

    def _end(self, started: subprocess.Popen[bytes]) -> None:
        if started in self.terminals:
            with suppress(ProcessLookupError):
                os.killpg(started.pid, signal.SIGTERM)
            self._wait(started)

    def _wait(self, started: subprocess.Popen[bytes]) -> int:
        try:
            return started.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            os.killpg(started.pid, signal.SIGKILL)
            started.wait()
            raise
        finally:
            os.close(self.terminals.pop(started))

    def _finish(self, script: str, *, is_again: bool = False) -> str:
        """Run a script to its end, and answer what it asks."""
        if not script.strip():
            return ""
        kept = f". {self.variables}\ntrap 'export -p > {self.variables}' EXIT\n"
        started = self._start(f"set -e\n{kept}{script}", "output")
        deadline, answered = time.monotonic() + PATIENCE_S, 0
        while started.poll() is None:
            if self._printed("output").count(QUESTION) > answered:
                answered += 1
                os.write(self.terminals[started], b"y\n")
            assert time.monotonic() < deadline, f"{script}\n{self._printed('output')}"
            with suppress(subprocess.TimeoutExpired):
                started.wait(0.1)
        if self.machine and started.returncode and RAY_GAVE_UP in self._printed("output"):
            return self._finish(f"ray stop --force\n{script}")
        if self.machine and started.returncode and WATCHDOG in self._printed("output") and not is_again:
            return self._finish(script, is_again=True)
        assert started.returncode == 0, f"{script}\n{self._printed('output')}"
        return self._printed("output")

    def _is_for_one_ray(self, line: str) -> bool:
        return self.one_ray is not None and line.startswith(("python examples/", "rlservo export "))

    def _run_in_one_ray(self, line: str) -> str:
        assert self.one_ray is not None
        command = re.sub("^rlservo ", f"python {Path(sys.executable).with_name('rlservo')} ", line)
        _python, script, *arguments = shlex.split(command, comments=True)
        ended = self.one_ray.run(self.folder, script.removeprefix("examples/"), *arguments).ended
        assert ended.code == 0, f"{line}\n{ended.out}{ended.err}"
        return ended.out

    def _printed(self, name: str) -> str:
        return (self.folder / f"{name}.txt").read_text(errors="replace")

    @property
    def runtime(self) -> Path:
        """A folder of its own: a folder `rlservo` beside a script would hide an editable install's package."""
        return self.folder / "runtime"

    @property
    def variables(self) -> Path:
        """What the blocks have exported so far, as a script."""
        return self.runtime / "variables"

    def _start(self, script: str, output: str) -> subprocess.Popen[bytes]:
        environment = os.environ | {
            "PATH": f"{self.folder / 'bin'}:{Path(sys.executable).parent}:{os.environ['PATH']}",
            "HOME": str(self.folder),
            "XDG_RUNTIME_DIR": str(self.runtime),
            "RAY_USAGE_STATS_ENABLED": "0",  # `ray start` asks, and waits for ten seconds
            "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "60",  # after 5 Serve kills a HAProxy that is not ready yet
            "RLSERVO_URL": f"http://127.0.0.1:{self.ports['8000']}",
        }
        keyboard, terminal = pty.openpty()  # no bash: it would take it over, and hang up on what it leaves running
        with (self.folder / f"{output}.txt").open("wb") as file:
            started = subprocess.Popen(
                [*self.machine, "sh", "-c", self._with_ports(script)],
                cwd=self.folder, env=environment, stdin=terminal, stdout=file, stderr=subprocess.STDOUT,
                start_new_session=True,
            )  # fmt: skip
        os.close(terminal)
        self.terminals[started] = keyboard
        return started

    def _with_ports(self, text: str) -> str:
        for printed, ours in self.ports.items():
            text = re.sub(rf"(127\.0\.0\.1:|http\.server |port ){printed}\b", rf"\g<1>{ours}", text)
        return text


@contextmanager
def shell(folder: Path, machine: tuple[str, ...] = (), one_ray: OneRay | None = None) -> Iterator[Shell]:
    """Make a checkout's look-alike in a folder; what was started there is ended."""
    for name in ("examples", "deploy"):
        (folder / name).symlink_to(ROOT / name)
    (folder / ".venv").symlink_to(sys.prefix)
    opened = Shell(folder, machine, one_ray)
    try:
        yield opened
    finally:
        opened.stop()


def ran(
    page: Path,
    folder: Path,
    machine: tuple[str, ...] = (),
    one_ray: OneRay | None = None,
    *,
    before: str = "",
    after: str = "",
) -> str:
    """Run a page's blocks between commands that stand for what the reader has and does; return what all printed."""
    with shell(folder, machine, one_ray) as opened:
        printed = [block for block in blocks(page) if block.language in ("sh", "python") and not block.reason]
        return "".join(map(opened.run, (Block("sh", before), *printed, Block("sh", after))))
