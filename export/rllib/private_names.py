"""Private names of Ray that reading old-stack checkpoints needs: where one is gone, the export is refused by name."""

from __future__ import annotations

import importlib
from typing import Any

from rlservo.export.contract.errors import UnsupportedError


def find(module: str, name: str) -> Any:
    """Return what a module of Ray calls so. Raises UnsupportedError where this Ray has no such thing."""
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError):
        import ray

        raise UnsupportedError(
            f"Ray {ray.__version__} has no {module}.{name}, without which old-stack checkpoints cannot be exported: "
            "export with a Ray that this version of rlservo knows, such as 2.60"
        ) from None
