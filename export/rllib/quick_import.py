"""Faster imports of torch and RLlib, for a process that only restores a checkpoint.

The `__init__` of nearly every package of Ray's imports all modules below it, so that one RLModule imports Tune, Train,
Data, pandas and every algorithm (ray 2.60): 1.2 s of processor time for nothing. While this module imports what any
checkpoint of the new API stack needs, such packages are made without running their `__init__`. It runs later, before
those below it as usual, when a name of the package or another module below it is used: nothing is left out.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import sys
import threading
from collections.abc import Iterator, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

DEFERRED = ("ray.rllib", "ray.tune", "ray.train", "ray.data", "ray.air")
"""These packages, and those below them, are deferred."""
AT_ONCE = ("ray.rllib.connectors", "ray.rllib.core")
"""Except these: a checkpoint's pipelines and networks may name any of their modules."""
ELSEWHERE = {
    ("ray.train", "Checkpoint"): "ray.train._checkpoint",
    ("ray.tune", "Checkpoint"): "ray.tune.trainable.trainable_fn_utils",
}
"""Modules with names that RLlib needs from deferred packages, to distinguish a checkpoint from a path (ray 2.60)."""
NEEDED = (
    "rlservo.export.rllib.new_stack.policy",  # and its imports from RLlib
    "ray.rllib.connectors.env_to_module",
    "ray.rllib.connectors.module_to_env",
    "ray.rllib.core.models.torch.encoder",
    "ray.rllib.core.models.torch.heads",
    "ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module",
)
"""Imported while packages are deferred: names in checkpoints of PPO's default module and its pipelines."""
_TORCH_LIBRARY = "lib/libtorch_python.so"


def prepare() -> None:
    """Let this process import less from now on; only for our own programs, as it changes how Ray's packages load.

    torch's shared libraries are mapped while other modules are imported, without Python's lock: this saves a quarter of
    a second.
    """
    if not any(isinstance(finder, Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, Finder())
    if "torch" not in sys.modules:
        # Not a daemon: a process that ends at once, for a wrong path, must not end in the middle of this.
        threading.Thread(target=_load_torch_library, name="torch-library").start()


def _load_torch_library() -> None:
    """Map torch's libraries. If they are elsewhere or cannot be loaded, torch's own import reports it."""
    spec = find_spec("torch")
    for folder in (spec and spec.submodule_search_locations) or ():
        with contextlib.suppress(OSError):
            ctypes.CDLL(str(Path(folder, _TORCH_LIBRARY)))


def import_needed() -> None:
    """Import what restoring needs, and little else, in a process that was prepared for it.

    If another version of RLlib cannot be imported this way, it is imported as usual.
    """
    finder = next((finder for finder in sys.meta_path if isinstance(finder, Finder)), None)
    if finder is None or "ray.rllib" in sys.modules:
        return
    with finder.deferring(), contextlib.suppress(ImportError):
        for name in NEEDED:
            importlib.import_module(name)


class Finder:
    """Finder of Ray's packages that defers them, and later runs the deferred packages above a module first."""

    def __init__(self) -> None:
        self.is_deferring = False

    @contextlib.contextmanager
    def deferring(self) -> Iterator[None]:
        """Defer packages that are found meanwhile."""
        self.is_deferring = True
        try:
            yield
        finally:
            self.is_deferring = False

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        if not name.startswith(DEFERRED):
            return None
        if not self.is_deferring:
            _run_above(name)
            return None
        if name.startswith(AT_ONCE):
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is None or spec.loader is None or not spec.has_location or spec.submodule_search_locations is None:
            return spec  # a module, not a package
        loader: Any = _Loader(spec.loader, self)
        spec.loader = loader
        return spec


class _Loader:
    """Loader that makes a package's module and runs its `__init__` at the first use."""

    def __init__(self, loader: Any, finder: Finder) -> None:
        self._loader = loader
        self._finder = finder

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        module: ModuleType | None = self._loader.create_module(spec)
        return module

    def exec_module(self, module: ModuleType) -> None:
        spec = module.__spec__
        assert spec is not None
        spec.loader = module.__loader__ = self._loader
        spec.loader_state = self._finder
        _set_class(module, _DeferredPackage)


class _DeferredPackage(ModuleType):
    """A package whose `__init__` has not run: it runs when a name is used that no import has set."""

    def __getattr__(self, name: str) -> Any:
        spec: Any = self.__spec__
        if spec.loader_state.is_deferring:
            if home := ELSEWHERE.get((self.__name__, name)):
                return getattr(importlib.import_module(home), name)
        elif name == "__warningregistry__":  # unittest and others ask every module there is
            raise AttributeError(name)
        else:
            _run_above(self.__name__)
        _run(self)
        return getattr(self, name)


def _run_above(name: str) -> None:
    """Run the deferred packages above a module, outermost first, as importing it normally does."""
    parts = name.split(".")
    for count in range(1, len(parts)):
        package = sys.modules.get(".".join(parts[:count]))
        if isinstance(package, _DeferredPackage):
            _run(package)


def _run(package: ModuleType) -> None:
    if not isinstance(package, _DeferredPackage):
        return
    _set_class(package, ModuleType)
    spec: Any = package.__spec__
    try:
        spec.loader.exec_module(package)
    except BaseException:
        _set_class(package, _DeferredPackage)  # the next caller sees the reason as well
        raise


def _set_class(module: Any, kind: type[ModuleType]) -> None:
    module.__class__ = kind
