"""Trial of a release's files: each is installed into an empty environment and tried.

`python .ci/try_release.py dist` exports a shipped checkpoint and asks a server for an action, with wheel and
sdist. It takes some minutes: each environment gets PyTorch and RLlib.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CHECKPOINT = ROOT / "examples" / "checkpoints" / "ur_positioning"
REQUEST = ROOT / "examples" / "ur5_request.json"
PORT = 8765
PATIENCE_S = 120.0


def run(folder: Path, *command: object) -> None:
    subprocess.run([str(word) for word in command], cwd=folder, check=True)


def action(url: str, server: subprocess.Popen[bytes]) -> list[float]:
    """Ask until the server answers."""
    headers = {"content-type": "application/json"}
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            with urllib.request.urlopen(urllib.request.Request(url, REQUEST.read_bytes(), headers)) as reply:
                answer: list[float] = json.load(reply)["action"]
                return answer
        except OSError:
            if server.poll() is not None or time.monotonic() > deadline:
                raise
            time.sleep(0.2)


def try_out(artifact: Path) -> None:
    """Install a wheel or an sdist, export, serve, ask. Raises if one of these fails."""
    with tempfile.TemporaryDirectory(prefix="rlservo-release-") as name:
        folder = Path(name)
        run(folder, sys.executable, "-m", "venv", "venv")
        python, rlservo = folder / "venv" / "bin" / "python", folder / "venv" / "bin" / "rlservo"
        constraints = ROOT / "constraints.txt"
        run(folder, python, "-m", "pip", "install", "-q", "-c", constraints, "--upgrade", "pip")
        run(folder, python, "-m", "pip", "install", "-q", "-c", constraints, f"{artifact}[serve,train]")
        run(folder, rlservo, "export", CHECKPOINT, "--out", "policies", "--name", "ur5")
        server = subprocess.Popen([str(rlservo), "serve", "policies", "--port", str(PORT)], cwd=folder, env=os.environ)
        try:
            answer = action(f"http://127.0.0.1:{PORT}/v1/policies/ur5/act", server)
        finally:
            server.terminate()
            server.wait(60)
        if len(answer) != 5:
            raise SystemExit(f"{artifact.name} answered {answer}, expected five joint positions")


def main() -> None:
    artifacts = sorted(Path(sys.argv[1]).resolve().iterdir())
    if {artifact.suffix for artifact in artifacts} != {".whl", ".gz"}:
        sys.exit(f"expected a wheel and an sdist in {sys.argv[1]}, found {[one.name for one in artifacts]}")
    for artifact in artifacts:
        print(f"trying {artifact.name}", flush=True)  # noqa: T201
        try_out(artifact)


if __name__ == "__main__":
    main()
