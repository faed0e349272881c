"""Loading of a checkpoint's pickles, with a one-sentence reason if one cannot be loaded.

Loading a pickle runs the code it names; callers warn first.
"""

from __future__ import annotations

import io
import pickle
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

from rlservo.errors import CheckpointError, UsageError, first_line
from rlservo.export.checkpoints import older_rays

TRUNCATED = "the file is truncated or damaged ({})"


@contextmanager
def user_code(app_dir: str | Path) -> Iterator[Path]:
    """Let the checkpoint import the user's own modules from `app_dir`, before anything else of that name.

    Gives the folder's absolute path. Raises UsageError if it is not a folder.
    """
    folder = str(Path(app_dir).expanduser().absolute())
    if not Path(folder).is_dir():
        raise UsageError(f"{folder} is not a folder: expected the one that holds your own classes (--app-dir)")
    sys.path.insert(0, folder)
    try:
        yield Path(folder)
    finally:
        if folder in sys.path:  # imported code may have changed the path itself
            sys.path.remove(folder)


def unpickle(file: Path, *, missing_ok: bool = False) -> Any:
    """Return the object pickled in `file` (cloudpickle writes ordinary pickles).

    With `missing_ok`, values whose class Ray no longer has are left out: for what does not decide what a policy does.
    Raises CheckpointError when the file is missing or damaged, or the code it names cannot be imported.
    """
    try:
        with file.open("rb") as stream:
            return _load(stream, str(file), missing_ok=missing_ok)
    except OSError as error:
        raise CheckpointError(f"{file} cannot be read: {error.strerror or error}") from error


def unpickle_bytes(pickled: bytes, name: str) -> Any:
    """Return the object that `pickled` holds, which messages call `name`. Raises CheckpointError as `unpickle` does."""
    return _load(io.BytesIO(pickled), name, missing_ok=False)


def _load(stream: BinaryIO, name: str, *, missing_ok: bool) -> Any:
    try:
        return _Unpickler(stream, missing_ok=missing_ok).load()
    except OSError:
        raise
    except Exception as error:  # a damaged pickle raises almost anything, and so does the code it runs
        damaged = isinstance(error, UnicodeDecodeError | IndexError | KeyError | MemoryError)
        reason = TRUNCATED.format(first_line(error)) if damaged else explain(error)
        raise CheckpointError(f"{name} cannot be loaded: {reason}") from error


def unpickle_present(file: Path) -> Any:
    """Return the object pickled in `file`; code that cannot be imported raises when it is called.

    For a configuration that names modules which are not there. Raises CheckpointError when the file is damaged.
    """
    try:
        with file.open("rb") as stream:
            return _PresentUnpickler(stream).load()
    except Exception as error:  # a damaged pickle raises almost anything
        raise CheckpointError(f"{file} cannot be loaded: {explain(error)}") from error


def modules_named(file: Path) -> set[str]:
    """Return the modules whose code a pickle names, without importing any; of a damaged one those before the damage."""
    with file.open("rb") as stream:
        unpickler = _NamesUnpickler(stream, missing_ok=False)
        with suppress(Exception):
            unpickler.load()
    return unpickler.modules


class _Missing:
    """Stand-in for code that cannot be imported: a pickle may do anything with it, but nothing else may call it."""

    error: ClassVar[Exception]
    is_read: ClassVar[bool] = False
    """Whether the pickle has been read to its end."""

    def __new__(cls, *_args: Any, **_kwargs: Any) -> _Missing:
        if cls.is_read:
            raise cls.error
        return object.__new__(cls)

    def __init__(self, *_args: Any, **_kwargs: Any) -> None: ...

    def __call__(self, *_args: Any, **_kwargs: Any) -> _Missing:
        return type(self)()

    def __deepcopy__(self, _memo: Any) -> _Missing:
        return self

    def __setitem__(self, _key: Any, _value: Any) -> None: ...

    def __setstate__(self, _state: Any) -> None: ...

    def extend(self, _items: Any) -> None: ...

    append = add = extend


class _Unpickler(pickle.Unpickler):
    """Reads older Rays' pickles as current ones."""

    def __init__(self, stream: BinaryIO, *, missing_ok: bool) -> None:
        super().__init__(stream)
        self._missing_ok = missing_ok

    def find_class(self, module: str, name: str) -> Any:
        return older_rays.find_class(super().find_class, module, name, missing_ok=self._missing_ok)


class _PresentUnpickler(_Unpickler):
    """Puts a stand-in where code cannot be imported."""

    def __init__(self, stream: BinaryIO) -> None:
        super().__init__(stream, missing_ok=False)
        self._missing: list[type[_Missing]] = []

    def load(self) -> Any:
        opened = super().load()
        for kind in self._missing:
            kind.is_read = True
        return opened

    def find_class(self, module: str, name: str) -> Any:
        try:
            return super().find_class(module, name)
        except Exception as error:  # a module of the user's own may raise anything when it is imported
            self._missing.append(type(name, (_Missing,), {"error": error, "__module__": module}))
            return self._missing[-1]


class _NamesUnpickler(_Unpickler):
    """Imports nothing."""

    def __init__(self, stream: BinaryIO, *, missing_ok: bool) -> None:
        super().__init__(stream, missing_ok=missing_ok)
        self.modules: set[str] = set()

    def find_class(self, module: str, name: str) -> Any:
        self.modules.add(module)
        return type(name, (_Missing,), {})


def explain(error: BaseException) -> str:
    """Return in one clause why loading failed: the file, the code it names, or what that code raised."""
    if isinstance(error, ModuleNotFoundError) and error.name:
        return (
            f"it needs the Python module '{error.name}', which was not found in {searched()}; "
            "give the folder that holds it with --app-dir"
        )
    if isinstance(error, ImportError | AttributeError):
        return (
            f"its code does not fit what is installed ({first_line(error)}); looked in {searched()}, and --app-dir "
            "names another folder"
        )
    if isinstance(error, pickle.UnpicklingError) and "weights_only" in str(error):  # torch advises to load it unsafely
        code = re.search(r"GLOBAL (\S+)", str(error))
        what = f"names the code '{code[1]}'" if code else "is damaged, or no file of torch.save"
        return f"its weights are not tensors alone: the file {what}, and cannot be loaded"
    if isinstance(error, EOFError | pickle.UnpicklingError):
        return TRUNCATED.format(first_line(error))
    return first_line(error)


def searched() -> str:
    """Return the import path for a message: without the standard library."""
    hidden = ("lib/python", "__editable__", ".zip")
    own = [entry or "." for entry in sys.path if not any(part in entry for part in hidden)]
    return ", ".join(dict.fromkeys([*own, "the installed packages"]))
