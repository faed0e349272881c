"""The environment variables that we set for Ray: the installed Ray reads each of them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import ray

from rlservo.serve_app.ray_serve.environment import ray_environment

RAY = Path(ray.__file__).parent
REPOSITORY = Path(__file__).resolve().parents[3]
NAME = re.compile(r"RAY_\w*[A-Za-z]")
SOURCES = ("serve/**/*.py", "tune/**/*.py", "_private/**/*.py", "_common/**/*.py")
BINARIES = ("_raylet.so", "core/src/ray/raylet/raylet", "core/src/ray/gcs/gcs_server")
PLACEHOLDERS = {"RAY_VERSION"}  # of RLSERVO_RAY_VERSION, our own


def names_set(folder: Path) -> set[str]:
    """Return what the launcher and the trainings set, the manifest tells operators to set, and the proxy looks at."""
    found = {name for name in ray_environment(folder, haproxy="/bin/true", mark="test") if name.startswith("RAY_")}
    for file in (
        "deploy/serve.yaml",
        "examples/shared/ray_settings.py",
        "serve_app/ray_serve/haproxy/configuration.py",
    ):
        found |= set(NAME.findall((REPOSITORY / file).read_text()))
    return found - PLACEHOLDERS


@pytest.fixture(scope="module")
def known() -> set[str]:
    """Every variable that Ray reads: quoted in its Python files, or a whole string of its binaries (RAY_CONFIG)."""
    files = [file for pattern in SOURCES for file in RAY.glob(pattern) if "tests" not in file.relative_to(RAY).parts]
    quoted = re.compile(r"""["'](RAY_\w+)["']""")
    found = {name for file in files for name in quoted.findall(file.read_text(encoding="utf-8", errors="replace"))}
    for binary in BINARIES:
        strings = re.findall(rb"(?<=\0)RAY_\w+(?=\0)", (RAY / binary).read_bytes())
        found |= {name.decode() for name in strings}
    return found


def test_ray_knows_every_variable_that_is_set_for_it(known: set[str], tmp_path: Path) -> None:
    wanted = names_set(tmp_path)
    assert len(wanted) > 35 and {"RAY_event_stats_print_interval_ms", "RAY_SERVE_ENABLE_HA_PROXY"} <= wanted
    assert not wanted - known, f"Ray {ray.__version__} does not read {sorted(wanted - known)}"
    # A renamed variable is missed: nothing here takes any name for known.
    assert not {"RAY_SERVE_HAPROXY_RETRY", "RAY_event_stats_print_interval", "RAY_SERVE_ENABLE_HAPROXY"} & known
