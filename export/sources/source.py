"""Source: a trainer's checkpoints, as the exporter reads them.

A source finds a policy by the names of files, names what loading it needs, and restores it: the recipe around its
network, the network to trace, and the framework's own way to act, which the parity gate compares with. How to add one:
docs/how-to/sources.md.
"""

from __future__ import annotations

import abc
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol, TypeAlias

from rlservo.errors import CheckpointError
from rlservo.export.checkpoints.facts import CheckpointFacts

if TYPE_CHECKING:
    from rlservo.export.sources.restored_policy import RestoredPolicy

Notify: TypeAlias = Callable[[str], None]
"""Takes one sentence for a person."""

PICKLES = "checkpoints are pickles and run code when loaded; export only those you trust"


@dataclass(frozen=True)
class RestoreOptions:
    """Options of one export that a source may need; those that its `options` do not name keep their defaults."""

    app_dir: Path
    """The folder of the user's own modules, which is on the import path."""
    value: bool = True
    """False leaves the value head out."""
    vecnormalize: Path | None = None
    """Stable-Baselines3's observation statistics, if they are not beside the model; `none` for a model without."""
    frame_stack: int = 1
    """Number of frames that Stable-Baselines3's VecFrameStack put into one observation."""
    joint_order: tuple[str, ...] = ()
    """The robot's joints in its own order, for an Isaac Lab or mjlab environment that does not describe them."""
    control_rate_hz: float | None = None
    """The control rate [Hz], if no file has it."""
    action_range: tuple[float, float] | None = None
    """Bounds that every element of a given ONNX's action is clipped to."""
    outputs: Mapping[str, str] = field(default_factory=dict)
    """Of a given ONNX's outputs: `action`, `none`, or the input that gets it at the next step."""


class PolicyFiles(Protocol):
    """One policy that was found, before anything of it is loaded."""

    @property
    def root(self) -> Path:
        """The checkpoint's file or folder."""
        ...

    @property
    def module_id(self) -> str:
        """The policy's id among several."""
        ...

    @property
    def agent_id(self) -> str | None: ...

    @property
    def is_one_of_several(self) -> bool:
        """Whether the policy has an id of its own, and may have others next to it."""
        ...

    def sha256(self) -> str:
        """Return a hash over all files that decide what the policy does."""
        ...


@dataclass(frozen=True)
class SinglePolicy:
    """The files of a checkpoint that holds one policy."""

    root: Path
    files: tuple[Path, ...]
    """All that decide what the policy does, in a fixed order."""
    module_id: str = "default_policy"
    agent_id: str | None = None
    is_one_of_several: bool = False

    def sha256(self) -> str:
        """Return a hash over the files' names and contents."""
        digest = hashlib.sha256()
        for file in self.files:
            digest.update(file.name.encode() + b"\0")
            digest.update(hashlib.sha256(file.read_bytes()).digest())
        return digest.hexdigest()


class Source(abc.ABC):
    """A trainer's format. One object serves all exports and keeps nothing."""

    name: ClassVar[str]
    """Its name for `--source`."""
    framework: ClassVar[str]
    """The framework as sentences call it."""
    distribution: ClassVar[str]
    """The installed package whose version goes into the contract."""
    extra: ClassVar[str]
    """The extra of rlservo that installs the framework."""
    packages: ClassVar[tuple[str, ...]] = ()
    """The modules that must be importable, besides torch and onnx."""
    expects: ClassVar[str]
    """Description of this source's paths, for the message about a path that no source recognises."""
    reference: ClassVar[str]
    """The parity gate's reference."""
    options: ClassVar[tuple[str, ...]] = ()
    """The options of `rlservo export` that it takes of those that not every source does, such as `--joint-order`."""

    @abc.abstractmethod
    def detects(self, path: Path) -> bool:
        """Return whether the existing `path` is this source's, by names of files and without loading any pickle."""

    @abc.abstractmethod
    def locate(self, path: Path, module_id: str | None, agent_id: str | None) -> PolicyFiles:
        """Return one policy's files.

        Raises CheckpointError when there is nothing to read, UnsupportedError when it is of a kind not exported.
        """

    def locate_all(self, path: Path) -> Sequence[PolicyFiles]:
        """Return the files of every policy of a checkpoint."""
        return [self.locate(path, None, None)]

    def loads(self, files: PolicyFiles) -> str:  # noqa: ARG002  # others depend on the file
        """Return the clause that warns of code that loading runs; '' if it runs none."""
        return PICKLES

    def facts(self, files: PolicyFiles, notify: Notify) -> CheckpointFacts:  # noqa: ARG002
        """Return what the checkpoint records of itself; nothing in it may stop an export."""
        return CheckpointFacts()

    @abc.abstractmethod
    def restore(self, files: PolicyFiles, options: RestoreOptions, notify: Notify) -> RestoredPolicy:
        """Restore one policy; starts no environment and no worker.

        Raises CheckpointError when it cannot be read, UnsupportedError when exporting it would lose something.
        """


def one_policy(path: Path, files: Sequence[Path], module_id: str | None, agent_id: str | None) -> SinglePolicy:
    """Return the only policy of a checkpoint. Raises CheckpointError when another is requested."""
    policy = SinglePolicy(path, tuple(files))
    if module_id not in (None, policy.module_id) or agent_id is not None:
        raise CheckpointError(f"{path}: --module-id and --agent-id are RLlib's: leave them out")
    return policy
