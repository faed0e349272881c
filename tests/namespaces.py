"""Linux namespaces: commands that run with mounts, a network or processes of their own."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

ROOT = Path(__file__).resolve().parents[1]
# Its name has an address, whatever this one's is. What we need of /tmp is mounted again at its place. The shell stays:
# the first process must reap what others leave.
MACHINE = """
set -e
hostname localhost
ip link set lo up
ip address add "$1/32" dev lo; shift
mount --bind /tmp /mnt; mount -t tmpfs tmpfs /tmp
for kept; do
  case "$kept" in /tmp/*) mkdir -p "$kept"; mount --bind "/mnt/${kept#/tmp/}" "$kept" ;; esac
done
echo up; cat; exit
"""


def in_own_namespace(*options: str) -> list[str]:
    """Return the beginning of a command that runs with its own mounts, network or processes, or skip."""
    command = ["unshare", "--map-root-user", *options]
    if shutil.which("unshare") is None or subprocess.run([*command, "true"], capture_output=True).returncode != 0:
        pytest.skip("this machine allows no namespaces of one's own")
    return command


@contextmanager
def own_machine(folder: Path, address: str = "192.168.0.1") -> Iterator[tuple[str, ...]]:
    """Make what looks like another machine with this address and an empty /tmp; give the words that run a command on
    it, in `folder`. All that was started there ends with it. Skips where none may be made.
    """
    unshare = in_own_namespace("--net", "--uts", "--mount", "--pid", "--fork", "--mount-proc", "--kill-child")
    command = [*unshare, "sh", "-c", MACHINE, "sh", address, *map(str, (folder, ROOT, sys.prefix, sys.base_prefix))]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen(command, text=True, **pipes) as holder:
        assert holder.stdin is not None and holder.stdout is not None
        try:
            if (line := holder.stdout.readline()) != "up\n":
                pytest.skip(f"no other machine can be made here: {line.strip()}")
            (first,) = psutil.Process(holder.pid).children()
            # nsenter waits for the command: a Ctrl-C is the command's alone.
            yield (
                "env", "--ignore-signal=INT", "nsenter", f"--target={first.pid}", "--all", "--preserve-credentials",
                "env", "--default-signal=INT", f"--chdir={folder}",
            )  # fmt: skip
        finally:
            holder.stdin.close()
