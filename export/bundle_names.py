"""Name and folder of a bundle: `<out>/<name>/<version>/`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlservo.bundle.contract import NAME_PATTERN, VERSION_PATTERN, version_key
from rlservo.errors import UsageError


def default_name(env_id: str | None, env_config: Mapping[str, Any], root: Path) -> str:
    """Return a policy name: 'rlservo/EndEffectorPositioningURSim-v0' gives 'end-effector-positioning-ur'.

    Without an environment it is the checkpoint folder's name. One that wraps another (`rlservo/Randomized-v0`) has the
    other's id among its arguments.
    """
    wrapped = env_config.get("env_id")
    env_id = wrapped if isinstance(wrapped, str) and wrapped else env_id
    stem = re.split(r"[/:.]", env_id)[-1] if env_id else root.name
    stem = re.sub(r"-v\d+$", "", stem)
    stem = re.sub(r"(Sim|Rob|Env)$", "", stem) or stem
    words = re.findall(r"[A-Z]+(?![a-z])\d*|[A-Z]?[a-z]+\d*|[A-Z]|\d+", stem)
    return "-".join(word.lower() for word in words)[:64].strip("-") or "policy"


def bundle_name(base: str, module_id: str, agent_id: str | None) -> str:
    """Return the name of one policy of several; characters that a name may not have become '-'."""
    parts = [base, module_id, *([agent_id] if agent_id else [])]
    return re.sub(r"[^A-Za-z0-9._-]+", "-", "-".join(parts))[:64].rstrip("-.")


def check_names(name: str | None, version: str | None) -> None:
    """Raise UsageError when a requested name or version is not valid."""
    if name is not None and not re.fullmatch(NAME_PATTERN, name):
        raise UsageError(f"'{name}' cannot be a policy's name: expected up to 64 letters, digits, '.', '_' and '-'")
    if version is not None and not re.fullmatch(VERSION_PATTERN, version):
        raise UsageError(f"'{version}' cannot be a version: expected a positive integer or a form like 1.2.0")


def choose_target(out: Path, name: str, version: str | None) -> Path:
    """Return the folder to write, which does not exist yet; the version defaults to the next integer.

    Raises UsageError when that version already exists, or something is in the way.
    """
    policy = out / name
    if (out.exists() and not out.is_dir()) or (policy.exists() and not policy.is_dir()):
        raise UsageError(f"{policy if out.is_dir() else out} is a file: expected a folder to write bundles into")
    present = [child.name for child in policy.iterdir()] if policy.is_dir() else []
    versions = [entry for entry in present if re.fullmatch(VERSION_PATTERN, entry)]
    if version is None:
        version = str(max((version_key(entry)[0] for entry in versions), default=0) + 1)
    if version in present:
        raise UsageError(f"{policy / version} already exists: versions are never overwritten; leave the version out "
                         f"for the next one")  # fmt: skip
    return policy / version
