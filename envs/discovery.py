"""Lets `gym.make("rlservo/...")` work in every process without an import, Ray's workers included.

Gymnasium removed its plugin loader in 1.0 (the `gymnasium.envs` entry points are declared by packages, but nobody reads
them any more). The installed file `rlservo-gymnasium.pth` calls `install()` when Python starts; that costs a fraction
of a millisecond, imports nothing heavy, and registers the environments right after Gymnasium's own.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

TRIGGER = "gymnasium.envs"


class _AfterGymnasium:
    """A meta-path finder that steps aside for everything but the one import it waits for."""

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None = None,  # noqa: ARG002 (the import system's signature)
        target: ModuleType | None = None,  # noqa: ARG002
    ) -> ModuleSpec | None:
        if fullname != TRIGGER:
            return None
        sys.meta_path.remove(self)  # once is enough, and the search below must not find us again
        from importlib.util import find_spec

        spec = find_spec(fullname)
        if spec is None or spec.loader is None:
            return spec
        load = spec.loader.exec_module

        def load_and_register(module: ModuleType) -> None:
            load(module)
            _register()

        spec.loader.exec_module = load_and_register  # type: ignore[method-assign]  # this one loader instance only
        return spec


def install() -> None:
    """Arrange for the registration; harmless when repeated."""
    if TRIGGER in sys.modules:
        _register()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


def _register() -> None:
    from rlservo.envs.registration import register_envs

    register_envs()
