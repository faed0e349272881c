"""Blocks of commands in the documents: found, run in order as printed, or checked where they cannot run."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import typer

from rlservo.deploy.cli import app
from servers import free_ports

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(
    r"^(<!-- not run: [^\n]+ -->\n)?( *)(?:<!-- not run: ([^\n]+) -->\n *)?```(\w+)\n(.*?)^ *```$", re.M | re.S
)
STAYS = re.compile(r"^(\w+=\S+ )*rlservo (serve|cockpit|server-manager|robot-server)\b")  # until Ctrl-C
NOT_HERE = re.compile(r"^(pip install|make) ")  # tests/test_wheel.py installs, tests/system/test_demo.py makes
PORTS = ("8000", "8080", "8090", "6379")
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
    return [
        ROOT / "README.md",
        *sorted((ROOT / "docs").glob("tutorial/*.md")),
        *sorted((ROOT / "docs").glob("how-to/*.md")),
    ]


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


def unknown_options(line: str) -> list[str]:
    """Return what `rlservo` does not know of a line's words, by its own definition of the command."""
    words = line.split("#")[0].split()
    command: Any = typer.main.get_command(app)
    for word in words[1:]:
        part = getattr(command, "commands", {}).get(word)
        if part is None:
            break
        command = part
    if hasattr(command, "commands"):
        return words[1:2]
    known = {name for each in command.params for name in (*each.opts, *each.secondary_opts)}
    return [word for word in words if word.startswith("--") and word not in known]


@dataclass
class Shell:
    """A folder that looks like the checkout, in which the blocks of a page run."""

    folder: Path
    ports: dict[str, str] = field(
        default_factory=lambda: dict(zip(PORTS, map(str, free_ports(len(PORTS))), strict=True))
    )
    groups: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def run(self, block: Block) -> str:
        """Run a block to its end, or until the server that its last line starts answers; return its output."""
        if block.language == "python":
            (self.folder / "block.py").write_text(self._with_ports(block.text))
            return self._finish("python block.py")
        lines = [line for line in block.text.splitlines(keepends=True) if not NOT_HERE.match(line)]
        if not lines or not STAYS.match(lines[-1]):
            return self._finish("".join(lines))
        self.stop()
        out = self._finish("".join(lines[:-1]))  # what it leaves running, a Redis say, runs beside the server
        port = self.ports["8090" if "cockpit" in lines[-1] else "8000"]
        server = self._start(f"exec env {lines[-1].split('#')[0].strip()} --port {port}", "server")
        deadline = time.monotonic() + PATIENCE_S
        while True:
            with suppress(OSError), socket.create_connection(("127.0.0.1", int(port)), timeout=1.0):
                return out
            assert server.poll() is None, (self.folder / "server").read_text()
            assert time.monotonic() < deadline, lines[-1]
            time.sleep(0.2)

    def stop(self) -> None:
        """End what the blocks have started and left running."""
        for started in self.groups:
            with suppress(ProcessLookupError):
                os.killpg(started.pid, signal.SIGTERM)
            try:
                started.wait(60)
            except subprocess.TimeoutExpired:
                os.killpg(started.pid, signal.SIGKILL)
                started.wait()
                raise
        self.groups.clear()

    def _finish(self, script: str) -> str:
        if not script.strip():
            return ""
        started = self._start("set -e\n" + script, "output")
        code = started.wait(PATIENCE_S)
        output = (self.folder / "output").read_text()
        assert code == 0, f"{script}\n{output}"
        return output

    @property
    def runtime(self) -> Path:
        """A folder of its own: a folder `rlservo` beside a script would hide an editable install's package."""
        return self.folder / "runtime"

    def _start(self, script: str, output: str) -> subprocess.Popen[bytes]:
        environment = os.environ | {
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "HOME": str(self.folder),
            "XDG_RUNTIME_DIR": str(self.runtime),
            "RLSERVO_URL": f"http://127.0.0.1:{self.ports['8000']}",
        }
        with (self.folder / output).open("wb") as file:
            started = subprocess.Popen(
                ["bash", "-c", self._with_ports(script)],
                cwd=self.folder, env=environment, stdout=file, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        self.groups.append(started)
        return started

    def _with_ports(self, text: str) -> str:
        for printed, ours in self.ports.items():
            text = re.sub(rf"(127\.0\.0\.1:|http\.server |--port ){printed}\b", rf"\g<1>{ours}", text)
        return text


@contextmanager
def shell(folder: Path) -> Iterator[Shell]:
    """Make a checkout's look-alike in a folder; what was started there is ended."""
    for name in ("examples", "deploy"):
        (folder / name).symlink_to(ROOT / name)
    opened = Shell(folder)
    opened.runtime.mkdir()
    try:
        yield opened
    finally:
        opened.stop()
