"""Registry of sources: ours by name, others' by the entry point group `rlservo.sources`."""

from __future__ import annotations

import pkgutil
from importlib.metadata import entry_points
from pathlib import Path

from rlservo.errors import CheckpointError, UsageError, first_line
from rlservo.export.sources.source import Notify, Source

ENTRY_POINTS = "rlservo.sources"
OURS = (
    "rlservo.export.rllib.rllib_source:NewStack",
    "rlservo.export.rllib.rllib_source:OldStack",
    "rlservo.export.sources.sb3:StableBaselines3",
    "rlservo.export.sources.rsl_rl:RslRl",
    "rlservo.export.sources.skrl:Skrl",
    "rlservo.export.sources.leapp:Leapp",
    "rlservo.export.sources.onnx.onnx_source:GivenOnnx",
)
"""Their modules import no framework. The first one is used if a path does not exist."""


def sources(notify: Notify | None = None) -> list[Source]:
    """Return all sources; `notify` gets a sentence for each entry point that cannot be imported."""
    found: list[Source] = [pkgutil.resolve_name(path)() for path in OURS]
    for point in entry_points(group=ENTRY_POINTS):
        try:
            made = point.load()()
        except Exception as error:  # another package's code raises anything
            if notify is not None:
                notify(f"the source '{point.name}' of {point.value} cannot be imported: {first_line(error)}")
            continue
        if isinstance(made, Source):
            found.append(made)
        elif notify is not None:
            notify(f"the source '{point.name}' of {point.value} is not an rlservo.export.sources.source.Source")
    return found


def find_source(path: Path, name: str | None = None, notify: Notify | None = None) -> Source:
    """Return the source called `name`, or the one that recognises `path`.

    Raises UsageError for an unknown name, CheckpointError if no source or more than one knows the path.
    """
    known = sources(notify)
    if name is not None:
        named = [source for source in known if source.name == name]
        if not named:
            raise UsageError(f"there is no source '{name}': expected one of {', '.join(each.name for each in known)}")
        return named[-1]  # an entry point may replace one of ours
    given = path.expanduser().absolute()
    if not given.exists():
        raise CheckpointError(f"{given} does not exist: expected a checkpoint")
    mine = [source for source in known if source.detects(given)]
    if len(mine) > 1:
        names = ", ".join(source.name for source in mine)
        raise CheckpointError(f"{given} matches several sources ({names}): choose one with --source")
    if not mine:
        raise CheckpointError(
            f"{given} is not a checkpoint of any known source: {'; '.join(f'{s.name}: {s.expects}' for s in known)}"
        )
    return mine[0]
