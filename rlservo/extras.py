"""Extras: packages that a part of rlservo needs beyond the in-process runtime."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

from rlservo.errors import UsageError


def install(extra: str) -> str:
    """Return the command that installs an extra. There is no release yet, and PyPI's `rlservo` would not be ours."""
    return f"pip install '.[{extra}]' in the checkout of rlservo"


def missing(package: str | None, extra: str, what: str) -> str:
    """Return the message about a package that is not installed."""
    return f"{what} needs the Python package {package!r}: {install(extra)}"


def require(extra: str, *packages: str, what: str = "this command") -> None:
    """Raise UsageError, which names the extra, when one of these packages is not installed. None is imported."""
    for package in packages:
        if find_spec(package) is None:
            raise UsageError(missing(package, extra, what))


@contextmanager
def needs_extra(extra: str, *packages: str, what: str = "this command") -> Iterator[None]:
    """Require an extra's packages; also raise UsageError when an import inside fails."""
    require(extra, *packages, what=what)
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("rlservo"):
            raise
        raise UsageError(missing(error.name, extra, what)) from error


def optional_package(name: str, purpose: str) -> ModuleType:
    """Import a package that one purpose needs and no extra has; raise UsageError if it is missing."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        package = (error.name or name).partition(".")[0]
        raise UsageError(f"{purpose} needs the Python package {package!r}: pip install {package}") from error
