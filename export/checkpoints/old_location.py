"""Location of an old-API-stack checkpoint's files: `policies/<policy id>/policy_state.pkl`, or such a folder alone.

As in `location.py`, names of files are enough.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from rlservo.errors import CheckpointError, UnsupportedError

POLICIES = "policies"
POLICY_STATE = "policy_state.pkl"
ALGORITHM_STATE = "algorithm_state.pkl"
DEFAULT_POLICY = "default_policy"  # RLlib's id if there is only one policy or module
RLLIB_FILE = "rllib_checkpoint.json"

_MSGPACK_STATES = ("policy_state.msgpck", "policy_state.msgpack")


@dataclass(frozen=True)
class OldStackFiles:
    """One policy of an old-stack checkpoint; its state file exists."""

    api_stack: ClassVar[Literal["old"]] = "old"

    root: Path
    """The algorithm checkpoint, or the policy's own folder if there is nothing else."""
    module_id: str
    """The policy's id, under the exporter's name for it."""

    @property
    def agent_id(self) -> None:
        """Always None: all agents of a policy share one filter."""

    @property
    def is_one_of_several(self) -> bool:
        """Whether the policy has an id of its own, and may have others next to it."""
        return self.policy != self.root and self.module_id != DEFAULT_POLICY

    @property
    def policy(self) -> Path:
        inside = self.root / POLICIES / self.module_id
        return inside if inside.is_dir() else self.root

    @property
    def state(self) -> Path:
        return self.policy / POLICY_STATE

    def files(self) -> list[Path]:
        """Return every file that affects the policy."""
        return [self.state]

    def sha256(self) -> str:
        """Return a hash over the state's contents: the same for a checkpoint, its pruned copy and its policy folder."""
        return hashlib.sha256(self.state.read_bytes()).hexdigest()


def old_stack_root(given: Path) -> Path | None:
    """Return the algorithm checkpoint (or lone policy folder) of the old stack that `given` is or lies in, if any.

    Raises UnsupportedError for one that is too old to describe what surrounds its network.
    """
    inside = {POLICIES: given.parent} if given.name == POLICIES else {}
    if given.parent.name == POLICIES:
        inside[POLICIES] = given.parent.parent
    for folder in (given, *inside.values()):
        if policy_ids(folder):
            return folder
    if _has_state(given):
        return given
    if any(re.fullmatch(r"checkpoint-\d+", child.name) for child in given.iterdir()) or _major_version(given) == "0":
        raise UnsupportedError(
            f"{given} was written by a Ray before 2.1, whose checkpoints do not hold the connectors that filter "
            "observations and scale actions: restore it in the Ray that wrote it, train on or save again with a later "
            "one, and export that"
        )
    if _major_version(given) == "1":
        raise CheckpointError(
            f"{given} is incomplete: a checkpoint of RLlib's old API stack holds "
            f"{POLICIES}/<policy id>/{POLICY_STATE}, and this one holds no policy"
        )
    return None


def locate_policy(root: Path, given: Path, policy_id: str | None) -> OldStackFiles:
    """Return one policy of the checkpoint at `root`: the requested one, the one that `given` is in, or the only one.

    Raises CheckpointError when there is no such policy, or several to choose from.
    """
    present = policy_ids(root)
    if not present:
        present = [policy_id or root.name]  # a policy's folder on its own, which does not name its id
    elif given.parent == root / POLICIES and policy_id is None:
        policy_id = given.name
    files = OldStackFiles(root, choose(root, present, policy_id, "policy", "policies"))
    if not files.state.is_file():
        raise UnsupportedError(
            f"{files.policy} holds its state as msgpack, which is not supported: only {POLICY_STATE}, RLlib's default, "
            "is; restore the algorithm with RLlib (and msgpack_numpy) and save it again without msgpack"
        )
    return files


def choose(root: Path, present: Sequence[str], name: str | None, singular: str, plural: str) -> str:
    """Return the requested module or policy, or the only one of those `present`. Raises CheckpointError."""
    if name is not None and name not in present:
        raise CheckpointError(f"{root} has no {singular} '{name}': it holds {', '.join(present) or 'none'}")
    if name is None and len(present) > 1:
        raise CheckpointError(
            f"{root} holds {len(present)} {plural} ({', '.join(present)}): name the one to export with --module-id, "
            "or export each of them with --all-modules"
        )
    return name or present[0]


def policy_ids(root: Path) -> list[str]:
    """Return the ids of the policies that an old-stack checkpoint holds; a policy's folder on its own holds none."""
    folder = root / POLICIES
    return sorted(child.name for child in folder.iterdir() if _has_state(child)) if folder.is_dir() else []


def _has_state(folder: Path) -> bool:
    return any((folder / name).is_file() for name in (POLICY_STATE, *_MSGPACK_STATES))


def _major_version(folder: Path) -> str | None:
    """Return the major checkpoint version in rllib_checkpoint.json, if that can be read."""
    try:
        recorded = json.loads((folder / RLLIB_FILE).read_text(encoding="utf-8"))
        return str(recorded["checkpoint_version"]).split(".")[0]
    except (OSError, ValueError, KeyError, TypeError):
        return None
