"""Private names of RLlib and Tune that restoring needs: if one is missing, the export is refused by name and version.

docs/reference/support.md lists them.
"""

from __future__ import annotations

import importlib
from typing import Any

from rlservo.errors import UnsupportedError

KNOWN = "2.60"
"""The Ray these names are of."""


def find(module: str, name: str) -> Any:
    """Return an object of a module of Ray by name. Raises UnsupportedError if this Ray does not have it."""
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError):
        raise _refusal(f"{module}.{name}") from None


def get(owner: Any, name: str) -> Any:
    """Return an object's attribute. Raises UnsupportedError if it does not exist in this Ray."""
    try:
        return getattr(owner, name)
    except AttributeError:
        raise _refusal(f"{type(owner).__module__}.{type(owner).__name__}.{name}") from None


def replace(owner: Any, name: str, value: Any) -> None:
    """Set an existing attribute: under a name that this Ray does not know, it would have no effect."""
    get(owner, name)
    setattr(owner, name, value)


def _refusal(name: str) -> UnsupportedError:
    import ray

    return UnsupportedError(
        f"Ray {ray.__version__} has no {name}, without which this checkpoint cannot be exported: export with a Ray "
        f"that this version of rlservo knows, such as {KNOWN}"
    )
