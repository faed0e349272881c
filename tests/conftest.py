"""robo-gym's own environment, for the tests that drive our servers with the original client.

robo-gym pins a protobuf that Ray cannot use, so it lives in a virtual environment of its own, built once into the
user's cache folder. Where that fails (no network, say) these tests skip with the reason, unless
RLSERVO_REQUIRE_ROBO_GYM is set, as it is in CI.
"""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

pytest_plugins = ["bundles", "checkpoints", "servers"]

ROBO_GYM = ["robo-gym==2.0.1", "robo-gym-server-modules==0.3.0.1"]
# What our light client imports. Not rlservo's own requirements: onnxruntime wants a newer protobuf than robo-gym, and
# pip would settle that with an old robo-gym-server-modules that has no pin and does not work.
CLIENT = ["httpcore>=1.0.6", "pydantic>=2.6"]


@pytest.fixture(scope="session")
def robo_gym_python() -> Path:
    """Return the Python of an environment with robo-gym, and without Ray, MuJoCo and rlservo."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rlservo-tests"
    folder = cache / f"robo-gym-2.0.1-python{sys.version_info[0]}.{sys.version_info[1]}"
    python, complete = folder / "bin" / "python", folder / "complete"
    wanted = " ".join([*ROBO_GYM, *CLIENT])
    cache.mkdir(parents=True, exist_ok=True)
    with (cache / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # another test run may be building it
        if not (complete.exists() and complete.read_text() == wanted):
            venv.create(folder, with_pip=True, clear=True)
            install = [str(python), "-m", "pip", "install", "-q", *ROBO_GYM, *CLIENT]
            done = subprocess.run(install, capture_output=True, text=True, timeout=500)
            if done.returncode != 0:
                reason = f"robo-gym's environment cannot be built: {done.stderr.strip()[-500:]}"
                if os.environ.get("RLSERVO_REQUIRE_ROBO_GYM"):
                    pytest.fail(reason)
                pytest.skip(reason)
            complete.write_text(wanted)
    return python
