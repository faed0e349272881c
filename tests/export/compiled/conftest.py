"""Compiled policies: the arm's dense network, once for all tests."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rlservo.export.compiled.compile import Compiled, compile_bundle


@pytest.fixture(scope="session")
def compiled_ur5(ur5: Path, tmp_path_factory: pytest.TempPathFactory) -> Compiled:
    """The C of a 27-256-256-6 network, with the library that was proven. Not to be written to."""
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    return compile_bundle(ur5, tmp_path_factory.mktemp("compiled") / "c")
